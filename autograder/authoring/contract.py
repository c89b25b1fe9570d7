"""The exercise contract: a stub, its reference and its checks agree, and the reference runs with what the notebook offers."""

from __future__ import annotations

import ast
import builtins
import functools
import importlib
import inspect
import re
import symtable
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Literal

from autograder import paths
from autograder.authoring.chapter import Cell, Chapter, ChapterError, page_files, parse

if TYPE_CHECKING:
    from autograder.authoring.spec import Artefact, Exercise, Tuning

STUB = "raise NotImplementedError"


@dataclass(frozen=True)
class Sources:
    """What a chapter needs besides its own text."""

    exercises: tuple[Exercise | Artefact | Tuning, ...]
    solutions: ModuleType
    bibliography: Path
    pages: Mapping[int, str]  # the chapters that are written, and their pages' names
    elsewhere: Mapping[str, str] = field(default_factory=dict)  # the exercises of other chapters, and where they stand

    def exercise(self, name: str) -> Exercise | Artefact | Tuning:
        """The checks of one exercise."""
        return next(exercise for exercise in self.exercises if exercise.name == name)


@dataclass(frozen=True)
class Reference:
    """A reference function, taken apart: the signature's lines, the docstring's, and the indented body after it."""

    signature: str
    docstring: str
    body: str


def sources(chapter: Chapter, alone: bool = False) -> Sources:
    """The real sources of a chapter of this checkout. ChapterError if its checks or its solutions are missing.

    `alone` leaves out what stands in other chapters, for whoever takes the course as proved: reading them all takes half a second.
    """
    files = page_files()
    solutions = _module(chapter, "solutions", "its reference functions")  # first, as the checks import them
    checks = _module(chapter, "checks", "a tuple `EXERCISES`")
    if not hasattr(checks, "EXERCISES"):
        raise ChapterError(Path(str(checks.__file__)), 1, "a chapter's checks are its tuple `EXERCISES`, which is missing here")
    return Sources(
        checks.EXERCISES,
        solutions,
        paths.BIBLIOGRAPHY,
        {number: path.stem for number, path in files.items()},
        {
            name: place
            for number, path in files.items()
            if number != chapter.number and not alone
            for name, place in _exercises_of(path, path.stat().st_mtime_ns)
        },
    )


@functools.cache  # for as long as the file is the same: a build asks for the sources of each chapter several times
def _exercises_of(path: Path, _modified: int) -> tuple[tuple[str, str], ...]:
    """Name and place of each exercise of a chapter."""
    return tuple((str(cell.exercise), f"{_shown(path)}:{cell.line}") for cell in parse(path).exercises)


def _module(chapter: Chapter, kind: Literal["checks", "solutions"], contents: str) -> ModuleType:
    """One of the two modules that belong to a chapter, found by their names."""
    name = f"{'autograder.' * (kind == 'checks')}{kind}.{chapter.assignment}"
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise  # it is there, and imports something that is not
        exercise = f", and so no {kind} of {chapter.exercises[0].exercise}" if chapter.exercises else ""
        line = chapter.exercises[0].line if chapter.exercises else 1
        missing = f"there is no {name.replace('.', '/')}.py{exercise}: write it, with {contents}"
        raise ChapterError(chapter.path, line, missing) from error


def _shown(path: Path) -> Path:
    return path.relative_to(paths.ROOT) if path.is_relative_to(paths.ROOT) else path


def references(chapter: Chapter, sources: Sources) -> dict[str, Reference]:
    """The reference of every exercise, by name, in the chapter's order. ChapterError if the contract is broken anywhere."""
    _one_of_each(chapter, sources)
    found = {}
    for cell in chapter.exercises:
        name = str(cell.exercise)
        try:
            function = _function(textwrap.dedent(inspect.getsource(getattr(sources.solutions, name))))
        except ValueError as error:
            raise ChapterError(Path(str(sources.solutions.__file__)), 1, f"{name}: {error}") from error
        try:
            stub = _function(cell.source)
        except (SyntaxError, ValueError) as error:
            raise ChapterError(chapter.path, cell.line, f"the stub of {name}: {error}") from error
        for complaint in _disagreements(name, stub, function):
            raise ChapterError(chapter.path, cell.line, f"the stub of {name}: {complaint}")
        found[name] = function.reference
    _names_are_known(chapter, found)
    return found


@dataclass(frozen=True)
class _Function:
    node: ast.FunctionDef
    reference: Reference


def _function(source: str) -> _Function:
    """Take apart the source of exactly one function that has a docstring and a body. ValueError if it is anything else."""
    nodes = ast.parse(source).body
    if len(nodes) != 1 or not isinstance(nodes[0], ast.FunctionDef):
        raise ValueError("must be one function and nothing else")
    node, lines = nodes[0], source.rstrip().split("\n")
    if ast.get_docstring(node) is None or len(node.body) < 2:
        raise ValueError("must be a signature, a docstring and a body")
    start, end = node.body[0].lineno - 1, int(node.body[0].end_lineno or 0)
    return _Function(node, Reference(*("\n".join(part) for part in (lines[:start], lines[start:end], lines[end:]))))


