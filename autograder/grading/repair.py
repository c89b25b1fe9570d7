"""Put an honest notebook right: cells that were copied, split, merged, moved, or that lost their metadata or their type.

What counts is found by function name, as the last definition of a name counts in any program; what was released and is missing is put
back; and every repair is said in a flag. Only an open answer can be ambiguous, as no name tells which text is meant. Pure functions of the
notebook; cells are looked at as text, for a hostile cell is not worth parsing. No repair runs anything but the learner's functions.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from nbformat import NotebookNode

from autograder.authoring.chapter import ANSWER_LINE

AS_RUN = "as_run"
"""Key of a cell's metadata: what of it runs, if not its source; None for nothing. Read from no file: reading keeps other keys."""
FIRST = "first"
"""Key of a notebook's metadata: a source to run before all cells."""
MAX_STUB = 10_000  # characters of a function that could be an untouched stub


@dataclass(frozen=True)
class Form:
    """An assignment's notebook as it was released."""

    stubs: Mapping[str, str] = field(default_factory=dict)
    """Exercise → source of its cell."""
    tests: Mapping[str, str] = field(default_factory=dict)
    """`test_NAME` → source."""
    questions: Mapping[str, str] = field(default_factory=dict)
    """Open question → text with the line for the answer."""
    setup: Mapping[str, str] = field(default_factory=dict)
    """Id of a cell that every answer may rely on → source."""
    live: Mapping[str, str] = field(default_factory=dict)
    """Id of a cell that is never run → source."""
    texts: frozenset[str] = frozenset()
    """All other texts, without blanks."""
    ids: frozenset[str] = frozenset()


def form(released: NotebookNode) -> Form:
    """What `released`, an assembled learner's notebook, consists of."""
    groups: dict[str, dict[str, str]] = {name: {} for name in ("stubs", "tests", "questions", "setup", "live")}
    texts = set()
    for cell in released.cells:
        nbgrader = cell.metadata.get("nbgrader", {})
        if name := nbgrader.get("grade_id"):
            kind = ("questions" if nbgrader.grade else "stubs") if nbgrader.solution else "tests"
            groups[kind][name] = cell.source
        elif "book-only" in cell.metadata.get("tags", []):
            continue  # what the book has shown there is in the notebook instead
        elif cell.cell_type == "code":
            groups["live" if "live" in cell.metadata.get("tags", []) else "setup"][cell.id] = cell.source
        else:
            texts.add(squeezed(cell.source))
    return Form(**groups, texts=frozenset(texts), ids=frozenset(cell.id for cell in released.cells))


@dataclass
class Repaired:
    """A notebook put right, what was done to it, and what nobody but a person can decide."""

    notebook: NotebookNode
    flags: list[str] = field(default_factory=list)
    ambiguous: list[str] = field(default_factory=list)


def repair(notebook: NotebookNode, form: Form) -> Repaired:
    """The notebook with each graded cell once, and notes on what of it runs. The one that was handed in stays as it is."""
    work = _Work(notebook, form)
    work.checks()
    work.stubs()
    work.questions()
    work.setup()
    return work.result()


def squeezed(text: str) -> str:
    """The text without blanks."""
    return "".join(text.split())


def grade_id(cell: NotebookNode) -> str | None:
    """nbgrader's id of a cell."""
    name = cell.metadata.get("nbgrader", {}).get("grade_id")
    return name if isinstance(name, str) else None


def resembles(source: str, released: str) -> bool:
    """Whether at least half of the lines of `released` stand in `source`."""
    if len(source) > 20 * len(released) + 10_000:
        return False
    lines = [line for line in map(squeezed, released.splitlines()) if len(line) > 2]
    there = set(map(squeezed, source.splitlines()))
    return bool(lines) and sum(line in there for line in lines) >= len(lines) / 2


# -------------------------------------------------------------------------------- definitions, as text


PROMPT = r"(?:>>>[ \t]*|In \[\d+\]: )?"


def defining(name: str) -> str:
    """A pattern of what defines `name`, from the start of its line: what follows the name tells a def from anything else."""
    name = re.escape(name)
    # [ \t], for \s would run on over empty lines, from every one of them: a cell of nothing else would take for ever
    return rf"(?:async[ \t]+)?def[ \t]+{name}[ \t]*[(\[]|class[ \t]+{name}\b|{name}[ \t]*(?::[^=\n]*)?=[^=]"


