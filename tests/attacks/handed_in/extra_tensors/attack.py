"""More tensors than belong there, one with a name of ten thousand letters and markup in it."""

from pathlib import Path

import numpy as np

from tests.attacks.handed_in.toolbox import policy, put


def make(folder: Path) -> None:
    name = "<script>evil()</script>" + "x" * 10_000
    put(folder, policy(**{name: np.zeros(1, np.float32), "\x1b[31m=1+1": np.zeros(1, np.float32)}))
