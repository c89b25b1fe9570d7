"""A cell of two million empty lines that ends the process: a regular expression that looks for definitions in it would take
hours."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import first, write


def make(folder: Path, notebook: NotebookNode) -> None:
    first(notebook, "import os\nos._exit(1)" + "\n" * 2_000_000)
    write(folder, notebook)
