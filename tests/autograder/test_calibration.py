"""The statistics behind thresholds, and the bar that every artefact's must pass."""

import numpy as np
import pytest

from autograder import calibration, checks
from autograder.spec import Artefact

ARTEFACTS = [exercise for exercise in checks.all_exercises() if isinstance(exercise, Artefact)]


def agents(centre, between, within, count=20, seed=0):
    generator = np.random.default_rng(seed)
    return generator.normal(centre, between, (count, 1)) + generator.normal(0, within, (count, 100))


def test_the_chance_follows_what_differs_between_agents():
    # normal agents, two deviations above the mark: a fortieth, and somewhat more as their deviation is estimated
    chances = [calibration.chance_below(agents(220, 10, 1, seed=seed), 200) for seed in range(200)]
    assert 0.02 < np.mean(chances) < 0.06


def test_the_chance_follows_what_differs_between_episodes():
    # agents that are all alike: what is left is the error of the mean of a hundred episodes
    alike = np.tile(np.random.default_rng(0).normal(0, 1, (1, 100)), (20, 1))
    alike = 220 + 100 * (alike - alike.mean()) / alike.std()
    assert calibration.chance_below(alike, 200) == pytest.approx(0.0228, abs=0.002)


def test_one_failure_among_twenty_is_seen():
    returns = agents(280, 1, 1)
    returns[0] -= 200
    assert calibration.chance_below(returns, 200) >= 0.05


def test_above_is_the_mirror_of_below():
    returns = agents(0, 30, 30)
    assert calibration.chance_from(returns, 40) == calibration.chance_below(-returns, -40)


def test_two_agents_are_too_few():
    with pytest.raises(ValueError, match="at least 3 agents, got 2"):
        calibration.chance_below(agents(0, 1, 1, count=2), 0)


def test_a_row_counts_full_and_half_points():
    train = Artefact("train", lambda: None, "f", "lander", 4.0, (0.0, 200.0))
    right, wrong = agents(260, 5, 50), agents(-100, 20, 50)
    found = [calibration.Group("right", "", right), calibration.Group("masked", "ignores the mask", wrong)]
    first, second = calibration.rows(train, found)
    assert (first.agents, first.full, first.half) == (20, 20, 20) and first.chance < 0.01
    assert (second.full, second.half) == (0, 0) and second.chance < 0.01
    assert first.least <= first.middle <= first.most and first.middle == pytest.approx(260, abs=5)


@pytest.mark.parametrize("artefact", ARTEFACTS, ids=lambda artefact: artefact.name)
def test_a_right_agent_earns_all_points_and_a_wrong_one_not_half_of_them(artefact):
    rows = calibration.rows(artefact, calibration.groups(artefact))
    assert sum(row.agents for row in rows if not row.mistake) >= 20 and sum(row.agents for row in rows if row.mistake) >= 20
    assert [row for row in rows if not row.mistake and (row.full < row.agents or row.chance > calibration.BAR)] == []
    assert [row for row in rows if row.mistake and (row.half or row.chance > calibration.BAR)] == []
