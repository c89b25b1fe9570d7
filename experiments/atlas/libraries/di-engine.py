# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0"]
#
# [tool.atlas]
# libraries = ["di-engine"]
# bare = ["di-engine==0.5.3"]
# why = "The package asks for much that is not needed here; its functions are built from their installed files."
# ///
"""`gae`, with one flag and with two, and `ppo_error` on two actions, of which the one that was taken has the log-probability of the
input."""

from collections import namedtuple
from typing import Optional

import torch
from sheet import function, given, installed, row, statements

names = {"torch": torch, "namedtuple": namedtuple, "Optional": Optional, "Tuple": tuple}
gae = function(installed("ding", "rl_utils", "gae.py"), "gae", names)
losses = installed("ding", "rl_utils", "ppo.py")
statements(losses, lambda text: "= namedtuple(" in text.partition("\n")[0], names)
for name in ("ppo_policy_error", "ppo_value_error", "ppo_error"):
    function(losses, name, names)


def steps(name):
    return torch.tensor(getattr(given, name)).T.float()


def tensor(name):
    return torch.tensor(getattr(given, name))


values, terminated, truncated = steps("values"), steps("terminated"), steps("truncated")
ended = ((terminated + truncated) > 0).float()
following = torch.cat([values[1:], tensor("last_values")[None]])
following = torch.where(ended > 0, steps("final_values"), following)
Rollout = namedtuple("Rollout", ["value", "next_value", "reward", "done", "traj_flag"])
source = "ding/rl_utils/gae.py"
for flags, setting in (((terminated, ended), "done for terminations, traj_flag for ends"), ((ended, None), "done alone")):
    rollout = Rollout(values, following.clone(), steps("rewards"), *flags)
    row("gae", gae(rollout, given.gamma, given.gae_lambda).T, "gae", source, setting)


def logits(name):
    taken = tensor(name)
    return torch.stack([torch.log1p(-taken.exp()), taken], -1)


def error(clipped):
    batch = names["ppo_data"](
        logits("logp"), logits("old_logp"), torch.ones(6, dtype=torch.long), tensor("new_values"), tensor("old_values"), tensor("adv"),
        tensor("returns"), None,
    )  # fmt: skip
    return names["ppo_error"](batch, given.clip_range, clipped)


source, call = "ding/rl_utils/ppo.py", "ppo_error"
loss, info = error(clipped=True)
row("policy_loss", loss.policy_loss, call, source)
row("approx_kl", info.approx_kl, call, source)
row("clip_fraction", info.clipfrac, call, source)
row("value_loss_clipped", loss.value_loss, call, source, "use_value_clip=True, the default")
row("value_loss", error(clipped=False)[0].value_loss, call, source, "use_value_clip=False")
