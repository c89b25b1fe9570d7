"""Who is who: a table from a platform's ids, logins or names to the students' folders, and names that can name a folder."""

from __future__ import annotations

import codecs
import csv
import io
import re
import unicodedata
from dataclasses import dataclass, field
from pathlib import Path

from autograder.grading.names import label

COLUMNS = {
    "student": "student",
    "student id": "student",
    "student_id": "student",
    "id": "id",
    "platform id": "id",
    "platform_id": "id",
    "user id": "id",
    "participant": "id",
    "login": "login",
    "username": "login",
    "github_username": "login",
    "email": "email",
    "email address": "email",
    "name": "name",
    "full name": "name",
    "submitted_at": "submitted_at",
}
KEYS = ("id", "login", "email", "name")
MAX_BYTES = 16 << 20
SEPARATOR = re.compile(r"[\"']?sep=([,;\t|])[\"',;\s]*$", re.I)  # the line that tells Excel what stands between columns


class RosterError(ValueError):
    """The table can't be used; the message names file, line and cure."""


def _key(value: str) -> str:
    return " ".join(unicodedata.normalize("NFC", value).split()).casefold()


@dataclass
class Roster:
    """(kind, value) → student, and the times at which students handed in, where the platform's download does not tell them."""

    students: dict[tuple[str, str], str] = field(default_factory=dict)
    times: dict[str, str] = field(default_factory=dict)

    def student(self, **known: str | None) -> str | None:
        """The student with the first of these: id, login, email, name. An id may also stand where a login is asked for, and so on."""
        for kind in KEYS:
            value = known.get(kind)
            if value and (found := self.students.get((kind, _key(value)))):
                return found
        return None


def load(path: Path) -> Roster:
    """Read `names.csv`: a column `student`, one or more of `id`, `login`, `email`, `name`, perhaps `submitted_at`.

    Canvas's gradebook, Moodle's grading worksheet and a GitHub Classroom roster are understood as they are exported.
    Raises: RosterError.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RosterError(f"{path}: {error.strerror}; --names wants a CSV file") from None
    text = _text(content[:MAX_BYTES])
    if text is None:
        raise RosterError(
            f"{path}: is not UTF-8 text; in Excel, save it as 'CSV UTF-8', in LibreOffice as CSV with the character set Unicode (UTF-8)"
        )
    first, _, rest = text.partition("\n")
    told = SEPARATOR.match(first)
    delimiter = told[1] if told else max(",;\t", key=first.count)
    try:
        rows = list(csv.reader(io.StringIO(rest if told else text), delimiter=delimiter))
    except csv.Error as error:
        raise RosterError(f"{path}: is no CSV that can be read ({error}); save it anew") from None
    header = 2 if told else 1
    if not rows:
        raise RosterError(f"{path}: is empty; its first line names the columns: student and one of {', '.join(KEYS)}")
    kinds = _kinds(rows[0])
    if "student" not in kinds or not set(kinds) & set(KEYS):
        raise RosterError(
            f"{path}, line {header}: the columns are {', '.join(rows[0]) or 'none'}; wanted are student and one of {', '.join(KEYS)}"
        )
    return _filled(path, kinds, rows, header + 1)


def _text(content: bytes) -> str | None:
    """Of a table as UTF-8, or as Excel's "Unicode text", which is UTF-16 with a mark; None if it is neither."""
    try:
        text = content.decode("utf-16" if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig")
    except UnicodeDecodeError:
        return None
    return None if "\0" in text else text.replace("\r\n", "\n").replace("\r", "\n")


def _kinds(header: list[str]) -> list[str | None]:
    """What each column means."""
    names = [_key(name) for name in header]
    if {"id", "sis login id"} <= set(names):  # Canvas's gradebook, whose column "Student" is a name
        canvas = {"student": "name", "id": "id", "sis login id": "student"}
        return [canvas.get(name) for name in names]
    if "github_username" in names and "identifier" in names:
        classroom = {"identifier": "student", "github_username": "login"}
        return [classroom.get(name) for name in names]
    if "identifier" in names and "full name" in names:  # Moodle's grading worksheet
        moodle = {"identifier": "id", "full name": "name"}
        who = next((name for name in ("username", "id number", "email address") if name in names), "full name")
        return ["student" if name == who else moodle.get(name) for name in names]
    return [COLUMNS.get(name) for name in names]


def _filled(path: Path, kinds: list[str | None], rows: list[list[str]], first: int) -> Roster:
    roster = Roster()
    lines: dict[tuple[str, str], int] = {}
    repeated = set()
    for number, row in enumerate(rows[1:], start=first):
        values = {kind: value.strip() for kind, value in zip(kinds, row, strict=False) if kind and value.strip()}
        if not values or row[0].strip() == "Points Possible":
            continue
        if "student" not in values:
            if any(kind in values for kind in ("login", "email")) or ("id" in values and "name" not in values):
                raise RosterError(f"{path}, line {number}: no student in it; fill in the column, or delete the line")
            continue  # a test student of Canvas has no login
        student = label(values["student"].strip())
        if "submitted_at" in values:
            roster.times[student] = values["submitted_at"]
        for kind in KEYS:
            if kind not in values:
                continue
            value = re.sub(r"^[^\d\W][^\d]*\s(?=\d+$)", "", values[kind]) if kind == "id" else values[kind]
            key = (kind, _key(value))
            if roster.students.setdefault(key, student) != student:
                if kind == "name":  # two people of one name: that tells nothing about either
                    repeated.add(key)
                    continue
                raise RosterError(
                    f"{path}, line {number}: the {kind} {value} is {student}'s here and {roster.students[key]}'s in line {lines[key]}; "
                    "delete one of the two"
                )
            lines.setdefault(key, number)
    for key in repeated:
        del roster.students[key]
    return roster
