"""Views of chapter 74: splits by episodes and training curves."""

import numpy as np
import pytest

from course_lib.checks import views

IDS = np.repeat(np.arange(5), 3)
SPLIT = {"episode_ids": IDS, "fraction": 0.4}


def seen(held_out, train=None):
    held_out = np.asarray(held_out)
    return views.episode_split(SPLIT, {"0": ~held_out if train is None else np.asarray(train), "1": held_out})


def test_any_split_by_episodes_looks_alike():
    assert seen(np.isin(IDS, [0, 3])) == seen(np.isin(IDS, [1, 2])) == seen(np.isin(IDS, [4]))


def test_mistakes_of_a_split_are_seen():
    one = np.isin(IDS, [0, 3])
    assert seen(np.arange(15) % 2 == 0)["episodes on both sides"] == 2
    assert seen(np.arange(15) >= 10)["episodes on both sides"] == 1
    assert seen(one, np.ones(15, bool))["steps in both masks"] and seen(one, ~one & (IDS != 1))["steps on neither side"]
    assert seen(IDS < 4)["held-out episodes, too many"] and seen(np.zeros(15, bool))["held-out episodes, too few"]
    assert seen(np.zeros(15, bool))["a side is empty"]


@pytest.mark.parametrize("masks", [{}, {"0": IDS > 2}, {"0": IDS > 2, "1": IDS[:3] < 3}, {"0": IDS, "1": IDS}])
def test_what_is_no_pair_of_masks_is_refused(masks):
    with pytest.raises(ValueError, match="train and held_out"):
        views.episode_split(SPLIT, masks)


def test_two_splits():
    one, other = np.isin(IDS, [0, 3]), np.isin(IDS, [1, 2])
    for second, same in ((one, True), (other, False)):
        outputs = {"0.0": ~one, "0.1": one, "1.0": ~second, "1.1": second}
        assert views.two_splits(SPLIT, outputs)["the same episodes twice"] == same


def test_training_curve():
    curve = views.training_curve({}, {"": np.array([2.0, 1.0])})
    assert (
        curve["number of losses"] == 2 and curve["first loss"] == 2 and curve["the loss falls"] and curve["it falls by a quarter"]
    )
    assert all(isinstance(value, np.ndarray) for value in curve.values())
    assert not views.training_curve({}, {"": np.array([1.0, 1.0 - 1e-7])})["the loss falls"]
    for unreadable in ({}, {"": np.array(1.0)}, {"": np.array([1, 2])}):
        with pytest.raises(ValueError, match="losses"):
            views.training_curve({}, unreadable)
