"""Carries the hidden inputs out in the text of an exception, to solve them at home. At most 2 KB of it arrive, which is less
than one case."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
raise RuntimeError(repr(locals()) + 'x' * 10**7)
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    write(folder, notebook)
