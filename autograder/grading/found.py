"""Which file of a submission is its notebook: the one with the right name, or the only one whose name can mean it.

Only names decide, never contents; but files with the same bytes are one. A notebook of another name is not taken for it. An archive is
looked into if nothing else is there.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from autograder.grading import archives, names, reading
from autograder.grading.files import MAX_SIDE_BYTES, MAX_SIDE_FILES, BadFile, entries, read_regular
from autograder.grading.names import EXACT, NAMED

MAX_CANDIDATES = 8
MAX_DEPTH = 4


@dataclass
class Notebook:
    """A submission's notebook: its bytes, the folder in which the files beside it lie, and under which name it was found."""

    content: bytes
    folder: Path
    found_as: str = ""
    also_there: tuple[str, ...] = ()
    unpacked: tempfile.TemporaryDirectory | None = field(default=None, repr=False)
    """Keeps what was taken out of an archive for as long as the submission lives."""
    ignored: tuple[str, ...] = ()


class NotFound(ValueError):
    """There is no notebook, or more than one could be meant; the message says so to the learner."""


@dataclass(frozen=True)
class _Candidate:
    name: str
    rank: int
    read: Callable[[], bytes]
    take: Callable[[bytes], Notebook]


def notebook(folder: Path, assignment: str) -> Notebook:
    """The notebook of `assignment` in a submission's folder.

    Raises: NotFound; BadFile, OSError if the file of the right name cannot be read.
    """
    exact = folder / f"{assignment}.ipynb"
    if os.path.lexists(exact):
        content = read_regular(exact, reading.MAX_RAW)
        return Notebook(content, folder, also_there=_others(folder, assignment, content))
    seen = list(_files(folder))
    candidates = [_in_folder(folder, relative, rank) for relative in seen if (rank := _rank(relative, assignment)) is not None]
    troubles: list[str] = []
    if not any(one.rank <= NAMED for one in candidates):
        candidates += _in_archives(folder, seen, assignment, troubles)
    return _the_one(candidates, assignment, troubles)


def _the_one(candidates: list[_Candidate], assignment: str, troubles: list[str]) -> Notebook:
    wanted = f"There is no notebook {assignment}.ipynb in the submission"
    likely = [one for one in candidates if one.rank <= NAMED]
    exact = [one for one in likely if one.rank == EXACT]
    if len(exact) == 1:
        likely = exact
    if not likely:
        found = ", ".join(one.name for one in candidates[:3])
        raise NotFound(f"{wanted}{f' (found: {found})' if found else _because(troubles)}.")
    shown = ", ".join(one.name for one in likely[:MAX_CANDIDATES]) + (", …" if len(likely) > MAX_CANDIDATES else "")
    contents: dict[str, tuple[_Candidate, bytes]] = {}
    for one in likely[:MAX_CANDIDATES]:
        try:
            content = one.read()
        except (BadFile, OSError, archives.BadArchive) as problem:
            if len(likely) == 1:
                raise NotFound(f"{wanted}; {one.name} {_said(problem)}.") from None
            continue
        contents.setdefault(hashlib.sha256(content).hexdigest(), (one, content))
    if len(likely) > MAX_CANDIDATES or len(contents) != 1:
        raise NotFound(
            f"{wanted}, but several that could be meant: {shown}. Hand in the one that counts, under the name {assignment}.ipynb."
        )
    [(one, content)] = contents.values()
    return one.take(content)


def _said(problem: Exception) -> str:
    return f"can't be read: {problem.strerror}" if isinstance(problem, OSError) else str(problem)


def _because(troubles: list[str]) -> str:
    return f" ({'; '.join(troubles[:3])})" if troubles else ""


def _others(folder: Path, assignment: str, content: bytes) -> tuple[str, ...]:
    """Other files at its side that could be meant as well, for the teacher to know."""
    found: list = []
    with os.scandir(folder) as scan:
        for number, entry in enumerate(scan):
            if number > 1000 or len(found) > MAX_CANDIDATES:
                break
            name, rank = entry.name, names.notebook_rank(entry.name, assignment)
            fresh = name.startswith(f"{assignment}.new") or name.endswith(".json")  # a later release, put beside the work
            if rank == NAMED and not fresh and entry.is_file(follow_symlinks=False):
                found.append(name)
    return tuple(sorted(name for name in found if not _same(folder / name, content)))


def _same(path: Path, content: bytes) -> bool:
    try:
        return path.stat().st_size == len(content) and read_regular(path, len(content)) == content
    except (OSError, BadFile):
        return False


def _files(folder: Path) -> Iterator[str]:
    for relative, entry in entries(folder):
        if relative.count(os.sep) <= MAX_DEPTH and entry.is_file(follow_symlinks=False):
            yield relative


def _rank(relative: str, assignment: str) -> int | None:
    return names.notebook_rank(os.path.basename(relative), assignment)


def _in_folder(folder: Path, relative: str, rank: int) -> _Candidate:
    path = folder / relative
    return _Candidate(
        relative,
        rank,
        lambda: read_regular(path, reading.MAX_RAW),
        lambda content: Notebook(content, path.parent, relative),
    )


# ---------------------------------------------------------------------------------------------------------------- archives


def _in_archives(folder: Path, seen: list[str], assignment: str, troubles: list[str]) -> list[_Candidate]:
    found: list[_Candidate] = []
    for relative in [name for name in seen if name.casefold().endswith(".zip")][:3]:
        try:
            archive = archives.Archive(read_regular(folder / relative, archives.MAX_ARCHIVE))
        except (BadFile, OSError, archives.BadArchive) as problem:
            troubles.append(f"{relative} {_said(problem)}")
            continue
        for entry in archive.entries.values():
            rank = _rank(entry.name, assignment)
            if rank is not None and entry.name.count("/") <= MAX_DEPTH:
                found.append(_in_archive(relative, archive, entry, rank))
        if not any(one.rank <= NAMED for one in found):
            troubles.append(f"{relative} holds none either")
    return found


def _in_archive(relative: str, archive: archives.Archive, entry: archives.Entry, rank: int) -> _Candidate:
    return _Candidate(
        f"{relative}/{entry.name}",
        rank,
        lambda: archive.read(entry, reading.MAX_RAW),
        lambda content: _unpacked(relative, archive, entry, content),
    )


def _unpacked(relative: str, archive: archives.Archive, entry: archives.Entry, content: bytes) -> Notebook:
    """The notebook, and the files beside it in the archive, in a folder of their own, within the limits of any side files."""
    place = tempfile.TemporaryDirectory(prefix="submission-", ignore_cleanup_errors=True)
    folder, left, ignored = Path(place.name), MAX_SIDE_BYTES, list(archive.ignored)
    beside = entry.name.rpartition("/")[0]
    others = [
        one for one in archive.entries.values() if one != entry and f"{one.name}/".startswith(f"{beside}/" if beside else "")
    ]
    for one in sorted(others, key=lambda one: (one.name.count("/"), not one.name.endswith(".py"), one.name))[:MAX_SIDE_FILES]:
        try:
            left -= archive.unpack(one, folder, one.name.removeprefix(f"{beside}/" if beside else ""), left)
        except (archives.BadArchive, OSError):
            ignored.append(one.name)
    return Notebook(content, folder, f"{relative}/{entry.name}", unpacked=place, ignored=tuple(ignored))
