# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "d3rlpy==2.8.1"]
#
# [tool.atlas]
# libraries = ["d3rlpy"]
# ///
"""Methods of `SACImpl` with a stand-in for `self` whose networks give the input."""

import math
from types import SimpleNamespace

import torch
from d3rlpy.algos.qlearning.torch import sac_impl
from sheet import given, row


def tensor(name):
    return torch.tensor(getattr(given, name))


class Distribution:
    def sample_with_log_prob(self):
        return torch.zeros(4, 2), tensor("next_logp")[:, None]


sac_impl.build_squashed_gaussian_distribution = lambda action: Distribution()
least = torch.minimum(tensor("q1"), tensor("q2"))[:, None]
parameter = torch.nn.Parameter(torch.full((1, 1), math.log(given.alpha)))
temperature = SimpleNamespace(data=parameter)
sac_impl.get_parameter = lambda wrapped: parameter
idle = SimpleNamespace(zero_grad=lambda: None, step=lambda: None)
self = SimpleNamespace(
    _action_size=-given.target_entropy,
    _modules=SimpleNamespace(temp_optim=idle, log_temp=temperature, policy=lambda obs: None),
    _q_func_forwarder=SimpleNamespace(compute_expected_q=lambda obs, action, reduction: least),
    _targ_q_func_forwarder=SimpleNamespace(compute_target=lambda obs, action, reduction: least),
)
self.update_temp = lambda log_prob: sac_impl.SACImpl.update_temp(self, log_prob)
source = "d3rlpy/algos/qlearning/torch/sac_impl.py"
row(
    "temperature_loss", sac_impl.SACImpl.update_temp(self, tensor("next_logp")[:, None]), "SACImpl.update_temp", source,
    note="Its target entropy is always minus the number of action dimensions.",
)  # fmt: skip
batch = SimpleNamespace(observations=None, next_observations=None)
row("soft_value", sac_impl.SACImpl.compute_target(self, batch)[:, 0], "SACImpl.compute_target", source)
row("sac_actor_loss", sac_impl.SACImpl.compute_actor_loss(self, batch, None).actor_loss, "SACImpl.compute_actor_loss", source)