def defines(name: str) -> re.Pattern[str]:
    """Where a source seems to define `name` outside of any function."""
    return re.compile(rf"^{PROMPT}(?:{defining(name)})", re.MULTILINE)


def _defined_in(source: str, name: str) -> bool:
    return name in source and bool(defines(name).search(source))  # a long cell that never says the name costs next to nothing


_STUB = re.compile(
    r'(?:async\s+)?def\s+\w+\s*\((?:[^"\'#]|#[^\n]*)*?\)\s*(?:->[^:\n]*)?:\s*'
    r'(?:r?"""(?:[^"]|"(?!""))*"""|r?\'\'\'(?:[^\']|\'(?!\'\'))*\'\'\'|r?"[^"\n]*"|)\s*'
    r"(?:#[^\n]*\n\s*)*raise\s+NotImplementedError\b[^\n]*\s*(?:#[^\n]*\s*)*"
)


@dataclass(frozen=True)
class _Definition:
    first: int
    last: int
    is_stub: bool


def definitions(source: str, name: str, stub: str) -> list[_Definition]:
    """The definitions of `name` in a source, in order, by their lines; whether each is the stub as it was released."""
    if not _defined_in(source, name):
        return []
    pattern = defines(name)
    lines, found = source.split("\n"), []
    for number, line in enumerate(lines):
        if not pattern.match(line):
            continue
        end = number + 1
        while end < len(lines) and (not lines[end].strip() or lines[end][0] in " \t)#"):
            end += 1
        block = "\n".join(lines[number:end])
        decorated = number > 0 and lines[number - 1].lstrip().startswith("@")
        untouched = squeezed(block) == squeezed(stub) or (len(block) <= MAX_STUB and bool(_STUB.fullmatch(block)))
        found.append(_Definition(number, end, untouched and not decorated))
    return found


def _without(source: str, stubs: Iterable[_Definition]) -> str:
    """The source with empty lines in the place of these definitions: all other lines keep their numbers."""
    lines = source.split("\n")
    for one in stubs:
        lines[one.first : one.last] = [""] * (one.last - one.first)
    return "\n".join(lines)


_FENCE = re.compile(r"\s*(```+|~~~+)[ \t]*(?:\{?[\w-]*\}?)[ \t]*(?:python|py)?[^\n]*\n(?P<code>.*?)\n?\1\s*", re.DOTALL)
_CODE_LINE = re.compile(
    r"(?:def |class |import |from \S+ import |@|#[^#]|#$|[A-Za-z_][\w., ]*\s*=[^=]|%|!|async def |\"\"\"|'''|$)"
)


def code_in(text: str, name: str) -> str | None:
    """The Python of a text cell that holds a function `name` and nothing else; None if there is prose in it."""
    fence = _FENCE.fullmatch(text)
    code = fence["code"] if fence else text
    if not re.search(rf"^(?:async[ \t]+)?def[ \t]+{re.escape(name)}[ \t]*\(", code, re.MULTILINE):
        return None
    top = [line for line in code.split("\n") if line[:1] not in (" ", "\t", ")", "]", "}")]
    return code if all(_CODE_LINE.match(line) for line in top) else None


# -------------------------------------------------------------------------------- the repairs


