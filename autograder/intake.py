"""Read a submission from a folder that its author controlled: never follow a link, never trust a size, never raise for its content.

`SUBMITTED/{student}/{assignment}/{assignment}.ipynb`, nbgrader's layout; other files lie beside the notebook.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import nbformat

MAX_NOTEBOOK = 20 << 20
MAX_SIDE_FILES = 100
MAX_NAME = 200
MAX_SIDE_BYTES = 256 << 20


@dataclass
class Submission:
    """What was handed in. `problem` is empty, or says why there is no notebook to grade. `files` are the regular files beside it."""

    student: str
    assignment: str
    folder: Path
    notebook: nbformat.NotebookNode | None = None
    files: dict[str, Path] = field(default_factory=dict)
    flags: list[str] = field(default_factory=list)
    problem: str = ""


class BadNotebook(ValueError):
    """The notebook cannot be read; the message says why, to the learner."""


def discover(submitted: Path) -> list[tuple[str, str, Path]]:
    """Every (student, assignment, folder) under `submitted`, sorted; names that begin with a dot are no submissions."""
    return [
        (printable(student.name), printable(assignment.name), assignment)
        for student in sorted(_folders(submitted))
        for assignment in sorted(_folders(student))
    ]


def printable(name: str) -> str:
    """A folder's name as our own files can bear it: unprintable characters as %XX, and an overlong name cut and told apart by a hash."""
    safe = "".join(c if c.isprintable() else "".join(f"%{byte:02X}" for byte in os.fsencode(c)) for c in name)
    if len(safe.encode()) > MAX_NAME:
        safe = f"{safe.encode()[:MAX_NAME - 17].decode(errors='ignore')}~{hashlib.sha256(os.fsencode(name)).hexdigest()[:16]}"
    return safe


def _folders(parent: Path) -> list[Path]:
    """Folders and links to folders; `read` refuses the links, so that each gets a verdict."""
    with os.scandir(parent) as entries:
        return [Path(entry.path) for entry in entries if not entry.name.startswith(".") and entry.is_dir()]


def read(student: str, assignment: str, folder: Path) -> Submission:
    """Read one submission. Whatever is wrong with it ends in `problem` or `flags`."""
    submission = Submission(student, assignment, folder)
    if folder.is_symlink() or folder.parent.is_symlink():
        submission.problem = "The submission's folder is a link; hand in the files themselves."
        return submission
    try:
        submission.notebook = parse(_read_regular(folder / f"{folder.name}.ipynb", MAX_NOTEBOOK))
    except FileNotFoundError:
        found = sorted(entry.name for entry in folder.glob("*.ipynb"))[:3]
        others = f" (found: {', '.join(found)})" if found else ""
        submission.problem = f"There is no notebook {assignment}.ipynb in the submission{others}."
    except BadNotebook as problem:
        submission.problem = str(problem)
    except OSError as error:
        submission.problem = f"{assignment}.ipynb can't be read: {error.strerror}."
    _collect(folder, submission)
    return submission


def parse(content: bytes) -> nbformat.NotebookNode:
    """The notebook in these bytes, as nbformat 4. Raises BadNotebook for anything else, whatever it is."""
    try:
        document = json.loads(content.decode("utf-8-sig"))
        if not isinstance(document, dict):
            raise BadNotebook("The file is JSON but no notebook.")
        if document.get("nbformat", 4) < 4:
            document = nbformat.convert(nbformat.from_dict(document), 4)
        return nbformat.from_dict({"nbformat": 4, "nbformat_minor": 5, "metadata": {}, "cells": [_cell(c) for c in document["cells"]]})
    except BadNotebook:
        raise
    except UnicodeDecodeError:
        raise BadNotebook("The notebook is not UTF-8 text.") from None
    except json.JSONDecodeError as error:
        raise BadNotebook(f"The notebook is not valid JSON (line {error.lineno}): it may be truncated. Save it again.") from None
    except Exception as error:  # a hostile document may break any converter in any way
        raise BadNotebook(f"The notebook is malformed ({type(error).__name__}). Open and save it in Jupyter.") from None


def _cell(cell: Any) -> dict[str, Any]:
    """A cell's type, source and metadata; outputs are never looked at."""
    source = cell["source"]
    source = source if isinstance(source, str) else "".join(source)
    kind = cell["cell_type"] if cell["cell_type"] in ("code", "markdown", "raw") else "raw"
    metadata = cell.get("metadata")
    plain: dict[str, Any] = {"cell_type": kind, "source": source, "metadata": metadata if isinstance(metadata, dict) else {}}
    if not isinstance(plain["metadata"].get("nbgrader", {}), dict):
        del plain["metadata"]["nbgrader"]
    return plain | ({"outputs": [], "execution_count": None} if kind == "code" else {})


def grade_ids(notebook: nbformat.NotebookNode) -> Counter[str]:
    """How often each nbgrader id occurs."""
    ids = (cell.metadata.get("nbgrader", {}).get("grade_id") for cell in notebook.cells)
    return Counter(name for name in ids if isinstance(name, str))


def _read_regular(path: Path, limit: int) -> bytes:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        if path.is_symlink():
            raise BadNotebook(f"{path.name} is a link; hand in the file itself.") from None
        raise error
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise BadNotebook(f"{path.name} is not a regular file.")
        if status.st_size > limit:
            raise BadNotebook(f"{path.name} is larger than {limit >> 20} MB: clear its outputs and save it again.")
        return file.read(limit + 1)


def _collect(folder: Path, submission: Submission) -> None:
    total = 0
    for parent, folders, names in os.walk(folder, followlinks=False):
        linked = [name for name in folders if os.path.islink(os.path.join(parent, name))]
        for name in sorted([*names, *linked]):
            path = Path(parent, name)
            relative = str(path.relative_to(folder))
            if relative == f"{folder.name}.ipynb":
                continue
            status = path.lstat()
            total += status.st_size
            if not stat.S_ISREG(status.st_mode):
                submission.flags.append(f"ignored_file: {relative[:200]} (a link or special file)")
            elif len(submission.files) >= MAX_SIDE_FILES or total > MAX_SIDE_BYTES:
                submission.flags.append(f"ignored_files: more than {MAX_SIDE_FILES} files or {MAX_SIDE_BYTES >> 20} MB beside the notebook")
                return
            else:
                submission.files[relative] = path
