"""Aborts in the very first cell: it is left out, and all that follows counts."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import first, write


def make(folder: Path, notebook: NotebookNode) -> None:
    first(notebook, "import os\nos.abort()")
    write(folder, notebook)
