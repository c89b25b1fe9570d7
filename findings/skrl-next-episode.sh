#!/usr/bin/env bash
# skrl's PPO does not cut its advantages at a time limit: with 2.1.1 and default settings, rewards of the episode that begins after the limit
# count as rewards of the one that ended there.
#
# Why: the sum is cut where an episode terminated; where one was truncated, only with `time_limit_bootstrap`, which is off by default.
#
# Seen in November 2026: four steps with rewards 1 1 100 1, a time limit after the second, discount and lambda 1, a critic that says 0
# everywhere. The first step's return is 103, though its episode paid 2.
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 skrl==2.1.1
cd "$folder"
venv/bin/python - <<'PYTHON'
import torch
from skrl.agents.torch.ppo import PPO_CFG
from skrl.agents.torch.ppo.ppo import compute_gae

rewards = torch.tensor([1.0, 1.0, 100.0, 1.0])[:, None, None]  # (steps, environments, 1)
truncated = torch.tensor([False, True, False, True])[:, None, None]
nothing = torch.zeros_like(rewards)
rollout = dict(rewards=rewards, truncated=truncated, terminated=nothing.bool(), values=nothing, last_values=nothing[0])
by_default = PPO_CFG().time_limit_bootstrap
found = {}
for bootstrap in (False, True):
    returns, _ = compute_gae(**rollout, discount_factor=1.0, lambda_coefficient=1.0, time_limit_bootstrap=bootstrap)
    found[bootstrap] = returns.flatten().tolist()
    print(f"time_limit_bootstrap={bootstrap}{' (default)' if bootstrap == by_default else ''}: returns {found[bootstrap]}")
assert by_default is False and found == {False: [103.0, 102.0, 101.0, 1.0], True: [2.0, 1.0, 101.0, 1.0]}, "this is no longer so"
PYTHON
