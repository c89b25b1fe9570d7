"""Checks of chapter 43: cases, named misconceptions and correct variants for PPO's clip and the numbers that watch over it."""

from __future__ import annotations

import math

import numpy as np
import torch

from autograder.authoring.parts import SHAPES
from autograder.authoring.spec import Case, Exercise, Misconception
from course_lib import validate
from solutions import ch43

INF = math.inf

# ---------------------------------------------------------------------------------------------------------------- inputs


def _normal(generator, *shape):
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def _off_bounds(log_ratio, clip_range=0.2):
    """The same log-ratios, moved where the ratio is within 0.01 of a bound: there neither gradient nor count is graded."""
    near = ((log_ratio.expm1().abs() - clip_range).abs() < 0.01) & (log_ratio != 0)
    return torch.where(near, log_ratio + 0.03, log_ratio)


def _arguments(generator, log_ratio, advantages, base=-2.0, **scalars):
    old_log_probs = base + _normal(generator, len(log_ratio))
    return {"log_probs": old_log_probs + log_ratio, "old_log_probs": old_log_probs, "advantages": advantages} | scalars


def _batch(size=33, spread=0.4, base=-2.0, **scalars):
    """Log-ratios of a policy that has moved by `spread`; `base` is the actions' typical log-probability."""

    def inputs(generator):
        log_ratio = _off_bounds(spread * _normal(generator, size), **scalars)
        return _arguments(generator, log_ratio, _normal(generator, size) + 0.3, base, **scalars)

    return inputs


def _quadrants(distance, **scalars):
    """Ratios well outside on either side, for either sign of the advantage."""

    def inputs(generator):
        side = torch.tensor([1.0, 1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
        sign = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0], dtype=torch.float64)
        log_ratio = side * distance * (1 + 0.2 * torch.rand(5, generator=generator, dtype=torch.float64))
        return _arguments(generator, log_ratio, sign * (0.2 + _normal(generator, 5).abs()), **scalars)

    return inputs


def _one_action(side, sign):
    """One of those quadrants alone, so that nothing else hides it."""

    def inputs(generator):
        return _arguments(generator, torch.full((1,), side, dtype=torch.float64), sign * (0.2 + _normal(generator, 1).abs()))

    return inputs


def _constant(log_ratio, **scalars):
    """Every action's probability has changed by the same factor."""

    def inputs(generator):
        return _arguments(generator, torch.full((7,), log_ratio, dtype=torch.float64), _normal(generator, 7) + 0.3, **scalars)

    return inputs


def _zero_advantage(generator):
    drawn = _batch(clip_range=INF)(generator)
    drawn["advantages"][3] = 0.0
    return drawn


def _close_calls(generator):
    """Ratios for which bounds that are nearly right (exp(±0.2), 1 / 1.2) count other samples as outside than the right ones."""
    ratios = torch.tensor([1.21, 1.21, 1.21, 0.81, 0.825, 1.0, 1.1], dtype=torch.float64)
    ratios = ratios + 0.004 * (torch.rand(7, generator=generator, dtype=torch.float64) - 0.5)
    return _arguments(generator, ratios.log(), _normal(generator, 7))


def _drop(*names):
    return lambda inputs: lambda generator: {name: value for name, value in inputs(generator).items() if name not in names}


def _with(inputs, **changes):
    return lambda generator: inputs(generator) | changes


def _reshaped(name, change, inputs):
    def wrong_shape(generator):
        drawn = inputs(generator)
        return drawn | {name: change(drawn[name])}

    return wrong_shape


def _shape_cases(names, inputs):
    """Bad shapes: a column broadcasts silently to all pairs, a batch that is too short fails later and elsewhere."""
    column = {f"{name} as a column": _reshaped(name, lambda x: x[:, None], inputs) for name in names}
    short = {f"{names[-1]} with an entry too few": _reshaped(names[-1], lambda x: x[:-1], inputs)}
    shown = f"{names[-1]} as a column"
    return tuple(Case(name, bad, raises=names, visible=name == shown, draws=1) for name, bad in (column | short).items())


def _negative_range(inputs):
    return Case("clip_range = -0.1", _with(inputs, clip_range=-0.1), raises=["clip_range"], visible=True, draws=1)


# ---------------------------------------------------------------------------------------------- wrong answers, in general

_VALIDATE = (
    "Shapes that differ broadcast silently, (B, 1) against (B,) to all pairs (B, B), and a negative clip_range turns the "
    "interval inside out. Check the arguments first: course_lib.validate raises errors that name them."
)
_DTYPE = "The result has lost the inputs' dtype: cast masks with .to(log_probs.dtype), not with .float()."
_SCALAR = "Return a 0-dim tensor, not a Python float: .item() cuts the graph that the optimiser needs."
_NUMBER = "Return a 0-dim tensor, not a Python float: .item() makes a device wait; convert once, where you log."
_METRIC = "A reported metric carries no graph: detach it, or it keeps the whole network's activations alive."
_DETACHED = "The loss reaches no parameter: detach only what is data, never the ratio or log_probs."
_INVERTED = "The ratio is old over new: it is exp(log_probs - old_log_probs), new minus old."
_NO_EXP = "This is the log-ratio: take its exponential. Where nothing has changed the ratio is 1, not 0."
_QUOTIENT = (
    "Dividing probabilities gives 0 / 0 for unlikely actions (with many action dimensions, all of them): subtract "
    "log-probabilities first, then take the exponential."
)
_SIGN = "The objective is to be maximised, a loss minimised: negate it."
_SUM = "A sum grows with the batch, and with it the step: take the mean over the batch."
_RANGE = "The range is 0.2 whatever the caller says: use clip_range."
_ZERO = "clip_range = 0 is the narrowest interval, not none (a falsy zero?): infinity means no clipping."
_LOWER = "The lower bound is 1 - ε, not 1 / (1 + ε)."
_LOG_RANGE = "The range applies to the ratio, not to its logarithm: the bounds are 1 - ε and 1 + ε."
_CRITIC = "The policy's loss must not train the critic: detach the advantages."
_IN_PLACE = (
    "The caller's tensor is changed (by -=, *= or a method that ends in _), and the next epoch finds other data: make a new one."
)


