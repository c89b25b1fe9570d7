# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "trl==1.16.0"]
#
# [tool.atlas]
# libraries = ["trl"]
# ///
"""`DPOTrainer._compute_loss` and `RewardTrainer.compute_loss` with a stand-in for `self` and a model that gives the log-probabilities or
scores of the input, the former spread evenly over a completion's tokens."""

from collections import defaultdict
from types import SimpleNamespace

import torch
from sheet import given, row
from trl.trainer.dpo_trainer import DPOTrainer
from trl.trainer.reward_trainer import RewardTrainer
from trl.trainer.utils import nanstd


def tensor(name):
    return torch.tensor(getattr(given, name))


def summed(x):
    return x


accelerator = SimpleNamespace(device="cpu", gather=summed, gather_for_metrics=summed)
lengths = given.chosen_lengths + given.rejected_lengths
width = max(lengths) + 1
mask = torch.tensor([[0] + [1] * length + [0] * (width - 1 - length) for length in lengths])


def model(prefix):
    """Gives each kept token an equal part of its completion's log-probability."""
    sums = torch.cat([tensor(f"{prefix}chosen"), tensor(f"{prefix}rejected")])
    logps = sums[:, None] / torch.tensor(lengths)[:, None] * mask[:, 1:]
    nothing = torch.zeros_like(logps)
    outputs = SimpleNamespace(
        log_probs=logps, entropy=nothing, mean_logits=nothing, is_top1=nothing.bool(), log_sum_sq_probs=nothing
    )
    return lambda **inputs: outputs


def dpo(loss_type, label_smoothing=0.0):
    """The loss, and the metrics."""
    self = SimpleNamespace(
        model=SimpleNamespace(training=False), accelerator=accelerator, aux_loss_enabled=False, ld_alpha=None, precompute_ref_logps=False,
        args=SimpleNamespace(gradient_checkpointing_kwargs=None), ref_model=model("ref_"), f_divergence_type="reverse_kl",
        loss_types=[loss_type], loss_weights=[1.0], beta=given.beta, label_smoothing=label_smoothing, use_weighting=False,
        _metrics={"eval": defaultdict(list)}, _total_train_tokens=0,
    )  # fmt: skip
    self.model = type("Model", (torch.nn.Module,), {"is_gradient_checkpointing": False})().eval()
    inputs = {"input_ids": torch.zeros_like(mask), "attention_mask": torch.ones_like(mask), "completion_mask": mask}
    return DPOTrainer._compute_loss(self, model(""), inputs, False), self._metrics["eval"]


source, call = "trl/trainer/dpo_trainer.py", "DPOTrainer._compute_loss"
loss, metrics = dpo("sigmoid")
row("dpo_loss_mean", loss, call, source, "loss_type='sigmoid', the default")
row("implicit_margin", metrics["rewards/margins"][0], call, source)
row("dpo_loss_smoothed_mean", dpo("sigmoid", given.label_smoothing)[0], call, source, "loss_type='sigmoid', label_smoothing=0.1")
row("dpo_loss_smoothed_mean", dpo("robust", given.label_smoothing)[0], call, source, "loss_type='robust', label_smoothing=0.1")
row("ipo_loss_mean", dpo("ipo")[0], call, source, "loss_type='ipo'")


def reward(margin=False, coefficient=None):
    scores = torch.cat([tensor("rm_chosen"), tensor("rm_rejected")])[:, None]
    self = SimpleNamespace(
        model=SimpleNamespace(training=False), args=SimpleNamespace(center_rewards_coefficient=coefficient), accelerator=accelerator,
        _metrics={"eval": defaultdict(list)}, _total_train_tokens=0,
    )  # fmt: skip
    inputs = {"input_ids": None, "attention_mask": torch.ones(6, 1)} | ({"margin": tensor("margin")} if margin else {})
    return RewardTrainer.compute_loss(self, lambda **inputs: SimpleNamespace(logits=scores), inputs)


source, call = "trl/trainer/reward_trainer.py", "RewardTrainer.compute_loss"
row("reward_model_loss", reward(), call, source)
row("reward_model_loss_margin", reward(margin=True), call, source)
row("reward_model_loss_centred", reward(coefficient=given.center_coef), call, source, "center_rewards_coefficient=0.01")
row("group_deviation", nanstd(tensor("group_rewards"), dim=1), "trainer.utils.nanstd", "trl/trainer/utils.py")
