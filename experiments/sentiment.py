"""PPO on a language model with VADER's sentiment as reward, for several weights of the KL penalty (chapter 95).

The policy goes on from the first words of film reviews; what it adds is scored. Every row is one iteration: samples of the policy as
it was then. At the end, and before, texts to prompts that training has not seen are scored apart.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from course_lib import lm
from course_lib.fine_tuning import Taught, TokenPPO, Writer, Writing, openings, train, vader_scores
from experiments.runner import Report, Result
from solutions import ch45, ch95

VARIANTS = {f"kl_{kl_coef}": {"model": "tiny", "kl_coef": kl_coef, "iterations": 40} for kl_coef in (0.0, 0.01, 0.05, 0.2)}
SEEDS = 5
EVALUATION_TEXTS = 256
TAUGHT = Taught.of(vars(ch95), vars(ch45))


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train; texts of the policy before and after to prompts that it has not seen."""
    configuration: dict[str, Any] = dict(VARIANTS[variant])
    policy = lm.load(configuration.pop("model"))
    settings = TokenPPO(**configuration)
    writer = Writer(policy, policy.frozen_copy(), vader_scores, TAUGHT)
    unseen = openings("test")[:EVALUATION_TEXTS]

    def evaluation() -> Writing:
        return writer.write(unseen, settings.new_tokens, torch.Generator().manual_seed(10_000 + seed))

    before = evaluation()
    rows = []
    for row in train(writer, openings("policy"), settings, seed):
        rows.append(row)
        report(len(rows), settings.iterations)
    after = evaluation()
    summary: dict[str, Any] = {
        f"{name}_{when}": value
        for when, writing in (("before", before), ("after", after))
        for name, value in writing.measured(TAUGHT).items()
    }
    summary["gain_in_deviations"] = (summary["score_after"] - summary["score_before"]) / summary["score_std_before"]
    summary["texts"] = [
        {"prompt": prompt, "before": old, "after": new}
        for prompt, old, new in zip(unseen[:12], before.texts, after.texts, strict=False)
    ]
    return Result(rows, summary)