def _checked(**arguments):
    clip_range = arguments.pop("clip_range", 0)
    validate.same_shape(**arguments)
    validate.non_negative(clip_range=clip_range)


def _ratio(new, old):
    return (new - old).exp()


def _inverted(new, old):
    return (old - new).exp()


def _quotient(new, old):
    return new.exp() / old.exp()


def _difference(new, old):
    return new - old


def _after(function, change):
    """Right, and then spoilt."""
    return lambda *args, **kwargs: change(function(*args, **kwargs))


def _spoilt(function, message=_SCALAR):
    return (
        Misconception("python-float", _after(function, torch.Tensor.item), message),
        Misconception("dtype-lost", _after(function, torch.Tensor.float), _DTYPE),
    )


def _loss(objective, ratio=_ratio, leaks=(), checked=True):
    """A version of a loss: `objective` takes ratio, advantages and clip range; `leaks` names the data that is not detached."""

    def version(log_probs, old_log_probs, advantages, clip_range=0.2):
        if checked:
            _checked(log_probs=log_probs, old_log_probs=old_log_probs, advantages=advantages, clip_range=clip_range)
        old = old_log_probs if "old_log_probs" in leaks else old_log_probs.detach()
        weights = advantages if "advantages" in leaks else advantages.detach()
        return objective(ratio(log_probs, old), weights, clip_range)

    return version


def _metric(formula, ratio=_ratio, checked=True):
    """A version of a metric: `formula` takes ratio and clip range."""

    def version(log_probs, old_log_probs, clip_range=0.2):
        if checked:
            _checked(log_probs=log_probs, old_log_probs=old_log_probs, clip_range=clip_range)
        return formula(ratio(log_probs, old_log_probs).detach(), clip_range)

    return version


def _plain(r, a, _e):
    return -(r * a).mean()


def _clip(r, a, e):
    return -torch.minimum(r * a, r.clamp(1 - e, 1 + e) * a).mean()


def _normalised(a):
    return (a - a.mean()) / (a.std() + 1e-8)


def _loss_misconceptions(objective):
    """What goes wrong alike with and without the clip."""
    both = ("old_log_probs", "advantages")
    return (
        Misconception("sign-missing", _loss(lambda r, a, e: -objective(r, a, e)), _SIGN),
        Misconception(
            "sum-instead-of-mean",
            _loss(lambda r, a, e: objective(r, a, e) * len(a)),
            _SUM,
        ),
        Misconception("ratio-inverted", _loss(objective, _inverted), _INVERTED),
        Misconception("exponential-missing", _loss(objective, _difference), _NO_EXP),
        Misconception("probabilities-divided", _loss(objective, _quotient), _QUOTIENT),
        Misconception(
            "advantages-sign-lost",
            _loss(lambda r, a, e: objective(r, a.abs(), e)),
            "Every action is made likelier, bad ones too: use the advantage with its sign.",
        ),
        Misconception(
            "advantages-normalised-inside",
            _loss(lambda r, a, e: objective(r, _normalised(a), e)),
            "The loss takes the advantages as they come; whoever calls it decides on normalising.",
        ),
        Misconception("ratio-detached", _loss(objective, lambda new, old: _ratio(new, old).detach()), _DETACHED),
        Misconception(
            "gradient-into-old-log-probs",
            _loss(objective, leaks=both[:1]),
            "The old log-probabilities are data of the rollout: detach them. On the same network, both gradients cancel.",
        ),
        Misconception(
            "gradient-into-advantages",
            _loss(objective, leaks=both[1:]),
            _CRITIC,
        ),
        Misconception(
            "nothing-detached",
            _loss(objective, leaks=both),
            "Gradient reaches the old log-probabilities and the advantages: both are data of the rollout, detach them.",
        ),
        Misconception("bad-input-accepted", _loss(objective, checked=False), _VALIDATE),
    )


# --------------------------------------------------------------------------------------------- correct answers, in general


def _refuse(clip_range=0.0, **tensors):
    """Another style of validation than the reference's."""
    first, *others = tensors
    for name in others:
        if tensors[name].shape != tensors[first].shape:
            raise ValueError(f"{name} has shape {tuple(tensors[name].shape)}, but {first} has {tuple(tensors[first].shape)}")
    if clip_range < 0:
        raise ValueError(f"expected clip_range >= 0, but received {clip_range!r}")


def _loss_variant(objective):
    """`objective` takes log-ratio, advantages and clip range."""

    def variant(log_probs, old_log_probs, advantages, clip_range=0.2):
        _refuse(clip_range, log_probs=log_probs, old_log_probs=old_log_probs, advantages=advantages)
        return objective(log_probs - old_log_probs.detach(), advantages.detach(), clip_range)

    return variant


def _metric_variant(formula):
    """`formula` takes log-ratio and clip range."""

    def variant(log_probs, old_log_probs, clip_range=0.2):
        _refuse(clip_range, log_probs=log_probs, old_log_probs=old_log_probs)
        with torch.no_grad():
            return formula(log_probs - old_log_probs, clip_range)

    return variant


def _in_double(objective):
    return lambda d, *rest: objective(d.double(), *rest).to(d.dtype)


_PAIR = ("log_probs", "old_log_probs")
_TRIPLE = (*_PAIR, "advantages")

# ------------------------------------------------------------------------------------------------------ importance_ratio

_bare = _drop("advantages", "clip_range")


