"""Argument checks shared by the course's functions: each error names the argument, the rule and the value received."""

from __future__ import annotations

import torch


def same_shape(**tensors: torch.Tensor) -> None:
    """Raise ValueError unless all tensors have one shape.

    >>> same_shape(rewards=torch.zeros(3, 2), values=torch.zeros(3))
    Traceback (most recent call last):
    ValueError: rewards, values must have one shape, got rewards (3, 2), values (3,)
    """
    if len({tuple(tensor.shape) for tensor in tensors.values()}) > 1:
        shapes = ", ".join(f"{name} {tuple(tensor.shape)}" for name, tensor in tensors.items())
        raise ValueError(f"{', '.join(tensors)} must have one shape, got {shapes}")


def unit_interval(**scalars: float) -> None:
    """Raise ValueError unless every scalar lies in [0, 1].

    >>> unit_interval(gamma=1.5)
    Traceback (most recent call last):
    ValueError: gamma must lie in [0, 1], got 1.5
    """
    for name, value in scalars.items():
        if not 0 <= value <= 1:
            raise ValueError(f"{name} must lie in [0, 1], got {value}")


def at_least_one(**counts: int) -> None:
    """Raise ValueError unless every count is at least 1.

    >>> at_least_one(num_episodes=0)
    Traceback (most recent call last):
    ValueError: num_episodes must be at least 1, got 0
    """
    for name, value in counts.items():
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")


def same_length(**tensors: torch.Tensor) -> None:
    """Raise ValueError unless all tensors have as many rows as each other.

    >>> same_length(obs=torch.zeros(3, 2), actions=torch.zeros(4))
    Traceback (most recent call last):
    ValueError: obs, actions must have as many rows as each other, got obs 3, actions 4
    """
    if len({len(tensor) for tensor in tensors.values()}) > 1:
        lengths = ", ".join(f"{name} {len(tensor)}" for name, tensor in tensors.items())
        raise ValueError(f"{', '.join(tensors)} must have as many rows as each other, got {lengths}")


def non_negative(**scalars: float) -> None:
    """Raise ValueError unless every scalar is at least 0; infinity is.

    >>> non_negative(clip_range=-0.1)
    Traceback (most recent call last):
    ValueError: clip_range must be at least 0, got -0.1
    """
    for name, value in scalars.items():
        if not value >= 0:
            raise ValueError(f"{name} must be at least 0, got {value}")


def positive(**scalars: float) -> None:
    """Raise ValueError unless every scalar is above 0.

    >>> positive(beta=0.0)
    Traceback (most recent call last):
    ValueError: beta must be above 0, got 0.0
    """
    for name, value in scalars.items():
        if not value > 0:
            raise ValueError(f"{name} must be above 0, got {value}")
