"""Stops the worker and waits: the judge must not wait with it. The exercises after it are judged in a fresh one."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import answer, write

BODY = """
import os, signal, time
os.kill(os.getppid(), signal.SIGSTOP)
time.sleep(1000)
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    answer(notebook, "explained_variance", BODY)
    write(folder, notebook)
