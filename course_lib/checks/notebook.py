"""Read a notebook file and run code cells in a plain namespace, without a kernel.

The learner's command line check and the grader's sandbox use the same rules: a cell means what it means in IPython, without its side
effects (course_lib.checks.magics says which), and after an exception the next statement goes on.
"""

from __future__ import annotations

import builtins
import json
import re
import sys
import traceback
import types
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from course_lib.checks import magics, names, syntax
from course_lib.checks.telling import text_of


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
    """Execute one cell's source as IPython would, but go on after a statement that fails; the first failure comes through at the end."""
    magics.shell_of(namespace).cell(source, f"<{name}>")


def run_definitions(source: str, namespace: dict[str, Any], name: str = "cell", wanted: Collection[str] | None = None) -> None:
    """Execute, of a cell that is not to run, what defines something (one of the names `wanted`) and calls nothing."""
    magics.shell_of(namespace).run_definitions(source, f"<{name}>", wanted)


def wanted_of_live(live: Iterable[str], others: Iterable[str], namespace: dict[str, Any]) -> set[str]:
    """The names that the other cells use and do not set, and what the live cells' definitions of them need in turn."""
    shell = magics.shell_of(namespace)
    defined, own = ([one for source in sources for one in shell.statements(source)] for sources in (live, others))
    return names.wanted_of(defined, own)


@dataclass(frozen=True)
class Stop:
    """The first statement of a cell that failed."""

    line: int
    error: str
    sets: tuple[str, ...] = ()
    """The names that the cell sets, or would have set."""
    newer: str = ""
    """The version of Python that reads the cell, if this one does not."""

    def said(self, number: int) -> str:
        """
        >>> Stop(3, "ModuleNotFoundError: No module named 'seaborn'").said(1)
        "code cell 1 stopped at line 3: ModuleNotFoundError: No module named 'seaborn'"
        """
        place = f" at line {self.line}" if self.line > 0 else ""
        return f"code cell {number} stopped{place}: {self.error}"


def stop(error: BaseException, source: str, namespace: dict[str, Any], name: str = "cell") -> Stop:
    """What is to be said of a cell that raised `error`."""
    told, line = text_of(error), 0
    for frame, at in traceback.walk_tb(error.__traceback__):
        if frame.f_code.co_filename == f"<{name}>" and frame.f_code.co_name == "<module>":
            line = at
    newer = ""
    if isinstance(error, SyntaxError) and not line:
        told, line = str(error.msg)[:500], error.lineno if isinstance(error.lineno, int) else 0
        newer = syntax.newer(magics.translated(source))
    sets = tuple(sorted(names_set_by(source, namespace)))[: names.MOST]
    return Stop(line, f"{type(error).__name__}: {told}".removesuffix(": "), sets, newer)


def names_set_by(source: str, namespace: dict[str, Any]) -> set[str]:
    """The names that a cell sets when it runs."""
    statements = magics.shell_of(namespace).statements(source)
    return names.set_by(statements) if statements else names.roughly_set_by(source)


NAMED = re.compile(r"name '(\w+)' is not defined|variable '(\w+)'|module '(\w+)")


def needed(stops: Mapping[Any, Stop], exercise: str, uses: Iterable[str], message: str = "") -> list[Any]:
    """Which of the cells that stopped set what an exercise uses, or what its message misses; in order."""
    missing = {name for found in NAMED.findall(message) for name in found if name}
    wanted = {exercise, *uses, *missing} | ({"*"} if missing else set())
    return [key for key in sorted(stops) if wanted & set(stops[key].sets)]


def run_cells(cells: Sequence[dict[str, Any]], namespace: dict[str, Any]) -> dict[int, Exception | SystemExit]:
    """Run the cells that a check needs, in order; return what failed, by position.

    Check cells are left out. Of live cells, what defines something that the others mention is run, and nothing is called.
    """
    failures: dict[int, Exception | SystemExit] = {}
    others = [cell["source"] for cell in cells if not (is_live(cell) or is_check(cell))]
    wanted = wanted_of_live([cell["source"] for cell in cells if is_live(cell)], others, namespace)
    for position, cell in enumerate(cells):
        name = f"cell {position + 1}"
        try:
            if is_live(cell):
                run_definitions(cell["source"], namespace, name, wanted)
            elif not is_check(cell):
                run_cell(cell["source"], namespace, name)
        except (Exception, SystemExit) as error:
            failures[position] = error
    return failures