def _ratios(formula, checked=True):
    def wrong(log_probs, old_log_probs):
        if checked:
            _checked(log_probs=log_probs, old_log_probs=old_log_probs)
        return formula(log_probs, old_log_probs)

    return wrong


def _ratio_mutating(log_probs, old_log_probs):
    _checked(log_probs=log_probs, old_log_probs=old_log_probs)
    log_probs -= old_log_probs
    return log_probs.exp()


def _ratio_variant(formula):
    def variant(log_probs, old_log_probs):
        _refuse(log_probs=log_probs, old_log_probs=old_log_probs)
        return formula(log_probs, old_log_probs)

    return variant


IMPORTANCE_RATIO = Exercise(
    name="importance_ratio",
    reference=ch43.importance_ratio,
    criteria={"values": 0.6, "gradient": 0.2, "dtype": 0.05, "inputs": 0.05, "errors": 0.1},
    cases=(
        Case("a batch", _bare(_batch()), visible=True, draws=3),
        Case(
            "identical policies", _bare(_constant(0.0)), closed_form=lambda log_probs, _: torch.ones_like(log_probs), visible=True
        ),
        Case("twice as likely", _bare(_constant(math.log(2))), closed_form=lambda log_probs, _: torch.full_like(log_probs, 2.0)),
        Case("very unlikely actions", _bare(_batch(base=-900.0)), visible=True),
        Case("log-ratios around ±20", _bare(_quadrants(20.0))),
        Case("log_probs that require gradient", _bare(_batch()), differentiate=["log_probs"], visible=True),
        Case("single precision", _bare(_batch()), dtype=torch.float32, visible=True),
        *_shape_cases(_PAIR, _bare(_batch())),
    ),
    misconceptions=(
        Misconception("ratio-inverted", _ratios(_inverted), _INVERTED),
        Misconception("exponential-missing", _ratios(_difference), _NO_EXP),
        Misconception("probabilities-divided", _ratios(_quotient), _QUOTIENT),
        Misconception(
            "log-probs-divided",
            _ratios(lambda new, old: new / old),
            "A quotient of logarithms is no ratio of probabilities: subtract, then exp.",
        ),
        Misconception(
            "log-probs-added",
            _ratios(lambda new, old: (new + old).exp()),
            "This multiplies the probabilities: subtract the logarithms.",
        ),
        Misconception(
            "minus-one",
            _ratios(lambda new, old: (new - old).expm1()),
            "This is ratio - 1: where nothing has changed the ratio itself is 1.",
        ),
        Misconception(
            "clipped-already",
            _ratios(lambda new, old: _ratio(new, old).clamp(0.8, 1.2)),
            "The ratio itself is not clipped: the loss needs it both as it is and clipped.",
        ),
        Misconception(
            "averaged",
            _ratios(lambda new, old: _ratio(new, old).mean()),
            "One ratio for each action, shape (B,): do not average here.",
        ),
        Misconception("ratio-detached", _ratios(lambda new, old: _ratio(new, old).detach()), _DETACHED),
        Misconception("dtype-lost", _after(ch43.importance_ratio, torch.Tensor.float), _DTYPE),
        Misconception("log-probs-changed-in-place", _ratio_mutating, _IN_PLACE),
        Misconception("bad-input-accepted", _ratios(_ratio, checked=False), SHAPES),
    ),
    variants={
        "its own buffer": _ratio_variant(lambda new, old: (new - old.detach()).exp_()),
        "reciprocal of the inverse, gradient on both sides": _ratio_variant(lambda new, old: (old - new).exp().reciprocal()),
        "one number at a time": _ratio_variant(
            lambda new, old: torch.stack([torch.exp(n - o.item()) for n, o in zip(new, old, strict=True)])
        ),
        "a power of e in double precision": _ratio_variant(
            lambda new, old: (math.e ** (new.double() - old.double())).to(new.dtype)
        ),
        "detached ratio with its gradient put back": _ratio_variant(
            lambda new, old: _ratio(new, old).detach() * (1 + new - new.detach())
        ),
    },
)

# -------------------------------------------------------------------------------------------------------- surrogate_loss

_unclipped = _drop("clip_range")


def _minus_mean_advantage(log_probs, old_log_probs, advantages, clip_range=0.2):
    return -advantages.mean()


def _plain_by_hand(log_probs, old_log_probs, advantages):
    total = sum(
        math.exp(n - o) * a for n, o, a in zip(*(x.tolist() for x in (log_probs, old_log_probs, advantages)), strict=True)
    )
    return torch.tensor(-total / len(advantages), dtype=torch.float64)


