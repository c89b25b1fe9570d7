"""Reads address 0 in the last cell: it is left out, and what was defined before counts in full."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write


def make(folder: Path, notebook: NotebookNode) -> None:
    last(notebook, "import ctypes\nctypes.string_at(0)")
    write(folder, notebook)
