"""Two gigabytes that take no space on the disk, until somebody reads them."""

from pathlib import Path

from tests.attacks.handed_in.toolbox import FILE, put


def make(folder: Path) -> None:
    put(folder)
    with open(folder / FILE, "r+b") as file:
        file.truncate(2 << 30)
