"""A standard deviation of zero: normalised observations would be infinite, or no numbers."""

from pathlib import Path

import numpy as np

from tests.attacks.handed_in.toolbox import policy, put


def make(folder: Path) -> None:
    put(folder, policy(obs_std=np.zeros(8, np.float32)))
