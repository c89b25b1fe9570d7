# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "rlax==0.1.9"]
#
# [tool.atlas]
# libraries = ["rlax"]
# ///
"""The functions themselves, on one environment after the other."""

import numpy as np
import rlax
from sheet import given, row


def array(name):
    return np.array(getattr(given, name), np.float32)


ended = array("terminated") + array("truncated") > 0
values = np.concatenate([array("values"), array("last_values")[:, None]], 1)


def advantages(rewards, discounts):
    parts = zip(rewards.astype(np.float32), discounts.astype(np.float32), values, strict=True)
    return np.array([rlax.truncated_generalized_advantage_estimation(r, d, given.gae_lambda, v) for r, d, v in parts])


source, call = "rlax/_src/multistep.py", "truncated_generalized_advantage_estimation"
row(
    "gae", advantages(array("rewards"), given.gamma * (1 - array("terminated"))), call, source, "discount 0 at terminations",
    "One array of values has no place for that of a last observation.",
)  # fmt: skip
bootstrap = given.gamma * array("final_values") * array("truncated") * (1 - array("terminated"))
row(
    "gae",
    advantages(array("rewards") + bootstrap, given.gamma * ~ended),
    call,
    source,
    "γ V added to rewards, discount 0 at every end",
)

source = "rlax/_src/policy_gradients.py"
ratios = np.exp(array("logp") - array("old_logp"))
row("policy_loss", rlax.clipped_surrogate_pg_loss(ratios, array("adv"), given.clip_range), "clipped_surrogate_pg_loss", source)
taken = array("logp")
logits = np.stack([np.log1p(-np.exp(taken)), taken], -1)
row("entropy_of_two_actions", rlax.entropy_loss(logits, np.ones(6, np.float32)), "entropy_loss", source)
