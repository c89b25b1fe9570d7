"""Chapter 48's functions: values by hand, limits, and the fast update against the plain one."""

import gymnasium as gym
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from course_lib.control import sac
from course_lib.control.replay import Transitions
from solutions import ch47
from solutions.ch48 import bootstrap_interval, fast_sac_update, interquartile_mean, race_counts, steps_to_threshold

TAUGHT = sac.Taught.of(vars(ch47))
SMALL = sac.SACSettings(total_steps=300, learning_starts=50, batch_size=16, hidden=8)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(
    ("scores", "expected"),
    [([7.0], 7), ([1.0, 3.0], 2), ([9.0, 1, 2, 3], 2.5), ([0.0, 1, 2, 3, 100], 2), ([5.0, 1, 2, 3, 4, 6], 3.5)],
)
def test_interquartile_mean_by_hand(scores, expected):
    assert interquartile_mean(torch.tensor(scores)).item() == pytest.approx(expected)


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=20), st.floats(0.1, 10), st.floats(-100, 100))
@settings(max_examples=50, deadline=None)
def test_interquartile_mean_follows_scale_and_shift_and_ignores_order(scores, scale, shift):
    scores = torch.tensor(scores, dtype=torch.float64)
    moved = interquartile_mean(scale * scores.flip(0) + shift)
    torch.testing.assert_close(moved, scale * interquartile_mean(scores) + shift, rtol=1e-9, atol=1e-7)
    assert scores.min() - 1e-9 <= interquartile_mean(scores) <= scores.max() + 1e-9


def test_interval_of_seeds_that_agree_has_no_width_whatever_the_tasks_levels():
    scores = torch.tensor([[0.0, 10.0, 50.0]]).expand(6, 3)
    low, high = bootstrap_interval(scores, generator=seeded())
    assert low == high == interquartile_mean(scores) and low.shape == ()


def test_interval_covers_and_narrows_and_is_drawn_from_its_generator_only():
    scores = torch.randn(20, generator=seeded(1))
    wide, again = (bootstrap_interval(scores, generator=seeded()) for _ in range(2))
    narrow = bootstrap_interval(scores, confidence=0.5, generator=seeded())
    assert wide == again and wide != bootstrap_interval(scores, generator=seeded(5))
    assert wide[0] < narrow[0] < interquartile_mean(scores) < narrow[1] < wide[1]


@pytest.mark.parametrize(
    ("returns", "expected"),
    [
        ([0.0, 0, 10, 20], 150),  # half-way up the second line
        ([9.0, 0, 10, 20], 0),  # from the beginning, and lost again
        ([0.0, 5, 0, 0], 100),  # touched
        ([0.0, 4, 3, 4], torch.inf),
        ([0.0, 20, 0, 20], 25),  # for the first time
    ],
)
def test_steps_to_threshold_by_hand(returns, expected):
    steps = torch.tensor([0.0, 100, 200, 300])
    assert steps_to_threshold(steps, torch.tensor([returns, [7.0, 7, 7, 7]]), 5).tolist() == [expected, 0]


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=12), st.floats(-100, 100), st.floats(0, 50))
@settings(max_examples=50, deadline=None)
def test_a_higher_threshold_is_never_reached_earlier(returns, threshold, more):
    returns = torch.tensor([returns], dtype=torch.float64)
    steps = torch.arange(returns.shape[1], dtype=torch.float64)
    sooner, later = (steps_to_threshold(steps, returns, at) for at in (threshold, threshold + more))
    assert (sooner <= later + 1e-9).all() and (sooner.isinf() == (returns < threshold).all(1)).all()


@pytest.mark.parametrize(
    ("steps", "returns", "name"),
    [([0.0, 1, 2], [[1.0, 2]], "returns"), ([0.0, 1], [1.0, 2], "returns"), ([0.0, 0], [[1.0, 2]], "steps")],
)
def test_steps_to_threshold_refuses_what_does_not_fit(steps, returns, name):
    with pytest.raises(ValueError, match=name):
        steps_to_threshold(torch.tensor(steps), torch.tensor(returns), 1)


NEVER = torch.inf


