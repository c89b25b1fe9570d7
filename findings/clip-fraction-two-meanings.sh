#!/usr/bin/env bash
# "Clip fraction" is two numbers. On one batch, TorchRL 0.14.1 says 0.6 and torchtune 0.6.1 says 0.2 for the same ratios, advantages and clip
# range: a curve from one cannot be laid over a curve from the other.
#
# Why: the first counts ratios outside the interval, the second those alone whose gradient the clip takes away.
#
# Seen in November 2026: ratios 1.5 0.5 0.5 1 1 under advantages 1 1 1 1 1 and a clip range of 0.2. Three are outside, one of them (1.5) is
# silenced. Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
pip=("$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check)
"${pip[@]}" torch==2.13.0 numpy==2.4.6 torchao==0.10.0 torchtune==0.6.1 torchrl==0.14.1
cd "$folder"
PYTHONWARNINGS=ignore venv/bin/python - <<'PYTHON'
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torchrl.objectives import ClipPPOLoss
from torchtune.rlhf.loss import PPOLoss

ratios, advantages = torch.tensor([1.5, 0.5, 0.5, 1.0, 1.0]), torch.ones(5)
now = torch.full((5,), 0.3).log()  # of action 0, whose probability is 0.3 at each step
before = now - ratios.log()

logits = torch.tensor([0.3, 0.7]).log()
network = TensorDictModule(lambda seen: logits.expand(len(seen), 2), ["observation"], ["logits"])
choice = ProbabilisticTensorDictModule(["logits"], ["action"], distribution_class=torch.distributions.Categorical, return_log_prob=True)
critic = TensorDictModule(lambda seen: seen, ["observation"], ["state_value"])
batch = {"observation": torch.zeros(5, 1), "action": torch.zeros(5, dtype=torch.long), "action_log_prob": before}
batch |= {"advantage": advantages[:, None], "value_target": torch.zeros(5, 1)}
loss = ClipPPOLoss(ProbabilisticTensorDictSequential(network, choice), critic, clip_epsilon=0.2)
outside = loss(TensorDict(batch, [5]))["clip_fraction"].item()

nothing = torch.zeros(1, 5)
result = PPOLoss(epsilon=0.2)(before[None], now[None], advantages[None], nothing, nothing, nothing)
silenced = result[-1].item()
print(f"TorchRL {outside:.1f}, torchtune {silenced:.1f}")
assert round(outside, 6) == 0.6 and round(silenced, 6) == 0.2, "this is no longer so"
PYTHON
