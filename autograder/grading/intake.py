"""Read a submission from a folder that its author controlled: never follow a link, never trust a size, never raise for its content.

`SUBMITTED/{student}/{assignment}/{assignment}.ipynb`, nbgrader's layout; other files lie beside the notebook. What is not laid out so
is found where only one thing can be meant (`found_as`), and otherwise said to the teacher: nothing is skipped in silence.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import nbformat

from autograder.grading import files, found, names, reading
from autograder.grading.files import MAX_ENTRIES, MAX_PATH, MAX_SIDE_BYTES, MAX_SIDE_FILES, BadFile, read_regular
from autograder.grading.reading import MAX_CELLS, MAX_NOTEBOOK, MAX_RAW, BadNotebook

__all__ = [
    "MAX_CELLS", "MAX_ENTRIES", "MAX_NOTEBOOK", "MAX_PATH", "MAX_RAW", "MAX_SIDE_BYTES", "MAX_SIDE_FILES", "BadFile", "BadNotebook",
    "Submission", "Survey", "grade_ids", "parse", "read", "read_regular", "survey",
]  # fmt: skip

Task = tuple[str, str, Path]
SHOWN = 30  # things left over that are named one by one


@dataclass
class Submission:
    """What was handed in. `problem` is empty, or says why there is no notebook to grade. `files` are the regular files beside it."""

    student: str
    assignment: str
    folder: Path
    """Where the notebook was found, and the files beside it."""
    notebook: nbformat.NotebookNode | None = None
    files: dict[str, Path] = field(default_factory=dict)
    flags: list[str] = field(default_factory=list)
    problem: str = ""
    fingerprint: str = ""
    """sha256 of the cells and the files beside them: the same for the same submission."""
    unpacked: tempfile.TemporaryDirectory | None = field(default=None, repr=False)


# -------------------------------------------------------------------------------- a class


@dataclass(frozen=True)
class Survey:
    """What lies in a folder of submissions."""

    tasks: list[Task]
    """(student, assignment, folder), sorted."""
    left_over: list[str]
    """What was seen and not understood, and what it would take, a line each."""
    wrong_level: bool = False
    """Whether this is plainly not the folder of the students, and nothing in it is to be graded."""


def survey(submitted: Path, assignments: Iterable[str]) -> Survey:
    """Look at all of `submitted`: every folder in a student's folder is a submission, and everything else is named."""
    known = sorted(assignments)
    if (submitted / ".release.json").is_file():
        line = f"{submitted}: this is the bundle that `course release` wrote, not a folder of submissions"
        return Survey([], [line], wrong_level=True)
    found_here: dict[tuple[str, str], list[Path]] = {}
    left: list[str] = []
    misplaced = False
    for entry in _listed(submitted):
        path = Path(entry.path)
        if not entry.is_dir():
            left.append(_loose(entry.name, path, known, "", "STUDENT"))
        elif line := _no_student(path, submitted, known):
            left.append(line)
            misplaced = True
        else:
            misplaced |= _student(path, submitted, known, found_here, left)
    tasks = []
    for (student, assignment), folders in found_here.items():
        chosen, *others = sorted(folders, key=lambda one: (one.name != assignment, one.parent.name != student, str(one)))
        tasks.append((student, assignment, chosen))
        left += [
            f"{_shown(one, submitted)}: a second {assignment} of the same student ({student}), other than {_shown(chosen, submitted)}, "
            "which was graded; keep the one that counts"
            for one in others
            if not _alike(chosen, one, assignment)
        ]
    graded = any(assignment in known for _, assignment, _ in tasks)
    return Survey(sorted(tasks), left, wrong_level=misplaced and not graded)


