"""Cells that quit: a naive runner stops at the first and takes the clean exit for success, or loses what was defined before."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write

SOURCES = [
    "import sys\nsys.exit(0)",
    "raise KeyboardInterrupt",
    "raise SystemExit('all tests passed')",
    "raise StopIteration",
    "quit()",
]


def make(folder: Path, notebook: NotebookNode) -> None:
    for source in SOURCES:
        last(notebook, source)
    write(folder, notebook)
