"""Announces cell number infinity over the judge's socket: parsing what a worker says may not end the judge. The cell is left
out."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import CHANNEL, last, write


def make(folder: Path, notebook: NotebookNode) -> None:
    last(notebook, CHANNEL + 'channel.send({"running": float("inf")})')
    write(folder, notebook)
