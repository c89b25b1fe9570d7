"""Gymnasium's interface, same-step autoreset, and exact values that agree with what one measures."""

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

from course_lib.control.envs import BalanceTask, ChainVectorEnv, HoverVectorEnv, TimerVectorEnv, begun, make


def quiet(**options):
    return ChainVectorEnv(**{"num_envs": 1, "slip": 0.0, "reward_noise": 0.0, **options})


def walk(envs, action, steps):
    envs.reset(seed=0)
    return [envs.step(np.full(envs.num_envs, action)) for _ in range(steps)]


def test_spaces_and_autoreset_mode_are_declared():
    envs = ChainVectorEnv(num_envs=3)
    obs, info = envs.reset(seed=0)
    assert envs.observation_space.contains(obs) and info == {}
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert envs.action_space.contains(envs.action_space.sample())


def test_left_end_pays_once_and_terminates():
    obs, rewards, terminated, truncated, info = walk(quiet(), action=0, steps=3)[-1]
    assert (rewards[0], terminated[0], truncated[0]) == (8, True, False)
    assert info["final_obs"][0] == -1 and info["_final_obs"][0]
    assert obs[0] == 0  # the first observation of the next episode


def test_right_end_pays_every_step_until_the_limit_truncates():
    steps = walk(quiet(), action=1, steps=10)
    assert [step[1][0] for step in steps] == [0, 0, 1, 1, 1, 1, 1, 1, 1, 1]
    assert [bool(step[3][0]) for step in steps] == [False] * 9 + [True]
    assert not any(step[2][0] for step in steps)
    assert steps[-1][4]["final_obs"][0] == 1 and steps[-1][0][0] == 0


def test_reaching_the_exit_on_the_last_allowed_step_is_termination_only():
    _, _, terminated, truncated, _ = walk(quiet(time_limit=3), action=0, steps=3)[-1]
    assert terminated[0] and not truncated[0]


def test_same_seed_gives_the_same_episode():
    first, second = (walk(ChainVectorEnv(num_envs=4), action=1, steps=20) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one[1], other[1])


def test_values_of_the_certain_chain_are_the_closed_forms():
    gamma = 0.9
    wage = 1 / (1 - gamma)  # 1 per step for ever
    np.testing.assert_allclose(quiet().values(1.0, gamma)[3:], [gamma**2 * wage, gamma * wage, wage, wage])
    np.testing.assert_allclose(quiet().values(0.0, gamma)[1:4], [8, gamma * 8, gamma**2 * 8])
    assert quiet().values(0.3, gamma)[0] == 0


def test_values_satisfy_the_definition_of_action_values():
    envs, policy = ChainVectorEnv(), np.linspace(0.1, 0.9, 7)
    action_values = envs.action_values(policy, 0.95)
    expected = (1 - policy) * action_values[:, 0] + policy * action_values[:, 1]
    np.testing.assert_allclose(envs.values(policy, 0.95), expected)


def test_values_agree_with_simulated_returns():
    envs = ChainVectorEnv(num_envs=4000, time_limit=None)
    rng = np.random.default_rng(0)
    envs.reset(seed=0)
    returns, running = np.zeros(4000), np.ones(4000)
    for _ in range(80):
        _, rewards, terminated, _, _ = envs.step(rng.random(4000) < 0.7)
        returns += running * rewards
        running *= 0.9 * ~terminated
    assert returns.mean() == pytest.approx(envs.values(0.7, 0.9)[envs.start], abs=4 * returns.std() / 4000**0.5)


@pytest.mark.parametrize(
    ("option", "value"), [("length", 2), ("time_limit", 0), ("slip", 1.5), ("slip", -0.1), ("reward_noise", -1.0)]
)
def test_impossible_options_are_refused_by_name(option, value):
    with pytest.raises(ValueError, match=f"{option}.*{value}"):
        ChainVectorEnv(**{option: value})


GAINS, STD = torch.tensor([0.6, 0.2, -0.1]), 0.7


