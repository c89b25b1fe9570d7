# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "torchtune==0.6.1", "torchao==0.10.0"]
#
# [tool.atlas]
# libraries = ["torchtune"]
# ///
"""The public functions and modules of `torchtune.rlhf`."""

import torch
from sheet import given, row
from torchtune import rlhf
from torchtune.rlhf.loss import DPOLoss, PPOLoss


def tensor(name):
    return torch.tensor(getattr(given, name))


def kept(x):
    return torch.where(mask, x, 0)


mask = tensor("mask").bool()
last = mask.sum(1) - 1
source = "torchtune/rlhf/rewards.py"
rewards = rlhf.get_rewards_ppo(tensor("score"), tensor("tok_old"), tensor("tok_ref"), given.kl_coef, last)[0]
row("kl_penalised_rewards", kept(rewards), "rlhf.get_rewards_ppo", source)
rewards, values = kept(rewards), tensor("tok_values")
arguments = given.tok_gamma, given.gae_lambda
note = "Its second result less the values, as the first is whitened."
for before, setting in (
    (kept(values), "values at the padding set to 0 by the caller"),
    (values, "values at the padding as they are"),
):
    _, returns = rlhf.estimate_advantages(before, rewards, *arguments, masks=mask)
    row("token_gae", kept(returns - before), "rlhf.estimate_advantages", source, setting, note)
advantages, _ = rlhf.estimate_advantages(kept(values), rewards, *arguments, masks=mask)
row("whitened_token_gae", kept(advantages), "rlhf.estimate_advantages", source, "masks given")
row("whitened", kept(rlhf.whiten(tensor("tok_adv"), mask, shift_mean=False)), "rlhf.whiten", source, "shift_mean=False")

source, call = "torchtune/rlhf/loss/ppo.py", "PPOLoss"
columns = ("tok_old", "tok_logp", "tok_adv", "tok_values", "tok_new_values", "tok_returns")
loss = PPOLoss(epsilon=given.clip_range, value_clip_range=given.tok_clip_range_vf)
_, policy_loss, value_loss, _, clipped = loss(*map(tensor, columns), padding_masks=mask, value_padding_masks=mask)
row("token_policy_loss", policy_loss, call, source)
row("token_value_loss_clipped", value_loss, call, source)
row("token_clip_fraction", clipped, call, source)

source, call = "torchtune/rlhf/loss/dpo.py", "DPOLoss"
pairs = [tensor(name) for name in ("chosen", "rejected", "ref_chosen", "ref_rejected")]
losses, chosen_rewards, _ = DPOLoss(given.beta)(*pairs)
row("dpo_loss", losses, call, source)
row("implicit_rewards", chosen_rewards, call, source)
row("dpo_loss_smoothed", DPOLoss(given.beta, given.label_smoothing)(*pairs)[0], call, source, "label_smoothing=0.1")
