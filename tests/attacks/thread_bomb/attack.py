"""The last cell starts threads until no more can be had, so that nothing can be forked any more. Exercises that were complete
before it count."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write

SOURCE = """
import threading, time
while True:
    threading.Thread(target=time.sleep, args=(1000,), daemon=True).start()
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    last(notebook, SOURCE)
    write(folder, notebook)
