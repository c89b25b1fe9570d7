"""The experiment of chapter 44's details: its first variant is the page's program, and each other changes what its name says."""

import numpy as np
import pytest
import torch

from autograder.authoring import chapter
from course_lib.control import envs
from course_lib.control.rollouts import collect
from experiments import details
from solutions import ch44


def test_the_page_shows_the_program_that_was_recorded(tmp_path, monkeypatch):
    cells = [cell.source for cell in chapter.load("ch44").cells if cell.kind == "code"]
    page = dict(vars(ch44))
    for sign in ("from gymnasium.vector import", "def mlp(", "def train(", "def cartpole("):
        (source,) = [source for source in cells if sign in source]
        exec(source.replace("range(20)", "range(3)").partition("runs = ")[0], page)
    monkeypatch.setattr(details, "UPDATES", 3)
    recorded = details.run("page", 3, tmp_path, lambda done, total: None)
    shown = page["cartpole"](3, 0.95)
    assert [[row["mean_return"], row["explained_variance"]] for row in recorded] == shown[:, :2].tolist()
    assert [row["env_steps"] for row in recorded] == [1024, 2048, 3072]


def test_running_statistics_are_those_of_all_rows_together():
    rows, running = np.random.default_rng(0).normal(3, 2, (30, 4)), details.Running()
    for part in (rows[:1], rows[1:11], rows[11:]):
        running.add(part)
    assert running.count == 30
    np.testing.assert_allclose(running.mean, rows.mean(0))
    np.testing.assert_allclose(running.deviation(), rows.std(0))


def walked(steps=12, **seen):
    """A rollout of CartPole with episodes of five steps, and the wrapper."""
    wrapped = details.Seen(envs.make("CartPole-v1", 3, max_episode_steps=5), 0.99, **seen)
    return collect(wrapped, lambda obs: torch.tensor([0, 1, 0]), steps, wrapped.reset(seed=0)[0])[0], wrapped


def test_units_of_positions_and_rewards_change_and_nothing_else():
    plain, other = walked()[0], walked(position_unit=100.0, reward_unit=0.01)[0]
    for name in ("obs", "next_obs"):  # a true last observation is in the same units
        torch.testing.assert_close(getattr(other, name), getattr(plain, name) * torch.tensor([100.0, 1, 100, 1]))
    assert plain.truncated.any() and (other.rewards == 0.01).all() and (plain.rewards == 1).all()


def test_normalised_observations_do_not_know_their_units():
    plain, other = walked(normalised_obs=True)[0], walked(normalised_obs=True, position_unit=100.0)[0]
    torch.testing.assert_close(other.obs, plain.obs, rtol=1e-2, atol=1e-2)  # but for what keeps a division finite
    assert plain.next_obs.abs().max() <= 10 and not torch.equal(plain.obs, walked()[0].obs)


def test_statistics_of_the_first_observations_stay():
    _, wrapped = walked(normalised_obs=9)
    assert wrapped.obs_seen.count == 9


def test_a_constant_critic_says_one_number_and_leaves_the_first_rollout_as_it_was(tmp_path, monkeypatch):
    monkeypatch.setattr(details, "UPDATES", 2)
    page, constant = (details.run(name, 0, tmp_path, lambda *at: None) for name in ("page", "constant_critic_45"))
    assert page[0]["mean_return"] == constant[0]["mean_return"] and page[-1] != constant[-1]
    assert details.Constant(45.0)(torch.zeros(3, 2, 4)).tolist() == [[[45.0], [45.0]]] * 3


@pytest.mark.parametrize("unit", [0.1, 100.0])
def test_scaled_rewards_do_not_know_their_unit(unit):
    plain, other = walked(scaled_rewards=True)[0], walked(scaled_rewards=True, reward_unit=unit)[0]
    torch.testing.assert_close(other.rewards, plain.rewards, rtol=1e-3, atol=0)


@pytest.mark.parametrize("variant", ["value_clip_0.2", "recomputed", "advantages_centred", "advantages_divided", "gamma_0.9"])
def test_a_detail_changes_what_is_learned_and_not_the_first_rollout(variant, tmp_path, monkeypatch):
    monkeypatch.setattr(details, "UPDATES", 5)
    page, changed = (details.run(name, 0, tmp_path, lambda done, total: None) for name in ("page", variant))
    assert page[0]["mean_return"] == changed[0]["mean_return"]
    assert page[-1] != changed[-1]
