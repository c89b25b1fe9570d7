"""How fast chapter 45's PPO is beside Stable-Baselines3's, at equal hyper-parameters, one thread each, back to back.

    python tools/bench_ppo.py [--rounds N] [--record FILE.json]

Both train on LunarLanderContinuous with rl-baselines3-zoo's settings and `render_mode=None`. In each round both collect and learn
from two rollouts of 16 times 1024 steps, after one to warm up. Seconds are processor time: the wall clock of a busy machine says
more about its other users. Ratios are taken within a round, between neighbours in time; the table shows medians over rounds.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import json
import os
import platform
import statistics
import time
from pathlib import Path

import threadpoolctl
import torch
from rich.console import Console
from rich.table import Table
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from course_lib.control.envs import make
from course_lib.control.ppo import ZOO_SETTINGS
from solutions import ch45

ENVIRONMENT, NUM_ENVS, ROLLOUTS = "LunarLanderContinuous-v3", 16, 2


class Stopwatch:
    """Adds up the processor time of functions, by their names."""

    def __init__(self):
        self.spent = {}

    def around(self, owner, name):
        """Replace a function of a module or object by one that is timed."""
        function = getattr(owner, name)

        def timed(*args, **kwargs):
            start = time.process_time()
            result = function(*args, **kwargs)
            self.spent[name] = self.spent.get(name, 0.0) + time.process_time() - start
            return result

        setattr(owner, name, timed)

    def microseconds(self, steps):
        """Processor time of each function per environment step; forgets it."""
        spent, self.spent = self.spent, {}
        return {name: seconds / steps * 1e6 for name, seconds in spent.items()}


def stable_baselines():
    """Rounds of Stable-Baselines3: yields the microseconds per step of its two phases."""
    envs = make_vec_env(ENVIRONMENT, NUM_ENVS, seed=0, env_kwargs={"render_mode": None})
    settings, steps = ZOO_SETTINGS, NUM_ENVS * ZOO_SETTINGS.num_steps
    model = PPO(
        "MlpPolicy", envs, n_steps=settings.num_steps, batch_size=settings.minibatch_size, n_epochs=settings.num_epochs,
        learning_rate=settings.learning_rate, gamma=settings.gamma, gae_lambda=settings.gae_lambda,
        clip_range=settings.clip_range, ent_coef=settings.ent_coef, vf_coef=settings.vf_coef,
        max_grad_norm=settings.max_grad_norm, device="cpu", seed=0,
    )  # fmt: skip
    watch = Stopwatch()
    watch.around(model, "collect_rollouts")
    watch.around(model, "train")
    model.learn(steps)
    while True:
        watch.microseconds(1)
        model.learn(ROLLOUTS * steps, reset_num_timesteps=False)
        phases = watch.microseconds(ROLLOUTS * steps)
        yield {"collect": phases["collect_rollouts"], "update": phases["train"]}


def ours(update):
    """Rounds of chapter 45 with one of its two update functions: yields the microseconds per step of its two phases."""
    envs = make(ENVIRONMENT, NUM_ENVS)
    policy = ch45.policy_for(envs)
    steps = NUM_ENVS * ZOO_SETTINGS.num_steps
    watch = Stopwatch()
    for name in ("collect_rollout", "estimate", update):
        watch.around(ch45, name)
    ch45.train_ppo(envs, ZOO_SETTINGS.but(total_steps=steps), policy=policy, update=getattr(ch45, update))
    while True:
        watch.microseconds(1)
        ch45.train_ppo(envs, ZOO_SETTINGS.but(total_steps=ROLLOUTS * steps), policy=policy, update=getattr(ch45, update))
        phases = watch.microseconds(ROLLOUTS * steps)
        yield {"collect": phases["collect_rollout"], "update": phases["estimate"] + phases[update]}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--record", type=Path, help="also write the result to this JSON file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    threadpoolctl.threadpool_limits(1)  # NumPy's products would otherwise take all cores

    contestants = {
        "Stable-Baselines3": stable_baselines(),
        **{update: ours(update) for update in ("ppo_update", "fast_ppo_update")},
    }
    rounds = [{name: next(phases) for name, phases in contestants.items()} for _ in range(arguments.rounds)]

    table = Table("", "collect", "update", "together", "steps/s", "times as fast")
    for name in contestants:
        phases = {phase: statistics.median(one[name][phase] for one in rounds) for phase in ("collect", "update")}
        ratios = [sum(one["Stable-Baselines3"].values()) / sum(one[name].values()) for one in rounds]
        together = sum(phases.values())
        table.add_row(
            name,
            *(f"{value:.0f} µs" for value in (*phases.values(), together)),
            f"{1e6 / together:.0f}",
            f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})",
        )
    Console(width=100).print(table)
    if arguments.record:
        packages = ("stable-baselines3", "torch", "numpy", "gymnasium")
        record = {
            "date": datetime.date.today().isoformat(),
            "machine": f"{platform.machine()}, {os.cpu_count()} cores",
            "versions": {name: importlib.metadata.version(name) for name in packages},
            "environment": ENVIRONMENT,
            "rounds": rounds,
        }
        arguments.record.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
