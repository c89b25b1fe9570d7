"""Checks of chapter 44: cases, named misconceptions and correct variants for GAE and its neighbours."""

from __future__ import annotations

import math

import numpy as np
import torch

from autograder.authoring import wild
from autograder.authoring.parts import (
    METRIC,
    NUMBER,
    after,
    bad_input_accepted,
    drawing,
    dtype_lost,
    in_place,
    integers,
    normal,
    number,
    one_shape,
    python_float,
    refused,
    replaced,
    reshaped,
    satisfies,
    versions_of,
    without,
    wrong,
)
from autograder.authoring.spec import Case, Exercise, Misconception
from solutions import ch44

FLOATS = ("rewards", "values", "next_values")
ROLLOUT = (*FLOATS, "terminated", "truncated")
PAIR = ("advantages", "values")

# ---------------------------------------------------------------------------------------------------------------- inputs


def _rollout(generator, steps=8, envs=3, terminated_at=(), truncated_at=(), rate=0.0):
    """A rollout as a vectorised collector would hand it over: next_values continue values except where an episode ends."""
    values = normal(generator, steps, envs)
    terminated = torch.rand(steps, envs, generator=generator) < rate
    truncated = torch.rand(steps, envs, generator=generator) < rate
    for t, env in terminated_at:
        terminated[t, env] = True
    for t, env in truncated_at:
        truncated[t, env] = True
    following = torch.cat([values[1:], normal(generator, 1, envs)])
    fresh = normal(generator, steps, envs)
    next_values = torch.where(terminated | truncated, fresh, following)
    rewards = normal(generator, steps, envs)
    return {"rewards": rewards, "values": values, "next_values": next_values, "terminated": terminated, "truncated": truncated}


def _position(generator, steps, envs):
    """A step that is neither the first nor the last one, in any environment."""
    return int(integers(generator, 1, steps - 1)), int(integers(generator, 0, envs))


@drawing
def _one_end(generator, *flags):
    """An episode of one environment ends, and these flags say how."""
    at = [_position(generator, 8, 3)]
    return _rollout(generator, **{f"{flag}_at": at for flag in flags}) | {"gamma": 0.9, "gae_lambda": 0.8}


_one_terminated = _one_end("terminated")
_one_truncated = _one_end("truncated")


def _many_ends(generator):
    rollout = _rollout(generator, 32, 4, [(5, 0), (31, 1)], [(7, 1), (20, 2), (31, 3)], rate=0.1)
    return rollout | {"gamma": 0.97, "gae_lambda": 0.9}


def _single_step(generator):
    return _rollout(generator, 1, 1) | {"gamma": 0.9, "gae_lambda": 0.8}


def _long(generator):
    return _rollout(generator, 600, 1) | {"gamma": 0.5, "gae_lambda": 0.5}


def _true_values(generator):
    """Reward 1 for ever, and a critic that knows that it is worth 1 / (1 - γ): nothing is left to explain."""
    gamma = 0.9
    ones = torch.ones(12, 2, dtype=torch.float64)
    cut = torch.zeros(12, 2, dtype=torch.bool)
    cut[_position(generator, 12, 2)] = True
    worth = ones / (1 - gamma)
    return {
        "rewards": ones,
        "values": worth,
        "next_values": worth,
        "terminated": torch.zeros_like(cut),
        "truncated": cut,
        "gamma": gamma,
        "gae_lambda": 0.95,
    }


def _cut(inputs, name, names, visible=False):
    """One argument is a column short: in NumPy's rules it would broadcast or fail later, somewhere else."""
    short = reshaped(inputs, name, lambda x: x[:, :1])
    return Case(f"{name} with a column too few", short, raises=names, visible=visible, draws=1)


def _monte_carlo_minus_value(rewards, values, next_values, terminated, truncated, gamma, gae_lambda):
    """λ = 1 by definition: the discounted rewards up to the episode's end or the rollout's, a bootstrap unless terminated, minus V."""
    steps, envs = rewards.shape
    advantages = torch.zeros_like(rewards)
    for env in range(envs):
        for start in range(steps):
            total, discount = 0.0, 1.0
            for t in range(start, steps):
                total += discount * float(rewards[t, env])
                discount *= gamma
                if terminated[t, env] or truncated[t, env] or t == steps - 1:
                    total += 0.0 if terminated[t, env] else discount * float(next_values[t, env])
                    break
            advantages[start, env] = total - float(values[start, env])
    return advantages


def _zeros_like_rewards(rewards, **_rest):
    return torch.zeros_like(rewards)


def _residuals_by_hand(rewards, values, next_values, terminated, truncated, gamma, gae_lambda):
    return rewards + gamma * torch.where(terminated, 0.0, next_values) - values


# ---------------------------------------------------------------------------------------------------------- td_residuals

