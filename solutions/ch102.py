"""Reference solutions of chapter 102: rules that libraries follow, and telling them from
numbers.
"""

from __future__ import annotations

import torch

from course_lib import validate


def clip_fraction_as(rule, log_probs, old_log_probs, advantages, clip_range=0.2):
    """The clip fraction by either of the two rules that libraries log under this name.

        mean(counted),   ρ = exp(log_probs - old_log_probs)

    Rule "outside" counts the samples whose ratio has left [1 - ε, 1 + ε], on either side.
    Rule "silenced" gives the silent fraction: it counts only those whose gradient the clip
    takes away. A sample whose advantage is 0 has none to lose. The clip is that of Schulman
    et al. (2017), eq. 7, https://arxiv.org/abs/1707.06347

    Args:
      rule: "outside" or "silenced".
      log_probs: log π(a|s) of the current policy, in nats; (B,).
      old_log_probs: the same under the policy that acted; (B,).
      advantages: (B,), in units of reward unless normalised.
      clip_range: ε ≥ 0, dimensionless; infinity means no clipping.

    Returns: scalar (0-dim) tensor in [0, 1], in the dtype of log_probs, without a graph.
    Raises: ValueError that names an argument if rule is another, the shapes differ or
      clip_range < 0.
    """
    if rule not in ("outside", "silenced"):
        raise ValueError(f"rule must be 'outside' or 'silenced', got {rule!r}")
    validate.same_shape(
        log_probs=log_probs, old_log_probs=old_log_probs, advantages=advantages
    )
    validate.non_negative(clip_range=clip_range)
    ratio = (log_probs - old_log_probs).exp()
    above, below = ratio > 1 + clip_range, ratio < 1 - clip_range
    if rule == "silenced":
        above, below = above & (advantages > 0), below & (advantages < 0)
    return (above | below).to(log_probs.dtype).mean()


def which_diagnostics(
    logged_kl, logged_fraction, log_probs, old_log_probs, advantages, clip_range=0.2
):
    """Which rules made the two numbers that a library has logged for a batch.

        |logged - computed| ≤ 1e-5 max(1, |logged|),   ρ = exp(log_probs - old_log_probs)

    Logs are in single precision, hence the tolerance. Where two rules agree, both fit; where
    the library follows another one, none does. k1 and k3 are named by Schulman (2020),
    http://joschu.net/blog/kl-approx.html

    Args:
      logged_kl: the "approximate KL" in nats; scalar (0-dim).
      logged_fraction: the "clip fraction"; scalar (0-dim).
      log_probs: log π(a|s) of the current policy, in nats; (B,).
      old_log_probs: the same under the policy that acted; (B,).
      advantages: (B,), in units of reward unless normalised.
      clip_range: ε ≥ 0, dimensionless; infinity means no clipping.

    Returns: (4,) bool tensor: whether logged_kl fits k1, the mean of -log ρ, and k3, that of
      ρ - 1 - log ρ; whether logged_fraction fits "outside" and "silenced" of clip_fraction_as.
    Raises: ValueError that names an argument if the shapes of the batch differ or
      clip_range < 0.
    """
    batch = (log_probs, old_log_probs, advantages, clip_range)
    fractions = [clip_fraction_as(rule, *batch) for rule in ("outside", "silenced")]
    log_ratio = log_probs - old_log_probs
    k1, k3 = -log_ratio.mean(), (log_ratio.expm1() - log_ratio).mean()
    computed = torch.stack([k1, k3, *fractions]).detach()
    logged = torch.stack([logged_kl, logged_kl, logged_fraction, logged_fraction])
    return (logged - computed).abs() <= 1e-5 * logged.abs().clamp(min=1)


