"""The kill matrix: every named misconception against its checks, over many seeds, and every correct variant beside it.

The tests demand that all misconceptions are rejected and named and all variants accepted; the book prints the same table.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from autograder.authoring import freeze
from autograder.authoring.spec import Exercise
from course_lib.checks.diagnosis import diagnose, examine

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
    exercise: str
    seeds: int
    misconceptions: list[MisconceptionRow] = field(default_factory=list)
    variants: list[VariantRow] = field(default_factory=list)


def exercise_rows(exercise: Exercise, seeds: int = SEEDS) -> ExerciseRows:
    """Run every misconception and every variant of one exercise against freshly drawn cases, `seeds` times."""
    result = ExerciseRows(
        exercise.name,
        seeds,
        [MisconceptionRow(mistake.name, mistake.message) for mistake in exercise.misconceptions],
        [VariantRow(name) for name in exercise.variants],
    )
    for seed in range(seeds):
        frozen = freeze.complete(exercise, seed)
        for row in result.misconceptions:
            # what a misconception does was observed when the case was frozen
            finding = diagnose(frozen, [case.misconceptions[row.name] for case in frozen.cases])
            row.rejected += finding.score < finding.max_score
            row.named += finding.misconceptions == [row.name]
        for variant in result.variants:
            variant.accepted += examine(frozen, exercise.variants[variant.name]).state == "correct"
    return result
