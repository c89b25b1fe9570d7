"""Figures that answer to the reader's own code: the explorers of a chapter that call its exercises, and those that a page can draw.

What a figure rests on is read off the chapter's cells: of the statements above it, those that bind a name that it uses. A page draws
it if, with the book's answers, it draws the values that the book has recorded, in every position of the sliders.
"""

from __future__ import annotations

import ast
import itertools
import json
import math
import re
import shutil
import subprocess
import symtable
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from autograder.authoring.chapter import Chapter
from autograder.proving import practice

PROGRAM = """
import json, sys
sys.path[:] = [sys.argv[1], *(path for path in sys.path if "site-packages" not in path)]
import judge
page, calls = json.load(sys.stdin)
judge.open_page(json.dumps(page))
json.dump([judge.draw(*call) for call in calls], sys.stdout)
"""
SCALED = """

right_of_{name} = {name}


def {name}(*given, **named):
    found = right_of_{name}(*given, **named)
    return tuple({factor} * one for one in found) if isinstance(found, tuple) else {factor} * found
"""
PAYLOAD = re.compile(r'<figcaption>(.*?)</figcaption>.*?<script type="application/json">(.*?)</script>', re.DOTALL)
LAST_DIGIT = 1.01e-3  # one unit in the fourth significant digit of 1.000, where it weighs most
NOTHING = 1e-6  # of a series' largest value: what single precision makes of 0


@dataclass(frozen=True)
class Figure:
    """An explorer: its title, the `source` that gives a function to `explore`, and the exercises that this `uses`."""

    title: str
    source: str
    uses: tuple[str, ...]


def figures(chapter: Chapter, offered: Iterable[str]) -> list[Figure]:
    """The explorers of a chapter that call an exercise that is offered."""
    own = [cell.exercise for cell in chapter.exercises if cell.exercise]
    answers, found, before = set(offered), [], list[ast.stmt]()
    for cell in chapter.cells:
        if cell.kind != "code" or cell.exercise:
            continue
        for statement in _statements(cell.source):
            if title := _title(statement):
                needed, names = _needed(statement, before, set(own))
                uses = tuple(name for name in own if name in names & answers)
                if uses:
                    found.append(Figure(title, "\n".join(map(ast.unparse, needed)), uses))
            before.append(statement)
    return found


def _statements(source: str) -> list[ast.stmt]:
    try:
        return ast.parse(source).body
    except SyntaxError:  # a cell with a command of IPython's
        return []


def _title(statement: ast.stmt) -> str:
    """The title of the figure that a statement shows; "" if it shows none."""
    if isinstance(statement, ast.Expr) and isinstance(call := statement.value, ast.Call) and ast.unparse(call.func) == "explore":
        return next(ast.literal_eval(one.value) for one in call.keywords if one.arg == "title")
    return ""


def _needed(last: ast.stmt, before: Sequence[ast.stmt], exercises: set[str]) -> tuple[list[ast.stmt], set[str]]:
    """The statements that `last` rests on, itself included, and the exercises that they call, whose answers are taken from elsewhere."""
    _, names = _names(last)
    kept = [last]
    for statement in reversed(before):
        binds, uses = _names(statement)
        if not binds & (names - exercises) or _title(statement):
            continue
        kept.append(statement)
        names |= uses
    return kept[::-1], names & exercises


def _names(statement: ast.stmt) -> tuple[set[str], set[str]]:
    """The names that a statement binds, or changes an entry of, and those of the module that it uses."""
    table = symtable.symtable(ast.unparse(statement), "<cell>", "exec")
    binds = {one.get_name() for one in table.get_symbols() if one.is_assigned() or one.is_imported()}
    changed = [
        node
        for node in ast.walk(statement)
        if isinstance(node, ast.Subscript | ast.Attribute) and isinstance(node.ctx, ast.Store)
    ]
    binds |= {name.id for node in changed for name in ast.walk(node) if isinstance(name, ast.Name)}
    return binds, {one.get_name() for one in table.get_symbols() if one.is_referenced()} | set(_globals(table))


def _globals(table: symtable.SymbolTable) -> Iterator[str]:
    for inner in table.get_children():
        yield from (one.get_name() for one in inner.get_symbols() if one.is_global())
        yield from _globals(inner)


# ---- the gate ----------------------------------------------------------------------------------------------------------


def told(found: Sequence[Figure]) -> dict[str, dict[str, Any]]:
    """What `judge.draw` needs to know of figures."""
    return {one.title: {"source": one.source, "uses": list(one.uses)} for one in found}


def recorded(outputs: Iterable[Sequence[Mapping[str, Any]]]) -> dict[str, dict[str, Any]]:
    """By title, the data of the explorers among the outputs of a chapter's cells."""
    import html

    shown = ["".join(one.get("data", {}).get("text/html", "")) for cell in outputs for one in cell]
    return {html.unescape(title): json.loads(data) for text in shown for title, data in PAYLOAD.findall(text)}


