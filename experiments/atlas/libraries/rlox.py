# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "rlox==1.2.0"]
#
# [tool.atlas]
# libraries = ["rlox"]
# ///
"""`compute_gae`, compiled, on one environment after the other."""

import numpy as np
import rlox
import torch
from rlox.losses import PPOLoss
from sheet import given, row


def advantages(n):
    ended = np.maximum(np.array(given.terminated[n]), np.array(given.truncated[n])).astype(float)
    rollout = np.array(given.rewards[n]), np.array(given.values[n]), ended, given.last_values[n]
    return rlox.compute_gae(*rollout, given.gamma, given.gae_lambda)[0]


row(
    "gae", np.array([advantages(n) for n in range(2)]), "compute_gae", "rlox._rlox_core", "one flag for both kinds of end",
    "Its collector adds γ V of the last observation to the reward beforehand where an episode was truncated and not terminated.",
)  # fmt: skip


class Policy:
    def get_logprob_and_entropy(self, obs, actions):
        return tensor("logp"), tensor("entropy")

    def get_value(self, obs):
        return tensor("new_values")


def tensor(name):
    return torch.tensor(getattr(given, name))


def loss(**settings):
    old = tensor("old_logp"), tensor("adv"), tensor("returns"), tensor("old_values")
    return PPOLoss(clip_eps=given.clip_range, vf_coef=given.vf_coef, ent_coef=given.ent_coef, **settings)(
        Policy(), None, None, *old
    )[1]


source = "rlox/losses.py"
clipped = loss()
row("policy_loss", clipped["policy_loss"], "PPOLoss", source)
row("approx_kl", clipped["approx_kl"], "PPOLoss", source)
row("clip_fraction", clipped["clip_fraction"], "PPOLoss", source)
row("value_loss_clipped", clipped["value_loss"], "PPOLoss", source, "clip_vloss=True, the default")
row("value_loss", loss(clip_vloss=False)["value_loss"], "PPOLoss", source, "clip_vloss=False")
