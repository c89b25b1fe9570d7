"""DPO on human ratings with the tiny language model: weights beta, other losses, an unfrozen reference, a silent bug (chapter 97).

Every variant begins with the fine-tuned policy of the experiment rlhf and learns from some of the comparisons that the reward model there
has, in one epoch; a run's seed is that of both. "coin" tosses a coin for every label. "own_texts" learns from that policy's own texts
instead, the best and the worst of four as the reward model orders them, and so at other weights beta in "own_texts_0.2" and its like;
"own_texts_two" from two of each prompt; "own_texts_twice" from as many, of which the second half are written by the policy as it is by
then. "whole_picked" learns from the best and the worst of four texts that people wrote, by the same reward model.
A row stands for five steps; in some of them texts of the policy as it is then are looked at. At the end it is judged on prompts and on
rated texts that it has not seen.
"""

from __future__ import annotations

import functools
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn.utils.rnn import pad_sequence

from course_lib.language import lm, preferences
from course_lib.language.direct import Pairs, completion_logps, encode_pairs, like_lengths, reference_logps, train_step
from course_lib.language.fine_tuning import Writer, Writing, openings
from course_lib.language.judges import gold_judge
from course_lib.language.reward_models import RewardModel, fit
from course_lib.language.rlhf import Proxy, whole_texts
from experiments import rlhf
from experiments.campaign import Report, Result
from solutions.ch95 import completion_mask
from solutions.ch96 import last_token_scores, reward_model_loss
from solutions.ch97 import dpo_loss, ipo_loss, sequence_logps

BETAS = (0.02, 0.05, 0.1, 0.3, 1.0)
COMMON = {"pairs": 640, "batch": 16, "learning_rate": 2e-4, "loss": "dpo", "beta": 0.1}
VARIANTS: dict[str, dict] = {
    **{f"dpo_{beta:g}": COMMON | {"beta": beta} for beta in BETAS},
    "dpo_0.1": COMMON | {"look": 10},
    "smoothed": COMMON | {"label_smoothing": 0.2},
    "ipo": COMMON | {"loss": "ipo"},
    "unfrozen": COMMON | {"loss": "unfrozen", "beta": 1.0},
    "suspect": COMMON | {"padding_counts": True, "look": 10},
    "reward_model": COMMON | {"loss": "reward model"},
    "own_texts": COMMON | {"candidates": 4, "look": 10},
    "own_texts_twice": COMMON | {"candidates": 4, "look": 10, "rounds": 2},
    **{f"own_texts_{beta:g}": COMMON | {"candidates": 4, "beta": beta} for beta in (0.15, 0.2, 0.3)},
    "own_texts_two": COMMON | {"candidates": 2},
    "whole_picked": COMMON | {"labels": "reward model, best and worst of four"},
    "coin": COMMON | {"labels": "coin"},
}
SEEDS = 5
ROWS = 5  # steps that a row stands for
FEW, MANY = 64, 192  # texts looked at on the way and at the end
HELD_OUT = 64  # pairs of unseen texts, ordered by raters, that a program would log its accuracy on
PROMPTS_AT_A_TIME = 32
RATED = 300  # unseen texts with their mean ratings


def dpo(beta: float, label_smoothing: float = 0.0):
    return functools.partial(dpo_loss, beta=beta, label_smoothing=label_smoothing)


def ipo(beta: float):
    """ipo_loss with the implicit rewards that `train_step` logs."""
    return lambda chosen, rejected, ref_chosen, ref_rejected: (
        ipo_loss(chosen, rejected, ref_chosen, ref_rejected, beta),
        *dpo_loss(chosen, rejected, ref_chosen, ref_rejected, beta)[1:],
    )


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


def reference(seed: int) -> lm.LanguageModel:
    return rlhf.fine_tuned(seed)[0]


def comparisons(count: int, seed: int) -> preferences.Preferences:
    """The first of those that chapter 96's reward model of this seed is trained on."""
    everything = preferences.comparisons(rlhf.COMPARISONS, seed)
    names = ("chosen", "rejected", "disagreement", "gap")
    return replace(everything, **{name: getattr(everything, name)[:count] for name in names})


def by_coin(asked: preferences.Preferences, seed: int) -> preferences.Preferences:
    """The same pairs, and labels that say nothing."""
    return preferences.flip_labels(asked, 0.5, torch.Generator().manual_seed(50_000 + seed))


