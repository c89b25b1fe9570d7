"""The promises of the checks: every misconception rejected and named, every correct variant accepted, over 50 seeds."""

import pytest

from autograder import checks, killmatrix
from course_lib.cases import FACETS

EXERCISES = checks.all_exercises()
AT_LEAST_EIGHT = {"compute_gae", "clipped_surrogate_loss", "bradley_terry_loss", "reward_model_loss", "dpo_loss"}


@pytest.mark.parametrize("exercise", EXERCISES, ids=lambda exercise: exercise.name)
def test_every_misconception_is_rejected_and_named_and_every_variant_accepted(exercise):
    result = killmatrix.exercise_rows(exercise)
    assert [row.name for row in result.misconceptions if row.rejected < result.seeds] == []
    assert [row.name for row in result.misconceptions if row.named < result.seeds] == []
    assert [row.name for row in result.variants if row.accepted < result.seeds] == []


@pytest.mark.parametrize("exercise", EXERCISES, ids=lambda exercise: exercise.name)
def test_there_are_enough_of_each(exercise):
    assert len(exercise.misconceptions) >= (8 if exercise.name in AT_LEAST_EIGHT else 6)
    assert len(exercise.variants) >= 4
    assert len({mistake.name for mistake in exercise.misconceptions}) == len(exercise.misconceptions)
    assert set(exercise.criteria) <= set(FACETS) and exercise.criteria["values"] >= exercise.points / 2
    assert sum(case.visible for case in exercise.cases) >= 3


def test_the_seeds_are_fifty():
    assert killmatrix.SEEDS == 50
