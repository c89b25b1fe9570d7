# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0"]
#
# [tool.atlas]
# libraries = ["trl"]
# bare = ["trl==0.24.0"]
# why = "An old version, as later ones have no PPO in the main package; its functions are built from their installed file."
# ///
"""The whitening of TRL's PPO."""

from typing import Optional

import torch
from sheet import function, given, installed, row

file, names = installed("trl", "core.py"), {"torch": torch, "Optional": Optional}
for name in ("masked_mean", "masked_var", "masked_whiten"):
    function(file, name, names)
mask = torch.tensor(given.mask).bool()
whitened = names["masked_whiten"](torch.tensor(given.tok_adv), mask)
row("whitened", torch.where(mask, whitened, 0), "core.masked_whiten", "trl/core.py")
