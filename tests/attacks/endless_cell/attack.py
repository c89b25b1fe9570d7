"""The last cell loops. It is left out once its time is up, and what was defined before counts in full."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write


def make(folder: Path, notebook: NotebookNode) -> None:
    last(notebook, "while True:\n    pass")
    write(folder, notebook)