def reasons(chapter: Chapter, found: Sequence[Figure], outputs: Iterable[Sequence[Mapping[str, Any]]]) -> dict[str, str]:
    """By title, why the page can't draw a figure; "" if it can."""
    if not found:
        return {}
    book = recorded(outputs)
    settings = {one.title: _settings(book[one.title]) for one in found}
    rows = iter(draw(chapter, found, [(title, positions) for title, all_of_it in settings.items() for positions, _ in all_of_it]))
    return {title: _differs(book[title], list(itertools.islice(rows, len(all_of_it)))) for title, all_of_it in settings.items()}


def drawn_by(chapter: Chapter, found: Sequence[Figure], factor: float = 0.5) -> dict[str, list[list[str]]]:
    """By title, of each series of a figure, the exercises that it draws: those of which `factor` times the answer moves it, at any end or
    middle of the sliders."""
    if not found:
        return {}
    answers = practice.answers(chapter)
    calls = [
        (one.title, positions, {name: answers[name] + SCALED.format(name=name, factor=factor)} if name else {})
        for one in found
        for name in ("", *one.uses)
        for positions in _corners(one)
    ]
    rows = iter(draw(chapter, found, calls))
    drawn = dict[str, list[list[str]]]()
    for one in found:
        number = len(_corners(one))
        right, *others = [list(itertools.islice(rows, number)) for _ in ("", *one.uses)]
        drawn[one.title] = [
            [name for name, rows_of in zip(one.uses, others, strict=True) if _moved(right, rows_of, at)]
            for at in range(len(right[0]["values"]))
        ]
    return drawn


def _corners(figure: Figure) -> list[list[int]]:
    """Positions of the sliders: each at its first, middle or last value."""
    (call,) = [
        node for node in ast.walk(ast.parse(figure.source)) if isinstance(node, ast.Call) and ast.unparse(node.func) == "explore"
    ]
    sizes = [len(ast.literal_eval(one.value)) for one in call.keywords if isinstance(one.value, ast.List)]
    return [list(places) for places in itertools.product(*(sorted({0, size // 2, size - 1}) for size in sizes))]


def _moved(right: Sequence[Mapping[str, Any]], other: Sequence[Mapping[str, Any]], series: int) -> bool:
    """Whether a series is another curve anywhere."""
    return any(not same(b["values"][series], a["values"][series]) for a, b in zip(right, other, strict=True))


def draw(
    chapter: Chapter, found: Sequence[Figure], calls: Sequence[Sequence[Any]], with_solutions: bool = True
) -> list[dict[str, Any]]:
    """What `judge.draw` answers to calls, with nothing but what the chapter's page has."""
    page = json.loads(practice.page_of(chapter, ()))
    page["page"]["figures"] = told(found)
    if not with_solutions:
        page["page"]["answers"] = {}
    with tempfile.TemporaryDirectory(prefix="course-page-") as folder:
        for name, path in practice.files().items():
            place = Path(folder) / name
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, place)
        command = [sys.executable, "-S", "-I", "-B", "-c", PROGRAM, folder]
        task = json.dumps([page, calls])
        done = subprocess.run(command, input=task, capture_output=True, text=True, timeout=practice.PATIENCE, check=False)
    if done.returncode:
        raise RuntimeError(f"{chapter.assignment}: the page's process failed\n{done.stderr[-2000:]}")
    return json.loads(done.stdout)


def _settings(book: Mapping[str, Any]) -> list[tuple[list[int], str]]:
    """Every position of an explorer's sliders, in the order in which the book records them, and how it reads."""
    places = itertools.product(*(enumerate(slider["values"]) for slider in book["sliders"]))
    return [([at for at, _ in place], ", ".join(label for _, label in place)) for place in places]


def _differs(book: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    """How what a page draws, setting by setting, differs from what the book shows; "" if it does not."""
    for (_, setting), here, there in zip(_settings(book), rows, book["values"], strict=True):
        if here["sentence"]:
            return here["sentence"]
        for series, mine, right in zip(book["series"], here["values"], there, strict=True):
            if not same(mine, right):
                return f"{series['name']} is another curve on the page at {setting}"
    return ""


def same(mine: Sequence[float | None], right: Sequence[float | None]) -> bool:
    """Whether two curves agree to the four significant digits that are kept."""
    nothing = NOTHING * max((abs(value) for value in right if value is not None), default=0.0)
    return len(mine) == len(right) and all(
        (a is None) == (b is None) and (a is None or b is None or math.isclose(a, b, rel_tol=LAST_DIGIT, abs_tol=nothing))
        for a, b in zip(mine, right, strict=True)
    )
