"""The last cell leaves a thread that ends the worker a moment later, in the middle of an exercise. Those that were complete
before the cell count."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write

SOURCE = """
import os, threading, time
def later():
    time.sleep(0.01)
    os._exit(0)
threading.Thread(target=later).start()
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    last(notebook, SOURCE)
    write(folder, notebook)
