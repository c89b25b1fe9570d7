# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "jax==0.10.2", "flax==0.12.8"]
#
# [tool.atlas]
# libraries = ["brax"]
# bare = ["brax==0.14.2"]
# why = "The package asks for simulators of many gigabytes; compute_gae is built from its installed file."
# ///
"""`compute_gae` of PPO's losses."""

import jax
import numpy as np
from jax import numpy as jnp
from sheet import function, given, installed, row

compute_gae = function(installed("brax", "training", "agents", "ppo", "losses.py"), "compute_gae", {"jax": jax, "jnp": jnp})


def array(name):
    return jnp.array(np.array(getattr(given, name), np.float32).T)


def advantages(truncated, terminated):
    last = jnp.array(given.last_values)
    return compute_gae(truncated, terminated, array("rewards"), array("values"), last, given.gae_lambda, given.gamma)[1].T


source, call = "brax/training/agents/ppo/losses.py", "compute_gae, second result"
none = jnp.zeros((8, 2))
row("gae", advantages(array("truncated"), array("terminated")), call, source)
row("gae_unbroken", advantages(none, none), call, source)
