"""Reads chapters/chNN_name.md, a MyST notebook, into a Chapter; whatever the format does not allow is refused by file and line.

The format: front matter (see `FRONT_MATTER`), prose in markdown cells, code cells with a YAML option block (`OPTIONS`). A code
cell with the option `exercise` is a stub; a markdown cell opened by `+++ {"open_question": id, "points": n}` is graded by hand.
What is accepted stands in tables with a line on each entry, which the book prints (autograder.publishing.format_page).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import yaml
from jupytext.myst import MystMetadataParsingError, myst_to_notebook

from autograder import paths
from autograder.authoring import skeleton

ANSWER_LINE = "*Write your answer here.*"


class Option(NamedTuple):
    """Something that a chapter can say: the type of its value, and what it is for, in a line of Markdown."""

    type: type | tuple[type, ...]
    says: str


FRONT_MATTER = {
    "chapter": Option(int, "The chapter's number NN; its file is called `chNN_name.md`."),
    "title": Option(str, "The title, without the number."),
    "minutes": Option(int, "How long a learner needs, exercises included."),
    "prerequisites": Option(list, "The numbers of the chapters to read before this one, all lower; `[]` if there are none."),
    "builds": Option(str, "What the learner will have built, to follow *You will have built:*."),
    "summary": Option(str, "What the chapter is about, for the list on the front page: a sentence or two."),
}
OPTIONAL = {
    "assumes": Option(str, "What one has to know besides these chapters, in a few words, for the list on the front page."),
    "experiments": Option(list, "The experiments whose records the page loads; they are handed out with the notebook."),
}
OPTIONS = {
    "tags": Option(list, "How the cell is run and shown, see below."),
    "exercise": Option(
        str, "Makes the cell the stub of this function: its signature, its docstring and `raise NotImplementedError`."
    ),
    "difficulty": Option(int, "Of an exercise: 1, 2 or 3."),
    "minutes": Option(int, "Of an exercise: how long it takes."),
    "alt": Option(
        str, "What the cell's picture shows, in words, for those who cannot see it; every cell with a picture needs it."
    ),
}
QUESTION = {
    "open_question": Option(str, "Opens a question that a person grades; the value is its name."),
    "points": Option((int, float), "What the question is worth, above 0."),
}
TAGS = {
    "live": "The cell runs when the book is built, and in learners' notebooks if they wish; never when work is graded. Plots and training.",
    "book-only": "With `live`: learners see what the cell gave, not the cell. For code that holds answers or needs minutes.",
    "full-width": "The output may be as wide as the window.",
    "margin": "The cell stands in the margin.",
    "output_scroll": "A long output scrolls in a box.",
    "raises-exception": "The cell is meant to fail, and the page shows how.",
    "hide-input": "The code is folded; its output is not.",
    "hide-output": "The output is folded.",
    "hide-cell": "Code and output are folded.",
    "remove-input": "The page shows the output alone.",
    "remove-output": "The page shows the code alone.",
    "remove-cell": "The cell runs, and the page does not show it.",
}
_ABOUT_THE_FORMAT = {"jupytext", "kernelspec", "jupyter", "source_map"}
_IDENTIFIER = re.compile(r"[A-Za-z]\w{0,50}")


class ChapterError(ValueError):
    """A chapter breaks the format or the contract of its exercises; the message begins with file:line."""

    def __init__(self, path: Path, line: int, message: str) -> None:
        super().__init__(f"{path}:{line}: {message}")


@dataclass(frozen=True)
class Cell:
    """One cell as its author wrote it; `line` is where its source (markdown) or its fence (code) begins, counted from 1."""

    kind: Literal["markdown", "code"]
    source: str
    line: int
    tags: frozenset[str] = frozenset()
    exercise: str | None = None
    difficulty: int = 0
    minutes: int = 0
    open_question: str | None = None
    points: float = 0.0
    alt: str = ""  # what the figure that the cell draws shows, in words


@dataclass(frozen=True)
class Chapter:
    """One chapter's source: what its front matter says, and its cells in order."""

    number: int
    path: Path
    title: str
    minutes: int
    prerequisites: tuple[int, ...]
    builds: str
    summary: str
    cells: tuple[Cell, ...]
    experiments: tuple[str, ...] = ()  # whose records its pages load
    assumes: str = ""

    @property
    def assignment(self) -> str:
        """The assignment's id, `ch44`."""
        return f"ch{self.number}"

    @property
    def page(self) -> str:
        """The page's name in the book, `ch44_gae`: the source's name without its suffix."""
        return self.path.stem

    @property
    def exercises(self) -> tuple[Cell, ...]:
        """The stub cells."""
        return tuple(cell for cell in self.cells if cell.exercise)

    @property
    def open_questions(self) -> tuple[Cell, ...]:
        """The cells that a teacher grades."""
        return tuple(cell for cell in self.cells if cell.open_question)


def load(name: int | str, directory: Path | None = None) -> Chapter:
    """The chapter called 44 or "ch44"; ValueError, with the names that exist, if there is none."""
    assignment = f"ch{name}" if isinstance(name, int) else name
    sources = _sources(directory)
    if assignment not in sources:
        raise ValueError(f"there is no chapter {assignment!r}; there are: {', '.join(sources) or 'none'}")
    return parse(sources[assignment])


def all_chapters(directory: Path | None = None) -> list[Chapter]:
    """Every chapter, in the order of their numbers. Raises ChapterError if one names a prerequisite that does not come before it."""
    chapters = [parse(path) for path in _sources(directory).values()]
    for chapter in chapters:
        before = [other.number for other in chapters if other.number < chapter.number]
        if unknown := [one for one in chapter.prerequisites if one not in before]:
            names = ", ".join(map(str, before)) or "none"
            raise ChapterError(
                chapter.path, 1, f"prerequisites: {unknown[0]!r} is no chapter before this one; those are: {names}"
            )
    return chapters


