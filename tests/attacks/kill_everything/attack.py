"""Kills every process it may: only its own sandbox's."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
import contextlib
import os
import time
with contextlib.suppress(ProcessLookupError):  # once all others are dead and buried
    os.kill(-1, 9)
time.sleep(2)  # without its first process the sandbox ends, and with it this one, but not within the same microsecond
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    write(folder, notebook)
