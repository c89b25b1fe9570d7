#!/usr/bin/env bash
# What PettingZoo calls truncated, Stable-Baselines3 takes for a termination if SuperSuit stands between them, as it usually does: with
# SuperSuit 3.11.0 and stable-baselines3 2.9.2 no step says that a time limit ended its episode, so that PPO counts nothing after the last
# step. The same episodes in Stable-Baselines3's own vector environment end with the critic's value of what would have come.
#
# Why: Stable-Baselines3 has one flag, done, and reads info["TimeLimit.truncated"] beside it. SuperSuit joins PettingZoo's two flags in the
# one, puts the last observation into the infos as Stable-Baselines3 wants it, and leaves the other entry out.
#
# Seen in November 2026: ten rewards of 1 and then a truncation, discount 0.99, a critic that says 100 everywhere, which is what rewards of 1
# without end are worth. In PPO's rollout the last step's reward is 100 without SuperSuit and 1 with it; the return that the first step's
# value is fitted to is 100 and 9.56.
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 gymnasium==1.4.0 pettingzoo==1.27.0 \
    supersuit==3.11.0 stable-baselines3==2.9.2
cd "$folder"
PYTHONWARNINGS=ignore venv/bin/python - <<'PYTHON'
import gymnasium
import numpy as np
import supersuit
import torch
from pettingzoo import ParallelEnv
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

STEPS, GAMMA = 10, 0.99
OBSERVATIONS, ACTIONS = gymnasium.spaces.Box(0, 1, (1,)), gymnasium.spaces.Discrete(2)


class OfTwo(ParallelEnv):
    """Two agents that get a reward of 1 in each of ten steps; then both are truncated."""

    metadata = {"name": "of_two_v0", "render_modes": []}
    possible_agents = ["left", "right"]
    render_mode = None

    def observation_space(self, agent):
        return OBSERVATIONS

    def action_space(self, agent):
        return ACTIONS

    def reset(self, seed=None, options=None):
        self.agents, self.count = list(self.possible_agents), 0
        return dict.fromkeys(self.agents, np.zeros(1, np.float32)), {agent: {} for agent in self.agents}

    def step(self, actions):
        self.count += 1
        ended = self.count == STEPS
        told = [dict.fromkeys(self.agents, each) for each in (np.full(1, self.count / STEPS, np.float32), 1.0, False, ended)]
        infos = {agent: {} for agent in self.agents}
        self.agents = [] if ended else self.agents
        return *told, infos


class OfOne(gymnasium.Env):
    """The same as one of them meets it."""

    observation_space, action_space = OBSERVATIONS, ACTIONS

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.inner = OfTwo()
        return tuple(told["left"] for told in self.inner.reset())

    def step(self, action):
        return tuple(told["left"] for told in self.inner.step({"left": action, "right": action}))


def rollout(env):
    """Of one episode in PPO's buffer: the last step's reward and the first step's return."""
    ppo = PPO("MlpPolicy", env, n_steps=STEPS, batch_size=STEPS, gamma=GAMMA, gae_lambda=1.0, device="cpu")
    with torch.no_grad():
        ppo.policy.value_net.weight.zero_()
        ppo.policy.value_net.bias.fill_(1 / (1 - GAMMA))
    _, callback = ppo._setup_learn(STEPS)
    ppo.collect_rollouts(env, callback, ppo.rollout_buffer, STEPS)
    return ppo.rollout_buffer.rewards[-1, 0].item(), ppo.rollout_buffer.returns[0, 0].item()


converted = supersuit.concat_vec_envs_v1(supersuit.pettingzoo_env_to_vec_env_v1(OfTwo()), 1, base_class="stable_baselines3")
found = {"without SuperSuit": rollout(DummyVecEnv([OfOne])), "with SuperSuit": rollout(converted)}
for name, (reward, target) in found.items():
    print(f"{name:18s} last reward {reward:6.2f}  first return {target:6.2f}")

converted.reset()
for _ in range(STEPS):
    _, _, dones, infos = converted.step(np.zeros(2, int))
print("SuperSuit's infos at the end:", *infos)
assert all(dones) and all("terminal_observation" in info for info in infos)
assert not any("TimeLimit.truncated" in info for info in infos), "this is no longer so"
assert np.allclose(found["without SuperSuit"], (100, 100), atol=0.01)
assert np.allclose(found["with SuperSuit"], (1, (1 - GAMMA**STEPS) / (1 - GAMMA)), atol=0.01), "this is no longer so"
PYTHON