def gae_as(
    rule,
    rewards,
    values,
    next_values,
    last_values,
    terminated,
    truncated,
    gamma=0.99,
    gae_lambda=0.95,
):
    """Advantages by the textbook, or by one of four rules that libraries follow where a time
    limit cuts an episode.

        A_t = δ_t + γ λ c_t A_{t+1},   δ_t and c_t by the rule

    - "textbook": as compute_gae of chapter 44. δ_t is r_t + γ V(s_{t+1}) - V(s_t), without the
      second term where the task ended; c_t is 0 where it ended or was cut, else 1.
    - "termination": a time limit counts as an end of the task.
    - "leak": a time limit is not seen. The value in row t + 1, of whatever episode, or
      last_values after the last row, stands in for that of the successor, and the sum runs on
      into that row.
    - "current_value": γ V(s_t), of the observation before the step, is added to the reward of
      each truncated step, even if the task ended just then; after that, every end counts as
      an end of the task.
    - "dropped": a truncated step has advantage 0. Every other one looks one step ahead, to a
      target: r_t + γ (1 - terminated_t) G_{t+1} - V(s_t). There G_{t+1} is last_values after
      the last row, and else V + A of row t + 1, where A is the sum of "termination" but with
      δ = 0 at truncated steps.

    The first is Schulman et al. (2016), eq. 16, https://arxiv.org/abs/1506.02438; who follows
    the others is said in the book's appendix on other libraries.

    Args:
      rule: one of these names.
      rewards: r_t, in units of reward; (T, N).
      values: V(s_t); (T, N).
      next_values: V of the true successor of each step; (T, N).
      last_values: V of the observation from which the next rollout starts, the first of an
        episode where one has just ended; (N,).
      terminated: True where the task itself ended; (T, N) bool.
      truncated: True where a time limit cut the episode; (T, N) bool.
      gamma: discount per step, in [0, 1].
      gae_lambda: λ in [0, 1].

    Returns: (T, N) advantages in units of reward, without a graph.
    Raises: ValueError that names an argument if rule is another, shapes differ, or gamma or
      gae_lambda lies outside [0, 1].
    """
    rules = ("textbook", "termination", "leak", "current_value", "dropped")
    if rule not in rules:
        raise ValueError(f"rule must be one of {', '.join(rules)}, got {rule!r}")
    flags = {"terminated": terminated, "truncated": truncated}
    validate.same_shape(rewards=rewards, values=values, next_values=next_values, **flags)
    validate.same_shape(last_values=last_values, values=values[-1])
    validate.unit_interval(gamma=gamma, gae_lambda=gae_lambda)
    ended = terminated | truncated
    following = torch.cat([values[1:], last_values[None]])
    if rule == "textbook":
        bootstraps, stops, following = ~terminated, ended, next_values
    elif rule == "leak":
        bootstraps, stops = ~terminated, terminated
    else:
        bootstraps, stops = ~ended, ended
    deltas = rewards + gamma * following * bootstraps - values
    if rule == "current_value":
        deltas = deltas + gamma * values * truncated
    if rule == "dropped":
        deltas = deltas * ~truncated
    advantages, later = torch.zeros_like(deltas), torch.zeros_like(deltas[0])
    for t in reversed(range(len(deltas))):
        later = deltas[t] + gamma * gae_lambda * later * ~stops[t]
        advantages[t] = later
    if rule == "dropped":
        targets = torch.cat([(values + advantages)[1:], last_values[None]])
        advantages = (rewards + gamma * targets * ~terminated - values) * ~truncated
    return advantages.detach()


