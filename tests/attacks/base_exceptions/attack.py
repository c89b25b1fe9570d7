"""Raises what `except Exception` does not catch, with a text that raises in turn. It fails like any other cell."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write

SOURCE = """
class Rude(BaseException):
    def __str__(self):
        raise self
    __repr__ = __str__
raise Rude
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    last(notebook, SOURCE)
    write(folder, notebook)
