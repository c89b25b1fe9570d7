"""Stops all clocks and the worker's own watch, then loops. The judge has a clock of its own."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import answer, last, write

SOURCE = """
import os, select, signal, time
time.time = time.monotonic = time.perf_counter = lambda: 0.0
select.select = lambda *args: ([1], [], [])
os.kill = signal.alarm = signal.setitimer = lambda *args: None
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    answer(notebook, "explained_variance", "while True:\n    pass")
    last(notebook, SOURCE)
    write(folder, notebook)
