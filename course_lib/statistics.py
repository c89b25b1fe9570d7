"""Summaries over seeds: the interquartile mean and its bootstrap interval (Agarwal et al., 2021, https://arxiv.org/abs/2108.13264)."""

from __future__ import annotations

import numpy as np


def middle_mean(scores):
    """Mean of the middle half along the first axis; where the count is no multiple of 4, the outer scores count in part."""
    scores = np.sort(scores, axis=0)
    count = len(scores)
    edges = np.clip(np.arange(count + 1), count / 4, 3 * count / 4)
    return np.tensordot(np.diff(edges) / (count / 2), scores, axes=1)


def summarise(scores, confidence=0.95, num_resamples=1000, seed=0):
    """Interquartile mean over seeds, with a percentile bootstrap interval.

    Args:
      scores: (seeds, ...), one row for each seed; summarised separately at every other position.
      confidence: mass of the interval, in (0, 1).
      num_resamples: bootstrap samples of the seeds.
      seed: of the resampling, so that a figure is the same whenever it is drawn.

    Returns: (centre, low, high), each of shape (...).
    """
    scores = np.asarray(scores, dtype=float)
    picks = np.random.default_rng(seed).integers(len(scores), size=(len(scores), num_resamples))
    low, high = np.quantile(middle_mean(scores[picks]), [(1 - confidence) / 2, (1 + confidence) / 2], axis=0)
    return middle_mean(scores), low, high
