"""Half characters, which JSON can hold and no file can, in code, Markdown, metadata, and in an exception's text."""

from pathlib import Path

import nbformat
from nbformat import NotebookNode
from nbformat.v4 import new_markdown_cell

from tests.attacks.toolbox import last, wrong


def make(folder: Path, notebook: NotebookNode) -> None:
    notebook.cells.append(new_markdown_cell("half HALF of a character"))
    last(notebook, "text = 'HALF'\nraise ValueError(text)")
    last(notebook, "raise ValueError(chr(0xD800) + chr(0))")
    wrong(notebook, "raise ValueError(chr(0xDFFF) * 3)")
    notebook.cells[-1].metadata["HALF"] = "HALF"
    (folder / "ch44.ipynb").write_text(nbformat.writes(notebook).replace("HALF", "\\ud800"), encoding="utf-8")
