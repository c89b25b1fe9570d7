"""SAC on Hopper, Walker2d and HalfCheetah for 300,000 steps, a third of the usual million, five seeds each.

Settings, protocol and rows are those of experiments/control.py; only the number of steps is another, so that up to where the runs of
that experiment end, a run of the same task and seed goes the same way.
"""

from __future__ import annotations

from pathlib import Path

from experiments.campaign import Report, Result
from experiments.control import CHUNK, ENVIRONMENTS, SAC_SETTINGS, SACRun, configuration, followed

TASKS = ("hopper", "walker2d", "halfcheetah")
SETTINGS = {f"sac_{task}": SAC_SETTINGS[task].but(total_steps=300_000) for task in TASKS}
VARIANTS = {f"sac_{task}": configuration("sac", task, SETTINGS[f"sac_{task}"]) for task in TASKS}
SEEDS = 5


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train one agent and evaluate it on the way."""
    task = variant.removeprefix("sac_")
    made = SACRun(task, seed, SETTINGS[variant])
    return followed(made, ENVIRONMENTS[task], VARIANTS[variant]["every"], CHUNK["sac"], checkpoint_dir, report)
