"""Checks of chapter 44: cases, named misconceptions and correct variants for GAE and its neighbours."""

from __future__ import annotations

import math

import numpy as np
import torch

from autograder.authoring.parts import SHAPES
from autograder.authoring.spec import Case, Exercise, Misconception
from course_lib import validate
from solutions import ch44

# ---------------------------------------------------------------------------------------------------------------- inputs


def _normal(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def _rollout(generator, steps=8, envs=3, terminated_at=(), truncated_at=(), rate=0.0):
    """A rollout as a vectorised collector would hand it over: next_values continue values except where an episode ends."""
    values = _normal(generator, steps, envs)
    terminated = torch.rand(steps, envs, generator=generator) < rate
    truncated = torch.rand(steps, envs, generator=generator) < rate
    for t, env in terminated_at:
        terminated[t, env] = True
    for t, env in truncated_at:
        truncated[t, env] = True
    following = torch.cat([values[1:], _normal(generator, 1, envs)])
    fresh = _normal(generator, steps, envs)
    next_values = torch.where(terminated | truncated, fresh, following)
    rewards = _normal(generator, steps, envs)
    return {
        "rewards": rewards,
        "values": values,
        "next_values": next_values,
        "terminated": terminated,
        "truncated": truncated,
    }


def _position(generator, steps, envs):
    """A step that is neither the first nor the last one, in any environment."""
    t = torch.randint(1, steps - 1, (), generator=generator)
    return int(t), int(torch.randint(envs, (), generator=generator))


def _no_end(generator):
    return _rollout(generator)


def _one_terminated(generator):
    return _rollout(generator, terminated_at=[_position(generator, 8, 3)]) | {"gamma": 0.9, "gae_lambda": 0.8}


def _one_truncated(generator):
    return _rollout(generator, truncated_at=[_position(generator, 8, 3)]) | {"gamma": 0.9, "gae_lambda": 0.8}


def _many_ends(generator):
    rollout = _rollout(generator, 32, 4, [(5, 0), (31, 1)], [(7, 1), (20, 2), (31, 3)], rate=0.1)
    return rollout | {"gamma": 0.97, "gae_lambda": 0.9}


def _both_at_once(generator):
    t, env = _position(generator, 8, 3)
    return _rollout(generator, terminated_at=[(t, env)], truncated_at=[(t, env)]) | {"gamma": 0.9, "gae_lambda": 0.8}


def _single_step(generator):
    return _rollout(generator, 1, 1) | {"gamma": 0.9, "gae_lambda": 0.8}


def _one_step_estimate(generator):
    return _many_ends(generator) | {"gae_lambda": 0.0}


def _monte_carlo(generator):
    return _many_ends(generator) | {"gae_lambda": 1.0}


def _undiscounted(generator):
    return _many_ends(generator) | {"gamma": 1}


def _only_now(generator):
    return _many_ends(generator) | {"gamma": 0}


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


def _long(generator):
    return _rollout(generator, 600, 1, rate=0.0) | {"gamma": 0.5, "gae_lambda": 0.5}


def _without(names, inputs):
    return lambda generator: {name: value for name, value in inputs(generator).items() if name not in names}


def _with(inputs, **changes):
    return lambda generator: inputs(generator) | changes


def _cut(name, inputs):
    """One argument is a column short: in NumPy's rules it would broadcast or fail later, somewhere else."""

    def short(generator):
        drawn = inputs(generator)
        return drawn | {name: drawn[name][:, :1]}

    return short


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

_TD = ("rewards", "values", "next_values")
_DETACH = (
    "The result still hangs on the critic's graph. Advantages are data for the losses: "
    "detach the result, or work under torch.no_grad()."
)
_VALIDATE = (
    "Shapes that differ broadcast silently into nonsense, and a discount outside [0, 1] diverges. "
    "Check the arguments first: course_lib.validate raises errors that name them."
)
_DTYPE = (
    "The result has lost the inputs' dtype. Build buffers with torch.zeros_like, or cast back to the inputs' dtype at the end."
)


def _td_inputs(inputs):
    return _without({"truncated", "gae_lambda"}, inputs)


def _td_by_steps(rewards, values, next_values, terminated, gamma=0.99):
    """Written out for one number at a time, without a mask product."""
    deltas = torch.empty_like(rewards)
    for index in np.ndindex(*rewards.shape):
        bootstrap = 0.0 if terminated[index] else gamma * next_values[index].item()
        deltas[index] = rewards[index].item() + bootstrap - values[index].item()
    return deltas


def _td_where(rewards, values, next_values, terminated, gamma=0.99):
    _refuse(gamma=gamma, rewards=rewards, values=values, next_values=next_values, terminated=terminated)
    with torch.no_grad():
        return rewards - values + gamma * torch.where(terminated, torch.zeros_like(next_values), next_values)


def _td_numpy(rewards, values, next_values, terminated, gamma=0.99):
    _refuse(gamma=gamma, rewards=rewards, values=values, next_values=next_values, terminated=terminated)
    alive = 1.0 - terminated.numpy().astype(np.float64)
    target = rewards.detach().numpy() + gamma * alive * next_values.detach().numpy()
    return torch.from_numpy(np.asarray(target - values.detach().numpy())).to(rewards.dtype)


def _td_masked_fill(rewards, values, next_values, terminated, gamma=0.99):
    _refuse(gamma=gamma, rewards=rewards, values=values, next_values=next_values, terminated=terminated)
    target = next_values.detach().masked_fill(terminated, 0.0).mul_(gamma).add_(rewards.detach())
    return target.sub_(values.detach())


def _td_double(rewards, values, next_values, terminated, gamma=0.99):
    _refuse(gamma=gamma, rewards=rewards, values=values, next_values=next_values, terminated=terminated)
    r, v, v_next, alive = (x.detach().to(torch.float64) for x in (rewards, values, next_values, 1 - terminated.int()))
    return torch.addcmul(r - v, v_next, alive, value=gamma).to(rewards.dtype)


def _refuse(gamma=0.0, gae_lambda=0.0, **tensors):
    """Another style of validation than the reference's."""
    first, *others = tensors
    for name in others:
        if tensors[name].shape != tensors[first].shape:
            raise ValueError(f"{name} has shape {tuple(tensors[name].shape)}, but {first} has {tuple(tensors[first].shape)}")
    for name, value in (("gamma", gamma), ("gae_lambda", gae_lambda)):
        if value < 0 or value > 1:
            raise ValueError(f"expected 0 <= {name} <= 1, but received {value!r}")


def _td_steps_checked(rewards, values, next_values, terminated, gamma=0.99):
    _refuse(gamma=gamma, rewards=rewards, values=values, next_values=next_values, terminated=terminated)
    return _td_by_steps(rewards, values, next_values, terminated, gamma)


def _td(formula, checked=True):
    """A wrong version of the residual: `formula` takes r, v, v_next, alive, gamma."""

    def wrong(rewards, values, next_values, terminated, gamma=0.99):
        if checked:
            validate.same_shape(rewards=rewards, values=values, next_values=next_values, terminated=terminated)
            validate.unit_interval(gamma=gamma)
        return formula(rewards, values, next_values, ~terminated, gamma).detach()

    return wrong


def _shifted(values, next_values):
    return torch.cat([values[1:], next_values[-1:]])


def _td_graph(rewards, values, next_values, terminated, gamma=0.99):
    ch44.td_residuals(rewards, values, next_values, terminated, gamma)
    return rewards + gamma * next_values * ~terminated - values


def _td_in_place(rewards, values, next_values, terminated, gamma=0.99):
    deltas = ch44.td_residuals(rewards, values, next_values, terminated, gamma)
    with torch.no_grad():
        rewards += gamma * next_values * ~terminated
    return deltas


TD_RESIDUALS = Exercise(
    name="td_residuals",
    reference=ch44.td_residuals,
    criteria={"values": 1.25, "gradient": 0.25, "dtype": 0.25, "inputs": 0.1, "errors": 0.15},
    axes=("t", "env"),
    cases=(
        Case("no episode ends, default gamma", _without({"truncated"}, _no_end), visible=True),
        Case("one episode terminates", _td_inputs(_one_terminated), visible=True),
        Case("many episode ends", _td_inputs(_many_ends), visible=True, draws=3),
        Case("one step of one environment", _td_inputs(_single_step)),
        Case("gamma = 0: reward minus value", _td_inputs(_only_now)),
        Case("gamma = 1", _td_inputs(_undiscounted)),
        Case(
            "reward 1 for ever and true values: no residual",
            _td_inputs(_true_values),
            closed_form=lambda rewards, **_rest: torch.zeros_like(rewards),
            visible=True,
        ),
        Case("values that require gradient", _td_inputs(_many_ends), differentiate=_TD, visible=True),
        Case("single precision", _td_inputs(_many_ends), dtype=torch.float32, visible=True),
        Case("gamma = 1.5", _with(_td_inputs(_one_terminated), gamma=1.5), raises=["gamma"], visible=True, draws=1),
        Case("gamma = -0.1", _with(_td_inputs(_one_terminated), gamma=-0.1), raises=["gamma"], draws=1),
        Case(
            "values with a column too few",
            _cut("values", _td_inputs(_one_terminated)),
            raises=["rewards", "values", "next_values", "terminated"],
            visible=True,
            draws=1,
        ),
        Case(
            "terminated with a column too few",
            _cut("terminated", _td_inputs(_one_terminated)),
            raises=["rewards", "values", "next_values", "terminated"],
            draws=1,
        ),
    ),
    misconceptions=(
        Misconception(
            "termination-ignored",
            _td(lambda r, v, v_next, alive, gamma: r + gamma * v_next - v),
            "After a terminated step nothing follows, so its bootstrap must vanish: multiply next_values by ~terminated.",
        ),
        Misconception(
            "mask-inverted",
            _td(lambda r, v, v_next, alive, gamma: r + gamma * v_next * ~alive - v),
            "The bootstrap survives only where the episode terminated: the mask is the wrong way round.",
        ),
        Misconception(
            "whole-residual-masked",
            _td(lambda r, v, v_next, alive, gamma: (r + gamma * v_next - v) * alive),
            "Only the bootstrap vanishes at termination; the last reward and the value still count.",
        ),
        Misconception(
            "gamma-missing",
            _td(lambda r, v, v_next, alive, gamma: r + v_next * alive - v),
            "The next value lies one step ahead: discount it by gamma.",
        ),
        Misconception(
            "reward-discounted",
            _td(lambda r, v, v_next, alive, gamma: gamma * (r + v_next * alive) - v),
            "The reward arrives in this step and is not discounted; only the next value is.",
        ),
        Misconception(
            "value-not-subtracted",
            _td(lambda r, v, v_next, alive, gamma: r + gamma * v_next * alive),
            "This is the one-step target. The residual is the target minus V(s_t).",
        ),
        Misconception(
            "sign-flipped",
            _td(lambda r, v, v_next, alive, gamma: v - r - gamma * v_next * alive),
            "The residual is target minus value: positive when things went better than expected.",
        ),
        Misconception(
            "shifted-values-as-next-values",
            _td(lambda r, v, v_next, alive, gamma: r + gamma * _shifted(v, v_next) * alive - v),
            "values[t + 1] is the value of whatever came next in the buffer; where an episode was cut, that is "
            "another episode. Use next_values.",
        ),
        Misconception("graph-kept", _td_graph, _DETACH),
        Misconception("dtype-lost", lambda *args, **kwargs: ch44.td_residuals(*args, **kwargs).float(), _DTYPE),
        Misconception(
            "rewards-changed-in-place",
            _td_in_place,
            "rewards += … changes the caller's buffer, and the next pass over the rollout adds the bootstrap again.",
        ),
        Misconception("bad-input-accepted", _td(lambda r, v, n, alive, g: r + g * n * alive - v, checked=False), _VALIDATE),
    ),
    variants={
        "one number at a time": _td_steps_checked,
        "torch.where": _td_where,
        "NumPy": _td_numpy,
        "masked_fill in its own buffer": _td_masked_fill,
        "double precision inside": _td_double,
    },
)

# ----------------------------------------------------------------------------------------------------------- compute_gae


def _gae(bootstrap=lambda terminated, truncated: ~terminated, carry=None, factor=None, following=None, checked=True):
    """A wrong version of the estimator: another bootstrap mask, recursion mask, recursion factor, or successor value."""

    def wrong(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
        if checked:
            _validated(rewards, values, next_values, terminated, truncated, gamma, gae_lambda)
        successor = following(values, next_values) if following else next_values
        deltas = rewards + gamma * successor * bootstrap(terminated, truncated) - values
        going_on = carry(terminated, truncated) if carry else ~(terminated | truncated)
        decay = factor(gamma, gae_lambda) if factor else gamma * gae_lambda
        return _backward(deltas.detach(), decay * going_on.to(deltas.dtype))

    return wrong


def _validated(rewards, values, next_values, terminated, truncated, gamma, gae_lambda):
    validate.same_shape(rewards=rewards, values=values, next_values=next_values, terminated=terminated, truncated=truncated)
    validate.unit_interval(gamma=gamma, gae_lambda=gae_lambda)


def _backward(deltas, carry):
    advantages: list[torch.Tensor] = []
    following = torch.zeros_like(deltas[0])
    for delta, factor in zip(deltas.flip(0), carry.flip(0), strict=True):
        following = delta + factor * following
        advantages.insert(0, following)
    return torch.stack(advantages)


def _next_ended(terminated, truncated):
    """The mask of the step after: the convention of buffers that store "this observation is the first of an episode"."""
    ended = terminated | truncated
    return ~torch.cat([ended[1:], torch.zeros_like(ended[:1])])


def _gae_graph(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
    _validated(rewards, values, next_values, terminated, truncated, gamma, gae_lambda)
    deltas = rewards + gamma * next_values * ~terminated - values
    return _backward(deltas, gamma * gae_lambda * (~(terminated | truncated)).to(deltas.dtype))


def _gae_single(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
    return ch44.compute_gae(rewards, values, next_values, terminated, truncated, gamma, gae_lambda).float()


def _gae_smuggled(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
    advantages = ch44.compute_gae(rewards, values, next_values, terminated, truncated, gamma, gae_lambda)
    with torch.no_grad():
        rewards += gamma * next_values * truncated
    return advantages


def _gae_wrong_axis(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
    _validated(rewards, values, next_values, terminated, truncated, gamma, gae_lambda)
    deltas = ch44.td_residuals(rewards, values, next_values, terminated, gamma)
    return _backward(deltas.T, (gamma * gae_lambda * (~(terminated | truncated)).to(deltas.dtype)).T).T


def _gae_plus_values(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
    return (ch44.compute_gae(rewards, values, next_values, terminated, truncated, gamma, gae_lambda) + values).detach()


def _gae_residuals_only(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
    _validated(rewards, values, next_values, terminated, truncated, gamma, gae_lambda)
    return ch44.td_residuals(rewards, values, next_values, terminated, gamma)


def _gae_per_environment(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
    """Plain Python, an environment after the other."""
    _refuse(
        gamma, gae_lambda, rewards=rewards, values=values, next_values=next_values, terminated=terminated, truncated=truncated
    )
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


def _gae_numpy(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
    """NumPy in double precision, cast back."""
    _refuse(
        gamma, gae_lambda, rewards=rewards, values=values, next_values=next_values, terminated=terminated, truncated=truncated
    )
    r, v, n = (x.detach().double().numpy() for x in (rewards, values, next_values))
    deltas = r + gamma * n * (1.0 - terminated.numpy()) - v
    stop = np.logical_or(terminated.numpy(), truncated.numpy())
    out = np.zeros_like(deltas)
    last = np.zeros(deltas.shape[1])
    for t in reversed(range(len(out))):
        out[t] = last = deltas[t] + np.where(stop[t], 0.0, gamma * gae_lambda * last)
    return torch.from_numpy(out).to(rewards.dtype)


def _gae_doubling(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
    """A scan by doubling: after k rounds every entry has summed 2**k steps."""
    _refuse(
        gamma, gae_lambda, rewards=rewards, values=values, next_values=next_values, terminated=terminated, truncated=truncated
    )
    with torch.no_grad():
        total = rewards + gamma * next_values.masked_fill(terminated, 0) - values
        weight = gamma * gae_lambda * (~(terminated | truncated)).to(total.dtype)
        reach = 1
        while reach < len(total):
            pad = total.new_zeros(reach, *total.shape[1:])
            total = total + weight * torch.cat([total[reach:], pad])
            weight = weight * torch.cat([weight[reach:], pad])
            reach *= 2
        return total


def _gae_by_episode(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
    """Cut each environment's steps into episodes and sum each by its definition, as a matrix product."""
    _refuse(
        gamma, gae_lambda, rewards=rewards, values=values, next_values=next_values, terminated=terminated, truncated=truncated
    )
    target = rewards.detach() + gamma * torch.where(terminated, torch.zeros_like(next_values), next_values).detach()
    deltas = target - values.detach()
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


def _gae_in_own_buffer(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
    """In place, in a buffer of its own."""
    _refuse(
        gamma, gae_lambda, rewards=rewards, values=values, next_values=next_values, terminated=terminated, truncated=truncated
    )
    buffer = rewards.detach().clone()
    buffer.add_(next_values.detach() * (1 - terminated.to(buffer.dtype)), alpha=gamma).sub_(values.detach())
    keep = torch.logical_not(torch.logical_or(terminated, truncated)).to(buffer.dtype).mul_(gamma * gae_lambda)
    for t in range(buffer.shape[0] - 2, -1, -1):
        buffer[t].addcmul_(keep[t], buffer[t + 1])
    return buffer


_ROLLOUT_NAMES = ["rewards", "values", "next_values", "terminated", "truncated"]

COMPUTE_GAE = Exercise(
    name="compute_gae",
    reference=ch44.compute_gae,
    criteria={"values": 2.0, "gradient": 0.4, "dtype": 0.2, "inputs": 0.2, "errors": 0.2},
    axes=("t", "env"),
    last_step_first=True,
    cases=(
        Case("no episode ends, default gamma and gae_lambda", _no_end, visible=True),
        Case("one episode terminates", _one_terminated, visible=True),
        Case("a time limit cuts one episode", _one_truncated, visible=True),
        Case("many episode ends", _many_ends, visible=True, draws=4),
        Case("terminated and truncated in the same step", _both_at_once),
        Case("one step of one environment", _single_step),
        Case("gae_lambda = 0: the one-step residual", _one_step_estimate, closed_form=_residuals_by_hand, visible=True),
        Case("gae_lambda = 1: Monte Carlo minus the value", _monte_carlo, closed_form=_monte_carlo_minus_value),
        Case("gamma = 1", _undiscounted),
        Case("gamma = 0", _only_now),
        Case("reward 1 for ever and true values: no advantage", _true_values, closed_form=_zeros_like_rewards, visible=True),
        Case("a long rollout", _long, draws=1),
        Case("values that require gradient", _many_ends, differentiate=_TD, visible=True),
        Case("single precision", _many_ends, dtype=torch.float32, visible=True),
        Case("gamma = 1.5", _with(_one_truncated, gamma=1.5), raises=["gamma"], visible=True, draws=1),
        Case("gae_lambda = -0.1", _with(_one_truncated, gae_lambda=-0.1), raises=["gae_lambda"], visible=True, draws=1),
        Case("gae_lambda = 2", _with(_one_truncated, gae_lambda=2), raises=["gae_lambda"], draws=1),
        *(
            Case(
                f"{name} with a column too few",
                _cut(name, _one_truncated),
                raises=_ROLLOUT_NAMES,
                visible=name == "truncated",
                draws=1,
            )
            for name in _ROLLOUT_NAMES
        ),
    ),
    misconceptions=(
        Misconception(
            "truncated-treated-as-terminated",
            _gae(bootstrap=lambda terminated, truncated: ~(terminated | truncated)),
            "A time limit does not end the task: bootstrap from next_values there. Only terminated removes the bootstrap.",
        ),
        Misconception(
            "termination-ignored",
            _gae(bootstrap=lambda terminated, truncated: torch.ones_like(terminated)),
            "After a terminated step nothing follows, so its bootstrap must vanish: multiply next_values by ~terminated.",
        ),
        Misconception(
            "recursion-runs-through-truncation",
            _gae(carry=lambda terminated, truncated: ~terminated),
            "The step after a truncated one belongs to another episode: the recursion must stop there as well.",
        ),
        Misconception(
            "recursion-never-stops",
            _gae(carry=lambda terminated, truncated: torch.ones_like(terminated)),
            "The residuals are right, but advantages leak from one episode into the one before: "
            "multiply the recursion by ~(terminated | truncated).",
        ),
        Misconception(
            "episode-ends-ignored",
            _gae(
                bootstrap=lambda terminated, truncated: torch.ones_like(terminated),
                carry=lambda terminated, truncated: torch.ones_like(terminated),
            ),
            "Neither the bootstrap nor the recursion looks at the episode's end: terminated removes the "
            "bootstrap, either flag stops the sum.",
        ),
        Misconception(
            "ended-mask-of-the-next-step",
            _gae(carry=_next_ended),
            "The recursion looks at the flag of step t + 1. Here a flag belongs to the step that it ends: use "
            "terminated[t] and truncated[t].",
        ),
        Misconception(
            "lambda-missing",
            _gae(factor=lambda gamma, gae_lambda: gamma),
            "The recursion decays by gamma alone, which is lambda = 1: multiply by gae_lambda as well.",
        ),
        Misconception(
            "gamma-missing-in-recursion",
            _gae(factor=lambda gamma, gae_lambda: gae_lambda),
            "The recursion decays by lambda alone: each step further is also discounted by gamma.",
        ),
        Misconception(
            "shifted-values-as-next-values",
            _gae(following=_shifted),
            "values[t + 1] is the value of whatever came next in the buffer; where an episode was cut, that is "
            "another episode. Use next_values.",
        ),
        Misconception(
            "residuals-only", _gae_residuals_only, "This is the one-step residual: later residuals are missing (lambda = 0)."
        ),
        Misconception(
            "values-added",
            _gae_plus_values,
            "These are the lambda-returns: advantages plus values. The advantage is the part above V.",
        ),
        Misconception(
            "wrong-axis", _gae_wrong_axis, "The sum runs over environments instead of time: the first axis is time, (T, N)."
        ),
        Misconception(
            "normalised-inside",
            lambda *args, **kwargs: ch44.normalize_advantages(ch44.compute_gae(*args, **kwargs)),
            "The advantages come back normalised. The critic's targets need them in units of reward: normalise later, for the policy only.",
        ),
        Misconception("graph-kept", _gae_graph, _DETACH),
        Misconception("dtype-lost", _gae_single, _DTYPE),
        Misconception(
            "rewards-changed-in-place",
            _gae_smuggled,
            "rewards += … changes the caller's buffer, and the next pass over the rollout adds the bootstrap again.",
        ),
        Misconception("bad-input-accepted", _gae(checked=False), _VALIDATE),
    ),
    variants={
        "plain Python, environment by environment": _gae_per_environment,
        "NumPy in double precision": _gae_numpy,
        "scan by doubling": _gae_doubling,
        "episode by episode, as a matrix product": _gae_by_episode,
        "in place in its own buffer": _gae_in_own_buffer,
    },
)

# -------------------------------------------------------------------------------------------------------- lambda_returns


def _pair(generator):
    return {"advantages": _normal(generator, 6, 3), "values": 3 + 2 * _normal(generator, 6, 3)}


def _tall_pair(generator):
    return {"advantages": 5 * _normal(generator, 40, 2), "values": -1 + _normal(generator, 40, 2)}


def _single_pair(generator):
    return {"advantages": _normal(generator, 1, 1), "values": _normal(generator, 1, 1)}


def _returns(formula):
    def wrong(advantages, values):
        validate.same_shape(advantages=advantages, values=values)
        return formula(advantages, values).detach()

    return wrong


def _returns_in_place(advantages, values):
    validate.same_shape(advantages=advantages, values=values)
    with torch.no_grad():
        advantages += values
    return advantages.detach().clone()


def _returns_graph(advantages, values):
    validate.same_shape(advantages=advantages, values=values)
    return advantages + values


def _returns_no_grad(advantages, values):
    _refuse(advantages=advantages, values=values)
    with torch.no_grad():
        return values + advantages


def _returns_numpy(advantages, values):
    _refuse(advantages=advantages, values=values)
    return torch.from_numpy(np.add(advantages.detach().numpy(), values.detach().numpy()))


def _returns_buffer(advantages, values):
    _refuse(advantages=advantages, values=values)
    returns = torch.empty_like(values, requires_grad=False)
    returns.copy_(values.detach()).add_(advantages.detach())
    return returns


def _returns_rows(advantages, values):
    _refuse(advantages=advantages, values=values)
    return torch.stack([a.double() + v.double() for a, v in zip(advantages.detach(), values.detach(), strict=True)]).to(
        values.dtype
    )


LAMBDA_RETURNS = Exercise(
    name="lambda_returns",
    reference=ch44.lambda_returns,
    criteria={"values": 0.6, "gradient": 0.2, "dtype": 0.05, "inputs": 0.05, "errors": 0.1},
    axes=("t", "env"),
    cases=(
        Case("a small rollout", _pair, visible=True),
        Case("a long rollout", _tall_pair, draws=3),
        Case("one step of one environment", _single_pair),
        Case("inputs that require gradient", _pair, differentiate=("advantages", "values"), visible=True),
        Case("single precision", _pair, dtype=torch.float32, visible=True),
        Case("values with a column too few", _cut("values", _pair), raises=["advantages", "values"], visible=True, draws=1),
        Case("advantages with a column too few", _cut("advantages", _pair), raises=["advantages", "values"], draws=1),
    ),
    misconceptions=(
        Misconception(
            "advantages-returned",
            _returns(lambda a, v: a.clone()),
            "The critic must be fitted to a return, not to the advantage: add the values that the advantage was measured against.",
        ),
        Misconception(
            "values-returned",
            _returns(lambda a, v: v.clone()),
            "Fitting the critic to its own values teaches it nothing: add the advantages.",
        ),
        Misconception(
            "difference-flipped",
            _returns(lambda a, v: v - a),
            "The advantage is return minus value, so the return is value plus advantage.",
        ),
        Misconception(
            "value-subtracted",
            _returns(lambda a, v: a - v),
            "The value was already subtracted inside the advantage: add it back.",
        ),
        Misconception(
            "advantages-normalised-first",
            _returns(lambda a, v: ch44.normalize_advantages(a) + v if a.numel() > 1 else a + v),
            "Normalised advantages have no unit of reward any more: form the returns first, normalise later.",
        ),
        Misconception(
            "values-of-the-next-step",
            _returns(lambda a, v: a + v.roll(-1, 0)),
            "The value to add is that of the same step, V(s_t).",
        ),
        Misconception("graph-kept", _returns_graph, "The target would move with the critic that chases it: detach it."),
        Misconception("dtype-lost", _returns(lambda a, v: (a + v).float()), _DTYPE),
        Misconception(
            "advantages-changed-in-place",
            _returns_in_place,
            "advantages += values changes the caller's advantages, which the policy's loss still needs.",
        ),
        Misconception("bad-input-accepted", lambda advantages, values: (advantages + values).detach(), SHAPES),
    ),
    variants={
        "under no_grad": _returns_no_grad,
        "NumPy": _returns_numpy,
        "its own buffer": _returns_buffer,
        "row by row in double precision": _returns_rows,
    },
)

# -------------------------------------------------------------------------------------------------- normalize_advantages


def _table(generator):
    return {"advantages": 2 + 3 * _normal(generator, 6, 3) * torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)}


def _flat(generator):
    return {"advantages": -1 + 0.2 * _normal(generator, 17)}


def _constant(generator):
    return {"advantages": torch.full((4, 2), 2.0, dtype=torch.float64)}


def _cube(generator):
    return {"advantages": 100 * _normal(generator, 3, 2, 5)}


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


def _normalize_mutating(advantages, eps=1e-8):
    result = ch44.normalize_advantages(advantages, eps)
    with torch.no_grad():
        advantages -= advantages.mean()
    return result


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
        Case("all advantages equal", _constant, closed_form=lambda advantages: torch.zeros_like(advantages), visible=True),
        Case("single precision", _table, dtype=torch.float32, visible=True),
    ),
    misconceptions=(
        Misconception(
            "normalised-per-environment",
            lambda advantages, eps=1e-8: (advantages - advantages.mean(0)) / (advantages.std(0) + eps),
            "Mean and deviation are taken along time for each environment apart: take them over all elements.",
        ),
        Misconception(
            "normalised-per-step",
            lambda advantages, eps=1e-8: (advantages - advantages.mean(-1, True)) / (advantages.std(-1, keepdim=True) + eps),
            "Mean and deviation are taken along the last axis: take them over all elements.",
        ),
        Misconception(
            "mean-not-subtracted",
            lambda advantages, eps=1e-8: advantages / (advantages.std() + eps),
            "The mean is still there: half of the actions should come out better than average.",
        ),
        Misconception(
            "deviation-not-divided",
            lambda advantages, eps=1e-8: advantages - advantages.mean(),
            "Centred, but still in units of reward: divide by the standard deviation.",
        ),
        Misconception(
            "variance-instead-of-deviation",
            lambda advantages, eps=1e-8: (advantages - advantages.mean()) / (advantages.var() + eps),
            "The divisor is the variance: take its square root.",
        ),
        Misconception(
            "eps-missing",
            lambda advantages, eps=1e-8: (advantages - advantages.mean()) / advantages.std(),
            "When all advantages are equal this is 0 / 0: eps belongs in the denominator.",
        ),
        Misconception(
            "scaled-to-unit-range",
            lambda advantages, eps=1e-8: (advantages - advantages.min()) / (advantages.max() - advantages.min() + eps),
            "This maps to [0, 1]: every action would look good. Use mean and standard deviation.",
        ),
        Misconception(
            "norm-instead-of-deviation",
            lambda advantages, eps=1e-8: (advantages - advantages.mean()) / ((advantages - advantages.mean()).norm() + eps),
            "Dividing by the norm makes the advantages shrink as the batch grows: divide by the standard deviation.",
        ),
        Misconception("dtype-lost", lambda advantages, eps=1e-8: ch44.normalize_advantages(advantages, eps).float(), _DTYPE),
        Misconception(
            "advantages-changed-in-place",
            _normalize_mutating,
            "advantages -= … changes the caller's advantages, which the critic's returns still need.",
        ),
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


def _critic(generator):
    returns = 4 * _normal(generator, 8, 3) + 1
    return {"values": returns + _normal(generator, 8, 3) + 2, "returns": returns}


def _flat_critic(generator):
    returns = _normal(generator, 25)
    return {"values": 0.5 * returns + 0.3 * _normal(generator, 25), "returns": returns}


def _bad_critic(generator):
    return {"values": 3 * _normal(generator, 8, 3), "returns": _normal(generator, 8, 3)}


def _perfect_critic(generator):
    returns = _normal(generator, 8, 3)
    return {"values": returns.clone(), "returns": returns}


def _shifted_critic(generator):
    returns = _normal(generator, 8, 3)
    return {"values": returns + 4, "returns": returns}


def _constant_returns(generator):
    return {"values": _normal(generator, 4, 2), "returns": torch.full((4, 2), 2.0, dtype=torch.float64)}


def _explained(formula):
    def wrong(values, returns):
        validate.same_shape(values=values, returns=returns)
        explained = formula(values, returns)
        return torch.where(returns.var() == 0, torch.full_like(explained, math.nan), explained).detach()

    return wrong


def _explained_naive(values, returns):
    validate.same_shape(values=values, returns=returns)
    return (1 - (returns - values).var() / returns.var()).detach()


def _explained_zero(values, returns):
    validate.same_shape(values=values, returns=returns)
    return torch.nan_to_num(ch44.explained_variance(values, returns), nan=0.0)


def _explained_graph(values, returns):
    validate.same_shape(values=values, returns=returns)
    explained = 1 - (returns - values).var() / returns.var()
    return torch.where(returns.var() == 0, math.nan, explained)


def _explained_biased(values, returns):
    _refuse(values=values, returns=returns)
    spread = returns.detach().var(correction=0)
    if spread == 0:
        return torch.full_like(spread, math.nan)
    return 1 - (returns - values).detach().var(correction=0) / spread


def _explained_numpy(values, returns):
    _refuse(values=values, returns=returns)
    v, r = values.detach().double().numpy(), returns.detach().double().numpy()
    spread = np.var(r)
    return torch.tensor(np.nan if spread == 0 else 1 - np.var(r - v) / spread, dtype=returns.dtype)


def _explained_sums(values, returns):
    _refuse(values=values, returns=returns)
    with torch.no_grad():
        residual = returns - values
        left = ((residual - residual.mean()) ** 2).sum()
        total = ((returns - returns.mean()) ** 2).sum()
        return (total - left) / total if total > 0 else total * math.nan


def _explained_deviations(values, returns):
    _refuse(values=values, returns=returns)
    with torch.no_grad():
        ratio = torch.std(returns - values) / torch.std(returns)
        return torch.where(torch.isinf(ratio), torch.full_like(ratio, math.nan), 1 - ratio * ratio)


EXPLAINED_VARIANCE = Exercise(
    name="explained_variance",
    reference=ch44.explained_variance,
    criteria={"values": 0.7, "gradient": 0.1, "dtype": 0.1, "errors": 0.1},
    cases=(
        Case("a good critic with an offset", _critic, visible=True, draws=3),
        Case("a flat batch", _flat_critic, visible=True),
        Case("a critic worse than a constant", _bad_critic, visible=True),
        Case("a perfect critic", _perfect_critic, closed_form=lambda values, returns: torch.ones((), dtype=returns.dtype)),
        Case(
            "a critic that is right up to a constant",
            _shifted_critic,
            closed_form=lambda values, returns: torch.ones((), dtype=returns.dtype),
        ),
        Case(
            "constant returns: NaN",
            _constant_returns,
            closed_form=lambda values, returns: torch.full((), math.nan, dtype=returns.dtype),
            visible=True,
        ),
        Case("values that require gradient", _critic, differentiate=("values", "returns"), visible=True),
        Case("single precision", _critic, dtype=torch.float32, visible=True),
        Case("values with a column too few", _cut("values", _critic), raises=["values", "returns"], visible=True, draws=1),
        Case("returns with a column too few", _cut("returns", _critic), raises=["values", "returns"], draws=1),
    ),
    misconceptions=(
        Misconception(
            "unexplained-share",
            _explained(lambda v, r: (r - v).var() / r.var()),
            "This is the share that is not explained: subtract it from 1.",
        ),
        Misconception(
            "squared-error-instead-of-variance",
            _explained(lambda v, r: 1 - (r - v).square().mean() / r.var(correction=0)),
            "Mean squared error also counts a constant offset (this is R²): the variance of the residual does not.",
        ),
        Misconception(
            "squared-error-over-unbiased-variance",
            _explained(lambda v, r: 1 - (r - v).square().mean() / r.var()),
            "Mean squared error also counts a constant offset (this is R²): the variance of the residual does not.",
        ),
        Misconception(
            "variance-of-values-below",
            _explained(lambda v, r: 1 - (r - v).var() / v.var()),
            "Divide by the variance of the returns, not of the values: arguments swapped?",
        ),
        Misconception(
            "ratio-of-variances",
            _explained(lambda v, r: v.var() / r.var()),
            "A critic can vary as much as the returns and still be wrong everywhere: look at the residual.",
        ),
        Misconception(
            "squared-correlation",
            _explained(lambda v, r: torch.corrcoef(torch.stack([v.flatten(), r.flatten()]))[0, 1].square()),
            "The squared correlation forgives a wrong scale and can't be negative.",
        ),
        Misconception(
            "deviations-instead-of-variances",
            _explained(lambda v, r: 1 - (r - v).std() / r.std()),
            "These are standard deviations: square them.",
        ),
        Misconception(
            "division-by-zero",
            _explained_naive,
            "Constant returns have no variance to explain: return NaN there, not minus infinity.",
        ),
        Misconception(
            "zero-for-constant-returns",
            _explained_zero,
            "0 would claim a useless critic; with constant returns nothing can be said: NaN.",
        ),
        Misconception("graph-kept", _explained_graph, "A metric carries no graph: detach it."),
        Misconception(
            "python-float",
            lambda values, returns: ch44.explained_variance(values, returns).item(),
            "Return a 0-dim tensor, not a Python float.",
        ),
        Misconception("dtype-lost", lambda values, returns: ch44.explained_variance(values, returns).float(), _DTYPE),
        Misconception(
            "bad-input-accepted",
            lambda values, returns: torch.where(
                returns.var() == 0, math.nan, 1 - (returns - values).var() / returns.var()
            ).detach(),
            _VALIDATE,
        ),
    ),
    variants={
        "biased variances": _explained_biased,
        "NumPy": _explained_numpy,
        "sums of squares": _explained_sums,
        "standard deviations, squared": _explained_deviations,
    },
)

# ------------------------------------------------------------------------------------------------------ repaired_targets


def _targets(advantages_of=ch44.normalize_advantages, returns_of=ch44.lambda_returns, gae=ch44.compute_gae, checked=True):
    def wrong(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
        advantages = gae(rewards, values, next_values, terminated, truncated, gamma, gae_lambda)
        return advantages_of(advantages), returns_of(advantages, values)

    return wrong


def _targets_swapped(*args, **kwargs):
    advantages, returns = ch44.repaired_targets(*args, **kwargs)
    return returns, advantages


def _targets_variant(gae, normalize, returns_of):
    def variant(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
        advantages = gae(rewards, values, next_values, terminated, truncated, gamma, gae_lambda)
        return normalize(advantages), returns_of(advantages, values)

    return variant


def _unrepaired_returns(advantages, values):
    return (ch44.normalize_advantages(advantages) + values).detach()


REPAIRED_TARGETS = Exercise(
    name="repaired_targets",
    reference=ch44.repaired_targets,
    also_right=(_targets(advantages_of=_biased),),
    criteria={"values": 1.6, "gradient": 0.2, "dtype": 0.05, "inputs": 0.05, "errors": 0.1},
    axes=("t", "env"),
    cases=(
        Case("no episode ends, default gamma and gae_lambda", _no_end, visible=True),
        Case("a time limit cuts one episode", _one_truncated, visible=True),
        Case("one episode terminates", _one_terminated, visible=True),
        Case("many episode ends", _many_ends, visible=True, draws=3),
        Case("values that require gradient", _many_ends, differentiate=_TD, visible=True),
        Case("single precision", _many_ends, dtype=torch.float32, visible=True),
        Case("gamma = 1.5", _with(_one_truncated, gamma=1.5), raises=["gamma"], visible=True, draws=1),
        Case("values with a column too few", _cut("values", _one_truncated), raises=_ROLLOUT_NAMES, draws=1),
    ),
    misconceptions=(
        Misconception(
            "returns-from-normalised-advantages",
            _targets(returns_of=_unrepaired_returns),
            "This is the suspect program's own bug. What unit do normalised advantages have, and what unit has a return?",
        ),
        Misconception(
            "advantages-not-normalised",
            _targets(advantages_of=lambda a: a),
            "The policy's advantages come back in units of reward: normalise them.",
        ),
        Misconception(
            "returns-normalised-too",
            _targets(returns_of=lambda a, v: ch44.normalize_advantages(ch44.lambda_returns(a, v))),
            "The critic's target must keep the unit of reward: it is compared with V(s).",
        ),
        Misconception(
            "normalised-per-environment",
            _targets(advantages_of=lambda a: (a - a.mean(0)) / (a.std(0) + 1e-8)),
            "Mean and deviation are taken for each environment apart: take them over all elements.",
        ),
        Misconception(
            "returns-are-advantages",
            _targets(returns_of=lambda a, v: a.clone()),
            "The critic would be fitted to the advantage: add the values back.",
        ),
        Misconception("outputs-swapped", _targets_swapped, "The order is (advantages, returns)."),
        Misconception(
            "truncated-treated-as-terminated",
            _targets(gae=_gae(bootstrap=lambda terminated, truncated: ~(terminated | truncated))),
            "A time limit does not end the task: bootstrap from next_values there.",
        ),
        Misconception(
            "recursion-never-stops",
            _targets(gae=_gae(carry=lambda terminated, truncated: torch.ones_like(terminated))),
            "Advantages leak from one episode into the one before: stop the recursion where an episode ended.",
        ),
        Misconception("graph-kept", _targets(gae=_gae_graph, returns_of=_returns_graph), _DETACH),
    ),
    variants={
        "NumPy": _targets_variant(_gae_numpy, _normalize_numpy, _returns_numpy),
        "scan by doubling, biased deviation": _targets_variant(_gae_doubling, _normalize_in_own_buffer, _returns_no_grad),
        "plain Python": _targets_variant(_gae_per_environment, _normalize_by_sums, _returns_rows),
        "its own buffers": _targets_variant(_gae_in_own_buffer, _normalize_eps_inside, _returns_buffer),
    },
)

EXERCISES = (TD_RESIDUALS, COMPUTE_GAE, LAMBDA_RETURNS, NORMALIZE_ADVANTAGES, EXPLAINED_VARIANCE, REPAIRED_TARGETS)