_GAMMA = satisfies(lambda gamma: 0 <= gamma <= 1)
_LAMBDA = satisfies(lambda gae_lambda: 0 <= gae_lambda <= 1)
_DETACH = (
    "The result still hangs on the critic's graph. Advantages are data for the losses: "
    "detach the result, or work under torch.no_grad()."
)
_BOOTSTRAPPED = "rewards += … changes the caller's buffer, and the next pass over the rollout adds the bootstrap again."
_NEXT_IN_BUFFER = (
    "values[t + 1] is the value of whatever came next in the buffer; where an episode was cut, that is "
    "another episode. Use next_values."
)
_NOTHING_FOLLOWS = "After a terminated step nothing follows, so its bootstrap must vanish: multiply next_values by ~terminated."


def _td_inputs(inputs):
    return without(inputs, "truncated", "gae_lambda")


_residuals = versions_of(ch44.td_residuals, one_shape(*FLOATS, "terminated"), _GAMMA, data=FLOATS)


def _td(formula, **options):
    """A version of the residual: `formula` takes r, v, v_next, alive, gamma."""
    return _residuals(lambda r, v, v_next, ended, gamma: formula(r, v, v_next, ~ended, gamma), **options)


def _residual(r, v, v_next, alive, gamma):
    return r + gamma * v_next * alive - v


def _td_by_steps(rewards, values, next_values, terminated, gamma):
    """Written out for one number at a time, without a mask product."""
    deltas = torch.empty_like(rewards)
    for index in np.ndindex(*rewards.shape):
        bootstrap = 0.0 if terminated[index] else gamma * next_values[index].item()
        deltas[index] = rewards[index].item() + bootstrap - values[index].item()
    return deltas


def _td_numpy(rewards, values, next_values, terminated, gamma):
    alive = 1.0 - terminated.numpy().astype(np.float64)
    target = rewards.numpy() + gamma * alive * next_values.numpy()
    return torch.from_numpy(np.asarray(target - values.numpy())).to(rewards.dtype)


def _td_masked_fill(rewards, values, next_values, terminated, gamma):
    return next_values.masked_fill(terminated, 0.0).mul_(gamma).add_(rewards).sub_(values)


def _td_double(rewards, values, next_values, terminated, gamma):
    r, v, v_next, alive = (x.to(torch.float64) for x in (rewards, values, next_values, 1 - terminated.int()))
    return torch.addcmul(r - v, v_next, alive, value=gamma).to(rewards.dtype)


def _shifted(values, next_values):
    return torch.cat([values[1:], next_values[-1:]])


_WRONG_RESIDUALS = {
    "termination-ignored": (lambda r, v, v_next, alive, gamma: r + gamma * v_next - v, _NOTHING_FOLLOWS),
    "mask-inverted": (
        lambda r, v, v_next, alive, gamma: r + gamma * v_next * ~alive - v,
        "The bootstrap survives only where the episode terminated: the mask is the wrong way round.",
    ),
    "whole-residual-masked": (
        lambda r, v, v_next, alive, gamma: (r + gamma * v_next - v) * alive,
        "Only the bootstrap vanishes at termination; the last reward and the value still count.",
    ),
    "gamma-missing": (
        lambda r, v, v_next, alive, gamma: r + v_next * alive - v,
        "The next value lies one step ahead: discount it by gamma.",
    ),
    "reward-discounted": (
        lambda r, v, v_next, alive, gamma: gamma * (r + v_next * alive) - v,
        "The reward arrives in this step and is not discounted; only the next value is.",
    ),
    "value-not-subtracted": (
        lambda r, v, v_next, alive, gamma: r + gamma * v_next * alive,
        "This is the one-step target. The residual is the target minus V(s_t).",
    ),
    "sign-flipped": (
        lambda r, v, v_next, alive, gamma: v - r - gamma * v_next * alive,
        "The residual is target minus value: positive when things went better than expected.",
    ),
    "shifted-values-as-next-values": (
        lambda r, v, v_next, alive, gamma: r + gamma * _shifted(v, v_next) * alive - v,
        _NEXT_IN_BUFFER,
    ),
    "input-changed": (lambda r, v, v_next, alive, gamma: r.add_(gamma * v_next * alive) - v, _BOOTSTRAPPED),
}

