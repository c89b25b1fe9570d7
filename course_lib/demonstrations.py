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
    """A loss for `train_bc`: the mean of (output - action)², whose best constant answer is the actions' mean."""

    def __call__(self, outputs, actions):
        return (outputs - actions).square().mean()


class AbsoluteError:
    """A loss for `train_bc`: the mean of |output - action|, whose best constant answer is the actions' median."""

    def __call__(self, outputs, actions):
        return (outputs - actions).abs().mean()
