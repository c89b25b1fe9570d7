"""Reference solutions of chapter 74: behavioural cloning, from the expert's demonstrations
to the measured clone.
"""

from __future__ import annotations

import math

import torch

from course_lib import validate
from course_lib.control.demonstrations import Demonstrations


def collect_demonstrations(policy, env, num_episodes, seed):
    """Let an expert act for some episodes, and write down what it saw and what it did.

    Args:
      policy: the expert: obs (B, O) float32 tensor -> actions (B, A), or (B,) int64 for
        discrete ones. Called with B = 1.
      env: a Gymnasium environment (not a vector environment).
      num_episodes: E ≥ 1. Episode k begins with env.reset(seed=seed + k) and lasts until
        it is terminated or truncated.
      seed: of the first episode.

    Returns: Demonstrations of M steps without a graph: obs (M, O) float32, before each
      action; actions (M, A) float32 or (M,) int64, as the policy returned them;
      episode_ids (M,) int64 from 0; returns (E,) float32, undiscounted.
    Raises: ValueError that names an argument if num_episodes < 1.
    """
    validate.at_least_one(num_episodes=num_episodes)
    obs_rows, action_rows, episode_ids, returns = [], [], [], []
    for episode in range(num_episodes):
        obs, _ = env.reset(seed=seed + episode)
        total, ended = 0.0, False
        while not ended:
            # torch.tensor copies: the environment may reuse its array
            seen = torch.tensor(obs, dtype=torch.float32)
            with torch.no_grad():
                action = policy(seen.unsqueeze(0)).squeeze(0)
            obs, reward, terminated, truncated, _ = env.step(action.numpy())
            obs_rows.append(seen)
            action_rows.append(action)
            episode_ids.append(episode)
            total += float(reward)
            ended = terminated or truncated
        returns.append(total)
    return Demonstrations(
        torch.stack(obs_rows),
        torch.stack(action_rows),
        torch.tensor(episode_ids),
        torch.tensor(returns),
    )


def split_by_episode(episode_ids, fraction, generator):
    """Divide the steps of a data set into training and held-out ones, by whole episodes.

        held out of E episodes: min(max(round(fraction · E), 1), E - 1), drawn at random

    Args:
      episode_ids: which episode each step belongs to; (M,) int64, any numbers, in any
        order.
      fraction: share of the episodes to hold out, in [0, 1]. Their number is rounded (up or
        down will do), and at least one episode stays on either side.
      generator: torch.Generator, the only source of randomness.

    Returns: (train, held_out), two complementary (M,) bool masks.
    Raises: ValueError that names an argument if fraction lies outside [0, 1], or episode_ids
      has fewer than two episodes.
    """
    validate.unit_interval(fraction=fraction)
    episodes = episode_ids.unique()
    if len(episodes) < 2:
        raise ValueError(
            "episode_ids must name at least two episodes, one for either side, got "
            f"{len(episodes)}"
        )
    count = min(max(round(fraction * len(episodes)), 1), len(episodes) - 1)
    order = torch.randperm(len(episodes), generator=generator)
    held_out = torch.isin(episode_ids, episodes[order[:count]])
    return ~held_out, held_out


def behavioural_cloning_loss(logits, expert_actions):
    """How surprised a policy with discrete actions is by what the expert did.

        L = -mean(log π(a*|s)),   π(a|s) = exp(logits_a) / Σ_b exp(logits_b)

    The mean negative log-likelihood of the expert's actions; Goodfellow et al. (2016),
    section 5.5, https://www.deeplearningbook.org

    Args:
      logits: unnormalised log-probabilities of all actions; (B, A). Receives gradient.
      expert_actions: a*, the index of what the expert did; (B,) int64.

    Returns: scalar (0-dim) tensor, in nats.
    Raises: ValueError that names an argument if logits is not (B, A) or expert_actions not
      (B,).
    """
    if logits.ndim != 2 or expert_actions.shape != logits.shape[:1]:
        raise ValueError(
            "logits must be (B, A) and expert_actions (B,), got "
            f"{tuple(logits.shape)} and {tuple(expert_actions.shape)}"
        )
    return torch.nn.functional.cross_entropy(logits, expert_actions)


