"""The promises of the checks: every misconception rejected and named, every correct variant accepted.

The kept records say so of fifty seeds. Here an exercise whose record fits is tried over two more seeds, others each day (COURSE_SEED, which
the header of the tests prints, repeats a day); one whose record does not fit is proved anew over the fifty, and asks for its record.
"""

import functools
import os
import random

import pytest
import torch

from autograder import checks
from autograder.authoring.spec import Case, Exercise, Misconception
from autograder.proving import kept, killmatrix
from course_lib.checks.cases import FACETS

NAMES = [(assignment, exercise.name) for assignment in checks.assignments() for exercise in checks.functions(assignment)]
EXERCISES = [exercise for exercise in checks.all_exercises() if isinstance(exercise, Exercise)]
AT_LEAST_EIGHT = {"compute_gae", "clipped_surrogate_loss", "bradley_terry_loss", "reward_model_loss", "dpo_loss"}
SAMPLED = 2
keys = functools.cache(kept.Keys)


def of_the_day():
    """Seeds beyond the recorded ones, and other ones for each COURSE_SEED."""
    first = killmatrix.SEEDS + SAMPLED * int(os.environ["COURSE_SEED"])
    return range(first, first + SAMPLED)


@pytest.mark.parametrize(("assignment", "name"), NAMES, ids=lambda value: value)
def test_every_misconception_is_rejected_and_named_and_every_variant_accepted(assignment, name):
    exercise = next(one for one in checks.functions(assignment) if one.name == name)
    record = kept.load(assignment).get(name)
    fits = record is not None and record.key == keys().key(assignment, exercise)
    findings = killmatrix.report(killmatrix.exercise_rows(exercise, of_the_day() if fits else range(killmatrix.SEEDS)))
    if findings and fits:
        findings.append(f"Repeat it with COURSE_SEED={os.environ['COURSE_SEED']}.")
    if not fits:
        findings.append(
            f"{name}: its record does not fit, so all {killmatrix.SEEDS} seeds were drawn: `{kept.remedy(assignment)}`"
        )
    if findings:
        pytest.fail("\n".join(findings), pytrace=False)


@pytest.mark.parametrize("exercise", EXERCISES, ids=lambda exercise: exercise.name)
def test_there_are_enough_of_each(exercise):
    assert len(exercise.misconceptions) >= (8 if exercise.name in AT_LEAST_EIGHT else 6)
    assert len(exercise.variants) >= 4
    assert len({mistake.name for mistake in exercise.misconceptions}) == len(exercise.misconceptions)
    assert set(exercise.criteria) <= set(FACETS) and exercise.criteria["values"] >= exercise.points / 2
    assert sum(case.visible for case in exercise.cases) >= 3


def test_the_seeds_are_fifty_and_those_of_a_day_are_others(monkeypatch):
    assert killmatrix.SEEDS == 50
    seen = set(range(killmatrix.SEEDS))
    for day in ("0", "1", "20261129", "20261130"):
        monkeypatch.setenv("COURSE_SEED", day)
        assert not seen & set(of_the_day())
        seen |= set(of_the_day())


def doubling(misconceptions=(), variants=(), closed_form=None):
    """An exercise that asks for twice its input."""
    cases = [
        Case(name, lambda generator: {"x": 1 + torch.rand(3, generator=generator, dtype=torch.float64)}, closed_form, dtype=dtype)
        for name, dtype in (("a batch", torch.float64), ("single precision", torch.float32))
    ]
    wrong = [Misconception(name, function, f"It is {name}.") for name, function in misconceptions]
    return Exercise("double", lambda x: 2 * x, {"values": 0.9, "dtype": 0.1}, cases, wrong, dict(variants))


def test_all_that_goes_wrong_is_told_at_once():
    rows = killmatrix.exercise_rows(
        doubling(
            misconceptions=[
                ("right", lambda x: x + x),
                ("tripled", lambda x: 3 * x),
                ("twin", lambda x: x * 3),
                ("squared", lambda x: x**2),
            ],
            variants={"slow": lambda x: 2 * x + 1e-3, "careless": lambda x: (2 * x).double(), "added": lambda x: x + x},
        ),
        range(3),
    )
    told = killmatrix.report(rows)
    assert [line.partition(". Seed 0: ")[0] for line in told] == [
        "double: misconception 'right' is not rejected, in 3 of 3 draws",
        "double: misconception 'tripled' is misnamed: 'tripled', 'twin' is named, in 3 of 3 draws",
        "double: misconception 'twin' is misnamed: 'tripled', 'twin' is named, in 3 of 3 draws",
        "double: variant 'slow' is refused in case 'a batch' (values), case 'single precision' (values), in 3 of 3 draws",
        "double: variant 'careless' is refused in case 'single precision' (dtype), in 3 of 3 draws",
    ]
    assert "is not right" in told[3]  # what a learner would have read
    assert [(row.rejected, row.named) for row in rows.misconceptions] == [(0, 0), (3, 0), (3, 0), (3, 3)]
    assert [row.accepted for row in rows.variants] == [0, 0, 3]


def test_a_specification_that_contradicts_itself_is_told_and_not_raised():
    [told] = killmatrix.report(killmatrix.exercise_rows(doubling(closed_form=lambda x: 3 * x), [7]))
    assert told == (
        "double: no cases can be drawn, in 1 of 1 draws. Seed 7: double, case 'a batch': the reference and the closed form differ"
    )


def test_a_misconception_that_is_another_one_each_time_is_told():
    told = killmatrix.report(killmatrix.exercise_rows(doubling([("never twice alike", lambda x: x * random.random())]), range(2)))
    assert [line.partition(". Seed 0: ")[0] for line in told] == [
        "double: misconception 'never twice alike' is misnamed: nothing is named, in 2 of 2 draws"
    ]


def test_parts_add_up_to_the_whole():
    exercise = doubling([("tripled", lambda x: 3 * x), ("right", lambda x: x + x)], {"added": lambda x: x + x})
    whole = killmatrix.exercise_rows(exercise, range(5))
    assert killmatrix.merged([killmatrix.exercise_rows(exercise, part) for part in (range(3, 5), range(3))]) == whole
