"""Reference solutions of chapter 47: soft actor-critic, from values that can be computed
exactly to one update of its networks.
"""

from __future__ import annotations

import math

import torch
from torch.nn import functional

from course_lib import validate
from course_lib.control import sac


def soft_value_iteration(rewards, transitions, alpha, gamma=0.95, num_sweeps=300):
    """The best soft policy of a small problem whose rules are known, and its values.

        Q ← r + γ Σ_s' P(s'|s, a) V(s'),   V ← α log Σ_a exp(Q / α),   from V = 0
        π = softmax(Q / α)

    Haarnoja et al. (2017), section 3.1, https://arxiv.org/abs/1702.08165. Q / α exceeds
    what an exponential can hold long before α is small: for α = 10⁻⁶, too, and in single
    precision, the result is right and finite, and then it is that of ordinary value iteration.

    Args:
      rewards: r(s, a); (S, A).
      transitions: P(s'|s, a), the probabilities of what follows; (S, A, S). The last axis
        sums to 1, or to less where the task may end with the step.
      alpha: α > 0, the temperature, in units of reward per nat; a number.
      gamma: γ, in [0, 1].
      num_sweeps: how often both lines are applied, at least 1. After one, Q is r.

    Returns: (q, values, policy), those of the last sweep, in the dtype of rewards and
      without a graph: Q (S, A); V (S,), of Q; π (S, A), probabilities.
    Raises: ValueError that names an argument if transitions is not (S, A, S) for rewards
      (S, A), alpha ≤ 0, gamma is outside [0, 1] or num_sweeps < 1.
    """
    if transitions.shape != (*rewards.shape, len(rewards)):
        raise ValueError(
            f"transitions must be (S, A, S) for rewards (S, A), got "
            f"{tuple(transitions.shape)} for {tuple(rewards.shape)}"
        )
    validate.positive(alpha=alpha)
    validate.unit_interval(gamma=gamma)
    validate.at_least_one(num_sweeps=num_sweeps)
    with torch.no_grad():
        values = torch.zeros_like(rewards[:, 0])
        for _ in range(num_sweeps):
            q = rewards + gamma * transitions @ values
            values = alpha * (q / alpha).logsumexp(-1)
        return q, values, (q / alpha).softmax(-1)


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


def critic_loss(q1, q2, targets):
    """What both critics minimise: their mean squared distances from one target, added.

        L = mean((Q₁ - y)²) + mean((Q₂ - y)²)

    Haarnoja et al. (2018b), eq. 5, https://arxiv.org/abs/1812.05905, twice, without the half.

    Args:
      q1, q2: the critics' values of the actions that were taken, in units of reward; (B,).
        Receive gradient.
      targets: y, what both should say; (B,). No gradient, even if it requires it.

    Returns: scalar tensor.
    Raises: ValueError that names an argument if the shapes differ.
    """
    validate.same_shape(q1=q1, q2=q2, targets=targets)
    targets = targets.detach()
    return (q1 - targets).square().mean() + (q2 - targets).square().mean()


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


def sac_update(agent, batch, next_noise, noise, settings):
    """One update of soft actor-critic: the critics, the policy, the temperature, and the slow
    copies, each moved once, in place.

        critics: L = critic_loss(Q(s, a), y),   y by the copies, a' = tanh(μ(s') + σ(s') ε')
        policy: L = sac_actor_loss(Q(s, ã), log π(ã|s), α),   ã = tanh(μ(s) + σ(s) ε)
        temperature: L = temperature_loss(log α, log π(ã|s), H̄)
        copies: ← (1 - τ) copies + τ critics

    Haarnoja et al. (2018b), algorithm 1, https://arxiv.org/abs/1812.05905

    In this order, so that the policy is judged by the critics as they have just become, and
    the copies follow these; α is everywhere the one from before the update. The policy's
    loss moves no critic.

    Args:
      agent: course_lib.control.sac.Agent, changed in place. It has the networks `critics`
        and `targets` (the slow copies), for sac.values(networks, obs, actions, learn=True),
        which gives Q₁ and Q₂, (B,) each; distribution(obs) gives μ and log σ, (B, A) each;
        log_alpha, (); target_entropy, H̄ in nats; critics_optimizer, actor_optimizer,
        temperature_optimizer, for sac.minimise(loss, optimizer).
      batch: Transitions of B steps: obs, actions in (-1, 1), rewards, next_obs, terminated.
      next_noise: ε', of the actions in next_obs; (B, A).
      noise: ε, of the policy's own actions in obs; (B, A).
      settings: SACSettings; gamma and tau are what counts here.

    Returns: dictionary of critic_loss, actor_loss, temperature_loss and entropy (the mean of
      -log π(ã|s), nats), these four and no other: 0-dim tensors without a graph, each as it
      was when it was computed.
    """

    def drawn(obs, noise):
        """Actions in (-1, 1) that noise makes, (B, A), and their log-probabilities (B,)."""
        mean, log_std = agent.distribution(obs)
        pre_tanh_actions = mean + log_std.exp() * noise
        log_probs = squashed_gaussian_log_prob(mean, log_std, pre_tanh_actions)
        return pre_tanh_actions.tanh(), log_probs

    alpha = agent.log_alpha.detach().exp()
    with torch.no_grad():
        next_actions, next_log_probs = drawn(batch.next_obs, next_noise)
        next_q1, next_q2 = sac.values(agent.targets, batch.next_obs, next_actions)
    targets = soft_q_target(
        batch.rewards,
        batch.terminated,
        next_q1,
        next_q2,
        next_log_probs,
        alpha,
        settings.gamma,
    )
    q1, q2 = sac.values(agent.critics, batch.obs, batch.actions)
    of_critics = critic_loss(q1, q2, targets)
    sac.minimise(of_critics, agent.critics_optimizer)

    actions, log_probs = drawn(batch.obs, noise)
    q1, q2 = sac.values(agent.critics, batch.obs, actions, learn=False)
    of_actor = sac_actor_loss(q1, q2, log_probs, alpha)
    sac.minimise(of_actor, agent.actor_optimizer)

    of_temperature = temperature_loss(agent.log_alpha, log_probs, agent.target_entropy)
    sac.minimise(of_temperature, agent.temperature_optimizer)

    polyak_update([agent.targets.weights], [agent.critics.weights], settings.tau)
    return {
        "critic_loss": of_critics.detach(),
        "actor_loss": of_actor.detach(),
        "temperature_loss": of_temperature.detach(),
        "entropy": -log_probs.detach().mean(),
    }


def repaired_follow(target_weights, online_weights, first, tau):
    """Let the slow copies of two critics follow, in place: the first critic's by tau, the
    second's by half of it.

        target ← (1 - τ) target + τ online where first,   with τ / 2 elsewhere

    Args:
      target_weights: of both copies, in one vector, changed in place; it may require
        gradient; (P,).
      online_weights: of both critics, in the same order, left as they are; (P,).
      first: whether a weight is the first critic's; (P,) bool.
      tau: τ in [0, 1].

    Returns: None. No graph is made.
    Raises: ValueError that names an argument if the shapes differ or tau is outside [0, 1].
    """
    validate.same_shape(
        target_weights=target_weights, online_weights=online_weights, first=first
    )
    validate.unit_interval(tau=tau)
    with torch.no_grad():
        shares = torch.where(first, tau, tau / 2).to(target_weights.dtype)
        target_weights.lerp_(online_weights, shares)
