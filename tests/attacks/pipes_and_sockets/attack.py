"""A named pipe, a socket and links beside the notebook: opening them would block, or lead elsewhere. They are ignored and
flagged."""

import os
import socket
from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write


def make(folder: Path, notebook: NotebookNode) -> None:
    os.mkfifo(folder / "weights.pt")
    with socket.socket(socket.AF_UNIX) as one:
        here = os.getcwd()
        os.chdir(folder)  # a socket's path is limited to 107 bytes
        one.bind("data.sock")
        os.chdir(here)
    (folder / "loop").symlink_to(folder)
    (folder / "shadow").symlink_to("/etc/shadow")
    write(folder, notebook)
