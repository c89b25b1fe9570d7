"""One chapter, three renderings: a page for the book, a notebook for learners, a source notebook for nbgrader.

All renderings are nbformat 4.5 and the same bytes for the same input. Cell ids follow from positions and names, and are the same in
all renderings: `ch44-007` for the chapter's own cells, `ch44-test_compute_gae` for the check after a stub. `outputs` always has one
list of outputs for each code cell of the chapter, in order; a stub's are those of its check. Errors are ChapterErrors that name
file and line.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from nbformat import NotebookNode
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

from autograder.authoring import markdown
from autograder.authoring.bibliography import Bibliography
from autograder.authoring.chapter import ANSWER_LINE, Cell, Chapter, ChapterError
from autograder.authoring.contract import STUB, Reference, Sources, references
from autograder.authoring.contract import sources as real_sources

Outputs = Sequence[list[NotebookNode]]

LEVELS = {1: "●○○ (1 of 3)", 2: "●●○ (2 of 3)", 3: "●●● (3 of 3)"}
_HEADING = re.compile(r"^(#{2,6}) (.+)$", re.MULTILINE)
_ANSI = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")


@dataclass(frozen=True)
class Outline:
    """What a chapter asks for: names and points, in the chapter's order."""

    id: str
    exercises: tuple[tuple[str, float], ...]
    open_questions: tuple[tuple[str, float], ...]


def outline(chapter: Chapter, sources: Sources | None = None) -> Outline:
    """The graded items of a chapter."""
    sources = sources or real_sources(chapter)
    return Outline(
        chapter.assignment,
        tuple((str(cell.exercise), float(sources.exercise(str(cell.exercise)).points)) for cell in chapter.exercises),
        tuple((str(cell.open_question), float(cell.points)) for cell in chapter.open_questions),
    )


def verify(chapter: Chapter, sources: Sources | None = None) -> None:
    """Raise ChapterError unless the chapter keeps its contract: exercises, references and checks agree, and everything renders."""
    sources = sources or real_sources(chapter)
    for_learners(chapter, sources=sources)
    for_book(chapter, [[] for cell in chapter.cells if cell.kind == "code"], sources=sources)


def for_book(chapter: Chapter, outputs: Outputs, with_solutions: bool = True, sources: Sources | None = None) -> NotebookNode:
    """The page as MyST for Jupyter Book (`execute_notebooks: "off"`): stubs, executed outputs, folded references.

    Nothing of a reference is in it if not with_solutions, nor the source of book-only cells, which may hold answers.
    Pages of one book must lie in one folder, as CHAPTER.page + ".ipynb".
    """
    sources = sources or real_sources(chapter)
    solutions = references(chapter, sources)
    executed = _outputs(chapter, outputs)

    def stub(key: str, cell: Cell) -> Iterator[NotebookNode]:
        yield _code(key, cell.source, [f"exercise-{cell.exercise}"])  # a class by which practice in the page finds it
        yield _code(_test_key(chapter, cell), f"check({cell.exercise})", outputs=executed[key])
        if with_solutions:
            yield _markdown(f"{key}-reference", _folded(solutions[str(cell.exercise)]))

    def code(key: str, cell: Cell) -> NotebookNode:
        source = (
            cell.source if with_solutions or "book-only" not in cell.tags else "# The edition with solutions shows this cell."
        )
        if complaint := wordless(cell, executed[key]):
            raise ChapterError(chapter.path, cell.line, complaint)
        node = _code(key, source, cell.tags - {"live", "book-only"}, executed[key])
        if cell.alt:
            node.metadata["mystnb"] = {"image": {"alt": cell.alt}}
        return node

    def question(key: str, cell: Cell, text: str) -> NotebookNode:
        return _markdown(key, text.removesuffix(ANSWER_LINE).rstrip())

    dialect = _dialect(markdown.Book, chapter, sources)
    return _notebook(_page(chapter, sources, dialect, stub, code, question))


def for_learners(chapter: Chapter, outputs: Outputs | None = None, sources: Sources | None = None) -> NotebookNode:
    """The learner's notebook: plain Markdown, stubs, locked checks; what only the book can run, as recorded output.

    Without `outputs` such cells become a sentence that says where to see the result.
    """
    return _notebook_of(chapter, outputs, sources, teacher=False)


def for_nbgrader(chapter: Chapter, outputs: Outputs | None = None, sources: Sources | None = None) -> NotebookNode:
    """nbgrader's source notebook: the learner's notebook with solution regions and hidden tests.

    What `nbgrader generate_assignment` makes of it, under release.write_nbgrader_course's configuration, is the learner's notebook.
    """
    return _notebook_of(chapter, outputs, sources, teacher=True)


def wordless(cell: Cell, outputs: Iterable[NotebookNode]) -> str:
    """What to do about a cell that shows a picture and does not say in words what is on it; empty if there is no such picture."""
    kinds = {kind for output in outputs for kind in output.get("data", {}) if kind.startswith("image/")}
    if not kinds or cell.alt:
        return ""
    return "this cell shows a picture: say with the option `alt: …` what is on it, for readers who cannot see it"


