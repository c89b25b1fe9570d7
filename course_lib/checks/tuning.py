"""Exercises that are judged by training: a function returns settings, and what they teach a policy earns the points.

`FrozenTuning` is to such an exercise what cases.FrozenExercise is to a function of numbers. There is no learning program here: learners
are judged with their own, the grader has the course's.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from course_lib.checks.artefact import score
from course_lib.checks.cases import FrozenCase, FrozenExercise, Observation
from course_lib.checks.diagnosis import Finding, with_article
from course_lib.checks.observing import observe
from course_lib.checks.telling import text_of
from course_lib.control import tuning
from course_lib.control.ppo import PPOSettings

KEPT = ("name", "points", "low", "high", "seeds")
PROGRAM = "train_ppo"  # by which a learner's notebook trains


@dataclass
class FrozenTuning(FrozenExercise):
    """An exercise whose answer are settings: no points at a mean return of `low` or less, all at `high` or more.

    `seeds` are those of the trainings.
    """

    low: float = 0.0
    high: float = 1.0
    seeds: list[int] = field(default_factory=list)
    train: Callable | None = None


def frozen(name: str, points: float, low: float, high: float, seeds: list[int], train: Callable | None = None) -> FrozenTuning:
    """A FrozenTuning: its function is called once, without arguments."""
    case = FrozenCase("the settings", {}, [])
    return FrozenTuning(name, {"values": points}, {}, [case], low=low, high=high, seeds=seeds, train=train)


def save(path: Path, exercise: FrozenTuning) -> None:
    """Write what `load` reads, as JSON."""
    path.write_text(json.dumps({name: getattr(exercise, name) for name in KEPT}, indent=1) + "\n", encoding="utf-8")


def load(path: Path) -> FrozenTuning:
    """Read what `save` wrote."""
    return frozen(**json.loads(path.read_text(encoding="utf-8")))


def examine_here(exercise: FrozenTuning, function: Callable) -> Finding:
    """Judge a function in this process, for one's own notebook: by the program of this name beside it."""
    train = exercise.train or getattr(function, "__globals__", {}).get(PROGRAM)
    if train is None:
        return _failed(
            exercise, "error", f"It is judged by training with your {PROGRAM}, which is not defined here: run its cell."
        )
    return judged(exercise, observe(function, **exercise.cases[0].call), train)


def judged(exercise: FrozenTuning, seen: Observation, train: Callable) -> Finding:
    """The finding on what a call was seen to return: train with it and fly."""
    if seen.error == "NotImplementedError":
        return _failed(exercise, "not_implemented", "Not implemented yet.")
    if seen.error:
        return _failed(exercise, "error", f"It raises {seen.error}: {seen.message[:300]}")
    if not seen.kind.startswith("dict of ") or any(value.numel() != 1 for value in seen.outputs.values()):
        return _failed(
            exercise,
            "wrong",
            f"It returns {with_article(seen.kind)[:200]} where a dict of numbers by the settings' names is asked for.",
        )
    try:
        settings = tuning.tuned({name: value.item() for name, value in seen.outputs.items()})
    except ValueError as refusal:
        return _failed(exercise, "wrong", f"Nothing is trained: {refusal}.")
    try:
        returns, told = tuning.trainings(train, settings, exercise.seeds)
    except Exception as error:  # a learner's own program
        return _failed(
            exercise,
            "error",
            f"It is judged by training, and here with your {PROGRAM}, which raises {type(error).__name__}: {text_of(error)[:300]}",
        )
    mean, standard_error = float(np.mean(returns)), float(np.std(returns, ddof=1) / math.sqrt(len(returns)))
    earned = score(exercise, mean)
    state = "correct" if mean >= exercise.high else "partial" if earned else "wrong"
    message = (
        f"Mean return {mean:.1f} of at most {tuning.STEPS} over {len(returns)} trainings (standard error {standard_error:.1f}; the worst"
        f" {returns.min():.1f}, the best {returns.max():.1f}). Points grow from 0 at {exercise.low:g} to {exercise.points:g} at"
        f" {exercise.high:g}."
    )
    if state != "correct":
        message += "\n" + "\n".join(pointers(settings, told))
    return Finding(
        exercise.name, state, earned, exercise.points, message=message, failed=[] if state == "correct" else ["values"]
    )


def pointers(settings: PPOSettings, told: Mapping[str, float]) -> list[str]:
    """What was logged, and where to look: the settings are the learner's to find."""
    updates = math.ceil(settings.total_steps / (tuning.DRONES * settings.num_steps))
    steps = settings.num_epochs * math.ceil(tuning.DRONES * settings.num_steps / settings.minibatch_size)
    horizon = 1 / max(1 - settings.gamma * settings.gae_lambda, 1e-9)
    logged = (
        f"Logged, on average over all updates: approximate KL {told['approx_kl']:.2g}, clip fraction {told['clip_fraction']:.0%}, explained"
        f" variance {told['explained_variance']:.2f}, entropy {told['entropy']:.2f}; {updates} updates of {steps} gradient steps each."
    )
    found = []
    if not all(map(math.isfinite, told.values())):
        found.append("Numbers have overflowed: look at what makes steps large, and at the width of the noise.")
    if told["approx_kl"] < 2e-3:
        found.append("An update hardly moves the policy: look at what makes its steps few, small or cut short.")
    if told["approx_kl"] > 0.1:
        found.append(
            "An update moves the policy very far from the one that collected: look at what makes its steps large or many."
        )
    if updates < 6:
        found.append("There are few updates in all: look at how many steps are collected before each.")
    if horizon > 2 * tuning.STEPS:
        found.append(
            f"The advantages look {min(horizon, 9999):.0f} steps ahead, in flights of {tuning.STEPS}: look at the discounts."
        )
    if settings.log_std < -1.5 or told["entropy"] < -1:
        found.append("There is next to no noise in the actions, and nothing to learn from them: look at the width.")
    if settings.ent_coef > 0.3:
        found.append("The bonus for noise outweighs what flying well pays: look at the loss's last term.")
    return [
        logged,
        *(found or ["Nothing here is out of the ordinary: change one setting at a time, up and down, over several seeds."]),
    ]


def _failed(exercise: FrozenTuning, state: str, message: str) -> Finding:
    return Finding(exercise.name, state, 0.0, exercise.points, message=message)


def told_here(finding: Finding) -> str:
    """What a notebook adds to a finding that was measured."""
    text = finding.message
    if finding.state in ("correct", "partial", "wrong") and text.startswith("Mean return"):
        text += (
            f"\nThat would be {finding.score:g} of {finding.max_score:g} points. The grader trains more often, from other seeds, with the"
            " course's own program."
        )
    return text