def page_files(directory: Path | None = None) -> dict[int, Path]:
    """The files of all chapters by number, `{44: …/ch44_gae.md}`: none is read. A page has its file's name."""
    return {int(assignment.removeprefix("ch")): path for assignment, path in _sources(directory).items()}


def _sources(directory: Path | None) -> dict[str, Path]:
    directory = directory or paths.checkout() / "chapters"
    found: dict[int, Path] = {}
    for path in sorted(directory.glob("ch*_*.md")):
        if match := re.match(r"ch(\d+)_", path.name):
            number = int(match[1])
            if number in found:
                raise ChapterError(path, 1, f"{found[number].name} is chapter {number}, too")
            found[number] = path
    return {f"ch{number}": found[number] for number in sorted(found)}


def parse(path: Path) -> Chapter:
    """Read one chapter. Raises ChapterError at the first thing that the format does not allow."""
    text = path.read_text(encoding="utf-8")
    try:
        notebook = myst_to_notebook(text, add_source_map=True)
    except (MystMetadataParsingError, yaml.YAMLError) as error:
        raise ChapterError(path, 1, f"unreadable options: {error}") from error
    front = {key: value for key, value in notebook.metadata.items() if key not in _ABOUT_THE_FORMAT}
    _expect(path, 1, "front matter", front, FRONT_MATTER | OPTIONAL, required=set(FRONT_MATTER))
    if not path.name.startswith(f"ch{front['chapter']}_"):
        raise ChapterError(path, 1, f"chapter {front['chapter']} must lie in a file called ch{front['chapter']}_*.md")
    lines = text.splitlines()
    located = zip(notebook.cells, notebook.metadata.source_map, strict=True)
    cells = tuple(_cell(path, cell, start, lines) for cell, start in located)
    return Chapter(
        front["chapter"],
        path,
        front["title"],
        front["minutes"],
        tuple(front["prerequisites"]),
        front["builds"],
        front["summary"],
        cells,
        tuple(front.get("experiments", ())),
        front.get("assumes", ""),
    )


def _cell(path: Path, cell: Any, start: int, lines: list[str]) -> Cell:
    """One notebook cell of jupytext's as a Cell; `start` is jupytext's line, before any blank lines that it has dropped."""
    options = dict(cell.metadata)
    if cell.cell_type == "code":
        _expect(path, start, "code cell", options, OPTIONS)
        tags = frozenset(options.pop("tags", ()))
        if unknown := tags - TAGS.keys():
            raise ChapterError(path, start, f"unknown tag {sorted(unknown)[0]!r}; known: {', '.join(sorted(TAGS))}")
        if "book-only" in tags and "live" not in tags:
            raise ChapterError(path, start, "a book-only cell is never run by the judge: tag it live, too")
        if "exercise" in options:
            _stub_options(path, start, tags, options)
        elif options.keys() & {"difficulty", "minutes"}:
            raise ChapterError(path, start, "difficulty and minutes belong to a cell with the option `exercise`")
        source = cell.source
        if "exercise" in options and not source.strip():
            try:
                source = skeleton.stub(paths.ROOT / "solutions" / f"{path.name.partition('_')[0]}.py", options["exercise"])
            except ValueError as error:
                raise ChapterError(path, start, f"the stub is empty, to be made from its reference, but {error}") from error
        return Cell("code", source, start, tags, **options)
    if cell.cell_type != "markdown":
        raise ChapterError(path, start, f"a {cell.cell_type} cell is not used here")
    while not lines[start].strip():
        start += 1
    _expect(path, start + 1, "markdown cell", options, QUESTION, required=set(QUESTION) if options else set())
    if options and (options["points"] <= 0 or not _IDENTIFIER.fullmatch(options["open_question"])):
        raise ChapterError(path, start + 1, "an open question needs points above 0 and a plain identifier as its name")
    if options and cell.source.split("\n")[-1] != ANSWER_LINE:
        raise ChapterError(path, start + 1, f"an open question ends with the line {ANSWER_LINE}")
    return Cell("markdown", cell.source, start + 1, **options)


def _stub_options(path: Path, line: int, tags: frozenset[str], options: dict[str, Any]) -> None:
    if tags:
        raise ChapterError(path, line, "an exercise's cell takes no tags")
    if not _IDENTIFIER.fullmatch(options["exercise"]):
        raise ChapterError(path, line, f"exercise: {options['exercise']!r} is not a function's name")
    if options.get("difficulty") not in (1, 2, 3) or options.get("minutes", 0) < 1:
        raise ChapterError(path, line, "an exercise needs difficulty: 1, 2 or 3, and minutes: at least 1")


def _expect(
    path: Path, line: int, where: str, found: dict[str, Any], known: dict[str, Option], required: set[str] | None = None
) -> None:
    """Refuse missing and unknown keys, and values of another type."""
    if unknown := found.keys() - known.keys():
        raise ChapterError(path, line, f"unknown option {sorted(unknown)[0]!r} in a {where}; known: {', '.join(known)}")
    if missing := (required or set()) - found.keys():
        raise ChapterError(path, line, f"{where} lacks {', '.join(sorted(missing))}")
    for key, value in found.items():
        if not isinstance(value, known[key].type) or isinstance(value, bool):
            raise ChapterError(path, line, f"{key}: {value!r} in a {where} has the wrong type")
