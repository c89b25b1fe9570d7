"""PPO's settings around chapter 45's own, on its task of tuning: a drone in strong gusts, 4,096 steps, a fraction of a second each.

A run is a set of eight trainings: the summary has the mean return that each of the policies flies. "centre" has the settings of chapter
45's lander, with rollouts and minibatches for a sixteenth of the steps and a shorter horizon. The settings tried (`SETTING_VALUE`) are
each one change of it, three values on either side for each of five settings. The ablations (`PARTS`) change what is not to be tuned, too,
some of them at ten times the learning rate; they, and what they are compared with, are three runs each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from course_lib.control import tuning
from course_lib.control.ppo import LANDER_SETTINGS
from experiments.campaign import Report, Result
from solutions import ch45

TRAININGS, FIRST_SEED = 8, 1_000_000
OF_THE_LANDER = ("learning_rate", "num_epochs", "clip_range", "gae_lambda", "ent_coef", "log_std")
CENTRE = {name: getattr(LANDER_SETTINGS, name) for name in OF_THE_LANDER} | {
    "num_steps": 32,
    "minibatch_size": 128,
    "gamma": 0.99,
}
TRIED: dict[str, tuple[float, ...]] = {
    "learning_rate": (1e-4, 2e-4, 5e-4, 2e-3, 5e-3, 1e-2),
    "clip_range": (0.05, 0.1, 0.15, 0.3, 0.4, 0.8),
    "gae_lambda": (0.0, 0.5, 0.9, 0.99, 0.995, 1.0),
    "minibatch_size": (32, 64, 96, 192, 256, 512),
    "num_epochs": (1, 3, 5, 13, 16, 20),
}
CHOSEN: dict[str, Mapping[str, float]] = {"centre": CENTRE} | {
    f"{name}_{value:g}": {**CENTRE, name: value} for name, values in TRIED.items() for value in values
}
INFINITE = float("inf")
FAST = {"learning_rate": 1e-2}
PARTS: dict[str, Mapping[str, float]] = {
    "no_clip": {"clip_range": INFINITE},
    "no_normalisation": {"normalize_advantages": False},
    "entropy_bonus": {"ent_coef": 0.01},
    "value_loss_0": {"vf_coef": 0.0},
    "value_loss_0.05": {"vf_coef": 0.05},
    "value_loss_5": {"vf_coef": 5.0},
    "no_norm_bound": {"max_grad_norm": INFINITE},
    "value_loss_0.05_no_norm_bound": {"vf_coef": 0.05, "max_grad_norm": INFINITE},
    "value_loss_5_no_norm_bound": {"vf_coef": 5.0, "max_grad_norm": INFINITE},
    "fast_no_clip": FAST | {"clip_range": INFINITE},
    "fast_target_kl": FAST | {"clip_range": INFINITE, "target_kl": 0.02},
}
COMPARED = ("centre", "learning_rate_0.01", "gae_lambda_0", "gae_lambda_1")


def configuration(chosen: Mapping[str, float], changes: Mapping[str, float] | None = None) -> dict:
    """What a record says of a set of trainings with these settings."""
    about = {"trainings": TRAININGS, "drones": tuning.DRONES, "gust": tuning.GUST}
    settings = asdict(tuning.tuned(chosen).but(**changes or {}))
    return about | {name: "infinity" if value == INFINITE else value for name, value in settings.items()}


VARIANTS = {variant: configuration(chosen) for variant, chosen in CHOSEN.items()}
VARIANTS |= {variant: configuration(CENTRE, changes) for variant, changes in PARTS.items()}
SEEDS = dict.fromkeys(VARIANTS, 1) | dict.fromkeys((*PARTS, *COMPARED), 3)


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Make a set of trainings; a run of a second or two keeps no checkpoint."""
    return made(CHOSEN.get(variant, CENTRE), seed, report, PARTS.get(variant))


def made(chosen: Mapping[str, float], seed: int, report: Report, changes: Mapping[str, float] | None = None) -> Result:
    """Eight trainings, no two of them with one seed; `changes` may be of settings that are not to be tuned."""
    rows: list[dict] = []
    settings = tuning.tuned(chosen).but(**changes or {})
    for number in range(TRAININGS):
        (value,), told = tuning.trainings(_train, settings, [FIRST_SEED + TRAININGS * seed + number])
        rows.append({"training": number, "mean_return": float(value)} | told)
        report(number + 1, TRAININGS)
    return Result(rows, {"eval_returns": [round(row["mean_return"], 3) for row in rows]})


def _train(envs, settings, seed, log):
    return ch45.train_ppo(envs, settings, seed, log=log, update=ch45.fast_ppo_update)
