# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "sb3-contrib==2.9.2"]
#
# [tool.atlas]
# libraries = ["sb3-contrib"]
# ///
"""MaskablePPO's buffer is filled by hand, with rewards as `collect_rollouts` stores them: γ V of the last observation is added at a time
limit. `MaskablePPO.train` runs with a buffer and a policy that hand out the input, and what it logs is read."""

import gymnasium
import numpy as np
import torch
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.buffers import MaskableRolloutBuffer, MaskableRolloutBufferSamples
from sheet import given, row
from stable_baselines3.common.logger import Logger

box, actions = gymnasium.spaces.Box(-100, 100, (1,), np.float32), gymnasium.spaces.Discrete(2)
buffer = MaskableRolloutBuffer(8, box, actions, "cpu", given.gae_lambda, given.gamma, 2)
starts = np.ones(2)
for t in range(8):
    rewards = np.array([given.rewards[n][t] for n in range(2)])
    for n in range(2):
        if given.truncated[n][t] and not given.terminated[n][t]:
            rewards[n] += given.gamma * given.final_values[n][t]
    values = torch.tensor([given.values[n][t] for n in range(2)])
    buffer.add(np.zeros((2, 1)), np.zeros((2, 1)), rewards, starts, values, torch.zeros(2), action_masks=np.ones((2, 2)))
    starts = np.array([given.terminated[n][t] or given.truncated[n][t] for n in range(2)], float)
buffer.compute_returns_and_advantage(torch.tensor(given.last_values), starts)
row(
    "gae", buffer.advantages.T, "MaskableRolloutBuffer.compute_returns_and_advantage", "sb3_contrib/common/maskable/buffers.py",
    note="With rewards as its collect_rollouts stores them.",
)  # fmt: skip


class Nothing(gymnasium.Env):
    observation_space, action_space = box, actions

    def reset(self, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, True, False, {}


def tensor(name):
    return torch.tensor(getattr(given, name))


class Batch:
    values = returns = np.zeros(2)

    def get(self, size):
        old = tensor("old_values"), tensor("old_logp"), tensor("adv"), tensor("returns")
        yield MaskableRolloutBufferSamples(torch.zeros(6, 1), torch.zeros(6, 1), *old, torch.ones(6, 2))


def train(**settings):
    model = MaskablePPO(
        "MlpPolicy", Nothing(), n_steps=8, batch_size=8, n_epochs=1, clip_range=given.clip_range, device="cpu", **settings
    )
    model.set_logger(Logger(None, []))
    model.rollout_buffer = Batch()
    moved = next(model.policy.parameters())
    model.policy.evaluate_actions = lambda obs, actions, action_masks=None: (
        tensor("new_values") + 0 * moved.sum(), tensor("logp") + 0 * moved.sum(), tensor("entropy")
    )  # fmt: skip
    model.train()
    return {name.removeprefix("train/"): value for name, value in model.logger.name_to_value.items()}


source, call = "sb3_contrib/ppo_mask/ppo_mask.py", "MaskablePPO.train"
plain = train(normalize_advantage=False)
row("policy_loss", plain["policy_gradient_loss"], call, source, "normalize_advantage=False")
row("approx_kl", plain["approx_kl"], call, source)
row("clip_fraction", plain["clip_fraction"], call, source)
row("value_loss", plain["value_loss"], call, source)
row("policy_loss_normalised", train()["policy_gradient_loss"], call, source, "normalize_advantage=True, the default")
row("value_loss_clipped", train(clip_range_vf=given.clip_range)["value_loss"], call, source, "clip_range_vf=0.2")
