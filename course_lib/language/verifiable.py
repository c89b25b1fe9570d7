"""Sorting digits, a task that a program verifies: its prompts, a small language model of characters, and measurements (chapter 101).

policy = fresh(seed=0)
list(warm_up(policy, steps=100, seed=0))
prompts = questions(64, generator=seed_everything(1), held_out=True)    # such as "49381=", to be answered by "13489"
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import tokenizers
import torch
import transformers

from course_lib.language import lm
from course_lib.language.rlhf import next_token_loss
from course_lib.seeding import seed_everything

Verify = Callable[[Sequence[str], Sequence[str]], torch.Tensor]
"""Prompts and as many completions in, rewards (B,) out."""

CHARACTERS = "0123456789="
DIGITS = (5,)  # how many a prompt may have
ROOM = 8  # tokens of a completion, the end token included: an answer of five digits needs six
HELD_OUT = 5  # one answer in so many is never asked for in training


def fresh(seed: int, width: int = 64, layers: int = 2, heads: int = 4) -> lm.LanguageModel:
    """An untrained language model whose tokens are digits, "=" and the end token; GPT-2's architecture, without dropout."""
    vocabulary = {character: index for index, character in enumerate(CHARACTERS)} | {lm.END: len(CHARACTERS)}
    splitter = tokenizers.Tokenizer(tokenizers.models.WordLevel(vocabulary, unk_token=lm.END))
    splitter.pre_tokenizer = tokenizers.pre_tokenizers.Split("", "isolated")
    splitter.decoder = tokenizers.decoders.Fuse()
    seed_everything(seed)
    config = transformers.GPT2Config(  # type: ignore[attr-defined]
        vocab_size=len(vocabulary), n_positions=32, n_embd=width, n_layer=layers, n_head=heads,
        resid_pdrop=0.0, embd_pdrop=0.0, attn_pdrop=0.0, activation_function="gelu_pytorch_tanh",
        bos_token_id=len(CHARACTERS), eos_token_id=len(CHARACTERS),
    )  # fmt: skip
    tokenizer = transformers.PreTrainedTokenizerFast(tokenizer_object=splitter)
    return lm.LanguageModel(transformers.GPT2LMHeadModel(config), tokenizer).eval()  # type: ignore[attr-defined]


def answer(prompt: str) -> str:
    """What is right: the prompt's digits in order."""
    return "".join(sorted(prompt.removesuffix("=")))


def questions(count: int, generator: torch.Generator, digits: Sequence[int] = DIGITS, held_out: bool = False) -> list[str]:
    """Prompts such as "49381=", drawn with replacement; one *answer* in five is kept for those that are held out.

    Args:
      digits: how many a prompt has, one of these, each as often.
    """
    found: list[str] = []
    while len(found) < count:
        sizes = torch.tensor(digits)[torch.randint(len(digits), (2 * count,), generator=generator)].tolist()
        drawn = torch.randint(10, (2 * count, max(digits)), generator=generator).tolist()
        for size, row in zip(sizes, drawn, strict=True):
            prompt = "".join(map(str, row[:size])) + "="
            if (zlib.crc32(answer(prompt).encode()) % HELD_OUT == 0) == held_out:
                found.append(prompt)
    return found[:count]


def warm_up(
    policy: lm.LanguageModel,
    steps: int,
    seed: int,
    digits: Sequence[int] = DIGITS,
    batch: int = 64,
    learning_rate: float = 1e-3,
) -> Iterator[float]:
    """A little supervised learning from right answers, in place. Yields: each step's loss, in nats a token."""
    generator = seed_everything(seed)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=learning_rate, weight_decay=0.0)
    for _ in range(steps):
        asked = questions(batch, generator, digits)
        loss = next_token_loss(policy, [prompt + answer(prompt) for prompt in asked])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        yield loss.item()


def measured(
    policy: lm.LanguageModel,
    verify: Verify,
    pass_at_k: Callable,
    generator: torch.Generator,
    digits: Sequence[int] = DIGITS,
    prompts: int = 96,
    samples: int = 16,
    room: int = ROOM,
    temperature: float = 1.0,
) -> dict[str, float]:
    """On held-out prompts, sampled at a temperature: pass@1, pass@4 and pass@16, characters of an answer; and how often the answer is
    right that takes the likeliest token each time ("greedy")."""
    asked = questions(prompts, generator, digits, held_out=True)
    rows = [prompt for prompt in asked for _ in range(samples)]
    texts = policy.generate(rows, room, temperature, generator).texts
    correct = verify(rows, texts).reshape(-1, samples).sum(1).long()
    greedy = policy.generate(asked, room, temperature=0.0).texts
    return {
        **{f"pass_{k}": pass_at_k(samples, correct, k).mean().item() for k in (1, 4, 16) if k <= samples},
        "greedy": verify(asked, greedy).mean().item(),
        "characters": sum(map(len, texts)) / len(texts),
    }


