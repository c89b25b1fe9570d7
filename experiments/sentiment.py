"""PPO on a language model with VADER's sentiment as reward: KL penalties, steps, the ratio, the lab (chapter 95).

The policy goes on from the first words of film reviews; what it adds is scored. Every row is one iteration: samples of the policy as
it was then. At the end, and before, texts to prompts that training has not seen are scored apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from course_lib.language import fine_tuning, lm
from course_lib.language.fine_tuning import Taught, TokenPPO, Writer, Writing, openings, train, vader_scores
from experiments.campaign import Report, Result
from solutions import ch45, ch95

HASTY = TokenPPO(gae_lambda=0.95)
BASE = {"kl_coef": 0.01, "iterations": 24, "learning_rate": 6e-4}
PATIENT = {"iterations": 50, "learning_rate": 2e-4, "gae_lambda": 1.0}
VARIANTS: dict[str, dict[str, Any]] = {
    **{f"kl_{kl_coef}": BASE | {"kl_coef": kl_coef} for kl_coef in (0.0, 0.01, 0.05, 0.2)},
    "kl_0.0_long": BASE | {"kl_coef": 0.0, "iterations": 80},
    "patient": BASE | PATIENT,
    **{f"patient_{kl_coef}": BASE | PATIENT | {"kl_coef": kl_coef} for kl_coef in (0.05, 0.2, 0.0)},
    "whole_credit_0.05": BASE | {"kl_coef": 0.05, "gae_lambda": 1.0},
    "lab_suspect": BASE | {"rewards": "whitened"},
    "lab_repaired": BASE | {"rewards": "scaled"},
    "per_text": BASE | {"rewards": "penalty averaged over the text", "kl_coef": 1.0},
    "ratio_to_reference": BASE | {"update": "ratio to the reference"},
}
SEEDS = 5
EVALUATION_TEXTS = 256
TAUGHT = Taught.of(vars(ch95), vars(ch45))


def averaged_over_the_text(scores, logps, ref_logps, mask, kl_coef):
    """Rewards whose penalties add up to the mean log-ratio of a text's tokens, in place of the sum."""
    count = mask.sum(1, keepdim=True)
    return ch95.kl_penalized_rewards(scores, logps / count, ref_logps / count, mask, kl_coef)


def then(change: Callable) -> Callable:
    """The rewards of chapter 95, brought to another scale by `change(rewards, mask)`."""
    return lambda scores, logps, ref_logps, mask, kl_coef: change(
        ch95.kl_penalized_rewards(scores, logps, ref_logps, mask, kl_coef), mask
    )


def against_the_reference(writer, critic, optimizer, writing, settings, generator):
    """PPO's update with the reference in the ratio, where the policy that sampled belongs."""
    advantages, returns = fine_tuning.estimate(writer, critic, writing, settings)
    mistaken = replace(writing, logps=writing.ref_logps)
    return fine_tuning.improve(writer, critic, optimizer, mistaken, advantages, returns, settings, generator)


REWARDS = {
    "as taught": ch95.kl_penalized_rewards,
    "penalty averaged over the text": averaged_over_the_text,
    "whitened": then(ch95.masked_whiten),
    "scaled": then(ch95.repaired_reward_scaling),
}
UPDATES = {"as taught": fine_tuning.update, "ratio to the reference": against_the_reference}


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train; texts of the policy before and after to prompts that it has not seen."""
    configuration: dict[str, Any] = dict(VARIANTS[variant])
    update = UPDATES[configuration.pop("update", "as taught")]
    taught = replace(TAUGHT, kl_penalized_rewards=REWARDS[configuration.pop("rewards", "as taught")])
    policy, settings = lm.load("tiny"), HASTY.but(**configuration)
    writer = Writer(policy, policy.frozen_copy(), vader_scores, taught)
    unseen = openings("test")[:EVALUATION_TEXTS]

    def evaluation() -> Writing:
        return writer.write(unseen, settings.new_tokens, torch.Generator().manual_seed(10_000 + seed))

    before = evaluation()
    rows = []
    for row in train(writer, openings("policy"), settings, seed, update):
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
