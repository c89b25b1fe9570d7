"""A replay buffer: the steps that were made, to be drawn again and again."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch


class Transitions(NamedTuple):
    """B steps. There is no `truncated`: a step that a time limit cut off is a step like any other, and has its true successor."""

    obs: torch.Tensor  # (B, O)
    actions: torch.Tensor  # (B, A)
    rewards: torch.Tensor  # (B,)
    next_obs: torch.Tensor  # (B, O), never the observation after a reset
    terminated: torch.Tensor  # (B,) bool


def made_up(count, obs_dim, action_dim, ended, seed=0) -> Transitions:
    """Steps that nobody made, float32, for checks of an update; a share `ended` of them terminates, by chance."""
    generator = torch.Generator().manual_seed(seed)
    obs, next_obs = torch.randn(2, count, obs_dim, generator=generator)
    actions, rewards = torch.randn(count, action_dim, generator=generator).tanh(), 2 * torch.randn(count, generator=generator)
    return Transitions(obs, actions, rewards, next_obs, torch.rand(count, generator=generator) < ended)


class ReplayBuffer:
    """The last `capacity` steps, float32.

    A step is one row of one matrix, so that drawing a batch is a single operation; what is drawn are views on its columns.

    Args:
      capacity: steps kept, at least 1; then each new one replaces the oldest.
      obs_dim: O.
      action_dim: A.

    Raises: ValueError if capacity is less than 1.
    """

    def __init__(self, capacity, obs_dim, action_dim):
        if capacity < 1:
            raise ValueError(f"capacity must be at least 1, got {capacity}")
        self.widths = (obs_dim, action_dim, 1, obs_dim, 1)
        self.rows = torch.zeros(capacity, sum(self.widths))
        self.added = 0  # steps, ever

    def __len__(self):
        return min(self.added, len(self.rows))

    def add(self, obs, actions, rewards, next_obs, terminated):
        """Keep N steps: tensors or arrays obs, next_obs (N, O), actions (N, A), rewards, terminated (N,).

        Raises: ValueError if there are more of them than the buffer holds.
        """
        count = len(obs)
        if count > len(self.rows):
            raise ValueError(f"obs must have at most {len(self.rows)} rows, the buffer's capacity, got {count}")
        rewards, terminated = (np.asarray(column).reshape(count, 1) for column in (rewards, terminated))
        columns = obs, actions, rewards, next_obs, terminated
        places = np.arange(self.added, self.added + count) % len(self.rows)
        self.rows.numpy()[places] = np.concatenate(columns, axis=1)
        self.added += count

    def sample(self, batch_size, generator) -> Transitions:
        """Steps drawn evenly, with replacement; `generator` is all that is drawn from."""
        return self[torch.randint(len(self), (batch_size,), generator=generator)]

    def __getitem__(self, indices) -> Transitions:
        """The steps at places in the buffer, an int64 tensor (B,)."""
        obs, actions, rewards, next_obs, terminated = self.rows.index_select(0, indices).split(self.widths, 1)
        return Transitions(obs, actions, rewards[:, 0], next_obs, terminated[:, 0] > 0)

    def state_dict(self):
        """What `load_state_dict` needs to fill a buffer of the same capacity."""
        return {"rows": self.rows[: len(self)].clone(), "added": self.added}

    def load_state_dict(self, state):
        """Go on from `state_dict()`."""
        self.rows[: len(state["rows"])] = state["rows"]
        self.added = state["added"]