def picked(count: int, seed: int) -> preferences.Preferences:
    """Of four texts at random, each time, the ones that chapter 96's reward model likes best and least; nobody else is asked."""
    texts = preferences.load("reward_model").texts
    drawn = torch.randint(len(texts), (count, 4), generator=torch.Generator().manual_seed(60_000 + seed))
    scores = rlhf.reward_model(seed).scores(texts, last_token_scores)[drawn]
    best, worst = (drawn.gather(1, index[:, None])[:, 0] for index in (scores.argmax(1), scores.argmin(1)))
    return preferences.Preferences(texts, best, worst, torch.empty(0), torch.empty(0))


def labelled(count: int, seed: int, labels: str) -> preferences.Preferences:
    """Pairs of texts that people wrote."""
    if labels == "two raters":
        return comparisons(count, seed)
    return by_coin(comparisons(count, seed), seed) if labels == "coin" else picked(count, seed)


def encoded(model: lm.LanguageModel, asked: preferences.Preferences) -> Pairs:
    return encode_pairs(model, asked.chosen_texts, asked.rejected_texts)


@functools.cache
def prepared(
    count: int, size: int, seed: int, padding_counts: bool, candidates: int, labels: str
) -> tuple[list[Pairs], list[torch.Tensor], float]:
    """One epoch of a seed, the reference's log-probabilities of it, and the processor time that took: once for all variants."""
    model = reference(seed)
    if candidates or labels.startswith("reward model"):
        rlhf.reward_model(seed)  # its training is not part of the time
    begun = time.process_time()
    pairs = own_texts(count, candidates, seed) if candidates else encoded(model, labelled(count, seed, labels))
    epoch = batches(pairs, size, padding_counts, torch.Generator().manual_seed(seed))
    return epoch, answered(model, epoch), time.process_time() - begun


@functools.cache
def held_out(seed: int, padding_counts: bool) -> tuple[list[Pairs], torch.Tensor]:
    """Pairs of unseen texts as a program would prepare them for its log, and the reference's log-probabilities (HELD_OUT, 2)."""
    model = reference(seed)
    parts = batches(encoded(model, preferences.comparisons(HELD_OUT, 1000 + seed, "test")), 16, padding_counts)
    return parts, torch.cat(answered(model, parts))


@functools.cache
def rated(seed: int) -> tuple[Pairs, torch.Tensor]:
    """RATED unseen texts, two by two, and what the reference says of them (RATED / 2, 2)."""
    snippets, model = preferences.load("test"), reference(seed)
    pairs = encode_pairs(model, snippets.texts[:RATED:2], snippets.texts[1:RATED:2])
    return pairs, reference_logps(model, pairs, sequence_logps)


def own_texts(count: int, candidates: int, seed: int, writer: lm.LanguageModel | None = None, first: int = 0) -> Pairs:
    """Of each prompt's completions by `writer`, those that chapter 96's reward model likes best and least.

    Args:
      count: of the prompts, from the one with the number `first` on.
      candidates: completions of each.
      writer: the policy that training begins with, if none is given.
    """
    model, proxy = writer or reference(seed), Proxy(rlhf.reward_model(seed), last_token_scores)
    generator = torch.Generator().manual_seed(40_000 + seed + 1000 * first)
    taken: list[list[torch.Tensor]] = []  # of each text, its own tokens and which of them are the completion's
    for begin in range(first, first + count, PROMPTS_AT_A_TIME):
        prompts = openings("policy")[begin : min(first + count, begin + PROMPTS_AT_A_TIME)]
        samples = model.generate(
            [prompt for prompt in prompts for _ in range(candidates)], rlhf.PPO.new_tokens, generator=generator
        )
        scores = proxy(samples).unflatten(0, (-1, candidates))
        rows = torch.arange(len(prompts)) * candidates
        written = completion_mask(samples.input_ids, samples.prompt_lengths, model.end_id)
        for row in torch.stack([rows + scores.argmax(1), rows + scores.argmin(1)], 1).flatten().tolist():
            kept = samples.attention_mask[row]
            taken.append([part[row][kept] for part in (samples.input_ids, samples.attention_mask, written)])
    padding = (model.end_id, False, False)
    return Pairs(
        *(
            pad_sequence(list(part), batch_first=True, padding_value=value).unflatten(0, (-1, 2))
            for part, value in zip(zip(*taken, strict=True), padding, strict=True)
        )
    )


@torch.no_grad()
def answered(model: lm.LanguageModel, parts: list[Pairs]) -> list[torch.Tensor]:
    """log π of both texts of each pair, (B, 2) for each batch."""
    return [completion_logps(model, part, sequence_logps) for part in parts]