TD_RESIDUALS = Exercise(
    name="td_residuals",
    reference=ch44.td_residuals,
    criteria={"values": 1.25, "gradient": 0.25, "dtype": 0.25, "inputs": 0.1, "errors": 0.15},
    axes=("t", "env"),
    cases=(
        Case("no episode ends, default gamma", _td_inputs(_rollout), visible=True),
        Case("one episode terminates", _td_inputs(_one_terminated), visible=True),
        Case("many episode ends", _td_inputs(_many_ends), visible=True, draws=3),
        Case("one step of one environment", _td_inputs(_single_step)),
        Case("gamma = 0: reward minus value", _td_inputs(replaced(_many_ends, gamma=0))),
        Case("gamma = 1", _td_inputs(replaced(_many_ends, gamma=1))),
        Case(
            "reward 1 for ever and true values: no residual",
            _td_inputs(_true_values),
            closed_form=_zeros_like_rewards,
            visible=True,
        ),
        Case("values that require gradient", _td_inputs(_many_ends), differentiate=FLOATS, visible=True),
        Case("single precision", _td_inputs(_many_ends), dtype=torch.float32, visible=True),
        refused(_td_inputs(_one_terminated), gamma=1.5, visible=True),
        refused(_td_inputs(_one_terminated), gamma=-0.1),
        _cut(_td_inputs(_one_terminated), "values", (*FLOATS, "terminated"), visible=True),
        _cut(_td_inputs(_one_terminated), "terminated", (*FLOATS, "terminated")),
    ),
    misconceptions=(
        *wrong(_WRONG_RESIDUALS, _td),
        Misconception("graph-kept", _td(_residual, leak=True), _DETACH),
        dtype_lost(ch44.td_residuals),
        bad_input_accepted(_td(_residual, checked=False)),
    ),
    variants={
        "one number at a time": _residuals(_td_by_steps),
        "torch.where": _residuals(
            lambda r, v, v_next, ended, gamma: r - v + gamma * torch.where(ended, torch.zeros_like(v_next), v_next)
        ),
        "NumPy": _residuals(_td_numpy),
        "masked_fill in its own buffer": _residuals(_td_masked_fill),
        "double precision inside": _residuals(_td_double),
    },
)

# ----------------------------------------------------------------------------------------------------------- compute_gae

_estimators = versions_of(ch44.compute_gae, one_shape(*ROLLOUT), _GAMMA, _LAMBDA, data=FLOATS)


def _never(terminated, truncated):
    return torch.zeros_like(terminated)


def _if_terminated(terminated, truncated):
    return terminated


def _at_either(terminated, truncated):
    return terminated | truncated


def _at_the_next(terminated, truncated):
    """The mask of the step after: the convention of buffers that store "this observation is the first of an episode"."""
    ended = terminated | truncated
    return torch.cat([ended[1:], torch.zeros_like(ended[:1])])


def _gae(
    no_bootstrap=_if_terminated,
    stop=_at_either,
    decay=lambda gamma, gae_lambda: gamma * gae_lambda,
    following=lambda values, next_values: next_values,
    **options,
):
    """A version of the estimator, from the places where it can go wrong: where nothing is bootstrapped, where the recursion stops, by
    what factor it decays, and what counts as the successor's value."""

    def estimator(rewards, values, next_values, terminated, truncated, gamma, gae_lambda):
        alive = ~no_bootstrap(terminated, truncated)
        deltas = _residual(rewards, values, following(values, next_values), alive, gamma)
        return _backward(deltas, decay(gamma, gae_lambda) * (~stop(terminated, truncated)).to(deltas.dtype))

    return _estimators(estimator, **options)


def _backward(deltas, carry):
    advantages: list[torch.Tensor] = []
    following = torch.zeros_like(deltas[0])
    for delta, factor in zip(deltas.flip(0), carry.flip(0), strict=True):
        following = delta + factor * following
        advantages.insert(0, following)
    return torch.stack(advantages)


def _bootstrap_smuggled_in(rewards, values, next_values, terminated, truncated, gamma, gae_lambda):
    advantages = ch44.compute_gae(rewards, values, next_values, terminated, truncated, gamma, gae_lambda)
    rewards += gamma * next_values * truncated
    return advantages


def _along_environments(rewards, values, next_values, terminated, truncated, gamma, gae_lambda):
    deltas = _residual(rewards, values, next_values, ~terminated, gamma)
    return _backward(deltas.T, (gamma * gae_lambda * (~(terminated | truncated)).to(deltas.dtype)).T).T


def _one_environment_at_a_time(rewards, values, next_values, terminated, truncated, gamma, gae_lambda):
    """Plain Python."""
    steps, envs = rewards.shape
    result = [[0.0] * envs for _ in range(steps)]
    for env in range(envs):
        running = 0.0
        for t in range(steps - 1, -1, -1):
            if terminated[t, env] or truncated[t, env]:
                running = 0.0
            future = 0.0 if terminated[t, env] else gamma * float(next_values[t, env])
            running = float(rewards[t, env]) + future - float(values[t, env]) + gamma * gae_lambda * running
            result[t][env] = running
    return torch.tensor(result, dtype=rewards.dtype)


def _in_numpy(rewards, values, next_values, terminated, truncated, gamma, gae_lambda):
    """NumPy in double precision, cast back."""
    r, v, n = (x.double().numpy() for x in (rewards, values, next_values))
    deltas = r + gamma * n * (1.0 - terminated.numpy()) - v
    stop = np.logical_or(terminated.numpy(), truncated.numpy())
    out = np.zeros_like(deltas)
    last = np.zeros(deltas.shape[1])
    for t in reversed(range(len(out))):
        out[t] = last = deltas[t] + np.where(stop[t], 0.0, gamma * gae_lambda * last)
    return torch.from_numpy(out).to(rewards.dtype)


