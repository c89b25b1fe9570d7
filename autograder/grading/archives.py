"""A zip that a learner handed in: looked at within limits, nothing of it written where its names say, nothing trusted."""

from __future__ import annotations

import io
import os
import stat
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from autograder.grading.names import is_junk

MAX_ARCHIVE = 200 << 20
MAX_ENTRIES = 20_000
MAX_DIRECTORY = 8 << 20  # bytes of the list of entries
_END = struct.Struct("<4s4H2LH")
_END64 = struct.Struct("<4sQ2H2L4Q")
_LOCATOR = 20  # bytes
_CHUNK = 1 << 20


class BadArchive(ValueError):
    """The archive is not read; the message goes on from its name, to the learner."""


@dataclass(frozen=True)
class Entry:
    """A regular file in the archive: its name, plain parts joined by slashes, and its place in the list."""

    name: str
    size: int
    info: zipfile.ZipInfo


class Archive:
    """The regular files of a zip archive that have plain names, each name once."""

    def __init__(self, content: bytes) -> None:
        _check_directory(content)
        try:
            self._zip = zipfile.ZipFile(io.BytesIO(content))
        except (zipfile.BadZipFile, ValueError, NotImplementedError, struct.error, UnicodeDecodeError, EOFError) as error:
            raise BadArchive(f"is a damaged zip archive ({type(error).__name__})") from None
        self.entries: dict[str, Entry] = {}
        self.ignored: list[str] = []
        twice = set()
        for info in self._zip.infolist():
            name = _plain(info)
            if name is None:
                self.ignored.append(info.filename)
            elif name and name in self.entries:
                twice.add(name)  # which of them counts is anybody's guess
            elif name:
                self.entries[name] = Entry(name, info.file_size, info)
        for name in twice:
            del self.entries[name]
            self.ignored.append(name)

    def read(self, entry: Entry, limit: int) -> bytes:
        """The content of a file of at most `limit` bytes, whatever the archive says of its size. Raises BadArchive."""
        if entry.info.flag_bits & 1:
            raise BadArchive("is encrypted: hand in the notebook itself")
        if entry.size > limit:
            raise BadArchive(f"holds a file of more than {limit >> 20} MB")
        parts, left = [], limit + 1
        try:
            with self._zip.open(entry.info) as file:
                while left > 0 and (part := file.read(min(left, _CHUNK))):
                    parts.append(part)
                    left -= len(part)
        except (zipfile.BadZipFile, zlib.error, ValueError, NotImplementedError, OSError, EOFError, RuntimeError) as error:
            raise BadArchive(f"is a damaged zip archive ({type(error).__name__})") from None
        if left <= 0:
            raise BadArchive(f"holds a file of more than {limit >> 20} MB")
        return b"".join(parts)

    def unpack(self, entry: Entry, folder: Path, name: str, limit: int) -> int:
        """Write a file as `folder/name`, and return its size; `name` is the entry's, or the end of it. Raises BadArchive."""
        target = folder.joinpath(*PurePosixPath(name).parts)
        target.parent.mkdir(parents=True, exist_ok=True)
        content = self.read(entry, limit)
        with open(target, "xb") as file:
            file.write(content)
        return len(content)


def _plain(info: zipfile.ZipInfo) -> str | None:
    """The entry's name if it is a regular file with a plain one, "" for folders and junk, None for what is not touched."""
    name = info.filename.replace("\\", "/")
    if info.is_dir() or name.endswith("/"):
        return ""
    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind not in (0, stat.S_IFREG) or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        return None
    parts = name.split("/")
    if any(part in ("", ".", "..") or "\0" in part or len(os.fsencode(part)) > 255 for part in parts) or ":" in parts[0]:
        return None
    if len(os.fsencode(name)) > 1000:
        return None
    return "" if any(is_junk(part) for part in parts) else name


def _check_directory(content: bytes) -> None:
    """Raise BadArchive for a list of entries of unreasonable size, before anything makes objects of it."""
    listed = listing(io.BytesIO(content))
    if listed.is_huge:
        raise BadArchive("is a zip archive of the kind for huge files: hand in the notebook itself")
    if listed.entries > MAX_ENTRIES or listed.size > MAX_DIRECTORY:
        raise BadArchive(f"is a zip archive of more than {MAX_ENTRIES} entries")


@dataclass(frozen=True)
class Listing:
    """How many entries a zip's list has, how many bytes that takes, and whether it is of the kind for huge files (zip64)."""

    entries: int
    size: int
    is_huge: bool


def listing(stream: IO[bytes]) -> Listing:
    """What the end of a zip says about its list, which `zipfile` reads whole before anybody can look. Raises BadArchive.

    The end is looked for where zipfile looks. Of a zip64 record, which different versions of it find by place or by reference, the
    larger numbers count.
    """
    length = stream.seek(0, os.SEEK_END)
    begin = max(0, length - _END.size - (1 << 16) - _LOCATOR - _END64.size)
    stream.seek(begin)
    tail = stream.read()
    at = len(tail) - _END.size
    if at >= 0 and not (tail[at : at + 4] == b"PK\5\6" and tail[-2:] == b"\0\0"):
        at = tail.rfind(b"PK\5\6")
    if at < 0 or at + _END.size > len(tail):
        raise BadArchive("is a damaged zip archive")
    *_, entries, size, _offset, _comment = _END.unpack_from(tail, at)
    locator = at - _LOCATOR
    if locator < 0 or tail[locator : locator + 4] != b"PK\6\7":
        return Listing(entries, size, False)
    (reference,) = struct.unpack_from("<Q", tail, locator + 8)
    for place in (begin + locator - _END64.size, reference):
        if 0 <= place <= length - _END64.size:
            stream.seek(place)
            mark, *_, here, bytes_here, _offset = _END64.unpack(stream.read(_END64.size))
            if mark == b"PK\6\6":
                entries, size = max(entries, here), max(size, bytes_here)
    return Listing(entries, size, True)
