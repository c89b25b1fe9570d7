"""Tables for teachers and for learning platforms. No cell of a CSV can be a formula, and no table can clear a grade.

The files are UTF-8 without a byte-order mark, since other programs read them; Excel gets `grades.xlsx` with the same rows.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from autograder.grading.verdicts import FINAL, Verdict, clean_text
from autograder.reporting.collected import Handed

QUESTION_COLUMNS = ("student", "assignment", "exercise", "state", "score", "max_score", "misconceptions")
BY_HAND = " by hand"  # ends the name of the column that holds an assignment's open questions

_FORMULA = tuple("=+-@＝＋－＠")  # some spreadsheets take the full-width characters, too


class Exact(str):
    """Text that is written as it is, because another program must find it again."""


def cell(value: Any) -> Any:
    """A CSV cell that no spreadsheet takes for a formula, nor a carriage return for a new row; numbers stay numbers."""
    if isinstance(value, Exact):
        return str(value)
    if not isinstance(value, str):
        return "" if value is None else value
    text = clean_text(value)
    return "'" + text if text.startswith("\t") or text.lstrip()[:1] in _FORMULA else text


def csv_text(header: Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    """The CSV of a table, every cell as `cell` makes it."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([cell(name) for name in header])
    writer.writerows([cell(value) for value in row] for row in rows)
    return stream.getvalue()


def grades_csv(grades: Iterable[Mapping[str, Any]]) -> str:
    """nbgrader's own export (`GradebookWriter.grades`), with proper quoting."""
    return csv_text(*grades_table(grades))


def grades_table(grades: Iterable[Mapping[str, Any]]) -> tuple[Sequence[str], list[list[Any]]]:
    """Header and rows of `grades.csv`."""
    from autograder.reporting.gradebook import GRADE_COLUMNS

    return GRADE_COLUMNS, [[row[column] for column in GRADE_COLUMNS] for row in grades]


def questions_csv(verdicts: Iterable[Verdict]) -> str:
    """A row for each exercise of each submission; the score is blank where none is final, as that of an open question is here."""
    return csv_text(QUESTION_COLUMNS, questions_table(verdicts))


def questions_table(verdicts: Iterable[Verdict]) -> list[tuple[Any, ...]]:
    """The rows of `questions.csv`."""
    rows = []
    for verdict in verdicts:
        for item in verdict.items:
            score = item.score if verdict.status in FINAL and item.state != "manual" else None
            misconceptions = ";".join(item.misconceptions)
            rows.append((verdict.student, verdict.assignment, item.exercise, item.state, score, item.max_score, misconceptions))
    return rows


# --- Canvas ------------------------------------------------------------------------------------------------------------------

_CANVAS_HEADER = ("Student", "ID", "SIS User ID", "SIS Login ID", "Section")
_LOGIN = re.compile(r"[-+@]?[\w.][\w.@-]*\Z")  # a name after a sign calls nothing in a spreadsheet, and Canvas must find it
_NUMBER = re.compile(r"-?[0-9.,]+%?\Z")

Column = tuple[float, dict[str, float]]  # points possible, and student → points


def canvas_csv(grades: Sequence[Mapping[str, Any]], handed: Mapping[tuple[str, str], Handed] = MappingProxyType({})) -> str:
    """Canvas's gradebook import: for each assignment the automatic points, and those by hand in a column of their own.

    A blank cell would clear the grade that Canvas has. So this is the largest part of the class's table that has no blanks: as many
    of the columns that most students have, and the students who have all of these. `canvas_files` has everything, column by column.
    Canvas finds a student by ID (nbgrader's `lms_user_id`, or from Canvas's download) or by login (the submission's folder).
    """
    columns = canvas_columns(grades)
    return canvas_table({name: columns[name] for name in without_blanks(columns)}, who(grades, handed))


def without_blanks(columns: Mapping[str, Column]) -> list[str]:
    """The columns of the largest table without blanks, of those that put the columns that most students have first."""
    names = sorted(columns, key=lambda name: (-len(columns[name][1]), name))
    chosen, cells = [], 0
    for count in range(1, len(names) + 1):
        students = set.intersection(*(set(columns[name][1]) for name in names[:count]))
        if count * len(students) > cells:
            chosen, cells = names[:count], count * len(students)
    return sorted(chosen)