def _by_doubling(rewards, values, next_values, terminated, truncated, gamma, gae_lambda):
    """A scan by doubling: after k rounds every entry has summed 2**k steps."""
    total = rewards + gamma * next_values.masked_fill(terminated, 0) - values
    weight = gamma * gae_lambda * (~(terminated | truncated)).to(total.dtype)
    reach = 1
    while reach < len(total):
        pad = total.new_zeros(reach, *total.shape[1:])
        total = total + weight * torch.cat([total[reach:], pad])
        weight = weight * torch.cat([weight[reach:], pad])
        reach *= 2
    return total


def _by_episode(rewards, values, next_values, terminated, truncated, gamma, gae_lambda):
    """Cut each environment's steps into episodes and sum each by its definition, as a matrix product."""
    deltas = rewards + gamma * torch.where(terminated, torch.zeros_like(next_values), next_values) - values
    advantages = torch.empty_like(deltas)
    for env in range(deltas.shape[1]):
        ends = torch.nonzero((terminated | truncated)[:, env]).flatten().tolist()
        start = 0
        for stop in [*[end + 1 for end in ends], len(deltas)]:
            lag = torch.arange(stop - start)
            power = lag[None, :] - lag[:, None]
            weights = torch.where(power >= 0, (gamma * gae_lambda) ** power.clamp(min=0).to(deltas.dtype), 0.0).to(deltas.dtype)
            advantages[start:stop, env] = weights @ deltas[start:stop, env]
            start = stop
    return advantages


def _in_own_buffer(rewards, values, next_values, terminated, truncated, gamma, gae_lambda):
    """In place, in a buffer of its own."""
    buffer = rewards.clone()
    buffer.add_(next_values * (1 - terminated.to(buffer.dtype)), alpha=gamma).sub_(values)
    keep = torch.logical_not(torch.logical_or(terminated, truncated)).to(buffer.dtype).mul_(gamma * gae_lambda)
    for t in range(buffer.shape[0] - 2, -1, -1):
        buffer[t].addcmul_(keep[t], buffer[t + 1])
    return buffer


_WRONG_GAE = {
    "truncated-treated-as-terminated": (
        _gae(no_bootstrap=_at_either),
        "A time limit does not end the task: bootstrap from next_values there. Only terminated removes the bootstrap."
        + wild.also("truncation_as_end", "gae"),
    ),
    "termination-ignored": (_gae(no_bootstrap=_never), _NOTHING_FOLLOWS),
    "recursion-runs-through-truncation": (
        _gae(stop=_if_terminated),
        "The step after a truncated one belongs to another episode: the recursion must stop there as well.",
    ),
    "recursion-never-stops": (
        _gae(stop=_never),
        "The residuals are right, but advantages leak from one episode into the one before: "
        "multiply the recursion by ~(terminated | truncated).",
    ),
    "episode-ends-ignored": (
        _gae(no_bootstrap=_never, stop=_never),
        "Neither the bootstrap nor the recursion looks at the episode's end: terminated removes the "
        "bootstrap, either flag stops the sum.",
    ),
    "ended-mask-of-the-next-step": (
        _gae(stop=_at_the_next),
        "The recursion looks at the flag of step t + 1. Here a flag belongs to the step that it ends: use "
        "terminated[t] and truncated[t].",
    ),
    "lambda-missing": (
        _gae(decay=lambda gamma, gae_lambda: gamma),
        "The recursion decays by gamma alone, which is lambda = 1: multiply by gae_lambda as well.",
    ),
    "gamma-missing-in-recursion": (
        _gae(decay=lambda gamma, gae_lambda: gae_lambda),
        "The recursion decays by lambda alone: each step further is also discounted by gamma.",
    ),
    "shifted-values-as-next-values": (_gae(following=_shifted), _NEXT_IN_BUFFER),
    "residuals-only": (
        _estimators(lambda r, v, v_next, terminated, truncated, gamma, gae_lambda: _residual(r, v, v_next, ~terminated, gamma)),
        "This is the one-step residual: later residuals are missing (lambda = 0).",
    ),
    "values-added": (
        _estimators(lambda rewards, values, *rest: ch44.compute_gae(rewards, values, *rest) + values),
        "These are the lambda-returns: advantages plus values. The advantage is the part above V.",
    ),
    "wrong-axis": (
        _estimators(_along_environments),
        "The sum runs over environments instead of time: the first axis is time, (T, N).",
    ),
    "normalised-inside": (
        after(ch44.compute_gae, ch44.normalize_advantages),
        "The advantages come back normalised. The critic's targets need them in units of reward: normalise later, for the policy only.",
    ),
    "graph-kept": (_gae(leak=True), _DETACH),
    "input-changed": (_estimators(_bootstrap_smuggled_in), _BOOTSTRAPPED),
}

