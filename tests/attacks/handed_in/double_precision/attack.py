"""The right tensors in another precision: no attack, but the message must say what to do."""

from pathlib import Path

import numpy as np
import safetensors.numpy

from tests.attacks.handed_in.toolbox import put, weights


def make(folder: Path) -> None:
    put(folder, safetensors.numpy.save({name: tensor.astype(np.float64) for name, tensor in weights().items()}))
