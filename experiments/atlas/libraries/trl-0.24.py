# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0"]
#
# [tool.atlas]
# libraries = ["trl"]
# bare = ["trl==0.24.0"]
# why = "An old version, as later ones have no PPO in the main package; its functions are built from their installed file."
# ///
"""The whitening of the PPO that was, and `DPOTrainer.dpo_loss` with a stand-in for `self`."""

from enum import Enum
from types import SimpleNamespace
from typing import Optional

import torch
from sheet import function, given, installed, row

file, names = installed("trl", "core.py"), {"torch": torch, "Optional": Optional}
for name in ("masked_mean", "masked_var", "masked_whiten"):
    function(file, name, names)
mask = torch.tensor(given.mask).bool()
whitened = names["masked_whiten"](torch.tensor(given.tok_adv), mask)
row("whitened", torch.where(mask, whitened, 0), "core.masked_whiten", "trl/core.py")

names |= {"F": torch.nn.functional, "Enum": Enum}
for name in ("FDivergenceType", "FDivergenceConstants"):
    function(installed("trl", "trainer", "dpo_config.py"), name, names)
dpo_loss = function(installed("trl", "trainer", "dpo_trainer.py"), "dpo_loss", names)
pairs = [torch.tensor(getattr(given, name)) for name in ("chosen", "rejected", "ref_chosen", "ref_rejected")]


def dpo(loss_type="sigmoid", label_smoothing=0.0):
    self = SimpleNamespace(
        accelerator=SimpleNamespace(device="cpu"), reference_free=False, f_divergence_params=None,
        f_divergence_type=names["FDivergenceType"].REVERSE_KL,
        beta=given.beta, label_smoothing=label_smoothing,
    )  # fmt: skip
    return dpo_loss(self, *pairs, loss_type)


source, call = "trl/trainer/dpo_trainer.py", "DPOTrainer.dpo_loss"
losses, chosen_rewards, _ = dpo()
row("dpo_loss", losses, call, source, "loss_type='sigmoid', the default")
row("implicit_rewards", chosen_rewards, call, source)
row("dpo_loss_smoothed", dpo(label_smoothing=given.label_smoothing)[0], call, source, "loss_type='sigmoid', label_smoothing=0.1")
row("ipo_loss", dpo("ipo")[0], call, source, "loss_type='ipo', log-probabilities as given")