COMPUTE_GAE = Exercise(
    name="compute_gae",
    reference=ch44.compute_gae,
    criteria={"values": 2.0, "gradient": 0.4, "dtype": 0.2, "inputs": 0.2, "errors": 0.2},
    axes=("t", "env"),
    last_step_first=True,
    cases=(
        Case("no episode ends, default gamma and gae_lambda", _rollout, visible=True),
        Case("one episode terminates", _one_terminated, visible=True),
        Case("a time limit cuts one episode", _one_truncated, visible=True),
        Case("many episode ends", _many_ends, visible=True, draws=4),
        Case("terminated and truncated in the same step", _one_end("terminated", "truncated")),
        Case("one step of one environment", _single_step),
        Case(
            "gae_lambda = 0: the one-step residual",
            replaced(_many_ends, gae_lambda=0.0),
            closed_form=_residuals_by_hand,
            visible=True,
        ),
        Case(
            "gae_lambda = 1: Monte Carlo minus the value",
            replaced(_many_ends, gae_lambda=1.0),
            closed_form=_monte_carlo_minus_value,
        ),
        Case("gamma = 1", replaced(_many_ends, gamma=1)),
        Case("gamma = 0", replaced(_many_ends, gamma=0)),
        Case("reward 1 for ever and true values: no advantage", _true_values, closed_form=_zeros_like_rewards, visible=True),
        Case("a long rollout", _long, draws=1),
        Case("values that require gradient", _many_ends, differentiate=FLOATS, visible=True),
        Case("single precision", _many_ends, dtype=torch.float32, visible=True),
        refused(_one_truncated, gamma=1.5, visible=True),
        refused(_one_truncated, gae_lambda=-0.1, visible=True),
        refused(_one_truncated, gae_lambda=2),
        *(_cut(_one_truncated, name, ROLLOUT, visible=name == "truncated") for name in ROLLOUT),
    ),
    misconceptions=(*wrong(_WRONG_GAE), dtype_lost(ch44.compute_gae), bad_input_accepted(_gae(checked=False))),
    variants={
        "plain Python, environment by environment": _estimators(_one_environment_at_a_time),
        "NumPy in double precision": _estimators(_in_numpy),
        "scan by doubling": _estimators(_by_doubling),
        "episode by episode, as a matrix product": _estimators(_by_episode),
        "in place in its own buffer": _estimators(_in_own_buffer),
    },
)

# -------------------------------------------------------------------------------------------------------- lambda_returns


@drawing
def _pair(generator, steps=6, envs=3, level=3.0, spread=2.0, scale=1.0):
    return {"advantages": scale * normal(generator, steps, envs), "values": level + spread * normal(generator, steps, envs)}


_returns = versions_of(ch44.lambda_returns, one_shape(*PAIR), data=PAIR)


def _returns_numpy(advantages, values):
    return torch.from_numpy(np.add(advantages.numpy(), values.numpy()))


def _returns_buffer(advantages, values):
    returns = torch.empty_like(values)
    returns.copy_(values).add_(advantages)
    return returns


def _returns_rows(advantages, values):
    return torch.stack([a.double() + v.double() for a, v in zip(advantages, values, strict=True)]).to(values.dtype)


_RETURN_VARIANTS = {
    "under no_grad": _returns(torch.no_grad()(lambda a, v: v + a), leak=True),
    "NumPy": _returns(_returns_numpy),
    "its own buffer": _returns(_returns_buffer),
    "row by row in double precision": _returns(_returns_rows),
}

_WRONG_RETURNS = {
    "advantages-returned": (
        lambda a, v: a.clone(),
        "The critic must be fitted to a return, not to the advantage: add the values that the advantage was measured against.",
    ),
    "values-returned": (lambda a, v: v.clone(), "Fitting the critic to its own values teaches it nothing: add the advantages."),
    "difference-flipped": (lambda a, v: v - a, "The advantage is return minus value, so the return is value plus advantage."),
    "value-subtracted": (lambda a, v: a - v, "The value was already subtracted inside the advantage: add it back."),
    "advantages-normalised-first": (
        lambda a, v: ch44.normalize_advantages(a) + v if a.numel() > 1 else a + v,
        "Normalised advantages have no unit of reward any more: form the returns first, normalise later.",
    ),
    "values-of-the-next-step": (lambda a, v: a + v.roll(-1, 0), "The value to add is that of the same step, V(s_t)."),
    "input-changed": (
        lambda a, v: a.add_(v).clone(),
        "advantages += values changes the caller's advantages, which the policy's loss still needs.",
    ),
}

