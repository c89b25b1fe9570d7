"""A file of a gigabyte that takes no space on the disk, until somebody copies it."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write


def make(folder: Path, notebook: NotebookNode) -> None:
    with open(folder / "weights.pt", "wb") as file:
        file.truncate(1 << 30)
    write(folder, notebook)
