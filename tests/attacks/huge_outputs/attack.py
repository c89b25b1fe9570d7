"""Nineteen megabytes of stored outputs. They are never looked at."""

from pathlib import Path

from nbformat import NotebookNode
from nbformat.v4 import new_output

from tests.attacks.toolbox import cell, write


def make(folder: Path, notebook: NotebookNode) -> None:
    cell(notebook, "test_compute_gae").outputs = [new_output("stream", text="x" * (19 << 20))]
    write(folder, notebook)
