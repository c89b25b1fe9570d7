"""Exercises that are judged by a file: what is handed in beside the notebook is flown, and its mean return earns the points.

`FrozenArtefact` is to such an exercise what cases.FrozenExercise is to a function: plain data that release writes for learners and
that the grader makes for itself, with other seeds.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from course_lib.checks.diagnosis import Finding
from course_lib.control.flight import MAX_BYTES, TASKS, RefusedFile, fly, read_weights


@dataclass(frozen=True)
class FrozenArtefact:
    """An exercise whose answer is the file `file`: no points at a mean return of `low` or less, all at `high` or more.

    `task` names one of course_lib.control.flight.TASKS; `seeds` are those of the episodes.
    """

    name: str
    file: str
    task: str
    points: float
    low: float
    high: float
    seeds: list[int] = field(default_factory=list)


def save(path: Path, artefact: FrozenArtefact) -> None:
    """Write an artefact as JSON that `load` reads."""
    path.write_text(json.dumps(asdict(artefact), indent=1) + "\n", encoding="utf-8")


def load(path: Path) -> FrozenArtefact:
    """Read what `save` wrote."""
    return FrozenArtefact(**json.loads(path.read_text(encoding="utf-8")))


class ByReturn(Protocol):
    """An exercise whose points are for a mean return: none at `low` or less, all at `high` or more."""

    @property
    def points(self) -> float: ...

    @property
    def low(self) -> float: ...

    @property
    def high(self) -> float: ...


def score(exercise: ByReturn, mean_return: float) -> float:
    """The points for a mean return: a straight line from 0 at `low` to all at `high`, in hundredths, rounded down."""
    share = (mean_return - exercise.low) / (exercise.high - exercise.low)
    return exercise.points if share >= 1 else math.floor(100 * exercise.points * max(share, 0.0)) / 100


def landed(artefact: FrozenArtefact, returns: np.ndarray) -> Finding:
    """The finding on a file that has flown, from its returns in all episodes, (episodes,)."""
    mean, error = float(np.mean(returns)), float(np.std(returns, ddof=1) / math.sqrt(len(returns)))
    earned = score(artefact, mean)
    state = "correct" if mean >= artefact.high else "partial" if earned else "wrong"
    message = (
        f"Mean return {mean:.1f} over {len(returns)} episodes (standard error {error:.1f}; the worst {np.min(returns):.0f}, the"
        f" best {np.max(returns):.0f}). Points grow from 0 at {artefact.low:g} to {artefact.points:g} at {artefact.high:g}."
    )
    return Finding(artefact.name, state, earned, artefact.points, message=message)


def refused(artefact: FrozenArtefact, reason: str) -> Finding:
    """The finding on a file that cannot be flown."""
    return Finding(artefact.name, "error", 0.0, artefact.points, message=f"{artefact.file} is not flown: {reason}.")


def missing(artefact: FrozenArtefact) -> Finding:
    """The finding where there is no file."""
    message = (
        f"There is no file {artefact.file} beside the notebook. When your policy is trained, write it with"
        f' course_lib.control.policies.save_policy(policy, "{artefact.file}"), and hand it in with the notebook.'
    )
    return Finding(artefact.name, "not_implemented", 0.0, artefact.points, message=message)


def judge_here(artefact: FrozenArtefact, folder: Path) -> Finding:
    """Fly the file in `folder`, in this process: for one's own notebook."""
    try:
        with open(folder / artefact.file, "rb") as file:
            content = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        return missing(artefact)
    except OSError as error:
        return refused(artefact, f"it can't be read ({error.strerror})")
    task = TASKS[artefact.task]
    try:
        return landed(artefact, fly(read_weights(content, task), artefact.seeds, task))
    except RefusedFile as reason:
        return refused(artefact, str(reason))
