"""Reference solutions of chapter 45: PPO, from the log-probability of an action to an
agent that lands.
"""

from __future__ import annotations

import math
import time

import numpy as np
import torch

from course_lib import validate
from course_lib.control.policies import Adam, Categorical, policy_for
from course_lib.control.ppo import Batch
from course_lib.control.rollouts import (
    EpisodeReturns,
    Rollout,
    require_same_step_autoreset,
    true_next_obs,
)
from course_lib.seeding import seed_everything
from solutions.ch44 import (
    compute_gae,
    explained_variance,
    lambda_returns,
    normalize_advantages,
)


def gaussian_log_prob(mean, log_std, actions):
    """Log-density of actions under independent normal distributions, one for each component.

        log π(a|s) = -Σ_i [ (a_i - μ_i)² / (2 σ_i²) + log σ_i + ½ log 2π ],   σ = exp(log_std)

    Args:
      mean: μ(s); (B, A). Receives gradient.
      log_std: log σ, the same in every state, (A,), or one for each, (B, A). Receives
        gradient.
      actions: as sampled, before clipping to the bounds; (B, A).

    Returns: (B,) nats, summed over the components.
    Raises: ValueError that names an argument if the shapes of mean and actions differ, or
      log_std is neither (A,) nor (B, A).
    """
    validate.same_shape(mean=mean, actions=actions)
    validate.same_shape(
        mean=mean,
        log_std=log_std.expand_as(mean) if log_std.shape == mean.shape[-1:] else log_std,
    )
    scaled = (actions.detach() - mean) * (-log_std).exp()
    return -(0.5 * scaled.square() + log_std + 0.5 * math.log(2 * math.pi)).sum(-1)


