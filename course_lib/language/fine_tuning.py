"""PPO on the tokens of a language model: what it writes, what it is told, how it changes (chapters 95 to 97).

    taught = Taught.of(globals())                       # your functions of chapter 95
    policy = lm.load("tiny")
    writer = Writer(policy, policy.frozen_copy(), vader_scores, taught)
    for row in train(writer, openings("policy"), TokenPPO(kl_coef=0.05), seed=0):
        print(row["score"], row["kl"])

The loop is here and reads from top to bottom; what the chapter teaches, from the log-probabilities to the loss, is handed to it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch

from course_lib.chapters import earlier
from course_lib.language import lm, preferences
from course_lib.language.variety import distinct_n, repetition
from course_lib.seeding import seed_everything

Score = Callable[[lm.Samples], torch.Tensor]
"""What a text is worth: samples of B texts in, (B,) scores out."""


@dataclass(frozen=True)
class Taught:
    """The functions that chapters 45 and 95 ask for, under their names there."""

    minibatches: Callable
    per_token_logps: Callable
    completion_mask: Callable
    kl_penalized_rewards: Callable
    masked_mean: Callable
    masked_whiten: Callable
    masked_gae: Callable
    ppo_token_loss: Callable

    @classmethod
    def of(cls, *namespaces: Mapping[str, Any]) -> Taught:
        """Each function from the first namespace that has it, and from your earlier notebooks where none has."""
        found: dict[str, Any] = {}
        for field in fields(cls):
            inside = [namespace[field.name] for namespace in namespaces if field.name in namespace]
            yours = earlier("minibatches", 45) if field.name == "minibatches" else earlier(field.name, 95)
            found[field.name] = inside[0] if inside else yours
        return cls(**found)


@dataclass(frozen=True)
class TokenPPO:
    """Everything that one may choose in PPO on tokens. `learning_rate` is the policy's; the critic is small and has its own.

    The step is small and λ is 1: chapter 95 measures that larger steps pay more divergence for the same score.
    """

    kl_coef: float = 0.05  # in units of score per nat
    iterations: int = 50
    batch: int = 64  # texts of an iteration
    new_tokens: int = 20
    epochs: int = 2
    minibatch: int = 32
    learning_rate: float = 2e-4
    critic_learning_rate: float = 2e-3
    gamma: float = 1.0
    gae_lambda: float = 1.0
    clip_range: float = 0.2
    max_grad_norm: float = 1.0

    def but(self, **changes) -> TokenPPO:
        """These settings with some changed."""
        return replace(self, **changes)


@dataclass(frozen=True)
class Writing:
    """Texts and what is known about each of their tokens; (B, L - 1), column t for the choice of token t + 1."""

    samples: lm.Samples
    mask: torch.Tensor  # True at the tokens that the policy chose
    logps: torch.Tensor  # under the policy that wrote, in nats
    ref_logps: torch.Tensor  # under the reference
    features: torch.Tensor  # (B, L - 1, D), what the reference's last layer knows before each choice
    scores: torch.Tensor  # (B,)

    @property
    def texts(self) -> list[str]:
        return self.samples.texts

    def measured(self, taught: Taught) -> dict[str, float]:
        """Score, departure from the reference and variety."""
        log_ratio = self.logps - self.ref_logps
        return {
            "score": self.scores.mean().item(),
            "score_std": self.scores.std().item(),
            "kl": torch.where(self.mask, log_ratio, 0)
            .sum(1)
            .mean()
            .item(),  # of a text, in nats, estimated from the policy's own
            "kl_per_token": taught.masked_mean(log_ratio, self.mask).item(),
            "perplexity": taught.masked_mean(-self.ref_logps, self.mask).exp().item(),  # of the texts, under the reference
            "entropy": taught.masked_mean(-self.logps, self.mask).item(),  # of a token
            "tokens": self.mask.sum(1).float().mean().item(),
            "distinct_1": distinct_n(self.texts, 1),
            "distinct_2": distinct_n(self.texts, 2),
            "repetition": repetition(self.texts),
        }


@dataclass(frozen=True)
class Writer:
    """A policy, the frozen reference that it began as, and what its texts are worth."""

    policy: lm.LanguageModel
    reference: lm.LanguageModel
    score: Score
    taught: Taught

    @torch.no_grad()
    def write(self, prompts: Sequence[str], new_tokens: int, generator: torch.Generator) -> Writing:
        """Let the policy go on from each prompt, and look at what it wrote with the eyes of the policy, the reference and the score."""
        samples = self.policy.generate(prompts, new_tokens, generator=generator)
        features = self.reference.hidden(samples.input_ids, samples.attention_mask)
        kept = self.taught.completion_mask(samples.input_ids, samples.prompt_lengths, self.policy.end_id)
        return Writing(
            samples=samples,
            mask=kept[:, 1:],
            logps=self.logps(samples.input_ids, samples.attention_mask),
            ref_logps=self.taught.per_token_logps(self.reference.head(features), samples.input_ids),
            features=features[:, :-1],
            scores=self.score(samples),
        )

    def logps(self, input_ids: torch.Tensor, attention_mask: torch.Tensor) -> torch.Tensor:
        """Of every token but the first under the policy as it is now; (B, L - 1), with a graph where one is kept."""
        return self.taught.per_token_logps(self.policy.logits(input_ids, attention_mask), input_ids)


class ActorCritic:
    """A policy, the critic of `train`, and one optimiser for both: what an iteration of PPO on tokens changes.

    Args:
      policy: language model that learns.
      settings: its learning rates are used here.
    """

    def __init__(self, policy: lm.LanguageModel, settings: TokenPPO):
        self.policy = policy
        self.critic = torch.nn.Sequential(torch.nn.Linear(policy.width, 64), torch.nn.Tanh(), torch.nn.Linear(64, 1))
        groups = [
            {"params": policy.parameters(), "lr": settings.learning_rate},
            {"params": self.critic.parameters(), "lr": settings.critic_learning_rate},
        ]
        self.optimizer = torch.optim.AdamW(groups, weight_decay=0.0)

    def step(self, loss: torch.Tensor, max_grad_norm: float) -> None:
        """One step down the gradient of a loss; the policy's is shortened to this norm if it is longer."""
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), max_grad_norm)
        self.optimizer.step()