class _Work:
    """One notebook on its way."""

    def __init__(self, notebook: NotebookNode, form: Form) -> None:
        self.form = form
        self.cells = [_copied(cell) for cell in notebook.cells]
        self.metadata = {key: value for key, value in notebook.get("metadata", {}).items() if key == "language_info"}
        self.first: list[str] = []
        self.ambiguous: list[str] = []
        self._notes: dict[str, list[str]] = {}
        known = {*form.stubs, *form.tests, *form.questions}
        self.all_lost = bool(known) and not any(grade_id(cell) in known for cell in self.cells)
        self.text_is_whole = form.texts <= {squeezed(cell.source) for cell in self.cells}  # else prose may be an edited release's

    def note(self, what: str, name: str) -> None:
        self._notes.setdefault(what, []).append(name)

    def result(self) -> Repaired:
        notes = dict(self._notes)
        flags = []
        if self.all_lost and any(what in notes for what in _BY_LOSS):
            flags.append("repaired: the cells had lost their metadata; answers were found by name")
            for what in _BY_LOSS:
                notes.pop(what, None)
        flags += [f"repaired: {what} ({', '.join(dict.fromkeys(names))})" for what, names in notes.items()]
        metadata = self.metadata | ({FIRST: "\n\n".join(self.first)} if self.first else {})
        notebook = NotebookNode(nbformat=4, nbformat_minor=5, metadata=NotebookNode(metadata), cells=self.cells)
        return Repaired(notebook, flags, self.ambiguous)

    def holders(self, name: str) -> list[NotebookNode]:
        return [cell for cell in self.cells if grade_id(cell) == name]

    # ------------------------------------------------------------ checks

    def checks(self) -> None:
        """Each check once, by its mark or by its text; none of them runs, but an answer that was merged with one does."""
        texts = {squeezed(source): name for name, source in self.form.tests.items()}
        for cell in self.cells:
            if cell.cell_type != "code":
                continue
            name = grade_id(cell)
            exercise = self._exercise_in(cell)
            if name in self.form.tests and exercise:
                _mark(cell, exercise if not self.holders(exercise) else None, solution=True)
            if exercise:
                self._merged(cell)
            elif squeezed(cell.source) in texts:
                cell.metadata[AS_RUN] = None
                if not self.holders(texts[squeezed(cell.source)]):
                    _mark(cell, texts[squeezed(cell.source)])
        for name in self.form.tests:
            found = self.holders(name)
            if not found:
                self.note(_CHECK_BACK, name)
            for cell in found:
                cell.metadata[AS_RUN] = None
            for cell in found[1:]:
                _mark(cell, None)
                self.note(_CHECK_TWICE, name)

    def _exercise_in(self, cell: NotebookNode) -> str | None:
        return next((name for name in self.form.stubs if _defined_in(cell.source, name)), None)

    def _merged(self, cell: NotebookNode) -> None:
        """Leave out, of an answer's cell, the lines that are a check's."""
        checks = {squeezed(line) for source in self.form.tests.values() for line in source.splitlines()} - {""}
        lines = cell.source.split("\n")
        kept = ["" if line[:1] not in (" ", "\t") and squeezed(line) in checks else line for line in lines]
        if kept != lines:
            cell.metadata[AS_RUN] = "\n".join(kept)

    # ------------------------------------------------------------ exercises

    def stubs(self) -> None:
        """Each exercise's cell once: the one with the definition that counts."""
        nothing = True
        for name, stub in self.form.stubs.items():
            self._code_again(name)
            held = self.holders(name)
            counting = self._leave_stubs_out(name, stub, held)
            nothing &= not held and counting is None
            if counting is not None and counting in held:
                main: NotebookNode | None = counting
            elif counting is not None and not held and grade_id(counting) is None:
                main = counting
                _mark(main, name, solution=True)
                self.note(_BY_NAME, name)
            else:
                main = held[0] if held else None
                if main is None:
                    self.note(_BY_NAME if counting is not None else _STUB_BACK, name)
            if len(held) > 1:
                self.note(_TWICE_CODE, name)
            for cell in held:
                if cell is not main:
                    _mark(cell, None)
        if nothing and self.form.stubs:
            self.ambiguous.append("no_exercise_found")
            for what in (_STUB_BACK, _CHECK_BACK):
                self._notes.pop(what, None)

    def _code_again(self, name: str) -> None:
        """An answer in a cell that became text is code again, if nothing but code is in it."""
        in_code = any(cell.cell_type == "code" and _defined_in(cell.source, name) for cell in self.cells)
        for cell in self.cells:
            if cell.cell_type == "code" or (grade_id(cell) != name and (in_code or grade_id(cell) is not None)):
                continue
            code = code_in(cell.source, name)
            if code is not None:
                cell.cell_type, cell.source, in_code = "code", code, True
                cell.outputs, cell.execution_count = [], None
                self.note(_CODE_AGAIN, name)

    def _leave_stubs_out(self, name: str, stub: str, held: list[NotebookNode]) -> NotebookNode | None:
        """Let no untouched stub run after an answer; return the cell whose definition counts, None if no cell has one but stubs."""
        found = [
            (cell, one)
            for cell in self.cells
            if cell.cell_type == "code" and cell.metadata.get(AS_RUN, "") is not None
            for one in definitions(cell.source, name, stub)
        ]
        answers = [position for position, (_, one) in enumerate(found) if not one.is_stub]
        if not answers:
            return None
        counting = found[answers[-1]][0]
        after: dict[int, tuple[NotebookNode, list[_Definition]]] = {}
        for cell, one in found[answers[-1] + 1 :]:
            after.setdefault(id(cell), (cell, []))[1].append(one)
        for cell, stubs in after.values():
            cell.metadata[AS_RUN] = _without(cell.metadata.get(AS_RUN, cell.source), stubs)
        if after:
            self.note(_STUB_LEFT, name)
        return counting

    # ------------------------------------------------------------ open questions

    def questions(self) -> None:
        """Each open answer once, whole; where that is not clear, all of its texts, and a person decides."""
        for name, released in self.form.questions.items():
            self._apart(name)
            held = self.holders(name)
            if not held:
                held = self._by_text(released)
                for cell in held:
                    _mark(cell, name, solution=True, grade=True)
                if held:
                    self.note(_BY_TEXT, name)
            if not held:
                self.ambiguous.append(f"missing_cell: {name}")
                continue
            self._one_answer(name, released, held)

    def _one_answer(self, name: str, released: str, held: list[NotebookNode]) -> None:
        if any(cell.cell_type == "code" for cell in held):
            self.note(_TEXT_AGAIN, name)
        for cell in held:
            cell.metadata[AS_RUN] = None
        distinct = list({squeezed(cell.source): cell for cell in reversed(held) if cell.source.strip()}.values())[::-1]
        edited = [cell for cell in distinct if squeezed(cell.source) != squeezed(released)]
        counting = edited or distinct[:1] or held[:1]
        question = _question(released)
        if len(held) > 1:
            if len(counting) == 1:
                self.note(_TWICE_ALIKE, name)
            elif self._adjoin(counting) and _are_parts(counting, question):
                self.note(_JOINED, name)
            else:
                self.ambiguous.append(f"duplicate_cell: {name}")
        keep = counting[0]
        keep.source = "\n\n".join(cell.source.strip("\n") for cell in counting) if len(counting) > 1 else keep.source
        self.cells = [cell for cell in self.cells if cell is keep or not any(cell is other for other in held)]
        self._answer_below(name, released, keep)

    def _adjoin(self, cells: list[NotebookNode]) -> bool:
        """Whether these cells stand one right below the other, as the parts of one that was split do."""
        positions = [number for number, other in enumerate(self.cells) if any(other is cell for cell in cells)]
        return positions[-1] - positions[0] == len(positions) - 1

    def _answer_below(self, name: str, released: str, cell: NotebookNode) -> None:
        """An answer in cells of the learner's own right below the question's, which was left as it is, belongs to it."""
        if squeezed(cell.source) not in (squeezed(released), squeezed(_question(released))) or not self.text_is_whole:
            return
        position = next(number for number, other in enumerate(self.cells) if other is cell) + 1
        below = []
        for other in self.cells[position:]:
            own = other.cell_type == "markdown" and grade_id(other) is None and other.get("id") not in self.form.ids
            if (
                not own
                or squeezed(other.source) in self.form.texts
                or self._is_asked(other)
                or other.source.lstrip().startswith("#")
            ):
                break
            below.append(other)
        if any(other.source.strip() for other in below):
            cell.source = "\n\n".join([cell.source, *(other.source.strip("\n") for other in below)])
            self.cells[position : position + len(below)] = []
            self.note(_BELOW, name)

    def _is_asked(self, cell: NotebookNode) -> bool:
        return any(_contains(cell.source, _question(text)) for text in self.form.questions.values())

    def _by_text(self, released: str) -> list[NotebookNode]:
        """Unmarked cells that hold the question's text, or else lines that are at least half of it."""
        free = [cell for cell in self.cells if grade_id(cell) is None and cell.source.strip() and not self._is_defining(cell)]
        question = _question(released)
        whole = [cell for cell in free if _contains(cell.source, question)]
        return whole or [cell for cell in free if cell.cell_type != "code" and _shares_lines(cell.source, question)]

    def _is_defining(self, cell: NotebookNode) -> bool:
        return cell.cell_type == "code" and self._exercise_in(cell) is not None

    def _apart(self, name: str) -> None:
        """Take the question `name` out of a text cell that it was merged into behind something else."""
        question = _question(self.form.questions[name])
        if self.holders(name):
            return
        merged = [cell for cell in self.cells if grade_id(cell) in self.form.questions and _contains(cell.source, question)]
        if len(merged) != 1 or not (start := _position(merged[0].source, question)):
            return
        cell = merged[0]
        own = _question(self.form.questions[str(grade_id(cell))])
        if (_position(cell.source, own) or 0) > start:
            return  # the other way round: nobody knows where one answer ends
        lower = NotebookNode(cell_type="markdown", source=cell.source[start:], metadata=NotebookNode())
        _mark(lower, name, solution=True, grade=True)
        cell.source = cell.source[:start].rstrip("\n")
        self.cells.insert(next(number for number, other in enumerate(self.cells) if other is cell) + 1, lower)
        self.note(_APART, name)

    # ------------------------------------------------------------ what answers rely on

    def setup(self) -> None:
        """Imports and helpers that were released run, and before the answers, wherever they stand now."""
        sources = [cell.source for cell in self.cells if cell.cell_type == "code"]
        all_text = squeezed("\n".join(sources))
        ids = {cell.get("id") for cell in self.cells}
        for key, source in self.form.setup.items():
            if (
                _RELIED_ON.search(source)
                and key not in ids
                and squeezed(source) not in all_text
                and not any(resembles(one, source) for one in sources)
            ):
                self.first.append(source)
                self.note(_SETUP_BACK, key)
        imports = next(iter(self.form.setup.values()), "")
        for cell in self.cells:
            if cell.cell_type != "code" or cell.metadata.get(AS_RUN, "") is None:
                continue
            if imports and (cell.get("id") in self.form.setup or resembles(cell.source, imports)):
                return
            if self._is_defining(cell):
                break
        below = next(
            (cell for cell in self.cells if cell.cell_type == "code" and imports and resembles(cell.source, imports)), None
        )
        if below is not None and not self._is_defining(below):
            self.first.insert(0, below.source)
            self.note(_SETUP_FIRST, "imports")


