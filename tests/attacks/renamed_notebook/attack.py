"""Hands the notebook in under another name, with nothing under the right one: named, and zero points."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write


def make(folder: Path, notebook: NotebookNode) -> None:
    write(folder, notebook)
    (folder / "ch44.ipynb").rename(folder / "ch44 (1).ipynb")
