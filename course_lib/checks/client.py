"""The learner's check: `check(compute_gae)` runs the visible cases in the notebook and says what is wrong.

The cases lie beside this file as arrays (`frozen/NAME.npz`): inputs, right outputs and gradients, and what each named misconception
would give. There is no code of any solution or check here.
"""

from __future__ import annotations

import difflib
import functools
import os
from collections.abc import Callable
from pathlib import Path

from course_lib.checks.cases import FrozenExercise
from course_lib.checks.results import CheckResult, examined
from course_lib.checks.stored import load

FROZEN = Path(__file__).parents[1] / "frozen"


def check(function: Callable) -> CheckResult:
    """Check your function on the visible cases and show what was found.

    Args:
      function: one of the chapter's exercises, as you defined it: `check(compute_gae)`.

    Returns: a CheckResult; its `passed` is True if every visible case passed.
    Raises: TypeError or LookupError with what to do, if there is nothing of that name to check.
    """
    name = getattr(function, "__name__", None)
    if not callable(function) or not isinstance(name, str):
        raise TypeError(f"check takes a function, as in check(compute_gae); it got {function!r:.80}")
    result = check_file(name) if is_judged_by_file(name) else _check_function(name, function)
    if os.environ.get("NBGRADER_EXECUTION") == "validate" and not result.passed:
        raise AssertionError(repr(result))  # nbgrader's Validate button goes by exceptions alone
    return result


def _check_function(name: str, function: Callable) -> CheckResult:
    return examined(visible_cases(name), function)


def is_judged_by_file(name: str) -> bool:
    """Whether the points of the exercise `name` come from a file, which the grader flies, and not from calling a function."""
    return (FROZEN / f"{name}.json").is_file()


def check_file(name: str) -> CheckResult:
    """Fly the file of the exercise `name` that lies in the working directory: a few episodes, in seconds."""
    from course_lib.checks import artefact  # Gymnasium takes a third of a second, which no other check should cost

    finding = artefact.judge_here(artefact.load(FROZEN / f"{name}.json"), Path())
    if finding.state in ("correct", "partial", "wrong"):
        finding.message += (
            f"\nThat would be {finding.score:g} of {finding.max_score:g} points. The grader flies other episodes, and more."
        )
    return CheckResult(finding, finding.message)


@functools.cache
def visible_cases(name: str) -> FrozenExercise:
    """The frozen visible cases of the exercise `name`. Raises LookupError, with what to do, if there are none."""
    known = exercise_names()
    if name in known:
        return load(FROZEN / f"{name}.npz")
    if not known:
        raise LookupError(
            "This copy of course_lib has no frozen checks: install the course_lib folder of your bundle (in the repository: make book)."
        )
    close = difflib.get_close_matches(name, known, 1)
    hint = f"Did you mean {close[0]}?" if close else f"Exercises: {', '.join(known)}."
    raise LookupError(f"There is no exercise called {name}. {hint}")


def exercise_names() -> list[str]:
    """The names of all exercises that can be checked here."""
    return sorted(path.stem for suffix in ("npz", "json") for path in FROZEN.glob(f"*.{suffix}"))
