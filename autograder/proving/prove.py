"""Draw the proofs that are missing, side by side, and keep what was proved.

An exercise is proved in parts of ten seeds each, so that all cores have work to the end. Nothing is kept of an exercise with a failure.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from autograder import checks
from autograder.authoring.spec import Artefact, Exercise, Tuning
from autograder.proving import calibration, kept, killmatrix, side_by_side
from autograder.proving.killmatrix import SEEDS

PART = 10
Progress = Callable[[str, int, int], None]  # the exercise whose part has ended, parts that are done, all parts


class UnknownName(ValueError):
    """There is no such chapter or exercise; the message names those there are."""


@dataclass(frozen=True)
class Target:
    """An exercise that is to be proved: plain names only, as they travel to other processes and machines."""

    assignment: str
    exercise: str


@dataclass(frozen=True)
class Part:
    target: Target
    seeds: tuple[int, ...]


@dataclass
class Outcome:
    """How the proof of one exercise ended: its rows as the book prints them, every finding in words, and what broke on our side."""

    target: Target
    rows: dict[str, Any] = field(default_factory=dict)
    findings: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)


def targets(only: Sequence[str] = (), exercises: Sequence[str] = (), every: bool = False) -> list[Target]:
    """What is to be proved.

    Args:
      only: chapters, "ch44"; all that have checks if empty.
      exercises: names; all of those chapters if empty.
      every: whether also those that have a fitting record; named exercises always are.

    Raises: UnknownName.
    """
    known = checks.assignments()
    for name in only:
        if name not in known:
            raise UnknownName(f"there are no checks of {name!r}; there are: {', '.join(known)}")
    chosen = [name for name in known if name in only or not only]
    found = [Target(name, exercise.name) for name in chosen for exercise in checks.exercises(name)]
    for name in exercises:
        if name not in {target.exercise for target in found}:
            raise UnknownName(f"there is no exercise {name!r}; there are: {', '.join(target.exercise for target in found)}")
    if exercises:
        return [target for target in found if target.exercise in exercises]
    if every:
        return found
    keys = kept.Keys()
    missing = {Target(assignment, name) for assignment in chosen for name in kept.unproved(assignment, keys)}
    return [target for target in found if target in missing]


def draw(part: Part) -> killmatrix.ExerciseRows | dict[str, Any]:
    """One part of a proof, in this process."""
    import torch

    torch.set_num_threads(1)  # right for small tensors, and parts share the machine
    exercise = _exercise(part.target)
    if isinstance(exercise, Exercise):
        return killmatrix.exercise_rows(exercise, part.seeds)
    return calibration.printed(exercise)


def prove(
    wanted: Sequence[Target],
    seeds: Sequence[int] = range(SEEDS),
    jobs: int = 1,
    scheduler: str | None = None,
    progress: Progress = lambda name, done, total: None,
) -> Iterator[Outcome]:
    """Prove each of the exercises, and tell how it ended, in the order of ending. Nothing is written.

    Args:
      wanted: from `targets`.
      seeds: of the draws.
      jobs: parts at a time, each in a process of its own with one thread.
      scheduler: address of a Dask scheduler whose workers share this file system; replaces `jobs`.
      progress: called after each part.
    """
    parts = [part for target in wanted for part in _parts(target, seeds)]
    ended: dict[Target, list[side_by_side.Done]] = {target: [] for target in wanted}
    for done, one in enumerate(side_by_side.run(draw, parts, jobs, scheduler), start=1):
        target = one.item.target
        ended[target].append(one)
        progress(f"{target.assignment} {target.exercise}", done, len(parts))
        if len(ended[target]) == sum(part.target == target for part in parts):
            yield _outcome(target, ended.pop(target))


class Keeper:
    """Writes the records of what is proved, under the keys of the code as it was in the beginning."""

    def __init__(self, wanted: Sequence[Target]) -> None:
        self.keys = kept.Keys()
        self.of = {target: self.keys.key(target.assignment, _exercise(target)) for target in wanted}

    def keep(self, outcome: Outcome) -> None:
        """Write one record, unless there are findings; if the code was edited in the meantime, nobody knows what was proved."""
        if outcome.findings or outcome.broken:
            return
        if not self.keys.code.is_current():
            outcome.broken.append(f"{outcome.target.exercise}: not kept, since the code was edited while it was proved")
            return
        rows = {name: value for name, value in outcome.rows.items() if name != "exercise"}
        proved = kept.Proved(outcome.target.exercise, self.of[outcome.target], kept.today(), rows)
        kept.keep(outcome.target.assignment, [proved])


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The rows of a quick look, a line each."""
    lines = []
    for row in rows:
        if "agents" in row:
            lines += [
                row["exercise"],
                *(f"  {one['variant']}: {one['full']} of {one['agents']} earn all" for one in row["agents"]),
            ]
            continue
        width = max([len(one["name"]) for one in [*row["misconceptions"], *row["variants"]]], default=0)
        lines.append(f"{row['exercise']}: of {row['seeds']} draws")
        lines += [f"  {w['name']:{width}}  rejected {w['rejected']:3d}  named {w['named']:3d}" for w in row["misconceptions"]]
        lines += [f"  {r['name']:{width}}  accepted {r['accepted']:3d}" for r in row["variants"]]
    return lines


def _exercise(target: Target) -> Exercise | Artefact | Tuning:
    return next(one for one in checks.exercises(target.assignment) if one.name == target.exercise)


def _parts(target: Target, seeds: Sequence[int]) -> list[Part]:
    if not isinstance(_exercise(target), Exercise):
        return [Part(target, ())]
    return [Part(target, tuple(seeds[start : start + PART])) for start in range(0, len(seeds), PART)]


def _outcome(target: Target, ended: Sequence[side_by_side.Done]) -> Outcome:
    broken = [f"{target.exercise}: {type(one.error).__name__}: {one.error}" for one in ended if one.error]
    if broken:
        return Outcome(target, broken=list(dict.fromkeys(broken)))
    found: list[Any] = [one.result for one in ended]
    exercise = _exercise(target)
    if not isinstance(exercise, Exercise):
        return Outcome(target, found[0], calibration.report(found[0], exercise.right))
    rows = killmatrix.merged(found)
    return Outcome(target, rows.as_printed(), killmatrix.report(rows))
