"""What a submission runs next: which cells, which exercises, for how long. Pure functions of what has happened to it so far.

A notebook is loaded whole, once; its exercises are asked in that process. Only a loss makes this longer:

- A cell hangs or ends the process. Those exercises come next whose definitions stand above it, with the cells above it, which are known
  to run. Then the notebook is loaded again; of the cell that was lost, what defines something and calls nothing, and if that is lost,
  too, nothing.
- A call ends the process. The cells run again for the exercises that are left. If a later cell may have done it, by what it left
  running, first without the cells below the last definition, then each exercise in a process of its own, with no cell below its own.

Every loss leaves fewer cells or fewer exercises, so this ends even without a clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Past:
    """What has happened."""

    found: frozenset[str] = frozenset()
    """Exercises that need not be asked again."""
    tried: frozenset[str] = frozenset()
    """Exercises that stopped with an error while cells below their definition were left out: helpers may stand there."""
    lost: tuple[int, ...] = ()
    """Positions of cells that hung or ended the process, the last loss last; twice, if their definitions were lost as well."""
    suspicions: int = 0
    """How often a call was lost to what may be a later cell's doing; counted to 2."""


@dataclass(frozen=True)
class Attempt:
    """What to do in the next process."""

    whole: tuple[int, ...]
    """Positions of the cells to run."""
    exercises: tuple[str, ...]
    """What to ask then, in this order."""
    definitions: tuple[int, ...] = ()
    """Positions of the cells of which only definitions run."""
    loading_spares: int = 0
    """How many exercises must have their own time left when the cells have run."""
    spares: int = 0
    """How many must have it left when the exercises of this attempt have been asked."""
    complete: bool = True
    """Whether no cell is left out but those that were lost."""


def plan(defined: Mapping[str, int], cells: int, past: Past) -> Attempt | None:
    """The next attempt; None if nothing is left to ask.

    Args:
      defined: exercise → position of the last cell that seems to define it, -1 for none; in the chapter's order.
      cells: how many cells there are.
    """
    pending = tuple(name for name in defined if name not in past.found)
    if not pending:
        return None
    if past.suspicions > 1:
        return _attempt(
            _end(defined, pending[:1], cells), pending[:1], past, loading_spares=len(pending) - 1, spares=len(pending) - 1
        )
    if past.lost:
        above = tuple(name for name in pending if 0 <= defined[name] < past.lost[-1] and name not in past.tried)
        if above:
            return _attempt(past.lost[-1], above, past, loading_spares=len(above) - 1, complete=False)
    return _attempt(_end(defined, pending, cells) if past.suspicions else cells, pending, past, loading_spares=len(pending))


def suspect(defined: Mapping[str, int], cells: int, past: Past, attempt: Attempt, name: str) -> Past | None:
    """What has happened, if a cell below its definition may have ended the process in which `name` was called; else None."""
    if not 0 <= defined[name] < max((*attempt.whole, *attempt.definitions)):
        return None
    pending = tuple(other for other in defined if other not in past.found)
    nothing_below = _end(defined, pending, cells) == cells
    return replace(past, suspicions=2 if past.suspicions or nothing_below else 1)


def _end(defined: Mapping[str, int], exercises: tuple[str, ...], cells: int) -> int:
    """The position after the last cell that they need; all cells, if one of them is not seen to be defined."""
    positions = [defined[name] for name in exercises]
    return cells if min(positions) < 0 else max(positions) + 1


def _attempt(
    end: int, exercises: tuple[str, ...], past: Past, loading_spares: int, spares: int = 0, complete: bool = True
) -> Attempt:
    times_lost = [past.lost.count(position) for position in range(end)]
    whole = tuple(position for position, times in enumerate(times_lost) if times == 0)
    definitions = tuple(position for position, times in enumerate(times_lost) if times == 1)
    return Attempt(whole, exercises, definitions, loading_spares, spares, complete)


def share(left: float, spares: int, timeout: float) -> float:
    """Seconds for one step, if `spares` exercises are to have as much afterwards: `timeout`, or an equal part of what is left."""
    return min(timeout, left / (spares + 1))
