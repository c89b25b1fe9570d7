"""A folder where the file belongs, with a file in it."""

from pathlib import Path

from tests.attacks.handed_in.toolbox import FILE, policy, put


def make(folder: Path) -> None:
    put(folder, None)
    (folder / FILE).mkdir()
    (folder / FILE / FILE).write_bytes(policy())
