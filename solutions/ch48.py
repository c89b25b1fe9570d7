"""Reference solutions of chapter 48: the statistics of a fair comparison, censored races, what
the bug lab's buffer should keep, and a fast update of soft actor-critic.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from course_lib import validate
from course_lib.control.replay import Transitions
from solutions.ch47 import polyak_update


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


def steps_to_threshold(steps, returns, threshold):
    """How long each run took until its curve first reached a return, and infinity where it
    never did.

        s_{k-1} + (θ - R_{k-1}) / (R_k - R_{k-1}) (s_k - s_{k-1}),   k = the first with R_k ≥ θ

    A curve goes straight from one evaluation to the next. One that begins at the threshold or
    above has reached it at its first evaluation. A run that never does is not left out: it is
    censored, and would have taken longer than anybody waited.

    Taylor & Stone (2009), "time to threshold", https://www.jmlr.org/papers/v10/taylor09a.html

    Args:
      steps: s, where all runs were evaluated, in environment steps or in seconds; increasing;
        (T,).
      returns: R, what each of N runs earned there; (N, T).
      threshold: θ, in units of return; a number.

    Returns: (N,), in the units of steps and the dtype of returns.
    Raises: ValueError that names an argument if returns is not (N, T) for steps (T,), or if
      steps do not increase.
    """
    if returns.shape[1:] != steps.shape or steps.dim() != 1:
        raise ValueError(
            f"returns must be (N, T) for steps (T,), got {tuple(returns.shape)} for "
            f"{tuple(steps.shape)}"
        )
    if not (steps.diff() > 0).all():
        raise ValueError("steps must increase from one evaluation to the next")
    reached = returns >= threshold
    first = reached.int().argmax(1)  # 0 where it never is
    before = (first - 1).clamp_min(0)
    low, high = (returns.gather(1, at[:, None])[:, 0] for at in (before, first))
    share = torch.where(first > 0, (threshold - low) / (high - low), 0.0)
    crossed = steps[before] + share * (steps[first] - steps[before])
    return torch.where(reached.any(1), crossed, math.inf).to(returns.dtype)


def race_counts(ours, our_ends, theirs, their_ends):
    """How many races were won, how many lost, and of how many nobody knows, each of our runs
    against each of theirs.

        won = #{(i, j): a_i < b_j and a_i ≤ v_j},   lost = #{(i, j): b_j < a_i and b_j ≤ u_i},
        undecided = n m - won - lost

    A run that did not cross is censored: below the line up to its end, the end included, and
    unknown from there on. A race is won if ours is sure to have crossed first: theirs crossed
    later, or had not crossed by its end, and that end is not before our crossing. All other
    races are undecided. They are of three kinds: one run crossed, but after the end of a
    censored one; neither crossed, however long each was watched; both crossed at the same
    moment, and nobody is first.

    Gehan (1965), the score of a pair, https://doi.org/10.1093/biomet/52.1-2.203

    Args:
      ours: a, when each of n runs crossed, in environment steps or in seconds; infinity where
        it never did; (n,).
      our_ends: u, when each was last evaluated, in the same units; finite; (n,).
      theirs: b, of m other runs the same as ours; (m,).
      their_ends: v; (m,).

    Returns: (won, lost, undecided), 0-dim int64 tensors. Their sum is n m.
    Raises: ValueError that names an argument if ours and our_ends, or theirs and their_ends,
      differ in shape, or if a run crossed after its end.
    """
    validate.same_shape(ours=ours, our_ends=our_ends)
    validate.same_shape(theirs=theirs, their_ends=their_ends)
    for name, crossed, ends in (("ours", ours, our_ends), ("theirs", theirs, their_ends)):
        late = crossed.isfinite() & (crossed > ends)
        if late.any():
            raise ValueError(
                f"{name} must lie at or before the run's end, or be infinite, got "
                f"{crossed[late].tolist()} for ends {ends[late].tolist()}"
            )
    ours, our_ends = ours[:, None], our_ends[:, None]  # (n, 1): against (m,), all pairs
    won = ((ours < theirs) & (ours <= their_ends)).sum()
    lost = ((theirs < ours) & (theirs <= our_ends)).sum()
    return won, lost, ours.numel() * theirs.numel() - won - lost


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
