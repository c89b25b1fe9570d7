"""Exercises whose answer is a file, or settings: the seeds from which learners and the grader fly or train, and the reference's file."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterable
from pathlib import Path

from autograder.authoring.spec import Artefact, Exercise, Tuning
from autograder.paths import ROOT
from course_lib.checks import tuning
from course_lib.checks.artefact import FrozenArtefact
from course_lib.checks.tuning import FrozenTuning


def visible(artefact: Artefact) -> FrozenArtefact:
    """What learners get: a few episodes."""
    return _frozen(artefact, "visible", artefact.visible_episodes)


def hidden(artefact: Artefact) -> FrozenArtefact:
    """What the grader flies: other episodes, the same for everybody."""
    return _frozen(artefact, "hidden", artefact.episodes)


def _frozen(artefact: Artefact, purpose: str, episodes: int) -> FrozenArtefact:
    low, high = artefact.thresholds
    seeds = _seeds(artefact.name, purpose, episodes)
    return FrozenArtefact(artefact.name, artefact.file, artefact.task, artefact.points, low, high, seeds)


def _seeds(name: str, purpose: str, count: int) -> list[int]:
    digests = (hashlib.sha256(f"{name}/{purpose}/{number}".encode()).digest() for number in range(count))
    return [int.from_bytes(digest[:4], "big") >> 1 for digest in digests]


def trained_by_learners(exercise: Tuning) -> FrozenTuning:
    """What learners get: a few trainings, by their own program."""
    seeds = _seeds(exercise.name, "visible", exercise.visible_episodes)
    return tuning.frozen(exercise.name, exercise.points, *exercise.thresholds, seeds)


def trained_by_grader(exercise: Tuning) -> FrozenTuning:
    """What the grader does: other trainings, the same for everybody, by the course's program."""
    seeds = _seeds(exercise.name, "hidden", exercise.episodes)
    return tuning.frozen(exercise.name, exercise.points, *exercise.thresholds, seeds, exercise.train)


def hand_in(exercises: Iterable[Exercise | Artefact | Tuning], folder: Path) -> None:
    """Put the reference's own files where a notebook's would lie. Raises ValueError if one has not been made."""
    for exercise in exercises:
        if isinstance(exercise, Artefact):
            if not answer(exercise).is_file():
                raise ValueError(f"{answer(exercise)} is missing: the file that the reference of {exercise.name} made")
            shutil.copyfile(answer(exercise), folder / exercise.file)


def answer(artefact: Artefact | FrozenArtefact) -> Path:
    """The file that the reference made."""
    return ROOT / "solutions" / artefact.file
