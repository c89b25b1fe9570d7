# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "tianshou==2.0.1"]
#
# [tool.atlas]
# libraries = ["tianshou"]
# ///
"""`compute_episodic_return` on a real replay buffer, and `PPO._update_with_batch` with a policy, a critic and a batch that hand out the
input."""

from types import SimpleNamespace

import numpy as np
import torch
from sheet import given, row
from tianshou.algorithm import PPO
from tianshou.algorithm.algorithm_base import Algorithm
from tianshou.data import Batch, VectorReplayBuffer


def tensor(name):
    return torch.tensor(getattr(given, name))


buffer = VectorReplayBuffer(16, 2)
values, terminated, truncated = np.array(given.values), np.array(given.terminated, bool), np.array(given.truncated, bool)
following = np.concatenate([values[:, 1:], np.array(given.last_values)[:, None]], 1)
following = np.where(terminated | truncated, np.array(given.final_values), following)
for t in range(8):
    step = Batch(
        obs=values[:, t], act=np.zeros(2), rew=np.array(given.rewards)[:, t], terminated=terminated[:, t], truncated=truncated[:, t],
        obs_next=following[:, t], info=Batch(),
    )  # fmt: skip
    step.done = step.terminated | step.truncated
    buffer.add(step, buffer_ids=np.arange(2))
batch, indices = buffer.sample(0)
_, advantages = Algorithm.compute_episodic_return(
    batch, buffer, indices, batch.obs_next, batch.obs, given.gamma, given.gae_lambda
)
order = np.argsort(indices)
row("gae", advantages[order].reshape(2, 8), "Algorithm.compute_episodic_return", "tianshou/algorithm/algorithm_base.py")


class Distribution:
    def log_prob(self, actions):
        return tensor("logp")

    def entropy(self):
        return tensor("entropy")


def update(**settings):
    self = SimpleNamespace(
        policy=lambda minibatch: SimpleNamespace(dist=Distribution()), critic=lambda obs: tensor("new_values"), recompute_adv=False,
        advantage_normalization=False, eps_clip=given.clip_range, dual_clip=None, value_clip=False, vf_coef=given.vf_coef,
        ent_coef=given.ent_coef, optim=SimpleNamespace(step=lambda loss: None), _eps=1e-8,
    )  # fmt: skip
    self.__dict__.update(settings)
    columns = {"adv": "adv", "logp_old": "old_logp", "returns": "returns", "v_s": "old_values"}
    minibatch = Batch(obs=np.zeros(6), act=np.zeros(6), **{name: tensor(known) for name, known in columns.items()})
    minibatch.split = lambda size, merge_last=True: [minibatch]
    return PPO._update_with_batch(self, minibatch, None, 1)


source, call = "tianshou/algorithm/modelfree/ppo.py", "PPO._update_with_batch"
plain = update()
row("policy_loss", plain.actor_loss.mean, call, source, "advantage_normalization=False")
row("value_loss", plain.vf_loss.mean, call, source)
row("total_loss", plain.loss.mean, call, source, "advantage_normalization=False, ent_coef=0.01, the default")
row(
    "policy_loss_normalised",
    update(advantage_normalization=True).actor_loss.mean,
    call,
    source,
    "advantage_normalization=True, the default",
)
row("value_loss_clipped", update(value_clip=True).vf_loss.mean, call, source, "value_clip=True")
