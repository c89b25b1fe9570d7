"""Chapter 45's task of tuning: a drone in strong gusts, few steps to learn from, and settings that are wrong in several places.

A training takes a fraction of a second, so that many can be compared. What is learned with is handed in: a learner's own `train_ppo`, or
the grader's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from numbers import Real
from typing import Any

import numpy as np

from course_lib.control.envs import HoverVectorEnv
from course_lib.control.ppo import PPOSettings

DRONES, FLIGHTS, STEPS, GUST = 16, 64, 50, 1.0
"""Drones that learn together; flights of the trained policy, steps of one, and the deviation of the gusts."""

START = PPOSettings(
    total_steps=4096,
    num_steps=128,
    minibatch_size=1024,
    num_epochs=2,
    learning_rate=3e-4,
    gamma=0.999,
    gae_lambda=1.0,
    clip_range=0.05,
    ent_coef=0.1,
    log_std=0.5,
)


@dataclass(frozen=True)
class Range:
    """What a setting may be: a number from low to high, whole or not."""

    low: float
    high: float
    whole: bool = False

    def holds(self, value: Any) -> bool:
        """Whether the value lies within."""
        number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
        return number and self.low <= value <= self.high and (not self.whole or float(value).is_integer())

    def __str__(self) -> str:
        return f"{'a whole number' if self.whole else 'a number'} from {self.low:g} to {self.high:g}"


RANGES = {
    "num_steps": Range(8, 256, whole=True),
    "minibatch_size": Range(32, 4096, whole=True),
    "num_epochs": Range(1, 20, whole=True),
    "learning_rate": Range(0, 0.1),
    "gamma": Range(0, 1),
    "gae_lambda": Range(0, 1),
    "clip_range": Range(0, 10),
    "ent_coef": Range(0, 1),
    "log_std": Range(-3, 1),
}
"""What may be tuned. The ranges bound the time of a training; the number of environment steps is given."""


def gusty_drones(num_envs: int = DRONES) -> HoverVectorEnv:
    """The task: HoverVectorEnv in gusts three times as strong as elsewhere."""
    return HoverVectorEnv(num_envs, time_limit=STEPS, gust=GUST)


def tuned(chosen: Mapping[str, Any]) -> PPOSettings:
    """START with the settings that are chosen.

    Raises: ValueError that names what is none of RANGES, or out of its range.
    """
    given = {field.name: getattr(START, field.name) for field in fields(START)}
    changes = {}
    for name, value in chosen.items():
        if name in RANGES:
            if not RANGES[name].holds(value):
                raise ValueError(f"{name} must be {RANGES[name]}, got {value!r:.40}")
            changes[name] = int(value) if RANGES[name].whole else float(value)
        elif name not in given or given[name] != value:  # all of START, with some changed, are its settings, too
            kept = "must stay as it is" if name in given else "is no setting"
            raise ValueError(f"{name:.40} {kept}; to be tuned are {', '.join(RANGES)}")
    return START.but(**changes)


def trainings(train: Callable, settings: PPOSettings, seeds: Iterable[int]) -> tuple[np.ndarray, dict[str, float]]:
    """Train once from each seed, and fly what was trained.

    Args:
      train: chapter 45's `train_ppo(envs, settings, seed, log=…)`.
      settings: PPOSettings.
      seeds: of the trainings.

    Returns: the mean return of 64 flights of each policy, with its likeliest actions, in units of reward, (seeds,); and the means of
      approx_kl, clip_fraction, explained_variance and entropy over all updates of all trainings.
    """
    returns: list[float] = []
    rows: list[dict[str, float]] = []
    with np.errstate(all="ignore"):  # settings may make numbers overflow: such a policy flies badly, and that is all
        for seed in seeds:
            policy = train(gusty_drones(), settings, seed, log=rows.append)
            returns.append(flown(policy))
    names = ("approx_kl", "clip_fraction", "explained_variance", "entropy")
    return np.array(returns), {name: float(np.mean([row.get(name, math.nan) for row in rows] or [math.nan])) for name in names}


def flown(policy: Any) -> float:
    """The mean return of 64 flights, always the same ones; 0 for a policy that acts no numbers."""
    drones = gusty_drones(FLIGHTS)
    obs, total, aloft = drones.reset(seed=2**30)[0], np.zeros(FLIGHTS), np.ones(FLIGHTS, bool)
    for _ in range(STEPS):
        obs, rewards, terminated, truncated, _ = drones.step(policy.best_action(obs).numpy())
        total += np.where(aloft, np.nan_to_num(rewards), 0.0)
        aloft &= ~(terminated | truncated)
    return float(total.mean())
