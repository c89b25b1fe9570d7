"""PPO on a language model with VADER's sentiment as reward, for several weights of the KL penalty (chapter 95).

The policy goes on from the first words of film reviews; what it adds is scored. Every row is one iteration: samples of the policy as
it was then. At the end, and before, texts to prompts that training has not seen are scored apart. The critic is a small network on what the
frozen reference's last layer knows of the text so far: that is computed anyway for the KL, so the critic costs next to nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch

from course_lib import lm, preferences
from course_lib.seeding import seed_everything
from course_lib.variety import distinct_n, repetition
from experiments.runner import Report, Result
from solutions.ch45 import minibatches
from solutions.ch95 import (
    completion_mask,
    kl_penalized_rewards,
    masked_gae,
    masked_mean,
    masked_whiten,
    per_token_logps,
    ppo_token_loss,
)

COMMON = {
    "model": "tiny",
    "iterations": 40,
    "batch": 64,
    "new_tokens": 20,
    "prompt_words": 3,
    "epochs": 2,
    "minibatch": 32,
    "learning_rate": 2e-4,
    "critic_learning_rate": 2e-3,
    "gamma": 1.0,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "evaluation_texts": 256,
}
VARIANTS = {f"kl_{kl_coef}": COMMON | {"kl_coef": kl_coef} for kl_coef in (0.0, 0.01, 0.05, 0.2)}
SEEDS = 5


@dataclass
class Batch:
    """Completions of one iteration and what is known about each token; (B, L - 1), but for scores (B,)."""

    texts: list[str]
    input_ids: torch.Tensor  # (B, L)
    attention_mask: torch.Tensor  # (B, L)
    mask: torch.Tensor
    logps: torch.Tensor
    ref_logps: torch.Tensor
    features: torch.Tensor  # (B, L - 1, D), of the reference, before each token is chosen
    scores: torch.Tensor

    def rows(self, index: torch.Tensor) -> Batch:
        return Batch(
            [self.texts[row] for row in index.tolist()],
            **{field.name: getattr(self, field.name)[index] for field in fields(self) if field.name != "texts"},
        )


def openings(split: str, words: int) -> list[str]:
    """The first words of each film review that goes on behind them."""
    texts = [text.split() for text in preferences.load(split).texts]
    return [" ".join(text[:words]) for text in texts if len(text) > words]


def token_logps(model: lm.LanguageModel, batch: Any) -> torch.Tensor:
    return per_token_logps(model.logits(batch.input_ids, batch.attention_mask), batch.input_ids)


@torch.no_grad()
def sample(policy, reference, prompts: list[str], new_tokens: int, generator: torch.Generator) -> Batch:
    """Let the policy write, and look at what it wrote with the eyes of the policy, the reference and VADER."""
    samples = policy.generate(prompts, new_tokens, generator=generator)
    features = reference.hidden(samples.input_ids, samples.attention_mask)
    kept = completion_mask(samples.input_ids, samples.prompt_lengths, policy.end_id)
    return Batch(
        texts=samples.texts,
        input_ids=samples.input_ids,
        attention_mask=samples.attention_mask,
        mask=kept[:, 1:],
        logps=token_logps(policy, samples),
        ref_logps=per_token_logps(reference.head(features), samples.input_ids),
        features=features[:, :-1],
        scores=preferences.vader(samples.texts),
    )


def measured(batch: Batch) -> dict[str, float]:
    """Score, departure from the reference and variety of a batch of texts."""
    ratios = torch.where(batch.mask, batch.logps - batch.ref_logps, 0).sum(1)
    return {
        "score": batch.scores.mean().item(),
        "score_std": batch.scores.std().item(),
        "kl": ratios.mean().item(),
        "kl_per_token": masked_mean(batch.logps - batch.ref_logps, batch.mask).item(),
        "perplexity": masked_mean(-batch.ref_logps, batch.mask).exp().item(),  # of the texts, under the reference
        "entropy": masked_mean(-batch.logps, batch.mask).item(),
        "tokens": batch.mask.sum(1).float().mean().item(),
        "distinct_1": distinct_n(batch.texts, 1),
        "distinct_2": distinct_n(batch.texts, 2),
        "repetition": repetition(batch.texts),
    }


def update(policy, critic, optimizer, batch: Batch, settings: dict[str, Any], generator: torch.Generator) -> dict[str, float]:
    """PPO's update: advantages from the critic as it is, then a few epochs of minibatches."""
    with torch.no_grad():
        values = critic(batch.features).squeeze(-1)
        rewards = kl_penalized_rewards(batch.scores, batch.logps, batch.ref_logps, batch.mask, settings["kl_coef"])
        advantages = masked_gae(rewards, values, batch.mask, settings["gamma"], settings["gae_lambda"])
        returns = advantages + values
        advantages = masked_whiten(advantages, batch.mask)
    policy_losses, value_losses = [], []
    for _ in range(settings["epochs"]):
        for index in minibatches(len(batch.scores), settings["minibatch"], generator):
            part = batch.rows(index)
            policy_loss = ppo_token_loss(
                token_logps(policy, part), part.logps, advantages[index], part.mask, settings["clip_range"]
            )
            value_loss = masked_mean((critic(part.features).squeeze(-1) - returns[index]) ** 2, part.mask)
            optimizer.zero_grad()
            (policy_loss + value_loss).backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
            optimizer.step()
            policy_losses.append(policy_loss.item())
            value_losses.append(value_loss.item())
    return {"policy_loss": sum(policy_losses) / len(policy_losses), "value_loss": sum(value_losses) / len(value_losses)}


def train(settings: dict[str, Any], seed: int, report: Callable[[int, int], None]) -> Result:
    """Collect, estimate, update, log; texts of the policy before and after to prompts that it has not seen."""
    generator = seed_everything(seed)
    policy = lm.load(settings["model"])
    reference = policy.frozen_copy()
    critic = torch.nn.Sequential(torch.nn.Linear(policy.width, 64), torch.nn.Tanh(), torch.nn.Linear(64, 1))
    optimizer = torch.optim.AdamW(
        [
            {"params": policy.parameters(), "lr": settings["learning_rate"]},
            {"params": critic.parameters(), "lr": settings["critic_learning_rate"]},
        ],
        weight_decay=0.0,
    )
    prompts, unseen = openings("policy", settings["prompt_words"]), openings("test", settings["prompt_words"])

    def evaluation() -> Batch:
        chosen = unseen[: settings["evaluation_texts"]]
        return sample(policy, reference, chosen, settings["new_tokens"], torch.Generator().manual_seed(10_000 + seed))

    before = evaluation()
    rows = []
    begun = time.perf_counter()
    for iteration in range(settings["iterations"]):
        picks = torch.randint(len(prompts), (settings["batch"],), generator=generator).tolist()
        batch = sample(policy, reference, [prompts[pick] for pick in picks], settings["new_tokens"], generator)
        losses = update(policy, critic, optimizer, batch, settings, generator)
        rows.append({"iteration": iteration, **measured(batch), **losses, "seconds": time.perf_counter() - begun})
        report(iteration + 1, settings["iterations"])
    after = evaluation()
    summary = {
        f"{name}_{when}": value
        for when, texts in (("before", before), ("after", after))
        for name, value in measured(texts).items()
    }
    summary["gain_in_deviations"] = (summary["score_after"] - summary["score_before"]) / summary["score_std_before"]
    shown = [
        {"prompt": prompt, "before": old, "after": new}
        for prompt, old, new in zip(unseen[:12], before.texts, after.texts, strict=False)
    ]
    return Result(rows, summary | {"texts": shown})


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    return train(VARIANTS[variant], seed, report)
