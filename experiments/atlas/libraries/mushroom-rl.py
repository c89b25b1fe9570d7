# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0"]
#
# [tool.atlas]
# libraries = ["mushroom-rl"]
# bare = ["mushroom-rl==1.10.2"]
# why = "The package asks for much that is not needed here; compute_gae is built from its installed file."
# ///
"""`compute_gae`, on one environment after the other, with a critic that returns the observation."""

import numpy as np
from sheet import function, given, installed, row

compute_gae = function(installed("mushroom_rl", "utils", "value_functions.py"), "compute_gae", {"np": np})


def advantages(n):
    values, terminated, truncated = (np.array(getattr(given, name)[n]) for name in ("values", "terminated", "truncated"))
    last = (terminated + truncated) > 0
    following = np.where(last, given.final_values[n], np.append(values[1:], given.last_values[n]))
    rollout = values, following, np.array(given.rewards[n]), terminated > 0, last
    return compute_gae(lambda states: states, *rollout, given.gamma, given.gae_lambda)[1]


row("gae", np.array([advantages(n) for n in range(2)]), "compute_gae", "mushroom_rl/utils/value_functions.py")
