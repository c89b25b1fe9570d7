"""Judge an answer that was written on a page of the book: the notebook's own comparing code, on the page's torch.

The page hands over a text that `autograder.proving.practice.page_of` made (`open_page`); then `check(name, source)` says of the text of
a cell what the notebook would say, and `draw(title, positions)` what one of the page's figures shows of it.
"""

from __future__ import annotations

import ast
import builtins
import contextlib
import dataclasses
import io
import json
import linecache
import re
import sys
import traceback
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import elsewhere
import figures
import torch
from torch import missing  # type: ignore[attr-defined]  # of the page's torch

HERE = Path(__file__).parent
MAX_PRINTED = 10_000
PROMPT = re.compile(r"^\s*(>>>|\.\.\.)( |$)")
HELP = re.compile(r"^\s*\?{0,2}[\w.]+\?{1,2}\s*$|^\s*\?{1,2}[\w.]+\s*$")


def _library(folder: Path) -> None:
    """`course_lib`, of which the page has what it needs."""
    library = types.ModuleType("course_lib")
    library.__path__ = [str(folder)]
    library.__dict__.update(check=check, earlier=earlier, __all__=["check", "earlier"])
    sys.modules["course_lib"] = library


@dataclasses.dataclass
class Page:
    """What a page knows: the cells that set its chapter up, the book's own answers by name, frozen cases by name, the same cells and
    answers of earlier chapters, and by title the figures that draw answers: the `source` that gives a function to `explore`, and the
    exercises that it `uses`."""

    setup: list[str]
    answers: dict[str, str]
    cases: dict[str, str] = dataclasses.field(default_factory=dict)
    earlier: dict[str, Page] = dataclasses.field(default_factory=dict)
    figures: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)


_page = Page([], {})


def open_page(text: str) -> list[str]:
    """Take over what the page hands over, and say which exercises can be judged."""
    global _page
    data = json.loads(text)
    missing.know(data.get("torch", {}))
    _page = Page(**data["page"] | {"earlier": {name: Page(**one) for name, one in data["page"]["earlier"].items()}})
    _exercises.clear()
    return list(_page.cases)


# ----------------------------------------------------------------------------------------------------------- the cases

_exercises: dict[str, Any] = {}


def exercise_from(text: str) -> Any:
    """An exercise with its frozen cases, of what course_lib.checks.stored.to_text wrote."""
    from course_lib.checks.cases import exercise_of

    data = json.loads(text)
    tensors = {
        name: torch.tensor(one["entries"], dtype=getattr(torch, one["dtype"])).reshape(one["shape"])
        for name, one in data["arrays"].items()
    }

    def whole(value: Any) -> Any:
        if isinstance(value, dict):
            return tensors[value["@array"]] if "@array" in value else {name: whole(entry) for name, entry in value.items()}
        return [whole(entry) for entry in value] if isinstance(value, list) else value

    return exercise_of(whole(data["exercise"]))


def _exercise(name: str) -> Any:
    if name not in _exercises:
        if name not in _page.cases:
            raise LookupError(f"{name} can't be checked on this page; it can in the notebook")
        _exercises[name] = exercise_from(_page.cases[name])
    return _exercises[name]


# ------------------------------------------------------------------------------------------------------------- judging


def check(name: Any, source: str | None = None, answers: Mapping[str, str] | None = None) -> Any:
    """Judge the text of a cell that defines the exercise `name`.

    Args:
      name: of the exercise. A function, as in a cell's `check(compute_gae)`, is judged as in the notebook: a CheckResult comes back.
      source: the text of the cell.
      answers: texts of cells for other exercises of the chapter, such as the reader's own; the book's stand in for the rest.

    Returns: `state`, `misconceptions` and `message` as in a verdict; `headline`, `lines` and `ticks` as the notebook shows them;
      `printed`, what the cell wrote.
    """
    if callable(name):
        from course_lib.checks.results import examined

        return examined(_exercise(name.__name__), name)
    exercise = _exercise(name)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        namespace = _prepared(
            _page, {other: text for other, text in {**_page.answers, **(answers or {})}.items() if other != name}
        )
        missing.asked_for.clear()
        told, stopped = run_cell(source or "", namespace)
        if callable(namespace.get(name)):
            result = judged(exercise, namespace[name])
        else:
            result = _told(exercise, "error", stopped or f"The cell defines no function {name}.")
            stopped = ""
    return result | {"printed": (told + printed.getvalue())[:MAX_PRINTED] + stopped}


