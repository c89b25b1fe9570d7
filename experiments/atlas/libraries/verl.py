# /// script
# requires-python = ">=3.11"
# dependencies = [
#   "numpy==2.4.6", "torch==2.13.0", "ray==2.60.0", "tensordict==0.15.3", "omegaconf==2.3.1", "codetiming==1.4.0", "hydra-core==1.3.8",
#   "transformers==5.24.0", "pandas==3.1.1", "datasets==5.2.0", "packaging==26.4", "orjson==3.13.0",
# ]
#
# [tool.atlas]
# libraries = ["verl"]
# bare = ["verl==0.9.1"]
# seconds = 300
# why = "The package asks for what serves language models on a GPU, which its functions do not need."
# ///
"""The functions of `core_algos`, with a real `ActorConfig`."""

import numpy as np
import torch
from sheet import given, row
from verl.trainer.ppo import core_algos
from verl.utils import torch_functional
from verl.workers.config import ActorConfig


def tensor(name):
    return torch.tensor(getattr(given, name))


def kept(x):
    return torch.where(mask, x, 0)


mask = tensor("mask").bool()
source = "verl/trainer/ppo/core_algos.py"
at_the_end = torch.zeros(3, 5)
at_the_end[torch.arange(3), mask.sum(1) - 1] = tensor("score")
rewards = kept(core_algos.compute_rewards(at_the_end, tensor("tok_old"), tensor("tok_ref"), given.kl_coef))
row("kl_penalised_rewards", rewards, "compute_rewards", source)
advantages, returns = core_algos.compute_gae_advantage_return(
    rewards, tensor("tok_values"), mask.float(), given.tok_gamma, given.gae_lambda
)
call = "compute_gae_advantage_return"
row(
    "token_gae",
    kept(returns - tensor("tok_values")),
    call,
    source,
    note="Its second result less the values, as the first is whitened.",
)
row("whitened_token_gae", kept(advantages), call, source)
whitened = torch_functional.masked_whiten(tensor("tok_adv"), mask.float())
row("whitened", kept(whitened), "torch_functional.masked_whiten", "verl/utils/torch_functional.py")

config = ActorConfig(
    strategy="fsdp", rollout_n=1, ppo_micro_batch_size_per_gpu=1, clip_ratio=given.clip_range, clip_ratio_low=given.clip_range,
    clip_ratio_high=given.clip_range,
)  # fmt: skip
call = "compute_policy_loss_vanilla"


def policy_loss(old, new, advantages, mask, mode="token-mean"):
    return core_algos.compute_policy_loss_vanilla(old, new, advantages, mask, mode, config)


tokens = tensor("tok_old"), tensor("tok_logp"), tensor("tok_adv"), mask.float()
loss, metrics = policy_loss(*tokens)
row("token_policy_loss", loss, call, source, "token-mean, the default")
row("token_approx_kl", metrics["actor/ppo_kl"], call, source)
row("token_clip_fraction", metrics["actor/pg_clipfrac"], call, source)
row("token_policy_loss", policy_loss(*tokens, "seq-mean-token-mean")[0], call, source, "seq-mean-token-mean")
row("token_policy_loss", policy_loss(*tokens, "seq-mean-token-sum")[0], call, source, "seq-mean-token-sum")
far = [torch.tensor([[getattr(given, name)]]) for name in ("far_old", "far_logp", "far_adv")]
row("token_policy_loss_far", policy_loss(*far, torch.ones(1, 1))[0], call, source, "clip_ratio_c=3, the default")
critic = [tensor(name) for name in ("tok_new_values", "tok_returns", "tok_values")]
value_loss = core_algos.compute_value_loss(*critic, mask.float(), given.tok_clip_range_vf)[0]
row("token_value_loss_clipped", value_loss, "compute_value_loss", source)
k3 = core_algos.kl_penalty(tensor("tok_old"), tensor("tok_ref"), "low_var_kl")
row("token_k3", k3[mask], "kl_penalty", source, "low_var_kl")
far = core_algos.kl_penalty(torch.tensor([given.k3_logp]), torch.tensor([given.k3_ref]), "low_var_kl")
row("token_k3_far", far.mean(), "kl_penalty", source, "low_var_kl")

call = "compute_grpo_outcome_advantage"
groups = tensor("group_rewards").flatten()[:, None]
advantages, _ = core_algos.compute_grpo_outcome_advantage(groups, torch.ones(12, 1), np.repeat(np.arange(3), 4))
row(
    "group_advantages",
    advantages.reshape(3, 4),
    call,
    source,
    note="It adds 1e-6 to the deviation, hence the tolerance.",
    tolerance=1e-5,
)
lone = torch.tensor([[given.lone_reward]])
advantages, _ = core_algos.compute_grpo_outcome_advantage(lone, torch.ones(1, 1), np.zeros(1, int))
row("group_of_one", advantages.mean(), call, source, note="It adds 1e-6 to the deviation, hence the tolerance.", tolerance=1e-5)
