"""A link to the file of another student."""

from pathlib import Path

from tests.attacks.handed_in.toolbox import FILE, put


def make(folder: Path) -> None:
    put(folder, None)
    (folder / FILE).symlink_to(Path("..", "..", "honest-1", folder.name, FILE))
