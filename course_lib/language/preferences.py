"""Human ratings of short texts, the preferences that follow from them, and how well people agree (chapters 95 to 97).

The ratings are those of Hutto and Gilbert (2014): see course_lib/data/README.md. A text's split is a property of the text:

    policy        the language model is pretrained and fine-tuned on these texts
    validation    choose settings and stop early by these
    reward_model  preferences for reward models and for DPO (and, as mere text, for pretraining)
    gold          trains the judge that is held out: no policy and no reward model sees these texts or their ratings
    test          every reported figure
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq
import torch
from vaderSentiment.vaderSentiment import SentimentIntensityAnalyzer

RATINGS = Path(__file__).parents[1] / "data" / "ratings.parquet"
SHA256 = "1bf89a02e9c4ddd290c1d6510971da143cfbf4a609e35bd2218b1826be5e9ff4"
SPLITS = ("policy", "validation", "reward_model", "gold", "test")
SOURCES = ("film", "amazon", "news", "tweet")
LOWEST, HIGHEST = -4, 4  # of the scale of the ratings


# --------------------------------------------------------------------------------------------------- texts and ratings


@dataclass(frozen=True)
class Snippets:
    """N texts with their raters' scores, integers from -4 (extremely negative) to 4.

    Raters are anonymous: the position of a score says nothing about who gave it, in this text or another.
    """

    ids: list[str]
    texts: list[str]
    ratings: list[torch.Tensor]

    def __len__(self) -> int:
        return len(self.texts)

    @functools.cached_property
    def means(self) -> torch.Tensor:
        """Mean rating of each text; (N,) float32."""
        return torch.stack([ratings.float().mean() for ratings in self.ratings])

    @functools.cached_property
    def frequencies(self) -> torch.Tensor:
        """Share of the raters who gave each of the nine scores; (N, 9) float32, rows sum to 1."""
        counts = [torch.bincount(ratings.long() - LOWEST, minlength=HIGHEST - LOWEST + 1) for ratings in self.ratings]
        return torch.stack([count / count.sum() for count in counts])


@functools.cache
def _table() -> dict[str, list]:
    payload = RATINGS.read_bytes()
    if hashlib.sha256(payload).hexdigest() != SHA256:
        raise ValueError(f"{RATINGS} is damaged or of another version: its SHA-256 is not {SHA256}")
    return pq.read_table(pa.BufferReader(payload)).to_pydict()


def load(split: str, sources: Sequence[str] = ("film",)) -> Snippets:
    """The snippets of one split, from the given sources, in a fixed order.

    Args:
      split: one of SPLITS.
      sources: any of SOURCES: film reviews, Amazon reviews, newspaper editorials, tweets.

    Raises: ValueError if there is no such split or source.
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {', '.join(SPLITS)}, got {split!r}")
    if isinstance(sources, str) or not set(sources) <= set(SOURCES):
        raise ValueError(f"sources must be a tuple of some of {', '.join(SOURCES)}, got {sources!r}")
    table = _table()
    kinds = enumerate(zip(table["split"], table["source"], strict=True))
    rows = [row for row, (of_split, of_source) in kinds if of_split == split and of_source in sources]
    return Snippets(
        ids=[table["id"][row] for row in rows],
        texts=[table["text"][row] for row in rows],
        ratings=[torch.tensor(table["ratings"][row], dtype=torch.int8) for row in rows],
    )


# -------------------------------------------------------------------------------------------------------- preferences


@dataclass(frozen=True)
class Preferences:
    """B comparisons between texts: `chosen` and `rejected` are indices into `texts`; (B,) int64 each.

    `disagreement` is the chance that two people, one rater of either text, would order the pair the other way; (B,) in [0, 1], ties
    counted half. `gap` is the difference between the mean ratings of chosen and rejected; (B,), negative where a label is wrong.
    """

    texts: list[str]
    chosen: torch.Tensor
    rejected: torch.Tensor
    disagreement: torch.Tensor
    gap: torch.Tensor

    def __len__(self) -> int:
        return len(self.chosen)

    @property
    def chosen_texts(self) -> list[str]:
        return [self.texts[index] for index in self.chosen.tolist()]

    @property
    def rejected_texts(self) -> list[str]:
        return [self.texts[index] for index in self.rejected.tolist()]

    def swapped(self, where: torch.Tensor) -> Preferences:
        """The same comparisons with the label turned round where `where`, (B,) bool, is True."""
        return replace(
            self,
            chosen=torch.where(where, self.rejected, self.chosen),
            rejected=torch.where(where, self.chosen, self.rejected),
            disagreement=torch.where(where, 1 - self.disagreement, self.disagreement),
            gap=torch.where(where, -self.gap, self.gap),
        )