def parting_ones(rules, terminated, truncated, gamma=0.99, gae_lambda=0.95):
    """Which inputs tell rules of gae_as apart, where one number is 1 and all others 0.

        parts = all_{i<j} (max |A_i - A_j| > 1e-3),   A_i by rules[i], over all steps

    The flags are given; free are the reward and the value of each row, the value of the true
    successor where an episode ends, and last_values. Where none ends, next_values continues
    values, and last_values after the last row: such a 1 stands in both.

    Args:
      rules: two names or more that gae_as takes.
      terminated: True where the task itself ended; (T, N) bool.
      truncated: True where a time limit cut the episode; (T, N) bool.
      gamma: discount per step, in [0, 1].
      gae_lambda: λ in [0, 1].

    Returns: dict of bool tensors, True where a 1 in this place tells every two of the rules
      apart: rewards, values and next_values, (T, N), the last False where no episode ends;
      and last_values, (N,).
    Raises: ValueError that names an argument if rules are fewer than two, or as gae_as.
    """
    if len(rules) < 2:
        raise ValueError(f"rules must be two at least, got {len(rules)}")
    validate.same_shape(terminated=terminated, truncated=truncated)
    steps, envs = terminated.shape
    sizes = [steps * envs] * 3 + [envs]
    probes = sum(sizes)  # as further environments, side by side

    def beside(flags):
        return flags[..., None].expand(steps, envs, probes).reshape(steps, -1)

    rewards, values, finals, last = torch.eye(probes).split(sizes)
    rewards, values, finals = (x.reshape(steps, -1) for x in (rewards, values, finals))
    last, ends = last.reshape(-1), (beside(terminated), beside(truncated))
    next_values = torch.where(ends[0] | ends[1], finals, torch.cat([values[1:], last[None]]))
    rollout = (rewards, values, next_values, last, *ends, gamma, gae_lambda)
    found = torch.stack([gae_as(rule, *rollout) for rule in rules])
    pairs = [(i, j) for j in range(len(rules)) for i in range(j)]
    gaps = torch.stack([(found[i] - found[j]).abs().amax(0) for i, j in pairs])
    parts = (gaps > 1e-3).reshape(len(pairs), envs, probes).any(1).all(0)
    rewards, values, finals, last = parts.split(sizes)
    told = {"rewards": rewards, "values": values, "next_values": finals}
    return {name: x.reshape(steps, envs) for name, x in told.items()} | {"last_values": last}


def which_gae(
    logged,
    rules,
    rewards,
    values,
    next_values,
    last_values,
    terminated,
    truncated,
    gamma=0.99,
    gae_lambda=0.95,
):
    """Which rules of gae_as can have made the advantages that a library has logged.

        max |logged - A| ≤ 1e-4 max(1, max |logged|)

    Logs are in single precision, hence the tolerance. In a rollout without time limits most
    rules agree, and all of these fit; if the library follows another rule, none does.

    Args:
      logged: advantages in units of reward; (T, N).
      rules: names that gae_as takes, in any order.
      rewards, values, next_values, last_values, terminated, truncated, gamma, gae_lambda: as
        for gae_as.

    Returns: (len(rules),) bool tensor: whether each rule fits.
    Raises: ValueError that names an argument if logged and rewards differ in shape, or as
      gae_as.
    """
    validate.same_shape(logged=logged, rewards=rewards)
    rollout = (rewards, values, next_values, last_values, terminated, truncated)
    tolerance = 1e-4 * logged.abs().max().clamp(min=1)
    gaps = [(logged - gae_as(rule, *rollout, gamma, gae_lambda)).abs().max() for rule in rules]
    return torch.stack(gaps).detach() <= tolerance.detach()


def repaired_bootstrap(
    stored_rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95
):
    """What the suspect program should have taken for advantages: those that gae_as("textbook")
    gives of the rewards as the environment paid them, each future counted once.

    Args:
      stored_rewards: as the collector of the lab has stored them, in units of reward; (T, N).
        It has added γ V(s_{t+1}) to the reward of each step that a time limit cut, and that
        was not terminated.
      values: V(s_t); (T, N).
      next_values: V of the true successor of each step; (T, N).
      terminated: True where the task itself ended; (T, N) bool.
      truncated: True where a time limit cut the episode; (T, N) bool.
      gamma: discount per step, in [0, 1].
      gae_lambda: λ in [0, 1].

    Returns: (T, N) advantages in units of reward, without a graph.
    Raises: ValueError that names an argument if shapes differ, or gamma or gae_lambda lies
      outside [0, 1].
    """
    flags = {"terminated": terminated, "truncated": truncated}
    shapes = {"stored_rewards": stored_rewards, "values": values, "next_values": next_values}
    validate.same_shape(**shapes, **flags)
    rewards = stored_rewards - gamma * next_values * (truncated & ~terminated)
    rollout = (rewards, values, next_values, next_values[-1], terminated, truncated)
    return gae_as("textbook", *rollout, gamma, gae_lambda)