def _student(path: Path, submitted: Path, known: list[str], found_here: dict, left: list[str]) -> bool:
    """Note one student's assignments, and what else is in the folder. Returns whether it looks like a folder of students."""
    student = names.label(path.name)
    inside = list(_listed(path))
    folders = [entry for entry in inside if entry.is_dir()]
    loose = [entry for entry in inside if not entry.is_dir()]
    if not inside:
        left.append(f"{path.name}: an empty folder; expected {path.name}/{known[0] if known else 'ASSIGNMENT'}/…")
    meant = {entry.name: entry.name if entry.name in known else names.folder_for(entry.name, known) for entry in folders}
    own = next((assignment for assignment in meant.values() if assignment), "ASSIGNMENT")
    left += [_loose(f"{path.name}/{entry.name}", Path(entry.path), known, path.name, path.name, own) for entry in loose]
    is_class = False
    for entry in folders:
        assignment, folder = meant[entry.name], Path(entry.path)
        others = [name for name, other in meant.items() if other == assignment and name != entry.name]
        if assignment and entry.name != assignment and others:
            left.append(
                f"{_shown(folder, submitted)}: may be meant as {assignment}, but so is {_shown(path / others[0], submitted)}; "
                f"keep the one that counts, as {path.name}/{assignment}"
            )
            assignment = ""
        found_here.setdefault((student, assignment or names.label(entry.name)), []).append(folder)
        if not assignment and not folder.is_symlink() and (inner := _assignment_inside(folder, known)):
            is_class = True
            left.append(
                f"{_shown(folder, submitted)}: no assignment, but it holds {inner}; expected {path.name}/{inner}/{inner}.ipynb. "
                f"If {path.name} is the folder of the students, grade that one: `course grade {submitted / path.name}`"
            )
    return is_class


def _no_student(path: Path, submitted: Path, known: list[str]) -> str:
    """Why a folder among the students' is not a student's; "" if it is."""
    if path.is_symlink():
        return ""
    if (path / "gradebook.db").is_file() and (path / "verdicts").is_dir():
        return f"{path.name}: what `course grade` wrote, not a student's folder"
    if _untouched_bundle(path):
        return f"{path.name}: the bundle that `course release` wrote, with nobody's work in it, not a student's folder"
    assignment = names.folder_for(path.name, known)
    notebooks = (entry.name for entry in _listed(path) if entry.is_file())
    if assignment and any((names.notebook_rank(name, assignment) or 0) < names.OTHER for name in notebooks if _is_notebook(name)):
        return (
            f"{path.name}/{assignment}.ipynb: an assignment's folder where a student's is expected. If {submitted} is one student's "
            f"folder, grade the folder above it; else put this into one: STUDENT/{assignment}/{assignment}.ipynb"
        )
    return ""


def _is_notebook(name: str) -> bool:
    return names.notebook_rank(name, "") is not None


def _untouched_bundle(path: Path) -> bool:
    try:
        manifest = json.loads(read_regular(path / ".release.json", 1 << 20))["notebooks"]
        for entry in _listed(path):
            name = f"{entry.name}/{entry.name}.ipynb"
            if entry.is_dir() and os.path.lexists(path / name):
                digest = hashlib.sha256(read_regular(path / name, MAX_NOTEBOOK)).hexdigest()
                if digest not in manifest[name]:
                    return False
    except (OSError, ValueError, KeyError, TypeError):  # no bundle, or a bundle in which somebody has worked
        return False
    return True


def _assignment_inside(folder: Path, known: list[str]) -> str:
    meant = (names.folder_for(entry.name, known) for entry in _listed(folder) if entry.is_dir())
    return next((assignment for assignment in meant if assignment), "")


def _loose(shown: str, path: Path, known: list[str], student: str, example: str, own: str = "ASSIGNMENT") -> str:
    """A line for a file that lies where no submission does."""
    assignment = names.assignment_of(path.name, known) or own
    wanted = f"{example}/{assignment}/{assignment}.ipynb"
    if path.is_symlink() and not path.exists():
        return f"{shown}: a broken link"
    if _is_notebook(path.name):
        return f"{shown}: a notebook outside an assignment's folder; expected {wanted}: move it there, or run `course collect`"
    if path.suffix.casefold() in (".zip", ".gz", ".tgz", ".tar", ".7z", ".rar"):
        return f"{shown}: an archive outside an assignment's folder; unpack it to {wanted}, or run `course collect`"
    if student:
        return f"{shown}: outside an assignment's folder, where no notebook finds it; if one needs it, move it beside {wanted}"
    return f"{shown}: a file beside the students' folders; not looked at"


def _listed(folder: Path) -> list[os.DirEntry[str]]:
    """What is in a folder, sorted, without what systems leave there and what is hidden; nothing, if it cannot be read."""
    try:
        with os.scandir(folder) as scan:
            return sorted((entry for entry in scan if not names.is_junk(entry.name)), key=lambda entry: entry.name)
    except OSError:
        return []


