"""The CSV files that a learning platform hands out to be filled in: read strictly, written back as they came."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

from autograder.platforms.give_back import GiveBackError

MAX_BYTES = 50 << 20
_BOM = b"\xef\xbb\xbf"


@dataclass
class Sheet:
    """A table and the form of its file. `rows[0]` is the header; row N of the file's table is `rows[N - 1]`."""

    path: Path
    rows: list[list[str]]
    delimiter: str
    newline: str
    marked: bool  # whether the file begins with a byte-order mark
    quoted: bool  # whether every cell stands in quotes

    def column(self, *names: str) -> int | None:
        """The place of the only column with one of these names. Raises GiveBackError if there are several."""
        places = [place for place, name in enumerate(self.rows[0]) if name.strip() in names]
        if len(places) > 1:
            raise GiveBackError(f"{self.path}: row 1: {len(places)} columns are called {names[0]!r}; keep one of them")
        return places[0] if places else None

    def needed(self, *names: str) -> int:
        """As `column`. Raises GiveBackError if there is none."""
        place = self.column(*names)
        if place is None:
            raise GiveBackError(
                f"{self.path}: row 1: no column {names[0]!r} (it has {', '.join(map(repr, self.rows[0]))}). "
                "Give the file as the platform hands it out, with the platform's language set to English."
            )
        return place

    def to_bytes(self) -> bytes:
        """The file."""
        stream = io.StringIO()
        if self.quoted:
            writer = csv.writer(stream, delimiter=self.delimiter, lineterminator=self.newline, quoting=csv.QUOTE_ALL)
        else:
            writer = csv.writer(stream, delimiter=self.delimiter, lineterminator=self.newline)
        writer.writerows(self.rows)
        return (_BOM if self.marked else b"") + stream.getvalue().encode()

    def target(self, folder: Path) -> Path:
        """Where the filled file goes. Raises GiveBackError if that is the file itself: what a platform handed out is kept."""
        path = folder / self.path.name
        if path.exists() and path.samefile(self.path):
            raise GiveBackError(f"{self.path}: would be overwritten; name another folder with --into")
        return path


def read(path: Path) -> Sheet:
    """Read a CSV file of a platform. Raises: GiveBackError that says what is wrong where, and what to do."""
    again = "download it again, and give it as it is"
    try:
        if path.stat().st_size > MAX_BYTES:
            raise GiveBackError(f"{path}: larger than {MAX_BYTES >> 20} MB; {again}")
        data = path.read_bytes()
    except OSError as error:
        raise GiveBackError(f"{path}: cannot be read ({error.strerror}); give the CSV file that the platform hands out") from None
    if data.startswith(b"PK\x03\x04"):
        raise GiveBackError(f"{path}: this is a workbook or zip, not CSV; {again}")
    try:
        text = data.removeprefix(_BOM).decode()
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise GiveBackError(f"{path}: row {line}: not UTF-8, a spreadsheet has rewritten it; {again}") from None
    if "\0" in text or not text.strip():
        raise GiveBackError(f"{path}: {'no text file' if text.strip() else 'empty'}; {again}")
    head = text.partition("\n")[0]
    delimiter = max(",;\t", key=head.count)
    try:
        rows = list(csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True))
    except csv.Error as error:
        raise GiveBackError(f"{path}: not CSV ({error}); {again}") from None
    rows = [row for row in rows if row]
    for number, row in enumerate(rows, 1):
        if len(row) != len(rows[0]):
            raise GiveBackError(f"{path}: row {number}: {len(row)} cells under {len(rows[0])} columns; {again}")
    newline = "\r\n" if head.endswith("\r") else "\n"
    stripped = head.rstrip("\r")
    quoted = stripped.startswith('"') and stripped.count('"') >= 2 * len(rows[0])
    return Sheet(path, rows, delimiter, newline, data.startswith(_BOM), quoted)
