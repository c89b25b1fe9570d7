"""Checks of chapter 47: cases, named misconceptions and correct variants for exact soft values, and for soft actor-critic."""

from __future__ import annotations

import math
from functools import partial
from types import SimpleNamespace
from typing import Any

import torch
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution
from torch.nn import functional as F

from autograder.authoring import wild
from autograder.authoring.parts import (
    CUT,
    DTYPE,
    NUMBER,
    after,
    bad_input_accepted,
    cut_from_graph,
    drawing,
    drawn_once,
    dtype_lost,
    in_place,
    integers,
    misshapen,
    normal,
    number,
    one_shape,
    python_float,
    refused,
    replaced,
    satisfies,
    shape_cases,
    spoilt,
    uniform,
    versions_of,
    without,
    wrong,
)
from autograder.authoring.spec import Case, Exercise, Misconception
from course_lib.checks.cases import built
from course_lib.control import sac
from solutions import ch47

HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


# ------------------------------------------------------------------------------------------------- soft_value_iteration


@drawing
def _problem(generator, states=4, actions=3, alpha=0.5, gamma=0.9, num_sweeps=40, ends=False, scale=1.0):
    """A problem of which everything is known. With `ends`, about every third pair of state and action ends the task."""
    transitions = (2 * normal(generator, states, actions, states)).softmax(-1)
    if ends:
        going_on = uniform(generator, states, actions, 1) > 0.35
        going_on[0, 0], going_on[-1, -1] = False, True
        transitions = transitions * going_on
    rewards = scale * normal(generator, states, actions)
    return {"rewards": rewards, "transitions": transitions, "alpha": alpha, "gamma": gamma, "num_sweeps": num_sweeps}


def _cell_by_cell(rewards, transitions, alpha, gamma=0.95, num_sweeps=300):
    """One number at a time; the largest exponent is taken out of each sum."""
    r, p = rewards.tolist(), transitions.tolist()
    values: list[float] = [0.0] * len(r)
    for _ in range(num_sweeps):
        q = [
            [r[s][a] + gamma * sum(chance * v for chance, v in zip(p[s][a], values, strict=True)) for a in range(len(r[s]))]
            for s in range(len(r))
        ]
        values = [max(row) + alpha * math.log(sum(math.exp((x - max(row)) / alpha) for x in row)) for row in q]
    policy = [[math.exp((x - v) / alpha) for x in row] for row, v in zip(q, values, strict=True)]
    return tuple(torch.tensor(table, dtype=rewards.dtype) for table in (q, values, policy))


def _ordinary(rewards, transitions, gamma, num_sweeps, **_rest):
    """Value iteration without entropy; no two actions are equally good."""
    values = torch.zeros_like(rewards[:, 0])
    for _ in range(num_sweeps):
        q = rewards + gamma * (transitions * values).sum(-1)
        values = q.amax(-1)
    return q, values, F.one_hot(q.argmax(-1), rewards.shape[1]).to(rewards.dtype)


def _geometric(rewards, alpha, gamma, num_sweeps, **_rest):
    """One state that leads to itself: each step is worth the same, and the values are a geometric series."""
    step = alpha * (rewards[0] / alpha).logsumexp(0)
    before, now = (step * (1 - gamma**n) / (1 - gamma) for n in (num_sweeps - 1, num_sweeps))
    return rewards + gamma * before, now[None], (rewards / alpha).softmax(-1)


@drawing
def _two_best(generator, actions=3, alpha=1e-6, gamma=0.9, num_sweeps=5):
    """One state that leads to itself, of whose actions the first two are equally good and the best by far."""
    rewards = uniform(generator, 1, actions) - 3
    rewards[:, :2] = 1 + uniform(generator, 1)
    transitions = torch.ones(1, actions, 1, dtype=torch.float64)
    return {"rewards": rewards, "transitions": transitions, "alpha": alpha, "gamma": gamma, "num_sweeps": num_sweeps}


def _shapes_fit(rewards, transitions):
    return transitions.shape == (*rewards.shape, rewards.shape[0])


_iterated = versions_of(
    ch47.soft_value_iteration,
    satisfies(_shapes_fit),
    satisfies(lambda alpha: alpha > 0),
    satisfies(lambda gamma: 0 <= gamma <= 1),
    satisfies(lambda num_sweeps: num_sweeps >= 1),
)


def _backed_up(r, p, v, gamma):
    return r + gamma * (p * v).sum(-1)


def _soft_maximum(q, alpha):
    return alpha * torch.logsumexp(q / alpha, -1)


def _sweeping(
    value=_soft_maximum,
    policy=lambda q, alpha: (q / alpha).softmax(-1),
    back=_backed_up,
    more=0,
    late=0,
    ahead=0,
    data=True,
    checked=True,
):
    """A version: `value` of a state's row of Q, `policy` of all rows, `back` for the first line; `more` sweeps than asked for, values
    that are `late`, of so many sweeps before, and a Q that is `ahead` by so many first lines.
    """

    def version(rewards, transitions, alpha, gamma, num_sweeps):
        r, history = rewards.detach() if data else rewards, [torch.zeros_like(rewards[:, 0])] * 2
        q = torch.zeros_like(rewards)
        for _ in range(num_sweeps + more):
            q = back(r, transitions, history[-1], gamma)
            history.append(value(q, alpha))
        for _ in range(ahead):
            q = back(r, transitions, history[-1], gamma)
        return q, history[-1 - late], policy(q, alpha)

    return _iterated(version, checked)


def _by_halves(q, alpha):
    """The soft maximum of a row, action by action."""
    columns = (q / alpha).unbind(-1)
    total = columns[0]
    for column in columns[1:]:
        total = torch.logaddexp(total, column)
    return alpha * total


def _largest_taken_out(q, alpha):
    top = q.amax(-1, keepdim=True)
    return (top + alpha * ((q - top) / alpha).exp().sum(-1, keepdim=True).log())[..., 0]


def _entropy_added(q, alpha):
    """The mean of Q and the wage, both under the policy."""
    log_policy = (q / alpha).log_softmax(-1)
    return (log_policy.exp() * (q - alpha * log_policy)).sum(-1)


def _by_difference(value):
    """The policy by its formula exp((Q - V) / α): a wrong V passes its fault on, and a right one the rounding of a difference."""
    return lambda q, alpha: ((q - value(q, alpha)[:, None]) / alpha).exp()


def _one_short(rewards, transitions, alpha, gamma, num_sweeps):
    """The loop ends one sweep early, so that after one that is asked for there is no Q."""
    values = torch.zeros_like(rewards[:, 0])
    with torch.no_grad():
        for _ in range(num_sweeps - 1):
            q = _backed_up(rewards, transitions, values, gamma)
            values = _soft_maximum(q, alpha)
        return q, values, (q / alpha).softmax(-1)


_WRONG_SOFT_VALUE_ITERATION: dict[str, tuple[dict[str, Any], str]] = {
    "hard-maximum": (
        {"value": lambda q, alpha: q.amax(-1)},
        "The value is that of the best action, as in ordinary value iteration. A soft value is α log Σ exp(Q/α): it lies above the"
        " maximum, since the policy is paid for its entropy, too.",
    ),
    "wage-missing": (
        {"value": lambda q, alpha: ((q / alpha).softmax(-1) * q).sum(-1)},
        "This is the mean of Q under the policy: the wage for its entropy, -α log π, is missing.",
    ),
    "not-multiplied-by-alpha": (
        {"value": lambda q, alpha: (q / alpha).logsumexp(-1)},
        "logsumexp(Q/α) is in nats: multiply it by α to have units of reward again.",
    ),
    "not-divided-by-alpha": (
        {"value": lambda q, alpha: alpha * q.logsumexp(-1)},
        "Q is in units of reward and α in reward per nat: divide Q by α before the exponential.",
    ),
    "mean-in-place-of-sum": (
        {"value": lambda q, alpha: _soft_maximum(q, alpha) - alpha * math.log(q.shape[-1])},
        "The exponentials are averaged over the actions: add them. The difference, α log A, is the wage of an even choice.",
    ),
    "overflow": (
        {"value": lambda q, alpha: alpha * (q / alpha).exp().sum(-1).log()},
        "exp(Q/α) is infinite, or 0 in all places, as soon as α is small beside Q: torch.logsumexp takes the largest exponent out first.",
    ),
    "policy-without-alpha": (
        {"policy": lambda q, alpha: q.softmax(-1)},
        "The policy is softmax(Q/α): here the temperature makes no difference to it.",
    ),
    "greedy-policy": (
        {"policy": lambda q, alpha: F.one_hot(q.argmax(-1), q.shape[-1]).to(q.dtype)},
        "The policy takes the best action only. The best *soft* policy gives each action a probability, softmax(Q/α).",
    ),
    "policy-of-all-states-together": (
        {"policy": lambda q, alpha: (q / alpha).softmax(0)},
        "Probabilities sum to 1 over the actions of a state, the last axis: these do over the states.",
    ),
    "gamma-missing": (
        {"back": lambda r, p, v, gamma: _backed_up(r, p, v, 1.0)},
        "What follows is not discounted: multiply it by gamma.",
    ),
    "gamma-on-the-reward": (
        {"back": lambda r, p, v, gamma: gamma * _backed_up(r, p, v, 1.0)},
        "The reward of this step is not discounted: gamma belongs to what follows.",
    ),
    "transitions-backwards": (
        {"back": lambda r, p, v, gamma: r + gamma * torch.einsum("tas,t->sa", p, v)},
        "The sum goes over the first axis of transitions, the state in which one acts: the state that follows is the last axis.",
    ),
    "ends-ignored": (
        {"back": lambda r, p, v, gamma: _backed_up(r, p / p.sum(-1, keepdim=True).clamp_min(1e-12), v, gamma)},
        "The probabilities are scaled to sum to 1. What they lack is the chance that the task ends with the step, after which nothing"
        " follows: take them as they are.",
    ),
    "one-sweep-more": ({"more": 1}, "There is a sweep too many: after one, from V = 0, Q is the reward."),
    "one-sweep-short-from-zero": ({"more": -1}, "There is a sweep too few: after one, from V = 0, Q is the reward, and not 0."),
    "values-of-the-sweep-before": (
        {"late": 1},
        "The values are those of the sweep before: they are to be the soft maximum of the Q that is returned.",
    ),
    "q-of-the-sweep-after": (
        {"ahead": 1},
        "Q is made once more after the last values: return the Q of which these values are the soft maximum, and its policy.",
    ),
    "graph-kept": (
        {"data": False},
        "The results carry the graph of all sweeps, which nobody differentiates: compute them under torch.no_grad().",
    ),
}

