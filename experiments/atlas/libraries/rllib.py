# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy==2.4.6", "torch==2.13.0", "ray[rllib]==2.60.0"]
#
# [tool.atlas]
# libraries = ["ray"]
# seconds = 300
# ///
"""`compute_value_targets` and `GeneralAdvantageEstimation` on episodes that are a step longer, as AddOneTsToEpisodesAndTruncate makes them,
and `PPOTorchLearner.compute_loss_for_module` with a stand-in for the module."""

from types import SimpleNamespace

import numpy as np
import torch
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.connectors.learner.general_advantage_estimation import GeneralAdvantageEstimation
from ray.rllib.utils.postprocessing.value_predictions import compute_value_targets
from sheet import given, row


def tensor(name):
    return torch.tensor(getattr(given, name))


def longer(truncated):
    """Columns of all episodes, each followed by a step that holds the value of its last observation; which steps are real; lengths."""
    columns = {name: [] for name in ("values", "rewards", "terminateds", "truncateds")}
    real, lengths = [], [0]
    for n in range(2):
        for t in range(8):
            end = given.terminated[n][t] or truncated[n][t]
            last = end or t == 7
            rollout = given.values[n][t], given.rewards[n][t], given.terminated[n][t], last and not given.terminated[n][t]
            extra = given.final_values[n][t] if end else given.last_values[n], 0.0, False, False
            for step in (rollout, extra) if last else (rollout,):
                for column, number in zip(columns.values(), step, strict=True):
                    column.append(float(number))
            real += [True, False] if last else [True]
            lengths[-1] += 1
            if last:
                lengths[-1] += 1
                lengths.append(0)
    return {name: np.array(column, np.float32) for name, column in columns.items()}, np.array(real), lengths[:-1]


columns, real, _ = longer(given.truncated)
targets = compute_value_targets(**columns, gamma=given.gamma, lambda_=given.gae_lambda)
source = "ray/rllib/utils/postprocessing/value_predictions.py"
row("gae", (targets - columns["values"])[real].reshape(2, 8), "compute_value_targets", source)

columns, real, lengths = longer(np.zeros((2, 8)))
connector = GeneralAdvantageEstimation(gamma=given.gamma, lambda_=given.gae_lambda)
connector._numpy_to_tensor_connector = lambda **inputs: inputs["batch"]
connector.single_agent_episode_iterator = lambda episodes, **settings: iter(episodes)


class Episode:
    module_id = None

    def __init__(self, length):
        self.length = length

    def __len__(self):
        return self.length


class Modules:
    def foreach_module(self, func, return_dict):
        return {"module": torch.tensor(columns["values"])}

    def __getitem__(self, name):
        return SimpleNamespace(is_stateful=lambda: False)


batch = {"module": {"rewards": columns["rewards"], "terminateds": columns["terminateds"], "truncateds": columns["truncateds"]}}
connector(rl_module=Modules(), episodes=[Episode(length) for length in lengths], batch=batch)
row(
    "normalised_rollout", np.array(batch["module"]["advantages"])[real].reshape(2, 8), "GeneralAdvantageEstimation.__call__",
    "ray/rllib/connectors/learner/general_advantage_estimation.py", "the default",
)  # fmt: skip


class Distribution:
    @classmethod
    def from_logits(cls, logits):
        return cls()

    def logp(self, actions):
        return tensor("logp")

    def entropy(self):
        return tensor("entropy")


def loss(scale=1):
    logged = {}
    module = SimpleNamespace(
        get_train_action_dist_cls=lambda: Distribution, get_exploration_action_dist_cls=lambda: Distribution,
        compute_values=lambda batch, embeddings=None: scale * tensor("new_values"),
    )  # fmt: skip
    coefficient = SimpleNamespace(get_current_value=lambda: given.ent_coef)
    self = SimpleNamespace(
        module={"module": SimpleNamespace(unwrapped=lambda: module)}, entropy_coeff_schedulers_per_module={"module": coefficient},
        metrics=SimpleNamespace(log_dict=lambda entries, **settings: logged.update(entries)),
    )  # fmt: skip
    config = SimpleNamespace(
        use_kl_loss=False, clip_param=given.clip_range, use_critic=True, vf_clip_param=10.0, vf_loss_coeff=given.vf_coef
    )
    batch = {
        "actions": None, "action_logp": tensor("old_logp"), "action_dist_inputs": None, "advantages": tensor("adv"),
        "value_targets": tensor("returns"),
    }  # fmt: skip
    outputs = {"action_dist_inputs": None}
    total = PPOTorchLearner.compute_loss_for_module(self, module_id="module", config=config, batch=batch, fwd_out=outputs)
    return logged | {"total": total}


source, call = "ray/rllib/algorithms/ppo/torch/ppo_torch_learner.py", "PPOTorchLearner.compute_loss_for_module"
logged = loss()
row("policy_loss", logged["policy_loss"], call, source)
row("value_loss", logged["vf_loss"], call, source, "vf_clip_param=10, the default", "No error of this input is cut off.")
row("total_loss", logged["total"], call, source, "vf_loss_coeff=0.5, entropy_coeff=0.01")
row("value_loss_far", loss(scale=5)["vf_loss"], call, source, "vf_clip_param=10, the default")
