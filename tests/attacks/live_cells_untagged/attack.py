"""Takes the `live` tag off the released training cells, and puts it on a cell of its own that loops. The released ones are known by
their ids and do not run; the tag protects no added cell, which is dropped when its time is up, and everything else counts."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write


def make(folder: Path, notebook: NotebookNode) -> None:
    for one in notebook.cells:
        one.metadata.pop("tags", None)
    last(notebook, "while True:\n    pass")
    notebook.cells[-1].metadata.tags = ["live"]
    write(folder, notebook)
