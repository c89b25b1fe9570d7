"""SAC on Walker2d with Spinning Up's settings for it, and with each of them put back to chapter 48's: which of them makes the difference.

The four settings in which Spinning Up's SAC, https://spinningup.openai.com/en/latest/algorithms/sac.html, departs from
experiments/control.py are its learning rate, its fixed temperature, its minibatches of 100 and its updates from step 1,000 on, while
actions are still drawn evenly. `published` has all four, `without_NAME` all but one, `only_NAME` that one alone. Its updates in blocks of
50, as many as steps, are here one after each step. Protocol and rows are those of experiments/control.py, where the settings with none of
the four are `sac_walker2d`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym

from course_lib.control import sac
from experiments.campaign import Report, Result
from experiments.control import CHUNK, ENVIRONMENTS, SAC_SETTINGS, SACRun, configuration, followed
from solutions import ch47, ch48

PLACE = "walker2d"
OURS: dict[str, Any] = {"learning_rate": 3e-4, "initial_alpha": 1.0, "adapts": True, "batch_size": 256, "updates_from": 10_000}
PUBLISHED: dict[str, dict[str, Any]] = {
    "learning_rate": {"learning_rate": 1e-3},
    "temperature": {"initial_alpha": 0.2, "adapts": False},
    "minibatch": {"batch_size": 100},
    "early_updates": {"updates_from": 1_000},
}


def with_those(names) -> dict[str, Any]:
    """Our settings, and Spinning Up's for what is named."""
    return OURS | {key: value for name in names for key, value in PUBLISHED[name].items()}


CHOICES = {
    "published": with_those(PUBLISHED),
    **{f"without_{left}": with_those(name for name in PUBLISHED if name != left) for left in PUBLISHED},
    **{f"only_{name}": with_those([name]) for name in PUBLISHED},
}


def settings(place: str, choice: dict[str, Any]) -> sac.SACSettings:
    """The settings of experiments/control.py for a task, with what `SACSettings` knows of a choice."""
    names = ("learning_rate", "initial_alpha", "batch_size")
    return SAC_SETTINGS[place].but(**{name: choice[name] for name in names})


VARIANTS = {variant: configuration("sac", PLACE, settings(PLACE, choice)) | choice for variant, choice in CHOICES.items()}
SEEDS = 3


class Early(sac.Training):
    """Learns from step `updates_from` on, also from actions that are still drawn evenly."""

    updates_from = OURS["updates_from"]

    def step(self):
        super().step()
        if self.updates_from < self.env_steps <= self.settings.learning_starts:
            self.latest = self.learn()


class Run(SACRun):
    """A choice's training in one environment, as `followed` advances it."""

    def __init__(self, place: str, chosen: sac.SACSettings, choice: dict[str, Any], seed: int):
        self.settings = chosen
        taught = sac.Taught.of(vars(ch47))
        self.training = Early(gym.make(ENVIRONMENTS[place]), chosen, seed, taught, ch48.fast_sac_update)
        self.training.updates_from = choice["updates_from"]
        if not choice["adapts"]:
            self.training.agent.temperature_optimizer.learning_rate = 0.0
        self.best_action = self.training.agent.best_action


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train one agent and evaluate it on the way."""
    choice = CHOICES[variant]
    made = Run(PLACE, settings(PLACE, choice), choice, seed)
    return followed(made, ENVIRONMENTS[PLACE], VARIANTS[variant]["every"], CHUNK["sac"], checkpoint_dir, report)
