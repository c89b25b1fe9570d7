"""Reference solutions of chapter 44: generalised advantage estimation and what PPO builds
on it.
"""

from __future__ import annotations

import torch

from course_lib import validate


def td_residuals(rewards, values, next_values, terminated, gamma=0.99):
    """One-step temporal-difference residuals.

        δ_t = r_t + γ (1 - terminated_t) V(s_{t+1}) - V(s_t)

    Schulman et al. (2016), section 3, https://arxiv.org/abs/1506.02438

    Args:
      rewards: r_t, in units of reward; (T, N).
      values: V(s_t), the critic's estimate; (T, N).
      next_values: V of the true successor of each step, never of the observation
        after a reset; (T, N).
      terminated: True where the task itself ended: nothing follows; (T, N) bool.
      gamma: discount per step, in [0, 1].

    Returns: (T, N) residuals in units of reward, without a graph.
    Raises: ValueError that names an argument if the shapes differ or gamma lies outside
      [0, 1].
    """
    validate.same_shape(
        rewards=rewards, values=values, next_values=next_values, terminated=terminated
    )
    validate.unit_interval(gamma=gamma)
    return (rewards + gamma * next_values * ~terminated - values).detach()


def compute_gae(
    rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95
):
    """Generalised advantage estimates, by one backward pass over time.

        A_t = δ_t + γ λ (1 - ended_t) A_{t+1},   ended_t = terminated_t or truncated_t

    Schulman et al. (2016), eq. 16, https://arxiv.org/abs/1506.02438

    Args:
      rewards: r_t, in units of reward; (T, N).
      values: V(s_t); (T, N).
      next_values: V of the true successor of each step; (T, N).
      terminated: True where the task itself ended: no bootstrap, no recursion;
        (T, N) bool.
      truncated: True where a time limit cut the episode: bootstrap, no recursion;
        (T, N) bool.
      gamma: discount per step, in [0, 1].
      gae_lambda: λ in [0, 1]; 0 gives the one-step residual, 1 the longest estimate that
        the rollout allows, which is the Monte Carlo return minus the value where the
        episode terminates in it.

    Returns: (T, N) advantages in units of reward, without a graph.
    Raises: ValueError that names an argument if shapes differ, or gamma or gae_lambda lies
      outside [0, 1].
    """
    validate.same_shape(
        rewards=rewards,
        values=values,
        next_values=next_values,
        terminated=terminated,
        truncated=truncated,
    )
    validate.unit_interval(gamma=gamma, gae_lambda=gae_lambda)
    deltas = td_residuals(rewards, values, next_values, terminated, gamma)
    ended = terminated | truncated
    advantages = torch.zeros_like(deltas)
    following = torch.zeros_like(deltas[0])
    for t in reversed(range(len(deltas))):
        following = deltas[t] + gamma * gae_lambda * torch.where(ended[t], 0, following)
        advantages[t] = following
    return advantages


def lambda_returns(advantages, values):
    """The λ-returns that the critic is fitted to.

        R_t = A_t + V(s_t)

    They are Monte Carlo returns only at λ = 1, and where the episode terminates within
    the rollout. Sutton and Barto (2018), eq. 12.3.

    Args:
      advantages: generalised advantage estimates in units of reward, not normalised;
        (T, N).
      values: V(s_t) as used in the estimates; (T, N).

    Returns: (T, N) returns in units of reward, without a graph.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(advantages=advantages, values=values)
    return (advantages + values).detach()


def normalize_advantages(advantages, eps=1e-8):
    """Advantages with zero mean and unit standard deviation over all elements.

        (A - mean(A)) / (std(A) + ε)

    Huang et al. (2022), detail 7, where it is done in each minibatch anew:
    https://iclr-blog-track.github.io/2022/03/25/ppo-implementation-details/

    Args:
      advantages: any shape, at least two elements.
      eps: keeps the division finite when all advantages are equal.

    Returns: the shape of advantages, dimensionless.
    """
    return (advantages - advantages.mean()) / (advantages.std() + eps)


def explained_variance(values, returns):
    """The share of the returns' variance that the critic explains.

        1 - Var(returns - values) / Var(returns)

    1 is perfect, 0 is no better than a constant, negative is worse. Stable-Baselines3
    logs it under this name.

    Args:
      values: V(s), in units of reward; any shape.
      returns: the targets, in the same shape.

    Returns: scalar (0-dim) tensor in the dtype of values, without a graph; NaN where
      Var(returns) = 0.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(values=values, returns=returns)
    variance = returns.var()
    explained = 1 - (returns - values).var() / variance
    return torch.where(
        variance == 0, torch.full_like(explained, float("nan")), explained
    ).detach()


def repaired_targets(
    rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95
):
    """What the suspect program should have fed to its two losses.

    Args:
      rewards, values, next_values: in units of reward; (T, N).
      terminated, truncated: (T, N) bool.
      gamma, gae_lambda: in [0, 1].

    Returns: (advantages, returns), both (T, N), without a graph: for the policy's loss the
      advantages, normalised over all elements; for the critic's loss its targets.
    Raises: ValueError that names an argument if shapes differ, or gamma or gae_lambda lies
      outside [0, 1].
    """
    advantages = compute_gae(
        rewards, values, next_values, terminated, truncated, gamma, gae_lambda
    )
    return normalize_advantages(advantages), lambda_returns(advantages, values)
