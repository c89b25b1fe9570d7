"""Variety of texts, counted by hand."""

import pytest

from course_lib.language.variety import distinct_n, repetition


@pytest.mark.parametrize(
    ("texts", "n", "expected"),
    [
        (["a b c d"], 2, 1),
        (["great great great great"], 2, 1 / 3),
        (["a b", "a b", "A B", "b c"], 2, 2 / 4),  # over all texts together, whatever the case
        (["a b"], 3, 0),
        ([], 1, 0),
    ],
)
def test_distinct_n_by_hand(texts, n, expected):
    assert distinct_n(texts, n) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("texts", "expected"), [(["a b c"], 0), (["a a a a"], 3 / 4), (["a b", "a b"], 0), (["a a", "b"], 1 / 3), ([""], 0)]
)
def test_repetition_is_counted_within_each_text(texts, expected):
    assert repetition(texts) == pytest.approx(expected)
