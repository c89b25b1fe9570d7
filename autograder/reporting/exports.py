"""What teachers, learning platforms and CI read: derived from `DIR/verdicts` and the gradebook alone, but for
Canvas's IDs, which stand in the list that `course collect` wrote beside the submissions.

Every run writes everything anew and replaces it atomically, rows sorted by student and assignment. Verdicts contain text that
learners chose: each format escapes it in its own way, and no CSV cell can be a formula.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autograder.grading import sources
from autograder.grading.verdicts import FINAL, Verdict, read_all, write_atomically
from autograder.reporting import collected, tables
from autograder.reporting.class_page import class_pages
from autograder.reporting.machines import gradescope_json, junit_xml, measured_times
from autograder.reporting.people import same_files, summary_markdown, table
from autograder.reporting.report import report_html
from autograder.reporting.tables import canvas_csv, grades_csv, questions_csv
from autograder.reporting.workbook import workbook

if TYPE_CHECKING:
    from autograder.reporting.gradebook import GradebookWriter

__all__ = [
    "FINAL", "canvas_csv", "countable", "grades_csv", "gradescope_json", "junit_xml", "questions_csv", "report_html", "same_files",
    "summary_markdown", "table", "write_all",
]  # fmt: skip


def write_all(directory: Path, gradebook: GradebookWriter, judged: Iterable[Verdict] = ()) -> list[Verdict]:
    """Write every export of the verdicts in `directory/verdicts`, also of students who are absent this time, and return them.

    `judged` are this run's verdicts, which know how long each exercise took; of others the last `junit.xml` knows it.
    Raises: ValueError if a file there is no verdict.
    """
    directory = Path(directory)
    verdicts = with_times(read_all(directory / "verdicts"), judged, directory / "junit.xml")
    marks, rows = gradebook.marks(), gradebook.grades()
    handed: dict[tuple[str, str], collected.Handed] = {}
    with suppress(ValueError):  # a damaged list costs IDs and no grade; `course return` says what is wrong with it
        handed = collected.read(sources.read(directory))
    grades = countable(rows, verdicts)
    write_atomically(directory / "grades.csv", grades_csv(grades))
    write_atomically(directory / "questions.csv", questions_csv(verdicts))
    sheets: dict[str, tuple[Sequence[str], Iterable[Sequence[Any]]]] = {
        "grades": tables.grades_table(grades),
        "questions": (tables.QUESTION_COLUMNS, tables.questions_table(verdicts)),
    }
    write_atomically(directory / "grades.xlsx", workbook(sheets))
    write_atomically(directory / "junit.xml", junit_xml(verdicts))
    write_atomically(directory / "canvas.csv", canvas_csv(grades, handed))
    files = tables.canvas_files(grades, handed)
    for path in (directory / "canvas").glob("*.csv"):
        if f"canvas/{path.name}" not in files:  # nobody has points there any longer
            path.unlink()
    for file, text in files.items():
        write_atomically(directory / file, text)
    penalties = {(row["student_id"], row["assignment"]): row["late_submission_penalty"] for row in rows}
    for verdict in verdicts:
        key, name = (verdict.student, verdict.assignment), Path(verdict.student) / verdict.assignment
        given = marks.get(key, [])
        write_atomically(directory / "gradescope" / f"{name}.json", gradescope_json(verdict, given, penalties.get(key, 0.0)))
        write_atomically(directory / "report" / f"{name}.html", report_html(verdict, given))
    people = {student: one.name for student, one in tables.who(rows, handed).items()}
    for file, text in class_pages(verdicts, people).items():
        write_atomically(directory / file, text)
    return verdicts


def with_times(verdicts: Iterable[Verdict], judged: Iterable[Verdict], earlier: Path) -> list[Verdict]:
    """The verdicts with the seconds of their exercises, which their files do not hold: from this run, else from `earlier`."""
    fresh = {(verdict.student, verdict.assignment): verdict for verdict in judged}
    known = measured_times(earlier)
    timed = []
    for verdict in verdicts:
        now = fresh.get((verdict.student, verdict.assignment))
        times = known.get((f"{verdict.student}/{verdict.assignment}", f"{verdict.seconds:.3f}"), {})
        timed.append(replace(verdict, timings=dict(now.timings) if now else times))
    return timed


def countable(grades: Iterable[Mapping[str, Any]], verdicts: Iterable[Verdict]) -> list[Mapping[str, Any]]:
    """The rows of the gradebook without those whose latest submission has no final verdict: neither a zero nor an older score
    may stand for it."""
    pending = {(verdict.student, verdict.assignment) for verdict in verdicts if verdict.status not in FINAL}
    return [row for row in grades if (row["student_id"], row["assignment"]) not in pending]
