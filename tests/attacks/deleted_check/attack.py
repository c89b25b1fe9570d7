"""Deletes the check cell of an exercise, with its points. Checks and points come from the release: it is put back, and that is said."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import graded, write


def make(folder: Path, notebook: NotebookNode) -> None:
    notebook.cells = [one for one in notebook.cells if graded(one) != "test_compute_gae"]
    write(folder, notebook)
