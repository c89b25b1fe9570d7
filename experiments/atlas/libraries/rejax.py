# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "jax==0.10.2", "flax==0.12.8"]
#
# [tool.atlas]
# libraries = ["rejax"]
# bare = ["rejax==0.1.3"]
# why = "The package asks for environments that are not needed here; calculate_gae is built from its installed file."
# ///
"""`PPO.calculate_gae` with a stand-in for `self`."""

from types import SimpleNamespace

import jax
import numpy as np
from flax import struct
from jax import numpy as jnp
from sheet import function, given, installed, row

calculate_gae = function(installed("rejax", "algos", "ppo.py"), "calculate_gae", {"jax": jax, "jnp": jnp})


class Trajectory(struct.PyTreeNode):
    reward: jax.Array
    value: jax.Array
    done: jax.Array


def array(name):
    return np.array(getattr(given, name), np.float32)


def advantages(n):
    done = np.maximum(array("terminated"), array("truncated"))[n]
    steps = Trajectory(jnp.array(array("rewards")[n]), jnp.array(array("values")[n]), jnp.array(done))
    self = SimpleNamespace(gamma=given.gamma, gae_lambda=given.gae_lambda)
    return calculate_gae(self, steps, jnp.array(array("last_values")[n]))[0]


row(
    "gae",
    np.array([advantages(n) for n in range(2)]),
    "PPO.calculate_gae",
    "rejax/algos/ppo.py",
    "one flag for both kinds of end",
)
