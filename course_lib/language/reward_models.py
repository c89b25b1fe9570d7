"""Reward models that a laptop trains in seconds (chapters 96 and 97).

    model = fit(RewardModel(lm.load("tiny"), seed=0), preferences.comparisons(4000, seed=0), loss, last_token_scores, seed=0)
    model.scores(["The film is a joy."], last_token_scores)

A reward model is anything that gives a number for each token, of which the last one counts: `lm.ValueModel`, the body of a language model,
is one, and the usual one. The one here is much smaller: the tiny language model knows too little of what words mean for its body to help.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import torch

from course_lib.language.lm import LanguageModel, Tokens
from course_lib.language.preferences import Preferences
from course_lib.seeding import seed_everything

PAIRS = 8192  # neighbouring tokens are known by a hash
Loss = Callable[..., torch.Tensor]  # of chosen and rejected scores and, where there are margins, of these; (B,) each
LastTokenScores = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


class RewardModel(torch.nn.Module):
    """A vector for each token and each pair of neighbours, averaged over the text so far, and a small network that reads the average."""

    def __init__(self, reader: LanguageModel, width: int = 16, seed: int = 0):
        """`reader` is who turns texts into tokens; nothing else of it is used."""
        super().__init__()
        seed_everything(seed)
        self.encode, self.vocabulary = reader.encode, len(reader.tokenizer)
        self.tokens = torch.nn.Embedding(self.vocabulary, width)
        self.pairs = torch.nn.Embedding(PAIRS, width)
        self.head = torch.nn.Sequential(torch.nn.Linear(width, width), torch.nn.Tanh(), torch.nn.Linear(width, 1))
        for table in (self.tokens, self.pairs):
            torch.nn.init.normal_(table.weight, std=0.1)

    def forward(self, input_ids: torch.Tensor, attention_mask: torch.Tensor) -> torch.Tensor:
        """Values at every position, (B, L); what they are at padding means nothing."""
        mask = attention_mask.bool()
        hashes = (input_ids[:, :-1] * self.vocabulary + input_ids[:, 1:]) * 2654435761 % PAIRS
        neighbours = torch.where((mask[:, :-1] & mask[:, 1:])[..., None], self.pairs(hashes), 0)
        vectors = torch.where(mask[..., None], self.tokens(input_ids), 0) + torch.nn.functional.pad(neighbours, (0, 0, 1, 0))
        so_far = vectors.cumsum(1) / mask.cumsum(1).clamp(min=1)[..., None]  # (B, L, D)
        return self.head(10 * so_far).squeeze(-1)

    @torch.no_grad()
    def scores(self, texts: Sequence[str], last_token_scores: LastTokenScores) -> torch.Tensor:
        """What each text is worth; (B,)."""
        tokens = self.encode(texts, ended=True)
        return last_token_scores(self(*tokens), tokens.attention_mask)


@functools.lru_cache(maxsize=2)
def _encoded(encode: Callable, texts: tuple[str, ...]) -> Tokens:
    """Texts as tokens that are only read: whoever fits several models to comparisons of the same texts waits for the tokenizer once."""
    return encode(texts, ended=True)


def fit(
    model: RewardModel,
    comparisons: Preferences,
    loss: Loss,
    last_token_scores: LastTokenScores,
    seed: int,
    steps: int = 300,
    batch: int = 64,
    learning_rate: float = 2e-3,
    weight_decay: float = 3.0,
    margins: torch.Tensor | None = None,
) -> RewardModel:
    """Minimise `loss` of chosen and rejected scores over minibatches of comparisons, with a learning rate that falls to 0.

    `margins`, one for each comparison, are handed to `loss` as its third argument.

    Returns: the model, frozen: nothing that uses it may train it by accident.
    """
    generator = torch.Generator().manual_seed(seed)
    tokens = _encoded(model.encode, tuple(comparisons.texts))
    lengths = tokens.attention_mask.sum(1)
    optimizer = torch.optim.AdamW(model.parameters(), lr=learning_rate, weight_decay=weight_decay)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, steps)
    for _ in range(steps):
        picks = torch.randint(len(comparisons), (batch,), generator=generator)
        rows = torch.cat([comparisons.chosen[picks], comparisons.rejected[picks]])
        width = lengths[rows].max()
        here = Tokens(tokens.input_ids[rows, :width], tokens.attention_mask[rows, :width])
        chosen, rejected = last_token_scores(model(*here), here.attention_mask).split(batch)
        optimizer.zero_grad()
        (loss(chosen, rejected) if margins is None else loss(chosen, rejected, margins[picks])).backward()
        optimizer.step()
        schedule.step()
    return model.requires_grad_(False).eval()
