"""The learner's check: `check(compute_gae)` runs the visible cases in the notebook and says what is wrong.

The cases lie beside this file as arrays (`frozen/NAME.npz`): inputs, right outputs and gradients, and what each named misconception
would give. There is no code of any solution or check here.
"""

from __future__ import annotations

import difflib
import functools
import html
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from course_lib.checks.cases import FACET_TEXT, FrozenExercise
from course_lib.checks.diagnosis import Finding, examine
from course_lib.checks.stored import load

FROZEN = Path(__file__).parents[1] / "frozen"

HEADLINES = {
    "correct": "Passed",
    "partial": "Nearly there",
    "wrong": "Not yet",
    "error": "It stops with an error",
    "not_implemented": "Not implemented yet",
}


class CheckResult:
    """What `check` found; shows itself as a small box in Jupyter and as plain text elsewhere."""

    def __init__(self, finding: Finding, praise: str, facets: Sequence[str] = ()) -> None:
        self.finding = finding
        self.passed = finding.state == "correct"
        self._praise = praise
        self._facets = facets

    def _headline(self) -> str:
        return f"{HEADLINES[self.finding.state]}: {self.finding.exercise}"

    def _lines(self) -> list[str]:
        told = (self._praise if self.passed else self.finding.message).splitlines()
        return [line for line in told if line.rstrip(".") != HEADLINES[self.finding.state]]  # which need not be said twice

    def _ticks(self) -> list[tuple[str, str]]:
        """The facets with a tick or a cross; once the values are wrong the others can't be told apart from it."""
        if self.finding.state in ("not_implemented", "error") or "values" in self.finding.failed:
            return []
        return [("✗" if facet in self.finding.failed else "✓", FACET_TEXT[facet]) for facet in self._facets]

    def __repr__(self) -> str:
        mark = "✓" if self.passed else "✗"
        return "\n".join(
            [
                f"{mark} {self._headline()}",
                *(f"  {line}" for line in self._lines()),
                *(f"  {m} {text}" for m, text in self._ticks()),
            ]
        )

    def _repr_html_(self) -> str:
        colour = {"correct": "#2e8540", "not_implemented": "#7a7a7a", "partial": "#b36b00"}.get(self.finding.state, "#c0392b")
        mark = "✓" if self.passed else ("…" if self.finding.state == "not_implemented" else "✗")
        lines = "".join(f'<div style="margin-top:.3em">{html.escape(line)}</div>' for line in self._lines())
        ticks = "".join(f'<li style="list-style:none">{m} {html.escape(text)}</li>' for m, text in self._ticks())
        ticks = f'<ul style="margin:.4em 0 0;padding:0">{ticks}</ul>' if ticks else ""
        return (
            f'<div class="course-check" role="status" style="border-left:4px solid {colour};padding:.5em .9em;margin:.3em 0">'
            f"<strong>{mark} {html.escape(self._headline())}</strong>{lines}{ticks}</div>"
        )


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
    exercise = visible_cases(name)
    start = time.perf_counter()
    finding = examine(exercise, function)
    took = 1000 * (time.perf_counter() - start)
    praise = f"{len(exercise.cases)} visible cases, {took:.0f} ms. The grader draws more like them."
    return CheckResult(finding, praise, [facet for facet in FACET_TEXT if exercise.criteria.get(facet)])


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
