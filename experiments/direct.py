"""DPO on human ratings with the tiny language model: weights beta, other losses, an unfrozen reference, a silent bug (chapter 97).

Every variant learns from the same pairs of film-review snippets, in one epoch. A row stands for five steps; in some of them texts of the
policy as it is then are looked at. At the end it is judged on prompts and on rated texts that it has not seen.
"""

from __future__ import annotations

import functools
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from course_lib import lm, preferences
from course_lib.direct import Pairs, completion_logps, encode_pairs, like_lengths, reference_logps, train_step
from course_lib.fine_tuning import Taught, Writer, Writing, openings
from course_lib.judges import gold_judge
from experiments.runner import Report, Result
from solutions import ch45, ch95
from solutions.ch96 import last_token_scores, reward_model_loss
from solutions.ch97 import dpo_loss, ipo_loss, sequence_logps

BETAS = (0.02, 0.05, 0.1, 0.3, 1.0)
COMMON = {"model": "tiny", "pairs": 640, "batch": 16, "learning_rate": 2e-4, "loss": "dpo", "beta": 0.1}
VARIANTS: dict[str, dict] = {
    **{f"dpo_{beta:g}": COMMON | {"beta": beta} for beta in BETAS},
    "dpo_0.1": COMMON | {"look": 10},
    "smoothed": COMMON | {"label_smoothing": 0.2},
    "ipo": COMMON | {"loss": "ipo"},
    "unfrozen": COMMON | {"loss": "unfrozen", "look": 10},
    "suspect": COMMON | {"padding_counts": True, "look": 10},
    "reward_model": COMMON | {"loss": "reward model", "learning_rate": 3e-4, "head_learning_rate": 5e-3},
}
SEEDS = 5
ROWS = 5  # steps that a row stands for
FEW, MANY = 64, 192  # texts looked at on the way and at the end
HELD_OUT = 64  # pairs of unseen texts, ordered by raters, that a program would log its accuracy on
RATED = 300  # unseen texts with their mean ratings
TAUGHT = Taught.of(vars(ch95), vars(ch45))


def dpo(beta: float, label_smoothing: float = 0.0):
    return functools.partial(dpo_loss, beta=beta, label_smoothing=label_smoothing)


def ipo(beta: float):
    """ipo_loss with the implicit rewards that `train_step` logs."""
    return lambda *logps: (ipo_loss(*logps, beta=beta), *dpo_loss(*logps, beta=beta)[1:])


def unfrozen(beta: float):
    """A reference that is the policy itself: whatever stands in for it is not looked at."""
    return lambda chosen, rejected, *_: dpo_loss(chosen, rejected, chosen, rejected, beta)


LOSSES = {"dpo": dpo, "ipo": ipo, "unfrozen": unfrozen}


def batches(pairs: Pairs, size: int, padding_counts: bool, generator: torch.Generator | None = None) -> list[Pairs]:
    """One epoch. The bug of the chapter's lab: every column behind the prompt counts, also the padding of that batch."""
    parts = [pairs.of(rows) for rows in like_lengths(pairs, size, generator)]
    if not padding_counts:
        return parts
    return [
        part._replace(completion_mask=torch.arange(part.input_ids.shape[-1]).expand(part.input_ids.shape) >= 1) for part in parts
    ]


def human_pairs(model: lm.LanguageModel, count: int, seed: int, split: str = "reward_model") -> Pairs:
    asked = preferences.comparisons(count, seed, split)
    return encode_pairs(model, asked.chosen_texts, asked.rejected_texts)


@functools.cache
def reference(name: str) -> lm.LanguageModel:
    return lm.load(name).frozen_copy()


@functools.cache
def prepared(name: str, count: int, size: int, seed: int, padding_counts: bool) -> tuple[list[Pairs], list[torch.Tensor], float]:
    """One epoch of a seed, the reference's log-probabilities of it, and the processor time that took: once for all variants."""
    begun = time.process_time()
    epoch = batches(human_pairs(reference(name), count, seed), size, padding_counts, torch.Generator().manual_seed(seed))
    return epoch, answered(reference(name), epoch), time.process_time() - begun


@functools.cache
def held_out(name: str, seed: int, padding_counts: bool) -> tuple[list[Pairs], torch.Tensor]:
    """Pairs of unseen texts as a program would prepare them for its log, and the reference's log-probabilities (HELD_OUT, 2)."""
    parts = batches(human_pairs(reference(name), HELD_OUT, 1000 + seed, "test"), 16, padding_counts)
    return parts, torch.cat(answered(reference(name), parts))


@functools.cache
def rated(name: str) -> tuple[Pairs, torch.Tensor, torch.Tensor]:
    """RATED unseen texts, two by two, their mean ratings (RATED,), and what the reference says of them (RATED / 2, 2)."""
    snippets, model = preferences.load("test"), reference(name)
    pairs = encode_pairs(model, snippets.texts[:RATED:2], snippets.texts[1:RATED:2])
    return pairs, snippets.means[:RATED], reference_logps(model, pairs, sequence_logps)


