# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "imitation==1.0.1"]
#
# [tool.atlas]
# libraries = ["imitation"]
# ///
"""`PreferenceModel.probability` and `CrossEntropyRewardLoss` on segments of one step whose rewards are the scores of the input, and
`BehaviorCloningLossCalculator` with a policy that has the given logits."""

from types import SimpleNamespace

import numpy as np
import torch
from gymnasium import spaces
from imitation.algorithms.bc import BehaviorCloningLossCalculator
from imitation.algorithms.preference_comparisons import CrossEntropyRewardLoss, PreferenceModel
from imitation.rewards.reward_nets import BasicRewardNet
from sheet import given, row

box = spaces.Box(-1, 1, (1,), np.float32)
model = PreferenceModel(BasicRewardNet(box, box))
source = "imitation/algorithms/preference_comparisons.py"


def probability(chosen, rejected):
    return torch.stack([model.probability(torch.tensor([a]), torch.tensor([b])) for a, b in zip(chosen, rejected, strict=True)])


def loss(chosen, rejected):
    predicted = probability(chosen, rejected)
    return CrossEntropyRewardLoss()([None] * len(chosen), np.ones(len(chosen)), lambda pairs: (predicted, None)).loss


row("preference_probability", probability(given.rm_chosen, given.rm_rejected), "PreferenceModel.probability", source)
row("preference_loss", loss(given.rm_chosen, given.rm_rejected), "CrossEntropyRewardLoss", source)
for gap in given.far_gaps:
    row(f"preference_loss_{gap:.0f}", loss([0.0], [gap]), "PreferenceModel.probability, CrossEntropyRewardLoss", source)

logits, actions = torch.tensor(given.bc_logits), torch.tensor(given.bc_actions)
distribution = torch.distributions.Categorical(logits=logits)
policy = SimpleNamespace(
    evaluate_actions=lambda obs, acts: (None, distribution.log_prob(acts), distribution.entropy()),
    parameters=lambda: [torch.zeros(1)],
)
metrics = BehaviorCloningLossCalculator(ent_weight=1e-3, l2_weight=0.0)(policy, torch.zeros(4, 1), actions)
source, call = "imitation/algorithms/bc.py", "BehaviorCloningLossCalculator"
row("behavioural_cloning_loss", metrics.loss, call, source, "ent_weight=0.001, the default")
row("behavioural_cloning_loss", metrics.neglogp, call, source, "its part neglogp")
