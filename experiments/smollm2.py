"""The methods of chapters 95 to 97 on a model that others trained, SmolLM2-135M: PPO with VADER's sentiment, a reward model, DPO.

It is SmolLM2-135M-Instruct, rounded to 4 bits: pretrained, fine-tuned on instructions and by DPO, and used without its chat template.
A few minutes of one core each: few and short texts, and only the network's last layers are trained, which saves half of the time, or,
for the reward model, no layer but a new head. On a GPU every number below can be raised. Reading the records needs neither the model
nor the package that holds it.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from course_lib.language import lm, preferences
from course_lib.language.direct import Pairs, encode_pairs, like_lengths, reference_logps, train_step
from course_lib.language.fine_tuning import Taught, TokenPPO, Writer, Writing, openings, train, vader_scores
from course_lib.seeding import seed_everything
from experiments.campaign import Report, Result
from solutions import ch45, ch95
from solutions.ch96 import reward_model_loss
from solutions.ch97 import dpo_loss, sequence_logps

MODEL = "smollm2-135m"
VARIANTS: dict[str, dict] = {
    "ppo": {
        "last_layers": 6, "kl_coef": 0.02, "iterations": 30, "batch": 24, "new_tokens": 16, "minibatch": 12, "learning_rate": 4e-4,
        "gae_lambda": 1.0,
    },
    "dpo": {"last_layers": 6, "beta": 0.1, "steps": 20, "batch": 8, "learning_rate": 2e-4},
    "reward_model": {"last_layers": 0, "texts": 600, "steps": 150, "batch": 64, "learning_rate": 1e-3},
}  # fmt: skip
SEEDS = 3
WRITTEN, NEW_TOKENS = 24, 16  # texts looked at before and after, to prompts that training has not seen, and their length
RATED = 160  # texts that training has not seen, whose order by their raters is to be found
SHOWN = 12
TAUGHT = Taught.of(vars(ch95), vars(ch45))


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train, and say what that changed."""
    method = {"ppo": ppo, "dpo": dpo, "reward_model": reward_model}[variant]
    return method(lm.load(MODEL), dict(VARIANTS[variant]), seed, report)


def train_last(model: lm.LanguageModel, layers: int) -> None:
    """Freeze all of a network but its last layers and the normalisation behind them; also the head, which is the embedding."""
    body = model.network.base_model
    model.requires_grad_(False)
    for part in (*body.layers[-layers:], body.norm):
        part.requires_grad_(True)


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


def ppo(policy: lm.LanguageModel, settings: dict, seed: int, report: Report) -> Result:
    """Chapter 95: make what the policy adds to the first words of a film review sound positive to VADER."""
    writer = Writer(policy, policy.frozen_copy(), vader_scores, TAUGHT)
    train_last(policy, settings.pop("last_layers"))
    choice = TokenPPO(**settings)
    before = written(writer, seed)
    rows = []
    for row in train(writer, openings("policy"), choice, seed):
        rows.append(row)
        report(len(rows), choice.iterations)
    return Result(rows, compared(before, written(writer, seed)))


def dpo(policy: lm.LanguageModel, settings: dict, seed: int, report: Report) -> Result:
    """Chapter 97: learn from people's order of pairs of film reviews, each seen once."""
    reference = policy.frozen_copy()
    writer = Writer(policy, reference, vader_scores, TAUGHT)
    train_last(policy, settings["last_layers"])
    learning = [parameter for parameter in policy.parameters() if parameter.requires_grad]
    optimizer = torch.optim.AdamW(learning, lr=settings["learning_rate"], weight_decay=0.0, fused=True)
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


def reward_model(model: lm.LanguageModel, settings: dict, seed: int, report: Report) -> Result:
    """Chapter 96: one number for each text, the higher the better people like it. The body stays as it is, and reads each text once."""
    steps, batch, generator = settings["steps"], settings["batch"], seed_everything(seed)
    snippets = some(preferences.load("reward_model"), settings["texts"], generator)
    features, others = known(model, snippets.texts), known(model, preferences.load("test").texts[:RATED])
    mean, std = features.mean(0), features.std(0)  # the text changes them little, beside what all texts share
    features, others = (features - mean) / std, (others - mean) / std
    said = asked(snippets, steps * batch, generator)
    head = torch.nn.Linear(model.width, 1)
    torch.nn.init.zeros_(head.weight)
    optimizer = torch.optim.AdamW(head.parameters(), lr=settings["learning_rate"], weight_decay=0.0)
    rows: list[dict[str, float]] = []
    for step, pairs in enumerate(torch.arange(len(said)).split(batch)):
        chosen, rejected = (head(features[texts[pairs]]).squeeze(1) for texts in (said.chosen, said.rejected))
        loss = reward_model_loss(chosen, rejected)
        if step % 10 == 0:
            right = (chosen > rejected).float().mean().item()
            held_out = order_found(head(others).detach())["accuracy"]
            rows.append({"iteration": step, "loss": loss.item(), "accuracy": right, "held_out_accuracy": held_out})
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        report(step + 1, steps)
    return Result(rows, order_found(head(others).detach()))


@torch.no_grad()
def known(model: lm.LanguageModel, texts: Sequence[str]) -> torch.Tensor:
    """What the last layer knows at the end token of each text; (N, D)."""
    order = sorted(range(len(texts)), key=lambda index: len(texts[index]))
    features = torch.empty(len(texts), model.width)
    for few in torch.tensor(order).split(32):
        tokens = model.encode([texts[index] for index in few.tolist()], ended=True)
        features[few] = model.hidden(*tokens)[torch.arange(len(few)), tokens.attention_mask.sum(1) - 1]
    return features


def some(snippets: preferences.Snippets, count: int, generator: torch.Generator) -> preferences.Snippets:
    """So many of the snippets, at random."""
    picks = torch.randperm(len(snippets), generator=generator)[:count].tolist()
    return preferences.Snippets(*([part[pick] for pick in picks] for part in (snippets.ids, snippets.texts, snippets.ratings)))


def asked(snippets: preferences.Snippets, pairs: int, generator: torch.Generator) -> preferences.Preferences:
    """Random pairs of snippets, each ordered by two people, one rater of either text."""
    return preferences.ask_two_raters(preferences.draw_pairs(snippets, pairs, generator), generator)


def batches(model: lm.LanguageModel, settings: dict, seed: int) -> Iterator[Pairs]:
    """One epoch of as many pairs as the steps need."""
    generator = torch.Generator().manual_seed(seed)
    said = asked(preferences.load("reward_model"), settings["steps"] * settings["batch"], generator)
    pairs = encode_pairs(model, said.chosen_texts, said.rejected_texts)
    return (pairs.of(rows) for rows in like_lengths(pairs, settings["batch"], seed_everything(seed)))
