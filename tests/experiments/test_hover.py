"""The experiments behind chapter 45's exercise of tuning: each variant is one change, and a run is a set of trainings that repeats."""

import numpy as np
import pytest

from course_lib.control import tuning
from course_lib.control.ppo import LANDER_SETTINGS
from experiments import hover, tuned


@pytest.mark.parametrize("name", hover.TRIED)
def test_there_are_three_values_on_either_side_of_the_centre(name):
    values, centre = hover.TRIED[name], hover.CENTRE[name]
    assert sum(value < centre for value in values) == sum(value > centre for value in values) == 3
    for value in values:
        changed = hover.VARIANTS[f"{name}_{value:g}"]
        assert {key for key in changed if changed[key] != hover.VARIANTS["centre"][key]} == {name}


def test_an_ablation_changes_what_it_says_and_is_compared_over_the_same_trainings():
    for variant, changes in hover.PARTS.items():
        told, centre = hover.VARIANTS[variant], hover.VARIANTS["centre"]
        assert {key for key in told if told[key] != centre[key]} == set(changes)
        assert hover.SEEDS[variant] == hover.SEEDS["centre"] == hover.SEEDS["learning_rate_0.01"] == 3


def test_a_run_of_an_ablation_trains_with_its_change(tmp_path, monkeypatch):
    given = []
    monkeypatch.setattr(tuning, "trainings", lambda train, settings, seeds: given.append(settings) or (np.zeros(1), {}))
    hover.run("fast_target_kl", 0, tmp_path, lambda done, total: None)
    assert {(one.learning_rate, one.clip_range, one.target_kl) for one in given} == {(0.01, np.inf, 0.02)}


def test_the_centre_is_the_landers_but_for_its_size_and_horizon():
    centre = tuning.tuned(hover.CENTRE)
    same = {name for name in hover.CENTRE if getattr(centre, name) == getattr(LANDER_SETTINGS, name)}
    assert set(hover.CENTRE) - same == {"num_steps", "minibatch_size", "gamma"}


@pytest.mark.parametrize("name", tuned.SINGLE)
def test_a_single_change_is_one(name):
    told, start = tuned.VARIANTS[f"broken_only_{name}"], tuned.VARIANTS["broken_nothing"]
    assert {key for key in told if told[key] != start[key]} == {"mistake", name}


def test_a_set_of_trainings_repeats_and_shares_no_seed_with_the_next(monkeypatch):
    monkeypatch.setattr(hover, "TRAININGS", 2)
    seeds = []
    trainings = tuning.trainings
    monkeypatch.setattr(
        tuning, "trainings", lambda train, settings, given: seeds.extend(given) or trainings(train, settings, given)
    )
    told = []
    first, again, other = (hover.made({}, seed, lambda *at: told.append(at)) for seed in (0, 0, 1))
    assert first.summary == again.summary != other.summary and told[:2] == [(1, 2), (2, 2)]
    assert seeds[:2] == seeds[2:4] and not set(seeds[:2]) & set(seeds[4:])
    assert np.allclose(first.summary["eval_returns"], [row["mean_return"] for row in first.rows], atol=1e-3)
