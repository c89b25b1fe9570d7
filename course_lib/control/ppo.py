"""What chapter 45's PPO is given: its settings, and the batch that an update draws minibatches from."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch


@dataclass(frozen=True)
class PPOSettings:
    """Everything that one may choose in PPO; the number of environments is theirs to say.

    `clip_range` infinity: no clipping. `target_kl`: an update ends after the epoch whose mean approx_kl exceeds it. `anneal`: the
    learning rate falls linearly to 0 over `total_steps`. `reward_scale` multiplies the rewards that are learned from, not those
    that are reported. `hidden` and `log_std` (the logarithm of the first standard deviation) shape a new policy.
    """

    total_steps: int = 400_000  # environment steps, over all environments together
    num_steps: int = 1024  # T, steps of each environment in a rollout
    minibatch_size: int = 64
    num_epochs: int = 4
    learning_rate: float = 3e-4
    anneal: bool = False
    gamma: float = 0.999
    gae_lambda: float = 0.98
    clip_range: float = 0.2
    vf_coef: float = 0.5
    ent_coef: float = 0.01
    max_grad_norm: float = 0.5
    target_kl: float = float("inf")
    normalize_advantages: bool = True
    normalize_obs: bool = False
    reward_scale: float = 1.0
    hidden: int = 64
    log_std: float = 0.0

    def but(self, **changes) -> PPOSettings:
        """These settings with some changed."""
        return replace(self, **changes)


ZOO_SETTINGS = PPOSettings()
"""For LunarLanderContinuous, with 16 environments: those of rl-baselines3-zoo, whose rollouts are 16 times 1024 steps."""

LANDER_SETTINGS = PPOSettings(
    num_steps=256,
    minibatch_size=512,
    num_epochs=10,
    learning_rate=1e-3,
    anneal=True,
    ent_coef=0.0,
    reward_scale=0.05,
    log_std=-0.5,
)
"""For LunarLanderContinuous, with 16 environments: our own, which land within 400,000 steps.

What differs from the zoo's and why: a quarter of the steps in a rollout, so that there are four times as many updates; rewards
scaled so that the critic's targets are of the order of 10, not 200; larger minibatches, which make a step cheaper, with a larger
learning rate, which falls to 0; and a smaller first standard deviation, with no bonus that keeps it up.
"""


@dataclass(frozen=True)
class Batch:
    """The steps of a rollout as PPO learns from them, in one row each: B = T N."""

    obs: torch.Tensor  # (B, *obs)
    actions: torch.Tensor  # (B, *act), as sampled
    old_log_probs: torch.Tensor  # (B,), nats, of the policy that acted
    advantages: torch.Tensor  # (B,)
    returns: torch.Tensor  # (B,), the critic's targets

    def __len__(self) -> int:
        return len(self.obs)

    def __getitem__(self, indices) -> Batch:
        """The rows of an int64 tensor of indices, in its order."""
        return Batch(*(getattr(self, field.name).index_select(0, indices) for field in fields(self)))