def _shown(path: Path, submitted: Path) -> str:
    return str(path.relative_to(submitted))


def _alike(one: Path, other: Path, assignment: str) -> bool:
    """Whether two folders hold the same notebook, so that nothing is lost if one counts."""
    try:
        first, second = (found.notebook(folder, assignment).content for folder in (one, other))
    except (found.NotFound, BadFile, OSError):
        return False
    return first == second


# -------------------------------------------------------------------------------- one submission


def read(student: str, assignment: str, folder: Path) -> Submission:
    """Read one submission. Whatever is wrong with it ends in `problem` or `flags`."""
    submission = Submission(student, assignment, folder)
    if folder.is_symlink() or folder.parent.is_symlink():
        submission.problem = "The submission's folder is a link; hand in the files themselves."
        return submission
    name = f"{assignment}.ipynb"
    try:
        notebook = found.notebook(folder, assignment)
        name = notebook.found_as or name
        _note(submission, notebook, folder)
        one = reading.read(notebook.content)
        submission.notebook, submission.flags = one.notebook, submission.flags + one.flags
    except found.NotFound as problem:
        submission.problem = str(problem)
    except BadNotebook as problem:
        submission.problem = f"{name}: {problem}" if name != f"{assignment}.ipynb" else str(problem)
    except BadFile as problem:
        submission.problem = f"{assignment}.ipynb {problem}."
    except OSError as error:
        submission.problem = f"{assignment}.ipynb can't be read: {error.strerror}."
    _collect(submission, os.path.basename(name))
    if submission.notebook is not None:
        submission.fingerprint = _fingerprint(submission)
    return submission


def _note(submission: Submission, notebook: found.Notebook, folder: Path) -> None:
    """Keep where the notebook was found, and say so if it is not where it belongs."""
    submission.folder, submission.unpacked = notebook.folder, notebook.unpacked
    where = notebook.found_as or f"{submission.assignment}.ipynb"
    if names.label(folder.name) != submission.assignment:
        submission.flags.append(f"found_as: {names.label(folder.name)}/{where}")
    elif notebook.found_as:
        submission.flags.append(f"found_as: {where}")
    if notebook.also_there:
        submission.flags.append(f"also_there: {', '.join(notebook.also_there)} (not graded)")
    if notebook.ignored:
        submission.flags.append(f"ignored_files: {len(notebook.ignored)} in the archive (links, odd names, or too large)")


def parse(content: bytes) -> nbformat.NotebookNode:
    """The notebook in these bytes, as nbformat 4. Raises BadNotebook for anything else, whatever it is."""
    return reading.read(content).notebook


def grade_ids(notebook: nbformat.NotebookNode) -> Counter[str]:
    """How often each nbgrader id occurs."""
    ids = (cell.metadata.get("nbgrader", {}).get("grade_id") for cell in notebook.cells)
    return Counter(name for name in ids if isinstance(name, str))


def _collect(submission: Submission, notebook: str) -> None:
    """The regular files beside the notebook, up to the limits; a flag for everything else."""
    total = number = 0
    for number, (relative, entry) in enumerate(files.entries(submission.folder), start=1):
        if number >= files.MAX_ENTRIES:
            submission.flags.append(f"ignored_files: more than {files.MAX_ENTRIES} entries in the folder")
            return
        if relative == notebook or files.can_be_entered(relative, entry):
            continue
        size = files.readable_size(entry)
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


def _fingerprint(submission: Submission) -> str:
    """sha256 of what a score depends on: types, sources and nbgrader's metadata of the cells, and the files beside them."""
    cells = [
        [cell.cell_type, cell.source, cell.metadata.get("nbgrader", {}), cell.metadata.get("tags")]
        for cell in (submission.notebook.cells if submission.notebook else ())
    ]
    digest = hashlib.sha256(json.dumps(cells, sort_keys=True, default=str).encode())
    for name, path in sorted(submission.files.items()):
        digest.update(os.fsencode(name) + b"\0")
        try:
            digest.update(hashlib.sha256(read_regular(path, MAX_SIDE_BYTES)).digest())
        except (BadFile, OSError):
            digest.update(b"unreadable")
    return digest.hexdigest()