def disagreement(frequencies_a: torch.Tensor, frequencies_b: torch.Tensor) -> torch.Tensor:
    """Chance that a rater of text a scores it below what a rater of text b gives b, ties counted half.

        P(A < B) + P(A = B) / 2,   A, B independent draws from the two texts' ratings

    Args:
      frequencies_a, frequencies_b: share of each score, in rising order of the score; (B, K).

    Returns: (B,) in [0, 1].
    """
    below = frequencies_b.flip(-1).cumsum(-1).flip(-1) - frequencies_b  # (B, K): P(B > score)
    return (frequencies_a * (below + frequencies_b / 2)).sum(-1)


def draw_pairs(snippets: Snippets, num_pairs: int, generator: torch.Generator, min_gap: float = 0.0) -> Preferences:
    """Random pairs of different texts, labelled by their mean ratings: the preferences of the whole panel.

    Args:
      snippets: from which pairs are drawn, uniformly and with replacement.
      num_pairs: B, how many.
      generator: of the draws.
      min_gap: pairs whose mean ratings differ by no more than this are left out; ties always are.

    Returns: Preferences of B pairs.
    Raises: ValueError if no pair differs by more than min_gap.
    """
    spread = (snippets.means.max() - snippets.means.min()).item()
    if not 0 <= min_gap < spread:
        raise ValueError(f"min_gap must be at least 0 and below the spread of the mean ratings, {spread:.2f}, got {min_gap}")
    kept: list[torch.Tensor] = []
    while sum(len(part) for part in kept) < num_pairs:
        part = torch.randint(len(snippets), (2 * num_pairs, 2), generator=generator)  # (2B, 2)
        gaps = snippets.means[part[:, 0]] - snippets.means[part[:, 1]]
        kept.append(torch.where(gaps[:, None] > 0, part, part.flip(1))[gaps.abs() > min_gap])
    chosen, rejected = torch.cat(kept)[:num_pairs].unbind(1)
    return Preferences(
        snippets.texts,
        chosen,
        rejected,
        disagreement(snippets.frequencies[chosen], snippets.frequencies[rejected]),
        snippets.means[chosen] - snippets.means[rejected],
    )


def ask_two_raters(preferences: Preferences, generator: torch.Generator) -> Preferences:
    """The labels that single people would give: each pair is turned round with the probability that is its disagreement."""
    draws = torch.rand(len(preferences), generator=generator)
    return preferences.swapped(draws < preferences.disagreement)


def told_differences(preferences: Preferences, snippets: Snippets, generator: torch.Generator) -> torch.Tensor:
    """By how many points the two people differed who gave each answer: drawn from all pairs of raters who would have given it.

        P(a - b | chosen ≻ rejected),   (a, b) with weight 1 where a > b, and 1/2 where a = b: a coin had decided

    Args:
      preferences: answers that two raters of `snippets` can have given, as `ask_two_raters` makes them; B of them.
      snippets: the texts, in the order of preferences.texts.
      generator: of the draws.

    Returns: (B,) float32, from 0 to HIGHEST - LOWEST.
    """
    scores = torch.arange(LOWEST, HIGHEST + 1)
    points = scores[:, None] - scores[None, :]  # (K, K): of the chosen text's rater less the other's
    chosen, rejected = snippets.frequencies[preferences.chosen], snippets.frequencies[preferences.rejected]  # (B, K) each
    weights = chosen[:, :, None] * rejected[:, None, :] * torch.where(points > 0, 1.0, torch.where(points == 0, 0.5, 0.0))
    return points.flatten()[torch.multinomial(weights.flatten(1), 1, generator=generator).squeeze(1)].float()


def flip_labels(preferences: Preferences, rate: float, generator: torch.Generator) -> Preferences:
    """Careless labels: each pair is turned round with probability `rate`, whatever the texts.

    Raises: ValueError if rate is outside [0, 1].
    """
    if not 0 <= rate <= 1:
        raise ValueError(f"rate must lie in [0, 1], got {rate}")
    return preferences.swapped(torch.rand(len(preferences), generator=generator) < rate)


