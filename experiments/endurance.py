"""SAC with Spinning Up's settings on Hopper, Walker2d and HalfCheetah for 300,000 steps, a third of the usual million, five seeds each.

The settings are the `published` ones of experiments/walker.py, the same for all three tasks, as in Spinning Up's own benchmark; only the
number of steps is another, so that up to where a run of that experiment ends, a run of the same seed on Walker2d goes the same way.
"""

from __future__ import annotations

from pathlib import Path

from experiments.campaign import Report, Result
from experiments.control import CHUNK, ENVIRONMENTS, configuration, followed
from experiments.walker import CHOICES, Run, settings

TASKS = ("walker2d", "halfcheetah", "hopper")
CHOICE = CHOICES["published"]
SETTINGS = {f"sac_{task}": settings(task, CHOICE).but(total_steps=300_000) for task in TASKS}
VARIANTS = {f"sac_{task}": configuration("sac", task, SETTINGS[f"sac_{task}"]) | CHOICE for task in TASKS}
SEEDS = 5


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train one agent and evaluate it on the way."""
    task = variant.removeprefix("sac_")
    made = Run(task, SETTINGS[variant], CHOICE, seed)
    return followed(made, ENVIRONMENTS[task], VARIANTS[variant]["every"], CHUNK["sac"], checkpoint_dir, report)
