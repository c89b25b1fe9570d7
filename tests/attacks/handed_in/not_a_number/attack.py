"""One weight is no number, in the critic, which does not fly: comparisons with it are all false, and clipping keeps it."""

from pathlib import Path

import numpy as np

from tests.attacks.handed_in.toolbox import policy, put


def make(folder: Path) -> None:
    put(folder, policy(critic__1__bias=np.full(64, np.nan, np.float32)))
