"""A tree of folders deeper than Python recurses and than a path can be long."""

import os
from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write


def make(folder: Path, notebook: NotebookNode) -> None:
    here = os.open(folder, os.O_RDONLY)
    for _ in range(2500):
        os.mkdir("d", dir_fd=here)
        here, above = os.open("d", os.O_RDONLY, dir_fd=here), here
        os.close(above)
    os.close(here)
    write(folder, notebook)