def simulated_returns(task, positions, first_actions, num_steps=80):
    """(1 - γ) Σ γ^t r_t of GAINS and STD, stepped one by one, for given first positions and actions."""
    generator = torch.Generator().manual_seed(1)

    def normal():
        return torch.randn(len(positions), generator=generator)

    returns, actions = torch.zeros(len(positions)), first_actions
    for t in range(num_steps):
        positions = task.drift * positions + actions + task.noise * normal()
        returns += (1 - task.gamma) * task.gamma**t * (-(positions**2) / 2).exp()
        actions = STD * normal() - GAINS[0] * positions - GAINS[1] * normal() - GAINS[2] * normal()
    return returns


def test_mean_reward_and_advantages_agree_with_a_simulation():
    task, count = BalanceTask(sensors=2), 20_000
    generator = torch.Generator().manual_seed(0)
    obs = torch.randn(count, 3, generator=generator)
    obs[:, 0] *= task.start_std
    actions = STD * torch.randn(count, generator=generator) - obs @ GAINS
    assert simulated_returns(task, obs[:, 0], actions).mean().item() == pytest.approx(task.mean_reward(GAINS, STD), abs=0.005)

    state = torch.tensor([[1.0, 0.5, -0.5]])
    pushes = {push: simulated_returns(task, torch.ones(count), torch.full((count,), push)).mean() for push in (-1.5, 0.5)}
    exact = [task.advantages(state, torch.tensor([push]), GAINS, STD).item() for push in pushes]
    assert exact[0] - exact[1] == pytest.approx((pushes[-1.5] - pushes[0.5]).item() / (1 - task.gamma), abs=0.03)


def test_advantages_have_mean_zero_in_every_state():
    task = BalanceTask(sensors=2)
    obs = torch.tensor([[2.0, 1.0, -1.0]]).expand(100_000, 3)
    actions = STD * torch.randn(100_000, generator=torch.Generator().manual_seed(0)) - obs @ GAINS
    assert task.advantages(obs, actions, GAINS, STD).mean().item() == pytest.approx(0, abs=0.005)


def test_expected_advantage_is_the_importance_weighted_mean_over_the_sample():
    task, new_gains, new_std = BalanceTask(sensors=2), torch.tensor([0.7, 0.1, 0.0]), 0.65
    obs, actions = task.sample(GAINS, STD, 200_000, torch.Generator().manual_seed(0))
    new, old = (
        torch.distributions.Normal(-(obs @ gains), std).log_prob(actions) for gains, std in ((new_gains, new_std), (GAINS, STD))
    )
    weighted = ((new - old).exp() * task.advantages(obs, actions, GAINS, STD)).mean().item()
    assert task.expected_advantage(new_gains, new_std, GAINS, STD) == pytest.approx(weighted, abs=0.01)


def test_expected_advantage_has_the_slope_of_the_mean_reward_at_the_policy_itself_and_only_there():
    task, nearby, far = BalanceTask(), torch.tensor([0.601]), torch.tensor([1.2])
    gains = torch.tensor([0.6])
    assert task.expected_advantage(gains, STD, gains, STD) == 0
    gained = {policy: task.mean_reward(policy, STD) - task.mean_reward(gains, STD) for policy in (nearby, far)}
    assert task.expected_advantage(nearby, STD, gains, STD) == pytest.approx(gained[nearby], rel=0.01)
    assert task.expected_advantage(far, STD, gains, STD) > 1.1 * gained[far]


def test_an_unstable_controller_earns_next_to_nothing_and_stays_finite():
    assert 0 <= BalanceTask().mean_reward(torch.tensor([50.0]), 1.0) < 0.05
    assert torch.isfinite(BalanceTask().advantages(torch.ones(1, 1), torch.ones(1), torch.tensor([50.0]), 1.0)).all()


@pytest.mark.parametrize("gamma", [0.0, 1.0, -0.5])
def test_balance_refuses_discounts_without_a_finite_sum(gamma):
    with pytest.raises(ValueError, match=f"gamma must lie in .*{gamma}"):
        BalanceTask(gamma=gamma)


