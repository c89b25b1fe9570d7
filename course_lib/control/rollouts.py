"""Collecting transitions from vector environments, with the true successor of every step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from gymnasium.vector import AutoresetMode


@dataclass(frozen=True)
class Rollout:
    """T steps of N environments, time-major; `next_obs` is the true successor, never an observation after a reset."""

    obs: torch.Tensor  # (T, N, *obs)
    actions: torch.Tensor  # (T, N, *act), as the policy returned them
    rewards: torch.Tensor  # (T, N)
    next_obs: torch.Tensor  # (T, N, *obs)
    terminated: torch.Tensor  # (T, N) bool
    truncated: torch.Tensor  # (T, N) bool
    last_obs: torch.Tensor  # (N, *obs), what the environments show now: where the next rollout starts


def require_same_step_autoreset(envs):
    """Raise ValueError unless `envs` starts the next episode in the same step in which one ends."""
    mode = envs.metadata.get("autoreset_mode")
    if mode != AutoresetMode.SAME_STEP:
        raise ValueError(
            f"envs must use same-step autoreset, got {mode}: make the vector environment with AutoresetMode.SAME_STEP"
        )


def true_next_obs(obs, info):
    """What each step led to: `obs` as `step` returned it, with `info["final_obs"]` where an episode ended.

    Args:
      obs: (N, *obs), the observations that `step` returned under same-step autoreset.
      info: the info that came with them.

    Returns: (N, *obs) array of its own.
    """
    successors = np.array(obs)
    for i in np.flatnonzero(info.get("_final_obs", ())):
        successors[i] = info["final_obs"][i]
    return successors


def collect(envs, policy, num_steps, obs):
    """Step `envs` num_steps times with `policy`, carrying on where the last rollout stopped.

    Args:
      envs: a vector environment with same-step autoreset.
      policy: obs (N, *obs) float32 tensor -> actions (N, *act) tensor; called without gradient.
      num_steps: T.
      obs: (N, *obs), from `envs.reset` or from the last call.

    Returns: (Rollout in float32, the observations (N, *obs) to start the next rollout from).
    Raises: ValueError if envs resets in another way than in the same step: with Gymnasium's default (next-step) every end of an
      episode is followed by a transition that never happened.
    """
    require_same_step_autoreset(envs)
    columns = []
    for _ in range(num_steps):
        before = torch.as_tensor(obs, dtype=torch.float32)
        with torch.no_grad():
            actions = policy(before)
        obs, rewards, terminated, truncated, info = envs.step(actions.numpy())
        columns.append((before, actions, rewards, true_next_obs(obs, info), terminated, truncated))
    befores, chosen, paid, successors, ends, cuts = zip(*columns, strict=True)
    rollout = Rollout(
        obs=torch.stack(befores),
        actions=torch.stack(chosen),
        rewards=torch.as_tensor(np.stack(paid), dtype=torch.float32),
        next_obs=torch.as_tensor(np.stack(successors), dtype=torch.float32),
        terminated=torch.as_tensor(np.stack(ends)),
        truncated=torch.as_tensor(np.stack(cuts)),
        last_obs=torch.as_tensor(obs, dtype=torch.float32),
    )
    return rollout, obs


class EpisodeReturns:
    """The undiscounted returns of episodes that run across the borders of rollouts."""

    def __init__(self, num_envs):
        self.running = np.zeros(num_envs)

    def add(self, rollout):
        """The returns, in the order of their ends, of the episodes that ended in `rollout`, the next one in time: list of floats."""
        finished = []
        for rewards, ended in zip(rollout.rewards.numpy(), (rollout.terminated | rollout.truncated).numpy(), strict=True):
            self.running += rewards
            if ended.any():
                finished += self.running[ended].tolist()
                self.running[ended] = 0
        return finished
