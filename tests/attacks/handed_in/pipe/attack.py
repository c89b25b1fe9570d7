"""A named pipe: whoever opens it waits for ever."""

import os
from pathlib import Path

from tests.attacks.handed_in.toolbox import FILE, put


def make(folder: Path) -> None:
    put(folder, None)
    os.mkfifo(folder / FILE)
