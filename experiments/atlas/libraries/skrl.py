# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "skrl==2.1.1"]
#
# [tool.atlas]
# libraries = ["skrl"]
# why = "The losses are statements in the middle of PPO.update, which are run as they stand in the installed file."
# ///
"""`compute_gae`, and the statements of `PPO.update` that make its losses."""

from types import SimpleNamespace

import torch
from sheet import given, installed, row, statements
from skrl.agents.torch.ppo.ppo import compute_gae
from torch.nn import functional


def steps(name):
    """(T, N, 1)."""
    return torch.tensor(getattr(given, name)).T[..., None]


def tensor(name):
    return torch.tensor(getattr(given, name))


rollout = {
    "values": steps("values"), "last_values": tensor("last_values")[:, None], "terminated": steps("terminated").bool(),
    "discount_factor": given.gamma, "lambda_coefficient": given.gae_lambda,
}  # fmt: skip
source = "skrl/agents/torch/ppo/ppo.py"
truncated = steps("truncated").bool()
returns, _ = compute_gae(rewards=steps("rewards"), truncated=truncated, **rollout)
row("gae", (returns - rollout["values"])[..., 0].T, "compute_gae", source, "time_limit_bootstrap=False, the default")
rewards = steps("rewards") + given.gamma * steps("final_values") * truncated
returns, _ = compute_gae(rewards=rewards, truncated=truncated, time_limit_bootstrap=True, **rollout)
row(
    "gae", (returns - rollout["values"])[..., 0].T, "compute_gae", source, "time_limit_bootstrap=True",
    note="With rewards as its record_transition makes them.",
)  # fmt: skip
_, advantages = compute_gae(rewards=steps("rewards"), truncated=torch.zeros_like(truncated), **rollout)
row("normalised_rollout", advantages[..., 0].T, "compute_gae, second result", source)

file = installed("skrl", "agents", "torch", "ppo", "ppo.py")


def update(start, result, **settings):
    """What a statement of PPO.update that begins so binds."""
    cfg = {"ratio_clip": given.clip_range, "value_clip": 0, "value_loss_scale": 1.0} | settings
    names = {
        "self": SimpleNamespace(cfg=SimpleNamespace(**cfg)),
        "torch": torch, "F": functional, "next_log_prob": tensor("logp"), "sampled_log_prob": tensor("old_logp"), "kl_divergences": [],
        "sampled_advantages": tensor("adv"), "sampled_returns": tensor("returns"), "sampled_values": tensor("old_values"),
        "predicted_values": tensor("new_values"),
    }  # fmt: skip
    for part in start:
        statements(file, lambda text, part=part: text.startswith(part), names)
    return names[result]


row("approx_kl", update(["with torch.no_grad():\n                        ratio"], "kl_divergence"), "PPO.update", source)
surrogate = ["ratio = torch.exp(next", "surrogate = ", "surrogate_clipped = ", "policy_loss = -torch.min"]
row(
    "policy_loss",
    update(surrogate, "policy_loss"),
    "PPO.update",
    source,
    note="Its advantages are normalised over the rollout beforehand.",
)
value_loss = ["if self.cfg.value_clip > 0", "value_loss = self.cfg"]
row(
    "value_loss",
    update(value_loss, "value_loss"),
    "PPO.update",
    source,
    "value_clip=0, value_loss_scale=1",
    "The scale is 2.5 by default.",
)
row(
    "value_loss_clipped", update(value_loss, "value_loss", value_clip=given.clip_range), "PPO.update", source,
    "value_clip=0.2, the default, value_loss_scale=1", "The scale is 2.5 by default.",
)  # fmt: skip
