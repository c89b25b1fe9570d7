"""Kills every process it may: only its own sandbox's."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
import contextlib
import os
with contextlib.suppress(ProcessLookupError):  # once all others are dead and buried
    os.kill(-1, 9)
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    write(folder, notebook)
