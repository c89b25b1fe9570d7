"""Implementation details on CartPole: the actor-critic of chapter 44, and the same with one detail changed.

A variant is `page`, the program of the chapter's second experiment as it stands, or that program with what `CHANGES` lists beside its name.
`constant_critic_…` has a critic that says one number of every state. `bad_units` shows the positions (of the cart and of the pole) in
units a hundred times smaller. Observations and rewards are normalised as is usual: by statistics of all steps so far, which go on
changing, and then clipped at ten. The return is that of the task itself.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torch import nn
from torch.distributions import Categorical

from course_lib.control.envs import make
from course_lib.control.rollouts import collect
from course_lib.seeding import seed_everything
from experiments.campaign import Report
from solutions.ch44 import compute_gae, explained_variance, lambda_returns, normalize_advantages

ENVIRONMENT, UPDATES = "CartPole-v1", 20
PAGE: dict[str, Any] = {
    "num_envs": 32,
    "num_steps": 32,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "learning_rate": 1e-2,
    "weights": "normalised",  # or as they are, centred only, divided by their deviation only
    "position_unit": 1.0,
    "normalised_obs": False,  # or with statistics of the observations so far, or of the first so many
    "reward_unit": 1.0,
    "scaled_rewards": False,
    "value_clip": None,
    "recomputed": False,
}
CHANGES: dict[str, dict[str, Any]] = {
    "page": {},
    "advantages_as_they_are": {"weights": "as they are"},
    "advantages_centred": {"weights": "centred"},
    "advantages_divided": {"weights": "divided"},
    "normalised_obs": {"normalised_obs": True},
    "normalised_obs_fixed": {"normalised_obs": 1024},
    "learning_rate_0.003": {"learning_rate": 3e-3},
    "normalised_obs_learning_rate_0.003": {"normalised_obs": True, "learning_rate": 3e-3},
    "bad_units": {"position_unit": 100.0},
    "bad_units_normalised_obs": {"position_unit": 100.0, "normalised_obs": True},
    "scaled_rewards": {"scaled_rewards": True},
    "rewards_100": {"reward_unit": 100.0},
    "rewards_100_scaled": {"reward_unit": 100.0, "scaled_rewards": True},
    "rewards_0.01": {"reward_unit": 0.01},
    "rewards_0.01_scaled": {"reward_unit": 0.01, "scaled_rewards": True},
    "value_clip_0.2": {"value_clip": 0.2},
    "recomputed": {"recomputed": True},
    "gamma_0.9": {"gamma": 0.9},
    "gamma_0.999": {"gamma": 0.999},
    "lambda_1": {"gae_lambda": 1.0},
    "long": {"num_envs": 8, "num_steps": 128},
    "long_lambda_1": {"num_envs": 8, "num_steps": 128, "gae_lambda": 1.0},
    "constant_critic_0": {"constant_critic": 0.0},
    "constant_critic_45": {"constant_critic": 45.0},
}
VARIANTS: dict[str, dict[str, Any]] = {variant: PAGE | changes for variant, changes in CHANGES.items()}
CLOSE = ("page", "advantages_as_they_are", "advantages_centred", "advantages_divided")  # ten seeds do not tell them apart
SEEDS = dict.fromkeys(VARIANTS, 10) | dict.fromkeys((*CLOSE, "constant_critic_0", "constant_critic_45"), 20)
WEIGHTS = {
    "normalised": normalize_advantages,
    "as they are": lambda advantages: advantages,
    "centred": lambda advantages: advantages - advantages.mean(),
    "divided": lambda advantages: advantages / (advantages.std() + 1e-8),
}


class Running:
    """Mean and variance of all rows so far. Chan et al. (1983), https://doi.org/10.1080/00031305.1983.10483115"""

    def __init__(self) -> None:
        self.count, self.mean, self.var = 0, np.zeros(()), np.zeros(())

    def add(self, rows: np.ndarray) -> None:
        """Merge the statistics of `rows`, (B, *shape), into those so far."""
        total = self.count + len(rows)
        apart = rows.mean(0) - self.mean
        self.var = (self.count * self.var + len(rows) * rows.var(0) + apart**2 * self.count * len(rows) / total) / total
        self.mean = self.mean + apart * len(rows) / total
        self.count = total

    def deviation(self) -> np.ndarray:
        """The standard deviation, a little more than zero."""
        return np.sqrt(self.var + 1e-8)


