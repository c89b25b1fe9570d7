"""Announces cells without end, so that there is always something to read. The loading time ends all the same."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import CHANNEL, last, write


def make(folder: Path, notebook: NotebookNode) -> None:
    last(notebook, CHANNEL + 'while True:\n    channel.send({"running": 10**9})')
    write(folder, notebook)
