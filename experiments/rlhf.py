"""The whole of RLHF on text, small: supervised fine-tuning, a reward model from comparisons, PPO and best-of-n on it (chapter 96).

Proxy and gold: the reward model that PPO maximises, in standard deviations of its scores of the fine-tuned policy's texts, and the
judge that is held out, in units of the ratings. Prompts of the evaluation are of the split "test". A run's seed is that of everything:
of fine-tuning, of the comparisons and the raters' answers, of the reward model and of PPO.
"""

from __future__ import annotations

import functools
import time
from pathlib import Path
from typing import Any

import torch
from torch.nn.utils.rnn import pad_sequence

from course_lib.language import lm, preferences
from course_lib.language.fine_tuning import Taught, TokenPPO, Writer, openings, train
from course_lib.language.judges import gold_judge
from course_lib.language.reward_models import RewardModel, fit
from course_lib.language.rlhf import Proxy, liked_texts, next_token_loss, supervised, whole_texts
from experiments.campaign import Report, Result
from solutions import ch45, ch95, ch96

PPO = TokenPPO(batch=48, new_tokens=16, minibatch=24, learning_rate=4e-4, gae_lambda=0.95)
COMPARISONS = 4000
EVALUATION_TEXTS = 256
CANDIDATES, BEST_OF_N_PROMPTS = 64, 64
VARIANTS: dict[str, dict[str, Any]] = {
    "sft": {"steps": 40},
    "best_of_n": {"candidates": CANDIDATES, "also_by": ["mean", "min", "twice"]},
    "distilled": {"candidates": 8, "prompts": 640, "steps": 40, "batch": 16, "learning_rate": 2e-4},
    **{f"flipped_{rate}": {"flipped": rate} for rate in (0.0, 0.1, 0.2, 0.3, 0.4)},
    **{f"comparisons_{count}": {"comparisons": count} for count in (250, 1000, 16_000)},
    "margin_same": {"by": ["nothing"], "mean_margins": [0.0, 1.0, 3.0]},
    "margin_graded": {"by": ["answer", "panels"], "mean_margins": [1.0, 3.0]},
    "frozen_body": {"features": "tiny, last layer, last token"},
    "ppo_kl_0.0": {"kl_coef": 0.0, "iterations": 50},
    "ppo_kl_0.2": {"kl_coef": 0.2, "iterations": 40},
    "ppo_kl_0.05": {"kl_coef": 0.05, "iterations": 40},
}
SEEDS = 5
TAUGHT = Taught.of(vars(ch95), vars(ch45))
OTHER = 100  # added to a seed for the second reward model: other comparisons, other raters, other initial weights


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """One part of the pipeline; those before it are made, or taken from this process's earlier runs."""
    kind = variant.partition("_")[0]
    kinds = {"sft": _sft, "ppo": _ppo, "best": _best_of_n, "distilled": _distilled, "frozen": _frozen_body, "margin": _margins}
    return kinds.get(kind, _labels)(variant, seed, report)


@functools.cache
def fine_tuned(seed: int) -> tuple[lm.LanguageModel, list[float]]:
    """The policy that all else begins with, frozen, and its losses."""
    policy = lm.load("tiny")
    losses = list(supervised(policy, liked_texts("policy"), seed, VARIANTS["sft"]["steps"]))
    return policy.frozen_copy(), losses


@functools.cache
def reward_model(seed: int) -> RewardModel:
    """From comparisons of its own seed."""
    return _fitted(preferences.comparisons(COMPARISONS, seed), seed)


def _fitted(comparisons: preferences.Preferences, seed: int, margins: torch.Tensor | None = None) -> RewardModel:
    model = RewardModel(lm.load("tiny"), seed=seed)
    return fit(model, comparisons, ch96.reward_model_loss, ch96.last_token_scores, seed, margins=margins)


@functools.cache
def proxies(seed: int) -> tuple[Proxy, Proxy]:
    """The score that PPO maximises, and that of another reward model, both calibrated on texts of the fine-tuned policy."""
    samples = fine_tuned(seed)[0].generate(openings("validation"), PPO.new_tokens, generator=torch.Generator().manual_seed(seed))
    first, other = (Proxy(reward_model(one), ch96.last_token_scores).calibrated(samples) for one in (seed, seed + OTHER))
    return first, other


def _correlation(a: torch.Tensor, b: torch.Tensor) -> float:
    return torch.corrcoef(torch.stack([a, b]))[0, 1].item()


