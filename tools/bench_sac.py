"""How fast SAC, of chapters 47 and 48, is beside Stable-Baselines3's, at equal arithmetic, one thread each, back to back.

    python tools/bench_sac.py [--rounds N] [--steps N] [--record FILE.json]

Both train on Hopper-v5 with batches of 256, two layers of 256 and one update for each step of the environment; a step includes all of
it: acting, the physics, the buffer, the update. The last contestant has two layers of 64 in their place, as PPO has. Seconds are
processor time: the wall clock of a busy machine says more about its other users. Ratios are taken within a round, between neighbours in
time; the table shows medians over rounds.
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

import gymnasium as gym
import threadpoolctl
import torch
from rich.console import Console
from rich.table import Table
from stable_baselines3 import SAC

from course_lib.control import sac
from solutions import ch47, ch48

ENVIRONMENT, WARM_UP = "Hopper-v5", 1_000


def stable_baselines(steps):
    """Rounds of Stable-Baselines3: yields the milliseconds of a step."""
    model = SAC("MlpPolicy", gym.make(ENVIRONMENT), learning_starts=WARM_UP, batch_size=256, device="cpu", seed=0)
    model.learn(WARM_UP + 50)
    while True:
        start = time.process_time()
        model.learn(steps, reset_num_timesteps=False)
        yield (time.process_time() - start) / steps * 1e3


def ours(update, steps, hidden=256):
    """Rounds of SAC with one of its two updates: yields the milliseconds of a step."""
    settings, taught = sac.SACSettings(learning_starts=WARM_UP, hidden=hidden), sac.Taught.of(vars(ch47))
    training = sac.Training(gym.make(ENVIRONMENT), settings, 0, taught, update)
    training.advance(WARM_UP + 50)
    while True:
        start = time.process_time()
        training.advance(steps)
        yield (time.process_time() - start) / steps * 1e3


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=200, help="of each contestant in a round")
    parser.add_argument("--record", type=Path, help="also write the result to this JSON file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    threadpoolctl.threadpool_limits(1)  # NumPy's products would otherwise take all cores

    contestants = {
        "Stable-Baselines3": stable_baselines(arguments.steps),
        "update": ours(sac.update, arguments.steps),
        "fast_sac_update": ours(ch48.fast_sac_update, arguments.steps),
        "the same, 64 wide": ours(ch48.fast_sac_update, arguments.steps, hidden=64),
    }
    rounds = [{name: next(times) for name, times in contestants.items()} for _ in range(arguments.rounds)]

    table = Table("", "a step", "steps/s", "times as fast")
    for name in contestants:
        typical = statistics.median(one[name] for one in rounds)
        ratios = [one["Stable-Baselines3"] / one[name] for one in rounds]
        spread = f"{statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
        table.add_row(name, f"{typical:.1f} ms", f"{1e3 / typical:.0f}", spread)
    Console(width=100).print(table)
    if arguments.record:
        packages = ("stable-baselines3", "torch", "numpy", "gymnasium", "mujoco")
        record = {
            "date": datetime.date.today().isoformat(),
            "machine": f"{platform.machine()}, {os.cpu_count()} cores",
            "versions": {name: importlib.metadata.version(name) for name in packages},
            "environment": ENVIRONMENT,
            "milliseconds_per_step": rounds,
        }
        arguments.record.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
