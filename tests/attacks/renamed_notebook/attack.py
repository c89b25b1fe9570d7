"""Hands the notebook in under a browser's name for a second download. It can be nothing else: it is graded, and that is said."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write


def make(folder: Path, notebook: NotebookNode) -> None:
    write(folder, notebook)
    (folder / "ch44.ipynb").rename(folder / "ch44 (1).ipynb")