def evaluation(policy: lm.LanguageModel, seed: int) -> tuple[dict[str, float], list[str]]:
    """Texts to prompts that nothing was trained on, as the proxy, the other reward model and the gold judge see them."""
    proxy, other = proxies(seed)
    prompts = openings("test")[:EVALUATION_TEXTS]
    writer = Writer(policy, fine_tuned(seed)[0], proxy, TAUGHT)
    writing = writer.write(prompts, PPO.new_tokens, torch.Generator().manual_seed(10_000 + seed))
    texts = whole_texts(policy, writing.samples)
    gold, others = gold_judge()(texts), other(writing.samples)
    measured = {
        "proxy": writing.scores.mean().item(),
        "other": others.mean().item(),
        "gold": gold.mean().item(),
        "vader": preferences.vader(texts).mean().item(),
        "two_models": _correlation(writing.scores, others),
        "proxy_and_gold": _correlation(writing.scores, gold),
    }
    return measured | {name: writing.measured(TAUGHT)[name] for name in ("kl", "perplexity", "tokens", "distinct_2")}, texts


def _sft(variant: str, seed: int, report: Report) -> Result:
    begun = time.process_time()
    policy, losses = fine_tuned(seed)
    seconds = time.process_time() - begun
    summary: dict[str, Any] = {"cpu_seconds": seconds}
    with torch.no_grad():
        for name, model in (("before", lm.load("tiny")), ("after", policy)):
            measured, texts = evaluation(model, seed)
            summary |= {f"{key}_{name}": value for key, value in measured.items()}
            summary[f"loss_{name}"] = next_token_loss(model, liked_texts("validation")).item()
            summary[f"texts_{name}"] = texts[:8]
    return Result([{"step": step, "loss": loss} for step, loss in enumerate(losses)], summary)


def _ppo(variant: str, seed: int, report: Report) -> Result:
    settings = PPO.but(**VARIANTS[variant])
    reference, (proxy, other) = fine_tuned(seed)[0], proxies(seed)
    policy = reference.frozen_copy().requires_grad_(True)
    written: list[lm.Samples] = []

    def score(samples: lm.Samples) -> torch.Tensor:
        written.append(samples)
        return proxy(samples)

    rows: list[dict[str, float]] = []
    for row in train(Writer(policy, reference, score, TAUGHT), openings("policy"), settings, seed):
        samples = written.pop()
        gold = gold_judge()(whole_texts(policy, samples)).mean().item()
        rows.append(row | {"proxy": row["score"], "gold": gold, "other": other(samples).mean().item()})
        report(len(rows), settings.iterations)
    summary, texts = evaluation(policy, seed)
    return Result(rows, summary | {"texts": texts[:8]})


