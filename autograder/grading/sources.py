"""Which folders of submissions were graded into a folder of grades: `course return` finds there who is who on the platform."""

from __future__ import annotations

import os
from pathlib import Path

from autograder.grading.verdicts import write_atomically

FILE = ".submitted"


def remember(grades: Path, submitted: Path) -> None:
    """Note that `submitted` is graded into `grades`, as the last of those noted there."""
    now = submitted.resolve()
    paths = [path for path in read(grades) if path != now]
    write_atomically(grades / FILE, b"".join(os.fsencode(path) + b"\0" for path in (*paths, now)))


def read(grades: Path) -> list[Path]:
    """The folders that were graded into `grades`, the last one last."""
    try:
        return [Path(os.fsdecode(path)) for path in (grades / FILE).read_bytes().split(b"\0") if path]
    except OSError:
        return []
