"""Summaries over seeds: the interquartile mean, the probability of improvement, and their bootstrap intervals.

After Agarwal et al. (2021), https://arxiv.org/abs/2108.13264.
"""

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
      scores: (seeds, ...), one row for each seed; summarised separately at every other position. Or a tuple of such arrays,
        one for each task: the mean is over all of them together, and seeds are resampled within each (a stratified bootstrap).
      confidence: mass of the interval, in (0, 1).
      num_resamples: bootstrap samples of the seeds.
      seed: of the resampling, so that a figure is the same whenever it is drawn.

    Returns: (centre, low, high), each of shape (...).
    """
    tasks = [np.asarray(task, dtype=float) for task in (scores if isinstance(scores, tuple) else [scores])]
    generator = np.random.default_rng(seed)
    picks = [task[generator.integers(len(task), size=(len(task), num_resamples))] for task in tasks]
    resampled = middle_mean(np.concatenate(picks))
    low, high = np.quantile(resampled, [(1 - confidence) / 2, (1 + confidence) / 2], axis=0)
    return middle_mean(np.concatenate(tasks)), low, high


def probability_of_improvement(x, y, confidence=0.95, num_resamples=2000, seed=0):
    """How often a run of x scores higher than one of y, ties counted as half, over all pairs.

    Args:
      x, y: scores, (seeds,) each; the numbers of seeds may differ.
      confidence: mass of the interval, in (0, 1).
      num_resamples: bootstrap samples of the seeds, of x and y apart.
      seed: of the resampling.

    Returns: (share, low, high), with a percentile bootstrap interval.
    """
    x, y = (np.asarray(scores, dtype=float) for scores in (x, y))
    wins = (np.sign(x[:, None] - y) + 1) / 2
    generator = np.random.default_rng(seed)
    rows, columns = (generator.integers(len(scores), size=(num_resamples, len(scores))) for scores in (x, y))
    resampled = wins[rows[:, :, None], columns[:, None]].mean(axis=(1, 2))
    low, high = np.quantile(resampled, [(1 - confidence) / 2, (1 + confidence) / 2])
    return wins.mean(), low, high


def interval(scores, digits=0):
    """The summary of scores (seeds,) in one text: "265 [251, 272]", the interquartile mean and its 95% interval."""
    centre, low, high = summarise(scores)
    return f"{centre:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def table(rows, digits=0):
    """Lines of aligned text, one for each row: a label, and under each column the summary of its scores.

    Args:
      rows: label -> {column: scores (seeds,)}, the same columns in every row; a text is shown as it is.
      digits: after the decimal point, for all columns, or column -> digits.

    Returns: text for `print`, with the columns' names in the first line.
    """
    columns = list(next(iter(rows.values())))
    digits = digits if isinstance(digits, dict) else dict.fromkeys(columns, digits)
    lines = [["", *columns]]
    for label, cells in rows.items():
        texts = [cells[name] if isinstance(cells[name], str) else interval(cells[name], digits.get(name, 0)) for name in columns]
        lines.append([label, *texts])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join([line[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True))])
        for line in lines
    )
