"""Files in a folder that somebody else controlled: no link is followed, no size trusted, no depth without an end."""

from __future__ import annotations

import itertools
import os
import stat
from collections import deque
from collections.abc import Iterator
from pathlib import Path

from autograder.grading.names import is_junk_file, is_junk_folder

MAX_SIDE_FILES = 100
MAX_SIDE_BYTES = 256 << 20
MAX_PATH = 1000  # bytes of a file's name with its folders
MAX_ENTRIES = 20_000  # looked at in one submission's folder, whatever they are


class BadFile(ValueError):
    """A file cannot be read; the message goes on from its name, to the learner."""


def read_regular(path: Path, limit: int) -> bytes:
    """The content of a regular file of at most `limit` bytes, nothing else being opened. Raises BadFile; OSError, if it can't be read."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        if path.is_symlink():
            raise BadFile("is a link; hand in the file itself") from None
        raise error
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode):
        os.close(descriptor)
        raise BadFile("is not a regular file")
    with os.fdopen(descriptor, "rb") as file:
        if status.st_size > limit:
            raise BadFile(f"is larger than {f'{limit >> 20} MB' if limit >= 1 << 20 else f'{limit >> 10} kB'}")
        return file.read(limit + 1)


def entries(folder: Path) -> Iterator[tuple[str, os.DirEntry[str]]]:
    """(relative path, entry) of what lies in a folder, the nearest first, modules before other files, MAX_ENTRIES at most.

    Links are never followed, nor folders that are too deep; environments, caches and what is hidden are not entered.
    """
    waiting, seen = deque([""]), 0  # a queue of our own: os.walk's recursion has an end, a hostile tree need not have one
    while waiting and seen < MAX_ENTRIES:
        parent = waiting.popleft()
        try:
            with os.scandir(folder / parent) as scan:
                here = sorted(itertools.islice(scan, MAX_ENTRIES - seen + 1), key=_modules_first)
        except OSError:
            continue
        for entry in here:
            relative = os.path.join(parent, entry.name)
            if is_junk_file(entry.name) or (entry.is_dir(follow_symlinks=False) and is_junk_folder(entry.path)):
                continue
            seen += 1
            if can_be_entered(relative, entry):
                waiting.append(relative)
            yield relative, entry
            if seen >= MAX_ENTRIES:
                break


def _modules_first(entry: os.DirEntry[str]) -> tuple[bool, str]:
    return not entry.name.endswith(".py"), entry.name


def can_be_entered(relative: str, entry: os.DirEntry[str]) -> bool:
    """Whether this is a folder, no link, with a name that is not too long."""
    return entry.is_dir(follow_symlinks=False) and len(os.fsencode(relative)) <= MAX_PATH


def readable_size(entry: os.DirEntry[str]) -> int | None:
    """Bytes of a regular file that can be opened; None for everything else."""
    try:
        status = entry.stat(follow_symlinks=False)
        return status.st_size if stat.S_ISREG(status.st_mode) and os.access(entry.path, os.R_OK) else None
    except OSError:
        return None
