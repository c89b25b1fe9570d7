"""What attacks with files are made of: the notebook of a chapter of the fixture, a policy that may be handed in, and changes to it."""

from __future__ import annotations

from pathlib import Path

import nbformat
from nbformat.v4 import new_code_cell

from autograder.authoring import assemble, chapter
from tests.autograder.fixtures.flight import course
from tests.autograder.fixtures.flight.course import FILE, policy, weights

__all__ = ["FILE", "policy", "put", "weights"]


def put(folder: Path, content: bytes | None = policy(), first: str = "", solved: bool = True) -> None:
    """Hand in the notebook of the chapter that the folder is named after, with `content` as the policy's file.

    `first` is a cell before all others; `double` is solved, if the chapter has it, unless not `solved`.
    """
    page = chapter.parse(next((course.HERE / "chapters").glob(f"{folder.name}_*.md")))
    notebook = assemble.for_learners(page, sources=course.sources(page))
    for cell in notebook.cells:
        if solved and cell.metadata.get("nbgrader", {}).get("grade_id") == "double":
            cell.source = "def double(x):\n    return x + x"
    if first:
        notebook.cells.insert(0, new_code_cell(first))
    (folder / f"{folder.name}.ipynb").write_text(nbformat.writes(notebook), encoding="utf-8")
    if content is not None:
        (folder / FILE).write_bytes(content)
