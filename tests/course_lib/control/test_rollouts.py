"""Rollouts hold the true successor of every step, and no transition that never happened."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

from course_lib.control.envs import ChainVectorEnv, TimerVectorEnv
from course_lib.control.rollouts import EpisodeReturns, collect


def always(action):
    return lambda obs: torch.full((len(obs),), action, dtype=torch.int64)


def test_next_obs_is_the_following_row_except_where_an_episode_ends():
    envs = ChainVectorEnv(num_envs=5)
    rollout, _ = collect(envs, always(1), 40, envs.reset(seed=0)[0])
    ended = rollout.terminated | rollout.truncated
    same = (rollout.next_obs[:-1] == rollout.obs[1:]).squeeze(-1)
    assert ended.any() and same[~ended[:-1]].all()
    assert (rollout.obs[1:][ended[:-1]] == 0).all()  # episodes start in the middle
    assert (rollout.next_obs[rollout.terminated] == -1).all()


def test_shapes_and_dtypes():
    envs = ChainVectorEnv(num_envs=3)
    rollout, obs = collect(envs, always(0), 7, envs.reset(seed=0)[0])
    assert rollout.obs.shape == rollout.next_obs.shape == (7, 3, 1) and obs.shape == (3, 1)
    assert rollout.rewards.shape == rollout.actions.shape == (7, 3)
    assert rollout.rewards.dtype == rollout.obs.dtype == torch.float32
    assert rollout.terminated.dtype == rollout.truncated.dtype == torch.bool


def test_a_second_call_carries_on_where_the_first_stopped():
    envs = ChainVectorEnv(num_envs=2)
    first, obs = collect(envs, always(1), 3, envs.reset(seed=0)[0])
    second, _ = collect(envs, always(1), 3, obs)
    assert torch.equal(second.obs[0], first.next_obs[-1])


def test_gymnasiums_own_vector_environment_gives_its_final_observation():
    options = {"autoreset_mode": AutoresetMode.SAME_STEP}
    envs = gym.make_vec("CartPole-v1", 2, vectorization_mode="sync", vector_kwargs=options, max_episode_steps=4)
    rollout, _ = collect(envs, always(1), 8, envs.reset(seed=0)[0])
    assert rollout.truncated[3].all() and rollout.truncated[7].all()
    speeds = rollout.next_obs[:, :, 1]
    assert (speeds[3] > speeds[2]).all() and (rollout.obs[4, :, 1].abs() < 0.06).all()


def test_next_step_autoreset_is_refused():
    envs = gym.make_vec("CartPole-v1", 2, vectorization_mode="sync")
    with pytest.raises(ValueError, match="same-step autoreset"):
        collect(envs, always(1), 2, np.zeros((2, 4)))


def test_returns_of_episodes_add_up_across_rollouts():
    envs, returns = TimerVectorEnv(lengths=(3, 4), terminates=(True, False)), EpisodeReturns(2)
    obs, seen = envs.reset(seed=0)[0], []
    for _ in range(4):
        rollout, obs = collect(envs, lambda obs: torch.zeros(2, 1), 2, obs)
        seen.append(returns.add(rollout))
    assert seen == [[], [3, 4], [3], [4]]
