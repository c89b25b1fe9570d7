"""Hands in two answers under one name, the right one first. The last definition counts, as for anything else, and that is said."""

import copy
from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import cell, write, wrong


def make(folder: Path, notebook: NotebookNode) -> None:
    notebook.cells.append(copy.deepcopy(cell(notebook, "repaired_targets")))
    wrong(notebook)
    notebook.cells[-1], position = cell(notebook, "repaired_targets"), notebook.cells.index(cell(notebook, "repaired_targets"))
    notebook.cells[position] = copy.deepcopy(cell(notebook, "repaired_targets"))
    write(folder, notebook)
