"""The middle mean against hand-sized cases, and the interval's obvious properties."""

import numpy as np
import pytest

from course_lib.statistics import interval, middle_mean, summarise, table


def test_middle_mean_drops_a_quarter_at_each_end():
    assert middle_mean(np.array([100.0, 1, 2, -50])) == pytest.approx(1.5)


def test_middle_mean_weights_in_part_where_the_count_is_no_multiple_of_four():
    # of five scores, 1.25 are trimmed at each end: the second and fourth keep a weight of 0.75
    assert middle_mean(np.array([0.0, 1, 2, 4, 9])) == pytest.approx((0.75 * 1 + 2 + 0.75 * 4) / 2.5)


def test_summarise_keeps_the_other_axes_and_brackets_the_centre():
    scores = np.random.default_rng(0).normal(size=(8, 3, 2))
    centre, low, high = summarise(scores)
    assert centre.shape == low.shape == high.shape == (3, 2)
    assert (low <= centre).all() and (centre <= high).all()


def test_equal_scores_have_an_interval_of_no_width():
    assert [float(part) for part in summarise(np.full(5, 3.0))] == pytest.approx([3, 3, 3])


def test_summarise_is_reproducible():
    scores = np.arange(10.0)
    assert summarise(scores) == summarise(scores)


def test_a_list_of_numbers_is_one_task():
    assert summarise([1.0, 2.0, 5.0, 9.0]) == summarise(np.array([1.0, 2.0, 5.0, 9.0]))


def test_tasks_are_resampled_apart():
    # each task's seeds agree: resampled within the tasks nothing varies, resampled over all of them it would
    centre, low, high = summarise((np.full(4, 0.0), np.full(4, 8.0)))
    assert (centre, low, high) == pytest.approx((4, 4, 4))
    _, low, high = summarise(np.array([0.0] * 4 + [8.0] * 4))
    assert low < 4 < high


def test_tables_are_aligned():
    rows = {"ours": {"return": np.full(5, 250.0), "KL": np.full(5, 0.01)}, "no clip": {"return": np.full(5, 30.0), "KL": "none"}}
    assert interval(np.full(5, 2.5), 1) == "2.5 [2.5, 2.5]"
    assert table(rows, {"KL": 2}).splitlines() == [
        "                 return                 KL",
        "ours     250 [250, 250]  0.01 [0.01, 0.01]",
        "no clip     30 [30, 30]               none",
    ]
