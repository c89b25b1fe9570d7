# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0"]
#
# [tool.atlas]
# libraries = ["agilerl"]
# bare = ["agilerl==2.58.0"]
# why = "The package asks for much that is not needed here; its functions are built from their installed files, with stand-ins for self."
# ///
"""Advantages of the rollout buffer and of the PPO for language models, and the whitening."""

from types import SimpleNamespace

import numpy as np
import torch
from sheet import function, given, installed, row


def tensor(name):
    return torch.tensor(getattr(given, name))


def steps(name):
    return tensor(name).T.float()


names = {"torch": torch, "np": np, "narrow_tensor": lambda one: one, "ArrayOrTensor": None}
compute = function(installed("agilerl", "components", "rollout_buffer.py"), "compute_returns_and_advantages", names)
ended = ((steps("terminated") + steps("truncated")) > 0).float()
buffer = {"rewards": steps("rewards"), "values": steps("values"), "dones": torch.cat([torch.zeros(1, 2), ended[:-1]])}
buffer |= {name: torch.zeros(8, 2) for name in ("advantages", "returns")}
self = SimpleNamespace(
    buffer=buffer,
    num_envs=2,
    capacity=8,
    full=True,
    pos=8,
    use_gae=True,
    gamma=given.gamma,
    gae_lambda=given.gae_lambda,
    device="cpu",
)
compute(self, tensor("last_values"), ended[-1])
row(
    "gae", buffer["advantages"].reshape(8, 2).T, "RolloutBuffer.compute_returns_and_advantages", "agilerl/components/rollout_buffer.py",
    "one flag for both kinds of end",
)  # fmt: skip

mask = tensor("mask").bool()
rewards = torch.where(mask, -given.kl_coef * (tensor("tok_old") - tensor("tok_ref")), 0)
rewards[torch.arange(3), mask.sum(1) - 1] += tensor("score")
file, names = installed("agilerl", "utils", "llm_utils.py"), {"torch": torch}
for name in ("masked_mean", "masked_var", "masked_whiten"):
    function(file, name, names)
token_gae = function(installed("agilerl", "algorithms", "ppo_llm.py"), "_compute_gae_returns_token", names)
self, rollout = SimpleNamespace(gamma=given.tok_gamma, whiten_advantages=False), (rewards, tensor("tok_values"), mask)
_, advantages = token_gae(self, *rollout, given.gae_lambda)
row("token_gae", torch.where(mask, advantages, 0), "PPO._compute_gae_returns_token", "agilerl/algorithms/ppo_llm.py")
whitened = names["masked_whiten"](tensor("tok_adv"), mask)
row("whitened", torch.where(mask, whitened, 0), "masked_whiten", "agilerl/utils/llm_utils.py")
self.whiten_advantages = True
_, advantages = token_gae(self, *rollout, given.gae_lambda)
row(
    "whitened_token_gae", torch.where(mask, advantages, 0), "PPO._compute_gae_returns_token", "agilerl/algorithms/ppo_llm.py",
    "whiten_advantages=True, the default",
)  # fmt: skip