def judged(exercise: Any, function: Callable) -> dict[str, Any]:
    """What the notebook says of a function; if it needs what the page does not have, only that."""
    from course_lib.checks.results import examined

    missing.asked_for.clear()
    result = examined(exercise, function)
    if missing.asked_for:
        return _told(exercise, "error", missing.asked_for[0])
    return _plain(result)


def _told(exercise: Any, state: str, message: str) -> dict[str, Any]:
    from course_lib.checks.diagnosis import Finding
    from course_lib.checks.results import CheckResult

    if missing.asked_for:
        message = missing.asked_for[0]
    return _plain(CheckResult(Finding(exercise.name, state, 0.0, exercise.points, message=message), ""))


def _plain(result: Any) -> dict[str, Any]:
    finding = result.finding
    return {
        "state": finding.state,
        "misconceptions": list(finding.misconceptions),
        "message": finding.message,
        "headline": result.headline(),
        "lines": result.lines(),
        "ticks": [list(tick) for tick in result.ticks()],
    }


# ------------------------------------------------------------------------------------------------------------- drawing


def draw(title: str, positions: list[int], answers: Mapping[str, str] | None = None) -> dict[str, Any]:
    """What a figure of the page shows of these answers, the book's where there is none.

    Args:
      title: of the figure.
      positions: where its sliders stand, counted from 0.
      answers: texts of cells for exercises of the chapter.

    Returns: `values`, those of each series, and `sentence`, "" unless there is nothing to draw: then it says why.
    """
    figure, failed = _page.figures[title], dict[str, str]()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        namespace = _prepared(_page, {**_page.answers, **(answers or {})}, failed)
        for name in figure["uses"]:
            if name in failed:
                return {"values": [], "sentence": f"There is no curve of yours, as the cell of {name} stops: {failed[name]}"}
        missing.asked_for.clear()
        returned = dict[str, Any]()
        for name in {*figure["uses"]} & {*(answers or {})} & {*namespace}:
            namespace[name] = _kept(namespace[name], name, returned)
        try:
            exec(compile(figure["source"], "<figure>", "exec", dont_inherit=True), namespace)
            values = figures.values(title, positions)
        except (Exception, SystemExit) as error:
            return {"values": [], "sentence": _no_curve(error, returned)}
    if missing.asked_for:
        return {"values": [], "sentence": f"There is no curve of yours: {missing.asked_for[0]}."}
    return {"values": values, "sentence": ""}


def _kept(function: Callable, name: str, returned: dict[str, Any]) -> Callable:
    """The function, which keeps in `returned` what it has returned last."""

    def calling(*args: Any, **kwargs: Any) -> Any:
        returned.pop(name, None)  # the last is the last to be called
        returned[name] = function(*args, **kwargs)
        return returned[name]

    return calling


def _said_of(value: Any) -> str:
    """A value in words."""
    if value is None:
        return "None"
    if isinstance(value, torch.Tensor):
        return f"a tensor of shape {tuple(value.shape)}"
    if isinstance(value, tuple):
        return f"a tuple ({', '.join(map(_said_of, value))})"
    kind = type(value).__name__
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


def _no_curve(error: BaseException, returned: Mapping[str, Any]) -> str:
    """Why there is none, and what to do: as course_lib.figures.interactive says it.

    Args:
      returned: by name, what the reader's functions have returned last.
    """
    if missing.asked_for:
        return f"There is no curve of yours: {missing.asked_for[0]}."
    frames = traceback.extract_tb(error.__traceback__)
    name = next((frame.name for frame in reversed(frames) if frame.filename == "<cell>"), "")
    if isinstance(error, NotImplementedError) and name:
        return f"This figure shows what {name} returns, which is not written yet: write it, then draw again."
    if isinstance(error, NameError) and frames[-1].filename == "<figure>":
        return f"This figure needs {error.name}, which is not written yet: write it, then draw again."
    said = f"{type(error).__name__}: {error}"
    if not name:
        odd = {one: value for one, value in returned.items() if not isinstance(value, torch.Tensor | tuple)} or returned
        which = f"{[*odd][-1]} returns: {_said_of([*odd.values()][-1])}" if odd else f"your code returns: {said}"
        return f"There is no curve of yours, as the figure can't use what {which}."
    return f"There is no curve of yours, as {name} stops: {said}. Its check says more."


