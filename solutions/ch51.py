"""Reference solutions of chapter 51: learning a model of the world, imagining with it, and
measuring where it fails.
"""

from __future__ import annotations

import math

import torch

from course_lib import validate


def gaussian_nll(mean, log_var, targets):
    """Negative log-likelihood of an ensemble of models that each predict a normal
    distribution.

        L = mean(½ [log σ² + (y - μ)² / σ² + log 2π]),   σ² = exp(log_var)

    over members, samples and dimensions; so each member learns from its own loss alone, up
    to a factor 1/E.
    Chua et al. (2018), section 4, https://arxiv.org/abs/1805.12114

    Args:
      mean: μ, the prediction of each of E members; (E, B, D). Receives gradient.
      log_var: log σ², its uncertainty; (E, B, D). Receives gradient.
      targets: y, what happened; (E, B, D) if each member sees samples of its own, or
        (B, D) for all of them. No gradient.

    Returns: scalar tensor, in nats.
    Raises: ValueError that names an argument if the shapes of mean and log_var differ, or that
      of targets is neither theirs nor theirs without the first axis.
    """
    validate.same_shape(mean=mean, log_var=log_var)
    targets = targets.detach()
    validate.same_shape(
        mean=mean,
        targets=targets.expand_as(mean) if targets.shape == mean.shape[1:] else targets,
    )
    return (
        0.5
        * (
            log_var + (targets - mean).square() * (-log_var).exp() + math.log(2 * math.pi)
        ).mean()
    )


def imagine(model, policy, start_obs, horizon, generator):
    """Let a policy act in a model instead of the world.

    From each start one trajectory of `horizon` steps. Where the model says that one ends,
    its `continues` are 0 from then on; what is written into its other entries after the
    end does not matter.

    Args:
      model: `model(obs, actions, generator) -> (next_obs, rewards, continues)` with
        (B, O), (B,) and (B,): continues is 1 where the trajectory goes on, 0 where the
        step ended it.
      policy: `policy(obs, generator) -> actions` (B, A).
      start_obs: (B, O).
      horizon: H ≥ 1, steps.
      generator: torch generator, handed to the policy and to the model. At each step the
        policy is called once, then the model once, for the whole batch.

    Returns: dict of obs (H + 1, B, O), which begins with start_obs; actions (H, B, A),
      rewards (H, B), and continues (H, B).
    """
    dream: dict[str, list] = {
        "obs": [start_obs],
        "actions": [],
        "rewards": [],
        "continues": [],
    }
    alive = torch.ones_like(start_obs[:, 0])
    for _ in range(horizon):
        actions = policy(dream["obs"][-1], generator)
        next_obs, rewards, goes_on = model(dream["obs"][-1], actions, generator)
        alive = alive * goes_on
        for name, entry in {
            "obs": next_obs,
            "actions": actions,
            "rewards": rewards,
            "continues": alive,
        }.items():
            dream[name].append(entry)
    return {name: torch.stack(column) for name, column in dream.items()}


def dreamer_lambda_returns(rewards, values, continues, gamma, lam):
    """λ-returns of imagined trajectories, through which Dreamer's policy learns.

        R_t = r_t + γ c_t [(1 - λ) v_t + λ R_{t+1}],   R_{H-1} = r_{H-1} + γ c_{H-1} v_{H-1}

    Hafner et al. (2021), eq. 4, https://arxiv.org/abs/2010.02193; here v_t stands for the
    value of the state that r_t led to.

    Args:
      rewards: r; (H, B). Receives gradient.
      values: v, where values[t] belongs to the state after step t; (H, B). Receives
        gradient.
      continues: c, in [0, 1]: 0 where step t ended the trajectory; (H, B).
      gamma: γ, in [0, 1].
      lam: λ, in [0, 1].

    Returns: (H, B), in units of reward.
    Raises: ValueError that names an argument if the shapes differ, or gamma or lam is outside
      [0, 1].
    """
    validate.same_shape(rewards=rewards, values=values, continues=continues)
    validate.unit_interval(gamma=gamma, lam=lam)
    returns, following = [], values[-1]
    for reward, value, goes_on in zip(
        rewards.flip(0), values.flip(0), continues.flip(0), strict=True
    ):
        following = reward + gamma * goes_on * ((1 - lam) * value + lam * following)
        returns.append(following)
    return torch.stack(returns).flip(0)


def model_error_by_horizon(model, obs, actions, generator):
    """How far a model's prediction is off, the further it looks ahead.

        e_h = √ mean((ŝ_h - s_h)²),   ŝ_0 = s_0,   ŝ_{h+1} from model(ŝ_h, a_h)

    The model gets the actions that were really taken, and never a real observation after
    the first. The mean is over samples and components.

    Args:
      model: as in `imagine`; whether it thinks that a trajectory ended does not matter.
      obs: real trajectories, none of which ends; (H + 1, B, O).
      actions: (H, B, A).
      generator: torch generator, handed to the model, which is called once for each step.

    Returns: (H,), for h = 1 to H, in units of the observations, without a graph.
    Raises: ValueError that names an argument if obs is not one step longer than actions, or
      their batches differ.
    """
    if len(obs) != len(actions) + 1 or obs.shape[1] != actions.shape[1]:
        raise ValueError(
            "obs must have one step more than actions and the same batch, got obs "
            f"{tuple(obs.shape)}, actions {tuple(actions.shape)}"
        )
    predicted, errors = obs[0], []
    with torch.no_grad():
        for real, taken in zip(obs[1:], actions, strict=True):
            predicted, _, _ = model(predicted, taken, generator)
            errors.append((predicted - real).square().mean().sqrt())
    return torch.stack(errors)


def repaired_next_obs(network, obs, actions, seen):
    """Where the model of the suspect planner should have said that each step leads.

    The network was trained on the steps `seen`: each component of their observations and
    actions was brought to mean 0 and standard deviation 1, and so was each component of the
    change of the observation, which it learned to predict.

    Args:
      network: takes (B, O + A), scaled observations with scaled actions behind them, and
        gives scaled changes (B, O).
      obs: (B, O), in units of observations.
      actions: (B, A), in units of actions.
      seen: dict of obs (N, O), actions (N, A) and next_obs (N, O), in the same units; N ≥ 2,
        and no component is constant.

    Returns: next_obs, (B, O), in units of observations. B may be 1.
    Raises: ValueError that names an argument if obs and actions have different batches.
    """
    if len(obs) != len(actions):
        raise ValueError(
            f"obs and actions must have the same batch, got {len(obs)} and {len(actions)} rows"
        )
    learned_from = torch.cat([seen["obs"], seen["actions"]], -1)
    changes = seen["next_obs"] - seen["obs"]
    inputs = (torch.cat([obs, actions], -1) - learned_from.mean(0)) / learned_from.std(0)
    return obs + changes.mean(0) + changes.std(0) * network(inputs)
