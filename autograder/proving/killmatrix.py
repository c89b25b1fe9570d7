"""The kill matrix: every named misconception against its checks, over many seeds, and every correct variant beside it.

All misconceptions must be rejected and named, and all variants accepted; whatever was not is told in words. The book prints the table.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from autograder.authoring import freeze
from autograder.authoring.spec import Exercise
from course_lib.checks.diagnosis import diagnose, differing_facets, view
from course_lib.checks.observing import observe

SEEDS = 50


@dataclass
class MisconceptionRow:
    """How often a wrong answer lost points, and how often it alone was named, of `seeds` draws of all cases."""

    name: str
    message: str
    rejected: int = 0
    named: int = 0


@dataclass
class VariantRow:
    """How often a correct variant got full marks."""

    name: str
    accepted: int = 0


@dataclass
class ExerciseRows:
    """One exercise's part of the matrix. `failures` are all that should not have happened: (what, how it showed, with which seed)."""

    exercise: str
    seeds: int
    misconceptions: list[MisconceptionRow] = field(default_factory=list)
    variants: list[VariantRow] = field(default_factory=list)
    failures: list[tuple[str, str, int]] = field(default_factory=list)

    def as_printed(self) -> dict[str, Any]:
        """The rows as plain data."""
        return {name: value for name, value in asdict(self).items() if name != "failures"}


def exercise_rows(exercise: Exercise, seeds: Iterable[int] = range(SEEDS)) -> ExerciseRows:
    """Run every misconception and every variant of one exercise against freshly drawn cases, once for each seed."""
    seeds = list(seeds)
    result = ExerciseRows(
        exercise.name,
        len(seeds),
        [MisconceptionRow(mistake.name, mistake.message) for mistake in exercise.misconceptions],
        [VariantRow(name) for name in exercise.variants],
    )
    for seed in seeds:
        _draw(exercise, seed, result)
    return result


def _draw(exercise: Exercise, seed: int, result: ExerciseRows) -> None:
    try:
        frozen = freeze.complete(exercise, seed)
    except freeze.FreezeError as error:
        result.failures.append(("no cases can be drawn", str(error), seed))
        return
    wrong = {mistake.name: mistake.function for mistake in exercise.misconceptions}
    for row in result.misconceptions:
        # observed anew, as a learner's is: what was frozen would be named even if it never came again
        finding = diagnose(frozen, [view(case, observe(wrong[row.name], **case.call)) for case in frozen.cases])
        rejected, named = finding.score < finding.max_score, finding.misconceptions == [row.name]
        row.rejected += rejected
        row.named += named
        if not rejected:
            result.failures.append((f"misconception {row.name!r} is not rejected", "it gets full marks", seed))
        elif not named:
            instead = ", ".join(map(repr, finding.misconceptions)) or "nothing"
            result.failures.append((f"misconception {row.name!r} is misnamed: {instead} is named", finding.message, seed))
    for variant in result.variants:
        function = exercise.variants[variant.name]
        observations = [view(case, observe(function, **case.call)) for case in frozen.cases]
        finding = diagnose(frozen, observations)
        variant.accepted += finding.state == "correct"
        if finding.state != "correct":
            lost = []
            for case, seen in zip(frozen.cases, observations, strict=True):
                facets = min((differing_facets(seen, right, case) for right in case.expected), key=len)
                lost += [f"case {case.name!r} ({', '.join(sorted(facets))})"] if facets else []
            what = f"variant {variant.name!r} is refused in {', '.join(dict.fromkeys(lost))}"
            result.failures.append((what, finding.message, seed))


def merged(parts: Sequence[ExerciseRows]) -> ExerciseRows:
    """The rows of one exercise that were drawn in parts, each with other seeds."""
    first = parts[0]
    result = ExerciseRows(first.exercise, sum(part.seeds for part in parts))
    for i, row in enumerate(first.misconceptions):
        rejected, named = (sum(getattr(part.misconceptions[i], count) for part in parts) for count in ("rejected", "named"))
        result.misconceptions.append(MisconceptionRow(row.name, row.message, rejected, named))
    for i, variant in enumerate(first.variants):
        result.variants.append(VariantRow(variant.name, sum(part.variants[i].accepted for part in parts)))
    result.failures = sorted((failure for part in parts for failure in part.failures), key=lambda failure: failure[2])
    return result


def report(rows: ExerciseRows) -> list[str]:
    """All that went wrong, alike failures together: what, in how many draws, and how the first of them showed."""
    found: dict[str, list[tuple[str, int]]] = {}
    for what, shown, seed in rows.failures:
        found.setdefault(what, []).append((shown, seed))
    return [
        f"{rows.exercise}: {what}, in {len(shows)} of {rows.seeds} draws. Seed {shows[0][1]}: {shows[0][0]}"
        for what, shows in found.items()
    ]
