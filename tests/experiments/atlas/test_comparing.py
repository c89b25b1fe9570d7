"""A library's numbers beside the course's: equal, or made by a known rule, or neither, which is said."""

import pytest

from experiments.atlas import comparing
from experiments.atlas.given import Formula, Rule

FORMULA = Formula(
    "loss", "Loss", 45, [1.0, 20.0], (Rule("half", "Half of it.", [0.5, 10.0]), Rule("none", "Nothing.", [0.0, 0.0]))
)
ROW = {"formula": "loss", "numbers": [1.0, 20.0], "call": "f", "source": "f.py"}


def judged(**parts):
    return comparing.judged(ROW | parts, {"loss": FORMULA})


def test_single_precision_is_equal_and_a_hundred_thousandth_is_not():
    assert comparing.same([1.0, 20.0], [1.0, 20.00001])  # a millionth of 20 is more than that
    assert not comparing.same([1.0, 2.0], [1.0, 2.00001])


@pytest.mark.parametrize("numbers", [[1.0], [1.0, 20.0, 3.0], [1.0, float("nan")], [1.0, float("inf")]])
def test_other_counts_and_what_is_no_number_are_never_equal(numbers):
    assert not comparing.same(numbers, [1.0, 20.0], 1e9 if len(numbers) == 2 else 1.0)


def test_nested_lists_are_read_in_order():
    assert comparing.same([[1, 2], [3]], [1, 2, 3]) and not comparing.same([[1, 2], [3]], [2, 1, 3])


def test_a_row_is_equal_or_says_which_rule_made_it():
    assert judged()["equal"] and judged()["rule"] == ""
    half = judged(numbers=[0.5, 10.0])
    assert not half["equal"] and half["rule"] == "half"
    other = judged(numbers=[0.7, 10.0], setting="odd")
    assert not other["equal"] and other["rule"] == ""
    assert comparing.unexplained([judged(), half, other]) == ["loss (odd)"]


def test_a_rows_own_tolerance_counts():
    assert not judged(numbers=[1.0, 20.1])["equal"]
    assert judged(numbers=[1.0, 20.1], tolerance=0.01)["equal"]


@pytest.mark.parametrize(
    ("row", "said"), [({"formula": "gain"}, "gain"), ({"formula": "loss"}, "numbers, call, source"), ([1], "[1]")]
)
def test_a_row_that_is_none_is_refused(row, said):
    with pytest.raises(ValueError, match=r".") as refused:
        comparing.judged(row, {"loss": FORMULA})
    assert said in str(refused.value)


def test_changes_name_what_came_went_or_has_another_verdict():
    former = {
        "rows": [judged(), judged(numbers=[0.5, 10.0], setting="a"), judged(numbers=[0.7, 1.0], setting="b"), judged(setting="c")]
    }
    new = {"rows": [judged(), judged(setting="a"), judged(numbers=[0.8, 1.0], setting="b"), judged(setting="d")]}
    assert comparing.changes(former, new) == [
        "loss (a): was half, is equal",
        "loss (b): other numbers, not equal, by no known rule",
        "loss (c): gone",
        "loss (d): new, equal",
    ]
    assert comparing.changes(former, former) == []