def _notebook_of(chapter: Chapter, outputs: Outputs | None, sources: Sources | None, teacher: bool) -> NotebookNode:
    sources = sources or real_sources(chapter)
    solutions = references(chapter, sources)
    executed = _outputs(chapter, outputs) if outputs is not None else {}

    def stub(key: str, cell: Cell) -> Iterator[NotebookNode]:
        name = str(cell.exercise)
        source, test = cell.source, f"check({name})"
        if teacher:
            reference = solutions[name]
            source = source.removesuffix(STUB) + f"### BEGIN SOLUTION\n{reference.body}\n    ### END SOLUTION"
            call = f'from autograder.publishing.hub import score\nscore("{name}", {name})'
            test += f"\n### BEGIN HIDDEN TESTS\n{call}\n### END HIDDEN TESTS"
        yield _graded(_code(key, source), name, solution=True)
        yield _graded(_code(_test_key(chapter, cell), test), f"test_{name}", points=sources.exercise(name).points)

    def code(key: str, cell: Cell) -> NotebookNode:
        if "book-only" in cell.tags:
            return _recorded(key, cell, executed.get(key, []), chapter)
        node = _code(key, cell.source, cell.tags)
        if cell.tags & {"hide-input", "hide-cell"}:
            node.metadata["jupyter"] = {"source_hidden": True}
        return node

    def question(key: str, cell: Cell, text: str) -> NotebookNode:
        if teacher:
            text = text.removesuffix(ANSWER_LINE) + f"### BEGIN SOLUTION\n{ANSWER_LINE}\n### END SOLUTION"
        return _graded(_markdown(key, text), str(cell.open_question), solution=True, points=cell.points)

    dialect = _dialect(markdown.Plain, chapter, sources)
    return _notebook(_page(chapter, sources, dialect, stub, code, question))


def _page(
    chapter: Chapter,
    sources: Sources,
    dialect: markdown.Dialect,
    stub: Callable[[str, Cell], Iterable[NotebookNode]],
    code: Callable[[str, Cell], NotebookNode],
    question: Callable[[str, Cell, str], NotebookNode],
) -> Iterator[NotebookNode]:
    """The cells of a page in order: what the renderings share, with their own ways to write stubs, code and questions."""
    yield _markdown(f"{chapter.assignment}-front", _render(_front(chapter, sources), dialect, chapter, 1))
    number = 0
    for position, (key, cell) in enumerate(_keyed(chapter)):
        if cell.exercise:
            if chapter.cells[position - 1].kind != "markdown":
                raise _unannounced(chapter, cell)
            yield _markdown(f"{key}-points", _criteria(cell, sources))
            yield from stub(key, cell)
        elif cell.kind == "code":
            yield code(key, cell)
        else:
            text = _render(cell.source, dialect, chapter, cell.line)
            following = chapter.cells[position + 1 : position + 2]
            if following and following[0].exercise:
                number += 1
                text = _introduced(text, following[0], f"{chapter.number}.{number}", chapter)
            if cell.open_question:
                yield question(key, cell, f"**Open question** ({_points(cell.points)}, graded by a person)\n\n{text}")
            else:
                yield _markdown(key, text)
    if dialect.cited:
        yield _markdown(f"{chapter.assignment}-references", f"## References\n\n{dialect.bibliography()}")


def _front(chapter: Chapter, sources: Sources) -> str:
    """The title and the facts under it, in the chapters' own Markdown."""
    before = ", ".join(f"[chapter {number}](chapter:{number})" for number in chapter.prerequisites)
    graded = [f"{len(chapter.exercises)} exercises ({_points(sum(exercise.points for exercise in sources.exercises))})"]
    if chapter.open_questions:
        total = _points(sum(cell.points for cell in chapter.open_questions))
        graded.append(f"open questions for a teacher ({total})")
    lines = [
        f"# {chapter.number}. {chapter.title}\n",
        f"- **Time:** {duration(chapter.minutes)}",
        f"- **Before this:** {before}" if before else "",
        f"- **You will have built:** {chapter.builds}",
        f"- **Graded:** {', '.join(graded)}",
    ]
    return "\n".join(line for line in lines if line)


def _introduced(text: str, stub: Cell, number: str, chapter: Chapter) -> str:
    """The text before a stub, its last heading made that of the exercise, and under it how hard and how long the exercise is."""
    headings = list(_HEADING.finditer(text))
    if not headings:
        raise _unannounced(chapter, stub)
    last = headings[-1]
    facts = f"`{stub.exercise}` · difficulty {LEVELS[stub.difficulty]} · {duration(stub.minutes)}"
    return f"{text[: last.start()]}{last[1]} Exercise {number}: {last[2]}\n\n{facts}{text[last.end() :]}"


def _unannounced(chapter: Chapter, stub: Cell) -> ChapterError:
    message = f"before the stub of {stub.exercise} there must be a text with a heading (### …), which becomes the exercise's"
    return ChapterError(chapter.path, stub.line, message)


