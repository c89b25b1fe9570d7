# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "torchrl==0.14.1"]
#
# [tool.atlas]
# libraries = ["torchrl"]
# ///
"""The functions of `objectives.value.functional`, and `ClipPPOLoss` with an actor of two actions, of which the one that was taken has the
log-probability of the input."""

import torch
from sheet import given, row
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import generalized_advantage_estimate, vec_generalized_advantage_estimate


def tensor(name):
    return torch.tensor(getattr(given, name))


def rollout():
    values, terminated, truncated = tensor("values"), tensor("terminated").bool(), tensor("truncated").bool()
    done = terminated | truncated
    following = torch.cat([values[:, 1:], tensor("last_values")[:, None]], 1)
    following = torch.where(done, tensor("final_values"), following)
    return [x[..., None] for x in (values, following, tensor("rewards"), done, terminated)]


values, following, rewards, done, terminated = rollout()
source = "torchrl/objectives/value/functional.py"
for function in (generalized_advantage_estimate, vec_generalized_advantage_estimate):
    advantages, _ = function(given.gamma, given.gae_lambda, values, following, rewards, done, terminated)
    row("gae", advantages[..., 0], function.__name__, source, f"terminated given{', vectorised' * ('vec' in function.__name__)}")
advantages, _ = generalized_advantage_estimate(given.gamma, given.gae_lambda, values, following, rewards, done)
row("gae", advantages[..., 0], "generalized_advantage_estimate", source, "terminated left out")


class Logits(torch.nn.Module):
    """Action 1 has the log-probability of the input, action 0 the rest."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))

    def forward(self, obs):
        taken = tensor("logp")
        return torch.stack([torch.log1p(-taken.exp()), taken], -1) + 0 * self.weight


class Critic(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))

    def forward(self, obs):
        return tensor("new_values")[:, None] + 0 * self.weight


def loss(**settings):
    actor = ProbabilisticTensorDictSequential(
        TensorDictModule(Logits(), ["observation"], ["logits"]),
        ProbabilisticTensorDictModule(
            ["logits"], ["action"], distribution_class=torch.distributions.Categorical, return_log_prob=True
        ),
    )
    critic = TensorDictModule(Critic(), ["observation"], ["state_value"])
    batch = TensorDict(
        {
            "observation": torch.zeros(6, 1),
            "action": torch.ones(6, dtype=torch.long),
            "action_log_prob": tensor("old_logp"),
            "sample_log_prob": tensor("old_logp"),
            "advantage": tensor("adv")[:, None],
            "value_target": tensor("returns")[:, None],
            "state_value": tensor("old_values")[:, None],
        },
        [6],
    )
    return ClipPPOLoss(actor, critic, clip_epsilon=given.clip_range, **settings)(batch)


source, call = "torchrl/objectives/ppo.py", "ClipPPOLoss"
plain = loss()
row("policy_loss", plain["loss_objective"], call, source, "normalize_advantage=False, the default")
row("approx_kl", plain["kl_approx"], call, source)
row("clip_fraction", plain["clip_fraction"], call, source)
row("value_loss", plain["loss_critic"], call, source, "loss_critic_type='smooth_l1', the default")
row(
    "entropy_of_two_actions", loss(entropy_coeff=1.0)["loss_entropy"], call, source, "entropy_coeff=1",
    note="Its coefficient, 0.01 by default, is inside loss_entropy.",
)  # fmt: skip
row("policy_loss_normalised", loss(normalize_advantage=True)["loss_objective"], call, source, "normalize_advantage=True")
row("value_loss", loss(loss_critic_type="l2")["loss_critic"], call, source, "loss_critic_type='l2'")
row(
    "value_loss_clipped",
    loss(loss_critic_type="l2", clip_value=given.clip_range)["loss_critic"],
    call,
    source,
    "l2, clip_value=0.2",
)
