"""Checks of chapter 48: cases, named misconceptions and correct variants for soft actor-critic and the statistics of comparisons."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution
from torch.nn import functional as F

from autograder.authoring import wild
from autograder.authoring.parts import (
    CUT,
    after,
    bad_input_accepted,
    cut_from_graph,
    drawing,
    drawn_once,
    dtype_lost,
    in_place,
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
from course_lib.control.replay import Transitions
from solutions import ch48

HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


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


_density = versions_of(ch48.squashed_gaussian_log_prob, one_shape(*_SQUASHED))


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
    reference=ch48.squashed_gaussian_log_prob,
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
        *spoilt(ch48.squashed_gaussian_log_prob, cut_from_graph, dtype_lost, changed="pre_tanh_actions"),
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


_checked_target = versions_of(ch48.soft_q_target, one_shape(*_TARGET_SHAPES), satisfies(lambda gamma: 0 <= gamma <= 1))


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
    reference=ch48.soft_q_target,
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
        *spoilt(ch48.soft_q_target, dtype_lost, changed="rewards"),
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


_actor = versions_of(ch48.sac_actor_loss, one_shape(*_ACTOR), data=["alpha"])


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
    reference=ch48.sac_actor_loss,
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
        *spoilt(ch48.sac_actor_loss, cut_from_graph, dtype_lost, changed="q1"),
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
    reference=ch48.temperature_loss,
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
        *spoilt(ch48.temperature_loss, python_float, dtype_lost, changed="log_probs"),
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
    ch48.polyak_update(targets[:1], onlines[:1], tau)


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
    reference=ch48.polyak_update,
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

# ------------------------------------------------------------------------------------------------------ interquartile_mean


@drawing
def _scores(generator, *shape, outlier=0.0):
    scores = 100 + 30 * normal(generator, *shape)
    scores.view(-1)[int(uniform(generator, 1) * scores.numel())] += outlier
    return {"scores": scores}


@drawing
def _tasks_apart(generator, seeds=5, tasks=3):
    """Tasks on different levels: the middle half of all is not the mean of middle halves."""
    levels = torch.tensor([0.0, 40.0, 400.0], dtype=torch.float64)[:tasks]
    return {"scores": levels + 10 * normal(generator, seeds, tasks)}


def _four_of_each(scores):
    """Every score four times: then a quarter of the entries is a whole number."""
    return torch.tensor(_middle_half(np.sort(np.repeat(scores.numpy().ravel(), 4))), dtype=scores.dtype)


def _middle_half(ordered):
    quarter = len(ordered) // 4
    return ordered[quarter : 3 * quarter].mean(0)


def _cut_by_weight(x, low, high=None):
    """The mean of what is left when shares of the weight are cut off at both ends."""
    count = len(x)
    edges = torch.arange(count + 1, dtype=x.dtype).clamp(low * count, (1 - (low if high is None else high)) * count)
    return edges.diff() @ x / edges.diff().sum()


def _by_task(scores):
    return torch.stack([ch48.interquartile_mean(column) for column in scores.reshape(len(scores), -1).unbind(1)])


def _in_numpy_by_area(scores):
    """The area between the quartiles under the quantile function."""
    areas = np.concatenate([[0.0], np.cumsum(np.sort(scores.numpy().ravel()))]) / scores.numel()
    ends = np.interp([0.25, 0.75], np.linspace(0, 1, scores.numel() + 1), areas)
    return torch.tensor(2 * (ends[1] - ends[0]), dtype=scores.dtype)


def _sorted(formula):
    return lambda scores: formula(scores.flatten().sort().values)


def _trimmed(cut):
    """The mean after whole entries were cut; `cut` says how many of n at each end."""
    return _sorted(lambda x: x[cut(len(x)) : max(len(x) - cut(len(x)), cut(len(x)) + 1)].mean())


def _between_quartiles(x):
    low, high = x.quantile(0.25), x.quantile(0.75)
    return x[(x >= low) & (x <= high)].mean()


def _quantile_integral(x):
    """The integral of the step function between 1/4 and 3/4."""
    count = len(x)
    overlaps = [min((i + 1) / count, 0.75) - max(i / count, 0.25) for i in range(count)]
    return 2 * sum(max(overlap, 0.0) * x[i] for i, overlap in enumerate(overlaps))


def _edges_in_part(x):
    count = len(x)
    whole, part = divmod(count, 4)
    inner = x[whole : count - whole].clone()
    weights = torch.ones_like(inner)
    if len(inner) == 1:
        return inner[0]
    weights[0] = weights[-1] = 1 - part / 4
    return (weights * inner).sum() / weights.sum()


_WRONG_INTERQUARTILE_MEAN = {
    "mean": (_sorted(torch.mean), "This is the mean of all scores: one lucky run moves it."),
    "median": (
        _sorted(lambda x: x.quantile(0.5)),
        "This is the median, which looks at one or two scores: the interquartile mean uses the middle half.",
    ),
    "whole-entries-rounded-down": (
        _trimmed(lambda n: n // 4),
        "Too little is cut where the count is no multiple of 4: the scores at the edges count in part, so that the weights sum"
        " to half of the count.",
    ),
    "whole-entries-rounded-up": (
        _trimmed(lambda n: -(-n // 4)),
        "Too much is cut where the count is no multiple of 4: the scores at the edges count in part, so that the weights sum to"
        " half of the count.",
    ),
    "a-quarter-in-all": (
        _sorted(lambda x: _cut_by_weight(x, 0.125)),
        "A quarter is cut off in all: it is a quarter at each end, which leaves half.",
    ),
    "upper-half": (
        _sorted(lambda x: _cut_by_weight(x, 0.5, 0.0)),
        "Both quarters are cut off at the lower end: the best runs are kept, and they are the lucky ones.",
    ),
    "mid-of-the-quartiles": (
        _sorted(lambda x: 0.5 * (x.quantile(0.25) + x.quantile(0.75))),
        "This is the middle between the two quartiles: the interquartile mean averages the scores between them.",
    ),
    "between-interpolated-quartiles": (
        _sorted(_between_quartiles),
        "The scores between torch.quantile's quartiles are no half of the weight: sort, and cut n / 4 at each end, the edges in part.",
    ),
    "not-sorted": (
        lambda scores: _cut_by_weight(scores.flatten(), 0.25),
        "The scores are cut in the order in which they came: sort them first.",
    ),
    "task-by-task": (
        lambda scores: _by_task(scores).mean(),
        "All entries are taken together: here each task is trimmed for itself, and a task without a middle counts as much.",
    ),
    "one-number-for-each-task": (
        lambda scores: _by_task(scores).squeeze(),
        "One number is asked for: flatten the scores before sorting.",
    ),
}

INTERQUARTILE_MEAN = Exercise(
    name="interquartile_mean",
    reference=ch48.interquartile_mean,
    criteria={"values": 0.85, "dtype": 0.1, "inputs": 0.05},
    cases=drawn_once(
        Case("eight seeds", _scores(8), closed_form=_four_of_each, visible=True, draws=2),
        Case("five seeds", _scores(5), closed_form=_four_of_each, visible=True, draws=2),
        Case("ten seeds, one of them lucky", _scores(10, outlier=5000.0), closed_form=_four_of_each, visible=True),
        Case("seven seeds, one of them failed", _scores(7, outlier=-5000.0), closed_form=_four_of_each),
        Case("six seeds", _scores(6), closed_form=_four_of_each),
        Case("five seeds of three tasks", _tasks_apart(), closed_form=_four_of_each, visible=True, draws=2),
        Case("four seeds of two tasks", _tasks_apart(4, 2), closed_form=_four_of_each),
        Case("a single seed", _scores(1), closed_form=_four_of_each, visible=True),
        Case("two seeds", _scores(2), closed_form=_four_of_each),
        Case("single precision", _scores(9), dtype=torch.float32, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_INTERQUARTILE_MEAN),
        *spoilt(ch48.interquartile_mean, python_float, dtype_lost, changed="scores"),
    ),
    variants={
        "four of each": lambda scores: _middle_half(scores.flatten().repeat_interleave(4).sort().values),
        "integral of the quantile function": _sorted(_quantile_integral),
        "edges in part": _sorted(_edges_in_part),
        "NumPy": _in_numpy_by_area,
        "topk": lambda scores: _edges_in_part(scores.flatten().topk(scores.numel(), largest=False).values),
    },
)


# ------------------------------------------------------------------------------------------------------ bootstrap_interval

HALVES = (0, 0, 0, 0, 1, 1, 1, 1)
FEW = (0, 0, 1, 1)
LUCKY = (0, 0, 0, 1)


@drawing
def _pattern(generator, *columns, confidence=0.5, num_resamples=400):
    """Few distinct scores, in random order and units. Their resampled means are few, too, and the ends of the interval fall on
    them: then every right bootstrap gives the same numbers but for one draw in millions."""
    rows = torch.tensor(columns, dtype=torch.float64).T
    rows = torch.stack([column[torch.randperm(len(column), generator=generator)] for column in rows.T], 1)
    scale, shift = 1 + 9 * uniform(generator, 1), 100 * normal(generator, 1)
    scores = shift + scale * rows
    return {
        "scores": scores[:, 0] if len(columns) == 1 else scores,
        "confidence": confidence,
        "num_resamples": num_resamples,
        "generator": built("seeding.generator", seed=int(1e6 * uniform(generator, 1))),
    }


def _together(generator):
    """Two tasks in which the same seeds do well in one and badly in the other."""
    drawn = _pattern(FEW)(generator)
    first = drawn["scores"]
    return drawn | {"scores": torch.stack([first, first.max() + first.min() - first], 1)}


def _ends(name, inputs, **options):
    """A case in which the interval's ends are looked at."""
    return Case(name, inputs, rtol=1e-4, atol=1e-4, **options)


