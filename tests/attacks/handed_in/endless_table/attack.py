"""A table that claims to be longer than any file."""

from pathlib import Path

from tests.attacks.handed_in.toolbox import policy, put


def make(folder: Path) -> None:
    put(folder, b"\xff" * 8 + policy()[8:])
