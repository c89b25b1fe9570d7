"""Takes memory, in one process and in many, until something gives."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
import os
kept = []
for _ in range(6):
    if os.fork() == 0:
        break
while True:
    try:
        kept.append(b"x" * (256 << 20))
    except MemoryError:
        pass
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    write(folder, notebook)
