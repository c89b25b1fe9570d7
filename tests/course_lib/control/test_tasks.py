"""The vector tasks: Pendulum against Gymnasium's own, the car by hand."""

import gymnasium as gym
import numpy as np
import pytest

from course_lib.control.tasks import CruiseVectorEnv, PendulumVectorEnv


def test_pendulum_moves_and_pays_as_gymnasium_does():
    single = gym.make("Pendulum-v1")
    single.reset(seed=0)
    envs = PendulumVectorEnv(num_envs=2)
    envs.reset(seed=0, options={"states": np.tile(single.unwrapped.state, (2, 1))})
    rng = np.random.default_rng(0)
    for _ in range(150):
        action = rng.uniform(-3, 3, 1)  # also beyond the bounds
        obs, reward, *_ = single.step(action)
        observations, rewards, *_ = envs.step(np.tile(action, (2, 1)))
        np.testing.assert_allclose(observations, np.tile(obs, (2, 1)), atol=1e-4)
        np.testing.assert_allclose(rewards, reward, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kind", [PendulumVectorEnv, CruiseVectorEnv])
def test_episodes_are_cut_together_and_the_last_observation_is_kept(kind):
    envs = kind(num_envs=3, time_limit=2)
    first, _ = envs.reset(seed=1)
    actions = np.zeros((3, 1))
    *_, truncated, info = envs.step(actions)
    assert not truncated.any() and not info
    obs, _, terminated, truncated, info = envs.step(actions)
    assert truncated.all() and not terminated.any() and info["_final_obs"].all()
    assert info["final_obs"].shape == obs.shape == first.shape and obs.dtype == np.float32
    assert not np.array_equal(info["final_obs"], obs)


def test_one_seed_gives_one_trajectory():
    def play():
        envs = CruiseVectorEnv(num_envs=4)
        envs.reset(seed=5)
        return [envs.step(np.full((4, 1), 0.3))[1] for _ in range(5)]

    np.testing.assert_array_equal(play(), play())


def test_the_car_settles_at_the_speed_that_the_pedal_asks_for_and_pays_for_it():
    envs = CruiseVectorEnv(num_envs=2, time_limit=1000, noise=0.0)
    envs.reset(seed=0)
    for _ in range(100):
        obs, rewards, *_ = envs.step(np.array([[-0.5], [1.0]]))
    np.testing.assert_allclose(obs[:, 0], [1, 4], atol=1e-6)
    np.testing.assert_allclose(rewards, [1, -8], atol=1e-5)


def test_a_time_limit_below_one_is_refused():
    with pytest.raises(ValueError, match="time_limit must be at least 1, got 0"):
        PendulumVectorEnv(time_limit=0)
