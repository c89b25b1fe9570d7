"""Recurses without end, first within Python's limit, then far beyond it, into a stack overflow."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
import sys
def down():
    down()
try:
    down()
except RecursionError:
    sys.setrecursionlimit(10**9)
    import ctypes
    callback = ctypes.CFUNCTYPE(None)(lambda: callback())
    callback()
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    write(folder, notebook)