def canvas_files(
    grades: Sequence[Mapping[str, Any]], handed: Mapping[tuple[str, str], Handed] = MappingProxyType({})
) -> dict[str, str]:
    """One file for each column of Canvas, with the students who have points there: `canvas/ch44.csv`, `canvas/ch44 by hand.csv`."""
    people = who(grades, handed)
    return {f"canvas/{name}.csv": canvas_table({name: column}, people) for name, column in canvas_columns(grades).items()}


def canvas_columns(grades: Iterable[Mapping[str, Any]]) -> dict[str, Column]:
    """Name → column. What a late submission loses is taken off the automatic points first, then off those by hand."""
    columns: dict[str, Column] = {}
    for row in grades:
        if not row["submitted"]:
            continue
        name, penalty = row["assignment"], row["late_submission_penalty"]
        columns.setdefault(name, (row["automatic_max"], {}))[1][row["student_id"]] = max(0.0, row["automatic"] - penalty)
        if row["by_hand_max"] and row["by_hand"] is not None:
            rest = max(0.0, penalty - row["automatic"])
            columns.setdefault(name + BY_HAND, (row["by_hand_max"], {}))[1][row["student_id"]] = max(0.0, row["by_hand"] - rest)
    return columns


@dataclass(frozen=True)
class Person:
    """How Canvas may know a student."""

    name: str
    login: str
    identity: str | None = None  # Canvas's own number


def person(row: Mapping[str, Any], handed: Handed | None = None) -> Person:
    """Name, last one first, login and Canvas's ID of a row of the gradebook.

    What the gradebook does not know may be known from the download. A login is the submission's folder, but not where that came from
    Canvas: its downloads show a number, which is the ID, and a name, which may be somebody else's login.
    """
    student, name = row["student_id"], ", ".join(filter(None, (row["last_name"], row["first_name"])))
    shown, login, identity = "", None, None
    if handed:
        shown, login = handed.name or "", handed.login
        if handed.platform == "canvas" and (handed.platform_id or "").isdecimal():
            identity, login = handed.platform_id, login or ""
    return Person(name or shown or student, student if login is None else login, row["lms_user_id"] or identity)


def who(
    grades: Iterable[Mapping[str, Any]], handed: Mapping[tuple[str, str], Handed] = MappingProxyType({})
) -> dict[str, Person]:
    """Student → how Canvas may know them."""
    from_canvas = {student: one for (student, _), one in handed.items() if one.platform == "canvas"}
    return {row["student_id"]: person(row, from_canvas.get(row["student_id"])) for row in grades}


def canvas_table(columns: Mapping[str, Column], people: Mapping[str, Person]) -> str:
    """The CSV with these columns and the students who have all of them."""
    students = sorted(set.intersection(*(set(column[1]) for column in columns.values()))) if columns else []
    lines: list[list[Any]] = [["    Points Possible", "", "", "", "", *(points for points, _ in columns.values())]]
    for student in students:
        known = people[student]
        scores = [column[1][student] for column in columns.values()]
        lines.append([known.name, known.identity, "", _canvas_login(known), "", *scores])
    return csv_text((*_CANVAS_HEADER, *columns), lines)


def _canvas_login(person: Person) -> str:
    """The login, which Canvas compares character by character; blank if it could be a formula and the ID is enough."""
    if _LOGIN.match(person.login):
        return Exact(person.login)
    return "" if person.identity and cell(person.login) != person.login else person.login


def canvas_finds(person: Person) -> bool:
    """Whether Canvas's import can find a student: by ID, or by a login that survives the file and Canvas's way with numbers."""
    login = cell(_canvas_login(person))
    return bool(person.identity) or bool(login and login == person.login and _as_canvas_reads(login) == person.login)


def _as_canvas_reads(field: str) -> str:
    """Canvas rewrites whatever looks like a number: the last comma or point is the decimal one, and all others go."""
    if not _NUMBER.match(field):
        return field
    *front, last = re.split("[.,]", field.rstrip(".,"))
    return f"{''.join(front)}.{last}" if front else last
