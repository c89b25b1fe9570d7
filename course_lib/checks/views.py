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
import torch

READABLE = "result"
"""The kind of every observation that a view could read."""


def epochs(arguments: Mapping[str, Any], outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What all random orders have in common: outputs "epoch.batch" hold one batch of indices each.

    Args:
      arguments: batch_size is the number of indices.
      outputs: for each epoch its batches, (size,) integers each.

    Returns: for each epoch the sizes of its batches, and truth values: whether an index is out of range, comes twice in the epoch, twice
      in one batch, or is missing; whether the order is 0, 1, 2, …; whether every batch holds neighbours only; whether all epochs have
      one order; whether the indices are int64.
    """
    batches: dict[int, list[np.ndarray]] = {}
    for path, batch in outputs.items():
        if path.count(".") != 1 or batch.ndim != 1 or batch.dtype.kind != "i":
            raise ValueError("each batch must be a tensor of indices, (size,)")
        batches.setdefault(int(path.split(".")[0]), []).append(batch)
    if not batches:
        raise ValueError("there are no batches")
    orders = {epoch: np.concatenate(found) for epoch, found in batches.items()}
    seen: dict[str, Any] = {}
    for epoch, order in orders.items():
        sizes = [len(batch) for batch in batches[epoch]]
        seen |= {
            f"{epoch}.sizes": sizes,
            f"{epoch}.out_of_range": ((order < 0) | (order >= arguments["batch_size"])).any(),
            f"{epoch}.twice": len(np.unique(order)) < len(order),
            f"{epoch}.twice_in_a_batch": any(len(np.unique(batch)) < len(batch) for batch in batches[epoch]),
            f"{epoch}.missing": len(np.setdiff1d(np.arange(arguments["batch_size"]), order)) > 0,
            f"{epoch}.in_order": np.array_equal(order, np.arange(len(order))),
            f"{epoch}.neighbours_only": all((np.diff(np.sort(batch)) == 1).all() for batch in batches[epoch]),
        }
    first = orders[min(orders)]
    seen["one_order"] = len(orders) > 1 and all(np.array_equal(order, first) for order in orders.values())
    seen["int64"] = all(batch.dtype == np.int64 for batch in outputs.values())
    return {name: np.asarray(value) for name, value in seen.items()}


def drawn_from(arguments: Mapping[str, Any], outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Whether anything was drawn from the generator whose state after the calls is the one output.

    Args:
      arguments: `generator` is built by seeding.generator.
      outputs: "" is its state afterwards, bytes.
    """
    untouched = torch.Generator().manual_seed(arguments["generator"]["arguments"]["seed"]).get_state().numpy()
    return {"drawn": np.asarray(not np.array_equal(outputs[""], untouched))}


def steps_made(_arguments: Mapping[str, Any], outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """How many steps an optimiser has made, of all that it holds: what depends on a random order is left out."""
    if "steps" not in outputs:
        raise ValueError("there is no number of steps")
    return {"steps": outputs["steps"]}


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


def width(_arguments: Mapping[str, Any], outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """How far apart the two ends of an interval are: outputs "0" and "1", numbers each."""
    if sorted(outputs) != ["0", "1"] or any(end.ndim or end.dtype.kind != "f" for end in outputs.values()):
        raise ValueError("the interval must be two numbers, low and high")
    return {"width": np.asarray(outputs["1"] - outputs["0"])}


def until_the_end(_arguments: Mapping[str, Any], outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Imagined trajectories, with 0 in what comes after the end of each.

    `outputs` has obs (H + 1, B, O), actions (H, B, A), rewards and continues (H, B). A step counts if the trajectory had not ended
    before it; the observation that it led to counts, too. Entries whose shapes do not belong together are left as they are.
    """
    names = ("obs", "actions", "rewards", "continues")
    if sorted(outputs) != sorted(names):
        raise ValueError(f"the entries must be {', '.join(names)}")
    obs, actions, rewards, continues = (outputs[name] for name in names)
    steps, batch = continues.shape if continues.ndim == 2 else (0, 0)
    if (obs.shape[:2], actions.shape[:2], rewards.shape) != ((steps + 1, batch), (steps, batch), (steps, batch)):
        return dict(outputs)
    if obs.ndim != 3 or actions.ndim != 3:
        return dict(outputs)
    begun = np.concatenate([np.ones((1, batch), bool), np.logical_and.accumulate(continues != 0)[:-1]])
    seen = np.concatenate([np.ones((1, batch), bool), begun])
    return {
        "obs": np.where(seen[..., None], obs, 0),
        "actions": np.where(begun[..., None], actions, 0),
        "rewards": np.where(begun, rewards, 0),
        "continues": continues,
    }


def _masks(outputs: dict[str, np.ndarray], paths: tuple[str, ...], size: int) -> list[np.ndarray]:
    masks = [outputs[path] for path in paths if path in outputs]
    if len(masks) < len(outputs) or len(masks) < len(paths) or any(mask.shape != (size,) for mask in masks):
        raise ValueError("train and held_out must have an entry for each step")
    if any(mask.dtype != bool for mask in masks):
        raise ValueError("train and held_out must be bool")
    return masks


def answers_of_a_table(arguments: Mapping[str, Any], outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What a table of language.verifiable.Table has learned: for each prompt, whether it is answered rightly more often than not, and
    whether the logits that stand before the answer have moved.

    Args:
      arguments: prompts of one digit each, and policy, as it was built.
      outputs: "table" (D, 3, V).
    """
    if "table" not in outputs:
        raise ValueError("there is no table")
    table = torch.as_tensor(outputs["table"]).double()
    before = torch.as_tensor(np.asarray(arguments["policy"]["arguments"]["table"])).double()
    probabilities = table.softmax(-1)
    right = [float(probabilities[int(p[0]), 1, int(p[0])] * probabilities[int(p[0]), 2, -1]) for p in arguments["prompts"]]
    return {
        "right more often than not": np.array([share > 0.5 for share in right]),
        "logits before the answer moved": np.array(bool((table[:, 0] - before[:, 0]).abs().max() > 1e-3)),
    }


def diary_of_training(arguments: Mapping[str, Any], outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What all right trainings of a control.clips.WatchedScorer have in common, whatever their random orders.

    Args:
      arguments: training_pairs and held_out_pairs, (chosen, rejected) each, whose clips are numbered in actions[:, 0, 0]; num_epochs.
      outputs: "diary" (N, 2), a row (clip, step) for each clip that was learned from.

    Returns: the number of steps; how often a training clip was learned from at least and at most; and truth values: whether held-out clips
      were, whether the two clips of a pair were apart, whether all epochs had the same minibatches, and whether all were neighbours.
    """
    diary = outputs.get("diary")
    if diary is None or diary.ndim != 2 or not len(diary):
        raise ValueError("nothing was learned from any clip")

    def numbers(pairs: Any) -> list[np.ndarray]:
        return [np.asarray(clips["arguments"]["actions"])[:, 0, 0].astype(int) for clips in pairs]

    sides = numbers(arguments["training_pairs"])
    places = {int(clip): place for side in sides for place, clip in enumerate(side)}
    when = {clip: diary[diary[:, 0] == clip, 1].tolist() for clip in places}
    learned = [len(steps) for steps in when.values()]
    batches: dict[int, set[int]] = {}
    for clip, step in diary.tolist():
        if clip in places:
            batches.setdefault(step, set()).add(places[clip])
    in_turn = [frozenset(batches[step]) for step in sorted(batches)]
    size = max(1, -(-len(in_turn) // arguments["num_epochs"]))
    epochs = [set(in_turn[start : start + size]) for start in range(0, len(in_turn), size)]
    return {
        "steps": np.asarray(len(np.unique(diary[:, 1]))),
        "a clip's times at least": np.asarray(min(learned)),
        "a clip's times at most": np.asarray(max(learned)),
        "held-out clips were learned from": np.asarray(
            bool(np.isin(diary[:, 0], np.concatenate(numbers(arguments["held_out_pairs"]))).any())
        ),
        "the clips of a pair were apart": np.asarray(any(when[int(c)] != when[int(r)] for c, r in zip(*sides, strict=True))),
        "the same minibatches in each epoch": np.asarray(len(epochs) > 1 and all(epoch == epochs[0] for epoch in epochs)),
        "neighbours only": np.asarray(all(max(batch) - min(batch) == len(batch) - 1 for batch in in_turn)),
    }


def weights_learned(_arguments: Mapping[str, Any], outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Of a module's parameters and buffers those called "weights": what else it has written down is left out."""
    if "weights" not in outputs:
        raise ValueError("there are no weights")
    return {"weights": outputs["weights"]}


def habits_of_a_table(arguments: Mapping[str, Any], outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What the policy of a language.tables.TableActor writes after training, beside its reference.

    Args:
      arguments: reference and score, as they were built.
      outputs: "policy.table" (V, V).

    Returns: truth values: whether the token that the score counts follows most others more often than not, and whether on average over
      tokens the divergence from the reference is below 0.05 nats.
    """
    if "policy.table" not in outputs:
        raise ValueError("there is no policy's table")
    tables = (outputs["policy.table"], np.asarray(arguments["reference"]["arguments"]["table"]))
    ours, theirs = (torch.as_tensor(table).double()[:-1].log_softmax(-1) for table in tables)
    liked = ours[:, arguments["score"]["arguments"]["token"]].exp()
    divergence = (ours.exp() * (ours - theirs)).sum(1).mean()
    return {
        "the liked token is written": np.asarray(bool(liked.median() > 0.5)),
        "stays near the reference": np.asarray(bool(divergence < 0.05)),
    }


def losses_seen(_arguments: Mapping[str, Any], outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A tensor of losses in double precision, whatever its own."""
    losses = outputs.get("")
    if losses is None or losses.ndim != 1 or losses.dtype.kind != "f":
        raise ValueError("the losses must be one tensor of numbers, (entries,)")
    return {"losses": losses.astype(np.float64)}


def log_of_steps(_arguments: Mapping[str, Any], outputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A dict of tensors with an entry for each step, in double precision, whatever their own."""
    if not outputs or any("." in name or column.dtype.kind != "f" for name, column in outputs.items()):
        raise ValueError("the log must be a dict of tensors, (steps,) each")
    return {name: column.astype(np.float64) for name, column in outputs.items()}
