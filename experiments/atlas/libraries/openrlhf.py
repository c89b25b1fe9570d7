# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0"]
#
# [tool.atlas]
# libraries = ["openrlhf"]
# bare = ["openrlhf==0.11.2"]
# why = "The package asks for libraries that need a GPU; its losses are built from their installed files."
# ///
"""The losses, and methods of `RemoteExperienceMaker` with a stand-in for `self`."""

import itertools
from types import SimpleNamespace
from typing import Any, Optional, Union

import torch
from sheet import function, given, installed, row
from torch import nn

losses, utils = installed("openrlhf", "models", "loss.py"), installed("openrlhf", "models", "utils.py")
maker = installed("openrlhf", "trainer", "ppo_utils", "experience_maker.py")
names = {
    "torch": torch,
    "nn": nn,
    "F": nn.functional,
    "Optional": Optional,
    "Tuple": tuple,
    "Union": Union,
    "List": list,
    "Any": Any,
}
for name in ("masked_mean", "compute_approx_kl", "compute_reward", "masked_normalize"):
    function(utils, name, names)
for name in ("aggregate_loss", "PolicyLoss", "ValueLoss", "DPOLoss", "PairWiseLoss"):
    function(losses, name, names)


def tensor(name):
    return torch.tensor(getattr(given, name))


def kept(x):
    return torch.where(mask, x, 0)


mask = tensor("mask").bool()
source = "openrlhf/models/loss.py"
tokens = [tensor(name) for name in ("tok_logp", "tok_old", "tok_adv")]
loss, clipped, kl, *_ = names["PolicyLoss"](given.clip_range, given.clip_range)(*tokens, action_mask=mask)
row("token_policy_loss", loss, "PolicyLoss", source, "token_level_loss=True, the default")
row("token_clip_fraction", clipped, "PolicyLoss, second result", source)
row("token_approx_kl", kl, "PolicyLoss, third result", source)
by_row = names["PolicyLoss"](given.clip_range, given.clip_range, token_level_loss=False)(*tokens, action_mask=mask)[0]
row("token_policy_loss", by_row, "PolicyLoss", source, "token_level_loss=False")
far = [torch.tensor([[getattr(given, name)]]) for name in ("far_logp", "far_old", "far_adv")]
row(
    "token_policy_loss_far",
    names["PolicyLoss"](given.clip_range, given.clip_range)(*far, torch.ones(1, 1))[0],
    "PolicyLoss",
    source,
)
critic = [tensor(name) for name in ("tok_new_values", "tok_values", "tok_returns")]
row("token_value_loss", names["ValueLoss"]()(*critic, action_mask=mask), "ValueLoss", source, "clip_eps=None, the default")
row(
    "token_value_loss_clipped",
    names["ValueLoss"](given.tok_clip_range_vf)(*critic, action_mask=mask),
    "ValueLoss",
    source,
    "clip_eps=0.2",
)
pairs = [tensor(name) for name in ("chosen", "rejected", "ref_chosen", "ref_rejected")]
row("dpo_loss_mean", names["DPOLoss"](given.beta)(*pairs)[0], "DPOLoss", source)
smoothed = names["DPOLoss"](given.beta, label_smoothing=given.label_smoothing)(*pairs)[0]
row("dpo_loss_smoothed_mean", smoothed, "DPOLoss", source, "label_smoothing=0.1")
row("ipo_loss_mean", names["DPOLoss"](given.beta, ipo=True)(*pairs)[0], "DPOLoss", source, "ipo=True, log-probabilities as given")
scores = tensor("rm_chosen"), tensor("rm_rejected")
row("reward_model_loss", names["PairWiseLoss"]()(*scores), "PairWiseLoss", source)
row("reward_model_loss_margin", names["PairWiseLoss"]()(*scores, tensor("margin")), "PairWiseLoss", source)

source = "openrlhf/models/utils.py"
kl = names["compute_approx_kl"](tensor("tok_old"), tensor("tok_ref"), kl_estimator="k1")
rewards = names["compute_reward"](tensor("score"), given.kl_coef, kl, action_mask=mask)
row("kl_penalised_rewards", kept(rewards), "compute_approx_kl, compute_reward", source)
row(
    "token_k3",
    names["compute_approx_kl"](tensor("tok_old"), tensor("tok_ref"), kl_estimator="k3")[mask],
    "compute_approx_kl",
    source,
    "k3",
)
k3_far = names["compute_approx_kl"](torch.tensor([given.k3_logp]), torch.tensor([given.k3_ref]), kl_estimator="k3")
row("token_k3_far", k3_far.mean(), "compute_approx_kl", source, "k3")
row("whitened", kept(names["masked_normalize"](tensor("tok_adv"), mask)), "masked_normalize", source, "dim=1, the default")

source = "openrlhf/trainer/ppo_utils/experience_maker.py"
advantages_of = function(maker, "get_advantages_and_returns", names)
advantages, _ = advantages_of(None, tensor("tok_values"), rewards, mask, given.tok_gamma, given.gae_lambda)
row("token_gae", kept(advantages), "RemoteExperienceMaker.get_advantages_and_returns", source)

names |= {"itertools": itertools, "apply_length_penalties": lambda experiences, args: None}
compute = function(maker, "compute_advantages_and_returns", names)


def experiences(estimator, samples, rewards, kl_coef, **columns):
    """What compute_advantages_and_returns makes of one batch."""
    advantage = SimpleNamespace(estimator=estimator, gamma=given.tok_gamma, lambd=given.gae_lambda, no_std_norm=False)
    args = SimpleNamespace(
        rollout=SimpleNamespace(n_samples_per_prompt=samples), algo=SimpleNamespace(advantage=advantage),
        reward=SimpleNamespace(clip_range=None),
    )  # fmt: skip
    self = SimpleNamespace(
        strategy=SimpleNamespace(args=args), kl_ctl=SimpleNamespace(value=kl_coef), advantage_estimator=estimator
    )
    self.get_advantages_and_returns = lambda *arguments: advantages_of(self, *arguments)
    self.get_cumulative_returns = lambda rewards, mask, gamma: function(maker, "get_cumulative_returns", names)(
        self, rewards, mask, gamma
    )
    batch = SimpleNamespace(index=list(range(len(rewards))), rewards=rewards, info={}, **columns)
    return compute(self, [batch])[0].advantages


call = "RemoteExperienceMaker.compute_advantages_and_returns"
whitened = experiences("gae", 1, tensor("score"), given.kl_coef, kl=kl, values=tensor("tok_values"), action_mask=mask)
row("whitened_token_gae", kept(whitened), call, source, "estimator='gae'")
one = torch.ones(12, 1)
note = "It adds 1e-9 to the deviation."
groups = experiences("group_norm", 4, tensor("group_rewards").flatten(), 0.0, kl=torch.zeros(12, 1), values=None, action_mask=one)
row("group_advantages", groups.reshape(3, 4), call, source, "estimator='group_norm'", note)
groups = experiences("rloo", 4, tensor("group_rewards").flatten(), 0.0, kl=torch.zeros(12, 1), values=None, action_mask=one)
row("rloo_advantages", groups.reshape(3, 4), call, source, "estimator='rloo'")
