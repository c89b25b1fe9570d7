"""For teachers who run plain nbgrader: what a graded cell's hidden line calls.

The function runs in the learner's kernel, so nothing here resists a hostile submission: `course grade` is the hardened way.
"""

from __future__ import annotations

import contextlib
import functools
import io
from collections.abc import Callable

from autograder import checks, freeze
from course_lib.cases import FrozenExercise
from course_lib.diagnosis import examine


def score(name: str, function: Callable) -> float:
    """The points that `function` earns as the exercise `name`, all cases included.

    nbgrader takes a cell's number as partial credit. Nothing is printed: anything on stderr would cost the learner all points.
    """
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        return examine(_frozen(name), function).score


@functools.cache
def _frozen(name: str) -> FrozenExercise:
    return next(freeze.complete(exercise) for exercise in checks.all_exercises() if exercise.name == name)
