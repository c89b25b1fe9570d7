"""The experiment of chapter 48: runs that are killed give the numbers of those that are not, and all are judged alike."""

import functools

import numpy as np
import pytest
import torch

from experiments import control

CLOCKS = {"train_seconds", "train_cpu_seconds"}


class Killed(Exception):
    pass


@pytest.fixture
def tiny(monkeypatch):
    """Totals that take a second, with evaluations and checkpoints at every look."""
    sac = {"total_steps": 240, "learning_starts": 60, "batch_size": 16, "hidden": 8}
    ppo = {"total_steps": 640, "num_steps": 40, "minibatch_size": 80, "num_epochs": 2}
    for settings, changes in ((control.SAC_SETTINGS, sac), (control.PPO_SETTINGS, ppo)):
        for place in settings:
            monkeypatch.setitem(settings, place, settings[place].but(**changes))
    for variant in control.VARIANTS:
        monkeypatch.setitem(control.VARIANTS, variant, control.VARIANTS[variant] | {"every": 80 if variant[0] == "s" else 320})
    monkeypatch.setattr(control, "SAVE_EVERY", -1.0)
    monkeypatch.setattr(control, "evaluate", functools.partial(control.evaluate, episodes=2))
    monkeypatch.setattr(control, "CHUNK", {"sac": 30, "ppo": 1})


def numbers(result):
    """What a run found, without what the clock said."""
    return [{name: value for name, value in row.items() if name not in CLOCKS} for row in result.rows], result.summary[
        "final_returns"
    ]


@pytest.mark.parametrize("variant", ["sac_pendulum", "ppo_pendulum", "sac_hopper", "ppo_hopper"])
def test_a_killed_run_goes_on_with_the_same_numbers(variant, tiny, tmp_path):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    whole.mkdir(), broken.mkdir()
    expected = control.run(variant, 1, whole, lambda done, total: None)

    def stop(done, total):
        if (broken / "checkpoint.pt").exists() and done > total / 2:
            raise Killed

    with pytest.raises(Killed):
        control.run(variant, 1, broken, stop)
    resumed = control.run(variant, 1, broken, lambda done, total: None)
    np.testing.assert_equal(numbers(resumed), numbers(expected))
    assert all(resumed.summary[clock] > 0 for clock in CLOCKS)


def test_rows_begin_before_training_and_hold_each_episode(tiny, tmp_path):
    result = control.run("sac_pendulum", 0, tmp_path, lambda done, total: None)
    assert [row["env_steps"] for row in result.rows] == [0, 80, 160, 240]
    for row in result.rows:
        assert row["eval_return"] == pytest.approx(np.mean([row["eval_return_0"], row["eval_return_1"]]))
    assert result.rows[0]["train_cpu_seconds"] == 0 < result.rows[-1]["train_cpu_seconds"]


def test_evaluation_is_the_same_each_time_and_asks_nobody_for_noise():
    asked = []

    def act(obs):
        asked.append(obs.copy())
        return torch.zeros(len(obs), 3)

    first, again = (control.evaluate(act, "Hopper-v5", episodes=3) for _ in range(2))
    assert first == again and len(set(first)) == 3
    half = len(asked) // 2
    for one, other in zip(asked[:half], asked[half:], strict=True):
        np.testing.assert_array_equal(one, other)


def test_both_algorithms_meet_the_same_starts():
    starts = []
    for made in (control.SACRun, control.PPORun):
        agent, seen = made("hopper", 0), []

        def act(obs, agent=agent, seen=seen):
            seen.append(obs.copy())
            return agent.best_action(torch.as_tensor(obs))

        control.evaluate(act, "Hopper-v5", episodes=2)
        starts.append(seen[0])
    np.testing.assert_array_equal(*starts)


def test_actions_beyond_the_bounds_are_clipped_in_evaluation():
    returns = [control.evaluate(lambda obs, a=a: torch.full((len(obs), 1), a), "Pendulum-v1", 2) for a in (2.0, 50.0)]
    assert returns[0] == returns[1]


def test_every_variant_says_all_of_its_settings():
    assert set(control.VARIANTS) == set(control.SEEDS)
    for variant, configuration in control.VARIANTS.items():
        settings = (control.SAC_SETTINGS if variant.startswith("sac") else control.PPO_SETTINGS)[variant[4:]]
        assert configuration["learning_rate"] == settings.learning_rate and configuration["every"] > 0