def _certain(scores, **_rest):
    return (ch48.interquartile_mean(scores),) * 2


def _trimmed_rows(rows):
    """The interquartile mean of every row at once."""
    count = rows.shape[1]
    edges = torch.arange(count + 1, dtype=rows.dtype).clamp(count / 4, 3 * count / 4)
    return rows.sort(1).values @ edges.diff() / (count / 2)


def _picked(by_task, count, generator, size=None):
    """`count` resamples of `size` seeds (as many as there are) for each task apart: (count, size, tasks)."""
    shape = (count, size or len(by_task), by_task.shape[1])
    picks = torch.randint(len(by_task), shape, generator=generator)
    return by_task.gather(0, picks.flatten(0, 1)).view(shape)


def _stratified(*given):
    return _picked(*given).flatten(1)


def _quantiles(means, confidence):
    return means.quantile((1 - confidence) / 2), means.quantile((1 + confidence) / 2)


def _bootstrap(statistic=_trimmed_rows, draw=_stratified, ends=_quantiles, size=lambda num_resamples: num_resamples):
    """A version: `draw(by_task, count, generator)` gives resampled scores, (count, entries); `ends` makes two of their `statistic`."""

    def version(scores, confidence=0.95, num_resamples=2000, generator=None):
        resampled = draw(scores.reshape(len(scores), -1), size(num_resamples), generator)
        return ends(statistic(resampled), confidence)

    return version