_SPREADING = ("hard-maximum", "not-multiplied-by-alpha", "mean-in-place-of-sum")
"""Mistakes in V that a policy by exp((Q - V) / α) shares."""

_WRONG_WITH_THEIR_POLICY = {
    f"{name}-and-its-policy": (
        parts | {"policy": _by_difference(parts["value"])},
        f"{message} The policy, exp((Q - V) / α), is wrong with it.",
    )
    for name, (parts, message) in ((name, _WRONG_SOFT_VALUE_ITERATION[name]) for name in _SPREADING)
}

_TABLES = ("rewards", "transitions")

SOFT_VALUE_ITERATION = Exercise(
    name="soft_value_iteration",
    reference=ch47.soft_value_iteration,
    criteria={"values": 1.5, "gradient": 0.1, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    cases=drawn_once(
        Case("four states, three actions", _problem(), closed_form=_cell_by_cell, visible=True, draws=2),
        Case("one sweep: Q is the reward", _problem(num_sweeps=1), closed_form=_cell_by_cell, visible=True),
        Case("three sweeps", _problem(num_sweeps=3), closed_form=_cell_by_cell, draws=2),
        Case("a cold one: ordinary value iteration", _problem(alpha=1e-8), closed_form=_ordinary, visible=True, draws=2),
        Case("a hot one", _problem(alpha=20.0), closed_form=_cell_by_cell),
        Case("rewards of thousands", _problem(scale=5e3, alpha=1.0), closed_form=_cell_by_cell, visible=True),
        Case("one state: a geometric series", _problem(states=1), closed_form=_geometric, visible=True),
        Case("a single action", _problem(actions=1), closed_form=_cell_by_cell),
        Case("as many states as actions", _problem(states=3), closed_form=_cell_by_cell),
        Case("the task may end", _problem(ends=True), closed_form=_cell_by_cell, visible=True),
        Case(
            "it ends with a chance",
            lambda generator: (drawn := _problem()(generator)) | {"transitions": 0.7 * drawn["transitions"]},
            closed_form=_cell_by_cell,
            visible=True,
        ),
        Case("gamma = 0", _problem(gamma=0.0), closed_form=_cell_by_cell),
        Case("gamma = 1, five sweeps", _problem(gamma=1.0, num_sweeps=5), closed_form=_cell_by_cell),
        Case("default settings", without(_problem(), "gamma", "num_sweeps"), closed_form=_cell_by_cell, visible=True),
        Case("rewards require gradient", _problem(), differentiate=("rewards",), visible=True),
        Case("single precision", _problem(num_sweeps=10), dtype=torch.float32, visible=True),
        Case(
            "a cold one in single precision, two equal actions",
            _two_best(),
            closed_form=_geometric,
            dtype=torch.float32,
            visible=True,
        ),
        misshapen("transitions without an action", _problem(), "transitions", lambda p: p[:, 1:], raises=_TABLES, draws=1),
        misshapen(
            "one table of transitions for all actions",
            _problem(),
            "transitions",
            lambda p: p[:, :1],
            raises=_TABLES,
            draws=1,
            visible=True,
        ),
        misshapen(
            "rewards of the states alone",
            _problem(),
            "rewards",
            lambda r: r[:, 0],
            raises=_TABLES,
            draws=1,
            visible=True,
        ),
        refused(_problem(), alpha=0.0, visible=True),
        refused(_problem(), alpha=-0.5),
        refused(_problem(), gamma=1.2, visible=True),
        refused(_problem(), gamma=-0.1),
        refused(_problem(), num_sweeps=0, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_SOFT_VALUE_ITERATION | _WRONG_WITH_THEIR_POLICY, lambda parts: _sweeping(**parts)),
        Misconception(
            "policy-by-a-difference",
            _sweeping(policy=_by_difference(_soft_maximum)),
            "exp((Q - V) / α) is right on paper. In a computer Q - V is rounded, and a small α makes the rounding large: these"
            " probabilities do not sum to 1. (Q / α).softmax(-1) takes the difference of exponents alone.",
        ),
        Misconception(
            "one-sweep-short",
            _iterated(_one_short),
            "There is a sweep too few, and so, where one is asked for, no Q at all: range(num_sweeps) counts num_sweeps of them.",
        ),
        Misconception(
            "dtype-lost", after(ch47.soft_value_iteration, lambda tables: tuple(table.float() for table in tables)), DTYPE
        ),
        in_place(ch47.soft_value_iteration, "rewards"),
        bad_input_accepted(_sweeping(checked=False)),
    ),
    variants={
        "sums of products": _sweeping(),
        "matrix products": _sweeping(back=lambda r, p, v, gamma: r + gamma * (p.flatten(0, 1) @ v).view_as(r)),
        "action by action": _sweeping(_by_halves),
        "the largest taken out by hand": _sweeping(_largest_taken_out),
        "mean and wage": _sweeping(_entropy_added),
        "the policy by logarithms": _sweeping(policy=lambda q, alpha: (q / alpha).log_softmax(-1).exp()),
    },
)

# ------------------------------------------------------------------------------------------- squashed_gaussian_log_prob

_SQUASHED = ("mean", "log_std", "pre_tanh_actions")


@drawing
def _squashed(generator, size=7, dims=3, reach=1.0, base=-0.5):
    """Pre-activations at `reach` standard deviations from the mean or so."""
    mean, log_std = normal(generator, size, dims), base + 0.4 * normal(generator, size, dims)
    drawn = mean + reach * log_std.exp() * normal(generator, size, dims)
    return {"mean": mean, "log_std": log_std, "pre_tanh_actions": drawn}


@drawing
def _saturated(generator, size=6, dims=2, low=12.0, high=60.0):
    """Pre-activations whose hyperbolic tangent is ±1 to the computer, of policies that are sure of them."""
    signs = torch.where(uniform(generator, size, dims) < 0.5, -1.0, 1.0).double()
    mean = signs * (low + (high - low) * uniform(generator, size, dims))
    log_std = -0.5 + 0.3 * normal(generator, size, dims)
    return {"mean": mean, "log_std": log_std, "pre_tanh_actions": mean + log_std.exp() * normal(generator, size, dims)}


def _at_rest(generator):
    """u = μ = 0, where squashing changes nothing."""
    drawn = _squashed()(generator)
    return drawn | {"mean": torch.zeros_like(drawn["mean"]), "pre_tanh_actions": torch.zeros_like(drawn["mean"])}


def _by_hyperbolic_cosine(mean, log_std, pre_tanh_actions):
    """One number at a time: 1 - tanh² u = 1 / cosh² u."""
    terms = []
    for m, s, u in zip(*(x.flatten().tolist() for x in (mean, log_std, pre_tanh_actions)), strict=True):
        log_cosh = abs(u) + math.log1p(math.exp(-2 * abs(u))) - math.log(2)
        terms.append(-0.5 * ((u - m) / math.exp(s)) ** 2 - s - HALF_LOG_TWO_PI + 2 * log_cosh)
    return torch.tensor(terms, dtype=mean.dtype).view_as(mean).sum(-1)


def _normal(m, s, u):
    return -0.5 * ((u - m) / s.exp()) ** 2 - s - HALF_LOG_TWO_PI


def _slope(u):
    """log(1 - tanh² u), stable."""
    return 2 * (math.log(2) - u - F.softplus(-2 * u))


def _squashed_normal(m, s, u):
    return (_normal(m, s, u) - _slope(u)).sum(-1)


_density = versions_of(ch47.squashed_gaussian_log_prob, one_shape(*_SQUASHED))


def _distribution_object(m, s, u):
    squashed = TransformedDistribution(Independent(Normal(m, s.exp()), 1), [TanhTransform(cache_size=1)])
    transform = squashed.transforms[-1]
    return squashed.base_dist.log_prob(u) - transform.log_abs_det_jacobian(u, u.tanh()).sum(-1)


_WRONG_SQUASHED_GAUSSIAN_LOG_PROB = {
    "squashing-ignored": (
        lambda m, s, u: _normal(m, s, u).sum(-1),
        "This is the density of u. tanh squeezes the line into (-1, 1), and the density of tanh(u) is higher by 1 / (1 - tanh² u)"
        " in each component: subtract log(1 - tanh² u).",
    ),
    "correction-added": (
        lambda m, s, u: (_normal(m, s, u) + _slope(u)).sum(-1),
        "The correction has the wrong sign: where tanh is flat, many u end up close together, and the density is higher.",
    ),
    "unstable": (
        lambda m, s, u: (_normal(m, s, u) - (1 - u.tanh().square()).log()).sum(-1),
        "For |u| above 20 the tangent rounds to ±1, 1 - tanh² u to 0, and its logarithm is -inf:"
        " 2 (log 2 - u - softplus(-2u)) is the same and is right everywhere.",
    ),
    "epsilon": (
        lambda m, s, u: (_normal(m, s, u) - (1 - u.tanh().square() + 1e-6).log()).sum(-1),
        "The 1e-6 inside the logarithm avoids -inf, but the density of saturated actions is then wrong by any amount, and its"
        " gradient is 0: use 2 (log 2 - u - softplus(-2u)).",
    ),
    "clamped": (
        lambda m, s, u: (_normal(m, s, u) - (1 - u.tanh().square()).clamp(1e-6, 1).log()).sum(-1),
        "The clamp avoids -inf, but beyond it the density is wrong and its gradient 0: use 2 (log 2 - u - softplus(-2u)).",
    ),
    "half-of-the-correction": (
        lambda m, s, u: (_normal(m, s, u) - 0.5 * _slope(u)).sum(-1),
        "log(1 - tanh² u) is *twice* log 2 - u - softplus(-2u): the factor 2 comes from the square and is missing.",
    ),
    "slope-without-square": (
        lambda m, s, u: (_normal(m, s, u) - (1 - u.tanh()).clamp_min(1e-300).log()).sum(-1),
        "The derivative of tanh u is 1 - tanh² u: the square is missing.",
    ),
    "squashed-action-in-the-normal-density": (
        lambda m, s, u: (_normal(m, s, u.tanh()) - _slope(u)).sum(-1),
        "The normal density is that of u, before squashing: it is given tanh(u) here.",
    ),
    "mean-squashed": (
        lambda m, s, u: (_normal(m.tanh(), s, u) - _slope(u)).sum(-1),
        "The mean of u is `mean` itself: only the action is squashed.",
    ),
    "log-std-taken-as-std": (
        lambda m, s, u: (-0.5 * ((u - m) / s) ** 2 - s.abs().log() - HALF_LOG_TWO_PI - _slope(u)).sum(-1),
        "log_std is the logarithm of the standard deviation: take its exponential before dividing.",
    ),
    "correction-once": (
        lambda m, s, u: _normal(m, s, u).sum(-1) - _slope(u).mean(-1),
        "Every component is squashed: sum the corrections, as the normal log-densities are summed.",
    ),
    "not-summed": (
        lambda m, s, u: _normal(m, s, u) - _slope(u),
        "One number for each sample, (B,): the components are independent, so their log-densities add up.",
    ),
    "summed-over-samples": (
        lambda m, s, u: (_normal(m, s, u) - _slope(u)).sum(0),
        "Sum over the action's components, the last axis, not over the samples.",
    ),
    "actions-detached": (
        lambda m, s, u: _squashed_normal(m, s, u.detach()),
        "No gradient passes through pre_tanh_actions. In SAC the action is a function of the policy's outputs, u = μ + σ ε, and"
        " without this path the policy's entropy never learns.",
    ),
}

SQUASHED_GAUSSIAN_LOG_PROB = Exercise(
    name="squashed_gaussian_log_prob",
    reference=ch47.squashed_gaussian_log_prob,
    criteria={"values": 1.3, "gradient": 0.4, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("sample",),
    cases=drawn_once(
        Case("seven actions of three components", _squashed(), closed_form=_by_hyperbolic_cosine, visible=True, draws=2),
        Case(
            "at rest: the normal density",
            _at_rest,
            closed_form=lambda mean, log_std, pre_tanh_actions: -(log_std + HALF_LOG_TWO_PI).sum(-1),
            visible=True,
        ),
        Case("a single component", _squashed(dims=1), closed_form=_by_hyperbolic_cosine, visible=True),
        Case("a single action", _squashed(1), closed_form=_by_hyperbolic_cosine),
        Case("deviations around e⁴", _squashed(base=4.0), closed_form=_by_hyperbolic_cosine),
        Case("as many samples as components", _squashed(4, 4), closed_form=_by_hyperbolic_cosine),
        Case("far into saturation", _saturated(), closed_form=_by_hyperbolic_cosine, visible=True, draws=2),
        Case("u of hundreds", _saturated(low=200.0, high=900.0), closed_form=_by_hyperbolic_cosine),
        Case("all inputs require gradient", _squashed(), differentiate=_SQUASHED, visible=True, draws=2),
        Case("gradient in saturation", _saturated(), differentiate=_SQUASHED),
        Case("single precision", _squashed(), dtype=torch.float32, visible=True),
        *shape_cases(_squashed(), _SQUASHED),
    ),
    misconceptions=(
        *wrong(_WRONG_SQUASHED_GAUSSIAN_LOG_PROB, _density),
        *spoilt(ch47.squashed_gaussian_log_prob, cut_from_graph, dtype_lost, changed="pre_tanh_actions"),
        bad_input_accepted(_density(_squashed_normal, checked=False)),
    ),
    variants={
        "distribution objects": _density(_distribution_object),
        "log cosh": _density(
            lambda m, s, u: (Normal(m, s.exp()).log_prob(u) + 2 * (u.abs() + (-2 * u.abs()).exp().log1p() - math.log(2))).sum(-1)
        ),
        "logsigmoid": _density(
            lambda m, s, u: (_normal(m, s, u) - math.log(4) - F.logsigmoid(2 * u) - F.logsigmoid(-2 * u)).sum(-1)
        ),
        "logaddexp, component by component": _density(
            lambda *given: sum(
                _normal(m, s, u) - 2 * (math.log(2) - torch.logaddexp(u, -u))
                for m, s, u in zip(*(x.T for x in given), strict=True)
            )
        ),
        "in double precision": _density(lambda m, s, u: _squashed_normal(m.double(), s.double(), u.double()).to(m.dtype)),
    },
)

# ---------------------------------------------------------------------------------------------------------- soft_q_target

_TARGET = ("rewards", "next_q1", "next_q2", "next_log_probs")
_TARGET_SHAPES = ("rewards", "terminated", "next_q1", "next_q2", "next_log_probs")


@drawing
def _steps(generator, size=8, alpha=0.3, gamma=0.97, ends=None, **fixed):
    """Steps of which about every third terminates, unless all or none do."""
    first = 20 + 5 * normal(generator, size)
    terminated = uniform(generator, size) < 0.35
    terminated[0], terminated[-1] = True, False
    return {
        "rewards": normal(generator, size),
        "terminated": terminated if ends is None else torch.full_like(terminated, ends),
        "next_q1": first,
        "next_q2": first + 2 * normal(generator, size),
        "next_log_probs": 1.5 + 3 * normal(generator, size),
        "alpha": alpha,
        "gamma": gamma,
    } | fixed


_ALPHA_TENSOR = replaced(_steps(), alpha=torch.tensor(0.7, dtype=torch.float64))


def _target_by_steps(rewards, terminated, next_q1, next_q2, next_log_probs, alpha, gamma=0.99):
    rows = zip(rewards.tolist(), terminated.tolist(), next_q1.tolist(), next_q2.tolist(), next_log_probs.tolist(), strict=True)
    return torch.tensor(
        [r if ended else r + gamma * (min(q1, q2) - float(alpha) * lp) for r, ended, q1, q2, lp in rows], dtype=rewards.dtype
    )


_checked_target = versions_of(ch47.soft_q_target, one_shape(*_TARGET_SHAPES), satisfies(lambda gamma: 0 <= gamma <= 1))


def _target(formula, checked=True, detached=True):
    """A version: `formula` takes r, c (1 where the task goes on, else 0), q1, q2, log_probs, alpha, gamma."""

    def version(rewards, terminated, *others):
        result = formula(rewards, 1 - terminated.to(rewards.dtype), *others)
        return result.detach() if detached else result

    return _checked_target(version, checked)


def _soft(r, c, q1, q2, lp, alpha, gamma):
    return r + gamma * c * (torch.minimum(q1, q2) - alpha * lp)


def _fixed(**fixed):
    """A version in which some terms of the target are these, whatever the caller says."""
    return lambda *terms: _soft(**(dict(zip(("r", "c", "q1", "q2", "lp", "alpha", "gamma"), terms, strict=True)) | fixed))


def _worth(value):
    """A version: `value` of what follows, from both critics and the entropy's worth h."""
    return _target(lambda r, c, q1, q2, lp, alpha, gamma: r + gamma * c * value(q1, q2, -alpha * lp))


def _masked_assignment(r, c, q1, q2, lp, alpha, gamma):
    following = (torch.stack([q1, q2]).amin(0) - alpha * lp).clone()
    following[c == 0] = 0
    return r + gamma * following


_WRONG_VALUES = {
    "maximum-of-the-critics": (
        lambda q1, q2, h: torch.maximum(q1, q2) + h,
        "This is the larger of the two values. The policy seeks out what is overestimated: the smaller one guards against that.",
    ),
    "mean-of-the-critics": (
        lambda q1, q2, h: 0.5 * (q1 + q2) + h,
        "This is the mean of the two values: the minimum is what guards against overestimation.",
    ),
    "first-critic-only": (lambda q1, q2, h: q1 + h, "next_q2 is not used: the target takes the smaller of the two values."),
    "second-critic-only": (lambda q1, q2, h: q2 + h, "next_q1 is not used: the target takes the smaller of the two values."),
    "entropy-missing": (
        lambda q1, q2, h: torch.minimum(q1, q2),
        "The next state's soft value is min(Q₁, Q₂) - α log π: the entropy term is missing, as in TD3.",
    ),
    "entropy-with-the-wrong-sign": (
        lambda q1, q2, h: torch.minimum(q1, q2) - h,
        "Randomness is rewarded: the entropy is -log π, so α log π is subtracted.",
    ),
}

_WRONG_SOFT_Q_TARGET = {
    "alpha-missing": (_fixed(alpha=1.0), "alpha is not used: it is the price of a nat of entropy in units of reward."),
    "entropy-of-the-end": (
        lambda r, c, q1, q2, lp, alpha, gamma: r + gamma * (c * torch.minimum(q1, q2) - alpha * lp),
        "The entropy term is left standing where the task has ended: after the end no action is taken, and none is random.",
    ),
    "entropy-not-discounted": (
        lambda r, c, q1, q2, lp, alpha, gamma: r + c * (gamma * torch.minimum(q1, q2) - alpha * lp),
        "The entropy is that of the next action, one step away: it is discounted as the value is.",
    ),
    "entropy-outside-the-bracket": (
        lambda r, c, q1, q2, lp, alpha, gamma: r + gamma * c * torch.minimum(q1, q2) - alpha * lp,
        "The entropy term stands outside the bracket: it is the next action's, so it is discounted as the value is, and falls away"
        " where the task has ended.",
    ),
    "end-ignored": (_fixed(c=1.0), "terminated is not used: nothing follows where the task has ended."),
    "end-inverted": (
        lambda r, c, q1, q2, lp, alpha, gamma: _soft(r, 1 - c, q1, q2, lp, alpha, gamma),
        "The bootstrap is kept where the task has ended and dropped where it goes on: multiply by 1 - terminated.",
    ),
    "reward-dropped-at-the-end": (
        lambda r, c, q1, q2, lp, alpha, gamma: _soft(r, c, q1, q2, lp, alpha, gamma) * c,
        "The last reward is paid, too: only what follows it falls away.",
    ),
    "gamma-missing": (_fixed(gamma=1.0), "What follows is not discounted: multiply it by gamma."),
    "gamma-on-the-reward": (
        lambda r, c, q1, q2, lp, alpha, gamma: gamma * _soft(r, c, q1, q2, lp, alpha, 1.0),
        "The reward of this step is not discounted: gamma belongs to what follows.",
    ),
}

SOFT_Q_TARGET = Exercise(
    name="soft_q_target",
    reference=ch47.soft_q_target,
    criteria={"values": 1.0, "gradient": 0.2, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("step",),
    cases=drawn_once(
        Case("eight steps", _steps(), closed_form=_target_by_steps, visible=True, draws=2),
        Case("default gamma", without(_steps(), "gamma"), closed_form=_target_by_steps, visible=True),
        Case("all steps terminate: the reward", _steps(ends=True), closed_form=lambda rewards, **_rest: rewards, visible=True),
        Case("no step terminates", _steps(ends=False), closed_form=_target_by_steps),
        Case("alpha = 0: a plain target", _steps(alpha=0.0), closed_form=_target_by_steps, visible=True),
        Case("gamma = 1", _steps(gamma=1.0), closed_form=_target_by_steps),
        Case("alpha is a tensor", _ALPHA_TENSOR, closed_form=_target_by_steps, visible=True),
        Case("all inputs require gradient", _ALPHA_TENSOR, differentiate=(*_TARGET, "alpha"), visible=True, draws=2),
        Case("single precision", _steps(), dtype=torch.float32, visible=True),
        *shape_cases(_steps(), _TARGET_SHAPES),
        refused(_steps(), gamma=1.2, visible=True),
        refused(_steps(), gamma=-0.1),
    ),
    misconceptions=(
        *wrong(_WRONG_VALUES, _worth),
        *wrong(_WRONG_SOFT_Q_TARGET, _target),
        Misconception(
            "graph-kept",
            _target(_soft, detached=False),
            "A target is data. With a graph, the critics' loss also pulls at the target networks, the policy and the temperature:"
            " compute it under torch.no_grad().",
        ),
        *spoilt(ch47.soft_q_target, dtype_lost, changed="rewards"),
        bad_input_accepted(_target(_soft, checked=False)),
    ),
    variants={
        "multiplied by 1 - terminated": _target(_soft),
        "logical not": _target(lambda r, c, q1, q2, lp, alpha, gamma: r + (c > 0) * gamma * (torch.min(q1, q2) - alpha * lp)),
        "filled with 0": _target(_masked_assignment),
        "minimum by halves": _worth(lambda q1, q2, h: 0.5 * (q1 + q2 - (q1 - q2).abs()) + h),
        "step by step": _target(
            lambda r, c, q1, q2, lp, alpha, gamma: torch.stack(
                [r[i] + (gamma * (min(q1[i], q2[i]) - alpha * lp[i]) if c[i] else torch.zeros_like(r[i])) for i in range(len(r))]
            )
        ),
    },
)

# ------------------------------------------------------------------------------------------------------------ critic_loss

_CRITICS = ("q1", "q2", "targets")


@drawing
def _fitted(generator, size=9):
    targets = 4 + 3 * normal(generator, size)
    return {"q1": targets + normal(generator, size), "q2": targets + 0.5 + 2 * normal(generator, size), "targets": targets}


def _exact(generator):
    """Both critics say what they should."""
    targets = normal(generator, 5)
    return {"q1": targets, "q2": targets.clone(), "targets": targets.clone()}


def _errors_by_samples(q1, q2, targets):
    rows = list(zip(q1.tolist(), q2.tolist(), targets.tolist(), strict=True))
    return torch.tensor(sum((a - y) ** 2 + (b - y) ** 2 for a, b, y in rows) / len(rows), dtype=q1.dtype)


_fitting = versions_of(ch47.critic_loss, one_shape(*_CRITICS), data=["targets"])


def _both(q1, q2, y):
    return F.mse_loss(q1, y) + F.mse_loss(q2, y)


_WRONG_CRITIC_LOSS = {
    "halved": (
        lambda *given: 0.5 * _both(*given),
        "This is half of the loss: the two mean squared errors are added, not averaged.",
    ),
    "first-critic-only": (
        lambda q1, q2, y: F.mse_loss(q1, y),
        "q2 is not used: it never learns, and the minimum is then by chance.",
    ),
    "second-critic-only": (
        lambda q1, q2, y: F.mse_loss(q2, y),
        "q1 is not used: it never learns, and the minimum is then by chance.",
    ),
    "minimum-fitted": (
        lambda q1, q2, y: F.mse_loss(torch.minimum(q1, q2), y),
        "Only the smaller of the two values is fitted, and the larger one runs free: both learn from each step; the minimum belongs"
        " into the target.",
    ),
    "mean-fitted": (
        lambda q1, q2, y: 2 * F.mse_loss(0.5 * (q1 + q2), y),
        "The mean of both critics is fitted: they may then err by any amount in opposite directions. Each has an error of its own.",
    ),
    "absolute-errors": (
        lambda q1, q2, y: (q1 - y).abs().mean() + (q2 - y).abs().mean(),
        "These are absolute errors: a critic that minimises them learns medians of the targets, not their means. Square them.",
    ),
    "summed": (
        lambda *given: _both(*given) * len(given[0]),
        "This is the sum over the batch: take the mean, or the step grows with the batch.",
    ),
    "not-averaged": (
        lambda q1, q2, y: (q1 - y).square() + (q2 - y).square(),
        "One number is asked for: take the mean over the batch.",
    ),
    "sign-flipped": (
        lambda *given: -_both(*given),
        "A loss is minimised: this one is smallest where the critics are infinitely wrong.",
    ),
    "fitted-to-each-other": (
        lambda q1, q2, y: F.mse_loss(q1, y) + F.mse_loss(q2, q1),
        "The second critic is fitted to the first: both have the same target.",
    ),
    "values-detached": (lambda q1, q2, y: _both(q1.detach(), q2.detach(), y), CUT),
}

CRITIC_LOSS = Exercise(
    name="critic_loss",
    reference=ch47.critic_loss,
    criteria={"values": 0.6, "gradient": 0.2, "dtype": 0.05, "inputs": 0.05, "errors": 0.1},
    cases=drawn_once(
        Case("nine samples", _fitted(), closed_form=_errors_by_samples, visible=True, draws=2),
        Case("both are right: 0", _exact, closed_form=number(0.0), visible=True),
        Case("a single sample", _fitted(1), closed_form=_errors_by_samples),
        Case("all inputs require gradient", _fitted(), differentiate=_CRITICS, visible=True, draws=2),
        Case("single precision", _fitted(), dtype=torch.float32, visible=True),
        *shape_cases(_fitted(), _CRITICS),
        misshapen("targets in a column", _fitted(), "targets", lambda y: y[:, None], raises=_CRITICS, draws=1, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_CRITIC_LOSS, _fitting),
        Misconception(
            "gradient-into-the-targets",
            _fitting(_both, leak=True),
            "The targets get gradient: whatever made them would be moved towards the critics. Detach them.",
        ),
        *spoilt(ch47.critic_loss, python_float, dtype_lost, changed="q1"),
        bad_input_accepted(_fitting(_both, checked=False)),
    ),
    variants={
        "mse_loss": _fitting(_both),
        "both at once": _fitting(lambda q1, q2, y: (torch.stack([q1, q2]) - y).square().mean(1).sum()),
        "sample by sample": _fitting(
            lambda q1, q2, y: sum((q1[i] - y[i]) ** 2 + (q2[i] - y[i]) ** 2 for i in range(len(y))) / len(y)
        ),
        "products": _fitting(lambda q1, q2, y: ((q1 - y) @ (q1 - y) + (q2 - y) @ (q2 - y)) / len(y)),
    },
)

# ---------------------------------------------------------------------------------------------------------- sac_actor_loss

_ACTOR = ("q1", "q2", "log_probs")


@drawing
def _judged(generator, size=9, alpha=0.25):
    first = 3 + 4 * normal(generator, size)
    second, log_probs = first + 2 * normal(generator, size), 1.0 + 2 * normal(generator, size)
    return {"q1": first, "q2": second, "log_probs": log_probs, "alpha": alpha}


_JUDGED_ALPHA_TENSOR = replaced(_judged(), alpha=torch.tensor(0.6, dtype=torch.float64))


def _actor_by_samples(q1, q2, log_probs, alpha):
    rows = zip(q1.tolist(), q2.tolist(), log_probs.tolist(), strict=True)
    terms = [float(alpha) * lp - min(a, b) for a, b, lp in rows]
    return torch.tensor(sum(terms) / len(terms), dtype=q1.dtype)


_actor = versions_of(ch47.sac_actor_loss, one_shape(*_ACTOR), data=["alpha"])


def _soft_value(q1, q2, lp, alpha):
    return (alpha * lp - torch.minimum(q1, q2)).mean()


def _gain(gain):
    """A version: minus the mean of a `gain` from both critics and the entropy's worth h."""
    return _actor(lambda q1, q2, lp, alpha: -gain(q1, q2, -alpha * lp).mean())


_WRONG_GAINS = {
    "value-minimised": (
        lambda q1, q2, h: h - torch.minimum(q1, q2),
        "A loss is minimised: with +Q the policy learns the worst actions.",
    ),
    "entropy-minimised": (
        lambda q1, q2, h: torch.minimum(q1, q2) - h,
        "The entropy is -log π, and minimising -α log π makes the policy less random: the sign is wrong.",
    ),
    "maximum-of-the-critics": (
        lambda q1, q2, h: torch.maximum(q1, q2) + h,
        "This is the larger of the two values: the policy would chase every overestimate.",
    ),
    "mean-of-the-critics": (
        lambda q1, q2, h: 0.5 * (q1 + q2) + h,
        "This is the mean of the two values: take the smaller one, sample by sample.",
    ),
    "first-critic-only": (lambda q1, q2, h: q1 + h, "q2 is not used: take the smaller of the two values, sample by sample."),
    "entropy-missing": (
        lambda q1, q2, h: torch.minimum(q1, q2),
        "The entropy's worth is missing, and the policy's noise shrinks to nothing.",
    ),
}

_WRONG_SAC_ACTOR_LOSS = {
    "objective-instead-of-loss": (
        lambda *given: -_soft_value(*given),
        "This is what the policy should maximise: a loss is minus that.",
    ),
    "minimum-of-means": (
        lambda q1, q2, lp, alpha: (alpha * lp).mean() - torch.minimum(q1.mean(), q2.mean()),
        "The minimum is taken for each sample, before the mean: here one critic judges the whole batch.",
    ),
    "alpha-missing": (
        lambda q1, q2, lp, alpha: _soft_value(q1, q2, lp, 1.0),
        "alpha is not used: it is the price of a nat of entropy in units of reward.",
    ),
    "summed": (
        lambda *given: _soft_value(*given) * len(given[0]),
        "This is the sum over the batch: take the mean, or the step grows with the batch.",
    ),
    "value-detached": (
        lambda q1, q2, lp, alpha: _soft_value(q1.detach(), q2.detach(), lp, alpha),
        "No gradient passes through the values, which is how the policy learns what pays: to keep the critics' weights fixed,"
        " leave them out of the optimiser, not the values out of the graph.",
    ),
    "log-probs-detached": (
        lambda q1, q2, lp, alpha: _soft_value(q1, q2, lp.detach(), alpha),
        "No gradient passes through log_probs: the policy never learns to stay random.",
    ),
}

SAC_ACTOR_LOSS = Exercise(
    name="sac_actor_loss",
    reference=ch47.sac_actor_loss,
    criteria={"values": 0.6, "gradient": 0.2, "dtype": 0.05, "inputs": 0.05, "errors": 0.1},
    cases=drawn_once(
        Case("nine samples", _judged(), closed_form=_actor_by_samples, visible=True, draws=2),
        Case(
            "alpha = 0: minus the smaller value",
            _judged(alpha=0.0),
            closed_form=lambda q1, q2, **_rest: -torch.stack([q1, q2]).amin(0).mean(),
            visible=True,
        ),
        Case("a single sample", _judged(1), closed_form=_actor_by_samples, visible=True),
        Case("a high price of entropy", _judged(alpha=4.0), closed_form=_actor_by_samples),
        Case("alpha is a tensor", _JUDGED_ALPHA_TENSOR, closed_form=_actor_by_samples, visible=True),
        Case("all inputs require gradient", _JUDGED_ALPHA_TENSOR, differentiate=(*_ACTOR, "alpha"), visible=True, draws=2),
        Case("single precision", _judged(), dtype=torch.float32, visible=True),
        *shape_cases(_judged(), _ACTOR),
    ),
    misconceptions=(
        *wrong(_WRONG_GAINS, _gain),
        *wrong(_WRONG_SAC_ACTOR_LOSS, _actor),
        Misconception(
            "gradient-into-alpha",
            _actor(_soft_value, leak=True),
            "alpha gets gradient from the policy's loss, which would drive it to 0 or beyond: it has a loss of its own.",
        ),
        *spoilt(ch47.sac_actor_loss, cut_from_graph, dtype_lost, changed="q1"),
        bad_input_accepted(_actor(_soft_value, checked=False)),
    ),
    variants={
        "minus the soft value": _actor(lambda q1, q2, lp, alpha: -(torch.min(q1, q2) - alpha * lp).mean()),
        "means apart": _actor(lambda q1, q2, lp, alpha: alpha * lp.mean() - torch.stack([q1, q2]).amin(0).mean()),
        "sum over count": _actor(lambda q1, q2, lp, alpha: (lp.mul(alpha) - torch.where(q1 < q2, q1, q2)).sum() / len(lp)),
        "sample by sample": _actor(
            lambda q1, q2, lp, alpha: sum(alpha * lp[i] - min(q1[i], q2[i]) for i in range(len(lp))) / len(lp)
        ),
    },
)

# -------------------------------------------------------------------------------------------------------- temperature_loss


@drawing
def _temperature(generator, size=9, log_alpha=-1.2, target_entropy=-3.0):
    log_alpha, log_probs = log_alpha + 0.3 * normal(generator), 1.5 + 2 * normal(generator, size)
    return {"log_alpha": log_alpha, "log_probs": log_probs, "target_entropy": target_entropy}


def _on_target(generator):
    """The batch's entropy is exactly the target."""
    drawn = _temperature()(generator)
    return drawn | {"log_probs": drawn["log_probs"] - drawn["log_probs"].mean() + 3.0}


def _temperature_by_hand(log_alpha, log_probs, target_entropy):
    mean = sum(log_probs.tolist()) / len(log_probs)
    return torch.tensor(-math.exp(log_alpha.item()) * (mean + target_entropy), dtype=log_probs.dtype)


_WRONG_TEMPERATURE_LOSS = {
    "sign-flipped": (
        lambda log_alpha, lp, target: (log_alpha.exp() * (lp.detach() + target)).mean(),
        "The temperature falls where it should rise: while the policy's entropy, -mean(log π), is below the target, descending"
        " the loss must make α larger.",
    ),
    "log-alpha-taken-as-alpha": (
        lambda log_alpha, lp, target: -(log_alpha * (lp.detach() + target)).mean(),
        "α is exp(log_alpha). The loss with log α in place of α has another value and another gradient."
        + wild.also("log_alpha", "temperature_loss"),
    ),
    "target-subtracted": (
        lambda log_alpha, lp, target: -(log_alpha.exp() * (lp.detach() - target)).mean(),
        "The policy's entropy is -log π: the difference between the target and it is log π + target_entropy.",
    ),
    "target-missing": (
        lambda log_alpha, lp, target: -(log_alpha.exp() * lp.detach()).mean(),
        "target_entropy is not used: without it the temperature never settles.",
    ),
    "not-averaged": (
        lambda log_alpha, lp, target: -(log_alpha.exp() * (lp.detach() + target)),
        "One number is asked for: take the mean over the batch.",
    ),
    "summed": (
        lambda log_alpha, lp, target: -(log_alpha.exp() * (lp.detach() + target)).sum(),
        "This is the sum over the batch: take the mean, or the step grows with the batch.",
    ),
    "absolute-difference": (
        lambda log_alpha, lp, target: log_alpha.exp() * (lp.detach().mean() + target).abs(),
        "The sign of the difference decides whether the temperature rises or falls: without it, it only falls.",
    ),
    "gradient-into-the-policy": (
        lambda log_alpha, lp, target: -(log_alpha.exp() * (lp + target)).mean(),
        "log_probs get gradient: descending this loss would change the policy's entropy directly, in place of the temperature."
        " Detach them.",
    ),
    "temperature-detached": (lambda log_alpha, lp, target: -(log_alpha.detach().exp() * (lp.detach() + target)).mean(), CUT),
}

TEMPERATURE_LOSS = Exercise(
    name="temperature_loss",
    reference=ch47.temperature_loss,
    criteria={"values": 0.7, "gradient": 0.2, "dtype": 0.05, "inputs": 0.05},
    cases=drawn_once(
        Case("nine samples", _temperature(), closed_form=_temperature_by_hand, visible=True, draws=2),
        Case("on target: nothing to change", _on_target, closed_form=number(0.0), visible=True),
        Case("a single sample", _temperature(1), closed_form=_temperature_by_hand, visible=True),
        Case("a positive target", _temperature(target_entropy=0.5), closed_form=_temperature_by_hand),
        Case("a high temperature", _temperature(log_alpha=2.0), closed_form=_temperature_by_hand),
        Case("all inputs require gradient", _temperature(), differentiate=("log_alpha", "log_probs"), visible=True, draws=2),
        Case("single precision", _temperature(), dtype=torch.float32, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_TEMPERATURE_LOSS),
        *spoilt(ch47.temperature_loss, python_float, dtype_lost, changed="log_probs"),
    ),
    variants={
        "mean first": lambda log_alpha, lp, target: -log_alpha.exp() * (lp.detach().mean() + target),
        "entropy minus target": lambda log_alpha, lp, target: ((-lp.detach() - target) * torch.exp(log_alpha)).mean(),
        "difference without gradient": lambda log_alpha, lp, target: (
            (torch.e**log_alpha * -(lp.detach() + target)).sum() / lp.numel()
        ),
        "sample by sample": lambda log_alpha, lp, target: torch.stack(
            [-torch.exp(log_alpha) * (one + target) for one in lp.detach()]
        ).mean(),
    },
)

# ----------------------------------------------------------------------------------------------------------- polyak_update

_PAIR = ("target_params", "online_params")


@drawing
def _networks(generator, tau=0.1, shapes=((3, 4), (4,), ()), parameters=(), once=()):
    """Parameters of two networks; those named in `parameters` require gradient, those in `once` can be gone through once."""
    drawn = {name: [normal(generator, *shape) for shape in shapes] for name in _PAIR}
    made = {
        name: built("control.networks.parameters", tensors=drawn[name]) if name in parameters else drawn[name] for name in _PAIR
    }
    made |= {name: built("control.networks.one_pass", tensors=drawn[name]) for name in once}
    return made | {"tau": tau}


@drawing
def _mismatch(generator, change):
    drawn = _networks()(generator)
    return drawn | {"online_params": [change(drawn["online_params"][0]), *drawn["online_params"][1:]]}


def _polyak(step, checked=True, graph=False):
    """A version: `step(target, online, tau)` changes one tensor."""

    def version(target_params, online_params, tau):
        if checked and not 0 <= tau <= 1:
            raise ValueError(f"tau is the weight of the new parameters, in [0, 1]: {tau}")
        with torch.set_grad_enabled(graph):
            for target, online in zip(target_params, online_params, strict=True):
                if checked and target.shape != online.shape:
                    raise ValueError(f"target_params and online_params differ: {tuple(target.shape)}, {tuple(online.shape)}")
                step(target, online, tau)

    return version


def _moved(name, inputs, **options):
    return Case(name, inputs, returns=("target_params",), **options)


def _first_only(target_params, online_params, tau):
    """Looks at all tensors, and moves the first."""
    targets, onlines = list(target_params), list(online_params)
    _polyak(lambda target, online, tau: None)(targets, onlines, tau)
    ch47.polyak_update(targets[:1], onlines[:1], tau)


def _used_up(target_params, online_params, tau):
    """Right for lists."""
    _polyak(lambda target, online, tau: None)(target_params, online_params, tau)
    with torch.no_grad():
        for target, online in zip(target_params, online_params, strict=False):
            target.lerp_(online, tau)


def _scaled_then_added(target, online, tau):
    target.mul_(1 - tau).add_(online, alpha=tau)


def _in_numpy(target, online, tau):
    target.numpy()[...] = (1 - tau) * target.numpy() + tau * online.numpy()


_NAMED = ("target", "online")  # the arguments, or their tensors

_WRONG_STEPS = {
    "tau-on-the-wrong-side": (
        lambda target, online, tau: target.lerp_(online, 1 - tau),
        "tau is the weight of the online parameters: with a small tau the targets move slowly, here they jump.",
    ),
    "copied": (
        lambda target, online, tau: target.copy_(online),
        "This copies the online parameters: the targets are to move by a share tau of the distance.",
    ),
    "added": (
        lambda target, online, tau: target.add_(tau * online),
        "The targets grow without bound: their old values are to be weighted with 1 - tau.",
    ),
    "moved-away": (
        lambda target, online, tau: target.sub_(tau * (online - target)),
        "The targets move away from the online parameters: the difference has the wrong sign.",
    ),
    "shrunk": (lambda target, _, tau: target.mul_(1 - tau), "The online parameters' share is missing: add tau times theirs."),
    "weights-in-sequence": (
        lambda target, online, tau: target.add_(tau * online).mul_(1 - tau),
        "The online share is shrunk by 1 - tau as well: multiply the targets first, then add.",
    ),
    "not-in-place": (
        lambda target, online, tau: (1 - tau) * target + tau * online,
        "target = … gives a name to a new tensor, and the network's own one stays as it is: use a method that ends in _.",
    ),
    "online-changed": (
        lambda target, online, tau: online.copy_(target.lerp_(online, tau)),
        "The online parameters are changed as well: they are what is being learnt, leave them as they are.",
    ),
}

_WRONG_POLYAK_UPDATE = {
    "checked-and-used-up": (
        _used_up,
        "The check goes through the parameters, and what can be gone through once, such as net.parameters(), has nothing left for the"
        " update: nothing moves. Do both in one loop.",
    ),
    "first-tensor-only": (_first_only, "Only the first tensor is moved: every pair is to be."),
    "graph-kept": (
        _polyak(_scaled_then_added, graph=True),
        "The update is recorded in the graph, which grows with every step, and PyTorch refuses to change parameters in place:"
        " do it under torch.no_grad().",
    ),
}

POLYAK_UPDATE = Exercise(
    name="polyak_update",
    reference=ch47.polyak_update,
    criteria={"values": 0.6, "gradient": 0.15, "dtype": 0.05, "inputs": 0.1, "errors": 0.1},
    cases=drawn_once(
        _moved("tau = 0.1", _networks(), visible=True, draws=2),
        _moved("tau = 0.005", _networks(0.005), visible=True),
        _moved("tau = 0.5: half-way", _networks(0.5)),
        _moved("tau = 0: nothing moves", _networks(0.0), visible=True),
        _moved("tau = 1: a copy", _networks(1.0)),
        _moved("one tensor", _networks(0.2, shapes=((5,),))),
        _moved("online parameters require gradient", _networks(parameters=_PAIR[1:]), visible=True),
        _moved("all parameters require gradient", _networks(parameters=_PAIR), visible=True),
        _moved("online parameters as a module hands them out", _networks(once=_PAIR[1:]), visible=True),
        _moved("single precision", _networks(), dtype=torch.float32, visible=True),
        _moved("a tensor of one row in place of three", _mismatch(lambda tensor: tensor[:1]), raises=_NAMED, visible=True),
        _moved("a tensor without its last axis", _mismatch(lambda tensor: tensor[0]), raises=_NAMED),
        _moved("a transposed tensor", _mismatch(lambda tensor: tensor.T), raises=_NAMED),
        _moved("tau = 1.5", _networks(1.5), raises=("tau",), visible=True),
        _moved("tau = -0.1", _networks(-0.1), raises=("tau",)),
    ),
    misconceptions=(
        *wrong(_WRONG_STEPS, _polyak),
        *wrong(_WRONG_POLYAK_UPDATE),
        bad_input_accepted(_polyak(_scaled_then_added, checked=False)),
    ),
    variants={
        "scaled, then added": _polyak(_scaled_then_added),
        "by the difference": _polyak(lambda target, online, tau: target.add_(tau * (online - target))),
        "copied from a sum": _polyak(lambda target, online, tau: target.copy_((1 - tau) * target + tau * online)),
        "through .data": _polyak(
            lambda target, online, tau: target.data.copy_(tau * online.data + (1 - tau) * target.data), graph=True
        ),
        "detached tensors, NumPy": _polyak(lambda target, online, tau: _in_numpy(target.detach(), online.detach(), tau)),
    },
)

# ------------------------------------------------------------------------------------------------------------- sac_update


@drawing
def _one_update(generator, size=12, actions=2, learning_rate=0.3, alpha=0.1, gamma=0.9, tau=0.2, target_entropy=None, ended=0.3):
    """An agent of small networks, a batch that others collected, and all that is drawn in an update; float32, as networks are."""
    seed, of_batch, *of_noises = integers(generator, 0, 2**31, 4).tolist()
    next_noise, noise = (built("seeding.noise", rows=size, columns=actions, seed=one) for one in of_noises)
    chosen = {
        "learning_rate": learning_rate,
        "gamma": gamma,
        "tau": tau,
        "initial_alpha": alpha,
        "target_entropy": target_entropy,
    }
    settings = built("control.sac.SACSettings", hidden=6, **chosen)
    agent = {"obs_dim": 3, "low": [-1.0] * actions, "high": [2.0] * actions, "settings": settings, "seed": seed}
    return {
        "agent": built("control.sac.begun", **agent),
        "batch": built("control.replay.made_up", count=size, obs_dim=3, action_dim=actions, ended=ended, seed=of_batch),
        "next_noise": next_noise,
        "noise": noise,
        "settings": settings,
    }


def _acting(agent, obs, noise, std=torch.exp, squash=torch.tanh):
    mean, log_std = agent.distribution(obs)
    u = mean + std(log_std) * noise
    return squash(u), ch47.squashed_gaussian_log_prob(mean, log_std, u)


def _targets(agent, batch, next_noise, alpha, gamma, networks=None, obs=None, judged=None, acting=_acting):
    with torch.no_grad():
        at = batch.next_obs if obs is None else obs
        actions, log_probs = acting(agent, at, next_noise)
        q1, q2 = sac.values(networks or agent.targets, at if judged is None else judged, actions)
    return ch47.soft_q_target(batch.rewards, batch.terminated, q1, q2, log_probs, alpha, gamma)


def _step_of_critics(agent, batch, targets):
    q1, q2 = sac.values(agent.critics, batch.obs, batch.actions)
    loss = ch47.critic_loss(q1, q2, targets)
    sac.minimise(loss, agent.critics_optimizer)
    return loss.detach()


def _step_of_policy(agent, obs, noise, alpha, networks=None, gradient=True, acting=_acting):
    """A step of the policy; its loss and the log-probabilities of its actions. `gradient` says whether any passes through the actions."""
    actions, log_probs = acting(agent, obs, noise)
    q1, q2 = sac.values(networks or agent.critics, obs, actions if gradient else actions.detach(), learn=False)
    loss = ch47.sac_actor_loss(q1, q2, log_probs, alpha)
    sac.minimise(loss, agent.actor_optimizer)
    return loss.detach(), log_probs.detach()


def _step_of_temperature(agent, log_probs):
    loss = ch47.temperature_loss(agent.log_alpha, log_probs, agent.target_entropy)
    sac.minimise(loss, agent.temperature_optimizer)
    return loss.detach()


def _follow(agent, settings):
    ch47.polyak_update([agent.targets.weights], [agent.critics.weights], settings.tau)


def _told(of_critics, of_policy, of_temperature, log_probs):
    losses = {"critic_loss": of_critics, "actor_loss": of_policy, "temperature_loss": of_temperature}
    return {name: torch.as_tensor(loss) for name, loss in losses.items()} | {"entropy": -log_probs.mean()}


def _updating(
    price=lambda agent: agent.log_alpha.detach().exp(),
    targets=_targets,
    critics=_step_of_critics,
    policy=_step_of_policy,
    policy_obs=lambda batch: batch.obs,
    temperature=_step_of_temperature,
    thermometer=lambda agent, batch, log_probs: log_probs,
    follow=_follow,
    order="target critics policy temperature copies",
    acting=_acting,
    noises=lambda next_noise, noise: (next_noise, noise),
    told=_told,
):
    """A version of the program, from the places where it can go wrong; `order` says what comes when, and `acting` draws all actions."""
    if acting is not _acting:
        targets, policy = partial(targets, acting=acting), partial(policy, acting=acting)

    def version(agent, batch, next_noise, noise, settings):
        alpha = price(agent)
        next_noise, noise = noises(next_noise, noise)
        for part in order.split():
            if part == "target":
                y = targets(agent, batch, next_noise, alpha, settings.gamma)
            elif part == "critics":
                of_critics = critics(agent, batch, y)
            elif part == "policy":
                of_policy, log_probs = policy(agent, policy_obs(batch), noise, alpha)
            elif part == "temperature":
                of_temperature = temperature(agent, thermometer(agent, batch, log_probs))
            else:
                follow(agent, settings)
        return told(of_critics, of_policy, of_temperature, log_probs)

    return version


def _at_the_new_price(agent, batch, next_noise, noise, settings):
    """The temperature before the policy, whose loss has the price that comes of it."""
    alpha = agent.log_alpha.detach().exp()
    of_critics = _step_of_critics(agent, batch, _targets(agent, batch, next_noise, alpha, settings.gamma))
    with torch.no_grad():
        _, log_probs = _acting(agent, batch.obs, noise)
    of_temperature = _step_of_temperature(agent, log_probs)
    of_policy, log_probs = _step_of_policy(agent, batch.obs, noise, agent.log_alpha.detach().exp())
    _follow(agent, settings)
    return _told(of_critics, of_policy, of_temperature, log_probs)


def _leaking(agent, obs, noise, alpha):
    """One backward pass for both: the critics are moved by the policy's loss."""
    actions, log_probs = _acting(agent, obs, noise)
    q1, q2 = sac.values(agent.critics, obs, actions)
    loss = ch47.sac_actor_loss(q1, q2, log_probs, alpha)
    sac.minimise(loss, agent.actor_optimizer, agent.critics_optimizer)
    return loss.detach(), log_probs.detach()


def _climbing(agent, obs, noise, alpha):
    """The policy's step, upside down."""
    actions, log_probs = _acting(agent, obs, noise)
    q1, q2 = sac.values(agent.critics, obs, actions, learn=False)
    loss = ch47.sac_actor_loss(q1, q2, log_probs, alpha)
    sac.minimise(-loss, agent.actor_optimizer)
    return loss.detach(), log_probs.detach()


def _by_one_critic(agent, obs, noise, alpha):
    """The policy's step, judged by the first critic alone."""
    actions, log_probs = _acting(agent, obs, noise)
    q1, _ = sac.values(agent.critics, obs, actions, learn=False)
    loss = ch47.sac_actor_loss(q1, q1, log_probs, alpha)
    sac.minimise(loss, agent.actor_optimizer)
    return loss.detach(), log_probs.detach()


def _unmoved(agent, obs, noise, alpha):
    """The policy's loss, and no step."""
    actions, log_probs = _acting(agent, obs, noise)
    q1, q2 = sac.values(agent.critics, obs, actions)
    return ch47.sac_actor_loss(q1, q2, log_probs, alpha).detach(), log_probs.detach()


def _of_stored_actions(agent, batch, log_probs):
    mean, log_std = agent.distribution(batch.obs)
    return ch47.squashed_gaussian_log_prob(mean, log_std, batch.actions.atanh()).detach()


def _by_hand(agent, batch, next_noise, noise, settings):
    """A variant: backward(), gradients cleared by hand, everything written out."""
    alpha = agent.log_alpha.exp().item()
    mean, log_std = (x.detach() for x in agent.distribution(batch.next_obs))
    u = torch.addcmul(mean, log_std.exp(), next_noise)
    q = agent.targets(torch.cat([batch.next_obs, u.tanh()], 1)).squeeze(-1).amin(0)
    soft = q - alpha * ch47.squashed_gaussian_log_prob(mean, log_std, u)
    y = batch.rewards + settings.gamma * soft * (~batch.terminated)
    fits = (agent.critics(torch.cat([batch.obs, batch.actions], 1))[..., 0] - y).square().mean(1).sum()
    fits.backward()
    agent.critics_optimizer.step(agent.critics.weights.grad)
    agent.critics.weights.grad = None

    mean, log_std = agent.distribution(batch.obs)
    u = torch.addcmul(mean, log_std.exp(), noise)
    log_probs = ch47.squashed_gaussian_log_prob(mean, log_std, u)
    q = agent.critics(torch.cat([batch.obs, u.tanh()], 1), learn=False).squeeze(-1).amin(0)
    loss = (alpha * log_probs - q).mean()
    loss.backward()
    agent.actor_optimizer.step(agent.actor.weights.grad)
    agent.actor.weights.grad = None

    gap = log_probs.detach().mean() + agent.target_entropy
    agent.temperature_optimizer.step(-alpha * gap)
    with torch.no_grad():
        agent.targets.weights.mul_(1 - settings.tau).add_(agent.critics.weights, alpha=settings.tau)
    return _told(fits.detach(), loss.detach(), -alpha * gap, log_probs.detach())


def _together(agent, batch, next_noise, noise, settings):
    """A variant: policy and temperature in one pass, as course_lib.control.sac.update has them."""
    alpha = agent.log_alpha.detach().exp()
    of_critics = _step_of_critics(agent, batch, _targets(agent, batch, next_noise, alpha, settings.gamma))
    actions, log_probs = _acting(agent, batch.obs, noise)
    q1, q2 = sac.values(agent.critics, batch.obs, actions, learn=False)
    of_policy = ch47.sac_actor_loss(q1, q2, log_probs, alpha)
    of_temperature = ch47.temperature_loss(agent.log_alpha, log_probs, agent.target_entropy)
    sac.minimise(of_policy + of_temperature, agent.actor_optimizer, agent.temperature_optimizer)
    _follow(agent, settings)
    return _told(of_critics, of_policy.detach(), of_temperature.detach(), log_probs.detach())


def _temperature_at_last(agent, batch, next_noise, noise, settings):
    """A variant: the copies before the policy, of which neither knows, and the temperature after all."""
    alpha = agent.log_alpha.detach().exp()
    of_critics = _step_of_critics(agent, batch, _targets(agent, batch, next_noise, alpha, settings.gamma))
    _follow(agent, settings)
    of_policy, log_probs = _step_of_policy(agent, batch.obs, noise, alpha)
    return _told(of_critics, of_policy, _step_of_temperature(agent, log_probs), log_probs)


_WRONG_SAC_UPDATE = {
    "target-by-the-critics": (
        {"targets": lambda agent, batch, noise, alpha, gamma: _targets(agent, batch, noise, alpha, gamma, agent.critics)},
        "The target is made by the critics themselves: the slow copies, agent.targets, make it.",
    ),
    "target-in-the-state-before": (
        {"targets": lambda agent, batch, noise, alpha, gamma: _targets(agent, batch, noise, alpha, gamma, obs=batch.obs)},
        "The target's action is drawn in obs: what follows the step is worth what next_obs is, and the action is the policy's there.",
    ),
    "next-action-judged-in-the-state-before": (
        {"targets": lambda agent, batch, noise, alpha, gamma: _targets(agent, batch, noise, alpha, gamma, judged=batch.obs)},
        "The action drawn for next_obs is judged in obs: both belong to the next state.",
    ),
    "one-noise-for-both": (
        {"noises": lambda next_noise, noise: (noise, noise)},
        "next_noise is not used: it makes the actions in next_obs, noise those in obs.",
    ),
    "noises-swapped": (
        {"noises": lambda next_noise, noise: (noise, next_noise)},
        "The two noises have changed places: next_noise makes the actions in next_obs, noise those in obs.",
    ),
    "next-action-without-noise": (
        {"noises": lambda next_noise, noise: (torch.zeros_like(next_noise), noise)},
        "The target's action is the middle of the policy's distribution: it is drawn like every other, with next_noise, and its entropy"
        " is paid for.",
    ),
    "policy-before-the-critics": (
        {"order": "policy target critics temperature copies"},
        "The policy moves before the critics: its loss, and the target's action, are then those of other networks. Critics first.",
    ),
    "policy-between-target-and-critics": (
        {"order": "target policy critics temperature copies"},
        "The policy is judged by the critics as they were before their step: move the critics first.",
    ),
    "copies-before-the-target": (
        {"order": "copies target critics policy temperature"},
        "The slow copies move before they have made the target, and towards the critics of the update before: they come last.",
    ),
    "copies-before-the-critics": (
        {"order": "target copies critics policy temperature"},
        "The slow copies move towards the critics as they were before their step: they follow the critics that have just become.",
    ),
    "gamma-by-default": (
        {"targets": lambda agent, batch, noise, alpha, gamma: _targets(agent, batch, noise, alpha, 0.99)},
        "settings.gamma is not handed to soft_q_target, which then takes its default, 0.99.",
    ),
    "log-std-for-std": (
        {"acting": partial(_acting, std=lambda log_std: log_std)},
        "The noise is multiplied by log_std: the standard deviation is its exponential.",
    ),
    "actions-not-squashed": (
        {"acting": partial(_acting, squash=lambda u: u)},
        "The critics are asked about u = μ + σ ε: an action is tanh(u).",
    ),
    "copies-left-behind": ({"follow": lambda agent, settings: None}, "The slow copies do not move: polyak_update is missing."),
    "copies-copied": (
        {"follow": lambda agent, settings: ch47.polyak_update([agent.targets.weights], [agent.critics.weights], 1.0)},
        "The slow copies jump onto the critics: settings.tau says how far they go.",
    ),
    "critics-follow-the-copies": (
        {"follow": lambda agent, settings: ch47.polyak_update([agent.critics.weights], [agent.targets.weights], settings.tau)},
        "polyak_update moves the critics towards the copies: its first argument is what moves.",
    ),
    "critics-moved-by-the-policys-loss": (
        {"policy": _leaking},
        "The critics are moved by the policy's loss as well: they learn to praise what the policy does. Ask them with learn=False, and"
        " give minimise the policy's optimiser alone.",
    ),
    "policy-climbs-its-loss": ({"policy": _climbing}, "The policy's loss is increased: minimise takes the loss as it is."),
    "policy-stands-still": ({"policy": _unmoved}, "The policy does not move: its loss is computed, and never minimised."),
    "action-detached": (
        {"policy": lambda agent, obs, noise, alpha: _step_of_policy(agent, obs, noise, alpha, gradient=False)},
        "The policy's action is cut from the graph before the critics see it: no reward reaches the policy.",
    ),
    "policy-judged-by-one-critic": (
        {"policy": _by_one_critic},
        "One critic judges the policy's actions: hand q1 and q2 to sac_actor_loss, which takes the smaller.",
    ),
    "policy-judged-by-the-copies": (
        {"policy": lambda agent, obs, noise, alpha: _step_of_policy(agent, obs, noise, alpha, agent.targets)},
        "The slow copies judge the policy's actions: the critics do, as they have just become. The copies are for targets.",
    ),
    "policy-in-the-next-state": (
        {"policy_obs": lambda batch: batch.next_obs},
        "The policy's loss is about its actions in batch.obs.",
    ),
    "price-is-log-alpha": (
        {"price": lambda agent: agent.log_alpha.detach().clone()},
        "The price of a nat is exp(log_alpha).",
    ),
    "price-fixed": (
        {"price": lambda agent: torch.tensor(0.2)},
        "The price of a nat is a constant of your own: it is exp(agent.log_alpha).",
    ),
    "temperature-stands-still": (
        {"temperature": lambda agent, lp: ch47.temperature_loss(agent.log_alpha, lp, agent.target_entropy).detach()},
        "The temperature does not move: its loss is computed, and never minimised.",
    ),
    "thermometer-on-stored-actions": (
        {"thermometer": _of_stored_actions},
        "The temperature's log-probabilities are those of batch.actions, which older policies chose: take the policy's own fresh actions.",
    ),
    "own-target-entropy": (
        {
            "temperature": lambda agent, lp: _step_of_temperature(
                SimpleNamespace(log_alpha=agent.log_alpha, target_entropy=1.0, temperature_optimizer=agent.temperature_optimizer),
                lp,
            )
        },
        "The entropy asked for is agent.target_entropy.",
    ),
    "log-prob-for-entropy": (
        {"told": lambda *given: (made := _told(*given)) | {"entropy": -made["entropy"]}},
        "The entropy that is reported has the wrong sign: it is the mean of -log π.",
    ),
    "metrics-as-numbers": (
        {"told": lambda *given: {name: value.item() for name, value in _told(*given).items()}},
        NUMBER,
    ),
}


def _afterwards(name, inputs, **options):
    """A case that looks at the agent after the update."""
    return Case(name, inputs, returns=("agent",), rtol=1e-3, atol=1e-4, **options)


def _reported(name, inputs, **options):
    """A case that looks at what the update tells."""
    return Case(name, inputs, rtol=1e-4, atol=1e-4, **options)


SAC_UPDATE = Exercise(
    name="sac_update",
    reference=ch47.sac_update,
    criteria={"values": 3.0},
    cases=drawn_once(
        _afterwards("the agent afterwards", _one_update(), visible=True, draws=2),
        _reported("what is reported", _one_update(), visible=True, draws=2),
        _afterwards("a high temperature", _one_update(alpha=3.0, target_entropy=0.3)),
        _reported("what is reported, at a high temperature", _one_update(alpha=3.0, target_entropy=0.3)),
        _afterwards("one action, no step ends, tau = 1", _one_update(actions=1, ended=0.0, tau=1.0), visible=True),
        _afterwards("learning rate 0: the copies alone move", _one_update(learning_rate=0.0, tau=0.5), visible=True),
        _reported("every step ends", _one_update(ended=1.1)),
    ),
    misconceptions=(
        *wrong(_WRONG_SAC_UPDATE, lambda parts: _updating(**parts)),
        Misconception(
            "policy-at-the-new-price",
            _at_the_new_price,
            "The temperature moves first, and the policy's loss has its new α: take alpha once, at the top, for all that follows.",
        ),
    ),
    variants={
        "step by step": _updating(),
        "everything written out": _by_hand,
        "policy and temperature in one pass": _together,
        "the temperature at last": _temperature_at_last,
    },
)

# ------------------------------------------------------------------------------------------------ repaired_follow (bug lab)

_WEIGHTS = ("target_weights", "online_weights", "first")


@drawing
def _copies(generator, size=8, tau=0.2, pattern=None):
    """Weights of which about half, in no order, are the first critic's."""
    first = uniform(generator, size) < 0.5 if pattern is None else torch.full((size,), pattern)
    if pattern is None:
        first[0], first[-1] = True, False
    given = {"target_weights": normal(generator, size), "online_weights": normal(generator, size)}
    return given | {"first": first, "tau": tau}


_followed = versions_of(ch47.repaired_follow, one_shape(*_WEIGHTS), satisfies(lambda tau: 0 <= tau <= 1))


def _following(move, checked=True, graph=False):
    """A version: `move(target, online, first, tau)` changes the copies, without a graph unless it is asked for."""

    def version(target_weights, online_weights, first, tau):
        with torch.set_grad_enabled(graph):
            move(target_weights, online_weights, first, tau)

    return _followed(version, checked)


def _followed_by(name, inputs, **options):
    return Case(name, inputs, returns=("target_weights",), **options)


def _share(first, tau, target):
    return torch.where(first, tau, 0.5 * tau).to(target.dtype)


def _by_masks(target, online, first, tau):
    for mask, share in ((first, tau), (~first, tau / 2)):
        target[mask] = (1 - share) * target[mask] + share * online[mask]


def _by_places(target, online, first, tau):
    for i, ours in enumerate(first.tolist()):
        target[i] += (tau if ours else tau / 2) * (online[i] - target[i])


def _written_back(target, online, first, tau):
    for mask, share in ((first, tau), (~first, tau / 2)):
        part = target[mask]
        ch47.polyak_update([part], [online[mask]], share)
        target[mask] = part


_WRONG_FOLLOW = {
    "the-suspects-own": (
        lambda target, online, first, tau: (
            ch47.polyak_update([target[first]], [online[first]], tau),
            ch47.polyak_update([target[~first]], [online[~first]], tau / 2),
        ),
        "Nothing has moved. A mask in brackets makes a *copy*, and an operation without _ at its end a new tensor: write into"
        " target_weights itself.",
    ),
    "one-speed": (
        lambda target, online, first, tau: target.lerp_(online, tau),
        "Both copies follow by tau: the second's share is half of that.",
    ),
    "speeds-swapped": (
        lambda target, online, first, tau: target.lerp_(online, _share(~first, tau, target)),
        "The first critic's copy follows by half of tau, and the second's by tau: it is the other way round.",
    ),
    "halves-by-place": (
        lambda target, online, first, tau: target.lerp_(
            online, _share(torch.arange(len(target)) < len(target) // 2, tau, target)
        ),
        "The first half of the vector follows by tau, the rest by half of it: `first` says which weights are the first critic's.",
    ),
    "first-only": (
        lambda target, online, first, tau: target.lerp_(online, torch.where(first, tau, 0.0).to(target.dtype)),
        "The second critic's copy does not move: it follows by half of tau.",
    ),
    "second-only": (
        lambda target, online, first, tau: target.lerp_(online, torch.where(first, 0.0, 0.5 * tau).to(target.dtype)),
        "The first critic's copy does not move: it follows by tau.",
    ),
    "copied": (
        lambda target, online, first, tau: target.copy_(online),
        "The copies jump onto the critics: they are to move by a share of the distance.",
    ),
    "double-speed": (
        lambda target, online, first, tau: target.lerp_(online, _share(first, 2 * tau, target)),
        "Both shares are twice as large as asked for.",
    ),
    "the-wrong-way-round": (
        lambda target, online, first, tau: online.lerp_(target, _share(first, tau, target)),
        "The critics move towards the copies: the copies are to follow.",
    ),
    "both-changed": (
        lambda target, online, first, tau: online.copy_(target.lerp_(online, _share(first, tau, target))),
        "The critics' weights are changed as well: they are what is being learnt, leave them as they are.",
    ),
}

REPAIRED_FOLLOW = Exercise(
    name="repaired_follow",
    reference=ch47.repaired_follow,
    criteria={"values": 1.5, "gradient": 0.1, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    axes=("weight",),
    cases=drawn_once(
        _followed_by("eight weights in no order", _copies(), visible=True, draws=2),
        _followed_by("tau = 0.005", _copies(tau=0.005)),
        _followed_by("tau = 1: the first is copied", _copies(tau=1.0), visible=True),
        _followed_by("tau = 0: nothing moves", _copies(tau=0.0), visible=True),
        _followed_by("all weights are the first critic's", _copies(pattern=True)),
        _followed_by("none is", _copies(pattern=False)),
        _followed_by("all weights require gradient", _copies(), differentiate=_WEIGHTS[:2], visible=True),
        _followed_by("single precision", _copies(), dtype=torch.float32, visible=True),
        *shape_cases(_copies(), _WEIGHTS),
        refused(_copies(), tau=1.5, visible=True),
        refused(_copies(), tau=-0.1),
    ),
    misconceptions=(
        *wrong(_WRONG_FOLLOW, _following),
        Misconception(
            "graph-kept",
            _following(_by_masks, graph=True),
            "The update is recorded in the graph, and PyTorch refuses to change weights that require gradient in place: do it under"
            " torch.no_grad().",
        ),
        bad_input_accepted(_following(_by_masks, checked=False)),
    ),
    variants={
        "a share for each weight": _following(
            lambda target, online, first, tau: target.lerp_(online, _share(first, tau, target))
        ),
        "masks on the left": _following(_by_masks),
        "one weight at a time": _following(_by_places),
        "moved, then written back": _following(_written_back),
        "by the difference": _following(
            lambda target, online, first, tau: target.add_((online - target) * tau * (0.5 + 0.5 * first.to(target.dtype)))
        ),
        "copied from a choice": _following(
            lambda target, online, first, tau: target.copy_(
                torch.where(first, (1 - tau) * target + tau * online, (1 - tau / 2) * target + tau / 2 * online)
            )
        ),
    },
)

EXERCISES = (
    SOFT_VALUE_ITERATION,
    SQUASHED_GAUSSIAN_LOG_PROB,
    SOFT_Q_TARGET,
    CRITIC_LOSS,
    SAC_ACTOR_LOSS,
    TEMPERATURE_LOSS,
    POLYAK_UPDATE,
    SAC_UPDATE,
    REPAIRED_FOLLOW,
)
