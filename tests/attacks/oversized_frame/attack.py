"""Returns a hundred megabytes for each case: more than a frame may have."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
big = torch.zeros(100 << 17, dtype=torch.float64)
return big, big
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    write(folder, notebook)
