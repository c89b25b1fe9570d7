# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0"]
#
# [tool.atlas]
# libraries = ["cleanrl"]
# bare = ["cleanrl==1.2.0"]
# why = "Each algorithm is one script; statements of its loop are run as they stand there. The last release is of 2023."
# ///
"""The statements of `ppo_continuous_action.py` and `sac_continuous_action.py` that make advantages, losses and targets."""

import math
from types import SimpleNamespace

import numpy as np
import torch
from sheet import given, installed, row, statements
from torch.nn import functional

PPO, SAC = "ppo_continuous_action.py", "sac_continuous_action.py"


def tensor(name):
    return torch.tensor(getattr(given, name))


def run(file, beginnings, **names):
    """Run the first statement that begins so, for each beginning."""
    names |= {"torch": torch, "np": np, "F": functional}
    for beginning in beginnings:
        found = []

        def first(text, beginning=beginning, found=found):
            found.extend([text] * (text.startswith(beginning) and not found))
            return bool(found) and found[-1] is text

        statements(installed("cleanrl", file), first, names)
    return names


ended = ((tensor("terminated") + tensor("truncated")) > 0).float().T
names = run(
    PPO, ["with torch.no_grad():\n            next_value"],
    args=SimpleNamespace(num_steps=8, gamma=given.gamma, gae_lambda=given.gae_lambda, gae=True), rewards=tensor("rewards").T,
    values=tensor("values").T, dones=torch.cat([torch.zeros(1, 2), ended[:-1]]), next_done=ended[-1], next_obs=None, device="cpu",
    agent=SimpleNamespace(get_value=lambda obs: tensor("last_values")),
)  # fmt: skip
row("gae", names["advantages"].T, "the loop that bootstraps", f"cleanrl/{PPO}", "one flag for both kinds of end")


def update(**settings):
    args = SimpleNamespace(clip_coef=given.clip_range, **settings)
    beginnings = [
        "logratio = ",
        "ratio = ",
        "with torch.no_grad():\n                    # calculate approx_kl",
        "mb_advantages = b_adv",
    ]
    beginnings += [
        "if args.norm_adv",
        "pg_loss1 = ",
        "pg_loss2 = ",
        "pg_loss = ",
        "newvalue = newvalue.view",
        "if args.clip_vloss",
    ]
    return run(
        PPO, beginnings, args=args, newlogprob=tensor("logp"), b_logprobs=tensor("old_logp"), mb_inds=np.arange(6), clipfracs=[],
        b_advantages=tensor("adv"), newvalue=tensor("new_values"), b_values=tensor("old_values"), b_returns=tensor("returns"),
    )  # fmt: skip


source, call = f"cleanrl/{PPO}", "the loop over minibatches"
default, plain = update(norm_adv=True, clip_vloss=True), update(norm_adv=False, clip_vloss=False)
row("policy_loss", plain["pg_loss"], call, source, "norm_adv=False")
row("approx_kl", plain["approx_kl"], call, source)
row("clip_fraction", plain["clipfracs"][0], call, source)
row("policy_loss_normalised", default["pg_loss"], call, source, "norm_adv=True, the default")
row("value_loss", plain["v_loss"], call, source, "clip_vloss=False")
row("value_loss_clipped", default["v_loss"], call, source, "clip_vloss=True, the default")

column = {name: tensor(name)[:, None] for name in ("q1", "q2", "next_logp", "sac_rewards")}
data = SimpleNamespace(
    observations=None,
    actions=None,
    next_observations=None,
    rewards=column["sac_rewards"],
    dones=tensor("sac_terminated")[:, None],
)
networks = {
    "actor": SimpleNamespace(get_action=lambda obs: (None, column["next_logp"], None)), "alpha": given.alpha,
    "log_alpha": torch.tensor([math.log(given.alpha)]), "target_entropy": given.target_entropy,
    "args": SimpleNamespace(gamma=given.gamma, batch_size=4), "data": data,
} | {name: lambda *seen, q=name[2]: column[f"q{q}"] for name in ("qf1", "qf2", "qf1_target", "qf2_target")}  # fmt: skip
critics = [
    "with torch.no_grad():\n                next_state_actions",
    "qf1_a_values",
    "qf2_a_values",
    "qf1_loss",
    "qf2_loss",
    "qf_loss",
]
source, call = f"cleanrl/{SAC}", "the training loop"
names = run(SAC, critics, **networks)
row("soft_q_target", names["next_q_value"], call, source)
row("sac_critic_loss", names["qf_loss"], call, source)
names = run(SAC, ["alpha_loss = "], **networks, log_pi=column["next_logp"])
row("temperature_loss", names["alpha_loss"], call, source, "autotune=True, the default")
