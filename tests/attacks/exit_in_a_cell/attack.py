"""The last cell ends the worker with status 0. It is left out, and what was defined before counts in full."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write


def make(folder: Path, notebook: NotebookNode) -> None:
    last(notebook, "import os\nos._exit(0)")
    write(folder, notebook)
