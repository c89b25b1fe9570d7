"""An environment that is put where another one was goes on as that one does, through the end of an episode and into the next."""

import gymnasium as gym
import numpy as np
import pytest
import torch

from experiments import checkpoint, snapshots


def played(env, actions):
    """Everything that is seen while these actions are played, resets included."""
    seen = []
    for action in actions:
        obs, reward, terminated, truncated, _ = env.step(action)
        seen.append(np.append(obs, [reward, terminated, truncated]))
        if terminated or truncated:
            seen.append(env.reset()[0])
    return np.concatenate(seen)


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [("Pendulum-v1", 190, 20), ("Hopper-v5", 7, 60), ("Walker2d-v5", 5, 40), ("HalfCheetah-v5", 40, 20)],
)
def test_a_restored_environment_goes_on_bit_for_bit(name, before, after, tmp_path):
    env, other = gym.make(name), gym.make(name)
    env.reset(seed=3)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(before + after)]
    played(env, actions[:before])
    checkpoint.save(tmp_path, {"env": snapshots.taken(env)})
    expected = played(env, actions[before:])
    other.reset(seed=9)
    played(other, actions[:3])
    snapshots.restored(other, checkpoint.load(tmp_path)["env"])
    np.testing.assert_array_equal(played(other, actions[before:]), expected)


def test_taking_a_snapshot_changes_nothing():
    env, other = gym.make("Hopper-v5"), gym.make("Hopper-v5")
    actions = [np.full(3, value, np.float32) for value in torch.linspace(-1, 1, 10).tolist()]
    env.reset(seed=0), other.reset(seed=0)
    seen = [played(env, [action]) for action in actions if snapshots.taken(env)]
    np.testing.assert_array_equal(np.concatenate(seen), played(other, actions))