_RELIED_ON = re.compile(r"^(?:import|from|def|class)\b", re.MULTILINE)

_CHECK_BACK = "checks were put back"
_CHECK_TWICE = "copies of checks were left out"
_STUB_BACK = "cells were put back as released, without an answer"
_STUB_LEFT = "an untouched stub below the answer was left out"
_BY_NAME = "answers were found by name"
_BY_TEXT = "open answers were found by their question"
_TWICE_CODE = "an answer's cell stands more than once; the last definition counts"
_TWICE_ALIKE = "copies of an open answer were left out"
_CODE_AGAIN = "an answer in a text cell was made code again"
_TEXT_AGAIN = "an open answer in a code cell was made text again"
_JOINED = "the parts of a split open answer were joined"
_BELOW = "an open answer was found in the cell below its question"
_APART = "an open answer was taken out of a merged cell"
_SETUP_BACK = "released cells were put back"
_SETUP_FIRST = "cells that stood below the answers ran first"
_BY_LOSS = (_BY_NAME, _BY_TEXT, _CHECK_BACK)


def _copied(cell: NotebookNode) -> NotebookNode:
    made = NotebookNode(cell)
    made.metadata = NotebookNode(copy.deepcopy(dict(cell.metadata)))
    made.metadata.pop(AS_RUN, None)
    return made


