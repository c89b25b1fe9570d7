"""One call seeds every source of randomness."""

import random

import numpy as np
import torch

from course_lib.seeding import seed_everything


def draws():
    generator = seed_everything(7)
    return random.random(), np.random.rand(), torch.rand(1).item(), torch.rand(1, generator=generator).item()


def test_all_sources_repeat():
    assert draws() == draws()
