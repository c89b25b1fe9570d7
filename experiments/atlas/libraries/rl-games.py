# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "rl-games==1.6.5"]
#
# [tool.atlas]
# libraries = ["rl-games"]
# seconds = 300
# why = "The line that adds the bootstrap stands in the middle of play_steps, and is run as it stands in the installed file."
# ///
"""`A2CBase.discount_values` with a stand-in for `self`, on rewards that the statement of `play_steps` has made; and the losses."""

from types import SimpleNamespace

import torch
from rl_games.common import common_losses
from rl_games.common.a2c_common import A2CBase
from sheet import given, installed, row, statements


def tensor(name):
    return torch.tensor(getattr(given, name))


def advantages(infos):
    rewards = []
    self = SimpleNamespace(
        gamma=given.gamma, tau=given.gae_lambda, horizon_length=8, value_bootstrap=True, cast_obs=lambda obs: obs
    )
    for t in range(8):
        names = {"self": self, "shaped_rewards": tensor("rewards")[:, t, None].clone(), "infos": infos(t)}
        names["res_dict"] = {"values": tensor("values")[:, t, None]}
        names["torch"], found = torch, []  # there are two such statements, for policies with and without a memory

        def first(text, found=found):
            if text.startswith("if self.value_bootstrap and 'time_outs' in infos") and not found:
                found.append(text)
                return True
            return False

        statements(installed("rl_games", "common", "a2c_common.py"), first, names)
        rewards.append(names["shaped_rewards"])
    rewards = torch.stack(rewards)
    ended = (tensor("terminated") | tensor("truncated")).T.float()
    before = torch.cat([torch.zeros(1, 2), ended[:-1]])
    values = tensor("values").T[..., None]
    return A2CBase.discount_values(self, ended[-1], tensor("last_values")[:, None], before, values, rewards)[..., 0].T


source, call = "rl_games/common/a2c_common.py", "A2CBase.play_steps, A2CBase.discount_values"
row("gae", advantages(lambda t: {}), call, source, "no time_outs in infos")
row(
    "gae", advantages(lambda t: {"time_outs": tensor("truncated")[:, t]}), call, source,
    "value_bootstrap=True, the default, and time_outs in infos",
)  # fmt: skip

source = "rl_games/common/common_losses.py"
losses = common_losses.actor_loss(-tensor("old_logp"), -tensor("logp"), tensor("adv"), True, given.clip_range)
row("policy_loss", losses.mean(), "common_losses.actor_loss", source, note="It takes negative log-probabilities.")
critic = tensor("old_values"), tensor("new_values"), given.clip_range, tensor("returns")
row(
    "value_loss",
    common_losses.default_critic_loss(*critic, False).mean(),
    "common_losses.default_critic_loss",
    source,
    "clip_value=False",
)
row(
    "value_loss_clipped",
    common_losses.default_critic_loss(*critic, True).mean(),
    "common_losses.default_critic_loss",
    source,
    "clip_value=True",
)
row("normalised", common_losses.normalize_advantage(tensor("adv")), "common_losses.normalize_advantage", source)
