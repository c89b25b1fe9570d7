"""Reference solutions of chapter 48: soft actor-critic's losses and targets, and the
statistics of a fair comparison.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch.nn import functional

from course_lib import validate
from course_lib.control.replay import Transitions


def squashed_gaussian_log_prob(mean, log_std, pre_tanh_actions):
    """Log-density of actions a = tanh(u) whose pre-activations u are normally distributed.

        log π(a|s) = Σ_i [ log N(u_i; μ_i, σ_i²) - log(1 - tanh² u_i) ],   σ = exp(log_std)

    Haarnoja et al. (2018), appendix C, https://arxiv.org/abs/1801.01290. For large |u|
    the hyperbolic tangent rounds to ±1, and 1 - tanh² u to 0; its logarithm is to be
    right there, too.

    Args:
      mean: μ(s); (B, A). Receives gradient.
      log_std: log σ(s); (B, A). Receives gradient.
      pre_tanh_actions: u, before squashing; (B, A). Receives gradient: in SAC u is
        μ + σ ε, and the policy learns through it.

    Returns: (B,) nats, summed over the components.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(mean=mean, log_std=log_std, pre_tanh_actions=pre_tanh_actions)
    scaled = (pre_tanh_actions - mean) * (-log_std).exp()
    normal = -0.5 * scaled.square() - log_std - 0.5 * math.log(2 * math.pi)
    # 1 - tanh² u = 4 / (e^u + e^-u)², and log(e^u + e^-u) = u + log(1 + e^-2u)
    log_slope = 2 * (
        math.log(2) - pre_tanh_actions - functional.softplus(-2 * pre_tanh_actions)
    )
    return (normal - log_slope).sum(-1)


def soft_q_target(rewards, terminated, next_q1, next_q2, next_log_probs, alpha, gamma=0.99):
    """What both critics should say of a step: its reward, and the soft value of what follows.

        y = r + γ (1 - terminated) [ min(Q₁', Q₂') - α log π(a'|s') ],   a' ~ π(·|s')

    Haarnoja et al. (2018b), section 6, https://arxiv.org/abs/1812.05905

    Args:
      rewards: (B,).
      terminated: whether the task ended with the step; (B,) bool. A step that a time
        limit cut off has not terminated.
      next_q1, next_q2: the target critics' values of the next state and a fresh action
        there, in units of reward; (B,).
      next_log_probs: log-probability of that action, in nats; (B,).
      alpha: α ≥ 0, the temperature, in units of reward per nat; a number or a 0-dim
        tensor.
      gamma: γ, in [0, 1].

    Returns: (B,), without a graph.
    Raises: ValueError that names an argument if the shapes differ or gamma is outside [0, 1].
    """
    validate.same_shape(
        rewards=rewards,
        terminated=terminated,
        next_q1=next_q1,
        next_q2=next_q2,
        next_log_probs=next_log_probs,
    )
    validate.unit_interval(gamma=gamma)
    with torch.no_grad():
        soft_values = torch.minimum(next_q1, next_q2) - alpha * next_log_probs
        return rewards + gamma * torch.where(terminated, 0, soft_values)


