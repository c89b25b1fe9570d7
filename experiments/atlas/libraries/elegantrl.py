# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0"]
#
# [tool.atlas]
# libraries = ["elegantrl"]
# bare = ["elegantrl==0.3.6"]
# why = "get_advantages_origin is built from its installed file, and the line that normalises is run as it stands there."
# ///
"""`AgentPPO.get_advantages_origin` with a stand-in for `self`, and the line of `update_net` that normalises."""

from types import SimpleNamespace

import torch
from sheet import function, given, installed, row, statements

file = installed("elegantrl", "agents", "AgentPPO.py")
get_advantages = function(file, "get_advantages_origin", {"torch": torch, "Tensor": torch.Tensor})


def steps(name):
    return torch.tensor(getattr(given, name)).T.float()


self = SimpleNamespace(
    gamma=given.gamma, lambda_gae_adv=given.gae_lambda, cri=lambda state: state, last_state=torch.tensor(given.last_values)
)
ended = (steps("terminated") + steps("truncated")) > 0
source = "elegantrl/agents/AgentPPO.py"
advantages = get_advantages(self, steps("rewards"), 1 - ended.float(), steps("values"))
row("gae", advantages.T, "AgentPPO.get_advantages_origin", source, "one flag for both kinds of end")
names = {"advantages": get_advantages(self, steps("rewards"), 1 - steps("terminated"), steps("values"))}
normalised = statements(file, lambda text: text.startswith("advantages = (advantages - advantages.mean())"), names)["advantages"]
row(
    "normalised_rollout", normalised.T, "AgentPPO.update_net", source, "the default", "It adds 1e-4 to the deviation, hence the tolerance.",
    tolerance=1e-3,
)  # fmt: skip
