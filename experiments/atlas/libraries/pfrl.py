# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "packaging==26.4", "pfrl==0.4.0"]
#
# [tool.atlas]
# libraries = ["pfrl"]
# why = "SAC's losses are statements in the middle of its updates, which are run as they stand in the installed file."
# ///
"""PPO's advantages, on the rollout cut into episodes, and `PPO._lossfun`; SAC's losses with stand-ins for `self`."""

import math
from types import SimpleNamespace

import torch
from pfrl.agents import PPO
from pfrl.agents.ppo import _add_advantage_and_value_target_to_episodes
from pfrl.agents.soft_actor_critic import TemperatureHolder
from sheet import given, installed, row, statements
from torch.nn import functional


def tensor(name):
    return torch.tensor(getattr(given, name))


def episodes():
    """Each ends where the rollout does, or where it is cut off, with the value of its true last observation."""
    found = [[]]
    for n in range(2):
        for t in range(8):
            end = given.terminated[n][t] or given.truncated[n][t]
            after = given.final_values[n][t] if end else (given.values[n] + given.last_values[n : n + 1])[t + 1]
            step = {"reward": given.rewards[n][t], "v_pred": given.values[n][t], "next_v_pred": after}
            found[-1].append(step | {"nonterminal": 1.0 - given.terminated[n][t]})
            if end or t == 7:
                found.append([])
    return found[:-1]


source, parts = "pfrl/agents/ppo.py", episodes()
_add_advantage_and_value_target_to_episodes(parts, given.gamma, given.gae_lambda)
advantages = torch.tensor([step["adv"] for part in parts for step in part]).reshape(2, 8)
row("gae", advantages, "ppo._add_advantage_and_value_target_to_episodes", source)


def losses(clip_eps_vf):
    self = SimpleNamespace(
        clip_eps=given.clip_range, clip_eps_vf=clip_eps_vf, value_loss_record=[], policy_loss_record=[], value_func_coef=given.vf_coef,
        entropy_coef=given.ent_coef,
    )  # fmt: skip
    columns = ("entropy", "new_values", "logp", "old_values", "old_logp", "adv", "returns")
    total = PPO._lossfun(self, *map(tensor, columns))
    return self.policy_loss_record[0], self.value_loss_record[0], total


policy_loss, value_loss, total = losses(None)
row("policy_loss", policy_loss, "PPO._lossfun", source)
row("value_loss", value_loss, "PPO._lossfun", source, "clip_eps_vf=None, the default")
row("value_loss_clipped", losses(given.clip_range)[1], "PPO._lossfun", source, "clip_eps_vf=0.2")
row("total_loss", total, "PPO._lossfun", source, "value_func_coef=0.5, entropy_coef=0.01")

source, file = "pfrl/agents/soft_actor_critic.py", installed("pfrl", "agents", "soft_actor_critic.py")
self = SimpleNamespace(entropy_target=given.target_entropy, temperature=given.alpha)
names = {"self": self, "torch": torch, "F": functional, "next_q": torch.minimum(tensor("q1"), tensor("q2"))[:, None]}
names |= {"next_log_prob": tensor("next_logp"), "batch_rewards": tensor("sac_rewards"), "batch_discount": given.gamma}
names |= {"batch_terminal": tensor("sac_terminated"), "predict_q1": tensor("q1"), "predict_q2": tensor("q2")}
for beginning in ("entropy_term = self.temperature * next", "target_q = batch_rewards", "loss1 = ", "loss2 = "):
    statements(file, lambda text, beginning=beginning: text.startswith(beginning), names)
row("soft_q_target", names["target_q"], "SoftActorCritic.update_q_func", source)
row("sac_critic_loss", names["loss1"] + names["loss2"], "SoftActorCritic.update_q_func", source)
self.temperature_holder = TemperatureHolder(initial_log_temperature=math.log(given.alpha))
names = {"self": self, "torch": torch, "log_prob": tensor("next_logp"), "q": torch.minimum(tensor("q1"), tensor("q2"))[:, None]}
for beginning in ("entropy_term = self.temperature * log_prob", "loss = torch.mean(entropy_term - q)"):
    statements(file, lambda text, beginning=beginning: text.startswith(beginning), names)
row("sac_actor_loss", names["loss"], "SoftActorCritic.update_policy_and_temperature", source)
statements(file, lambda text: text.startswith("loss = -torch.mean(self.temperature_holder()"), names)
row("temperature_loss", names["loss"], "SoftActorCritic.update_temperature", source)
