"""How varied a policy's texts are: what falls when a language model collapses."""

from __future__ import annotations

from collections.abc import Sequence


def _grams(text: str, n: int) -> list[tuple[str, ...]]:
    words = text.lower().split()
    return [tuple(words[i : i + n]) for i in range(len(words) - n + 1)]


def distinct_n(texts: Sequence[str], n: int) -> float:
    """Different sequences of n words over all sequences of n words, in all texts together; 0 if there are none.

    Li et al. (2016), https://arxiv.org/abs/1510.03055. It falls as the number of texts grows: compare like with like.
    """
    grams = [gram for text in texts for gram in _grams(text, n)]
    return len(set(grams)) / len(grams) if grams else 0.0


def repetition(texts: Sequence[str], n: int = 1) -> float:
    """Share of the sequences of n words that have occurred in their own text before; 0 if there are none."""
    rows = [_grams(text, n) for text in texts]
    total = sum(map(len, rows))
    return 1 - sum(len(set(row)) for row in rows) / total if total else 0.0
