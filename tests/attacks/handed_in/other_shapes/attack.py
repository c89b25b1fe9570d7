"""A network eight times as wide, which the judge would have to trust to be as quick as the course's own."""

from pathlib import Path

import numpy as np

from tests.attacks.handed_in.toolbox import policy, put


def make(folder: Path) -> None:
    put(folder, policy(actor__0__weight=np.zeros((8, 512), np.float32), actor__0__bias=np.zeros(512, np.float32)))
