"""One way to seed everything a run draws from."""

from __future__ import annotations

import random
from dataclasses import InitVar, dataclass, field

import numpy as np
import torch


def seed_everything(seed: int) -> torch.Generator:
    """Seed Python, NumPy and torch, and return a torch generator of the same seed for explicit draws.

    Environments are seeded apart, by `envs.reset(seed=seed)`.
    """
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    return torch.Generator().manual_seed(seed)


def generator(seed: int) -> torch.Generator:
    """A torch generator of its own, for explicit draws."""
    return torch.Generator().manual_seed(seed)


@dataclass(eq=False)
class WatchedGenerator(torch.Generator):
    """A torch generator that knows whether anything has been drawn from it: `drawn`."""

    seed: InitVar[int]
    drawn: bool = field(init=False)

    def __new__(cls, seed):
        return super().__new__(cls)

    def __post_init__(self, seed):
        self.manual_seed(seed)
        self.first_state = self.get_state()

    def __getattr__(self, name):
        if name != "drawn":
            raise AttributeError(name)
        return not torch.equal(self.get_state(), self.first_state)