LAMBDA_RETURNS = Exercise(
    name="lambda_returns",
    reference=ch44.lambda_returns,
    criteria={"values": 0.6, "gradient": 0.2, "dtype": 0.05, "inputs": 0.05, "errors": 0.1},
    axes=("t", "env"),
    cases=(
        Case("a small rollout", _pair(), visible=True),
        Case("a long rollout", _pair(40, 2, level=-1.0, spread=1.0, scale=5.0), draws=3),
        Case("one step of one environment", _pair(1, 1, level=0.0, spread=1.0)),
        Case("inputs that require gradient", _pair(), differentiate=PAIR, visible=True),
        Case("single precision", _pair(), dtype=torch.float32, visible=True),
        _cut(_pair(), "values", PAIR, visible=True),
        _cut(_pair(), "advantages", PAIR),
    ),
    misconceptions=(
        *wrong(_WRONG_RETURNS, _returns),
        Misconception(
            "graph-kept", _returns(torch.add, leak=True), "The target would move with the critic that chases it: detach it."
        ),
        dtype_lost(ch44.lambda_returns),
        bad_input_accepted(_returns(torch.add, checked=False)),
    ),
    variants=_RETURN_VARIANTS,
)

# -------------------------------------------------------------------------------------------------- normalize_advantages


def _table(generator):
    return {"advantages": 2 + 3 * normal(generator, 6, 3) * torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)}


def _flat(generator):
    return {"advantages": -1 + 0.2 * normal(generator, 17)}


def _constant(generator):
    return {"advantages": torch.full((4, 2), 2.0, dtype=torch.float64)}


def _cube(generator):
    return {"advantages": 100 * normal(generator, 3, 2, 5)}


_normalized = versions_of(ch44.normalize_advantages)


def _biased(advantages, eps=1e-8):
    return (advantages - advantages.mean()) / (advantages.std(correction=0) + eps)


def _normalize_numpy(advantages, eps=1e-8):
    a = advantages.detach().double().numpy()
    return torch.from_numpy(np.asarray((a - a.mean()) / (a.std(ddof=1) + eps))).to(advantages.dtype)


def _normalize_eps_inside(advantages, eps=1e-8):
    return (advantages - advantages.mean()) * torch.rsqrt(advantages.var() + eps**2)


def _normalize_by_sums(advantages, eps=1e-8):
    count = advantages.numel()
    centred = advantages - advantages.sum() / count
    return centred / ((centred.square().sum() / (count - 1)).sqrt() + eps)


def _normalize_in_own_buffer(advantages, eps=1e-8):
    deviation, mean = torch.std_mean(advantages.detach(), correction=0)
    return advantages.detach().clone().sub_(mean).div_(deviation + eps)


def _normalize_layer_norm(advantages, eps=1e-8):
    return torch.nn.functional.layer_norm(advantages, advantages.shape, eps=eps**2)


_WRONG_NORMALIZED = {
    "normalised-per-environment": (
        lambda a, eps: (a - a.mean(0)) / (a.std(0) + eps),
        "Mean and deviation are taken along time for each environment apart: take them over all elements.",
    ),
    "normalised-per-step": (
        lambda a, eps: (a - a.mean(-1, True)) / (a.std(-1, keepdim=True) + eps),
        "Mean and deviation are taken along the last axis: take them over all elements.",
    ),
    "mean-not-subtracted": (
        lambda a, eps: a / (a.std() + eps),
        "The mean is still there: half of the actions should come out better than average.",
    ),
    "deviation-not-divided": (
        lambda a, eps: a - a.mean(),
        "Centred, but still in units of reward: divide by the standard deviation.",
    ),
    "variance-instead-of-deviation": (
        lambda a, eps: (a - a.mean()) / (a.var() + eps),
        "The divisor is the variance: take its square root.",
    ),
    "eps-missing": (
        lambda a, eps: (a - a.mean()) / a.std(),
        "When all advantages are equal this is 0 / 0: eps belongs in the denominator.",
    ),
    "scaled-to-unit-range": (
        lambda a, eps: (a - a.min()) / (a.max() - a.min() + eps),
        "This maps to [0, 1]: every action would look good. Use mean and standard deviation.",
    ),
    "norm-instead-of-deviation": (
        lambda a, eps: (a - a.mean()) / ((a - a.mean()).norm() + eps),
        "Dividing by the norm makes the advantages shrink as the batch grows: divide by the standard deviation.",
    ),
}

NORMALIZE_ADVANTAGES = Exercise(
    name="normalize_advantages",
    reference=ch44.normalize_advantages,
    also_right=(_biased,),
    criteria={"values": 0.8, "dtype": 0.1, "inputs": 0.1},
    axes=("t", "env"),
    cases=(
        Case("environments of different scale", _table, visible=True, draws=3),
        Case("a flat minibatch", _flat, visible=True),
        Case("three axes", _cube),
        Case("all advantages equal", _constant, closed_form=torch.zeros_like, visible=True),
        Case("single precision", _table, dtype=torch.float32, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_NORMALIZED, _normalized),
        dtype_lost(ch44.normalize_advantages),
        in_place(ch44.normalize_advantages, "advantages"),
    ),
    variants={
        "NumPy": _normalize_numpy,
        "epsilon inside the root": _normalize_eps_inside,
        "sums written out": _normalize_by_sums,
        "its own buffer, biased deviation": _normalize_in_own_buffer,
        "layer_norm over everything": _normalize_layer_norm,
    },
)

