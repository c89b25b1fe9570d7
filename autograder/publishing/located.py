"""Sphinx's warnings about a staged page, told of the source that its author wrote.

Sphinx reads notebooks made from chapters and counts `cell * 10000 + line` in them. `relocated` names the chapter's own file and line.
What was rewritten on the way (headings, quizzes, citations) is found by the words that the warning quotes, or by its likeness.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import nbformat
from nbformat import NotebookNode

from autograder.authoring.chapter import Cell, Chapter
from autograder.paths import ROOT

_COLOUR = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")
_PLACE = re.compile(r"^(?P<file>\S+?)\.(?P<kind>ipynb|md)(?::(?P<number>\d+))?: ", re.MULTILINE)
_POSITION = re.compile(r"ch\d+-(\d+)(?:-|$)")


def relocated(text: str, stage: Path, chapters: Mapping[str, Chapter]) -> str:
    """`text` without colours, its places in the folder `stage` those of the sources, of chapters by page, "chapters/ch44_gae"."""
    pages = {
        name: (chapter, nbformat.read(stage / f"{name}.ipynb", as_version=4))
        for name, chapter in chapters.items()
        if f"{name}.ipynb" in text
    }
    lines = []
    for line in _COLOUR.sub("", text).replace(f"{stage}/", "").splitlines():
        if match := _PLACE.match(line):
            line = f"{_place(match, line[match.end() :], pages)}: {line[match.end() :]}"
        lines.append(line)
    return "\n".join(lines)


def _place(match: re.Match[str], message: str, pages: Mapping[str, tuple[Chapter, NotebookNode]]) -> str:
    if match["kind"] == "md" or match["file"] not in pages:
        return match[0].removesuffix(": ") if match["file"].startswith("chapters/") else f"book/{match[0]}".removesuffix(": ")
    chapter, notebook = pages[match["file"]]
    source = os.path.relpath(chapter.path, ROOT)
    if match["number"] is None:
        return source
    return f"{source}:{source_line(chapter, notebook, int(match['number']), message)}"


def source_line(chapter: Chapter, notebook: NotebookNode, number: int, message: str) -> int:
    """The chapter's line for Sphinx's number of a place in its notebook."""
    at, line = divmod(number, 10000)
    rendered = notebook.cells[min(max(at, 1), len(notebook.cells)) - 1]
    cell = _cell(chapter, rendered.id)
    if cell is None:  # the head of the page, or its list of references
        return _quoting(message, chapter.path.read_text(encoding="utf-8").split("\n"), 1) or 1
    if cell.kind == "code":
        return cell.line
    source = cell.source.split("\n")
    return _quoting(message, source, cell.line) or cell.line + _like(rendered.source.split("\n"), source, line - 1)


def _cell(chapter: Chapter, key: str) -> Cell | None:
    """The chapter's cell from which a cell of its page was made."""
    if match := _POSITION.match(key):
        return chapter.cells[int(match[1])]
    _, _, name = key.partition("-test_")
    return next((cell for cell in chapter.exercises if cell.exercise == name), None)


def _quoting(message: str, source: Sequence[str], first: int) -> int | None:
    """The only line that has the words that the message quotes, if there is one."""
    for quoted in re.findall(r"['\"‘“`]([^'\"’”`]{3,})['\"’”`]", message):
        plain = re.sub(r"^(?:ch\d+-|eq-ch\d+-)", "", quoted)
        found = [first + at for at, line in enumerate(source) if plain in line]
        if len(found) == 1:
            return found[0]
    return None


def _like(rendered: Sequence[str], source: Sequence[str], line: int) -> int:
    """The line of `source` from which a line of `rendered` was made, both counted from 0."""
    line = min(max(line, 0), len(rendered) - 1)
    if source.count(rendered[line]) == 1:
        return source.index(rendered[line])
    before, after = 0, len(source)  # the lines that are the same in both, on either side
    for block in _blocks(rendered, source):
        if block.a <= line < block.a + block.size and rendered[line].strip():
            return block.b + line - block.a
        if block.a + block.size <= line:
            before = max(before, block.b + block.size)
        elif block.a > line:
            after = min(after, block.b)
    between = range(min(before, len(source) - 1), max(after, before + 1))
    return max((at for at in between if at < len(source)), key=lambda at: _likeness(source[at], rendered[line]), default=0)


def _blocks(rendered: Sequence[str], source: Sequence[str]) -> Iterable[difflib.Match]:
    blocks = difflib.SequenceMatcher(None, rendered, source, autojunk=False).get_matching_blocks()
    return [block for block in blocks if block.size]


def _likeness(one: str, other: str) -> float:
    return difflib.SequenceMatcher(None, one, other, autojunk=False).ratio()
