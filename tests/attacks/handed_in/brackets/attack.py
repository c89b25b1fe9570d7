"""A table of tensors that is nothing but brackets: parsers that recurse run out of stack."""

from pathlib import Path

from tests.attacks.handed_in.toolbox import put


def make(folder: Path) -> None:
    table = b"[" * 200_000
    put(folder, len(table).to_bytes(8, "little") + table)
