"""nbgrader's feedback folder, `feedback/STUDENT/ASSIGNMENT/ASSIGNMENT.html`, as `nbgrader release_feedback` takes it.

nbgrader names what it releases by the submission's secret, which the exchange lays beside each submission with its time: both files
are copied from the submission's folder, where the exchange put them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from autograder.grading.verdicts import write_atomically
from autograder.platforms.give_back import Given, Result
from autograder.reporting.report import report_html

RECEIPTS = ("timestamp.txt", "submission_secret.txt")
_MAX_BYTES = 4096


def write(results: list[Result], into: Path, given: Given, submitted: Sequence[Path]) -> None:
    """Write the reports of the verdicts, with points by hand as they are now, into nbgrader's layout."""
    lacking = []
    for result in results:
        folder = into / "feedback" / result.student / result.assignment
        page = report_html(result.verdict, result.marks)
        given.files.append(write_atomically(folder / f"{result.assignment}.html", page))
        for name in RECEIPTS:
            places = [one / result.student / result.assignment / name for one in submitted]
            fitting = [one for one in places if one.is_file() and not one.is_symlink() and one.stat().st_size <= _MAX_BYTES]
            if fitting:
                given.files.append(write_atomically(folder / name, fitting[-1].read_bytes()))
            elif not (folder / name).is_file():
                lacking.append(f"{result.student} {result.assignment}")
    if lacking:
        given.notes.append(
            "`nbgrader release_feedback` needs timestamp.txt and submission_secret.txt as the exchange lays them beside a submission; "
            f"they are missing for {', '.join(dict.fromkeys(lacking))}."
        )
