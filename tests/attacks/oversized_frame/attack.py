"""Returns more than seventy megabytes: more than a frame may have."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
if not calls:
    calls.append(1)
    return torch.zeros(9 << 20), torch.zeros(9 << 20)
"""

ABOVE = """
calls = []
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY, ABOVE)
    write(folder, notebook)