def _mark(cell: NotebookNode, name: str | None, solution: bool = False, grade: bool = False) -> None:
    """Give a cell nbgrader's mark, or take it away."""
    cell.metadata.pop("nbgrader", None)
    if name is not None:
        marks: dict[str, Any] = {"grade_id": name, "solution": solution, "grade": grade or not solution, "locked": not solution}
        cell.metadata["nbgrader"] = NotebookNode(marks)


def _question(released: str) -> str:
    return released.removesuffix(ANSWER_LINE).rstrip()


def _contains(source: str, question: str) -> bool:
    return squeezed(question) in squeezed(source)


def _are_parts(cells: list[NotebookNode], question: str) -> bool:
    """Whether the question runs through these cells once, so that one text was cut into them."""
    whole = "".join(squeezed(cell.source) for cell in cells)
    return whole.count(squeezed(question)) == 1 and not any(_contains(cell.source, question) for cell in cells[1:])


def _position(source: str, question: str) -> int | None:
    """Where the question begins in a source, whatever its blanks."""
    target, start = squeezed(question), squeezed(source).find(squeezed(question))
    if start < 0 or not target:
        return None
    return next(position for count, position in enumerate(_solid(source)) if count == start)


def _solid(source: str) -> Iterator[int]:
    return (position for position, character in enumerate(source) if not character.isspace())


def _shares_lines(source: str, question: str) -> bool:
    text = squeezed(source)
    lines = [line for line in map(squeezed, question.splitlines()) if len(line) > 20]
    return bool(lines) and sum(len(line) for line in lines if line in text) * 2 >= sum(map(len, lines))