def sac_actor_loss(q1, q2, log_probs, alpha):
    """The policy's loss: minus the value of its actions, and minus its entropy's worth.

        L = mean(α log π(a|s) - min(Q₁, Q₂)),   a = tanh(μ(s) + σ(s) ε)

    Haarnoja et al. (2018b), sections 4.2 and 6, https://arxiv.org/abs/1812.05905

    Args:
      q1, q2: the critics' values of the policy's own actions, in units of reward; (B,).
        Receive gradient, and pass it on to the actions.
      log_probs: log-probabilities of those actions, in nats; (B,). Receives gradient.
      alpha: α ≥ 0, the temperature, in units of reward per nat; a number or a 0-dim
        tensor. No gradient.

    Returns: scalar tensor.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(q1=q1, q2=q2, log_probs=log_probs)
    alpha = torch.as_tensor(alpha).detach()
    return (alpha * log_probs - torch.minimum(q1, q2)).mean()


def temperature_loss(log_alpha, log_probs, target_entropy):
    """The temperature's loss: descending it raises alpha while the entropy is below the
    target.

        L = -mean(exp(log α) (log π(a|s) + H̄))

    Haarnoja et al. (2018b), section 5, https://arxiv.org/abs/1812.05905

    Args:
      log_alpha: log α; (). Receives gradient.
      log_probs: log-probabilities of the policy's own actions, in nats; (B,). No gradient.
      target_entropy: H̄, in nats; a number.

    Returns: scalar tensor.
    """
    return -(log_alpha.exp() * (log_probs.detach() + target_entropy)).mean()


def polyak_update(target_params, online_params, tau):
    """Move slow copies of parameters a little towards the parameters, in place.

        target ← (1 - τ) target + τ online

    Lillicrap et al. (2016), algorithm 1, https://arxiv.org/abs/1509.02971

    Args:
      target_params: iterable of tensors, changed in place; they may require gradient.
      online_params: as many tensors of the same shapes, left as they are.
      tau: τ in [0, 1]: 0 leaves the targets where they are, 1 copies.

    Returns: None. No graph is made.
    Raises: ValueError that names an argument if a tensor's shape differs from its partner's,
      or tau is outside [0, 1].
    """
    validate.unit_interval(tau=tau)
    with torch.no_grad():
        for target, online in zip(target_params, online_params, strict=True):
            validate.same_shape(target_params=target, online_params=online)
            target.lerp_(online, tau)


def interquartile_mean(scores):
    """The mean of the middle half of all scores: no lucky run lifts it, no failed one ruins
    it.

        Σ_i w_i s_{(i)} / (n / 2),   w_i = length of [i - 1, i] ∩ [n / 4, 3 n / 4],
        s_{(i)} = the i-th smallest of n scores

    A quarter of the weight is cut off at each end. Where the count n is no multiple of 4,
    the scores at the two edges count in part: the weights, n / 2 in all, are those of n
    scores laid side by side, one unit each, from n / 4 to 3 n / 4.

    Agarwal et al. (2021), section 4.3, https://arxiv.org/abs/2108.13264

    Args:
      scores: of any shape, with at least one entry; all are taken together.

    Returns: 0-dim tensor.
    """
    ordered = scores.flatten().sort().values
    count = len(ordered)
    edges = torch.arange(count + 1, dtype=scores.dtype, device=scores.device).clamp(
        count / 4, 3 * count / 4
    )
    return edges.diff() @ ordered / (count / 2)


def bootstrap_interval(scores, confidence=0.95, num_resamples=2000, generator=None):
    """How far the interquartile mean could be off: a stratified percentile bootstrap.

        quantiles α / 2 and 1 - α / 2 of IQM(scores of redrawn seeds),   α = 1 - confidence

    As many seeds as there are are drawn, with replacement, for each task apart; the
    interquartile mean of all that was drawn is noted, and this is repeated. The interval
    leaves out (1 - confidence) / 2 of these means at either end.

    Agarwal et al. (2021), section 4.1, https://arxiv.org/abs/2108.13264

    Args:
      scores: (seeds,) or (seeds, tasks).
      confidence: mass of the interval, in (0, 1).
      num_resamples: how often seeds are drawn.
      generator: torch generator, the only source of the draws; None takes torch's own.

    Returns: (low, high), 0-dim tensors.
    """
    by_task = scores.reshape(len(scores), -1)  # (seeds, tasks)
    picks = torch.randint(len(by_task), (num_resamples, *by_task.shape), generator=generator)
    resampled = by_task.gather(0, picks.flatten(0, 1)).view(num_resamples, -1)
    means = torch.vmap(interquartile_mean)(resampled)
    tail = (1 - confidence) / 2
    return means.quantile(tail), means.quantile(1 - tail)


def repaired_transitions(obs, sent, rewards, next_obs, terminated, truncated, low, high):
    """What the suspect program of the bug lab should have put into its replay buffer.

    Args:
      obs: what the policy saw; (N, O).
      sent: what the environment was sent, in its own units; (N, A).
      rewards: (N,).
      next_obs: the true successor, also where an episode ended; (N, O).
      terminated: whether the task ended with the step; (N,) bool.
      truncated: whether a time limit cut the episode off; (N,) bool.
      low, high: the bounds of what the environment takes, low < high; (A,).

    Returns: Transitions of N steps, as the update of SAC needs them.
    Raises: ValueError that names an argument if the numbers of rows differ, or low < high does
      not hold everywhere.
    """
    for name, rows in {
        "sent": sent,
        "rewards": rewards,
        "next_obs": next_obs,
        "terminated": terminated,
        "truncated": truncated,
    }.items():
        if len(rows) != len(obs):
            raise ValueError(
                f"{name} must have as many rows as obs, {len(obs)}, got {len(rows)}"
            )
    if not (low < high).all():
        raise ValueError(
            f"low must lie below high in every component, got {low.tolist()} and "
            f"{high.tolist()}"
        )
    middle, reach = (low + high) / 2, (high - low) / 2
    return Transitions(obs, (sent - middle) / reach, rewards, next_obs, terminated)


def fast_sac_update(agent, batch, settings, taught, generator):
    """What course_lib.control.sac.update does, up to rounding, in three quarters of its time.

    Much of a plain update is not arithmetic on matrices but PyTorch's bookkeeping. So the
    losses are differentiated on paper. With u = μ + σ ε, a = tanh u, B samples:

        ∂L/∂Q = 2 (Q - y) / B for each critic,
        ∂L/∂u = [2 α a - (1 - a²) ∂min(Q₁, Q₂)/∂a] / B,
        ∂L/∂μ = ∂L/∂u,   ∂L/∂log σ = σ ε ∂L/∂u - α / B

    Here the density of a needs no care at its edges: u is known.

    Args, returns: as course_lib.control.sac.update; `taught` is not asked.
    """
    obs, actions, rewards, next_obs, terminated = (column.numpy() for column in batch)
    count, size = len(rewards), actions.shape[1]
    alpha = math.exp(agent.log_alpha.item())
    # for the next states first, as update draws it
    noise = torch.randn((2, count, size), generator=generator).numpy()

    # the actor changes last: one pass for both
    policy = agent.actor.forward(0, np.concatenate([next_obs, obs]))
    std, pre_tanh, free = _sampled(
        policy[-1], noise.reshape(2 * count, size), agent.log_std_range
    )
    squashed = np.tanh(pre_tanh)
    log_slope = 2 * (math.log(2) - pre_tanh - np.logaddexp(0, -2 * pre_tanh))
    constant = 0.5 * math.log(2 * math.pi)
    log_probs = -(
        0.5 * noise.reshape(2 * count, size) ** 2 + np.log(std) + constant + log_slope
    ).sum(1)
    next_squashed, squashed = squashed[:count], squashed[count:]
    next_log_probs, log_probs = log_probs[:count], log_probs[count:]

    following = np.concatenate([next_obs, next_squashed], 1)
    next_q = np.minimum(*(agent.targets.forward(i, following)[-1][:, 0] for i in range(2)))
    targets = rewards + settings.gamma * np.where(
        terminated, 0, next_q - alpha * next_log_probs
    )
    taken, critic_loss = np.concatenate([obs, actions], 1), 0.0
    for i in range(2):
        activations = agent.critics.forward(i, taken)
        errors = activations[-1] - targets[:, None]
        critic_loss += np.vdot(errors, errors) / count
        agent.critics.backward(i, activations, (2 / count) * errors, to_inputs=False)
    agent.critics_optimizer.step(torch.from_numpy(agent.critics.gradient))

    own = np.concatenate([obs, squashed], 1)
    judged = [agent.critics.forward(i, own) for i in range(2)]
    first_is_less = judged[0][-1] <= judged[1][-1]
    chosen = (first_is_less, ~first_is_less)
    d_squashed = sum(
        agent.critics.backward(
            i, judged[i], chosen[i] * np.float32(-1 / count), to_weights=False
        )[:, obs.shape[1] :]
        for i in range(2)
    )
    d_pre_tanh = (2 * alpha / count) * squashed + (1 - squashed**2) * d_squashed
    d_log_std = (std[count:] * noise[1] * d_pre_tanh - alpha / count) * free[count:]
    activations = [layer[count:] for layer in policy]
    agent.actor.backward(
        0, activations, np.concatenate([d_pre_tanh, d_log_std], 1), to_inputs=False
    )
    agent.actor_optimizer.step(torch.from_numpy(agent.actor.gradient))
    surplus = log_probs.mean() + agent.target_entropy
    agent.temperature_optimizer.step(torch.as_tensor(-alpha * surplus))

    polyak_update([agent.targets.weights], [agent.critics.weights], settings.tau)
    metrics = {
        "critic_loss": critic_loss,
        "q": judged[0][-1].mean(),
        "entropy": -log_probs.mean(),
        "alpha": alpha,
    }
    return {name: torch.as_tensor(value) for name, value in metrics.items()}


def _sampled(outputs, noise, log_std_range):
    """Of an actor's outputs: σ, the pre-activations, and where log σ is inside its range."""
    mean, log_std = np.split(outputs, 2, axis=1)
    std = np.exp(np.clip(log_std, *log_std_range))
    return (
        std,
        mean + std * noise,
        (log_std >= log_std_range[0]) & (log_std <= log_std_range[1]),
    )