def comparisons(num_pairs: int, seed: int, split: str = "reward_model") -> Preferences:
    """What reward models and DPO are trained on: random pairs of film reviews, each answered as two people might, one for each text.

    Args:
      num_pairs: B, how many.
      seed: of the pairs and of the answers.
      split: where the texts are from.
    """
    generator = torch.Generator().manual_seed(seed)
    return ask_two_raters(draw_pairs(load(split), num_pairs, generator), generator)


# ---------------------------------------------------------------------------------------------------------- agreement


class Interval(NamedTuple):
    """An estimate with its 95% confidence interval."""

    estimate: float
    low: float
    high: float


def _agreement(scores: torch.Tensor, labels: torch.Tensor, min_gap: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Agreement about each pair of texts, 1, ½ (a tie of the scores) or 0, and which pairs count; (N, N) each."""
    gaps = labels[:, None] - labels[None, :]
    counts = gaps.abs() > min_gap
    return ((scores[:, None] - scores[None, :]).sign() * gaps.sign() + 1) / 2 * counts, counts.to(scores.dtype)


def _ratio(agreement: torch.Tensor, counts: torch.Tensor) -> Interval:
    """Agreement over counted pairs, from each text's sums over its pairs, (N,) each; interval by the U-statistic's projection."""
    estimate = agreement.sum() / counts.sum()
    influence = 2 * (agreement - estimate * counts) / counts.mean()
    half_width = 1.96 * influence.std() / len(influence) ** 0.5
    return Interval(estimate.item(), (estimate - half_width).item(), (estimate + half_width).item())


def pairwise_accuracy(scores: torch.Tensor, labels: torch.Tensor, min_gap: float = 0.0) -> Interval:
    """How often scores put two texts in the order of their labels, over all pairs of N texts; ties of the scores count half.

    Pairs share texts, so the interval treats the texts, not the pairs, as the sample (Hoeffding's projection of the U-statistic).

    Args:
      scores: of a reward model, a judge or a person; (N,).
      labels: mean ratings; (N,).
      min_gap: pairs whose labels differ by no more than this are left out; ties always are.
    """
    agreement, counts = _agreement(scores.double(), labels.double(), min_gap)
    return _ratio(agreement.sum(1), counts.sum(1))


def agreement_ceiling(
    snippets: Snippets, raters: int | None = 1, min_gap: float = 0.0, num_draws: int = 20, seed: int = 0
) -> Interval:
    """How often people agree with other people about which of two texts is the more positive one.

    The raters of every text are split at random: `raters` of them give its score and the others its label. What is returned is the
    pairwise accuracy of these human scores, averaged over splits.

    Args:
      snippets: N texts, of which all pairs are used.
      raters: how many people score each text: 1 for a single person, None for half of the panel against the other half.
      min_gap: pairs whose labels differ by no more than this are left out; ties always are.
      num_draws: random splits.
      seed: of the splits.
    """
    generator = torch.Generator().manual_seed(seed)
    agreement = counts = torch.zeros(len(snippets), dtype=torch.float64)
    for _ in range(num_draws):
        scores, labels = [], []
        for ratings in snippets.ratings:
            shuffled = ratings[torch.randperm(len(ratings), generator=generator)].double()
            cut = len(shuffled) // 2 if raters is None else raters
            scores.append(shuffled[:cut].mean())
            labels.append(shuffled[cut:].mean())
        agreed, counted = _agreement(torch.stack(scores), torch.stack(labels), min_gap)
        agreement, counts = agreement + agreed.sum(1), counts + counted.sum(1)
    return _ratio(agreement, counts)


# ------------------------------------------------------------------------------------------- the cheap simulated labeller


@functools.cache
def _analyser() -> SentimentIntensityAnalyzer:
    return SentimentIntensityAnalyzer()


def vader(texts: Sequence[str]) -> torch.Tensor:
    """VADER's compound sentiment of each text, from a lexicon and a few rules: cheap, crude and easily fooled.

    Hutto and Gilbert (2014). Returns: (B,) float32 in [-1, 1].
    """
    return torch.tensor([_analyser().polarity_scores(text)["compound"] for text in texts], dtype=torch.float32)
