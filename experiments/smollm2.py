"""The methods of chapters 95 to 97 on a real pretrained model, SmolLM2-135M: PPO with VADER's sentiment, a reward model, DPO.

A few minutes of one core each: few and short texts, and only the network's last layers are trained, which saves half of the time. On a
GPU every number below can be raised. Reading the records needs neither the model nor the package that holds it.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from course_lib import lm, preferences
from course_lib.direct import Pairs, encode_pairs, like_lengths, reference_logps, train_step
from course_lib.fine_tuning import Taught, TokenPPO, Writer, Writing, openings, train, vader_scores
from course_lib.seeding import seed_everything
from experiments.runner import Report, Result
from solutions import ch45, ch95
from solutions.ch96 import last_token_scores, reward_model_loss
from solutions.ch97 import dpo_loss, sequence_logps

MODEL = "smollm2-135m"
VARIANTS: dict[str, dict] = {
    "ppo": {
        "last_layers": 6, "kl_coef": 0.05, "iterations": 12, "batch": 16, "new_tokens": 16, "minibatch": 8, "learning_rate": 2e-4,
    },
    "dpo": {"last_layers": 6, "beta": 0.1, "steps": 20, "batch": 8, "learning_rate": 2e-4},
    "reward_model": {"last_layers": 6, "steps": 48, "batch": 8, "learning_rate": 1e-4, "head_learning_rate": 5e-3},
}  # fmt: skip
SEEDS = 3
WRITTEN, NEW_TOKENS = 24, 16  # texts looked at before and after, to prompts that training has not seen, and their length
RATED = 160  # texts that training has not seen, whose order by their raters is to be found
SHOWN = 12
TAUGHT = Taught.of(vars(ch95), vars(ch45))


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train the last layers, and say what that changed."""
    settings: dict[str, Any] = dict(VARIANTS[variant])
    layers = settings.pop("last_layers")
    method = {"ppo": ppo, "dpo": dpo, "reward_model": reward_model}[variant]
    return method(lm.load(MODEL), layers, settings, seed, report)


def train_last(model: lm.LanguageModel, layers: int) -> None:
    """Freeze all of a network but its last layers and the normalisation behind them; also the head, which is the embedding."""
    body = model.network.base_model
    model.requires_grad_(False)
    for part in (*body.layers[-layers:], body.norm):
        part.requires_grad_(True)


def trained(model: torch.nn.Module) -> list[torch.nn.Parameter]:
    return [parameter for parameter in model.parameters() if parameter.requires_grad]


def optimizer_of(model: torch.nn.Module, learning_rate: float) -> torch.optim.Optimizer:
    return torch.optim.AdamW(trained(model), lr=learning_rate, weight_decay=0.0, fused=True)


def asked(split: str, pairs: int, seed: int) -> preferences.Preferences:
    """Random pairs of a split's film reviews, each ordered by two people, one rater of either text."""
    generator = torch.Generator().manual_seed(seed)
    return preferences.ask_two_raters(preferences.draw_pairs(preferences.load(split), pairs, generator), generator)


# ------------------------------------------------------------------------------------------------------ before and after


def written(writer: Writer, seed: int) -> Writing:
    return writer.write(openings("test")[:WRITTEN], NEW_TOKENS, torch.Generator().manual_seed(10_000 + seed))


def compared(before: Writing, after: Writing) -> dict[str, Any]:
    """What changed in texts to the same prompts, with some of them to read."""
    summary: dict[str, Any] = {
        f"{name}_{when}": value
        for when, writing in (("before", before), ("after", after))
        for name, value in writing.measured(TAUGHT).items()
    }
    summary["texts"] = [
        {"prompt": prompt, "before": old, "after": new}
        for prompt, old, new in list(zip(openings("test"), before.texts, after.texts, strict=False))[:SHOWN]
    ]
    return summary


def unseen(model: lm.LanguageModel) -> Pairs:
    """RATED texts of the test split, two by two."""
    texts = preferences.load("test").texts[:RATED]
    return encode_pairs(model, texts[::2], texts[1::2])


