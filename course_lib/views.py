"""Ways of looking at outputs where many are right: a random order, a sample, a trained model.

A view is a pure function (arguments, outputs) -> outputs. `arguments` are those of the call, as arrays and plain data, and `outputs` what
it returned, by path ("0", "1.entropy"). The view gives what all right answers have in common, such as sorted indices, frequencies or
truth values, and that is what is compared, shown and named. It runs where the comparison runs and never in the process of the
judged function, so it cannot be forged; it raises ValueError for outputs that it cannot read.
"""

from __future__ import annotations

from typing import Any

import numpy as np

READABLE = "result"
"""The kind of every observation that a view could read."""


def episode_split(arguments: dict[str, Any], outputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What every right split by episodes has in common: all counts are 0 and nothing is too many or too few.

    `arguments` has episode_ids (M,) and fraction; `outputs` is (train, held_out), two masks over the steps. Of the episodes that
    straddle the two sides, 2 stands for more than one.
    """
    train, held_out = _masks(outputs, ("0", "1"), len(arguments["episode_ids"]))
    ids = arguments["episode_ids"]
    episodes, lost, held = (len(np.unique(ids[mask])) for mask in (train | held_out, ~train & ~held_out, held_out))
    straddling = len(np.intersect1d(ids[train & ~held_out], ids[held_out & ~train]))
    wanted = arguments["fraction"] * len(np.unique(ids))
    return {
        "episodes on both sides": np.array(min(straddling, 2)),
        "steps on neither side": np.array(lost > 0),
        "steps in both masks": np.array(bool((train & held_out).any())),
        "held-out episodes, too many": np.array(held > wanted + 1),
        "held-out episodes, too few": np.array(held < wanted - 1),
        "a side is empty": np.array(not train.any() or not held_out.any()),
        "episodes in all": np.array(episodes),
    }


def two_splits(arguments: dict[str, Any], outputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Whether two splits in a row, with one generator, differ."""
    masks = _masks(outputs, ("0.0", "0.1", "1.0", "1.1"), len(arguments["episode_ids"]))
    return {"the same episodes twice": np.array(bool((masks[1] == masks[3]).all()))}


def training_curve(_arguments: dict[str, Any], outputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Of a training run's losses: how many there are, the first, and whether the last is smaller, by a hundredth and by a quarter."""
    losses = outputs.get("")
    if losses is None or losses.ndim != 1 or not len(losses) or losses.dtype.kind != "f":
        raise ValueError("the losses must be a tensor of numbers, one for each step")
    return {
        "number of losses": np.array(len(losses)),
        "first loss": np.array(losses[0], dtype=np.float32),
        "the loss falls": np.array(bool(losses[-1] < 0.99 * losses[0])),
        "it falls by a quarter": np.array(bool(losses[-1] < 0.75 * losses[0])),
    }


def _masks(outputs: dict[str, np.ndarray], paths: tuple[str, ...], size: int) -> list[np.ndarray]:
    masks = [outputs[path] for path in paths if path in outputs]
    if len(masks) < len(outputs) or len(masks) < len(paths) or any(mask.shape != (size,) for mask in masks):
        raise ValueError("train and held_out must have an entry for each step")
    if any(mask.dtype != bool for mask in masks):
        raise ValueError("train and held_out must be bool")
    return masks