# ------------------------------------------------------------------------------------------------------------- running


def _prepared(page: Page, answers: Mapping[str, str], failed: dict[str, str] | None = None) -> dict[str, Any]:
    """A `__main__` in which the chapter's cells have run, as far as the page can run them, and its exercises are answered: by the book
    where an answer stops, which `failed` is told, with the reason."""
    module = types.ModuleType("__main__")
    sys.modules["__main__"] = module
    namespace = module.__dict__
    namespace["__builtins__"] = builtins
    namespace["display"] = lambda *_args, **_kwargs: None
    for source in page.setup:
        for statement in ast.parse(source).body:
            with contextlib.suppress(Exception):  # what it would define is asked for in vain, then
                exec(compile(ast.Module([statement], []), "<set-up>", "exec", dont_inherit=True), namespace)
    for name, source in answers.items():
        _, stopped = run_cell(source, namespace)
        if stopped or not callable(namespace.get(name)):
            if failed is not None:
                failed[name] = stopped or f"The cell defines no function {name}."
            run_cell(page.answers.get(name, ""), namespace)
    return namespace


def run_cell(source: str, namespace: dict[str, Any]) -> tuple[str, str]:
    """Run the text of a cell. Returns what there is to say about it, and how it stopped: "" if it did not."""
    told = ""
    try:
        code = compile(source, "<cell>", "exec", dont_inherit=True)
    except (SyntaxError, ValueError) as error:
        lines = source.splitlines()
        if any(line.lstrip().startswith(">>>") for line in lines):  # pasted from a prompt, which IPython takes away, too
            lines = [PROMPT.sub("", line) for line in lines]
        plain = ["" if line.lstrip()[:1] in ("%", "!") or HELP.match(line) else line for line in lines]
        if plain == source.splitlines():
            return told, _syntax(error)
        told = "" if plain == lines else "Lines that begin with % or !, or ask for help with ?, are left out on the page.\n"
        try:
            source = "\n".join(plain)
            code = compile(source, "<cell>", "exec", dont_inherit=True)
        except (SyntaxError, ValueError) as error:
            return told, _syntax(error)
    linecache.cache["<cell>"] = (len(source), None, source.splitlines(keepends=True), "<cell>")
    try:
        exec(code, namespace)
    except Exception as error:
        return told, _stopped(error)
    except SystemExit as error:
        return told, f"The cell ends with SystemExit: {error}"
    return told, ""


def _syntax(error: Exception) -> str:
    if not isinstance(error, SyntaxError):
        return f"{type(error).__name__}: {error}"
    line = f" in line {error.lineno}: {(error.text or '').strip()}" if error.lineno else ""
    return f"{type(error).__name__}: {error.msg}{line}"


def _stopped(error: Exception) -> str:
    """The exception, and the line of the cell at which it arose."""
    places = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == "<cell>"]
    line = f" in line {places[-1].lineno}: {places[-1].line}" if places else ""
    return f"{type(error).__name__}: {error}{line}"


def earlier(name: str, chapter: int) -> Callable:
    """The function `name` of an earlier chapter, as in the notebook; here, the book's own answer."""
    found: list[Callable] = []

    def function(*args: Any, **kwargs: Any) -> Any:
        if not found:
            page = _page.earlier.get(f"ch{chapter}")
            if page is None or name not in page.answers:
                raise missing.Missing(f"{name} of chapter {chapter}", "the page")
            running = sys.modules["__main__"]
            try:
                found.append(_prepared(page, page.answers)[name])
            finally:
                sys.modules["__main__"] = running
        return found[0](*args, **kwargs)

    function.__name__ = name
    return function


_library(HERE / "course_lib")
elsewhere.install()
figures.install()
