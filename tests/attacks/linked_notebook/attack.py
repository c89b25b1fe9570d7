"""The notebook is a link to a file of the grader's. Links are not followed."""

from pathlib import Path

from nbformat import NotebookNode


def make(folder: Path, notebook: NotebookNode) -> None:
    (folder / "ch44.ipynb").symlink_to("/etc/passwd")
