"""One way to seed everything a run draws from."""

from __future__ import annotations

import random

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


def noise(rows: int, columns: int, seed: int) -> torch.Tensor:
    """Standard normal numbers, (rows, columns) float32, the same for the same seed."""
    return torch.randn(rows, columns, generator=generator(seed))
