"""Ten thousand files beside the notebook: more descriptors than a process may have."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write


def make(folder: Path, notebook: NotebookNode) -> None:
    for number in range(10_000):
        (folder / f"{number:05}.txt").touch()
    write(folder, notebook)
