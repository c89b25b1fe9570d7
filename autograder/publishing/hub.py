"""For teachers who run plain nbgrader: what a graded cell's hidden line calls.

The function runs in the learner's kernel, so nothing here resists a hostile submission: `course grade` is the hardened way.
"""

from __future__ import annotations

import contextlib
import functools
import io
from collections.abc import Callable
from pathlib import Path

from autograder import checks
from autograder.authoring import artefacts, freeze
from autograder.authoring.spec import Artefact, Tuning
from course_lib.checks.artefact import FrozenArtefact, judge_here
from course_lib.checks.cases import FrozenExercise
from course_lib.checks.diagnosis import examine
from course_lib.checks.tuning import FrozenTuning, examine_here


def score(name: str, function: Callable) -> float:
    """The points that `function` earns as the exercise `name`, all cases included; or the file beside the notebook, if that is judged.

    nbgrader takes a cell's number as partial credit. Nothing is printed: anything on stderr would cost the learner all points.
    """
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        frozen = _frozen(name)
        if isinstance(frozen, FrozenArtefact):
            return judge_here(frozen, Path()).score
        return (examine_here(frozen, function) if isinstance(frozen, FrozenTuning) else examine(frozen, function)).score


@functools.cache
def _frozen(name: str) -> FrozenExercise | FrozenArtefact:
    exercise = next(exercise for exercise in checks.all_exercises() if exercise.name == name)
    if isinstance(exercise, Tuning):
        return artefacts.trained_by_grader(exercise)
    return artefacts.hidden(exercise) if isinstance(exercise, Artefact) else freeze.complete(exercise)
