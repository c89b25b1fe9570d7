"""Which cells of an assignment a notebook has twice or not at all: said while a learner can still mend it.

The release puts a list of an assignment's graded cells beside the frozen checks (`frozen/ch44.cells`). The grader puts most of this
right by itself; what it can't is which of two open answers counts.
"""

from __future__ import annotations

import functools
import json
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SUFFIX = ".cells"
MAX_BYTES = 5 << 20  # of a notebook that is read while a learner waits


@dataclass(frozen=True)
class Outline:
    """The names of an assignment's graded cells, in its order."""

    exercises: tuple[str, ...]
    questions: tuple[str, ...]


def save(directory: Path, assignment: str, outline: Outline) -> None:
    """Write the list to `directory/ASSIGNMENT.cells`."""
    text = json.dumps({"exercises": outline.exercises, "questions": outline.questions})
    (directory / f"{assignment}{SUFFIX}").write_text(text + "\n", encoding="utf-8")


@functools.cache
def outlines(directory: Path) -> dict[str, Outline]:
    """Assignment → the list of its cells, for all lists in a folder."""
    found = {}
    for path in sorted(directory.glob(f"*{SUFFIX}")):
        raw = json.loads(path.read_text(encoding="utf-8"))
        found[path.stem] = Outline(tuple(raw["exercises"]), tuple(raw["questions"]))
    return found


def outline_of(cells: Sequence[Mapping[str, Any]], known: Mapping[str, Outline]) -> Outline | None:
    """The list that most of a notebook's cells belong to; None if none do."""
    marked = {_mark(cell) for cell in cells}
    text = "\n".join(_text(cell) for cell in cells)

    def hits(outline: Outline) -> int:
        names = {*outline.exercises, *outline.questions}
        return sum(name in marked or f"check({name})" in text for name in names)

    best = max(known.values(), key=hits, default=None)
    return best if best and hits(best) else None


def complaints(cells: Sequence[Mapping[str, Any]], outline: Outline) -> dict[str, list[str]]:
    """Exercise or open question → a line for each thing about its cells that a learner should look at; only for those that have one.

    Args:
      cells: all cells of the notebook file, as they stand in its JSON.
    """
    marked = {_mark(cell) for cell in cells}
    if not marked & {*outline.exercises, *outline.questions, *(f"test_{name}" for name in outline.exercises)}:
        return {outline.exercises[0]: [_LOST]} if outline.exercises else {}
    found = {name: list(_of_exercise(name, cells)) for name in outline.exercises}
    found |= {name: list(_of_question(name, cells)) for name in outline.questions}
    return {name: lines for name, lines in found.items() if lines}


_LOST = (
    "The cells have lost their marks (nbgrader's metadata), as some editors and converters take them off: the grader finds functions by "
    "their names and open answers by their questions, so leave both as they are."
)


def unchecked(cells: Sequence[Mapping[str, Any]], outline: Outline) -> list[str]:
    """The exercises that have a cell in the notebook and no check."""
    text = "\n".join(_text(cell) for cell in cells)
    return [name for name in outline.exercises if _places(name, cells) and f"check({name})" not in text]