def gaussian_cloning_loss(mean, log_std, expert_actions):
    """How surprised a policy with normal actions is by what the expert did.

        L = mean over B of Σ_i (½ ((a*_i - μ_i) / σ_i)² + log σ_i + ½ log 2π)

    The mean negative log-likelihood of the expert's actions; Goodfellow et al. (2016),
    section 5.5, https://www.deeplearningbook.org

    Args:
      mean: μ, the policy's mean actions; (B, A). Receives gradient.
      log_std: log σ, (A,) for the same σ in every state, or (B, A). Receives gradient.
      expert_actions: a*, what the expert did; (B, A). No gradient.

    Returns: scalar (0-dim) tensor, in nats.
    Raises: ValueError that names an argument if mean and expert_actions differ in shape, or
      log_std is neither (A,) nor (B, A).
    """
    validate.same_shape(mean=mean, expert_actions=expert_actions)
    if log_std.shape not in (mean.shape, mean.shape[-1:]):
        raise ValueError(
            f"log_std must be (A,) or (B, A) for mean {tuple(mean.shape)}, got "
            f"{tuple(log_std.shape)}"
        )
    surprise = (
        ((expert_actions.detach() - mean) / log_std.exp()).square() / 2
        + log_std
        + math.log(2 * math.pi) / 2
    )
    return surprise.sum(-1).mean()


def train_bc(
    network,
    loss_fn,
    obs,
    actions,
    num_steps=1000,
    batch_size=128,
    learning_rate=3e-3,
    generator=None,
):
    """Behavioural cloning: fit a network to the expert's actions, by gradient descent.

    Pomerleau (1991), https://doi.org/10.1162/neco.1991.3.1.88

    Args:
      network: torch.nn.Module, trained in place; loss_fn takes its output for obs (B, O).
      loss_fn: (network's output, actions of the batch) -> scalar tensor.
      obs, actions: of the demonstrations; M rows each.
      num_steps: gradient steps.
      batch_size: rows of a minibatch, drawn at random (all rows if there are no more).
      learning_rate: the optimiser's step size; Adam is a good choice.
      generator: torch.Generator for the minibatches, or None for PyTorch's own.

    Returns: (num_steps,) tensor without a graph: each minibatch's loss before its step.
    Raises: ValueError that names an argument if obs and actions differ in their number of
      rows, or num_steps < 1.
    """
    validate.at_least_one(num_steps=num_steps)
    validate.same_length(obs=obs, actions=actions)
    optimizer = torch.optim.Adam(network.parameters(), lr=learning_rate)
    losses = []
    for _ in range(num_steps):
        rows = torch.randperm(len(obs), generator=generator)[:batch_size]
        loss = loss_fn(network(obs[rows]), actions[rows])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.detach())
    return torch.stack(losses)


def evaluate(policy, env, num_episodes, seed):
    """Let a policy act for some episodes, and report the return of each.

    Args:
      policy: obs (B, O) float32 tensor -> actions (B, A), or (B,) int64 for discrete ones.
        Called with B = 1.
      env: a Gymnasium environment (not a vector environment).
      num_episodes: E ≥ 1. Episode k begins with env.reset(seed=seed + k) and lasts until
        it is terminated or truncated.
      seed: of the first episode; policies evaluated with one seed meet the same starts.

    Returns: (E,) float32 undiscounted returns, without a graph.
    Raises: ValueError that names an argument if num_episodes < 1.
    """
    return collect_demonstrations(policy, env, num_episodes, seed).returns