@torch.no_grad()
def estimate(writer: Writer, critic, writing: Writing, settings: TokenPPO) -> tuple[torch.Tensor, torch.Tensor]:
    """Whitened advantages of the tokens, and what the critic should have said of them; (B, L - 1) each."""
    taught, mask = writer.taught, writing.mask
    values = critic(writing.features).squeeze(-1)
    rewards = taught.kl_penalized_rewards(writing.scores, writing.logps, writing.ref_logps, mask, settings.kl_coef)
    advantages = taught.masked_gae(rewards, values, mask, settings.gamma, settings.gae_lambda)
    return taught.masked_whiten(advantages, mask), advantages + values


def improve(
    writer: Writer, critic, optimizer, writing: Writing, advantages, returns, settings: TokenPPO, generator: torch.Generator
) -> dict[str, float]:
    """A few epochs of minibatches of the clipped loss, and of the critic's.

    Returns: the means over all minibatches of policy_loss, value_loss and clip_fraction, the share of tokens whose ratio to
      `writing.logps` is out of the clip's interval.
    """
    taught, mask = writer.taught, writing.mask
    logged = []
    for _ in range(settings.epochs):
        for rows in taught.minibatches(len(mask), settings.minibatch, generator):
            kept, old_logps = mask[rows], writing.logps[rows]
            logps = writer.logps(writing.samples.input_ids[rows], writing.samples.attention_mask[rows])
            policy_loss = taught.ppo_token_loss(logps, old_logps, advantages[rows], kept, settings.clip_range)
            value_errors = critic(writing.features[rows]).squeeze(-1) - returns[rows]
            value_loss = taught.masked_mean(value_errors**2, kept)
            optimizer.zero_grad()
            (policy_loss + value_loss).backward()
            torch.nn.utils.clip_grad_norm_(writer.policy.parameters(), settings.max_grad_norm)
            optimizer.step()
            outside = ((logps - old_logps).expm1().abs() > settings.clip_range).to(logps.dtype)
            logged.append(torch.stack([policy_loss, value_loss, taught.masked_mean(outside, kept)]).detach())
    return dict(zip(("policy_loss", "value_loss", "clip_fraction"), torch.stack(logged).mean(0).tolist(), strict=True))


def update(
    writer: Writer, critic, optimizer, writing: Writing, settings: TokenPPO, generator: torch.Generator
) -> dict[str, float]:
    """Estimate advantages with the critic as it is, then improve both policy and critic. Returns: see `improve`."""
    advantages, returns = estimate(writer, critic, writing, settings)
    return improve(writer, critic, optimizer, writing, advantages, returns, settings, generator)


def train(
    writer: Writer, prompts: Sequence[str], settings: TokenPPO, seed: int, update: Callable = update
) -> Iterator[dict[str, float]]:
    """Write, estimate, update, log: PPO on `writer.policy`, in place, one row for each iteration.

    The critic is a small network on what the frozen reference's last layer knows of the text so far: that is computed anyway for the KL,
    so the critic costs next to nothing.

    Args:
      prompts: of which every iteration draws `settings.batch`, with replacement.
      update: takes the place of this module's.

    Yields: what `Writing.measured` and `update` say, with iteration and seconds.
    """
    generator = seed_everything(seed)
    critic = torch.nn.Sequential(torch.nn.Linear(writer.policy.width, 64), torch.nn.Tanh(), torch.nn.Linear(64, 1))
    optimizer = torch.optim.AdamW(
        [
            {"params": writer.policy.parameters(), "lr": settings.learning_rate},
            {"params": critic.parameters(), "lr": settings.critic_learning_rate},
        ],
        weight_decay=0.0,
    )
    begun = time.perf_counter()
    for iteration in range(settings.iterations):
        picks = torch.randint(len(prompts), (settings.batch,), generator=generator).tolist()
        writing = writer.write([prompts[pick] for pick in picks], settings.new_tokens, generator)
        losses = update(writer, critic, optimizer, writing, settings, generator)
        yield {
            "iteration": iteration, **writing.measured(writer.taught), **losses, "seconds": time.perf_counter() - begun,
        }  # fmt: skip


def openings(split: str, words: int = 3) -> list[str]:
    """The first words of each film review of a split that goes on behind them: prompts."""
    texts = [text.split() for text in preferences.load(split).texts]
    return [" ".join(text[:words]) for text in texts if len(text) > words]


def vader_scores(samples: lm.Samples) -> torch.Tensor:
    """VADER's sentiment of the completions alone, (B,) in [-1, 1]."""
    return preferences.vader(samples.texts)