SURROGATE_LOSS = Exercise(
    name="surrogate_loss",
    reference=ch43.surrogate_loss,
    criteria={"values": 0.8, "gradient": 0.45, "dtype": 0.05, "inputs": 0.05, "errors": 0.15},
    cases=(
        Case("a batch", _unclipped(_batch()), closed_form=_plain_by_hand, visible=True, draws=3),
        Case(
            "identical policies: minus the mean advantage",
            _unclipped(_constant(0.0)),
            closed_form=_minus_mean_advantage,
            visible=True,
        ),
        Case("ratios far from 1", _unclipped(_quadrants(1.5)), closed_form=_plain_by_hand, visible=True),
        Case("very unlikely actions", _unclipped(_batch(base=-900.0)), closed_form=_plain_by_hand, visible=True),
        Case("log-ratios around ±20", _unclipped(_quadrants(20.0)), closed_form=_plain_by_hand),
        Case("all inputs require gradient", _unclipped(_batch()), differentiate=_TRIPLE, visible=True),
        Case("gradient where the policies are identical", _unclipped(_constant(0.0)), differentiate=_TRIPLE),
        Case("single precision", _unclipped(_batch()), dtype=torch.float32, visible=True),
        *_shape_cases(_TRIPLE, _unclipped(_batch())),
    ),
    misconceptions=(
        *_loss_misconceptions(_plain),
        Misconception(
            "log-probability-instead-of-ratio",
            _loss(_plain, lambda new, old: new),
            "This is REINFORCE's loss: it has the right gradient only before the first step. Use the ratio.",
        ),
        Misconception(
            "probability-instead-of-ratio",
            _loss(_plain, lambda new, old: new.exp()),
            "The actions came from the old policy: divide by its probability.",
        ),
        Misconception("clipped-already", _loss(_clip), "There is no clip in this loss yet: it is what the next exercise adds."),
        Misconception(
            "means-multiplied",
            _loss(lambda r, a, e: -r.mean() * a.mean()),
            "The product of the means forgets which action had which advantage: multiply first, then average.",
        ),
        Misconception(
            "ratios-normalised",
            _loss(lambda r, a, e: -(r / r.sum() * a).sum()),
            "The ratios are divided by their sum: PPO's objective is the plain mean of ρ A.",
        ),
        *_spoilt(ch43.surrogate_loss),
        Misconception(
            "advantages-changed-in-place",
            _loss(lambda r, a, _e: (r * a.neg_()).mean()),
            _IN_PLACE,
        ),
    ),
    variants={
        "dot product": _loss_variant(lambda d, a, e: -(d.exp() @ a) / len(a)),
        "one number at a time": _loss_variant(
            lambda d, a, e: -sum(math.e**x * y.item() for x, y in zip(d, a, strict=True)) / len(a)
        ),
        "double precision inside": _loss_variant(_in_double(lambda d, a, e: (-a.double() * d.exp()).mean())),
        "score function with detached ratio": _loss_variant(
            lambda d, a, e: (d.exp().detach() * -a * (1 + d - d.detach())).mean()
        ),
        "its own buffer": _loss_variant(lambda d, a, e: (d.exp() * a).neg_().mean()),
    },
)

# ------------------------------------------------------------------------------------------------- clipped_surrogate_loss


def _clip_by_cases(log_probs, old_log_probs, advantages, clip_range=0.2):
    """Without min: a good action's ratio counts up to the upper bound, a bad one's down to the lower bound."""
    total = 0.0
    for new, old, advantage in zip(*(x.tolist() for x in (log_probs, old_log_probs, advantages)), strict=True):
        ratio = math.exp(new - old)
        total += advantage * (min(ratio, 1 + clip_range) if advantage > 0 else max(ratio, 1 - clip_range))
    return torch.tensor(-total / len(advantages), dtype=torch.float64)


def _clipped_to(bounds):
    """min with a ratio clipped to other bounds."""
    return _loss(lambda r, a, e: -torch.minimum(r * a, r.clamp(*bounds(e)) * a).mean())


def _limits(r, a, e):
    """OpenAI Spinning Up's way to write it, which for A = 0 and an infinite range is 0 times infinity."""
    return -torch.minimum(r * a, torch.where(a > 0, (1 + e) * a, (1 - e) * a)).mean()


def _cut_outside(r, a, e):
    """The right value, but no gradient wherever the ratio is outside."""
    return _clip(torch.where((r - 1).abs() > e, r.detach(), r), a, e)


def _straight_through(r, a, e):
    clipped = r + (r.clamp(1 - e, 1 + e) - r).detach()
    return -torch.minimum(r * a, clipped * a).mean()


def _clip_in_python(d, a, e):
    objectives = []
    for log_ratio, advantage in zip(d, a.tolist(), strict=True):
        ratio = torch.exp(log_ratio)
        bound = min(max(ratio.item(), 1 - e), 1 + e)
        objectives.append(ratio * advantage if ratio.item() * advantage <= bound * advantage else 0 * ratio + bound * advantage)
    return -sum(objectives) / len(objectives)


def _clip_by_mask(d, a, e):
    ratio = d.exp()
    saturated = ((a > 0) & (ratio > 1 + e)) | ((a < 0) & (ratio < 1 - e))
    return (torch.where(saturated, ratio.detach().clamp(1 - e, 1 + e), ratio) * -a).mean()


def _clip_by_excess(d, a, e):
    """ρ A minus what lies past the bound in the direction of the advantage."""
    ratio = d.exp()
    excess = torch.where(a > 0, (ratio - 1 - e).relu(), (1 - e - ratio).relu())
    return (a.abs() * excess - a * ratio).mean()


