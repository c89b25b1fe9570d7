"""Prints a gigabyte, with the commands that a CI runner obeys. Nothing of it goes anywhere."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write

SOURCE = """
import os, sys
line = "::error::canary-printed " + "x" * 1000
for _ in range(200_000):
    print(line)
    sys.stderr.write(line)
for number in (1, 2):
    os.write(number, b"::set-output name=canary-printed::1" * 1000)
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    last(notebook, SOURCE)
    write(folder, notebook)