def _criteria(cell: Cell, sources: Sources) -> str:
    """What an exercise is worth, and for what."""
    exercise = sources.exercise(str(cell.exercise))
    return f"**{_points(exercise.points)}:** {exercise.terms}"


def _folded(reference: Reference) -> str:
    """A reference without its docstring, which stands in the stub just above, behind a click."""
    return f"::::{{dropdown}} Reference solution\n````python\n{reference.signature}\n{reference.body}\n````\n::::"


def _recorded(key: str, cell: Cell, outputs: list[NotebookNode], chapter: Chapter) -> NotebookNode:
    """What a book-only cell has shown in the book, as a markdown cell: pictures as attachments, text in a fence."""
    parts: list[str] = []
    attachments: dict[str, dict[str, str]] = {}
    for output in outputs:
        data = output.get("data", {})
        if "image/png" in data:
            name = f"{key}-{len(attachments) + 1}.png"
            attachments[name] = {"image/png": data["image/png"].strip()}
            parts.append(f"![{cell.alt or 'recorded figure'}](attachment:{name})")
        elif text := output.get("text", data.get("text/plain", "")).strip():
            parts.append(f"````text\n{_ANSI.sub('', text)}\n````")
    if not parts or any("text/html" in output.get("data", {}) for output in outputs):  # HTML runs scripts that notebooks refuse
        parts.append(f"*See it live on the book's page of chapter {chapter.number}.*")
    node = _markdown(key, "\n\n".join(parts), cell.tags)
    if attachments:
        node["attachments"] = attachments
    return node


def _dialect(kind: type[markdown.Dialect], chapter: Chapter, sources: Sources) -> markdown.Dialect:
    """A dialect that knows the numbers of the chapter's equations."""
    equations: dict[str, str] = {}
    for cell in chapter.cells:
        if cell.kind == "markdown":
            with _located(chapter):
                found = list(markdown.labels(cell.source, cell.line))
            for label, line in found:
                if label in equations:
                    raise ChapterError(chapter.path, line, f"a second equation is labelled {label!r}")
                equations[label] = f"{chapter.number}.{len(equations) + 1}"
    return kind(chapter.assignment, equations, Bibliography(sources.bibliography), sources.pages)


def _render(text: str, dialect: markdown.Dialect, chapter: Chapter, line: int) -> str:
    with _located(chapter):
        return markdown.render(text, dialect, line)


@contextmanager
def _located(chapter: Chapter) -> Iterator[None]:
    """Adds the file's name to the errors of its Markdown."""
    try:
        yield
    except markdown.MarkdownError as error:
        raise ChapterError(chapter.path, error.line, str(error)) from error


def _outputs(chapter: Chapter, outputs: Outputs) -> dict[str, list[NotebookNode]]:
    """The outputs of each code cell, by the cell's id."""
    keys = [key for key, cell in _keyed(chapter) if cell.kind == "code"]
    if len(keys) != len(outputs):
        raise ChapterError(chapter.path, 1, f"there are outputs of {len(outputs)} code cells, but {len(keys)} code cells")
    return dict(zip(keys, outputs, strict=True))


def _keyed(chapter: Chapter) -> Iterator[tuple[str, Cell]]:
    for position, cell in enumerate(chapter.cells):
        yield f"{chapter.assignment}-{position:03d}", cell


def _test_key(chapter: Chapter, cell: Cell) -> str:
    return f"{chapter.assignment}-test_{cell.exercise}"


def _graded(cell: NotebookNode, name: str, *, solution: bool = False, points: float | None = None) -> NotebookNode:
    """Mark a cell for nbgrader: learners edit solutions, and neither edit nor delete checks."""
    cell.metadata["nbgrader"] = {
        "schema_version": 3,
        "grade_id": name,
        "grade": points is not None,
        "solution": solution,
        "locked": not solution,
        "task": False,
        "cell_type": cell.cell_type,
    }
    cell.metadata["deletable"] = False
    if points is not None:
        cell.metadata["nbgrader"]["points"] = float(points)
    if not solution:
        cell.metadata["editable"] = False
    return cell


def _code(key: str, source: str, tags: Iterable[str] = (), outputs: Iterable[NotebookNode] = ()) -> NotebookNode:
    return new_code_cell(source, id=key, metadata=_tagged(tags), outputs=list(outputs))


def _markdown(key: str, source: str, tags: Iterable[str] = ()) -> NotebookNode:
    return new_markdown_cell(source, id=key, metadata=_tagged(tags))


def _tagged(tags: Iterable[str]) -> dict[str, Any]:
    return {"tags": sorted(tags)} if tags else {}


def _notebook(cells: Iterable[NotebookNode]) -> NotebookNode:
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return new_notebook(cells=list(cells), metadata={"kernelspec": kernel, "language_info": {"name": "python"}})


def _points(points: float) -> str:
    return f"{points:g} point{'' if points == 1 else 's'}"


def duration(minutes: int) -> str:
    hours, rest = divmod(minutes, 60)
    words = [f"{hours} hour{'s' * (hours > 1)}"] * (hours > 0) + [f"{rest} minutes"] * (rest > 0)
    return f"about {' '.join(words)}"
