"""Read a notebook file and run code cells in a plain namespace, without a kernel.

The learner's command line check and the grader's sandbox use the same rules: a cell means what it means in IPython, without its side
effects (course_lib.checks.magics says which), and after an exception the next cell goes on.
"""

from __future__ import annotations

import builtins
import json
import sys
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from course_lib.checks import magics


class NotebookError(ValueError):
    """The file is no notebook; the message says what is wrong with it."""


def code_cells(path: Path) -> list[dict[str, Any]]:
    """The code cells of a notebook file (nbformat 4): dicts with `source` (str) and `metadata` (dict).

    Raises: NotebookError if the file is missing or is not a notebook.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
        cells = [cell for cell in document["cells"] if cell["cell_type"] == "code"]
        return [{"source": "".join(cell["source"]), "metadata": dict(cell.get("metadata") or {})} for cell in cells]
    except OSError as error:
        raise NotebookError(f"{path}: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError, RecursionError):
        raise NotebookError(f"{path}: this is not a Jupyter notebook (nbformat 4)") from None


def is_live(cell: dict[str, Any]) -> bool:
    """Whether the cell is marked as training, plot or experiment, which a check never runs."""
    tags = cell["metadata"].get("tags")
    return isinstance(tags, list) and "live" in tags


def is_check(cell: dict[str, Any]) -> bool:
    """Whether the cell is one of the locked check cells that carry an exercise's points."""
    nbgrader = cell["metadata"].get("nbgrader")
    return isinstance(nbgrader, dict) and nbgrader.get("grade") is True and nbgrader.get("solution") is not True


def new_namespace() -> dict[str, Any]:
    """A `__main__` to run cells in, where `display` does nothing and `get_ipython()` is a shell that does no harm."""
    module = types.ModuleType("__main__")
    sys.modules["__main__"] = module
    module.__dict__["__builtins__"] = builtins
    module.__dict__["display"] = lambda *_args, **_kwargs: None
    magics.install(module.__dict__)
    return module.__dict__


def run_cell(source: str, namespace: dict[str, Any], name: str = "cell") -> None:
    """Execute one cell's source as IPython would. Whatever it raises comes through."""
    magics.shell_of(namespace).run(source, f"<{name}>")


def run_definitions(source: str, namespace: dict[str, Any], name: str = "cell") -> None:
    """Execute, of a cell that never ends, what defines something and calls nothing."""
    magics.shell_of(namespace).run_definitions(source, f"<{name}>")


def run_cells(cells: Sequence[dict[str, Any]], namespace: dict[str, Any]) -> dict[int, Exception]:
    """Run the cells that a check needs (neither live nor check cells), in order; return what failed, by position."""
    failures: dict[int, Exception] = {}
    for position, cell in enumerate(cells):
        if is_live(cell) or is_check(cell):
            continue
        try:
            run_cell(cell["source"], namespace, f"cell {position + 1}")
        except Exception as error:
            failures[position] = error
    return failures