@dataclass(frozen=True)
class GroupSettings:
    """Everything that one may choose in an iteration of GRPO."""

    prompts: int = 24  # of an iteration
    group_size: int = 8  # answers to each
    new_tokens: int = ROOM
    epochs: int = 1
    minibatch: int = 64  # answers of a step
    learning_rate: float = 3e-4
    baseline: str = "mean"
    scale: str = "group"
    how: str = "tokens"
    clip_low: float = 0.2
    clip_high: float = 0.28
    max_grad_norm: float = 1.0

    def but(self, **changes) -> GroupSettings:
        """These settings with some changed."""
        return replace(self, **changes)


class Learner:
    """A model with an optimiser: all that an iteration needs of a policy."""

    def __init__(self, model: Any, learning_rate: float = GroupSettings.learning_rate):
        self.model = model
        self.optimizer = torch.optim.AdamW(model.parameters(), lr=learning_rate, weight_decay=0.0)

    @property
    def end_id(self) -> int:
        return self.model.end_id

    def generate(self, prompts: Sequence[str], max_new_tokens: int, generator: torch.Generator | None = None) -> lm.Samples:
        return self.model.generate(prompts, max_new_tokens, generator=generator)

    def logits(self, input_ids: torch.Tensor, attention_mask: torch.Tensor) -> torch.Tensor:
        """Logits of the next token at every position, (B, L, V); what they are at padding means nothing."""
        nothing_before = attention_mask[:, 0].all()  # then no mask is needed: no kept token looks at the padding behind it
        return self.model.logits(input_ids, attention_mask | nothing_before)

    def step(self, loss: torch.Tensor, max_grad_norm: float) -> None:
        """One step down the gradient of a loss, which is shortened to this norm if it is longer."""
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), max_grad_norm)
        self.optimizer.step()


class Table(torch.nn.Module):
    """A policy that is a table, for trying an iteration out in milliseconds: it answers prompts of one digit, such as "2=".

    Args:
      table: logits of the token behind the digit ("=", which is given), of the first and of all later tokens of the answer, for each
        digit; (D, 3, V). The last token of the vocabulary ends an answer, the last but one is "=".
      learning_rate: of plain gradient descent.
    """

    def __init__(self, table: torch.Tensor, learning_rate: float):
        super().__init__()
        self.table = torch.nn.Parameter(table)
        self.steps: torch.Tensor
        self.register_buffer("steps", torch.tensor(0))
        self.learning_rate = learning_rate
        self.end_id = table.shape[-1] - 1

    def logits(self, input_ids: torch.Tensor, attention_mask: torch.Tensor) -> torch.Tensor:
        return self.table[input_ids[:, :1], torch.arange(input_ids.shape[1]).clamp(max=2)]

    @torch.no_grad()
    def generate(self, prompts: Sequence[str], max_new_tokens: int, generator: torch.Generator | None = None) -> lm.Samples:
        ids = torch.tensor([[int(prompt[0]), self.end_id - 1] for prompt in prompts])
        mask = torch.ones_like(ids, dtype=torch.bool)
        alive = mask[:, 0]
        for _ in range(max_new_tokens):
            drawn = torch.multinomial(self.logits(ids, mask)[:, -1].softmax(-1), 1, generator=generator).squeeze(1)
            ids = torch.cat([ids, torch.where(alive, drawn, self.end_id)[:, None]], 1)
            mask = torch.cat([mask, alive[:, None]], 1)
            alive = alive & (drawn != self.end_id)
        texts = ["".join(str(token) for token in row if token < self.end_id - 1) for row in ids[:, 2:].tolist()]
        return lm.Samples(ids, mask, torch.full((len(ids),), 2), texts)

    def step(self, loss: torch.Tensor, max_grad_norm: float) -> None:
        (gradient,) = torch.autograd.grad(loss, self.table)
        with torch.no_grad():
            self.table.sub_(self.learning_rate * gradient * (max_grad_norm / gradient.norm().clamp(min=max_grad_norm)))
            self.steps.add_(1)


def verifier(reward: float | None = None) -> Verify:
    """Pays 1 for right answers, or always the same `reward`."""
    return lambda prompts, completions: torch.tensor(
        [float(text == answer(prompt)) if reward is None else reward for prompt, text in zip(prompts, completions, strict=True)]
    )