def gaussian_entropy(log_std):
    """Differential entropy of independent normal distributions, one for each component.

        H = Σ_i [ log σ_i + ½ log 2πe ],   σ = exp(log_std)

    Unlike the entropy of discrete actions it may be negative.

    Args:
      log_std: log σ; (A,) or (B, A). Receives gradient.

    Returns: nats, summed over the components: () for (A,), (B,) for (B, A).
    """
    return (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum(-1)


def evaluate_actions(policy, obs, actions):
    """What a policy now thinks of actions: their log-probabilities, its entropy, and values.

    Args:
      policy: called with obs, returns (Gaussian or Categorical, values).
      obs: (B, *obs).
      actions: (B, A) for a Gaussian; (B,) whole numbers for a Categorical.

    Returns: (log_probs (B,), entropy (B,) or (), values (B,)), all with a graph.
    """
    distribution, values = policy(obs)
    if isinstance(distribution, Categorical):
        log_probs = distribution.logits.log_softmax(-1)
        chosen = log_probs.gather(-1, actions.long().unsqueeze(-1)).squeeze(-1)
        return chosen, -(log_probs.exp() * log_probs).sum(-1), values
    log_probs = gaussian_log_prob(distribution.mean, distribution.log_std, actions)
    return log_probs, gaussian_entropy(distribution.log_std), values


def collect_rollout(envs, policy, num_steps, obs, generator):
    """Step every environment `num_steps` times with sampled actions.

    The actions that are recorded are those that were sampled; the environments get them
    clipped to the bounds of their action space.

    Args:
      envs: a vector environment of N environments with same-step autoreset.
      policy: `policy.act(obs, generator)` samples actions (N, *act) for obs (N, *obs).
      num_steps: T.
      obs: (N, *obs), what the environments show now: from `envs.reset`, or `last_obs` of
        the rollout before.
      generator: torch generator, the only source of the actions' randomness.

    Returns: Rollout of (T, N) steps, float32; `next_obs` is the true successor of each
      step, also where an episode ends; `last_obs` is what the environments show
      afterwards.
    Raises: ValueError that names an argument if envs resets in another way than in the same
      step.
    """
    require_same_step_autoreset(envs)
    bounds = envs.single_action_space
    steps = []
    for _ in range(num_steps):
        before = torch.as_tensor(obs, dtype=torch.float32)
        actions = policy.act(before, generator)
        clipped = (
            actions.numpy()
            if actions.dtype == torch.int64
            else actions.numpy().clip(bounds.low, bounds.high)
        )
        obs, rewards, terminated, truncated, info = envs.step(clipped)
        steps.append(
            (before, actions, rewards, true_next_obs(obs, info), terminated, truncated)
        )
    columns = [torch.as_tensor(np.stack(column)) for column in zip(*steps, strict=True)]
    columns.append(torch.as_tensor(obs))
    return Rollout(
        *(column.float() if column.is_floating_point() else column for column in columns)
    )


def minibatches(batch_size, minibatch_size, generator):
    """The minibatches of one epoch: every index once, in a fresh random order.

        order[k m : (k + 1) m],   k = 0, 1, …,   m = minibatch_size,
        order = a random permutation of 0, …, batch_size - 1

    Args:
      batch_size: number of samples, at least 1.
      minibatch_size: samples in a minibatch, at least 1; the last one may be shorter.
      generator: torch generator, the only source of the order.

    Returns: iterator of int64 index tensors.
    Raises: ValueError that names an argument if batch_size or minibatch_size is less than 1.
    """
    for name, value in (("batch_size", batch_size), ("minibatch_size", minibatch_size)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    return iter(torch.randperm(batch_size, generator=generator).split(minibatch_size))


def ppo_loss(
    log_probs,
    old_log_probs,
    advantages,
    values,
    returns,
    entropy,
    clip_range,
    vf_coef,
    ent_coef,
):
    """PPO's loss: the clipped surrogate, the critic's squared error, and a bonus for entropy.

        L = -mean(min(ρ A, clip(ρ, 1 - ε, 1 + ε) A)) + c_v mean((V - R)²) - c_e mean(H)

    Schulman et al. (2017), eq. 9, https://arxiv.org/abs/1707.06347

    Args:
      log_probs: log π(a|s) of the current policy, in nats; (B,). Receives gradient.
      old_log_probs: the same under the policy that acted; (B,). No gradient.
      advantages: (B,), taken as given. No gradient.
      values: V(s) of the current critic, in units of reward; (B,). Receives gradient.
      returns: the critic's targets, in units of reward; (B,). No gradient.
      entropy: of the current policy, in nats; (B,) or (). Receives gradient.
      clip_range: ε ≥ 0, dimensionless; infinity means no clipping.
      vf_coef: c_v, the weight of the critic's error.
      ent_coef: c_e, the weight of the entropy.

    Returns: (scalar loss, metrics), where metrics holds policy_loss, value_loss, entropy,
      approx_kl and clip_fraction, and nothing else, as 0-dim tensors without a graph.
    Raises: ValueError that names an argument if the shapes of all but entropy differ, entropy
      is neither (B,) nor (), or clip_range < 0.
    """
    validate.same_shape(
        log_probs=log_probs,
        old_log_probs=old_log_probs,
        advantages=advantages,
        values=values,
        returns=returns,
    )
    if entropy.dim():
        validate.same_shape(entropy=entropy, log_probs=log_probs)
    validate.non_negative(clip_range=clip_range)
    weights = advantages.detach()
    log_ratio = log_probs - old_log_probs.detach()
    ratio = log_ratio.exp()
    clipped_ratio = ratio.clamp(1 - clip_range, 1 + clip_range)
    policy_loss = -torch.minimum(ratio * weights, clipped_ratio * weights).mean()
    value_loss = (values - returns.detach()).square().mean()
    loss = policy_loss + vf_coef * value_loss - ent_coef * entropy.mean()
    with torch.no_grad():
        metrics = {
            "policy_loss": policy_loss.detach(),
            "value_loss": value_loss.detach(),
            "entropy": entropy.detach().mean(),
            "approx_kl": (ratio - 1 - log_ratio).mean(),
            "clip_fraction": ((ratio - 1).abs() > clip_range).to(ratio.dtype).mean(),
        }
    return loss, metrics


def torch_ppo_steps(tensors, batch, settings, num_steps=1):
    """PPO's gradient steps with an agent of torch.nn and torch.optim.

    A torch.nn.Module of two networks that share nothing, obs (B, O) → mean (B, A) and
    obs (B, O) → V (B,), with a tanh behind each of their two hidden layers and nothing behind
    the last, and of log σ, (A,), which is learned, too. Each step goes down the loss of the
    batch, all parameters θ at once:

        g = ∂L/∂θ,   θ ← Adam(θ, g min(1, max_grad_norm / ‖g‖))

    Schulman et al. (2017), eq. 9, https://arxiv.org/abs/1707.06347; Kingma and Ba (2015),
    algorithm 1, https://arxiv.org/abs/1412.6980

    Args:
      tensors: where the weights begin, by name, not changed: actor.0.weight (O, H),
        actor.0.bias (H,), actor.1.weight (H, H), actor.1.bias, actor.out.weight (H, A),
        actor.out.bias, the same for critic with one output, and log_std (A,). A layer
        computes inputs @ weight + bias.
      batch: Batch of B rows, for every step all of them.
      settings: PPOSettings: clip_range, vf_coef, ent_coef, max_grad_norm, learning_rate.
        Adam's ε is 1e-5.
      num_steps: K, at least 1.

    Returns: (losses, weights), without a graph: the loss before each step, (K,), and the
      weights after the last, a dict of the names and shapes of `tensors`.
    Raises: ValueError that names num_steps if it is less than 1.
    """
    if num_steps < 1:
        raise ValueError(f"num_steps must be at least 1, got {num_steps}")

    class ActorCritic(torch.nn.Module):
        def __init__(self, obs_dim, hidden, action_dim):
            super().__init__()
            self.actor, self.critic = (
                torch.nn.ModuleDict(
                    {
                        "0": torch.nn.Linear(obs_dim, hidden),
                        "1": torch.nn.Linear(hidden, hidden),
                        "out": torch.nn.Linear(hidden, outputs),
                    }
                )
                for outputs in (action_dim, 1)
            )
            self.log_std = torch.nn.Parameter(torch.zeros(action_dim))

        def forward(self, obs):
            outputs = []
            for network in (self.actor, self.critic):
                hidden = network["1"](network["0"](obs).tanh()).tanh()
                outputs.append(network["out"](hidden))
            mean, values = outputs
            return mean, values.squeeze(-1)

    def turned(weights):
        """torch.nn.Linear keeps its weight as (outputs, inputs)."""
        return {name: (x.T if x.dim() == 2 else x).clone() for name, x in weights.items()}

    obs_dim, hidden = tensors["actor.0.weight"].shape
    agent = ActorCritic(obs_dim, hidden, len(tensors["log_std"]))
    agent.load_state_dict(turned(tensors))
    optimizer = torch.optim.Adam(agent.parameters(), lr=settings.learning_rate, eps=1e-5)
    losses = []
    for _ in range(num_steps):
        mean, values = agent(batch.obs)
        loss, _ = ppo_loss(
            gaussian_log_prob(mean, agent.log_std, batch.actions),
            batch.old_log_probs,
            batch.advantages,
            values,
            batch.returns,
            gaussian_entropy(agent.log_std),
            settings.clip_range,
            settings.vf_coef,
            settings.ent_coef,
        )
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(agent.parameters(), settings.max_grad_norm)
        optimizer.step()
        losses.append(loss.detach())
    return torch.stack(losses), turned(agent.state_dict())


def ppo_update(policy, optimizer, batch, settings, generator):
    """Improve a policy, in place, by some epochs of minibatches over one rollout.

    Schulman et al. (2017), algorithm 1, https://arxiv.org/abs/1707.06347

    Args:
      policy: what `evaluate_actions` takes; its parameters are `policy.weights`.
      optimizer: `optimizer.step(policy, max_grad_norm)` clips the gradient that
        `backward()` left in `policy.weights.grad`, and makes one step with it.
      batch: Batch of B steps; `batch[indices]` is a minibatch. Advantages are taken as
        given.
      settings: PPOSettings: num_epochs, minibatch_size, clip_range, vf_coef, ent_coef,
        max_grad_norm, and target_kl: the update ends after an epoch whose mean approx_kl
        over its minibatches is larger.
      generator: torch generator, the only source of the minibatches' order.

    Returns: the metrics of ppo_loss, each averaged over all minibatches: a dict of 0-dim
      tensors.
    """
    history = []
    for _ in range(settings.num_epochs):
        epoch = []
        for indices in minibatches(len(batch), settings.minibatch_size, generator):
            rows = batch[indices]
            log_probs, entropy, values = evaluate_actions(policy, rows.obs, rows.actions)
            loss, metrics = ppo_loss(
                log_probs,
                rows.old_log_probs,
                rows.advantages,
                values,
                rows.returns,
                entropy,
                settings.clip_range,
                settings.vf_coef,
                settings.ent_coef,
            )
            policy.weights.grad = None
            loss.backward()
            optimizer.step(policy, settings.max_grad_norm)
            epoch.append(metrics)
        history += epoch
        if (
            torch.stack([metrics["approx_kl"] for metrics in epoch]).mean()
            > settings.target_kl
        ):
            break
    return {
        name: torch.stack([metrics[name] for metrics in history]).mean() for name in history[0]
    }


def estimate(policy, rollout, settings, reward=None):
    """Turn a rollout into a batch to learn from, before the policy changes.

    Args:
      policy: the policy that acted.
      rollout: Rollout of (T, N) steps.
      settings: PPOSettings: gamma, gae_lambda, reward_scale, normalize_advantages.
      reward: `reward(obs, actions, next_obs) -> (T, N)` in place of the environments'
        rewards.

    Returns: (Batch of T N rows, explained variance of the values).
    """
    rewards = (
        rollout.rewards
        if reward is None
        else reward(rollout.obs, rollout.actions, rollout.next_obs)
    )
    with torch.no_grad():
        log_probs, _, values = evaluate_actions(
            policy, rollout.obs.flatten(0, 1), rollout.actions.flatten(0, 1)
        )
    values, next_values = values.view_as(rewards), policy.value(rollout.next_obs)
    advantages = compute_gae(
        settings.reward_scale * rewards,
        values,
        next_values,
        rollout.terminated,
        rollout.truncated,
        settings.gamma,
        settings.gae_lambda,
    )
    returns = lambda_returns(advantages, values)
    explained = explained_variance(values, returns)
    if settings.normalize_advantages:
        advantages = normalize_advantages(advantages)
    batch = Batch(
        rollout.obs.flatten(0, 1),
        rollout.actions.flatten(0, 1),
        log_probs,
        advantages.flatten(),
        returns.flatten(),
    )
    return batch, explained


def train_ppo(envs, settings, seed=0, policy=None, reward=None, log=None, update=None):
    """Train a policy by PPO: collect, estimate, update, log.

    Schulman et al. (2017), algorithm 1, https://arxiv.org/abs/1707.06347

    Args:
      envs: a vector environment of N environments with same-step autoreset.
      settings: PPOSettings.
      seed: of the environments, the new policy's weights, the actions and the
        minibatches: two runs with one seed are equal bit for bit.
      policy: the policy to train, in place; None makes a new one.
      reward: `reward(obs, actions, next_obs) -> (T, N)` to learn from in place of the
        environments' rewards; what is logged as return stays the environments'.
      log: called after each update with a row, a dict of floats: env_steps, episodes (that
        ended in this rollout), mean_return (of those; NaN if none), explained_variance,
        learning_rate, seconds (since the start), and the metrics of ppo_update.
      update: what is called in place of ppo_update, with the same arguments.

    Returns: the trained policy.
    """
    start, generator = time.perf_counter(), seed_everything(seed)
    if policy is None:
        policy = policy_for(envs, settings.hidden, settings.log_std, seed)
    optimizer, episode_returns = Adam(), EpisodeReturns(envs.num_envs)
    obs, env_steps = envs.reset(seed=seed)[0], 0
    while env_steps < settings.total_steps:
        left = 1 - env_steps / settings.total_steps if settings.anneal else 1.0
        optimizer.learning_rate = settings.learning_rate * left

        rollout = collect_rollout(envs, policy, settings.num_steps, obs, generator)
        batch, explained = estimate(policy, rollout, settings, reward)
        metrics = (update or ppo_update)(policy, optimizer, batch, settings, generator)
        if settings.normalize_obs:
            policy.observe(batch.obs)

        obs, env_steps = rollout.last_obs, env_steps + len(batch)
        finished = episode_returns.add(rollout)
        if log is not None:
            log(
                {
                    "env_steps": env_steps,
                    "episodes": len(finished),
                    "mean_return": sum(finished) / len(finished) if finished else math.nan,
                    "explained_variance": explained.item(),
                    "learning_rate": optimizer.learning_rate,
                    "seconds": time.perf_counter() - start,
                }
                | {name: metric.item() for name, metric in metrics.items()}
            )
    return policy


def tuned_settings():
    """Settings with which PPO learns, within 4,096 steps, to hold a drone in strong gusts.

    They are found by trying. What they do not name stays as it is in
    course_lib.control.tuning.START.

    Returns: dict of numbers by the names of settings. Which may be tuned, and from where to
      where, says course_lib.control.tuning.RANGES.
    """
    return {
        "num_steps": 16,  # 16 updates in place of two
        "minibatch_size": 64,  # with eight epochs, 32 gradient steps each
        "num_epochs": 8,
        "learning_rate": 1e-3,
        "gamma": 0.95,  # sees 7 steps ahead: a gust is put right in less
        "gae_lambda": 0.9,
        "clip_range": 0.2,  # 0.05 silences what these steps move
        "ent_coef": 0.0,
    }


def repaired_rollout(envs, policy, num_steps, obs, generator):
    """What the suspect program of the bug lab should have recorded.

    Args and returns are those of collect_rollout. `envs` may hand out one array again and
    again, and overwrite it at every step (`copy=False` in Gymnasium's vector environments).

    Args:
      envs: a vector environment of N environments with same-step autoreset.
      policy: `policy.act(obs, generator)` samples actions (N, *act) for obs (N, *obs).
      num_steps: T.
      obs: (N, *obs), what the environments show now.
      generator: torch generator, the only source of the actions' randomness.

    Returns: Rollout of (T, N) steps, float32, that no later step of envs changes.
    """
    bounds = envs.single_action_space
    steps = []
    for _ in range(num_steps):
        # the next step overwrites what obs holds
        before = torch.as_tensor(obs, dtype=torch.float32).clone()
        actions = policy.act(before, generator)
        obs, rewards, terminated, truncated, info = envs.step(
            actions.numpy().clip(bounds.low, bounds.high)
        )
        steps.append(
            (before, actions, rewards, true_next_obs(obs, info), terminated, truncated)
        )
    columns = [torch.as_tensor(np.stack(column)) for column in zip(*steps, strict=True)]
    columns.append(torch.as_tensor(obs).clone())
    return Rollout(
        *(column.float() if column.is_floating_point() else column for column in columns)
    )


def fast_ppo_update(policy, optimizer, batch, settings, generator):
    """What ppo_update does, up to rounding, in less time: `tools/bench_ppo.py` measures it.

    With 64 samples in a minibatch, PyTorch's bookkeeping takes far longer than the
    arithmetic. So the loss is differentiated on paper, and NumPy does the sums:

        ∂L/∂log π = -ρ A / B where the clip does not bind, else 0
        ∂L/∂V = 2 c_v (V - R) / B,   ∂L/∂H = -c_e

    The first is in `clipped_surrogate_gradient`; the chain rule through log π and H in
    `gaussian_head` and `categorical_head`, through the networks in `policy.backward`.

    Args, returns: as ppo_update.
    """
    columns = [
        column.numpy()
        for column in (
            batch.obs,
            batch.actions,
            batch.old_log_probs,
            batch.advantages,
            batch.returns,
        )
    ]
    columns[0] = policy.normalize(columns[0])
    head = categorical_head if policy.discrete else gaussian_head
    history: list[list[float]] = []
    # one memory: what `backward` writes is what `step` reads
    policy.weights.grad = torch.from_numpy(policy.gradient)
    for _ in range(settings.num_epochs):
        epoch = []
        for indices in minibatches(len(batch), settings.minibatch_size, generator):
            rows = indices.numpy()
            obs, actions, old_log_probs, advantages, returns = (
                column[rows] for column in columns
            )
            actor, critic = policy.forward("actor", obs), policy.forward("critic", obs)
            log_probs, entropy, pull_back = head(policy, actor[-1], actions)
            (policy_loss, approx_kl, clip_fraction), d_log_probs = clipped_surrogate_gradient(
                log_probs, old_log_probs, advantages, settings.clip_range
            )
            errors = critic[-1] - returns[:, None]
            policy.backward("actor", actor, pull_back(d_log_probs, -settings.ent_coef))
            policy.backward("critic", critic, (2 * settings.vf_coef / len(errors)) * errors)
            optimizer.step(policy, settings.max_grad_norm)
            epoch.append(
                [
                    policy_loss,
                    np.vdot(errors, errors) / len(errors),
                    entropy,
                    approx_kl,
                    clip_fraction,
                ]
            )
        history += epoch
        if np.mean([metrics[3] for metrics in epoch]) > settings.target_kl:
            break
    names = "policy_loss", "value_loss", "entropy", "approx_kl", "clip_fraction"
    return dict(
        zip(names, torch.from_numpy(np.mean(history, axis=0, dtype=np.float32)), strict=True)
    )


def clipped_surrogate_gradient(log_probs, old_log_probs, advantages, clip_range):
    """The clipped surrogate loss, and its derivative by log_probs, on arrays (B,).

    Where the minimum picks the clipped term, the ratio has left the interval, and the
    term is a constant; elsewhere ∂(ρ A) / ∂log π = ρ A.

    Returns: ((policy_loss, approx_kl, clip_fraction), derivative (B,)).
    """
    log_ratio = log_probs - old_log_probs
    ratio = np.exp(log_ratio)
    gains, share = ratio * advantages, 1 / len(ratio)
    clipped_gains = np.minimum(np.maximum(ratio, 1 - clip_range), 1 + clip_range) * advantages
    outside = np.count_nonzero(np.abs(ratio - 1) > clip_range)
    metrics = (
        -share * np.minimum(gains, clipped_gains).sum(),
        share * (ratio - 1 - log_ratio).sum(),
        share * outside,
    )
    return metrics, np.where(gains <= clipped_gains, gains, 0) * -share


def gaussian_head(policy, mean, actions):
    """Log-probabilities (B,), mean entropy, and the chain rule through both.

    Returns: (log_probs, entropy, pull_back), where pull_back(d_log_probs (B,), d_entropy)
      gives the gradient of the mean, (B, A), and leaves that of log_std in the policy.
    """
    log_std = policy.arrays["log_std"]
    inverse = np.exp(-log_std)
    scaled = (actions - mean) * inverse
    squares = scaled * scaled
    constant = log_std.sum() + 0.5 * math.log(2 * math.pi) * len(log_std)

    def pull_back(d_log_probs, d_entropy):
        policy.gradients["log_std"][:] = d_log_probs @ (squares - 1) + d_entropy
        return d_log_probs[:, None] * scaled * inverse

    return -0.5 * squares.sum(1) - constant, constant + 0.5 * len(log_std), pull_back


def categorical_head(policy, logits, actions):
    """The same for discrete actions: pull_back gives the gradient of the logits."""
    shifted = logits - logits.max(1, keepdims=True)
    log_all = shifted - np.log(np.exp(shifted).sum(1, keepdims=True))
    probs, rows = np.exp(log_all), np.arange(len(logits))
    entropies = -(probs * log_all).sum(1)

    def pull_back(d_log_probs, d_entropy):
        gradient = (
            -(d_log_probs[:, None] + (d_entropy / len(rows)) * (log_all + entropies[:, None]))
            * probs
        )
        gradient[rows, actions] += d_log_probs
        return gradient

    return log_all[rows, actions], entropies.mean(), pull_back
