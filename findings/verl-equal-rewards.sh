#!/usr/bin/env bash
# verl's GRPO pushes a group of equal rewards: with 0.9.1 eight answers that all earned 0.9 get an advantage of -0.056 each, eight that all
# earned 1.2 (1 for the answer, 0.2 for its form) get +0.106. A group of equal rewards ought to teach nothing, and is often counted as one
# that does nothing. With rewards of 0 and 1 alone it does: sums of those are exact.
#
# Why: rewards are float32. The mean of equal ones may miss them by a unit in the last place, some 6e-8; their deviation is then as small,
# and 1e-6 is all that is added to it before dividing. Its vectorised twin (grpo_vectorized) adds in another order: for
# sixteen rewards of 0.9 the two differ in sign.
#
# Seen in November 2026: of the rewards 0.1, 0.2 ... 2.0 in groups of eight only 0.5, 1.0, 1.1, 1.5 and 2.0 give exactly 0.
# Fails (exit 1) if that is different. Installs some 1.5 GB: the package imports Ray and TensorDict, whatever part of it is used; verl
# itself is installed without what it asks for, which serves language models on a GPU.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
pip() { "$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check "$@"; }
pip numpy==2.4.6 torch==2.13.0 ray==2.60.0 tensordict==0.15.3 omegaconf==2.3.1 codetiming==1.4.0 hydra-core==1.3.8 transformers==5.24.0 \
    pandas==3.1.1 datasets==5.2.0 packaging==26.4 orjson==3.13.0
pip --no-deps verl==0.9.1
cd "$folder"
PYTHONWARNINGS=ignore venv/bin/python - <<'PYTHON'
import numpy as np
import torch
from verl.trainer.ppo.core_algos import compute_grpo_outcome_advantage as plain
from verl.trainer.ppo.core_algos import compute_grpo_vectorized_outcome_advantage as vectorised


def advantage(function, reward, answers):
    """Of `answers` texts of three tokens to one question, each rewarded alike at its last token."""
    rewards = torch.zeros(answers, 3)
    rewards[:, -1] = reward
    found, _ = function(rewards, torch.ones(answers, 3), np.array(["one question"] * answers, dtype=object))
    assert (found == found[0, 0]).all()
    return round(found[0, 0].item(), 3)


print("reward  8 answers  16 answers  16, vectorised")
for reward in (0.9, 1.0, 1.2):
    print(f"{reward:6.1f}  {advantage(plain, reward, 8):9.3f}  {advantage(plain, reward, 16):10.3f}  {advantage(vectorised, reward, 16):14.3f}")
silent = [reward for reward in range(1, 21) if advantage(plain, reward / 10, 8) == 0]
print("exactly 0 in a group of eight:", *(reward / 10 for reward in silent))
assert advantage(plain, 1.0, 8) == 0 and advantage(plain, 0.0, 8) == 0
assert advantage(plain, 0.9, 8) == -0.056 and advantage(plain, 1.2, 8) == 0.106, "this is no longer so"
assert silent == [5, 10, 11, 15, 20]
assert advantage(plain, 0.9, 16) < 0 < advantage(vectorised, 0.9, 16)
PYTHON
