"""What a chapter's checks are made of: exercises, cases, misconceptions and correct variants, as data; files to be flown; settings.

A chapter's module `autograder/checks/chNN.py` has one tuple, `EXERCISES`. The same cases run in the learner's notebook (those that
are visible, frozen to arrays), in the judge, in the tests, and in the book's kill matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from course_lib.checks.cases import FACET_TEXT, FrozenCase

Inputs = Callable[[torch.Generator], dict[str, Any]]


@dataclass(frozen=True)
class Case:
    """One kind of call.

    `inputs` draws the arguments (float64 tensors, scalars, course_lib.checks.cases.built objects) from a seeded generator. `closed_form`
    takes the same arguments and gives the answer by another route; the reference is held against it whenever the case is frozen.
    `differentiate` names the arguments that require gradient: what the reference passes on to each is the contract. `raises` names
    the arguments of which a ValueError must mention one. `repeat`, `returns` and `view` say how the function is called and looked
    at (course_lib.checks.cases.FrozenCase). A visible case is also shown to learners, with one draw; the judge takes `draws` of every case.
    """

    name: str
    inputs: Inputs
    closed_form: Callable | None = None
    differentiate: Sequence[str] = ()
    raises: Sequence[str] = ()
    repeat: int = 1
    returns: Sequence[str] = ()
    view: str = ""
    rtol: float = FrozenCase.rtol
    atol: float = FrozenCase.atol
    dtype: torch.dtype = torch.float64
    visible: bool = False
    draws: int = 2

    @property
    def facet(self) -> str:
        """What an unexpected exception in this case costs."""
        if self.raises:
            return "errors"
        if self.differentiate:
            return "gradient"
        return "values" if self.dtype == torch.float64 else "dtype"


@dataclass(frozen=True)
class Misconception:
    """A named wrong answer: a small implementation, and what a learner who wrote it should look at."""

    name: str
    function: Callable
    message: str


@dataclass(frozen=True)
class Exercise:
    """An exercise of a chapter: the reference, its cases, its points by facet (course_lib.checks.cases.FACETS).

    `also_right` has references that differ from the first where the contract leaves a choice (biased or unbiased deviation);
    `variants` are correct solutions in other styles that the tests and the kill matrix must see accepted.
    """

    name: str
    reference: Callable
    criteria: Mapping[str, float]
    cases: Sequence[Case]
    misconceptions: Sequence[Misconception]
    variants: Mapping[str, Callable]
    also_right: Sequence[Callable] = ()
    axes: Sequence[str] = field(default=())
    last_step_first: bool = False

    @property
    def points(self) -> float:
        return round(sum(self.criteria.values()), 6)

    @property
    def terms(self) -> str:
        """What the points are for, as the notebook says it."""
        shares = ", ".join(f"{points:g} if it {FACET_TEXT[name]}" for name, points in self.criteria.items())
        return f"{shares}. Nothing is paid without right values."


@dataclass(frozen=True)
class Artefact:
    """An exercise whose points come from a file that is handed in beside the notebook: the weights of a trained policy.

    It stands in EXERCISES and has a stub in its chapter like any other, but what the stub's function does is never looked at: the grader
    flies `file` as the task `task` (course_lib.control.flight.TASKS) from `episodes` seeds that nobody has seen, learners from
    `visible_episodes` others. `thresholds` are the mean returns that earn nothing and everything. The file that the reference made lies
    in solutions/.
    """

    name: str
    reference: Callable
    file: str
    task: str
    points: float
    thresholds: tuple[float, float]
    episodes: int = 100
    visible_episodes: int = 20
    experiment: str = ""  # whose agents show that the thresholds are right: autograder.proving.calibration
    right: str = "ours"  # its variant that was trained rightly; those whose configuration names a `mistake` were not
    wrong: Sequence[str] = ()  # of these, the ones that a flight must show

    @property
    def criteria(self) -> dict[str, float]:
        """All points are for one thing."""
        return {"flight": self.points}

    @property
    def terms(self) -> str:
        """What the points are for, as the notebook says it."""
        low, high = self.thresholds
        return (
            f"for the file `{self.file}`, handed in beside the notebook. The grader flies it, without noise, for {self.episodes} episodes"
            f" that start from seeds of its own: no points up to a mean return of {low:g}, all of them from {high:g} on, and in between a"
            " share that grows in proportion. The file alone counts, not the function that wrote it."
        )


@dataclass(frozen=True)
class Tuning:
    """An exercise whose function returns settings, and whose points come from training with them.

    It stands in EXERCISES and has a stub in its chapter like any other. The grader trains by `train` from `episodes` seeds that nobody has
    seen, learners by their own program from `visible_episodes` others. `thresholds` are the mean returns that earn nothing and everything.
    """

    name: str
    reference: Callable
    train: Callable
    points: float
    thresholds: tuple[float, float]
    episodes: int = 8
    visible_episodes: int = 4
    experiment: str = ""  # whose trainings show that the thresholds are right: autograder.proving.calibration
    right: str = "ours"
    wrong: Sequence[str] = ()  # of the variants with a `mistake`, those that must not earn half

    @property
    def criteria(self) -> dict[str, float]:
        """All points are for one thing."""
        return {"return": self.points}

    @property
    def terms(self) -> str:
        """What the points are for, as the notebook says it."""
        low, high = self.thresholds
        return (
            f"for what is learned with these settings. The grader trains {self.episodes} times, with the course's own program, from seeds"
            f" of its own: no points up to a mean return of {low:g}, all of them from {high:g} on, and in between a share that grows in"
            " proportion."
        )
