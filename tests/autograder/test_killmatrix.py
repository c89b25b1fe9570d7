"""The promises of the checks: every misconception rejected and named, every correct variant accepted, over 50 seeds."""

import pytest

from autograder import checks, killmatrix
from autograder.authoring import chapter
from autograder.publishing import book
from course_lib.checks.cases import FACETS

PAGES = chapter.all_chapters()
EXERCISES = [exercise for page in PAGES for exercise in checks.functions(page.assignment)]
AT_LEAST_EIGHT = {"compute_gae", "clipped_surrogate_loss", "bradley_terry_loss", "reward_model_loss", "dpo_loss"}


@pytest.mark.parametrize(
    ("page", "name"),
    [(page, exercise.name) for page in PAGES for exercise in checks.functions(page.assignment)],
    ids=lambda value: value if isinstance(value, str) else value.assignment,
)
def test_every_misconception_is_rejected_and_named_and_every_variant_accepted(page, name):
    # computed once a chapter, and kept under a hash of all that takes part; the book prints the same rows
    row = next(row for row in book.kill_rows(page) if row["exercise"] == name)
    assert row["seeds"] == killmatrix.SEEDS and row["misconceptions"] and row["variants"]
    assert [wrong for wrong in row["misconceptions"] if wrong["rejected"] < row["seeds"]] == []
    assert [wrong for wrong in row["misconceptions"] if wrong["named"] < row["seeds"]] == []
    assert [right for right in row["variants"] if right["accepted"] < row["seeds"]] == []


@pytest.mark.parametrize("exercise", EXERCISES, ids=lambda exercise: exercise.name)
def test_there_are_enough_of_each(exercise):
    assert len(exercise.misconceptions) >= (8 if exercise.name in AT_LEAST_EIGHT else 6)
    assert len(exercise.variants) >= 4
    assert len({mistake.name for mistake in exercise.misconceptions}) == len(exercise.misconceptions)
    assert set(exercise.criteria) <= set(FACETS) and exercise.criteria["values"] >= exercise.points / 2
    assert sum(case.visible for case in exercise.cases) >= 3


def test_the_seeds_are_fifty():
    assert killmatrix.SEEDS == 50