class Seen(gym.vector.VectorWrapper):
    """The environments as the program sees them: in other units, or normalised. True last observations are treated as all others.

    Args:
      envs: CartPole's, with same-step autoreset.
      gamma: discount of the returns by whose deviation rewards are divided.
      position_unit, reward_unit: factors of the two positions, and of all rewards.
      normalised_obs: whether statistics of all observations so far are applied to them, or only of so many, if it is a number.
      scaled_rewards: whether rewards are divided by the deviation of the discounted returns so far.
    """

    def __init__(self, envs, gamma, position_unit=1.0, reward_unit=1.0, normalised_obs=False, scaled_rewards=False):
        super().__init__(envs)
        self.units = np.array([position_unit, 1.0, position_unit, 1.0], dtype=np.float32)
        self.gamma, self.reward_unit = gamma, reward_unit
        self.obs_seen = Running() if normalised_obs else None
        self.learn_from = np.inf if normalised_obs is True else normalised_obs
        self.returns_seen = Running() if scaled_rewards else None
        self.returns = np.zeros(envs.num_envs)

    def shown(self, obs):
        """Observations of any number, by the statistics as they are now."""
        obs = obs * self.units
        if self.obs_seen is None:
            return obs
        return ((obs - self.obs_seen.mean) / self.obs_seen.deviation()).clip(-10, 10).astype(np.float32)

    def learn(self, obs):
        """Let observations count in the statistics, if they are still learned."""
        if self.obs_seen is not None and self.obs_seen.count < self.learn_from:
            self.obs_seen.add(obs * self.units)

    def reset(self, *, seed=None, options=None):
        """Start all episodes."""
        obs, info = self.env.reset(seed=seed, options=options)
        self.learn(obs)
        return self.shown(obs), info

    def step(self, actions):
        """A step; it counts in the statistics before they are applied to it."""
        obs, rewards, terminated, truncated, info = self.env.step(actions)
        self.learn(obs)
        if "final_obs" in info:
            last = [None if one is None else self.shown(one) for one in info["final_obs"]]
            info = info | {"final_obs": last}
        rewards = rewards * self.reward_unit
        if self.returns_seen is not None:
            self.returns = self.gamma * self.returns + rewards
            self.returns_seen.add(self.returns)
            self.returns[terminated | truncated] = 0
            rewards = (rewards / self.returns_seen.deviation()).clip(-10, 10)
        return self.shown(obs), rewards, terminated, truncated, info


def mlp(num_inputs: int, num_outputs: int) -> nn.Module:
    """A network of one hidden layer, as on the page."""
    return nn.Sequential(nn.Linear(num_inputs, 64), nn.Tanh(), nn.Linear(64, num_outputs))


class Constant(nn.Module):
    """A critic that says the same of every state, and never learns."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.value = value

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Observations (*shape, 4) to values (*shape, 1)."""
        return torch.full((*obs.shape[:-1], 1), self.value)


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> list[dict[str, Any]]:
    """Train once; it takes seconds, so that no checkpoint is kept. Rows are updates."""
    with_ = VARIANTS[variant]
    seed_everything(seed)
    recorder = RecordEpisodeStatistics(make(ENVIRONMENT, with_["num_envs"]), buffer_length=30)
    seen = "gamma", "position_unit", "reward_unit", "normalised_obs", "scaled_rewards"
    envs = Seen(recorder, **{name: with_[name] for name in seen})
    obs, _ = envs.reset(seed=seed)
    actor, critic = mlp(4, 2), mlp(4, 1)
    if "constant_critic" in with_:
        critic = Constant(with_["constant_critic"])
    optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=with_["learning_rate"])
    rows = []

    def estimates(rollout):
        """Values, advantages and targets by the critic as it is now."""
        with torch.no_grad():
            values, next_values = critic(rollout.obs).squeeze(-1), critic(rollout.next_obs).squeeze(-1)
        ends = rollout.terminated, rollout.truncated
        advantages = compute_gae(rollout.rewards, values, next_values, *ends, with_["gamma"], with_["gae_lambda"])
        return values, advantages, lambda_returns(advantages, values)

    for update in range(UPDATES):
        rollout, obs = collect(envs, lambda obs: Categorical(logits=actor(obs)).sample(), with_["num_steps"], obs)
        old_values, advantages, returns = estimates(rollout)
        row = {
            "env_steps": (update + 1) * returns.numel(),
            "mean_return": float(np.mean(recorder.return_queue)),
            "explained_variance": explained_variance(old_values, returns).item(),
            "targets_mean": returns.mean().item(),
            "targets_std": returns.std().item(),
        }
        with torch.no_grad():
            old_log_probs = Categorical(logits=actor(rollout.obs)).log_prob(rollout.actions)
        for epoch in range(4):
            if with_["recomputed"] and epoch:
                _, advantages, returns = estimates(rollout)
            weights = WEIGHTS[with_["weights"]](advantages)
            policy = Categorical(logits=actor(rollout.obs))
            ratio = (policy.log_prob(rollout.actions) - old_log_probs).exp()
            policy_loss = -torch.min(ratio * weights, ratio.clamp(0.8, 1.2) * weights).mean()
            values = critic(rollout.obs).squeeze(-1)
            errors = (values - returns).square()
            if with_["value_clip"] is not None:
                near = old_values + (values - old_values).clamp(-with_["value_clip"], with_["value_clip"])
                errors = torch.max(errors, (near - returns).square())
            loss = policy_loss + 0.5 * errors.mean() - 0.01 * policy.entropy().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        rows.append(row)
        report(update + 1, UPDATES)
    return rows
