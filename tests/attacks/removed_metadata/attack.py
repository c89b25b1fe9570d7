"""Removes all of nbgrader's metadata, as some editors do. Never a graded zero: the answers are found by name and judged as ever."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write


def make(folder: Path, notebook: NotebookNode) -> None:
    for one in notebook.cells:
        one.metadata.pop("nbgrader", None)
    write(folder, notebook)