def test_made_environments_reset_in_the_same_step_show_the_true_end_and_draw_nothing():
    envs = make("CartPole-v1", 2, max_episode_steps=3)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP and envs.envs[0].render_mode is None
    envs.reset(seed=0)
    _, second, third = (envs.step(np.ones(2, dtype=int)) for _ in range(3))
    assert third[3].all() and not second[3].any()
    assert (np.stack(third[4]["final_obs"])[:, 1] > second[0][:, 1]).all() and (np.abs(third[0]) < 0.06).all()


def test_environments_of_one_vector_differ_and_one_seed_decides_them():
    first, again, other = (make("CartPole-v1", 3).reset(seed=seed)[0] for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(first[:, 0])) == 3 and not (first == other).any()


def test_timers_end_when_and_as_told():
    envs = TimerVectorEnv(lengths=(1, 2), terminates=(True, False), action_reward=0.5, low=-0.3, high=0.8)
    assert envs.single_action_space.low == np.float32(-0.3) and envs.single_action_space.high == np.float32(0.8)
    assert envs.observation_space.contains(envs.reset(seed=0)[0])
    first, second = (envs.step(np.array([[0.0], [1.0]])) for _ in range(2))
    assert (first[0].tolist(), first[2].tolist(), first[3].tolist()) == ([[0], [1]], [True, False], [False, False])
    assert first[4]["final_obs"].tolist() == [[1], [1]] and first[4]["_final_obs"].tolist() == [True, False]
    assert (second[0].tolist(), second[2].tolist(), second[3].tolist()) == ([[0], [0]], [True, False], [False, True])
    assert first[1].tolist() == [1, 1.5]


@pytest.mark.parametrize("options", [{"lengths": (3,)}, {"lengths": (0, 3)}, {"terminates": (True,) * 3}])
def test_timers_refuse_impossible_lengths(options):
    with pytest.raises(ValueError, match="lengths"):
        TimerVectorEnv(**options)


def test_a_drone_follows_its_equations_up_to_the_limit():
    envs = HoverVectorEnv(num_envs=2, time_limit=2, gust=0.0)
    before, _ = envs.reset(seed=0)
    assert envs.observation_space.contains(before) and envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    speeds = before[:, 1] + 0.2 * 2 * np.array([1.0, -0.5])
    obs, rewards, terminated, truncated, info = envs.step(np.array([[3.0], [-0.5]]))  # a thrust of 3 is one of 1
    np.testing.assert_allclose(obs, np.stack([before[:, 0] + 0.2 * speeds, speeds], axis=1), rtol=1e-5)
    np.testing.assert_allclose(rewards, np.exp(-2 * obs[:, 0] ** 2), rtol=1e-5)
    assert not terminated.any() and not truncated.any() and info == {}
    obs, _, terminated, truncated, info = envs.step(np.zeros((2, 1)))
    assert truncated.all() and not terminated.any() and (np.abs(obs[:, 0]) <= 1.5).all()
    np.testing.assert_allclose(info["final_obs"][:, 1], speeds, rtol=1e-5)


def test_a_drone_that_flies_away_is_lost():
    envs = begun(HoverVectorEnv(num_envs=3, gust=0.0), seed=1, steps=4, action=1.0)
    ends = [envs.step(np.ones((3, 1)))[2:4] for _ in range(10)]
    assert np.any([terminated for terminated, _ in ends], axis=0).all() and not np.any([truncated for _, truncated in ends])


def test_a_drones_array_is_reused_only_where_one_asks_for_it():
    for copy in (True, False):
        envs = HoverVectorEnv(num_envs=2, copy=copy)
        before, _ = envs.reset(seed=0)
        kept = before.copy()
        after = envs.step(np.ones((2, 1)))[0]
        assert (before is after) is not copy and np.array_equal(before, kept) is copy


@pytest.mark.parametrize("options", [{"time_limit": 0}, {"gust": -0.1}])
def test_a_drone_refuses_impossible_options(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        HoverVectorEnv(**options)


def test_begun_environments_have_been_reset_and_stepped():
    envs = begun(TimerVectorEnv(lengths=(3, 5), terminates=(True, True)), seed=0, steps=4)
    assert envs.observe().tolist() == [[1.0], [4.0]]
