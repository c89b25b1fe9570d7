"""The middle mean against hand-sized cases, and the interval's obvious properties."""

import numpy as np
import pytest

from course_lib.statistics import middle_mean, summarise


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