CLIPPED_SURROGATE_LOSS = Exercise(
    name="clipped_surrogate_loss",
    reference=ch43.clipped_surrogate_loss,
    criteria={"values": 1.6, "gradient": 1.0, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    cases=(
        Case("a batch, default clip_range", _batch(), closed_form=_clip_by_cases, visible=True, draws=3),
        Case(
            "identical policies: minus the mean advantage",
            _constant(0.0),
            closed_form=_minus_mean_advantage,
            visible=True,
            draws=1,
        ),
        *(
            Case(f"{how} action, ratio {where}", _one_action(side, sign), closed_form=_clip_by_cases, visible=True, draws=1)
            for how, sign in (("a good", 1), ("a bad", -1))
            for where, side in (("above", 0.7), ("below", -0.7))
        ),
        Case("clip_range = 0.05", _batch(clip_range=0.05), closed_form=_clip_by_cases, visible=True, draws=1),
        Case("clip_range = 0", _batch(clip_range=0), closed_form=_clip_by_cases, visible=True, draws=1),
        Case("clip_range = 1.5", _batch(spread=1.0, clip_range=1.5), closed_form=_clip_by_cases, draws=1),
        Case("clip_range = infinity, one advantage is 0", _zero_advantage, closed_form=_clip_by_cases, visible=True, draws=1),
        Case("very unlikely actions", _batch(base=-900.0), closed_form=_clip_by_cases, visible=True, draws=1),
        Case("log-ratios around ±20", _quadrants(20.0), closed_form=_clip_by_cases, draws=1),
        Case("all inputs require gradient", _batch(), differentiate=_TRIPLE, visible=True),
        Case("gradient where the policies are identical", _constant(0.0), differentiate=_TRIPLE, visible=True, draws=1),
        Case("gradient well outside", _quadrants(1.0), differentiate=_TRIPLE, visible=True, draws=1),
        Case("gradient with clip_range = 0", _batch(clip_range=0), differentiate=_TRIPLE, draws=1),
        Case("gradient with clip_range = infinity", _batch(clip_range=INF), differentiate=_TRIPLE, draws=1),
        Case("single precision", _batch(), dtype=torch.float32, visible=True, draws=1),
        *_shape_cases(_TRIPLE, _batch()),
        _negative_range(_batch()),
    ),
    misconceptions=(
        *_loss_misconceptions(_clip),
        Misconception(
            "max-instead-of-min",
            _loss(lambda r, a, e: -torch.maximum(r * a, r.clamp(1 - e, 1 + e) * a).mean()),
            "Take the smaller of the two terms (the larger only once both are negated): max caps just the wrong side.",
        ),
        Misconception(
            "clip-without-min",
            _loss(lambda r, a, e: -(r.clamp(1 - e, 1 + e) * a).mean()),
            "A sample that has moved the wrong way is stuck outside: take the minimum with the unclipped term.",
        ),
        Misconception("not-clipped", _loss(_plain), "Nothing is clipped: good actions gain without limit."),
        Misconception(
            "range-on-log-ratio",
            _clipped_to(lambda e: (math.exp(-e), math.exp(e))),
            _LOG_RANGE,
        ),
        Misconception(
            "no-lower-bound", _clipped_to(lambda e: (-INF, 1 + e)), "Bad actions have no limit: clip at 1 - ε as well."
        ),
        Misconception(
            "no-upper-bound", _clipped_to(lambda e: (1 - e, INF)), "Good actions have no limit: clip at 1 + ε as well."
        ),
        Misconception("lower-bound-is-inverse", _clipped_to(lambda e: (1 / (1 + e), 1 + e)), _LOWER),
        Misconception(
            "bounds-around-zero",
            _clipped_to(lambda e: (-e, e)),
            "An unchanged policy has ratio 1: the interval lies around 1, not around 0.",
        ),
        Misconception(
            "product-clipped",
            _loss(lambda r, a, e: -torch.minimum(r * a, (r * a).clamp(1 - e, 1 + e)).mean()),
            "The ratio is clipped, then multiplied by the advantage; here the product is clipped.",
        ),
        Misconception(
            "minimum-of-means",
            _loss(lambda r, a, e: -torch.minimum((r * a).mean(), (r.clamp(1 - e, 1 + e) * a).mean())),
            "Take the minimum sample by sample, then the mean: otherwise all samples are clipped, or none.",
        ),
        Misconception("clip-range-ignored", _loss(lambda r, a, e: _clip(r, a, 0.2)), _RANGE),
        Misconception(
            "zero-range-means-off",
            _loss(lambda r, a, e: _clip(r, a, e or INF)),
            _ZERO,
        ),
        Misconception(
            "infinity-times-zero",
            _loss(_limits),
            "An infinite range times an advantage of 0 is NaN: clip the ratio before you multiply.",
        ),
        Misconception(
            "gradient-cut-on-both-sides",
            _loss(_cut_outside),
            "A sample outside on the wrong side of its advantage has lost its gradient: it is the one that must come back.",
        ),
        Misconception(
            "straight-through-clip",
            _loss(_straight_through),
            "Past the bound the gradient still flows: that it vanishes there is the point of the clip.",
        ),
        Misconception(
            "clipped-term-detached",
            _loss(lambda r, a, e: -torch.minimum(r * a, r.detach().clamp(1 - e, 1 + e) * a).mean()),
            "Inside, both terms are equal and min splits the gradient between them: with one detached, half is lost.",
        ),
        *_spoilt(ch43.clipped_surrogate_loss),
        Misconception(
            "advantages-changed-in-place",
            _loss(lambda r, a, e: torch.maximum(r * a.neg_(), r.clamp(1 - e, 1 + e) * a).mean()),
            _IN_PLACE,
        ),
    ),
    variants={
        "maximum of the negated terms": _loss_variant(
            lambda d, a, e: torch.max(-a * d.exp(), -a * torch.clamp(d.exp(), 1 - e, 1 + e)).mean()
        ),
        "one number at a time": _loss_variant(_clip_in_python),
        "mask of the saturated samples": _loss_variant(_clip_by_mask),
        "excess past the bound": _loss_variant(_clip_by_excess),
        "one-sided limits by sign": _loss_variant(
            lambda d, a, e: -torch.where(a > 0, a * d.exp().clamp(max=1 + e), a * d.exp().clamp(min=1 - e)).mean()
        ),
        "amin over a stack, in double precision": _loss_variant(
            _in_double(
                lambda d, a, e: -torch.stack([d.exp() * a.double(), d.exp().clip(1 - e, 1 + e) * a.double()]).amin(0).mean()
            )
        ),
    },
)

# ------------------------------------------------------------------------------------------------------------- approx_kl


def _kl(formula, checked=True):
    """A wrong estimator: `formula` takes the ratio and its logarithm, sample by sample."""
    return _metric(lambda d, _e: formula(d.exp(), d).mean(), _difference, checked)


def _kl_graph(log_probs, old_log_probs):
    _checked(log_probs=log_probs, old_log_probs=old_log_probs)
    log_ratio = log_probs - old_log_probs
    return (log_ratio.exp() - 1 - log_ratio).mean()


def _zero(log_probs, old_log_probs, clip_range=0.2):
    return torch.zeros((), dtype=log_probs.dtype)


def _kl_numpy(d, _e):
    values = d.double().numpy()
    return torch.tensor(np.mean(np.expm1(values) - values), dtype=d.dtype)


APPROX_KL = Exercise(
    name="approx_kl",
    reference=ch43.approx_kl,
    criteria={"values": 1.0, "gradient": 0.2, "dtype": 0.1, "inputs": 0.05, "errors": 0.15},
    cases=(
        Case("a batch", _bare(_batch()), visible=True, draws=3),
        Case("identical policies: 0", _bare(_constant(0.0)), closed_form=_zero, visible=True),
        Case(
            "every action twice as likely: 1 - log 2",
            _bare(_constant(math.log(2))),
            closed_form=lambda log_probs, _: torch.tensor(1 - math.log(2), dtype=torch.float64),
            visible=True,
        ),
        Case("policies far apart", _bare(_quadrants(1.5))),
        Case("very unlikely actions", _bare(_batch(base=-900.0)), visible=True),
        Case("log-ratios around ±20", _bare(_quadrants(20.0))),
        Case("both inputs require gradient", _bare(_batch()), differentiate=_PAIR, visible=True),
        Case("single precision", _bare(_batch()), dtype=torch.float32, visible=True),
        *_shape_cases(_PAIR, _bare(_batch())),
    ),
    misconceptions=(
        Misconception(
            "log-ratio-estimator",
            _kl(lambda r, d: -d),
            "mean(-log ρ) is the estimator k1: unbiased too, but noisy, and negative for many batches. Add ρ - 1.",
        ),
        Misconception(
            "squared-log-ratio-estimator",
            _kl(lambda r, d: d.square() / 2),
            "mean(½ (log ρ)²) is the estimator k2: small variance, but biased.",
        ),
        Misconception(
            "reversed",
            _kl(lambda r, d: 1 / r - 1 + d),
            "The policies are swapped: the actions came from the old one, so the ratio is new over old.",
        ),
        Misconception(
            "mean-log-ratio", _kl(lambda r, d: d), "The mean log-ratio has expectation minus KL: look at the sign, and add ρ - 1."
        ),
        Misconception(
            "one-not-subtracted", _kl(lambda r, d: r - d), "Identical policies give 1 here and must give 0: subtract 1."
        ),
        Misconception(
            "log-ratio-added",
            _kl(lambda r, d: r - 1 + d),
            "The sign of the log-ratio: ρ - 1 - log ρ is never negative, ρ - 1 + log ρ can be.",
        ),
        Misconception(
            "log-ratio-missing", _kl(lambda r, d: r - 1), "mean(ρ - 1) has expectation 0 whatever the policies: subtract log ρ."
        ),
        Misconception(
            "weighted-by-ratio",
            _kl(lambda r, d: r * d - (r - 1)),
            "This estimates the other direction, KL(new ‖ old): the log-ratio is not multiplied by the ratio here.",
        ),
        Misconception("sum-instead-of-mean", _metric(lambda d, e: (d.expm1() - d).sum(), _difference), _SUM),
        Misconception(
            "per-sample",
            _metric(lambda d, e: d.expm1() - d, _difference),
            "One number for the batch is asked for: take the mean over samples.",
        ),
        Misconception("probabilities-divided", _metric(lambda r, e: (r - 1 - r.log()).mean(), _quotient), _QUOTIENT),
        Misconception("graph-kept", _kl_graph, _METRIC),
        *_spoilt(ch43.approx_kl, _NUMBER),
        Misconception("bad-input-accepted", _kl(lambda r, d: r - 1 - d, checked=False), SHAPES),
        Misconception(
            "log-probs-changed-in-place",
            _metric(lambda d, e: (d.expm1() - d).mean(), lambda new, old: new.detach().sub_(old.detach())),
            _IN_PLACE,
        ),
    ),
    variants={
        "as the formula says": _metric_variant(lambda d, e: ((d.exp() - 1) - d).mean()),
        "NumPy": _metric_variant(_kl_numpy),
        "means of the parts, in double precision": _metric_variant(_in_double(lambda d, e: d.exp().mean() - 1 - d.mean())),
        "one number at a time": _metric_variant(
            lambda d, e: torch.tensor(sum(math.exp(x) - 1 - x for x in d.tolist()) / len(d), dtype=d.dtype)
        ),
    },
)

# --------------------------------------------------------------------------------------------------------- clip_fraction

_ranged = _drop("advantages")


def _share(outside, ratio=_ratio):
    """A wrong fraction: `outside` takes ratio and clip range and gives what is averaged."""
    return _metric(lambda r, e: outside(r, e).to(r.dtype).mean(), ratio)


def _fraction_graph(log_probs, old_log_probs, clip_range=0.2):
    """A count by sign() and relu() hangs on the graph, with gradient zero."""
    _checked(log_probs=log_probs, old_log_probs=old_log_probs, clip_range=clip_range)
    return ((_ratio(log_probs, old_log_probs) - 1).abs() - clip_range).relu().sign().mean()


def _fraction_numpy(d, e):
    return torch.tensor(np.mean(np.abs(np.expm1(d.double().numpy())) > e), dtype=d.dtype)


def _fraction_by_logarithms(d, e):
    bounds = torch.tensor([-e, e], dtype=torch.float64).log1p()  # the lower one is NaN, and never passed, where ε > 1
    return ((d < bounds[0]) | (d > bounds[1])).to(d.dtype).mean()


CLIP_FRACTION = Exercise(
    name="clip_fraction",
    reference=ch43.clip_fraction,
    criteria={"values": 0.7, "gradient": 0.05, "dtype": 0.1, "inputs": 0.05, "errors": 0.1},
    cases=(
        Case("a batch, default clip_range", _ranged(_batch()), visible=True, draws=3),
        Case("identical policies: 0", _ranged(_constant(0.0)), closed_form=_zero, visible=True),
        Case("ratios close to the bounds", _ranged(_close_calls), visible=True),
        Case(
            "every ratio outside: 1",
            _ranged(_quadrants(1.0)),
            closed_form=lambda log_probs, _: torch.ones((), dtype=log_probs.dtype),
            visible=True,
        ),
        Case("clip_range = 0.05", _ranged(_batch(clip_range=0.05)), visible=True),
        Case("clip_range = 0", _ranged(_batch(clip_range=0)), visible=True),
        Case("clip_range = infinity: 0", _ranged(_batch(clip_range=INF)), closed_form=_zero, visible=True),
        Case("clip_range = 1.5", _ranged(_batch(spread=1.0, clip_range=1.5))),
        Case("very unlikely actions", _ranged(_batch(base=-900.0)), visible=True),
        Case("both inputs require gradient", _ranged(_batch()), differentiate=_PAIR, visible=True),
        Case("single precision", _ranged(_batch()), dtype=torch.float32, visible=True),
        *_shape_cases(_PAIR, _ranged(_batch())),
        _negative_range(_ranged(_batch())),
    ),
    misconceptions=(
        Misconception(
            "abs-missing",
            _share(lambda r, e: r - 1 > e),
            "Only ratios above 1 + ε are counted: those below 1 - ε are outside, too.",
        ),
        Misconception(
            "only-below",
            _share(lambda r, e: 1 - r > e),
            "Only ratios below 1 - ε are counted: those above 1 + ε are outside, too.",
        ),
        Misconception("range-on-log-ratio", _share(lambda r, e: r.log().abs() > e), _LOG_RANGE),
        Misconception(
            "share-inside", _share(lambda r, e: (r - 1).abs() < e), "This is the share that stays inside the interval."
        ),
        Misconception(
            "one-not-subtracted",
            _share(lambda r, e: r.abs() > e),
            "The interval lies around 1: how far is the ratio from 1, not from 0?",
        ),
        Misconception(
            "lower-bound-is-inverse",
            _share(lambda r, e: (r > 1 + e) | (r < 1 / (1 + e))),
            _LOWER,
        ),
        Misconception("ratio-inverted", _share(lambda r, e: (r - 1).abs() > e, _inverted), _INVERTED),
        Misconception("probabilities-divided", _share(lambda r, e: (r - 1).abs() > e, _quotient), _QUOTIENT),
        Misconception(
            "count-instead-of-share",
            _metric(lambda r, e: ((r - 1).abs() > e).to(r.dtype).sum()),
            "This counts: divide by the batch size.",
        ),
        Misconception(
            "mean-distance",
            _share(lambda r, e: ((r - 1).abs() - e).clamp(min=0)),
            "This averages how far ratios are outside: count them instead.",
        ),
        Misconception("clip-range-ignored", _share(lambda r, e: (r - 1).abs() > 0.2), _RANGE),
        Misconception(
            "zero-range-means-off",
            _share(lambda r, e: (r - 1).abs() > (e or INF)),
            _ZERO,
        ),
        Misconception("graph-kept", _fraction_graph, _METRIC),
        *_spoilt(ch43.clip_fraction, _NUMBER),
        Misconception(
            "bad-input-accepted", _metric(lambda r, e: ((r - 1).abs() > e).to(r.dtype).mean(), checked=False), _VALIDATE
        ),
    ),
    variants={
        "what the clip changes": _metric_variant(lambda d, e: (d.exp() != d.exp().clamp(1 - e, 1 + e)).to(d.dtype).mean()),
        "NumPy": _metric_variant(_fraction_numpy),
        "bounds of the log-ratio": _metric_variant(_fraction_by_logarithms),
        "one number at a time": _metric_variant(
            lambda d, e: torch.tensor(sum(abs(math.exp(x) - 1) > e for x in d.tolist()) / len(d), dtype=d.dtype)
        ),
        "counted with torch.where": _metric_variant(
            lambda d, e: torch.where(d.expm1().abs() <= e, 0.0, torch.ones_like(d)).sum() / len(d)
        ),
    },
)

# ------------------------------------------------------------------------------------------------------- repaired_losses


def _rollout(epochs=4, size=16, spread=0.35, base=-2.0, **scalars):
    """Log-probabilities that drift away from those of row 0."""

    def inputs(generator):
        drift = spread * _normal(generator, epochs, size).cumsum(0)
        drift = _off_bounds(drift - drift[0], **scalars)
        return {"log_probs": drift + base + _normal(generator, size), "advantages": _normal(generator, size) + 0.3} | scalars

    return inputs


def _standstill(generator):
    drawn = _rollout()(generator)
    return drawn | {"log_probs": drawn["log_probs"][:1].expand(3, -1).clone()}


def _losses_by_cases(log_probs, advantages, clip_range=0.2):
    return torch.stack([_clip_by_cases(current, log_probs[0], advantages, clip_range) for current in log_probs])


def _epochs(old=lambda log_probs, epoch: log_probs[0], loss=ch43.clipped_surrogate_loss):
    """A version of the program: `old` gives an epoch's old log-probabilities, `loss` its loss."""

    def version(log_probs, advantages, clip_range=0.2):
        losses = [loss(current, old(log_probs, epoch), advantages, clip_range) for epoch, current in enumerate(log_probs)]
        return torch.stack(losses)

    return version


def _repaired_variant(objective):
    """`objective` takes the log-ratios (K, B), the advantages and the clip range, and gives K losses."""

    def variant(log_probs, advantages, clip_range=0.2):
        _refuse(clip_range, advantages=advantages, log_probs=log_probs[0])
        return objective(log_probs - log_probs[0].detach(), advantages.detach(), clip_range)

    return variant


def _losses_in_a_buffer(d, a, e):
    losses = d.new_zeros(len(d))
    for epoch, log_ratio in enumerate(d):
        losses[epoch] = _clip_by_mask(log_ratio, a, e)
    return losses


_LEAKING_OLD = _loss(_clip, leaks=("old_log_probs",))
_BOTH = ("log_probs", "advantages")

REPAIRED_LOSSES = Exercise(
    name="repaired_losses",
    reference=ch43.repaired_losses,
    criteria={"values": 1.2, "gradient": 0.55, "dtype": 0.05, "inputs": 0.05, "errors": 0.15},
    axes=("epoch",),
    cases=(
        Case("four epochs, default clip_range", _rollout(), closed_form=_losses_by_cases, visible=True, draws=3),
        Case(
            "a policy that stands still",
            _standstill,
            closed_form=lambda log_probs, advantages: -advantages.mean().expand(3),
            visible=True,
        ),
        Case("a single epoch", _rollout(epochs=1), closed_form=_losses_by_cases),
        Case("ten epochs", _rollout(epochs=10), closed_form=_losses_by_cases),
        Case("clip_range = 0.05", _rollout(clip_range=0.05), closed_form=_losses_by_cases, visible=True),
        Case("clip_range = 0", _rollout(clip_range=0), closed_form=_losses_by_cases),
        Case("clip_range = 1.5", _rollout(spread=0.7, clip_range=1.5), closed_form=_losses_by_cases),
        Case("clip_range = infinity", _rollout(clip_range=INF), closed_form=_losses_by_cases),
        Case("very unlikely actions", _rollout(base=-900.0), closed_form=_losses_by_cases),
        Case("both inputs require gradient", _rollout(), differentiate=_BOTH, visible=True, draws=3),
        Case("gradient where the policy stands still", _standstill, differentiate=_BOTH),
        Case("single precision", _rollout(), dtype=torch.float32, visible=True),
        Case(
            "advantages as a column",
            _reshaped("advantages", lambda a: a[:, None], _rollout()),
            raises=_BOTH,
            visible=True,
            draws=1,
        ),
        Case("advantages of a single action", _reshaped("advantages", lambda a: a[:1], _rollout()), raises=_BOTH, draws=1),
        Case("advantages for every epoch", _reshaped("advantages", lambda a: a.repeat(4, 1), _rollout()), raises=_BOTH, draws=1),
        _negative_range(_rollout()),
    ),
    misconceptions=(
        Misconception(
            "old-from-current-epoch",
            _epochs(lambda log_probs, epoch: log_probs[epoch]),
            "This is the suspect program's own bug. What is the ratio in every epoch, and when can it reach a bound?",
        ),
        Misconception(
            "old-from-current-epoch-with-graph",
            _epochs(lambda log_probs, epoch: log_probs[epoch], _LEAKING_OLD),
            "The ratio is a policy over itself: it is 1 in every epoch, and without detach its two gradients cancel as well.",
        ),
        Misconception(
            "old-from-previous-epoch",
            _epochs(lambda log_probs, epoch: log_probs[max(epoch - 1, 0)]),
            "The old policy is the one that acted, in all epochs; here it follows an epoch behind, and steps add up.",
        ),
        Misconception(
            "old-from-last-epoch",
            _epochs(lambda log_probs, epoch: log_probs[-1]),
            "The rollout was collected before the first epoch: row 0, not -1.",
        ),
        Misconception(
            "gradient-into-old-log-probs",
            _epochs(loss=_LEAKING_OLD),
            "Row 0 receives gradient from later epochs too: as old log-probabilities it is data, so detach it.",
        ),
        Misconception(
            "gradient-into-advantages",
            _epochs(loss=_loss(_clip, leaks=("advantages",))),
            _CRITIC,
        ),
        Misconception(
            "nothing-detached",
            _epochs(loss=_loss(_clip, leaks=("old_log_probs", "advantages"))),
            "Gradient reaches row 0 as old log-probabilities, and the advantages: both are data of the rollout, detach them.",
        ),
        Misconception(
            "losses-cut-from-graph",
            _after(ch43.repaired_losses, torch.Tensor.detach),
            "The losses carry no graph: torch.tensor([…]) and .item() make plain numbers. Use torch.stack.",
        ),
        Misconception("not-clipped", _epochs(loss=_loss(_plain)), "The ratio is right again, but nothing is clipped."),
        Misconception("sign-missing", _after(ch43.repaired_losses, torch.neg), _SIGN),
        Misconception(
            "averaged-over-epochs", _after(ch43.repaired_losses, torch.mean), "One loss for each epoch is asked for, shape (K,)."
        ),
        Misconception(
            "sum-instead-of-mean",
            _epochs(loss=_loss(lambda r, a, e: _clip(r, a, e) * len(a))),
            _SUM,
        ),
        Misconception("clip-range-ignored", _epochs(loss=_loss(lambda r, a, e: _clip(r, a, 0.2))), _RANGE),
        Misconception("dtype-lost", _after(ch43.repaired_losses, torch.Tensor.float), _DTYPE),
        Misconception("bad-input-accepted", _epochs(loss=_loss(_clip, checked=False)), _VALIDATE),
    ),
    variants={
        "all epochs at once": _repaired_variant(
            lambda d, a, e: -torch.min(d.exp() * a, d.exp().clamp(1 - e, 1 + e) * a).mean(dim=1)
        ),
        "one number at a time": _repaired_variant(lambda d, a, e: torch.stack([_clip_in_python(row, a, e) for row in d])),
        "its own buffer": _repaired_variant(_losses_in_a_buffer),
        "excess past the bound, in double precision": _repaired_variant(
            lambda d, a, e: torch.stack([_clip_by_excess(row.double(), a.double(), e) for row in d]).to(d.dtype)
        ),
    },
)

EXERCISES = (IMPORTANCE_RATIO, SURROGATE_LOSS, CLIPPED_SURROGATE_LOSS, APPROX_KL, CLIP_FRACTION, REPAIRED_LOSSES)