# ---------------------------------------------------------------------------------------------------- explained_variance

_CRITIC = ("values", "returns")


def _critic(generator):
    returns = 4 * normal(generator, 8, 3) + 1
    return {"values": returns + normal(generator, 8, 3) + 2, "returns": returns}


def _flat_critic(generator):
    returns = normal(generator, 25)
    return {"values": 0.5 * returns + 0.3 * normal(generator, 25), "returns": returns}


def _bad_critic(generator):
    return {"values": 3 * normal(generator, 8, 3), "returns": normal(generator, 8, 3)}


@drawing
def _right_up_to(generator, offset):
    returns = normal(generator, 8, 3)
    return {"values": returns + offset, "returns": returns}


def _constant_returns(generator):
    return {"values": normal(generator, 4, 2), "returns": torch.full((4, 2), 2.0, dtype=torch.float64)}


_metrics = versions_of(ch44.explained_variance, one_shape(*_CRITIC), data=_CRITIC)


def _explained(formula, **options):
    """NaN where there is nothing to explain."""
    return _metrics(lambda v, r: torch.where(r.var() == 0, math.nan, formula(v, r)), **options)


def _explained_share(v, r):
    return 1 - (r - v).var() / r.var()


def _explained_biased(values, returns):
    spread = returns.var(correction=0)
    if spread == 0:
        return torch.full_like(spread, math.nan)
    return 1 - (returns - values).var(correction=0) / spread


def _explained_numpy(values, returns):
    v, r = values.double().numpy(), returns.double().numpy()
    spread = np.var(r)
    return torch.tensor(np.nan if spread == 0 else 1 - np.var(r - v) / spread, dtype=returns.dtype)


def _explained_sums(values, returns):
    residual = returns - values
    left = ((residual - residual.mean()) ** 2).sum()
    total = ((returns - returns.mean()) ** 2).sum()
    return (total - left) / total if total > 0 else total * math.nan


def _explained_deviations(values, returns):
    ratio = torch.std(returns - values) / torch.std(returns)
    return torch.where(torch.isinf(ratio), torch.full_like(ratio, math.nan), 1 - ratio * ratio)


_OFFSET_COUNTED = "Mean squared error also counts a constant offset (this is R²): the variance of the residual does not."

_WRONG_SHARES = {
    "unexplained-share": (lambda v, r: (r - v).var() / r.var(), "This is the share that is not explained: subtract it from 1."),
    "squared-error-instead-of-variance": (lambda v, r: 1 - (r - v).square().mean() / r.var(correction=0), _OFFSET_COUNTED),
    "squared-error-over-unbiased-variance": (lambda v, r: 1 - (r - v).square().mean() / r.var(), _OFFSET_COUNTED),
    "variance-of-values-below": (
        lambda v, r: 1 - (r - v).var() / v.var(),
        "Divide by the variance of the returns, not of the values: arguments swapped?",
    ),
    "ratio-of-variances": (
        lambda v, r: v.var() / r.var(),
        "A critic can vary as much as the returns and still be wrong everywhere: look at the residual.",
    ),
    "squared-correlation": (
        lambda v, r: torch.corrcoef(torch.stack([v.flatten(), r.flatten()]))[0, 1].square(),
        "The squared correlation forgives a wrong scale and can't be negative.",
    ),
    "deviations-instead-of-variances": (lambda v, r: 1 - (r - v).std() / r.std(), "These are standard deviations: square them."),
}

_WRONG_CONSTANTS = {
    "division-by-zero": (_explained_share, "Constant returns have no variance to explain: return NaN there, not minus infinity."),
    "zero-for-constant-returns": (
        lambda v, r: torch.nan_to_num(ch44.explained_variance(v, r), nan=0.0),
        "0 would claim a useless critic; with constant returns nothing can be said: NaN.",
    ),
}