def state_shift(expert_obs, agent_obs):
    """How far the states that an agent visits lie from those that the expert visited.

        2 E|X - Y| - E|X - X'| - E|Y - Y'|,   X = expert_obs / σ,   Y = agent_obs / σ,
        σ = std(expert_obs)

    The squared energy distance, with means over all ordered pairs (i = j included) and σ
    the expert's standard deviation in each dimension. Székely and Rizzo (2013),
    https://doi.org/10.1016/j.jspi.2013.03.018

    Args:
      expert_obs: (N, O); no dimension is constant.
      agent_obs: (M, O).

    Returns: scalar (0-dim) tensor, at least 0 (up to rounding); 0 for equal samples.
    Raises: ValueError that names an argument if the two are not matrices of one width.
    """
    if (
        expert_obs.ndim != 2
        or agent_obs.ndim != 2
        or expert_obs.shape[1] != agent_obs.shape[1]
    ):
        raise ValueError(
            "expert_obs must be (N, O) and agent_obs (M, O), got "
            f"{tuple(expert_obs.shape)} and {tuple(agent_obs.shape)}"
        )
    scale = expert_obs.std(0)
    x, y = expert_obs / scale, agent_obs / scale

    def mean_distance(a, b):
        # a thousand rows at a time, and no matrix product, which would lose the digits of
        # small distances
        rows = [
            torch.cdist(block, b, compute_mode="donot_use_mm_for_euclid_dist").mean(1)
            for block in a.split(1000)
        ]
        return torch.cat(rows).mean()

    return 2 * mean_distance(x, y) - mean_distance(x, x) - mean_distance(y, y)


def dagger_round(clone, expert, env, shown, num_episodes, seed):
    """One round of dataset aggregation: the clone acts, the expert says what it would have
    done, and both sets of pairs are kept.

    Algorithm 3.1 of Ross et al. (2011), https://arxiv.org/abs/1011.0686, where the clone
    alone acts (β = 0). It does not train: train_bc does, on what is returned.

    Args:
      clone: the policy that acts: obs (B, O) float32 tensor -> actions (B, A), or (B,)
        int64 for discrete ones. Called with B = 1.
      expert: the policy that is asked, likewise, for any B. Its actions are not executed.
      env: a Gymnasium environment (not a vector environment).
      shown: Demonstrations of M steps of E episodes, numbered 0 to E - 1; left as they are.
      num_episodes: ≥ 1, of the clone. Episode k begins with env.reset(seed=seed + k) and
        lasts until it is terminated or truncated.
      seed: of the first new episode.

    Returns: Demonstrations without a graph. First the rows of `shown`, then the new ones, in
      order of time: obs, what the clone saw; actions, the expert's for them, as it returned
      them; episode_ids, from E on; returns, those shown, then what the clone earned.
    Raises: ValueError that names an argument if num_episodes < 1.
    """
    flown = collect_demonstrations(clone, env, num_episodes, seed)
    with torch.no_grad():
        answers = expert(flown.obs)
    return Demonstrations(
        torch.cat([shown.obs, flown.obs]),
        torch.cat([shown.actions, answers]),
        torch.cat([shown.episode_ids, flown.episode_ids + len(shown.returns)]),
        torch.cat([shown.returns, flown.returns]),
    )


def repaired_pairs(obs, actions, episode_ids):
    """The pairs of observation and action that can be saved from the suspect's log.

    Args:
      obs: as logged; (M, O).
      actions: as logged; (M, A).
      episode_ids: (M,) int64; the steps of an episode stand together and in order of time.

    Returns: (obs, actions), (K, O) and (K, A): row by row what the driver saw and what it
      did then, for all steps of which the log holds both, in their order.
    Raises: ValueError that names an argument if the three differ in their number of rows.
    """
    validate.same_length(obs=obs, actions=actions, episode_ids=episode_ids)
    same_episode = episode_ids[1:] == episode_ids[:-1]
    return obs[:-1][same_episode], actions[1:][same_episode]
