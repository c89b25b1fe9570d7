# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "sbx-rl==0.28.0"]
#
# [tool.atlas]
# libraries = ["sbx-rl"]
# ///
"""`PPO._one_update` runs on train states whose functions return the input."""

import jax.numpy as jnp
import numpy as np
import optax
from flax.training.train_state import TrainState
from sbx.ppo.ppo import PPO
from sheet import given, row


def array(name):
    return np.array(getattr(given, name), np.float32)


class Distribution:
    def __init__(self, moved):
        self.moved = moved

    def log_prob(self, actions):
        return array("logp") + 0 * self.moved

    def entropy(self):
        return array("entropy") + 0 * self.moved


def update(**settings):
    state = {"params": {"w": jnp.zeros(())}, "tx": optax.sgd(0.1)}
    actor = TrainState.create(apply_fn=lambda params, obs: Distribution(params["w"]), **state)
    critic = TrainState.create(apply_fn=lambda params, obs: array("new_values")[:, None] + 0 * params["w"], **state)
    nothing = np.zeros((6, 1), np.float32)
    old = array("adv"), array("returns"), array("old_logp")
    return PPO._one_update(actor, critic, nothing, nothing, *old, given.clip_range, given.ent_coef, given.vf_coef, **settings)[1]


source, call = "sbx/ppo/ppo.py", "PPO._one_update"
_, policy_loss, entropy_loss, value_loss, ratio = update(normalize_advantage=False)
row("policy_loss", policy_loss, call, source, "normalize_advantage=False")
row("entropy_loss", entropy_loss, call, source, note="Minus the mean entropy is logged.")
row("value_loss", value_loss, call, source, "as logged, times vf_coef=0.5")
row("policy_loss_normalised", update()[1], call, source, "normalize_advantage=True, the default")
