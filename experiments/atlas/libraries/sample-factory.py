# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0"]
#
# [tool.atlas]
# libraries = ["sample-factory"]
# bare = ["sample-factory==2.1.1"]
# why = "The package asks for much that is not needed here; its functions are built from their installed file."
# ///
"""`gae_advantages`, with the flag that `make_dones` makes of both."""

from collections.abc import Sequence
from typing import Union

import numpy as np
import torch
from sheet import function, given, installed, row
from torch import Tensor

file = installed("sample_factory", "algo", "utils", "rl_utils.py")
names = {"torch": torch, "Tensor": Tensor, "np": np, "Union": Union, "Sequence": Sequence}
function(file, "calculate_discounted_sum_torch", names)
make_dones = function(file, "make_dones", names)
gae_advantages = function(file, "gae_advantages", names)


def tensor(name):
    return torch.tensor(getattr(given, name))


dones = make_dones(tensor("terminated").bool(), tensor("truncated").bool())
values = torch.cat([tensor("values"), tensor("last_values")[:, None]], 1)
advantages = gae_advantages(tensor("rewards"), dones, values, torch.ones(2, 9), given.gamma, given.gae_lambda)
row("gae", advantages, "gae_advantages", "sample_factory/algo/utils/rl_utils.py", "value_bootstrap=False, the default")
