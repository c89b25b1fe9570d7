"""What RLHF on text needs beside PPO: supervised fine-tuning first, a frozen reward model's score, and many candidates (chapter 96)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from course_lib.language import lm, preferences
from course_lib.language.reward_models import LastTokenScores
from course_lib.seeding import seed_everything


def liked_texts(split: str) -> list[str]:
    """The film reviews of a split that its raters liked better than the median one."""
    snippets = preferences.load(split)
    return [text for text, mean in zip(snippets.texts, snippets.means, strict=True) if mean > snippets.means.median()]


def next_token_loss(policy: lm.LanguageModel, texts: Sequence[str]) -> torch.Tensor:
    """Cross-entropy of the texts' tokens, their end tokens included, in nats a token; scalar."""
    input_ids, mask = policy.encode(texts, ended=True)
    predicted = mask[:, 1:]
    return torch.nn.functional.cross_entropy(policy.logits(input_ids, mask)[:, :-1][predicted], input_ids[:, 1:][predicted])


def supervised(
    policy: lm.LanguageModel, texts: Sequence[str], seed: int, steps: int = 40, batch: int = 32, learning_rate: float = 3e-4
) -> Iterator[float]:
    """Supervised fine-tuning of `policy`, in place, on minibatches of `texts`. Yields: each step's loss, in nats a token."""
    generator = seed_everything(seed)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=learning_rate, weight_decay=0.0)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, steps)
    for _ in range(steps):
        picks = torch.randint(len(texts), (batch,), generator=generator).tolist()
        loss = next_token_loss(policy, [texts[pick] for pick in picks])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        yield loss.item()


@dataclass(frozen=True)
class Proxy:
    """A frozen reward model as a score of samples, prompts included: (model's score - level) / scale, constants once and for all."""

    model: torch.nn.Module
    last_token_scores: LastTokenScores
    level: float = 0.0
    scale: float = 1.0

    @torch.no_grad()
    def __call__(self, samples: lm.Samples) -> torch.Tensor:
        """(B,)"""
        scores = self.last_token_scores(self.model(samples.input_ids, samples.attention_mask), samples.attention_mask)
        return (scores - self.level) / self.scale

    def calibrated(self, samples: lm.Samples) -> Proxy:
        """The same with mean 0 and deviation 1 on these samples: those of the policy that PPO begins with."""
        scores = Proxy(self.model, self.last_token_scores)(samples)
        return Proxy(self.model, self.last_token_scores, scores.mean().item(), scores.std().item())


def whole_texts(policy: lm.LanguageModel, samples: lm.Samples) -> list[str]:
    """Prompts and completions: what a judge reads."""
    return policy.decode(samples.input_ids, samples.attention_mask)
