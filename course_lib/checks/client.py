"""The learner's check: `check(compute_gae)` runs the visible cases in the notebook and says what is wrong.

The cases lie beside this file as arrays (`frozen/NAME.npz`): inputs, right outputs and gradients, and what each named misconception
would give. There is no code of any solution or check here.
"""

from __future__ import annotations

import difflib
import functools
import os
import sys
from collections.abc import Callable
from pathlib import Path

from course_lib.checks.cases import FrozenExercise
from course_lib.checks.cells import notes
from course_lib.checks.diagnosis import Finding, begin_with, examine
from course_lib.checks.names import roughly_set_by, used_by
from course_lib.checks.notebook import NAMED
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
    result.notes = notes(name, FROZEN)
    if os.environ.get("NBGRADER_EXECUTION") == "validate" and not result.passed:
        raise AssertionError(repr(result))  # nbgrader's Validate button goes by exceptions alone
    return result


def _check_function(name: str, function: Callable) -> CheckResult:
    result = _trained(name, function) if is_judged_by_training(name) else examined(visible_cases(name), function)
    if result.finding.state == "error":
        result.finding.message = "; ".join([result.finding.message, *_cells_to_run(result.finding.message)])
    if not result.passed:
        result.finding = begin_with(result.finding, _called(name, function))
    return result


def _called(name: str, function: Callable) -> list[Finding]:
    """What the checks say of the other exercises that a function calls, itself or through others of the notebook."""
    namespace = getattr(function, "__globals__", {})
    known = {other for other in exercise_names() if other != name}
    known -= {other for other in known if is_judged_by_file(other) or is_judged_by_training(other)}
    called = {other: namespace.get(other) for other in used_by(function, namespace) if other in known}
    return [examine(visible_cases(other), one) for other, one in called.items() if callable(one)]


def _cells_to_run(message: str) -> list[str]:
    """In Jupyter, the cells that were run and have not set a name that an answer misses."""
    module = sys.modules.get("IPython.core.getipython")
    shell = module.get_ipython() if module else None
    if shell is None or getattr(shell, "kernel", None) is None:  # not Jupyter, but our own, which knows what stopped
        return []
    history = shell.user_ns["In"]
    missing = [name for found in NAMED.findall(message) for name in found if name and name not in shell.user_ns]
    cells = {name: [number for number, source in enumerate(history) if name in roughly_set_by(source)] for name in missing}
    return [
        f"In[{numbers[-1]}] was to set {name}: run it again, and look where it stops"
        for name, numbers in cells.items()
        if numbers
    ]


def is_judged_by_file(name: str) -> bool:
    """Whether the points of the exercise `name` come from a file, which the grader flies, and not from calling a function."""
    return (FROZEN / f"{name}.json").is_file()


def is_judged_by_training(name: str) -> bool:
    """Whether the points of the exercise `name` come from training with what its function returns."""
    return (FROZEN / f"{name}.tuning").is_file()


def _trained(name: str, function: Callable) -> CheckResult:
    from course_lib.checks import tuning  # as with files

    finding = tuning.examine_here(tuning.load(FROZEN / f"{name}.tuning"), function)
    finding.message = tuning.told_here(finding)
    return CheckResult(finding, finding.message)


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
    return sorted(path.stem for suffix in ("npz", "json", "tuning") for path in FROZEN.glob(f"*.{suffix}"))
