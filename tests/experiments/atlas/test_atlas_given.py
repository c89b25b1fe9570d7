"""The course's numbers are those worked out by hand, and no two rules of a formula give the same, else no number would tell its rule."""

import itertools

import pytest

from experiments.atlas import comparing, given

FORMULAS = given.formulas()


@pytest.mark.parametrize("formula", FORMULAS.values(), ids=lambda formula: formula.name)
def test_each_rule_gives_other_numbers_than_the_book_and_than_each_other_rule(formula):
    made = [("the book", formula.ours), *((rule.name, rule.numbers) for rule in formula.rules)]
    for (name, numbers), (other, others) in itertools.combinations(made, 2):
        assert len(comparing.flat(numbers)) == len(comparing.flat(others)), (name, other)
        assert not comparing.same(numbers, others, 1e-4), (name, other)


@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        ("clip_fraction", 3 / 6),  # ratios 1.22, 0.90, 0.45, 2.01, 1.02, 1.05 beside an interval from 0.8 to 1.2
        ("token_clip_fraction", 6 / 10),
        ("value_loss", (0.3**2 + 0.3**2 + 0.5**2 + 1.4**2 + 0.3**2 + 0.7**2) / 6),
        ("stored_reward", 1.25 + 0.99 * 10),
        ("soft_value", [0.8 + 0.2, 2 - 0.1, -0.5 - 0.04, 0.1 + 0.06]),
        ("ipo_loss", [(1.5 - 5) ** 2, (-3.5 - 5) ** 2, (3 - 5) ** 2]),
        (
            "rloo_advantages",
            [[2 / 3, -2 / 3, -2 / 3, 2 / 3], [0] * 4, [0.5 - 2.25 / 3, -1 - 3.75 / 3, 3 + 0.25 / 3, 0.25 - 2.5 / 3]],
        ),
    ],
)
def test_the_books_numbers_are_those_worked_out_by_hand(name, numbers):
    assert comparing.same(FORMULAS[name].ours, numbers, 1e-9)


def test_rules_at_a_time_limit_differ_where_it_is_and_nowhere_else():
    ours = comparing.flat(FORMULAS["gae"].ours)
    before_the_limits = {0, 1, 2, 6, 7, 15}  # environment 0 ends at 2 and is cut off at 5, environment 1 at 6
    for rule in FORMULAS["gae"].rules:
        if rule.name == "truncated_step_dropped":
            continue  # it looks one step ahead, everywhere
        numbers = comparing.flat(rule.numbers)
        assert all(abs(numbers[at] - ours[at]) < 1e-12 for at in before_the_limits), rule.name


def test_padding_goes_to_the_left():
    assert given.to_the_left([[1, 2, 0], [3, 4, 5]], [[1, 1, 0], [1, 1, 1]]) == [[0, 1, 2], [3, 4, 5]]
