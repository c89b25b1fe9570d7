"""Train the judge that is held out and write course_lib/models/gold_judge/weights.safetensors; then say how good it is.

    python tools/train_gold_judge.py [--measure]

Ten seconds of one core. Ridge regression on the texts and mean ratings of the split "gold" and on nothing else; its one setting was chosen
on "validation", the figures are on "test".
"""

from __future__ import annotations

import argparse

import safetensors.torch
import torch

from course_lib.language import preferences
from course_lib.language.judges import BUCKETS, WEIGHTS, LinearJudge, features, gold_judge

SOURCES = ("film", "amazon", "tweet")  # editorials say nothing about how praise sounds
RIDGE = 1.0


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--measure", action="store_true", help="the committed judge, without training it again")
    torch.set_num_threads(1)
    if not arguments.parse_args().measure:
        judge = trained(preferences.load("gold", SOURCES))
        weights = {"weights": judge.weights.half(), "rarity": judge.rarity.half(), "level": judge.level}
        safetensors.torch.save_file(weights, WEIGHTS)
    test = preferences.load("test")
    for name, scores in (("gold judge", gold_judge()(test.texts)), ("VADER", preferences.vader(test.texts))):
        correlation = torch.corrcoef(torch.stack([scores, test.means]))[0, 1].item()
        print(
            f"{name:11s} correlation {correlation:.3f}, pairwise accuracy {_text(preferences.pairwise_accuracy(scores, test.means))}"
        )
    print(f"one person  against the others: pairwise accuracy {_text(preferences.agreement_ceiling(test))}")


def trained(snippets: preferences.Snippets) -> LinearJudge:
    """Ridge regression of mean ratings on features that at least two texts have, in its dual form: one number for each text."""
    counts = torch.sparse.sum(_occurrences(snippets.texts), 0).to_dense()
    rarity = torch.where(counts > 1, 1 + (len(snippets) / counts.clamp(min=1)).log(), 0.0).half().float()  # as they are kept
    known = features(snippets.texts, rarity)
    level = snippets.means.mean()
    forth, back = known.to_sparse_csr(), known.t().to_sparse_csr()
    dual = conjugate_gradients(lambda x: (forth @ (back @ x[:, None]))[:, 0] + RIDGE * x, snippets.means - level)
    return LinearJudge((back @ dual[:, None])[:, 0], rarity, level)


def _occurrences(texts: list[str]) -> torch.Tensor:
    """1 for each feature that a text has; (N, BUCKETS) sparse."""
    found = features(texts, torch.ones(BUCKETS))
    return torch.sparse_coo_tensor(found.indices(), torch.ones_like(found.values()), found.shape)


def conjugate_gradients(product, target: torch.Tensor, tolerance: float = 1e-5) -> torch.Tensor:
    """The x at which product(x) = target, for a symmetric positive definite linear map (Hestenes and Stiefel, 1952)."""
    x, residual = torch.zeros_like(target), target.clone()
    direction, size = residual.clone(), residual @ residual
    while size > tolerance**2 * (target @ target):
        changed = product(direction)
        step = size / (direction @ changed)
        x, residual = x + step * direction, residual - step * changed
        size, before = residual @ residual, size
        direction = residual + size / before * direction
    return x


def _text(interval: preferences.Interval) -> str:
    return f"{interval.estimate:.3f} [{interval.low:.3f}, {interval.high:.3f}]"


if __name__ == "__main__":
    main()
