"""Tags the solution cells as training cells, which the judge never runs, and adds tags that runners know. An answer is run
whatever its tags."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import graded, write


def make(folder: Path, notebook: NotebookNode) -> None:
    for one in notebook.cells:
        if one.cell_type == "code" and graded(one):
            one.metadata.tags = ["live", "skip-execution", "raises-exception"]
    write(folder, notebook)