@torch.no_grad()
def answered(model: lm.LanguageModel, parts: list[Pairs]) -> list[torch.Tensor]:
    """log π of both texts of each pair, (B, 2) for each batch."""
    return [completion_logps(model, part, sequence_logps) for part in parts]


def accuracy(name: str, scores: torch.Tensor) -> float:
    """How often scores, (RATED / 2, 2), put two of the rated texts in the order of their mean ratings, over all pairs of them."""
    return preferences.pairwise_accuracy(scores.flatten(), rated(name)[1]).estimate


def gold(samples: lm.Samples) -> torch.Tensor:
    """What the judge of chapter 96 gives for the completions."""
    return gold_judge()(samples.texts)


def written(policy: lm.LanguageModel, name: str, seed: int, texts: int) -> Writing:
    """What the policy adds to prompts that it has not seen."""
    generator = torch.Generator().manual_seed(10_000 + seed)
    return Writer(policy, reference(name), gold, TAUGHT).write(openings("test")[:texts], 20, generator)


@functools.cache
def score_before(name: str, seed: int) -> float:
    return written(reference(name), name, seed, MANY).scores.mean().item()


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train on one epoch of pairs, in some variants with a look at the policy's texts now and then; judge it at the end."""
    choice: dict[str, Any] = VARIANTS[variant]
    if choice["loss"] == "reward model":
        return reward_model(choice, seed, report)
    name, padding_counts = choice["model"], choice.get("padding_counts", False)
    loss = LOSSES[choice["loss"]](**{key: choice[key] for key in ("beta", "label_smoothing") if key in choice})
    policy = lm.load(name)
    epoch, ref, seconds = prepared(name, choice["pairs"], choice["batch"], seed, padding_counts)
    unseen, unseen_ref = held_out(name, seed, padding_counts)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=choice["learning_rate"], weight_decay=0.0, fused=True)

    def look() -> dict[str, float]:
        moved = torch.cat(answered(policy, unseen)) - unseen_ref
        return written(policy, name, seed, FEW).measured(TAUGHT) | {"held_out": (moved[:, 0] > moved[:, 1]).float().mean().item()}

    rows: list[dict] = []
    steps: list[dict] = []
    for done, (part, ref_logps) in enumerate(zip(epoch, ref, strict=True), 1):
        begun = time.process_time()
        steps.append(train_step(policy, optimizer, part, ref_logps, loss, sequence_logps))
        seconds += time.process_time() - begun
        if done % ROWS == 0:
            row = {column: float(np.mean([step[column] for step in steps[-ROWS:]])) for column in steps[0]} | {"step": done}
            rows.append(row | (look() if "look" in choice and done % choice["look"] == 0 else {}))
            report(done, len(epoch))
    writing = written(policy, name, seed, MANY)
    pairs, _, ref_logps = rated(name)
    moved = reference_logps(policy, pairs, sequence_logps) - ref_logps
    summary: dict[str, Any] = writing.measured(TAUGHT) | {
        "gold": writing.scores.mean().item(),
        "gold_before": score_before(name, seed),
        "vader": preferences.vader(writing.texts).mean().item(),
        "seconds": seconds,
        "rated_accuracy": accuracy(name, moved),
        "unseen_moved": moved.mean().item(),
        **{column: float(np.mean([step[column] for step in steps[-2 * ROWS :]])) for column in steps[0]},
        "texts": [{"prompt": prompt, "text": text} for prompt, text in zip(openings("test"), writing.texts[:8], strict=False)],
    }
    return Result(rows, summary)


def reward_model(choice: dict, seed: int, report: Report) -> Result:
    """What chapter 96 does with the same pairs: a score at the end of each text, and the loss of Bradley and Terry."""
    model = lm.ValueModel(lm.load(choice["model"]))
    begun = time.process_time()
    generator = torch.Generator().manual_seed(seed)
    epoch = batches(human_pairs(model.body, choice["pairs"], seed), choice["batch"], False, generator)
    parts = {"learning_rate": model.body, "head_learning_rate": model.head}
    groups = [{"params": part.parameters(), "lr": choice[name]} for name, part in parts.items()]
    optimizer = torch.optim.AdamW(groups, weight_decay=0.0, fused=True)

    def scored(part: Pairs) -> torch.Tensor:
        input_ids, attention_mask = (half.flatten(0, 1) for half in part[:2])
        return last_token_scores(model(input_ids, attention_mask), attention_mask).unflatten(0, (-1, 2))

    rows: list[dict] = []
    for part in epoch:
        loss = reward_model_loss(*scored(part).unbind(1))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        rows.append({"step": len(rows), "loss": loss.item()})
        report(len(rows), len(epoch))
    seconds = time.process_time() - begun
    pairs = rated(choice["model"])[0]
    scores = torch.empty(len(pairs.input_ids), 2)
    with torch.no_grad():
        for some in like_lengths(pairs, 16):
            scores[some] = scored(pairs.of(some))
    return Result(rows, {"rated_accuracy": accuracy(choice["model"], scores), "seconds": seconds})
