"""What steps of PPO cost where nothing can be won: chapter 95's loop, with scores that are drawn at random.

Every text gets a number of the spread that VADER's scores have, whatever it says. A row is one iteration: samples of the policy as it was
then, with VADER's sentiment of them, which no step has seen.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from course_lib.language import lm, preferences
from course_lib.language.fine_tuning import Writer, openings, train
from experiments import sentiment
from experiments.campaign import Report, Result

VARIANTS: dict[str, dict[str, Any]] = {
    "large_steps": sentiment.BASE | {"spread": 0.34},
    "small_steps": sentiment.BASE | sentiment.PATIENT | {"spread": 0.34},
}
SEEDS = 3


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train on noise."""
    configuration = dict(VARIANTS[variant])
    spread = configuration.pop("spread")
    policy, settings = lm.load("tiny"), sentiment.HASTY.but(**configuration)
    generator, written = torch.Generator().manual_seed(20_000 + seed), []

    def score(samples: lm.Samples) -> torch.Tensor:
        written.append(samples)
        return spread * torch.randn(len(samples.texts), generator=generator)

    rows: list[dict[str, float]] = []
    for row in train(Writer(policy, policy.frozen_copy(), score, sentiment.TAUGHT), openings("policy"), settings, seed):
        rows.append(row | {"sentiment": preferences.vader(written.pop().texts).mean().item()})
        report(len(rows), settings.iterations)
    return Result(rows)