def order_found(scores: torch.Tensor) -> dict[str, float]:
    """How often scores of the `unseen` texts, (RATED / 2, 2), put two of them in the order of their mean ratings; over all pairs."""
    found = preferences.pairwise_accuracy(scores.flatten(), preferences.load("test").means[:RATED])
    return {"accuracy": found.estimate, "accuracy_low": found.low, "accuracy_high": found.high}


# ---------------------------------------------------------------------------------------------------------- the methods


def ppo(policy: lm.LanguageModel, layers: int, settings: dict, seed: int, report: Report) -> Result:
    """Chapter 95: make what the policy adds to the first words of a film review sound positive to VADER."""
    choice = TokenPPO(**settings)
    writer = Writer(policy, policy.frozen_copy(), vader_scores, TAUGHT)
    train_last(policy, layers)
    before = written(writer, seed)
    rows = []
    for row in train(writer, openings("policy"), choice, seed):
        rows.append(row)
        report(len(rows), choice.iterations)
    return Result(rows, compared(before, written(writer, seed)))


def dpo(policy: lm.LanguageModel, layers: int, settings: dict, seed: int, report: Report) -> Result:
    """Chapter 97: learn from people's order of pairs of film reviews, each seen once."""
    reference = policy.frozen_copy()
    writer = Writer(policy, reference, vader_scores, TAUGHT)
    train_last(policy, layers)
    optimizer = optimizer_of(policy, settings["learning_rate"])
    loss = functools.partial(dpo_loss, beta=settings["beta"])
    before = written(writer, seed)
    rows: list[dict[str, float]] = []
    begun = time.perf_counter()
    for pairs in batches(policy, settings, seed):
        row = train_step(policy, optimizer, pairs, reference_logps(reference, pairs, sequence_logps), loss, sequence_logps)
        rows.append({"iteration": len(rows), **row, "seconds": time.perf_counter() - begun})
        report(len(rows), settings["steps"])
    now, then = (reference_logps(model, unseen(policy), sequence_logps) for model in (policy, reference))
    return Result(rows, compared(before, written(writer, seed)) | order_found(now - then))


def reward_model(model: lm.LanguageModel, layers: int, settings: dict, seed: int, report: Report) -> Result:
    """Chapter 96: one number for each text, the higher the better people like it; from pairs that are each seen once."""
    judge = lm.ValueModel(model)
    train_last(judge.body, layers)
    optimizer = optimizer_of(judge.body, settings["learning_rate"])
    head = {
        "params": judge.head.parameters(),
        "lr": settings["head_learning_rate"],
    }  # begins at 0, and what it reads differs little
    optimizer.add_param_group(head)
    rows: list[dict[str, float]] = []
    begun = time.perf_counter()
    for pairs in batches(model, settings, seed):
        scores = scored(judge, pairs)
        loss = reward_model_loss(*scores.unbind(1))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(trained(judge), 1.0)
        optimizer.step()
        right = (scores[:, 0] > scores[:, 1]).float().mean().item()
        rows.append({"iteration": len(rows), "loss": loss.item(), "accuracy": right, "seconds": time.perf_counter() - begun})
        report(len(rows), settings["steps"])
    texts = unseen(model)
    scores = torch.empty(texts.input_ids.shape[:2])
    with torch.no_grad():
        for few in like_lengths(texts, 32):
            scores[few] = scored(judge, texts.of(few))
    return Result(rows, order_found(scores))


def batches(model: lm.LanguageModel, settings: dict, seed: int) -> Iterator[Pairs]:
    """One epoch of as many pairs as the steps need."""
    said = asked("reward_model", settings["steps"] * settings["batch"], seed)
    pairs = encode_pairs(model, said.chosen_texts, said.rejected_texts)
    return (pairs.of(rows) for rows in like_lengths(pairs, settings["batch"], seed_everything(seed)))


def scored(judge: lm.ValueModel, pairs: Pairs) -> torch.Tensor:
    """Scores of both texts of each pair; (B, 2)."""
    input_ids, attention_mask = pairs.input_ids.flatten(0, 1), pairs.attention_mask.flatten(0, 1)
    return last_token_scores(judge(input_ids, attention_mask), attention_mask).unflatten(0, (-1, 2))
