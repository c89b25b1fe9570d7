"""Takes the `live` tag off the training cells and adds one of its own that loops, tagged so: what the release marks live never
runs."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write


def make(folder: Path, notebook: NotebookNode) -> None:
    for one in notebook.cells:
        one.metadata.pop("tags", None)
    last(notebook, "while True:\n    pass")
    notebook.cells[-1].metadata.tags = ["live"]
    write(folder, notebook)
