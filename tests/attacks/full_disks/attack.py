"""Fills every folder that can be written. Their sizes are limited, and nothing that the judge needs lies there."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write

SOURCE = """
for folder in ("/work", "/tmp", "/dev/shm"):
    for number in range(10):
        try:
            with open(f"{folder}/{number}", "wb") as file:
                while True:
                    file.write(bytes(1 << 20))
        except OSError:
            pass
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    last(notebook, SOURCE)
    write(folder, notebook)
