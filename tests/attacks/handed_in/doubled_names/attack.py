"""A table that names a tensor twice, first with the right shape and then with another: two parsers may see two files."""

from pathlib import Path

from tests.attacks.handed_in.toolbox import policy, put


def make(folder: Path) -> None:
    content = policy()
    length = int.from_bytes(content[:8], "little")
    table = content[8 : 8 + length].rstrip()
    table = table[:-1] + b',"log_std":{"dtype":"F32","shape":[1000000000],"data_offsets":[0,4000000000]}}'
    put(folder, len(table).to_bytes(8, "little") + table + content[8 + length :])
