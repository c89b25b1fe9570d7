"""Read a submission from a folder that its author controlled: never follow a link, never trust a size, never raise for its content.

`SUBMITTED/{student}/{assignment}/{assignment}.ipynb`, nbgrader's layout; other files lie beside the notebook.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import nbformat

from autograder.grading.verdicts import clean_text, plain_name

MAX_NOTEBOOK = 20 << 20
MAX_SIDE_FILES = 100
MAX_SIDE_BYTES = 256 << 20
MAX_PATH = 1000  # bytes of a side file's name with its folders
MAX_ENTRIES = 20_000  # looked at in one submission's folder, whatever they are
MAX_CELLS = 2000


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


class BadFile(ValueError):
    """A file cannot be read; the message goes on from its name, to the learner."""


def discover(submitted: Path) -> list[tuple[str, str, Path]]:
    """Every (student, assignment, folder) under `submitted`, sorted; names that begin with a dot are no submissions."""
    return [
        (_label(student.name), _label(assignment.name), assignment)
        for student in sorted(_folders(submitted))
        for assignment in sorted(_folders(student))
    ]


def _label(name: str) -> str:
    """The name, or, if it cannot name a file of ours, what can be read of it and a hash that tells it from others."""
    try:
        return plain_name(name)
    except ValueError:
        readable = "".join(character if character.isprintable() else "_" for character in clean_text(name, 100))
        return f"{readable}-{hashlib.sha256(os.fsencode(name)).hexdigest()[:8]}"


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
        submission.notebook = parse(read_regular(folder / f"{folder.name}.ipynb", MAX_NOTEBOOK))
    except FileNotFoundError:
        found = sorted(entry.name for entry in folder.glob("*.ipynb"))[:3]
        others = f" (found: {', '.join(found)})" if found else ""
        submission.problem = f"There is no notebook {assignment}.ipynb in the submission{others}."
    except BadNotebook as problem:
        submission.problem = str(problem)
    except BadFile as problem:
        submission.problem = f"{assignment}.ipynb {problem}."
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
        if len(document["cells"]) > MAX_CELLS:
            raise BadNotebook(f"The notebook has {len(document['cells'])} cells; at most {MAX_CELLS} are graded.")
        return nbformat.from_dict(
            {"nbformat": 4, "nbformat_minor": 5, "metadata": _language(document), "cells": [_cell(c) for c in document["cells"]]}
        )
    except BadNotebook:
        raise
    except UnicodeDecodeError:
        raise BadNotebook("The notebook is not UTF-8 text.") from None
    except json.JSONDecodeError as error:
        raise BadNotebook(f"The notebook is not valid JSON (line {error.lineno}): it may be truncated. Save it again.") from None
    except Exception as error:  # a hostile document may break any converter in any way
        raise BadNotebook(f"The notebook is malformed ({type(error).__name__}). Open and save it in Jupyter.") from None


def _language(document: Any) -> dict[str, Any]:
    """Of the notebook's metadata, the version of Python that saved it, if it looks like one; it is only named, in a message."""
    with suppress(AttributeError, KeyError, TypeError):
        version = document["metadata"]["language_info"]["version"]
        if re.fullmatch(r"\d\.\d{1,3}(\.\d{1,3})?[a-z\d+]{0,6}", version):
            return {"language_info": {"name": "python", "version": version}}
    return {}


def _cell(cell: Any) -> dict[str, Any]:
    """A cell's type, source and metadata; outputs are never looked at."""
    source = cell["source"]
    source = source if isinstance(source, str) else "".join(source)
    kind = cell["cell_type"] if cell["cell_type"] in ("code", "markdown", "raw") else "raw"
    metadata = cell.get("metadata")
    plain: dict[str, Any] = {"cell_type": kind, "source": source, "metadata": metadata if isinstance(metadata, dict) else {}}
    if not isinstance(plain["metadata"].get("nbgrader", {}), dict):
        del plain["metadata"]["nbgrader"]
    if isinstance(cell.get("id"), str):
        plain["id"] = cell["id"]
    return plain | ({"outputs": [], "execution_count": None} if kind == "code" else {})


def grade_ids(notebook: nbformat.NotebookNode) -> Counter[str]:
    """How often each nbgrader id occurs."""
    ids = (cell.metadata.get("nbgrader", {}).get("grade_id") for cell in notebook.cells)
    return Counter(name for name in ids if isinstance(name, str))


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
            allowed = f"{limit >> 20} MB: clear its outputs and save it again" if limit == MAX_NOTEBOOK else f"{limit >> 10} kB"
            raise BadFile(f"is larger than {allowed}")
        return file.read(limit + 1)


def _collect(folder: Path, submission: Submission) -> None:
    """The regular files beside the notebook, up to the limits; a flag for everything else."""
    total = 0
    for number, (relative, entry) in enumerate(_entries(folder)):
        if number >= MAX_ENTRIES:
            submission.flags.append(f"ignored_files: more than {MAX_ENTRIES} entries in the folder")
            return
        if relative == f"{submission.assignment}.ipynb" or _can_be_entered(relative, entry):
            continue
        size = _readable_size(entry)
        if size is None or len(os.fsencode(relative)) > MAX_PATH:
            submission.flags.append(f"ignored_file: {relative[:200]} (a link, a special file, unreadable, or too deep)")
            continue
        total += size
        if len(submission.files) >= MAX_SIDE_FILES or total > MAX_SIDE_BYTES:
            submission.flags.append(
                f"ignored_files: more than {MAX_SIDE_FILES} files or {MAX_SIDE_BYTES >> 20} MB beside the notebook"
            )
            return
        submission.files[relative] = Path(entry.path)


def _entries(folder: Path) -> Iterator[tuple[str, os.DirEntry[str]]]:
    """(relative path, entry) of all that is in a folder; links are never followed, nor folders that are too deep."""
    waiting = [""]  # a stack of our own: os.walk's recursion has an end, a hostile tree need not have one
    while waiting:
        parent = waiting.pop()
        try:
            with os.scandir(folder / parent) as scan:
                entries = sorted(scan, key=lambda entry: entry.name)
        except OSError:
            continue
        for entry in entries:
            relative = os.path.join(parent, entry.name)
            if _can_be_entered(relative, entry):
                waiting.append(relative)
            yield relative, entry


def _can_be_entered(relative: str, entry: os.DirEntry[str]) -> bool:
    return entry.is_dir(follow_symlinks=False) and len(os.fsencode(relative)) <= MAX_PATH


def _readable_size(entry: os.DirEntry[str]) -> int | None:
    """Bytes of a regular file that can be opened; None for everything else."""
    try:
        status = entry.stat(follow_symlinks=False)
        return status.st_size if stat.S_ISREG(status.st_mode) and os.access(entry.path, os.R_OK) else None
    except OSError:
        return None
