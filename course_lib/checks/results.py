"""What a check says and how it shows itself: the same words in a notebook, in a shell and on a page of the book."""

from __future__ import annotations

import html
import time
from collections.abc import Callable, Sequence

from course_lib.checks.cases import FACET_TEXT, FrozenExercise
from course_lib.checks.diagnosis import Finding, examine

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
        self.notes: list[str] = []
        self._facets = facets

    def headline(self) -> str:
        """The outcome in words, and the exercise."""
        return f"{HEADLINES[self.finding.state]}: {self.finding.exercise}"

    def lines(self) -> list[str]:
        """What there is to say about it."""
        told = (self._praise if self.passed else self.finding.message).splitlines()
        told = [line for line in told if line.rstrip(".") != HEADLINES[self.finding.state]]  # which need not be said twice
        return [*told, *self.notes]

    def ticks(self) -> list[tuple[str, str]]:
        """The facets with a tick or a cross; once the values are wrong the others can't be told apart from it."""
        if self.finding.state in ("not_implemented", "error") or "values" in self.finding.failed:
            return []
        return [("✗" if facet in self.finding.failed else "✓", FACET_TEXT[facet]) for facet in self._facets]

    def __repr__(self) -> str:
        mark = "✓" if self.passed else "✗"
        return "\n".join(
            [
                f"{mark} {self.headline()}",
                *(f"  {line}" for line in self.lines()),
                *(f"  {m} {text}" for m, text in self.ticks()),
            ]
        )

    def _repr_html_(self) -> str:
        colour = {"correct": "#2e8540", "not_implemented": "#7a7a7a", "partial": "#b36b00"}.get(self.finding.state, "#c0392b")
        mark = "✓" if self.passed else ("…" if self.finding.state == "not_implemented" else "✗")
        lines = "".join(f'<div style="margin-top:.3em">{html.escape(line)}</div>' for line in self.lines())
        ticks = "".join(f'<li style="list-style:none">{m} {html.escape(text)}</li>' for m, text in self.ticks())
        ticks = f'<ul style="margin:.4em 0 0;padding:0">{ticks}</ul>' if ticks else ""
        return (
            f'<div class="course-check" role="status" style="border-left:4px solid {colour};padding:.5em .9em;margin:.3em 0">'
            f"<strong>{mark} {html.escape(self.headline())}</strong>{lines}{ticks}</div>"
        )


def examined(exercise: FrozenExercise, function: Callable) -> CheckResult:
    """Judge a function in this process, and say how long it took."""
    start = time.perf_counter()
    finding = examine(exercise, function)
    took = 1000 * (time.perf_counter() - start)
    praise = f"{len(exercise.cases)} visible cases, {took:.0f} ms. The grader draws more like them."
    return CheckResult(finding, praise, [facet for facet in FACET_TEXT if exercise.criteria.get(facet)])
