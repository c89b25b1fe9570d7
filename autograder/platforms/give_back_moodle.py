"""Moodle's grading worksheet and the zip of its feedback files.

Moodle's import (`mod/assign/feedback/offline`) finds a row by the number at the end of Identifier, takes Grade as points out of the
assignment's maximum, leaves rows without a grade alone, and skips without a word what exceeds the maximum. Its zip
(`mod/assign/feedback/file`) gives each file to the participant whose number is the second part of `Name_number_assignsubmission_file_`.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Iterable
from pathlib import Path

from autograder.grading.verdicts import clean_text, write_atomically
from autograder.platforms import give_back_sheets
from autograder.platforms.give_back import GiveBackError, Given, Result, by_assignment, matched, the_assignment
from autograder.reporting.report import points, report_html
from autograder.reporting.tables import csv_text

COLUMNS = (
    "Identifier", "Full name", "Email address", "Status", "Grade", "Maximum grade", "Grade can be changed",
    "Last modified (submission)", "Last modified (grade)", "Feedback comments",
)  # fmt: skip
MARK = "Automatic grading: "  # begins our part of a comment: it is replaced the next time, what a teacher wrote before it stays
UNKNOWN = "Moodle's number of this participant is unknown: collect from Moodle's download, or give --worksheet"
_FOLDER = re.compile(r"(?P<name>[^_/]+)_(?P<id>\d+)_assignsubmission_file(?P<end>_?)(?P<file>[^/]*)", re.S)
_DATE = (1980, 1, 1, 0, 0, 0)  # the same bytes for the same feedback


def write(results: list[Result], into: Path, given: Given, worksheet: Path | None = None, automatic_only: bool = False) -> None:
    """Write `into/moodle/ch44.csv` and `into/moodle/ch44-feedback.zip` for each assignment, or the worksheet, filled in."""
    final = []
    for result in results:
        if result.waits and not automatic_only:
            given.leave_out(result, "waits for points by hand (formgrader; --automatic gives back the automatic points alone)")
        else:
            final.append(result)
    numbers = {result.student: (_number(result), _name(result)) for result in final if _number(result)}
    if worksheet is not None:
        final = the_assignment(final, worksheet)
        numbers = _fill(final, into, given, worksheet, automatic_only)
    for assignment, group in by_assignment(final).items():
        known = [result for result in group if result.student in numbers]
        if worksheet is None:
            for result in group:
                if result not in known:
                    given.leave_out(result, UNKNOWN)
            if known:
                given.files.append(write_atomically(into / "moodle" / f"{assignment}.csv", _made(known, automatic_only)))
                most = points(known[0].total(automatic_only)[1])
                given.notes.append(
                    f"{assignment}: the maximum grade in Moodle must be {most}. Tick there that newer grades are replaced."
                )
        if known:
            feedback = _zip((result, *numbers[result.student]) for result in known)
            given.files.append(write_atomically(into / "moodle" / f"{assignment}-feedback.zip", feedback))


def _number(result: Result) -> str:
    handed = result.handed
    return (handed.platform_id or "") if handed and handed.platform == "moodle" and (handed.platform_id or "").isdecimal() else ""


def _name(result: Result) -> str:
    return result.handed.name if result.handed and result.handed.name else result.person.name


def _names(result: Result) -> tuple[str, ...]:
    return (_number(result), result.person.login, result.student)


def _made(results: Iterable[Result], automatic_only: bool) -> str:
    rows = []
    for result in results:
        got, most = result.total(automatic_only)
        grades = (f"{got:.2f}", f"{most:.2f}", "Yes", "", "")
        rows.append((f"Participant {_number(result)}", _name(result), "", "", *grades, MARK + result.summary(automatic_only)))
    return csv_text(COLUMNS, rows)


def _fill(results: list[Result], into: Path, given: Given, worksheet: Path, automatic_only: bool) -> dict[str, tuple[str, str]]:
    """Fill the worksheet, and say for whom: student → Moodle's number and name."""
    sheet = give_back_sheets.read(worksheet)
    identifier, grade = sheet.needed("Identifier", "ID"), sheet.needed("Grade")
    sheet.needed("Last modified (grade)")  # without it, Moodle refuses the file
    most, can = sheet.column("Maximum Grade", "Maximum grade"), sheet.column("Grade can be changed")
    comments = sheet.column("Feedback comments")
    email = sheet.column("Email address", "Email", "Username")
    keys = {}
    for number, row in enumerate(sheet.rows[1:], 1):
        found = re.fullmatch(r"\D*?(\d+)", row[identifier].strip())
        if not found:
            cell = row[identifier]
            raise GiveBackError(f"{worksheet}: row {number + 1}: {cell!r} is no participant; expected as in 'Participant 987654'")
        address = row[email].strip() if email is not None else ""
        keys[number] = {found[1], address, address.partition("@")[0]}
    cure = "is this one's: collect from Moodle's download, or call the folder by Moodle's number or the e-mail address"
    full, scaled, numbers = sheet.column("Full name", "Name"), set(), {}
    for number, result in matched(results, keys, _names, given, cure).items():
        row = sheet.rows[number]
        if can is not None and row[can].strip().lower() == "no":
            given.leave_out(result, f"Moodle has locked its grade (row {number + 1})")
            continue
        numbers[result.student] = (re.sub(r"\D", "", row[identifier]), row[full] if full is not None else _name(result))
        got, maximum = result.total(automatic_only)
        limit = _points(row[most], worksheet, number + 1) if most is not None else maximum
        if limit != maximum:
            scaled.add((limit, maximum))
        row[grade] = f"{got * limit / maximum if maximum else 0.0:.2f}"
        if comments is not None:
            row[comments] = row[comments].partition(MARK)[0] + MARK + result.summary(automatic_only)
    for limit, maximum in sorted(scaled):
        given.notes.append(f"Moodle's maximum is {points(limit)}, the assignment's {points(maximum)}: grades are scaled.")
    given.files.append(write_atomically(sheet.target(into / "moodle"), sheet.to_bytes()))
    return numbers


def _points(text: str, worksheet: Path, row: int) -> float:
    try:
        value = float(text.strip().replace(",", "."))
    except ValueError:
        value = -1.0
    if not 0 < value < 1e9:
        raise GiveBackError(
            f"{worksheet}: row {row}: the maximum grade {text!r} is no number; let Moodle grade this assignment in points"
        )
    return value


def _zip(addressed: Iterable[tuple[Result, str, str]]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for result, number, name in addressed:
            entry = zipfile.ZipInfo(f"{_place(result, number, name)}report-{result.assignment}.html", _DATE)
            archive.writestr(entry, report_html(result.verdict, result.marks).encode(), zipfile.ZIP_DEFLATED)
    return stream.getvalue()


def _place(result: Result, number: str, name: str) -> str:
    """What comes before a feedback file's name: the download's own folder, or its prefix where it had none."""
    download = result.handed.download.replace("\\", "/") if result.handed else ""
    for part in download.split("/"):
        found = _FOLDER.fullmatch(part)
        if found and found["id"] == number:
            prefix = f"{clean_text(found['name'], 200)}_{number}_assignsubmission_file{found['end']}"
            return prefix if found["file"] else prefix + "/"
    plain = re.sub(r"[_/\\\x00-\x1f]+", " ", name).strip(" .") or "Participant"
    return f"{clean_text(plain, 200)}_{number}_assignsubmission_file_/"
