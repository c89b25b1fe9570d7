"""The judge that is held out: what policies' texts are really worth, as far as a model can say (chapters 95 to 97).

It is trained on the texts of the split "gold", which no policy and no reward model sees, and it is of another kind than they are: a linear
model of words, pairs of words and parts of words. What a policy learns to exploit in a reward model is not what this one gets wrong.

    judge = gold_judge()
    judge(["A masterpiece.", "A mess."])   # mean rating that it expects, from -4 to 4

`python tools/train_gold_judge.py` trains it and says how good it is.
"""

from __future__ import annotations

import functools
import itertools
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import safetensors.torch
import torch

WEIGHTS = Path(__file__).parents[1] / "models" / "gold_judge" / "weights.safetensors"
BUCKETS = 2**17  # features are known by a hash of their text alone


@dataclass(frozen=True)
class LinearJudge:
    """Expected rating = `level` + a text's features, by `rarity` (BUCKETS,) and of length 1, times `weights` (BUCKETS,)."""

    weights: torch.Tensor
    rarity: torch.Tensor
    level: torch.Tensor

    def __call__(self, texts: Sequence[str]) -> torch.Tensor:
        """The mean rating that people would give each text, in units of the scale from -4 to 4; (B,) float32."""
        return self.level + features(texts, self.rarity) @ self.weights


@functools.cache
def gold_judge() -> LinearJudge:
    """The judge that is held out, from its committed weights."""
    return LinearJudge(**{name: tensor.float() for name, tensor in safetensors.torch.load_file(WEIGHTS).items()})


def features(texts: Sequence[str], rarity: torch.Tensor) -> torch.Tensor:
    """What the judge knows of each text: which features occur, weighted by rarity and brought to length 1; (B, BUCKETS) sparse.

    A feature whose rarity is 0 is unknown. A text without known features has none.
    """
    rows, columns, values = [], [], []
    for row, text in enumerate(texts):
        found = torch.tensor(sorted(_buckets(text)), dtype=torch.int64)
        known = found[rarity[found] > 0]
        rows.append(torch.full_like(known, row))
        columns.append(known)
        values.append(torch.nn.functional.normalize(rarity[known], dim=0))
    where = torch.stack([torch.cat(rows), torch.cat(columns)])
    return torch.sparse_coo_tensor(where, torch.cat(values), (len(texts), len(rarity)), check_invariants=True).coalesce()


def _buckets(text: str) -> set[int]:
    """Hashes of a text's words, neighbouring pairs, and parts of words of three to five characters."""
    words = re.findall(r"[a-z']+|[!?]", text.lower())
    pairs = [f"{a} {b}" for a, b in itertools.pairwise(words)]
    framed = [f"<{word}>" for word in words]
    parts = [word[start : start + n] for word in framed for n in (3, 4, 5) for start in range(len(word) - n + 1)]
    named = [*(f"1 {word}" for word in words), *(f"2 {pair}" for pair in pairs), *(f"3 {part}" for part in parts)]
    return {zlib.crc32(name.encode()) % BUCKETS for name in named}
