"""Exercises whose answer is a file: the seeds from which learners and the grader fly it, and the file that the reference made."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterable
from pathlib import Path

from autograder.authoring.spec import Artefact, Exercise
from autograder.paths import ROOT
from course_lib.checks.artefact import FrozenArtefact


def visible(artefact: Artefact) -> FrozenArtefact:
    """What learners get: a few episodes."""
    return _frozen(artefact, "visible", artefact.visible_episodes)


def hidden(artefact: Artefact) -> FrozenArtefact:
    """What the grader flies: other episodes, the same for everybody."""
    return _frozen(artefact, "hidden", artefact.episodes)


def _frozen(artefact: Artefact, purpose: str, episodes: int) -> FrozenArtefact:
    digests = (hashlib.sha256(f"{artefact.name}/{purpose}/{episode}".encode()).digest() for episode in range(episodes))
    seeds = [int.from_bytes(digest[:4], "big") >> 1 for digest in digests]
    low, high = artefact.thresholds
    return FrozenArtefact(artefact.name, artefact.file, artefact.task, artefact.points, low, high, seeds)


def hand_in(exercises: Iterable[Exercise | Artefact], folder: Path) -> None:
    """Put the reference's own files where a notebook's would lie. Raises ValueError if one has not been made."""
    for exercise in exercises:
        if isinstance(exercise, Artefact):
            if not answer(exercise).is_file():
                raise ValueError(f"{answer(exercise)} is missing: the file that the reference of {exercise.name} made")
            shutil.copyfile(answer(exercise), folder / exercise.file)


def answer(artefact: Artefact | FrozenArtefact) -> Path:
    """The file that the reference made."""
    return ROOT / "solutions" / artefact.file
