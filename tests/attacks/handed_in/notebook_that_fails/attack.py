"""No attack: the notebook exits before it defines anything, and the file beside it flies all the same."""

from pathlib import Path

from tests.attacks.handed_in.toolbox import policy, put

ASSIGNMENT = "ch97"


def make(folder: Path) -> None:
    put(folder, policy(), "import os\nos._exit(0)", solved=False)
