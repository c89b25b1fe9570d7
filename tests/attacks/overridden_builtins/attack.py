"""Overrides the builtins that a comparison ends in. The judge's builtins are in another process."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write, wrong

SOURCE = """
import builtins
builtins.abs = lambda value: 0
builtins.all = builtins.any = builtins.bool = lambda *args: True
builtins.round = builtins.sum = lambda *args: 2.0
builtins.float = type("float", (float,), {"__eq__": lambda self, other: True, "__hash__": float.__hash__})
builtins.AssertionError = type("Quiet", (Exception,), {})
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook)
    last(notebook, SOURCE)
    write(folder, notebook)
