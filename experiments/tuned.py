"""What earns points in chapter 45's exercise of tuning: sets of trainings with the reference's settings, and with changes that are too few.

A run is a set of eight trainings, as many as the grader makes, from seeds of its own. "ours" are the settings of the reference, and
"elsewhere" the defaults of Stable-Baselines3. The variants with a mistake change nothing of what they find (`broken_nothing`), a single
setting (`broken_only_…`), or the learning rate and the clip range (`broken_two`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from experiments import hover
from experiments.campaign import Report, Result
from solutions import ch45

OURS = ch45.tuned_settings()
SINGLE = ("num_steps", "minibatch_size", "num_epochs", "learning_rate", "clip_range")
CHOSEN: dict[str, Mapping[str, float]] = {
    "ours": OURS,
    "elsewhere": {
        "learning_rate": 3e-4,
        "num_steps": 128,
        "minibatch_size": 64,
        "num_epochs": 10,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "clip_range": 0.2,
        "ent_coef": 0.0,
        "log_std": 0.0,
    },
    "broken_nothing": {},
    "broken_two": {"learning_rate": 3e-3, "clip_range": 0.2},
} | {f"broken_only_{name}": {name: 3e-3 if name == "learning_rate" else OURS[name]} for name in SINGLE}
MISTAKES = {"broken_nothing": "Nothing is changed.", "broken_two": "Only the learning rate and the clip range are changed."} | {
    f"broken_only_{name}": f"Only {name} is changed." for name in SINGLE
}

VARIANTS = {
    variant: hover.configuration(chosen) | ({"mistake": MISTAKES[variant]} if variant in MISTAKES else {})
    for variant, chosen in CHOSEN.items()
}
SEEDS = dict.fromkeys(CHOSEN, 5) | {"ours": 20}


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Make a set of trainings; a run of a second or two keeps no checkpoint."""
    return hover.made(CHOSEN[variant], seed, report)
