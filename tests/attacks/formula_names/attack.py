"""A student's name and a folder's that are formulas in a spreadsheet, and a folder whose name no verdict could have. Every
folder gets a verdict, and no cell of a table is a formula."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write

STUDENT = "=cmd|' -C calc'!A0"


def make(folder: Path, notebook: NotebookNode) -> None:
    (folder.parent / "=1+1").mkdir()
    (folder.parent / "ch44\nch45").mkdir()
    write(folder, notebook)
