"""The appendix with every loss and estimator, to print: written from the docstrings of stubs, which are those of the references.

By rule all exercises are on it that compute something: not the repairs of bug labs (`repaired_…`), nor procedures, which are handed
something that acts or learns (an argument in `ACTORS`), or nothing at all, and are only named. A docstring gives its first paragraph; the
first paragraph that is indented further, which is the formula; and the shapes of arguments and return. What it lacks is said on the page
and on stderr.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from autograder.authoring.chapter import Cell, Chapter

ACTORS = {"policy", "env", "envs", "network"}
INTRODUCTION = """# Cheat sheet

The losses, estimators and statistics that you write in this book. Names lead to the exercises; formulas and shapes are those of the
docstrings there. Printed, this page is a leaflet in two columns."""
HEADING = re.compile(r"^#{2,6} (Exercise \d+\.\d+: .+)$", re.MULTILINE)
_SIZE = r"(?:\*?[A-Za-z]\w*'?(?: [-+] 1)?|\.\.\.)"
SHAPE = re.compile(rf"(?:\(\)|\({_SIZE}(?:,(?: {_SIZE})?)+\))(?: (?:bool|int64)(?: or (?:int64|floating point))?)?")
INDEX = re.compile(
    r"_\{([^}]*)\}"  # anything in braces: s_{t+1}
    r"|(?<=(?<![A-Za-z_])[^\W_])_([A-Za-zα-ω]+|\d)"  # of a single letter: π_old
    r"|(?<=[A-Za-z*'])_([a-z])(?![A-Za-z_])"  # a single letter: terminated_t
)


@dataclass(frozen=True)
class Entry:
    """What the sheet says of one function."""

    name: str
    arguments: str  # with shapes
    returns: str
    says: str
    formula: str

    @property
    def lacks(self) -> str:
        """What is missing in the docstring; empty if nothing is."""
        wanted = {
            "a first sentence": self.says,
            "a formula (a paragraph that is indented further)": self.formula,
            "a paragraph `Returns: …`": self.returns,
        }
        return ", ".join(what for what, found in wanted.items() if not found)


def computes(cell: Cell) -> bool:
    """Whether an exercise is of a function that computes something."""
    return not str(cell.exercise).startswith("repaired_") and not _is_procedure(cell)


def entry(cell: Cell) -> Entry:
    """What the sheet says of an exercise, from its stub."""
    node = _function(cell)
    text = inspect.cleandoc(ast.get_docstring(node) or "")
    head = re.split(r"^(?:Args|Returns|Raises):", text, maxsplit=1, flags=re.MULTILINE)[0]
    says, *others = re.split(r"\n\n(?=\S|    )", head.strip())
    formula = next((_line(paragraph) for paragraph in others if paragraph.startswith("    ")), "")
    return Entry(node.name, ", ".join(_arguments(cell, node, text)), _returns(text), _line(says), formula)


def page(chapters: Sequence[Chapter], pages: Mapping[str, bytes]) -> str:
    """The page, in MyST; `pages` has the staged notebook of each chapter, by path, in which the exercises have got their headings."""
    parts = [INTRODUCTION]
    for chapter in chapters:
        path = f"chapters/{chapter.page}.ipynb"
        places = {name: f"{path}#{_slug(heading)}" for name, heading in _headings(json.loads(pages[path]))}
        if chapter.exercises:
            parts.append(f"## {chapter.number}. {chapter.title}")
        for cell in filter(computes, chapter.exercises):
            found = entry(cell)
            if found.lacks:
                print(
                    f"{chapter.path}:{cell.line}: the docstring of {found.name} lacks {found.lacks}", file=sys.stderr, flush=True
                )
            parts += _shown(found, places[found.name])
        procedures = [f"[`{cell.exercise}`]({places[str(cell.exercise)]})" for cell in chapter.exercises if _is_procedure(cell)]
        if procedures:
            parts.append(f"Procedures: {', '.join(procedures)}.")
    return "\n\n".join(parts) + "\n"


def _shown(found: Entry, place: str) -> Iterator[str]:
    yield f"### [`{found.name}`]({place})"
    yield f":::{{div}} sheet-signature\n`({found.arguments}) → {found.returns}`\n:::"
    yield _typeset(found.says)
    if found.formula:
        yield f":::{{div}} sheet-formula\n{_typeset(found.formula)}\n:::"
    if found.lacks:
        yield f"*Its docstring lacks {_escaped(found.lacks)}.*"


def _typeset(text: str) -> str:
    """Text or a formula in MyST, indices lowered."""
    parts, end = [], 0
    for match in INDEX.finditer(text):
        parts += [_escaped(text[end : match.start()]), f"{{sub}}`{match[1] or match[2] or match[3]}`"]
        end = match.end()
    return "".join([*parts, _escaped(text[end:])]).replace(",   ", ",\N{EM SPACE}")


def _escaped(text: str) -> str:
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)


def _function(cell: Cell) -> ast.FunctionDef:
    return next(node for node in ast.parse(cell.source).body if isinstance(node, ast.FunctionDef))


def _is_procedure(cell: Cell) -> bool:
    is_repair = str(cell.exercise).startswith("repaired_")
    arguments = [argument.arg for argument in _function(cell).args.args]
    return not is_repair and (not arguments or any(name in ACTORS for name in arguments))


def _arguments(cell: Cell, node: ast.FunctionDef, text: str) -> Iterator[str]:
    """Each argument with the shapes that the docstring names, or with its default."""
    shapes: dict[str, str] = {}
    for names, about in re.findall(
        r"^  (\w[\w, ]*): (.*(?:\n {3,}.*)*)", text.partition("Args:\n")[2].partition("\n\n")[0], re.MULTILINE
    ):
        shapes |= dict.fromkeys(names.split(", "), " or ".join(dict.fromkeys(SHAPE.findall(_line(about)))))
    defaults = [None] * (len(node.args.args) - len(node.args.defaults)) + node.args.defaults
    for argument, default in zip(node.args.args, defaults, strict=True):
        shape = f": {shapes[argument.arg]}" if shapes.get(argument.arg) else ""
        equals = " = " if shape else "="
        yield f"{argument.arg}{shape}{f'{equals}{ast.get_source_segment(cell.source, default)}' if default else ''}"


def _returns(text: str) -> str:
    """The first sentence of what is returned, without the remarks behind a semicolon that name no shape."""
    told = _line(text.partition("Returns: ")[2].partition("\nRaises:")[0])
    first, *remarks = told.partition(". ")[0].removesuffix(".").split("; ")
    return "; ".join([first, *(remark for remark in remarks if SHAPE.search(remark))])


def _headings(page: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Of each exercise of a staged page, its name and heading."""
    heading = ""
    for cell in page["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            heading = [heading, *HEADING.findall(source)][-1]
        for tag in cell["metadata"].get("tags", ()):
            if tag.startswith("exercise-"):
                yield tag.removeprefix("exercise-"), heading


def _slug(heading: str) -> str:
    """The anchor that MyST gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def _line(text: str) -> str:
    """Text on one line; gaps between the parts of a formula stay."""
    return re.sub(r"\s*\n\s*", " ", text).strip()
