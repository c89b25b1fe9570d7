"""Ways of looking at outputs where many are right: a random order, a sample, a trained model.

A view is a pure function (arguments, outputs) -> outputs. `arguments` are those of the call, as arrays and plain data, and `outputs` what
it returned, by path ("0", "1.entropy"). The view gives what all right answers have in common, such as sorted indices, frequencies or
truth values, and that is what is compared, shown and named. It runs where the comparison runs and never in the process of the
judged function, so it cannot be forged; it raises ValueError for outputs that it cannot read.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

READABLE = "result"
"""The kind of every observation that a view could read."""


def group_frequencies(arguments: Mapping[str, Any], outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What all honest draws of answers have in common: how often each kind of pair is answered True.

    Args:
      arguments: true_returns_a and true_returns_b, (B,); pairs that are equal in both, and that follow one another, are of one kind.
      outputs: for each call its answers, (B,) bool.

    Returns: "frequency", (kinds,), over all calls together; "alike", whether two calls gave the very same answers.
    """
    pairs = np.stack([arguments["true_returns_a"], arguments["true_returns_b"]])
    answers = list(outputs.values())
    if not answers or any(given.dtype != bool or given.shape != pairs.shape[1:] for given in answers):
        raise ValueError(f"the answers must be a bool tensor of shape {pairs.shape[1:]}")
    starts = np.flatnonzero(np.r_[True, (np.diff(pairs) != 0).any(0)])
    frequencies = [[part.mean() for part in np.split(given, starts[1:])] for given in answers]
    alike = len(answers) > 1 and all(np.array_equal(given, answers[0]) for given in answers)
    return {"frequency": np.mean(frequencies, axis=0), "alike": np.asarray(alike)}
