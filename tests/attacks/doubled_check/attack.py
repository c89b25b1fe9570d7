"""Duplicates a check cell, to be paid twice. Points come from the release: the copy is left out, and that is said."""

import copy
from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import cell, write


def make(folder: Path, notebook: NotebookNode) -> None:
    notebook.cells.append(copy.deepcopy(cell(notebook, "test_compute_gae")))
    write(folder, notebook)
