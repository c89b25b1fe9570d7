"""The assignment's folder is a link to another student's. Links are not followed."""

from pathlib import Path

from nbformat import NotebookNode


def make(folder: Path, notebook: NotebookNode) -> None:
    folder.rmdir()
    folder.symlink_to("../honest-1/ch44")