def _disagreements(name: str, stub: _Function, function: _Function) -> Iterator[str]:
    if stub.node.name != name:
        yield f"defines {stub.node.name}"
    if (ast.dump(stub.node.args), ast.dump(stub.node.returns or ast.Pass())) != (
        ast.dump(function.node.args),
        ast.dump(function.node.returns or ast.Pass()),
    ):
        yield f"takes ({ast.unparse(stub.node.args)}), its reference ({ast.unparse(function.node.args)})"
    if stub.reference.docstring != function.reference.docstring:
        yield "has another docstring than its reference"
    if stub.reference.body.strip() != STUB:
        yield f"its body must be the one line `{STUB}`"


def _one_of_each(chapter: Chapter, sources: Sources) -> None:
    ids: dict[str, Cell] = {}
    for cell in chapter.exercises + chapter.open_questions:
        for name in (f"test_{cell.exercise}", cell.exercise) if cell.exercise else (str(cell.open_question),):
            if name in ids:
                raise ChapterError(chapter.path, cell.line, f"the id {name!r} is taken by line {ids[str(name)].line}")
            ids[str(name)] = cell
        if cell.exercise in sources.elsewhere:
            other = sources.elsewhere[str(cell.exercise)]
            cure = "an exercise's name occurs once in the course, as its checks are kept by it: choose another"
            raise ChapterError(chapter.path, cell.line, f"the exercise {cell.exercise} is at {other}, too; {cure}")
    checked = [exercise.name for exercise in sources.exercises]
    if repeated := {name for name in checked if checked.count(name) > 1}:
        raise ChapterError(chapter.path, 1, f"the checks of {chapter.assignment} name {sorted(repeated)[0]} twice")
    for cell in chapter.exercises:
        if cell.exercise not in checked:
            raise ChapterError(chapter.path, cell.line, f"the checks of {chapter.assignment} lack {cell.exercise}")
        if not hasattr(sources.solutions, str(cell.exercise)):
            raise ChapterError(chapter.path, cell.line, f"{sources.solutions.__name__} lacks {cell.exercise}")
    if stubless := set(checked) - ids.keys():
        raise ChapterError(chapter.path, 1, f"no stub for {', '.join(sorted(stubless))}, which the checks name")
    _checks_are_sound(chapter, sources)
    for exercise in sources.exercises:
        if abs(sum(exercise.criteria.values()) - exercise.points) > 1e-9:
            raise ChapterError(chapter.path, 1, f"the criteria of {exercise.name} do not add up to {exercise.points:g} points")


def _checks_are_sound(chapter: Chapter, sources: Sources) -> None:
    from autograder.authoring import complaints, freeze, spec  # they load torch, as the checks themselves do

    for exercise in sources.exercises:
        if isinstance(exercise, spec.Exercise):
            for complaint in freeze.refusals(exercise):
                file = complaints.checks_file(exercise)
                path = paths.ROOT / file if file else chapter.path
                raise ChapterError(path, _line_of(exercise.name, path), complaint)


def _line_of(name: str, path: Path) -> int:
    """The line of a module in which an exercise gets its name; 1 if none does."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return next((number for number, line in enumerate(lines, 1) if re.search(rf'^\s*(name=)?"{name}",', line)), 1)


def _names_are_known(chapter: Chapter, found: Mapping[str, Reference]) -> None:
    """Every global name that a reference uses is defined above it: by stubs, or by set-up cells, which the judge runs, too."""
    known = set(dir(builtins))
    for cell in chapter.cells:
        if cell.exercise:
            reference = found[cell.exercise]
            known.add(cell.exercise)
            if missing := _globals(f"{reference.signature}\n{reference.body}") - known:
                raise ChapterError(
                    chapter.path,
                    cell.line,
                    f"the reference of {cell.exercise} uses {', '.join(sorted(missing))}, which no set-up cell above defines",
                )
        elif cell.kind == "code" and "live" not in cell.tags:
            known |= _defined(chapter, cell)


def _tables(table: symtable.SymbolTable) -> Iterable[symtable.SymbolTable]:
    yield table
    for child in table.get_children():
        yield from _tables(child)


def _globals(source: str) -> set[str]:
    top = symtable.symtable(source, "reference", "exec")
    used = {symbol.get_name() for table in _tables(top) for symbol in table.get_symbols() if _reads_global(symbol, table is top)}
    return used - {symbol.get_name() for symbol in top.get_symbols() if symbol.is_assigned()}


def _reads_global(symbol: symtable.Symbol, is_top: bool) -> bool:
    return symbol.is_referenced() and (is_top or symbol.is_global())


def _defined(chapter: Chapter, cell: Cell) -> set[str]:
    source = re.sub(r"^[%!].*$", "", cell.source, flags=re.MULTILINE)  # magics are not Python
    try:
        top = symtable.symtable(source, "cell", "exec")
    except SyntaxError as error:
        raise ChapterError(chapter.path, cell.line + int(error.lineno or 0), f"not Python: {error.msg}") from error
    return {name.get_name() for name in top.get_symbols() if name.is_assigned() or name.is_imported() or name.is_namespace()}