def _of_exercise(name: str, cells: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    answers, checks = _places(name, cells), _places(f"test_{name}", cells)
    definition = re.compile(rf"^(?:async )?def {name}\(", re.MULTILINE)
    if len(answers) > 1:
        yield f"{name} stands {_times(answers)} ({_where(answers, cells)}): the last definition counts."
    in_text = [at for at, cell in enumerate(cells) if cell.get("cell_type") != "code" and definition.search(_text(cell))]
    in_code = any(cell.get("cell_type") == "code" and definition.search(_text(cell)) for cell in cells)
    if in_text and not in_code:
        yield f"{name} is written in a text cell ({_where(in_text, cells)}), which never runs: make it a code cell."
    if len(checks) > 1:
        yield f"The check of {name} stands {_times(checks)} ({_where(checks, cells)}): the copies are ignored."
    if not checks:
        called = any(cell.get("cell_type") == "code" and f"check({name})" in _text(cell) for cell in cells)
        yield f"The check cell of {name} {'has lost its mark' if called else 'is missing'}: the grader puts it back."


def _of_question(name: str, cells: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    places = _places(name, cells)
    if not places:
        yield (
            f"The open question {name} has no cell with its mark: the grader looks for its text, and if that is gone, too, "
            "your teacher must look at this notebook. Copy the cell from the released notebook and put your answer into it."
        )
    elif len(places) > 1 and len({_text(cells[at]).strip() for at in places}) > 1:
        yield (
            f"The open question {name} stands {_times(places)}, with different texts ({_where(places, cells)}): keep one cell with your "
            "whole answer, or your teacher must look at which one counts."
        )
    elif any(cells[at].get("cell_type") == "code" for at in places):
        yield f"The open question {name} is in a code cell ({_where(places, cells)}): make it a text cell."


def notes(name: str, directory: Path) -> list[str]:
    """What to say beside the check of an exercise in a notebook, if its file can be found: as it was last saved.

    Lines on open questions come with the last exercise. An editor that does not say where the file is gets no notes.
    """
    path = _own_file()
    if path is None:
        return []
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
        cells = [cell for cell in document["cells"] if isinstance(cell, dict)]
        outline = outline_of(cells, outlines(directory))
        if outline is None or name not in outline.exercises:
            return []
        asked = (name, *(outline.questions if name == outline.exercises[-1] else ()))
        found = complaints(cells, outline)
        return [f"In the saved file: {line}" for one in asked for line in found.get(one, [])]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return []  # a notebook that is just being saved, or is none: its own check still says what it says


def _own_file() -> Path | None:
    """The file of the notebook that runs here, if its editor says so: JupyterLab, Notebook 7, VS Code."""
    main = vars(sys.modules["__main__"])
    named = (os.environ.get("JPY_SESSION_NAME"), main.get("__session__"), main.get("__vsc_ipynb_file__"))
    for name in named:
        if isinstance(name, str) and name.endswith(".ipynb"):
            path = Path(name)
            try:
                if path.is_file() and path.stat().st_size <= MAX_BYTES:
                    return path
            except (OSError, ValueError):
                continue
    return None


def all_cells(path: Path) -> list[dict[str, Any]]:
    """All cells of a notebook file; none, if it cannot be read, which others say better."""
    try:
        cells = json.loads(path.read_text(encoding="utf-8-sig"))["cells"]
        return [cell for cell in cells if isinstance(cell, dict)]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []


def _mark(cell: Mapping[str, Any]) -> str | None:
    metadata = cell.get("metadata")
    nbgrader = metadata.get("nbgrader") if isinstance(metadata, dict) else None
    name = nbgrader.get("grade_id") if isinstance(nbgrader, dict) else None
    return name if isinstance(name, str) else None


def _text(cell: Mapping[str, Any]) -> str:
    source = cell.get("source", "")
    if isinstance(source, list):
        return "".join(line for line in source if isinstance(line, str))
    return source if isinstance(source, str) else ""


def _places(name: str, cells: Sequence[Mapping[str, Any]]) -> list[int]:
    return [at for at, cell in enumerate(cells) if _mark(cell) == name]


def _times(places: Sequence[int]) -> str:
    return "twice" if len(places) == 2 else f"{len(places)} times"


def _where(places: Sequence[int], cells: Sequence[Mapping[str, Any]]) -> str:
    """Places as a learner counts them: code cells among code cells, if all are."""
    if all(cells[at].get("cell_type") == "code" for at in places):
        kind, numbers = "code cell", [sum(cell.get("cell_type") == "code" for cell in cells[: at + 1]) for at in places]
    else:
        kind, numbers = "cell", [at + 1 for at in places]
    *first, last = map(str, numbers)
    return f"{kind}s {', '.join(first)} and {last}" if first else f"{kind} {last}"
