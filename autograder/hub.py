"""For teachers who run plain nbgrader: what a graded cell's hidden line calls.

The function runs in the learner's kernel, so nothing here resists a hostile submission: `course grade` is the hardened way.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import pkgutil
from collections.abc import Callable

from autograder import checks, freeze, killmatrix
from course_lib.cases import FrozenExercise


def score(name: str, function: Callable) -> float:
    """The points that `function` earns as the exercise `name`, all cases included.

    nbgrader takes a cell's number as partial credit. Nothing is printed: anything on stderr would cost the learner all points.
    """
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        return killmatrix.run(function, _frozen(name)).score


@functools.cache
def _frozen(name: str) -> FrozenExercise:
    for module in pkgutil.iter_modules(checks.__path__):
        for exercise in importlib.import_module(f"{checks.__name__}.{module.name}").EXERCISES:
            if exercise.name == name:
                return freeze.complete(exercise)
    raise LookupError(f"no chapter has an exercise called {name}")
