# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "tensordict==0.15.3", "GitPython==3.2.1", "onnx==1.23.2", "tensorboard==2.21.0"]
#
# [tool.atlas]
# libraries = ["rsl-rl-lib"]
# bare = ["rsl-rl-lib==5.5.1"]
# ///
"""`PPO.process_env_step`, `compute_returns` and `update` run with a stand-in for `self` that holds the rollout or the minibatch."""

from types import SimpleNamespace

import torch
from rsl_rl.algorithms import PPO
from sheet import given, row


def tensor(name):
    return torch.tensor(getattr(given, name))


class Critic:
    """Returns the values of the input; the rest does nothing."""

    def __init__(self, values):
        self.values = values

    def __call__(self, *args, **kwargs):
        return self.values

    def get_hidden_state(self):
        return None

    def reset(self, *args, **kwargs):
        pass


def rollout(time_limits, normalised):
    """Rewards and advantages, (N, T)."""
    rewards, dones, values = [], [], []
    critic = Critic(tensor("last_values")[:, None])
    self = SimpleNamespace(rnd=None, gamma=given.gamma, lam=given.gae_lambda, device="cpu", actor=critic, critic=critic)
    self.normalize_advantage_per_mini_batch = not normalised

    def add(transition):
        rewards.append(transition.rewards[:, None])
        dones.append(transition.dones[:, None])
        values.append(transition.values)

    self.storage = SimpleNamespace(add_transition=add)
    for t in range(8):
        truncated = tensor("truncated")[:, t] * time_limits
        self.transition = SimpleNamespace(values=tensor("values")[:, t, None], clear=lambda: None)
        ended = (tensor("terminated")[:, t] | truncated).bool()
        PPO.process_env_step(self, None, tensor("rewards")[:, t], ended, {"time_outs": truncated})
    self.storage = SimpleNamespace(
        num_transitions_per_env=8, values=torch.stack(values), dones=torch.stack(dones), rewards=torch.stack(rewards),
        returns=torch.zeros(8, 2, 1),
    )  # fmt: skip
    PPO.compute_returns(self, None)
    return self.storage.rewards[..., 0].T, self.storage.advantages[..., 0].T


source = "rsl_rl/algorithms/ppo.py"
rewards, advantages = rollout(time_limits=1, normalised=False)
row("stored_reward", rewards[0, 5], "PPO.process_env_step", source, "time_outs given")
row("gae", advantages, "PPO.process_env_step, PPO.compute_returns", source, "time_outs given")
row("normalised_rollout", rollout(time_limits=0, normalised=True)[1], "PPO.compute_returns", source, "the default")


class Actor(Critic):
    output_distribution_params, is_recurrent = (), False

    def get_output_log_prob(self, actions):
        return tensor("logp") + 0 * self.values

    @property
    def output_entropy(self):
        return tensor("entropy")

    def parameters(self):
        return [self.values]

    def update_normalization(self, obs):
        pass


class Judge(Actor):
    def __call__(self, *args, **kwargs):
        return tensor("new_values")[:, None] + 0 * self.values


def update(clipped, normalised=False):
    weight = torch.nn.Parameter(torch.zeros(()))
    batch = SimpleNamespace(
        observations=SimpleNamespace(batch_size=[6]), masks=None, hidden_states=(None, None), actions=None,
        old_actions_log_prob=tensor("old_logp")[:, None], advantages=tensor("adv")[:, None], returns=tensor("returns")[:, None],
        values=tensor("old_values")[:, None],
    )  # fmt: skip
    storage = SimpleNamespace(
        mini_batch_generator=lambda *counts: [batch], clear=lambda: None, observations=SimpleNamespace(flatten=lambda *axes: None)
    )
    self = SimpleNamespace(
        rnd=None, symmetry=None, storage=storage, num_mini_batches=1, num_learning_epochs=1, device="cpu", use_mixed_precision=False,
        normalize_advantage_per_mini_batch=normalised, actor=Actor(weight), critic=Judge(weight), desired_kl=None, schedule="fixed",
        clip_param=given.clip_range, use_clipped_value_loss=clipped, value_loss_coef=given.vf_coef, entropy_coef=given.ent_coef,
        optimizer=torch.optim.SGD([weight], 0.1), is_multi_gpu=False, max_grad_norm=1.0,
    )  # fmt: skip
    return PPO.update(self)


plain = update(clipped=False)
row("policy_loss", plain["surrogate"], "PPO.update", source)
row("value_loss", plain["value"], "PPO.update", source, "use_clipped_value_loss=False")
row("value_loss_clipped", update(clipped=True)["value"], "PPO.update", source, "use_clipped_value_loss=True, the default")
row(
    "policy_loss_normalised", update(clipped=False, normalised=True)["surrogate"], "PPO.update", source,
    "normalize_advantage_per_mini_batch=True",
)  # fmt: skip