@pytest.mark.parametrize(
    ("ours", "our_ends", "theirs", "their_ends", "expected"),
    [
        ([80.0], [200], [NEVER], [100], (1, 0, 0)),  # theirs was seen below the line at 100
        ([150.0], [200], [NEVER], [100], (0, 0, 1)),  # theirs may have crossed at 110
        ([100.0], [200], [NEVER], [100], (1, 0, 0)),  # seen below the line at that very step
        ([NEVER], [100], [80.0], [200], (0, 1, 0)),
        ([NEVER], [100], [NEVER], [200], (0, 0, 1)),
        ([150.0], [200], [90.0], [100], (0, 1, 0)),  # both crossed: no end is asked
        ([80.0], [100], [80.0], [200], (0, 0, 1)),  # a tie
        ([80.0, NEVER], [100, 50], [90.0, NEVER, 70.0], [100, 60, 100], (1, 1, 4)),
    ],
)
def test_race_counts_by_hand(ours, our_ends, theirs, their_ends, expected):
    columns = [torch.tensor(column, dtype=torch.float64) for column in (ours, our_ends, theirs, their_ends)]
    assert tuple(count.item() for count in race_counts(*columns)) == expected
    exchanged = race_counts(*columns[2:], *columns[:2])
    assert tuple(count.item() for count in exchanged) == (expected[1], expected[0], expected[2])


RUNS = st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), min_size=1, max_size=6)


@given(RUNS, RUNS, st.integers(0, 9))
@settings(max_examples=100, deadline=None)
def test_what_is_decided_agrees_with_the_truth_and_stays_when_all_are_watched_for_longer(ours, theirs, longer):
    def watched(runs, more=0):
        crossings, ends = torch.tensor(runs, dtype=torch.float64).T
        ends = ends + more
        return torch.where(crossings <= ends, crossings, NEVER), ends

    won, lost, undecided = race_counts(*watched(ours), *watched(theirs))
    later = race_counts(*watched(ours, longer), *watched(theirs, longer))
    truth = race_counts(*watched(ours, 10), *watched(theirs, 10))
    assert won <= later[0] <= truth[0] and lost <= later[1] <= truth[1]
    assert won + lost + undecided == len(ours) * len(theirs)
    assert truth[2] == sum(a == b for a, _ in ours for b, _ in theirs)  # ties only


@pytest.mark.parametrize(
    ("ours", "our_ends", "theirs", "their_ends", "name"),
    [([2.0], [1.0], [1.0], [1.0], "ours"), ([1.0], [1.0], [2.0], [1.0], "theirs"), ([1.0, 1], [1.0], [1.0], [1.0], "our_ends")],
)
def test_race_counts_refuses_what_does_not_fit(ours, our_ends, theirs, their_ends, name):
    with pytest.raises(ValueError, match=name):
        race_counts(*map(torch.tensor, (ours, our_ends, theirs, their_ends)))


def random_steps(size=32, seed=0):
    generator = seeded(seed)
    obs, next_obs = torch.randn(2, size, 4, generator=generator)
    actions = 2 * torch.rand(size, 2, generator=generator) - 1
    ended = torch.rand(size, generator=generator) < 0.3
    return Transitions(obs, actions, torch.randn(size, generator=generator), next_obs, ended)


def test_the_fast_update_is_the_plain_one():
    plain, fast = (sac.Agent(4, [-1.0, -2.0], [1.0, 2.0], SMALL.but(learning_rate=1e-2), seed=3) for _ in range(2))
    for seed in range(3):
        batch = random_steps(seed=seed)
        expected = sac.update(plain, batch, SMALL, TAUGHT, seeded(seed))
        metrics = fast_sac_update(fast, batch, SMALL, TAUGHT, seeded(seed))
        for name, value in expected.items():
            assert metrics[name].item() == pytest.approx(value.item(), rel=1e-4, abs=1e-5)
        for here, there in zip(fast.tensors(), plain.tensors(), strict=True):
            torch.testing.assert_close(here, there, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("update", [sac.update, fast_sac_update])
def test_two_runs_with_one_seed_are_equal_bit_for_bit(update):
    rows = []
    for seed in (0, 0, 1):
        training = sac.Training(gym.make("Pendulum-v1"), SMALL, seed, TAUGHT, update)
        rows.append(repr([training.advance(100) for _ in range(3)]))
    assert rows[0] == rows[1] != rows[2]