EXPLAINED_VARIANCE = Exercise(
    name="explained_variance",
    reference=ch44.explained_variance,
    criteria={"values": 0.7, "gradient": 0.1, "dtype": 0.1, "errors": 0.1},
    cases=(
        Case("a good critic with an offset", _critic, visible=True, draws=3),
        Case("a flat batch", _flat_critic, visible=True),
        Case("a critic worse than a constant", _bad_critic, visible=True),
        Case("a perfect critic", _right_up_to(0), closed_form=number(1.0)),
        Case("a critic that is right up to a constant", _right_up_to(4), closed_form=number(1.0)),
        Case("constant returns: NaN", _constant_returns, closed_form=number(math.nan), visible=True),
        Case("values that require gradient", _critic, differentiate=_CRITIC, visible=True),
        Case("single precision", _critic, dtype=torch.float32, visible=True),
        _cut(_critic, "values", _CRITIC, visible=True),
        _cut(_critic, "returns", _CRITIC),
    ),
    misconceptions=(
        *wrong(_WRONG_SHARES, _explained),
        *wrong(_WRONG_CONSTANTS, _metrics),
        Misconception("graph-kept", _explained(_explained_share, leak=True), METRIC),
        python_float(ch44.explained_variance, NUMBER),
        dtype_lost(ch44.explained_variance),
        bad_input_accepted(_explained(_explained_share, checked=False)),
    ),
    variants={
        "biased variances": _metrics(_explained_biased),
        "NumPy": _metrics(_explained_numpy),
        "sums of squares": _metrics(_explained_sums),
        "standard deviations, squared": _metrics(_explained_deviations),
    },
)

# ------------------------------------------------------------------------------------------------------ repaired_targets


def _targets(gae=ch44.compute_gae, advantages_of=ch44.normalize_advantages, returns_of=ch44.lambda_returns):
    """A version of the program, from its three parts."""

    def targets(rewards, values, *rest):
        advantages = gae(rewards, values, *rest)
        return advantages_of(advantages), returns_of(advantages, values)

    return versions_of(ch44.repaired_targets)(targets)


def _swapped(targets):
    return targets[1], targets[0]


_WRONG_TARGETS = {
    "returns-from-normalised-advantages": (
        _targets(returns_of=lambda a, v: (ch44.normalize_advantages(a) + v).detach()),
        "This is the suspect program's own bug. What unit do normalised advantages have, and what unit has a return?",
    ),
    "advantages-not-normalised": (
        _targets(advantages_of=lambda a: a),
        "The policy's advantages come back in units of reward: normalise them.",
    ),
    "returns-normalised-too": (
        _targets(returns_of=lambda a, v: ch44.normalize_advantages(ch44.lambda_returns(a, v))),
        "The critic's target must keep the unit of reward: it is compared with V(s).",
    ),
    "normalised-per-environment": (
        _targets(advantages_of=lambda a: (a - a.mean(0)) / (a.std(0) + 1e-8)),
        "Mean and deviation are taken for each environment apart: take them over all elements.",
    ),
    "returns-are-advantages": (
        _targets(returns_of=lambda a, v: a.clone()),
        "The critic would be fitted to the advantage: add the values back.",
    ),
    "outputs-swapped": (after(ch44.repaired_targets, _swapped), "The order is (advantages, returns)."),
    "truncated-treated-as-terminated": (
        _targets(_gae(no_bootstrap=_at_either)),
        "A time limit does not end the task: bootstrap from next_values there." + wild.also("truncation_as_end", "gae"),
    ),
    "recursion-never-stops": (
        _targets(_gae(stop=_never)),
        "Advantages leak from one episode into the one before: stop the recursion where an episode ended.",
    ),
    "graph-kept": (_targets(_gae(leak=True), returns_of=torch.add), _DETACH),
}

REPAIRED_TARGETS = Exercise(
    name="repaired_targets",
    reference=ch44.repaired_targets,
    also_right=(_targets(advantages_of=_biased),),
    criteria={"values": 1.6, "gradient": 0.2, "dtype": 0.05, "inputs": 0.05, "errors": 0.1},
    axes=("t", "env"),
    cases=(
        Case("no episode ends, default gamma and gae_lambda", _rollout, visible=True),
        Case("a time limit cuts one episode", _one_truncated, visible=True),
        Case("one episode terminates", _one_terminated, visible=True),
        Case("many episode ends", _many_ends, visible=True, draws=3),
        Case("values that require gradient", _many_ends, differentiate=FLOATS, visible=True),
        Case("single precision", _many_ends, dtype=torch.float32, visible=True),
        refused(_one_truncated, gamma=1.5, visible=True),
        _cut(_one_truncated, "values", ROLLOUT),
    ),
    misconceptions=wrong(_WRONG_TARGETS),
    variants={
        "NumPy": _targets(_estimators(_in_numpy), _normalize_numpy, _RETURN_VARIANTS["NumPy"]),
        "scan by doubling, biased deviation": _targets(
            _estimators(_by_doubling), _normalize_in_own_buffer, _RETURN_VARIANTS["under no_grad"]
        ),
        "plain Python": _targets(
            _estimators(_one_environment_at_a_time), _normalize_by_sums, _RETURN_VARIANTS["row by row in double precision"]
        ),
        "its own buffers": _targets(_estimators(_in_own_buffer), _normalize_eps_inside, _RETURN_VARIANTS["its own buffer"]),
    },
)

EXERCISES = (TD_RESIDUALS, COMPUTE_GAE, LAMBDA_RETURNS, NORMALIZE_ADVANTAGES, EXPLAINED_VARIANCE, REPAIRED_TARGETS)