def accuracy(scores: torch.Tensor) -> float:
    """How often scores (RATED,) put two of the rated texts in the order of their mean ratings, over all pairs of them."""
    return preferences.pairwise_accuracy(scores, preferences.load("test").means[:RATED]).estimate


def written(policy: lm.LanguageModel, seed: int, texts: int) -> Writing:
    """What the policy adds to prompts that it has not seen, and what the judge of chapter 96 gives for the whole texts."""
    writer = Writer(policy, reference(seed), lambda samples: gold_judge()(whole_texts(policy, samples)), rlhf.TAUGHT)
    return writer.write(openings("test")[:texts], rlhf.PPO.new_tokens, torch.Generator().manual_seed(10_000 + seed))


@functools.cache
def score_before(seed: int) -> float:
    return written(reference(seed), seed, MANY).scores.mean().item()


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train on one epoch of pairs, in some variants with a look at the policy's texts now and then; judge it at the end."""
    choice: dict[str, Any] = VARIANTS[variant]
    if choice["loss"] == "reward model":
        return reward_model(choice, seed, report)
    padding_counts = choice.get("padding_counts", False)
    loss = LOSSES[choice["loss"]](**{key: choice[key] for key in ("beta", "label_smoothing") if key in choice})
    policy = reference(seed).frozen_copy().requires_grad_(True)
    rounds, candidates = choice.get("rounds", 1), choice.get("candidates", 0)
    size = choice["pairs"] // rounds
    labels = choice.get("labels", "two raters")
    epoch, ref, seconds = prepared(size, choice["batch"], seed, padding_counts, candidates, labels)
    unseen, unseen_ref = held_out(seed, padding_counts)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=choice["learning_rate"], weight_decay=0.0, fused=True)

    def look() -> dict[str, float]:
        moved = torch.cat(answered(policy, unseen)) - unseen_ref
        return written(policy, seed, FEW).measured(rlhf.TAUGHT) | {"held_out": (moved[:, 0] > moved[:, 1]).float().mean().item()}

    rows: list[dict] = []
    steps: list[dict] = []
    for number in range(rounds):
        begun = time.process_time()
        if number:  # the policy as it is now writes; the reference remains
            fresh = own_texts(size, candidates, seed, policy, first=number * size)
            epoch = batches(fresh, choice["batch"], padding_counts, torch.Generator().manual_seed(seed + 1000 * number))
            ref = answered(reference(seed), epoch)
        seconds += time.process_time() - begun
        for part, ref_logps in zip(epoch, ref, strict=True):
            begun = time.process_time()
            steps.append(train_step(policy, optimizer, part, ref_logps, loss, sequence_logps))
            seconds += time.process_time() - begun
            done = len(steps)
            if done % ROWS == 0:
                row = {column: float(np.mean([step[column] for step in steps[-ROWS:]])) for column in steps[0]} | {"step": done}
                rows.append(row | (look() if "look" in choice and done % choice["look"] == 0 else {}))
                report(done, rounds * len(epoch))
    writing = written(policy, seed, MANY)
    pairs, ref_logps = rated(seed)
    moved = reference_logps(policy, pairs, sequence_logps) - ref_logps
    summary: dict[str, Any] = writing.measured(rlhf.TAUGHT) | {
        "gold": writing.scores.mean().item(),
        "gold_before": score_before(seed),
        "vader": preferences.vader(writing.texts).mean().item(),
        "seconds": seconds,
        "rated_accuracy": accuracy(moved.flatten()),
        "unseen_moved": moved.mean().item(),
        **{column: float(np.mean([step[column] for step in steps[-2 * ROWS :]])) for column in steps[0]},
        "texts": [{"prompt": prompt, "text": text} for prompt, text in zip(openings("test"), writing.texts[:8], strict=False)],
    }
    return Result(rows, summary)


def reward_model(choice: dict, seed: int, report: Report) -> Result:
    """Chapter 96's reward model, from the same comparisons as the other variants."""
    begun = time.process_time()
    asked = comparisons(choice["pairs"], seed)
    model = fit(RewardModel(lm.load("tiny"), seed=seed), asked, reward_model_loss, last_token_scores, seed)
    row = {"seconds": time.process_time() - begun}
    row["rated_accuracy"] = accuracy(model.scores(preferences.load("test").texts[:RATED], last_token_scores))
    return Result([row], row)
