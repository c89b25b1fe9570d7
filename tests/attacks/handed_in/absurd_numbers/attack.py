"""The largest numbers that there are, with both signs: in single precision their sums are infinite, and differences of those no
numbers. It flies all the same, badly."""

from pathlib import Path

import numpy as np

from tests.attacks.handed_in.toolbox import policy, put, weights


def make(folder: Path) -> None:
    largest = np.finfo(np.float32).max
    signs = {name: np.where(np.arange(tensor.size).reshape(tensor.shape) % 3, 1, -1) for name, tensor in weights().items()}
    changes = {name.replace(".", "__"): (largest * sign).astype(np.float32) for name, sign in signs.items()}
    put(folder, policy(**changes | {"obs_std": np.full(8, np.finfo(np.float32).tiny)}))
