"""Returns ten billion numbers that take no memory until somebody copies them."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
return torch.zeros(1).expand(10**10), torch.zeros(1).expand(10**10)
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    write(folder, notebook)