def _and_centre(finish):
    """A version: `finish` makes the interval of the scores' own interquartile mean and of the resampled ones."""

    def version(scores, confidence=0.95, num_resamples=2000, generator=None):
        centre = ch48.interquartile_mean(scores)
        return _bootstrap(ends=lambda means, _: finish(centre, means, confidence))(scores, confidence, num_resamples, generator)

    return version


def _by_multinomial(by_task, count, generator):
    """Seeds as the outcomes of a multinomial with equal weights."""
    size = len(by_task)
    weights = torch.ones(count, size)
    picks = [torch.multinomial(weights, size, replacement=True, generator=generator) for _ in by_task.T]
    return torch.cat([column[rows] for column, rows in zip(by_task.T, picks, strict=True)], 1)


def _by_floor(by_task, count, generator):
    """Seeds by rounding down uniform numbers."""
    size, tasks = by_task.shape
    picks = (torch.rand((count, size, tasks), generator=generator, dtype=torch.float64) * size).long()
    return torch.cat([by_task[picks[:, :, task], task] for task in range(tasks)], 1)


def _by_numpy(by_task, count, generator):
    """NumPy's generator, seeded from torch's."""
    chance = np.random.default_rng(int(torch.randint(2**62, (1,), generator=generator)))
    picks = chance.integers(len(by_task), size=(count, *by_task.shape))
    return torch.from_numpy(np.take_along_axis(by_task.numpy()[None], picks, axis=1).reshape(count, -1))


def _percentiles(means, confidence):
    ends = np.percentile(means.numpy(), [50 * (1 - confidence), 50 * (1 + confidence)])
    return tuple(torch.from_numpy(ends).to(means.dtype))


def _task_by_task(scores, confidence=0.95, num_resamples=2000, generator=None):
    """Each score four times over, so that a quarter can be cut off; the interval's ends by counting."""
    by_task = scores.reshape(len(scores), -1)
    drawn = [column[torch.randint(len(column), (num_resamples, len(column)), generator=generator)] for column in by_task.T]
    means = _middle_half(torch.cat(drawn, 1).repeat_interleave(4, 1).sort(1).values.T).sort().values
    tail = (1 - confidence) / 2
    return means[int(tail * num_resamples)], means[int((1 - tail) * num_resamples) - 1]


