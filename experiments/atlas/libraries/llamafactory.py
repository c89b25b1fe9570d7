# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0"]
#
# [tool.atlas]
# libraries = ["llamafactory"]
# bare = ["llamafactory==0.9.5"]
# why = "The package asks for much that is not needed here; its methods are built from their installed files, with stand-ins for self."
# ///
"""`PairwiseTrainer.compute_loss` on scores at every token, with padding on either side, and `CustomDPOTrainer.simpo_loss`."""

from types import SimpleNamespace
from typing import Optional, Union

import torch
from sheet import function, given, installed, row

names = {"torch": torch, "F": torch.nn.functional, "Optional": Optional, "Union": Union, "override": lambda method: method}
compute_loss = function(installed("llamafactory", "train", "rm", "trainer.py"), "compute_loss", names)
sides = ("chosen", "rejected")


def loss(left):
    def padded(tokens, mask):
        return [row[sum(m) :] + row[: sum(m)] if left else row for row, m in zip(tokens, mask, strict=True)]

    masks = {side: getattr(given, f"rm_{side}_mask") for side in sides}
    values = torch.tensor([row for side in sides for row in padded(getattr(given, f"rm_{side}_tokens"), masks[side])])
    mask = torch.tensor([row for side in sides for row in padded(masks[side], masks[side])])
    inputs = {"input_ids": torch.zeros_like(mask), "attention_mask": mask}
    return compute_loss(None, lambda **inputs: (None, None, values), inputs)


source, call = "llamafactory/train/rm/trainer.py", "PairwiseTrainer.compute_loss"
row("reward_model_loss_padded", loss(left=False), call, source, "padding on the right")
row("reward_model_loss_left", loss(left=True), call, source, "padding on the left")
simpo_loss = function(installed("llamafactory", "train", "dpo", "trainer.py"), "simpo_loss", names)
self = SimpleNamespace(simpo_gamma=given.simpo_gamma, beta=given.beta)
losses = simpo_loss(self, torch.tensor(given.chosen), torch.tensor(given.rejected))
row("simpo_loss", losses, "CustomDPOTrainer.simpo_loss", "llamafactory/train/dpo/trainer.py")
