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
        kept.append(bytearray(32 << 20))
        kept[-1][::4096] = b"x" * len(kept[-1][::4096])
    except MemoryError:
        pass
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    write(folder, notebook)