_WRONG_BOOTSTRAP_INTERVAL = {
    "mean-instead-of-the-interquartile-mean": (
        _bootstrap(lambda rows: rows.mean(1)),
        "This is an interval for the mean: bootstrap the interquartile mean.",
    ),
    "median-instead-of-the-interquartile-mean": (
        _bootstrap(lambda rows: rows.quantile(0.5, dim=1)),
        "This is an interval for the median: bootstrap the interquartile mean.",
    ),
    "tasks-mixed": (
        _bootstrap(draw=lambda x, count, g: x.flatten()[torch.randint(x.numel(), (count, x.numel()), generator=g)]),
        "Scores are drawn from all tasks together, so that a resample may hold one task twice as often as another, and the"
        " interval is too wide: draw seeds within each task.",
    ),
    "whole-rows": (
        _bootstrap(draw=lambda x, count, g: x[torch.randint(len(x), (count, len(x)), generator=g)].flatten(1)),
        "The same seeds are drawn for all tasks, as if seed 3 of one task had anything to do with seed 3 of another: draw for each"
        " task apart.",
    ),
    "without-replacement": (
        _bootstrap(draw=lambda x, count, g: 0 * _stratified(x, count, g) + x.flatten()),
        "Every seed is drawn once, so that all resamples are the same and the interval has no width: draw with replacement.",
    ),
    "half-as-many": (
        _bootstrap(draw=lambda x, count, g: _stratified(x, count, g, max(len(x) // 2, 1))),
        "A resample has as many seeds as there are: with fewer the interval is too wide.",
    ),
    "tasks-averaged": (
        _bootstrap(lambda rows: torch.stack([_trimmed_rows(task) for task in rows.unbind(2)]).mean(0), draw=_picked),
        "Each task's interquartile mean is taken for itself: it is one mean over all entries of the resample.",
    ),
    "tails-not-halved": (
        _bootstrap(ends=lambda means, confidence: (means.quantile(1 - confidence), means.quantile(confidence))),
        "1 - confidence is left out at each end: it is half of that, as there are two ends.",
    ),
    "one-sided": (
        _bootstrap(ends=lambda means, confidence: (means.min(), means.quantile(confidence))),
        "All that is left out is left out at the upper end: leave out (1 - confidence) / 2 at either end.",
    ),
    "extremes": (
        _bootstrap(ends=lambda means, _: (means.min(), means.max())),
        "The smallest and the largest resampled mean are returned, which move apart with the number of resamples: take the quantiles.",
    ),
    "normal-approximation": (
        _and_centre(lambda centre, means, _: (centre - 1.96 * means.std(), centre + 1.96 * means.std())),
        "Centre ± 1.96 standard deviations is symmetric and ignores `confidence`: a percentile interval takes quantiles of the"
        " resampled means.",
    ),
    "mirrored": (
        _and_centre(lambda centre, means, confidence: _quantiles(2 * centre - means, confidence)),
        "This is the basic bootstrap, which mirrors the interval at the centre: the percentile interval takes the quantiles as they are.",
    ),
    "ends-swapped": (_bootstrap(ends=lambda *given: _quantiles(*given)[::-1]), "The lower end comes first."),
    "num-resamples-ignored": (_bootstrap(size=lambda _: 2000), "The number of resamples is fixed: draw num_resamples of them."),
    "own-generator": (
        _bootstrap(draw=lambda x, count, _: _stratified(x, count, None)),
        "Nothing is drawn from `generator`, so the interval is another one each time: hand it on to whatever draws.",
    ),
    "python-floats": (
        after(ch48.bootstrap_interval, lambda interval: tuple(end.item() for end in interval)),
        "Return 0-dim tensors, not Python floats.",
    ),
    "dtype-lost": (
        after(ch48.bootstrap_interval, lambda interval: tuple(end.float() for end in interval)),
        "The results have lost the scores' dtype.",
    ),
}

BOOTSTRAP_INTERVAL = Exercise(
    name="bootstrap_interval",
    reference=ch48.bootstrap_interval,
    criteria={"values": 1.3, "dtype": 0.1, "inputs": 0.1},
    cases=drawn_once(
        _ends("eight seeds, half of them failed", _pattern(HALVES), visible=True),
        _ends("four seeds, one of them lucky", _pattern(LUCKY, confidence=0.7), visible=True),
        _ends("confidence 0.9", _pattern(HALVES, confidence=0.9, num_resamples=1000)),
        _ends("two tasks", _pattern(FEW, [score + 10 for score in FEW], confidence=0.7), visible=True),
        _ends("two tasks in which seeds trade places", _together, visible=True, draws=2),
        _ends(
            "three tasks, all seeds alike: no width", _pattern(*((x,) * 6 for x in (0, 1, 5))), closed_form=_certain, visible=True
        ),
        _ends("a single seed: no width", _pattern((3,)), closed_form=_certain),
        _ends("default settings", without(_pattern(HALVES), "confidence", "num_resamples"), visible=True),
        _ends("no generator", replaced(_pattern(HALVES), generator=None)),
        _ends("a single resample: no width", _pattern(HALVES, num_resamples=1), view="width", visible=True),
        Case("what is drawn from", _pattern(HALVES, num_resamples=20), returns=("generator",), view="drawn_from", visible=True),
        _ends("single precision", _pattern(HALVES), dtype=torch.float32, visible=True),
    ),
    misconceptions=(*wrong(_WRONG_BOOTSTRAP_INTERVAL), in_place(ch48.bootstrap_interval, "scores")),
    variants={
        "all resamples at once": _bootstrap(),
        "rounded uniform numbers": _bootstrap(draw=_by_floor),
        "task by task": _task_by_task,
        "multinomial": _bootstrap(draw=_by_multinomial),
        "NumPy, seeded from the generator": _bootstrap(draw=_by_numpy, ends=_percentiles),
    },
)

# --------------------------------------------------------------------------------------------------- repaired_transitions

_ROWS = ("sent", "rewards", "truncated")


@drawing
def _motor_steps(generator, size=6, dims=2, low=(-1.0, 0.5), high=(3.0, 1.5), reach=1.0):
    """Steps of motors whose commands lie within `reach` of their range around its middle."""
    lower, upper = torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)
    ends = uniform(generator, 2, size) < 0.5
    ends[:, 0], ends[:, -1] = torch.tensor([True, False]), torch.tensor([False, True])
    return {
        "obs": normal(generator, size, 3),
        "sent": 0.5 * (lower + upper) + reach * (uniform(generator, size, dims) - 0.5) * (upper - lower),
        "rewards": normal(generator, size),
        "next_obs": normal(generator, size, 3),
        "terminated": ends[0],
        "truncated": ends[1],
        "low": lower,
        "high": upper,
    }


_rewritten = versions_of(
    ch48.repaired_transitions,
    satisfies(lambda obs, sent, rewards, next_obs: len(obs) == len(sent) == len(rewards) == len(next_obs)),
    one_shape("rewards", "terminated", "truncated"),
    satisfies(lambda low, high: (low < high).all()),
)


def _as_sampled(sent, low, high):
    return 2 * (sent - low) / (high - low) - 1


def _kept(actions=_as_sampled, ended=lambda terminated, truncated: terminated, checked=True, **columns):
    """A version: `actions(sent, low, high)` are those that are kept."""

    def version(obs, sent, rewards, next_obs, terminated, truncated, low, high):
        kept = Transitions(obs, actions(sent, low, high), rewards, next_obs, ended(terminated, truncated))
        return kept._replace(**{name: change(kept) for name, change in columns.items()})

    return _rewritten(version, checked)


def _component_by_component(sent, low, high):
    columns = [(sent[:, i] - (low[i] + high[i]) / 2) / ((high[i] - low[i]) / 2) for i in range(sent.shape[1])]
    return torch.stack(columns, 1)


def _by_interpolation(sent, low, high):
    ends = np.array([-1.0, 1.0])
    columns = [np.interp(sent[:, i].numpy(), [float(low[i]), float(high[i])], ends) for i in range(sent.shape[1])]
    return torch.from_numpy(np.stack(columns, 1)).to(sent.dtype)


_ABOVE = torch.full((2,), 5.0)  # any high
_STUCK = torch.tensor([3.0, 0.5], dtype=torch.float64)  # the second motor's low, too

_WRONG_ACTIONS = {
    "as-sent": (
        lambda sent, low, high: sent.clone(),
        "The buffer keeps what the environment was sent. The policy's actions lie in (-1, 1), and the critic is asked about those: it"
        " has to be taught about actions on the same scale.",
    ),
    "as-clipped": (
        lambda sent, low, high: sent.clamp(-1, 1),
        "Clipping commands to [-1, 1] makes many of them one and the same action, and moves none to where the policy meant it:"
        " undo the scaling.",
    ),
    "to-the-unit-interval": (
        lambda sent, low, high: (sent - low) / (high - low),
        "These actions lie in [0, 1]: half of the range that the policy chooses from is missing.",
    ),
    "divided-by-the-upper-bound": (
        lambda sent, low, high: sent / high,
        "Dividing by the upper bound is right only for bounds that are symmetric around 0.",
    ),
    "not-centred": (
        lambda sent, low, high: 2 * sent / (high - low),
        "The middle of the motor's range is the policy's 0: subtract it before you scale.",
    ),
    "not-scaled": (
        lambda sent, low, high: sent - 0.5 * (low + high),
        "The commands are centred, but not scaled: half of the range is 1.",
    ),
    "half-the-scale": (
        lambda sent, low, high: (sent - 0.5 * (low + high)) / (high - low),
        "Divide by half of the range: these actions reach only from -0.5 to 0.5.",
    ),
    "upside-down": (
        lambda sent, low, high: -_as_sampled(sent, low, high),
        "The lower bound is the policy's -1, the upper one its 1: these are exchanged.",
    ),
    "one-motor's-bounds-for-all": (
        lambda sent, low, high: _as_sampled(sent, low[0], high[0]),
        "Every motor has bounds of its own: low and high are (A,), and broadcast over the steps.",
    ),
    "before-squashing": (
        lambda sent, low, high: _as_sampled(sent, low, high).clamp(-1 + 1e-6, 1 - 1e-6).atanh(),
        "The critic is asked about actions after the hyperbolic tangent, in (-1, 1), not about pre-activations.",
    ),
}

_WRONG_REPAIRED_TRANSITIONS = {
    "truncated-taken-for-terminated": (
        _kept(ended=lambda terminated, truncated: terminated | truncated),
        "A time limit is no end of the task: the critic's target goes on there.",
    ),
    "truncated-instead-of-terminated": (
        _kept(ended=lambda terminated, truncated: truncated),
        "`terminated` is what ends the target. The time limit does not.",
    ),
    "successor-lost": (_kept(next_obs=lambda kept: kept.obs), "next_obs is what the step led to, not what was seen before it."),
    "dtype-lost": (
        after(ch48.repaired_transitions, lambda kept: kept._replace(actions=kept.actions.half())),
        "The actions have lost the dtype of what was sent.",
    ),
}

REPAIRED_TRANSITIONS = Exercise(
    name="repaired_transitions",
    reference=ch48.repaired_transitions,
    criteria={"values": 1.6, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    axes=("step",),
    cases=drawn_once(
        Case("a motor that takes 0 to 1", _motor_steps(dims=1, low=(0.0,), high=(1.0,)), visible=True, draws=2),
        Case("two motors with bounds of their own", _motor_steps(), visible=True, draws=2),
        Case("bounds of -1 and 1", _motor_steps(low=(-1.0, -1.0), high=(1.0, 1.0)), visible=True),
        Case("symmetric bounds", _motor_steps(dims=1, low=(-2.0,), high=(2.0,))),
        Case("as many steps as motors", _motor_steps(size=2)),
        Case("single precision", _motor_steps(), dtype=torch.float32, visible=True),
        Case("low above high", replaced(_motor_steps(), low=_ABOVE), raises=["low", "high"], visible=True, draws=1),
        Case("one motor that cannot move", replaced(_motor_steps(), high=_STUCK), raises=["low", "high"], draws=1),
        *shape_cases(_motor_steps(), _ROWS),
    ),
    misconceptions=(
        *wrong(_WRONG_ACTIONS, _kept),
        *wrong(_WRONG_REPAIRED_TRANSITIONS),
        *spoilt(ch48.repaired_transitions, changed="sent"),
        bad_input_accepted(_kept(checked=False)),
    ),
    variants={
        "from the lower bound": _kept(),
        "component by component": _kept(_component_by_component),
        "interpolation": _kept(_by_interpolation),
        "from the upper bound": _kept(lambda sent, low, high: 1 - (high - sent) / ((high - low) / 2)),
        "a plain tuple": after(_kept(), tuple),
    },
)

EXERCISES = (
    SQUASHED_GAUSSIAN_LOG_PROB,
    SOFT_Q_TARGET,
    SAC_ACTOR_LOSS,
    TEMPERATURE_LOSS,
    POLYAK_UPDATE,
    INTERQUARTILE_MEAN,
    BOOTSTRAP_INTERVAL,
    REPAIRED_TRANSITIONS,
)
