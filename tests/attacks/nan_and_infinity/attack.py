"""Returns NaN and infinities: every comparison written as `not (difference > tolerance)` lets them pass."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
return torch.full_like(rewards, float("nan")), torch.full_like(rewards, float("inf"))
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    write(folder, notebook)
