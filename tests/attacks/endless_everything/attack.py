"""Every exercise loops, and so does a cell: the most that a submission can cost."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import ARGUMENTS, answer, last, write


def make(folder: Path, notebook: NotebookNode) -> None:
    for name in ARGUMENTS:
        answer(notebook, name, "while True:\n    pass")
    last(notebook, "while True:\n    pass")
    write(folder, notebook)
