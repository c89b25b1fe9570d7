#!/usr/bin/env bash
# gymnasium's NormalizeReward runs on through episodes that a time limit ends: with 1.4.0 the discounted return whose variance it divides by
# begins again after a termination only. Ten rewards of 1 and then the end make returns of at most 9.56; where the end is a truncation the
# wrapper's running return climbs to 100, that of an episode without end, and the rewards that a learner sees are another number.
# Tasks that never terminate (HalfCheetah, Pendulum) are always of that kind. Stable-Baselines3's VecNormalize begins again at both ends.
#
# Why: the running return is multiplied by gamma * (1 - terminated), and `reset` leaves it alone.
#
# Seen in November 2026, 200 episodes: largest running return 9.56 and last reward 0.37 after termination, 100.00 and 0.07 after truncation;
# VecNormalize of stable-baselines3 2.9.2 after truncation: 9.56 and 0.37.
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check gymnasium==1.4.0 torch==2.13.0 numpy==2.4.6 stable-baselines3==2.9.2
cd "$folder"
PYTHONWARNINGS=ignore venv/bin/python - <<'PYTHON'
import gymnasium
import numpy as np
from gymnasium.wrappers import NormalizeReward
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

EPISODES, STEPS = 200, 10


class Ones(gymnasium.Env):
    """Ten rewards of 1, and then the end: a termination, or a truncation as gymnasium.wrappers.TimeLimit gives it."""

    observation_space = gymnasium.spaces.Box(0, 1, (1,))
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, terminates):
        self.terminates = terminates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.count += 1
        done = self.count == STEPS
        return np.zeros(1, np.float32), 1.0, done and self.terminates, done and not self.terminates, {}


def through_gymnasium(terminates):
    env, largest = NormalizeReward(Ones(terminates)), 0.0
    for _ in range(EPISODES):
        env.reset()
        for _ in range(STEPS):
            reward = env.step(0)[1]
            largest = max(largest, env.discounted_reward.item())
    return largest, float(reward)


def through_stable_baselines():
    env = VecNormalize(DummyVecEnv([lambda: Ones(terminates=False)]), norm_obs=False)
    largest = reward = 0.0
    env.reset()
    for step in range(EPISODES * STEPS):
        expected = 0.99 * (0 if step % STEPS == 0 else env.returns.item()) + 1
        reward = env.step(np.array([0]))[1].item()
        assert env.returns.item() == (0 if step % STEPS == STEPS - 1 else expected)  # begun again at every end
        largest = max(largest, expected)
    return largest, reward


found = {
    "gymnasium, terminated": through_gymnasium(True),
    "gymnasium, truncated": through_gymnasium(False),
    "VecNormalize, truncated": through_stable_baselines(),
}
for name, (largest, reward) in found.items():
    print(f"{name:24s} largest running return {largest:6.2f}, last reward {reward:.2f}")
assert round(found["gymnasium, terminated"][0], 2) == round(found["VecNormalize, truncated"][0], 2) == 9.56
assert found["gymnasium, truncated"][0] > 99.9, "this is no longer so"
assert found["gymnasium, truncated"][1] < 0.25 * found["gymnasium, terminated"][1]
PYTHON
