"""Leaves a number in the place of the function, for a grader that reads results instead of calling."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import cell, write


def make(folder: Path, notebook: NotebookNode) -> None:
    cell(notebook, "repaired_targets").source = "repaired_targets = 2.0"
    write(folder, notebook)