def _best_of_n(variant: str, seed: int, report: Report) -> Result:
    """Chosen by the proxy, and by the mean and by the smaller of two models' scores, and by one model with the comparisons of both."""
    policy, (proxy, other) = fine_tuned(seed)[0], proxies(seed)
    twice = Proxy(_fitted(preferences.comparisons(2 * COMPARISONS, seed), seed), ch96.last_token_scores)
    prompts = openings("test")[:BEST_OF_N_PROMPTS]
    generator = torch.Generator().manual_seed(20_000 + seed)
    begun = time.perf_counter()
    tables: dict[str, list[torch.Tensor]] = {"proxy": [], "other": [], "gold": [], "tokens": [], "twice": []}
    repeated = [prompt for prompt in prompts for _ in range(4)]
    for call in range(CANDIDATES // 4):
        samples = policy.generate(repeated, PPO.new_tokens, generator=generator)
        written = ch95.completion_mask(samples.input_ids, samples.prompt_lengths, policy.end_id)
        for name, scores in (
            ("proxy", proxy(samples)), ("other", other(samples)), ("gold", gold_judge()(whole_texts(policy, samples))),
            ("tokens", written.sum(1).float()), ("twice", twice(samples)),
        ):  # fmt: skip
            tables[name].append(scores.view(len(prompts), 4))
        report(call + 1, CANDIDATES // 4)
    everything = {name: torch.cat(parts, dim=1) for name, parts in tables.items()}  # (prompts, candidates) each
    seconds = time.perf_counter() - begun
    rows = []
    for n in (1, 2, 4, 8, 16, 32, 64):
        groups = {name: scores.unflatten(1, (-1, n)).flatten(0, 1) for name, scores in everything.items()}
        both = torch.stack([groups["proxy"], groups["other"]])
        by = {"proxy": groups["proxy"], "mean": both.mean(0), "min": both.amin(0), "twice": groups.pop("twice")}
        best = {rule: ch96.best_of_n(scores)[:, None] for rule, scores in by.items()}
        means = {name: scores.gather(1, best["proxy"]).mean().item() for name, scores in groups.items()}
        also = {f"gold_by_{rule}": groups["gold"].gather(1, best[rule]).mean().item() for rule in VARIANTS[variant]["also_by"]}
        rows.append({"n": n, "kl": ch96.best_of_n_kl(n), **means, **also, "seconds": seconds * n / CANDIDATES})
    return Result(rows, {"proxy_and_gold": _correlation(everything["proxy"].flatten(), everything["gold"].flatten())})


def _distilled(variant: str, seed: int, report: Report) -> Result:
    """Best of n as training texts: the policy is fine-tuned on the best of its candidates for each prompt, and writes one text after."""
    choice, reference, (proxy, _) = VARIANTS[variant], fine_tuned(seed)[0], proxies(seed)
    generator = torch.Generator().manual_seed(50_000 + seed)
    begun = time.process_time()
    kept: list[tuple[torch.Tensor, ...]] = []  # of each best text: tokens, that none is padding, which were written
    prompts, many = openings("policy")[: choice["prompts"]], choice["candidates"]
    for first in range(0, len(prompts), 8):
        repeated = [prompt for prompt in prompts[first : first + 8] for _ in range(many)]
        samples = reference.generate(repeated, PPO.new_tokens, generator=generator)
        written = ch95.completion_mask(samples.input_ids, samples.prompt_lengths, reference.end_id)
        for row in (torch.arange(0, len(repeated), many) + ch96.best_of_n(proxy(samples).view(-1, many))).tolist():
            own = samples.attention_mask[row]
            kept.append(tuple(part[row][own] for part in (samples.input_ids, samples.attention_mask, written)))
        report(len(kept), len(prompts))
    input_ids, attention_mask, written = (
        pad_sequence(list(part), batch_first=True, padding_value=value)
        for part, value in zip(zip(*kept, strict=True), (reference.end_id, False, False), strict=True)
    )
    policy = reference.frozen_copy().requires_grad_(True)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=choice["learning_rate"], weight_decay=0.0)
    rows = []
    for step, picks in enumerate(torch.randperm(len(kept), generator=generator).split(choice["batch"])[: choice["steps"]]):
        logps = ch95.per_token_logps(policy.logits(input_ids[picks], attention_mask[picks]), input_ids[picks])
        loss = -ch95.masked_mean(logps, written[picks, 1:])
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimizer.step()
        rows.append({"step": step, "loss": loss.item()})
    seconds = time.process_time() - begun
    summary, texts = evaluation(policy, seed)
    return Result(rows, summary | {"cpu_seconds": seconds, "texts": texts[:8]})


def _labels(variant: str, seed: int, report: Report) -> Result:
    configuration = VARIANTS[variant]
    answers = preferences.comparisons(configuration.get("comparisons", COMPARISONS), seed)
    generator = torch.Generator().manual_seed(30_000 + seed)
    answers = preferences.flip_labels(answers, configuration.get("flipped", 0.0), generator)
    begun = time.process_time()
    model = _fitted(answers, seed)
    seconds = time.process_time() - begun
    test = preferences.load("test")
    scores = model.scores(test.texts, ch96.last_token_scores)
    seen = model.scores(answers.texts, ch96.last_token_scores)
    lengths = model.encode(test.texts).attention_mask.sum(1)
    other = reward_model(seed + OTHER).scores(test.texts, ch96.last_token_scores)
    accuracy = preferences.pairwise_accuracy(scores, test.means)
    row = {
        "accuracy": accuracy.estimate,
        "low": accuracy.low,
        "high": accuracy.high,
        "training_accuracy": (seen[answers.chosen] > seen[answers.rejected]).float().mean().item(),
        "correlation": _correlation(scores, test.means),
        "length": ch96.length_correlation(scores, lengths).item(),
        "two_models": _correlation(scores, other),
        "wrong": (answers.gap < 0).float().mean().item(),
        "cpu_seconds": seconds,
    }
    return Result([row], row)


def _margins(variant: str, seed: int, report: Report) -> Result:
    """Reward models of the same comparisons, in the same order and from the same weights: the margin alone differs.

    It is the same for every comparison; or it grows with how clear the difference was, to the two raters who answered, or by the means
    of both panels, whoever is right; its mean over the comparisons is given. Accuracy is on all pairs of held-out texts, and on those
    whose mean ratings lie closer than 1, from 1 to 3 and at least 3 apart. Claims are held against the raters' chances on 20,000 held-out
    pairs, in nats an answer, before and after the gaps are divided by the number that is best on the split "validation".
    """
    answers, test = preferences.comparisons(COMPARISONS, seed), preferences.load("test")
    generator = torch.Generator().manual_seed(60_000 + seed)
    told = preferences.told_differences(answers, preferences.load("reward_model"), generator)
    clear = {"nothing": torch.ones(len(answers)), "answer": told, "panels": answers.gap.abs()}
    choices = [(by, mean) for by in VARIANTS[variant]["by"] for mean in VARIANTS[variant]["mean_margins"]]
    rows: list[dict[str, Any]] = []
    for by, mean in choices:
        model = _fitted(answers, seed, mean * clear[by] / clear[by].mean())
        scores = model.scores(test.texts, ch96.last_token_scores)
        seen = model.scores(answers.texts, ch96.last_token_scores)
        gaps, people = _asked(model, "validation")
        divisor = min((step / 20 for step in range(10, 400)), key=lambda divided: _surprise(gaps / divided, people))
        gaps, people = _asked(model, "test")
        rows.append({
            "by": by,
            "mean_margin": mean,
            "accuracy": preferences.pairwise_accuracy(scores, test.means).estimate,
            **{name: _ordered(scores, test.means, low, high) for name, low, high in BANDS},
            "training_accuracy": (seen[answers.chosen] > seen[answers.rejected]).float().mean().item(),
            "deviation": scores.std().item(),
            "claimed": torch.sigmoid(gaps).mean().item(),
            "agreed": people.mean().item(),
            "nats": _surprise(gaps, people),
            "divisor": divisor,
            "nats_divided": _surprise(gaps / divisor, people),
        })  # fmt: skip
        report(len(rows), len(choices))
    return Result(rows)


BANDS = (("close", 0.0, 1.0), ("between", 1.0, 3.0), ("far", 3.0, float("inf")))  # of two mean ratings


def _ordered(scores: torch.Tensor, means: torch.Tensor, low: float, high: float) -> float:
    """Share of the pairs of texts that the scores order as the means do, of those pairs whose means lie from low to below high apart."""
    apart = means[:, None] - means[None, :]
    here = (apart > 0) & (apart >= low) & (apart < high)
    return (((scores[:, None] - scores[None, :]).sign() + 1) / 2)[here].mean().item()


def _asked(model: RewardModel, split: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Of pairs of a split's texts: the model's gap, and the chance that two raters agree with its sign; (B,) each."""
    pairs = preferences.comparisons(20_000, 0, split)
    scores = model.scores(pairs.texts, ch96.last_token_scores)
    gaps = scores[pairs.chosen] - scores[pairs.rejected]
    return gaps.abs(), torch.where(gaps > 0, 1 - pairs.disagreement, pairs.disagreement)


def _surprise(gaps: torch.Tensor, people: torch.Tensor) -> float:
    """Mean negative log-likelihood of the raters' answers, in nats."""
    log_likely, log_unlikely = (torch.nn.functional.logsigmoid(z) for z in (gaps, -gaps))
    return -(people * log_likely + (1 - people) * log_unlikely).mean().item()


def _frozen_body(variant: str, seed: int, report: Report) -> Result:
    """What the tiny language model's body knows without training: a linear head on its last layer at the last token."""
    answers, test = preferences.comparisons(COMPARISONS, seed), preferences.load("test")
    training, held_out = (_features(tuple(texts)) for texts in (answers.texts, test.texts))
    level, scale = training.mean(0), training.std(0)
    gaps = (training[answers.chosen] - training[answers.rejected]) / scale
    head = torch.zeros(gaps.shape[1], requires_grad=True)
    optimizer = torch.optim.LBFGS([head], max_iter=100, line_search_fn="strong_wolfe")

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        loss = ch96.reward_model_loss(gaps @ head, torch.zeros(len(gaps))) + 0.015 * head.square().sum()
        loss.backward()
        return loss

    optimizer.step(closure)
    accuracy = preferences.pairwise_accuracy(((held_out - level) / scale) @ head.detach(), test.means)
    row = {"accuracy": accuracy.estimate, "low": accuracy.low, "high": accuracy.high}
    return Result([row], row)


@functools.cache
@torch.no_grad()
def _features(texts: tuple[str, ...]) -> torch.Tensor:
    """(N, D)"""
    model, found = lm.load("tiny"), []
    for start in range(0, len(texts), 64):
        tokens = model.encode(texts[start : start + 64], ended=True)
        last = tokens.attention_mask.sum(1) - 1
        found.append(model.hidden(*tokens)[torch.arange(len(last)), last])
    return torch.cat(found)
