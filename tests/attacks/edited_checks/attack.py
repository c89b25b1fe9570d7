"""Rewrites the checks, raises their points and adds a score to the metadata. Checks and points come from the release."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import graded, write, wrong


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook)
    for one in notebook.cells:
        if (graded(one) or "").startswith("test_"):
            one.source = "print(10.0)\n10.0"
            one.metadata.nbgrader.update(points=1000, max_score=1000, score=1000, locked=False)
    notebook.metadata.nbgrader = {"score": 10, "max_score": 10, "points": 1000}
    write(folder, notebook)
