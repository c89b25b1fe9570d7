"""Deletes the check cell of an exercise, with its points. Such a notebook goes to a person, and its score is provisional."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import graded, write


def make(folder: Path, notebook: NotebookNode) -> None:
    notebook.cells = [one for one in notebook.cells if graded(one) != "test_compute_gae"]
    write(folder, notebook)
