"""SAC and PPO on Pendulum: three values of three hyper-parameters for each, and the program of chapter 48's bug lab.

A variant is `sac` or `ppo`, or one of them with one setting changed, such as `sac_learning_rate_0.03`; `lab_suspect` is the lab's
program before its repair (after it, it is `sac`), and `lab_symmetric` has the same fault and a motor of symmetric bounds. Runs take
seconds, so that there are more seeds of the two unchanged settings than elsewhere. Policies are evaluated as in experiments/control.py;
evaluation is not in the processor time that the rows tell.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from course_lib.control import envs, sac
from course_lib.control.policies import policy_for
from course_lib.control.ppo import PPOSettings
from experiments.campaign import Report, Result
from experiments.control import NUM_ENVS, PPO_SETTINGS, evaluate
from solutions import ch45, ch47, ch48

ENVIRONMENT = "Pendulum-v1"
SAC = sac.SACSettings(
    total_steps=5_000,
    learning_starts=500,
    batch_size=64,
    learning_rate=3e-3,
    gamma=0.95,
    tau=0.02,
    hidden=64,
    target_entropy=-1.0,
)
PPO = PPO_SETTINGS["pendulum"].but(total_steps=61_440)
CHANGES: dict[str, dict[str, Any]] = {
    "sac": {},
    "sac_learning_rate_0.0003": {"learning_rate": 3e-4},
    "sac_learning_rate_0.03": {"learning_rate": 3e-2},
    "sac_gamma_0.9": {"gamma": 0.9},
    "sac_gamma_0.99": {"gamma": 0.99},
    "sac_target_entropy_minus_4": {"target_entropy": -4.0},
    "sac_target_entropy_0.5": {"target_entropy": 0.5},
    "ppo": {},
    "ppo_learning_rate_0.0001": {"learning_rate": 1e-4},
    "ppo_learning_rate_0.01": {"learning_rate": 1e-2},
    "ppo_gamma_0.95": {"gamma": 0.95},
    "ppo_gamma_0.99": {"gamma": 0.99},
    "ppo_clip_range_0.05": {"clip_range": 0.05},
    "ppo_clip_range_0.8": {"clip_range": 0.8},
    "lab_suspect": {},
    "lab_symmetric": {},
}
SETTINGS: dict[str, Any] = {
    variant: (PPO if variant.startswith("ppo") else SAC).but(**changes) for variant, changes in CHANGES.items()
}
EVERY = {"sac": 500, "lab": 500, "ppo": 4_096}  # environment steps between evaluations
VARIANTS = {
    variant: {"environment": ENVIRONMENT, "every": EVERY[variant[:3]]}
    | {name: "infinity" if value == float("inf") else value for name, value in asdict(settings).items()}
    for variant, settings in SETTINGS.items()
}
SEEDS = {variant: {"sac": 20, "ppo": 10}.get(variant, 5) for variant in VARIANTS}


KEPT = {"lab_suspect": lambda actions: 0.5 * (actions + 1), "lab_symmetric": lambda actions: 2 * actions}
"""What the lab's buffers hold in place of actions in (-1, 1): commands in [0, 1], or torques in [-2, 2]."""


def updating(variant: str) -> Callable:
    """The update of a variant of SAC; the lab's learns from actions in the units of its motor."""
    if variant not in KEPT:
        return ch48.fast_sac_update

    def update(agent, batch, settings, taught, generator):
        return ch48.fast_sac_update(agent, batch._replace(actions=KEPT[variant](batch.actions)), settings, taught, generator)

    return update


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train one agent and evaluate it on the way; it takes seconds, so that no checkpoint is kept."""
    settings = SETTINGS[variant]
    rows: list[dict[str, Any]] = []
    spent, resumed = 0.0, time.process_time()

    def log(told: dict[str, Any], best_action: Callable) -> None:
        nonlocal spent, resumed
        spent += time.process_time() - resumed
        rows.append(told | {"train_cpu_seconds": spent, "eval_return": float(np.mean(evaluate(best_action, ENVIRONMENT)))})
        report(min(told["env_steps"], settings.total_steps), settings.total_steps)
        resumed = time.process_time()

    if isinstance(settings, PPOSettings):
        world = envs.make(ENVIRONMENT, NUM_ENVS)
        policy = policy_for(world, settings.hidden, settings.log_std, seed)

        def every_other(row: dict[str, float]) -> None:
            if row["env_steps"] % EVERY["ppo"] == 0:
                log({name: value for name, value in row.items() if name != "seconds"}, policy.best_action)

        ch45.train_ppo(world, settings, seed, policy, log=every_other, update=ch45.fast_ppo_update)
    else:
        training = sac.Training(gym.make(ENVIRONMENT), settings, seed, sac.Taught.of(vars(ch47)), updating(variant))
        while training.env_steps < settings.total_steps:
            log(training.advance(EVERY["sac"]), training.agent.best_action)
    return Result(rows, {"final_return": rows[-1]["eval_return"]})
