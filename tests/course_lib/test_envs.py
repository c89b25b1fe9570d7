"""The chain: Gymnasium's interface, same-step autoreset, and exact values that agree with what one measures."""

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from course_lib.envs import ChainVectorEnv


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
