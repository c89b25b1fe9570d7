# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0"]
#
# [tool.atlas]
# libraries = ["ms-swift"]
# bare = ["ms-swift==4.6.0"]
# why = "The package asks for much that is not needed here; its functions are built from their installed files, with stand-ins for self."
# ///
"""`compute_advantages`, and `DPOTrainer.dpo_loss`."""

from types import SimpleNamespace
from typing import Optional

import torch
from sheet import function, given, installed, row

names = {"torch": torch, "F": torch.nn.functional, "Optional": Optional, "Tuple": tuple, "Dict": dict, "List": list}


def tensor(name):
    return torch.tensor(getattr(given, name))


compute = function(installed("swift", "rl_core", "advantage.py"), "compute_advantages", names)
source, rewards = "swift/rl_core/advantage.py", tensor("group_rewards")


def advantages(**settings):
    return compute(rewards.reshape(-1, 1), torch.ones(1), 4, **settings)[0].reshape(3, 4)


note, near = "It adds 1e-4 to the deviation, hence the tolerance.", 1e-3
row("group_advantages", advantages(), "compute_advantages", source, "scale_rewards='group', the default", note, near)
row(
    "group_advantages_batch", advantages(scale_rewards="batch"), "compute_advantages", source, "scale_rewards='batch'", note, near
)
row("group_advantages_centred", advantages(scale_rewards="none"), "compute_advantages", source, "scale_rewards='none'")
row(
    "rloo_advantages", advantages(advantage_estimator="rloo", scale_rewards="none"), "compute_advantages", source,
    "advantage_estimator='rloo', scale_rewards='none'",
)  # fmt: skip

dpo_loss = function(installed("swift", "rlhf_trainers", "dpo_trainer.py"), "dpo_loss", names)
pairs = [tensor(name) for name in ("chosen", "rejected", "ref_chosen", "ref_rejected")]


def dpo(loss_type="sigmoid", label_smoothing=0.0):
    self = SimpleNamespace(
        accelerator=SimpleNamespace(device="cpu"), reference_free=False, f_divergence_type="reverse_kl", f_divergence_params=None,
        beta=given.beta, label_smoothing=label_smoothing,
    )  # fmt: skip
    return dpo_loss(self, *pairs, loss_type)[0]


source, call = "swift/rlhf_trainers/dpo_trainer.py", "DPOTrainer.dpo_loss"
row("dpo_loss", dpo(), call, source, "loss_type='sigmoid'")
row("dpo_loss_smoothed", dpo(label_smoothing=given.label_smoothing), call, source, "loss_type='sigmoid', label_smoothing=0.1")
row(
    "ipo_loss", dpo("ipo"), call, source, "loss_type='ipo', log-probabilities as given",
    "Its trainer divides them by the numbers of tokens beforehand.",
)  # fmt: skip
