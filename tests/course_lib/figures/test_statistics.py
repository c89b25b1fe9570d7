"""The middle mean against hand-sized cases, and the interval's obvious properties."""

import numpy as np
import pytest

from course_lib.figures.statistics import interval, middle_mean, probability_of_improvement, summarise, table


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


def test_the_probability_of_improvement_counts_pairs_and_half_of_each_tie():
    # of six pairs 3 beats both of 1 and 2, 1 ties with 1 and loses to 2, 0 loses twice
    assert probability_of_improvement([3.0, 1.0, 0.0], [1.0, 2.0])[0] == pytest.approx(2.5 / 6)
    assert probability_of_improvement([1.0, 2.0], [3.0, 1.0, 0.0])[0] == pytest.approx(3.5 / 6)


def test_the_interval_of_the_probability_of_improvement_resamples_both_sides():
    assert probability_of_improvement(np.arange(5.0) + 10, np.arange(5.0)) == (1, 1, 1)
    one_seed, ten_seeds = np.array([4.5]), np.arange(10.0)
    _, low, high = probability_of_improvement(one_seed, ten_seeds)
    assert 0 < low < 0.5 < high < 1
    assert probability_of_improvement(ten_seeds, one_seed)[1:] == pytest.approx((low, high), abs=0.2)
    _, lower, higher = probability_of_improvement(one_seed, ten_seeds, confidence=0.5)
    assert low < lower <= 0.5 <= higher < high


def test_tables_are_aligned():
    rows = {"ours": {"return": np.full(5, 250.0), "KL": np.full(5, 0.01)}, "no clip": {"return": np.full(5, 30.0), "KL": "none"}}
    assert interval(np.full(5, 2.5), 1) == "2.5 [2.5, 2.5]"
    assert table(rows, {"KL": 2}).splitlines() == [
        "                 return                 KL",
        "ours     250 [250, 250]  0.01 [0.01, 0.01]",
        "no clip     30 [30, 30]               none",
    ]
