"""Closes every descriptor, the judge's socket among them. The cell is left out."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write


def make(folder: Path, notebook: NotebookNode) -> None:
    last(notebook, "import os\nos.closerange(0, 1000)")
    write(folder, notebook)
