"""What an expert did, step by step: the data of imitation learning."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Demonstrations:
    """M steps of E episodes, one after another; row m holds what the expert saw and what it did then."""

    obs: torch.Tensor  # (M, O) float32, before the action
    actions: torch.Tensor  # (M, A) float32, as the expert chose them, or (M,) int64 for discrete ones
    episode_ids: torch.Tensor  # (M,) int64: 0, …, 0, 1, …, E - 1
    returns: torch.Tensor  # (E,) float32, undiscounted, in units of reward


class SquaredError:
    """A loss: the mean of (gain · output - action)², for `loss_fn(outputs, actions)`."""

    def __init__(self, gain=1.0):
        self.gain = gain

    def __call__(self, outputs, actions):
        return (self.gain * outputs - actions).square().mean()
