#!/usr/bin/env bash
# torchtune's PPO whitens advantages and keeps their mean: with 0.6.1 the deviation becomes 1 and the mean stays what it was, so that a batch
# of advantages that are all positive stays one, and every token is encouraged. Other libraries' whitening subtracts it.
#
# Why: `shift_mean` of `whiten` says, when true, that the mean is added back, and it is true by default; `estimate_advantages` leaves it so.
#
# Seen in November 2026: one text of four tokens, a reward of 1 at each, a critic that says 0, discount and lambda 1. The advantages 4 3 2 1
# come out with mean 2.5 and deviation 1; with shift_mean=False `whiten` gives mean 0.
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check torch==2.13.0 numpy==2.4.6 torchao==0.10.0 torchtune==0.6.1
cd "$folder"
PYTHONWARNINGS=ignore venv/bin/python - <<'PYTHON'
import torch
from torchtune import rlhf
from torchtune.rlhf.rewards import whiten

zeros, every = torch.zeros(1, 4), torch.ones(1, 4, dtype=torch.bool)
advantages, returns = rlhf.estimate_advantages(zeros, torch.ones(1, 4), 1.0, 1.0, masks=every)
centred = whiten(returns, mask=every, shift_mean=False)
for name, found in {"before": returns, "as torchtune's PPO uses them": advantages, "whiten, shift_mean=False": centred}.items():
    print(f"{name:28s} {[round(one, 3) for one in found[0].tolist()]} mean {found.mean():.3f}, deviation {found.std():.3f}")
assert returns.tolist() == [[4.0, 3.0, 2.0, 1.0]]
assert torch.allclose(advantages.mean(), returns.mean()) and (advantages > 0).all(), "this is no longer so"
assert centred.mean().abs() < 1e-6 and torch.allclose(advantages.std(), torch.ones(()), atol=1e-4)
PYTHON
