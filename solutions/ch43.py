"""Reference solutions of chapter 43: PPO's clipped surrogate objective and the two numbers
that watch over it.
"""

from __future__ import annotations

import torch

from course_lib import validate


def importance_ratio(log_probs, old_log_probs):
    """How much likelier each action is under the current policy than under the one that took
    it.

        ρ = π(a|s) / π_old(a|s) = exp(log_probs - old_log_probs)

    Schulman et al. (2017), section 3, https://arxiv.org/abs/1707.06347

    Args:
      log_probs: log π(a|s) of the current policy, in nats; (B,). Receives gradient.
      old_log_probs: the same under the policy that acted, a constant of the rollout; (B,).

    Returns: (B,) ratios, dimensionless, positive; 1 where nothing has changed.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(log_probs=log_probs, old_log_probs=old_log_probs)
    return (log_probs - old_log_probs.detach()).exp()


def surrogate_loss(log_probs, old_log_probs, advantages):
    """The unclipped surrogate objective, negated so that it can be minimised.

        L = -mean(ρ A),   ρ = exp(log_probs - old_log_probs)

    Schulman et al. (2017), eq. 6, https://arxiv.org/abs/1707.06347

    Args:
      log_probs: log π(a|s) of the current policy, in nats; (B,). Receives gradient.
      old_log_probs: the same under the policy that acted; (B,). No gradient.
      advantages: (B,), in units of reward unless normalised. No gradient.

    Returns: scalar (0-dim) tensor.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(
        log_probs=log_probs, old_log_probs=old_log_probs, advantages=advantages
    )
    return -(importance_ratio(log_probs, old_log_probs) * advantages.detach()).mean()


def clipped_surrogate_loss(log_probs, old_log_probs, advantages, clip_range=0.2):
    """PPO's clipped surrogate objective, negated so that it can be minimised.

        L = -mean(min(ρ A, clip(ρ, 1 - ε, 1 + ε) A)),   ρ = exp(log_probs - old_log_probs)

    Schulman et al. (2017), eq. 7, https://arxiv.org/abs/1707.06347

    Args:
      log_probs: log π(a|s) of the current policy, in nats; (B,). Receives gradient.
      old_log_probs: the same under the policy that acted; (B,). No gradient.
      advantages: (B,), in units of reward unless normalised. No gradient.
      clip_range: ε ≥ 0, dimensionless; infinity means no clipping.

    Returns: scalar (0-dim) tensor.
    Raises: ValueError that names an argument if the shapes differ or clip_range < 0.
    """
    validate.same_shape(
        log_probs=log_probs, old_log_probs=old_log_probs, advantages=advantages
    )
    validate.non_negative(clip_range=clip_range)
    ratio = importance_ratio(log_probs, old_log_probs)
    clipped_ratio = ratio.clamp(1 - clip_range, 1 + clip_range)
    weights = advantages.detach()
    return -torch.minimum(ratio * weights, clipped_ratio * weights).mean()


def approx_kl(log_probs, old_log_probs):
    """How far the policy has moved: an unbiased estimate of KL(π_old ‖ π) that is never
    negative.

        mean(ρ - 1 - log ρ),   log ρ = log_probs - old_log_probs

    Schulman (2020), estimator k3, http://joschu.net/blog/kl-approx.html

    Args:
      log_probs: log π(a|s) of the current policy, in nats; (B,).
      old_log_probs: the same under the policy that acted, from which the actions were drawn;
        (B,).

    Returns: scalar (0-dim) tensor in nats, without a graph.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(log_probs=log_probs, old_log_probs=old_log_probs)
    log_ratio = (log_probs - old_log_probs).detach()
    # expm1(x) is exp(x) - 1 without the cancellation where policies are close
    return (log_ratio.expm1() - log_ratio).mean()


def clip_fraction(log_probs, old_log_probs, clip_range=0.2):
    """The share of samples whose ratio has left the clip's interval.

        mean(|ρ - 1| > ε),   ρ = exp(log_probs - old_log_probs)

    Stable-Baselines3 logs it under this name.

    Args:
      log_probs: log π(a|s) of the current policy, in nats; (B,).
      old_log_probs: the same under the policy that acted; (B,).
      clip_range: ε ≥ 0, dimensionless; infinity means no clipping.

    Returns: scalar (0-dim) tensor in [0, 1], in the dtype of log_probs, without a graph.
    Raises: ValueError that names an argument if the shapes differ or clip_range < 0.
    """
    validate.non_negative(clip_range=clip_range)
    outside = (importance_ratio(log_probs, old_log_probs) - 1).abs() > clip_range
    return outside.to(log_probs.dtype).mean()


def repaired_losses(log_probs, advantages, clip_range=0.2):
    """The clipped losses that the suspect program of the bug lab should have minimised, epoch
    by epoch.

        L_k = -mean(min(ρ_k A, clip(ρ_k, 1 - ε, 1 + ε) A)),   ρ_k = exp(log_probs_k -
        log_probs_0)

    Schulman et al. (2017), algorithm 1 and eq. 7, https://arxiv.org/abs/1707.06347

    Args:
      log_probs: log π(a|s) of one rollout's actions in K successive epochs, in nats; (K, B).
        Row k is the policy at the moment of epoch k's loss; row 0 is also the policy that
        acted. Each row receives gradient from its own epoch's loss only.
      advantages: of the rollout's actions; (B,), in units of reward unless normalised. No
        gradient.
      clip_range: ε ≥ 0, dimensionless; infinity means no clipping.

    Returns: (K,) losses.
    Raises: ValueError that names an argument if a row of log_probs and advantages differ in
      shape, or clip_range < 0.
    """
    old_log_probs = log_probs[0].detach()
    return torch.stack(
        [
            clipped_surrogate_loss(current, old_log_probs, advantages, clip_range)
            for current in log_probs
        ]
    )
