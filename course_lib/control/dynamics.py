"""A small world whose model is known: linear, with noise, and an end."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass
class LinearModel:
    """A linear model of the world, as `imagine` calls it, which counts its calls.

        s' = s W + a V + noise · ε,   reward = -Σ s'² + drift,   the end: the first component of s' leaves ±`limit`

    Args:
      dynamics: W, (O, O).
      control: V, (A, O).
      noise: standard deviation of each component's noise; with 0 nothing is drawn.
      limit: beyond which a trajectory ends.
      drift: added to each reward.
    """

    dynamics: torch.Tensor
    control: torch.Tensor
    noise: float = 0.0
    limit: float = float("inf")
    drift: float = 0.0
    calls: int = 0

    def __call__(self, obs, actions, generator):
        """(next_obs (B, O), rewards (B,), continues (B,) of 0 and 1) of a step from obs (B, O) with actions (B, A)."""
        self.calls += 1
        next_obs = obs @ self.dynamics.to(obs.dtype) + actions @ self.control.to(obs.dtype)
        if self.noise:
            next_obs = next_obs + self.noise * torch.randn(obs.shape, generator=generator, dtype=obs.dtype)
        rewards = self.drift - next_obs.square().sum(-1)
        return next_obs, rewards, (next_obs[:, 0].abs() <= self.limit).to(obs.dtype)


@dataclass
class LinearPolicy:
    """A policy as `imagine` calls it, which counts its calls: a = s K + noise · ε.

    Args:
      gains: K, (O, A).
      noise: standard deviation; with 0 nothing is drawn.
    """

    gains: torch.Tensor
    noise: float = 0.0
    calls: int = 0

    def __call__(self, obs, generator):
        """Actions (B, A) for obs (B, O)."""
        self.calls += 1
        actions = obs @ self.gains.to(obs.dtype)
        return actions + self.noise * torch.randn(actions.shape, generator=generator, dtype=obs.dtype) if self.noise else actions


@dataclass
class FixedNetwork:
    """A network that has learned something, long ago: tanh(inputs W), whose weights W are (inputs, outputs)."""

    weights: torch.Tensor

    def __call__(self, inputs):
        """Outputs (B, outputs) for inputs (B, inputs)."""
        return (inputs @ self.weights.to(inputs.dtype)).tanh()
