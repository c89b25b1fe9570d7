"""Checks of chapter 43: cases, named misconceptions and correct variants for PPO's clip and the numbers that watch over it."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import torch

from autograder.authoring import wild
from autograder.authoring.parts import (
    IN_PLACE,
    METRIC,
    NUMBER,
    after,
    bad_input_accepted,
    drawing,
    dtype_lost,
    in_place,
    normal,
    one_shape,
    python_float,
    refused,
    reshaped,
    satisfies,
    uniform,
    versions_of,
    without,
    wrong,
)
from autograder.authoring.spec import Case, Exercise
from solutions import ch43

INF = math.inf
PAIR = ("log_probs", "old_log_probs")
TRIPLE = (*PAIR, "advantages")

# ---------------------------------------------------------------------------------------------------------------- inputs


def off_bounds(log_ratio, clip_range=0.2):
    """The same log-ratios, moved where the ratio is within 0.01 of a bound: there neither gradient nor count is graded."""
    near = ((log_ratio.expm1().abs() - clip_range).abs() < 0.01) & (log_ratio != 0)
    return torch.where(near, log_ratio + 0.03, log_ratio)


def _arguments(generator, log_ratio, advantages, base=-2.0, **scalars):
    old_log_probs = base + normal(generator, len(log_ratio))
    return {"log_probs": old_log_probs + log_ratio, "old_log_probs": old_log_probs, "advantages": advantages} | scalars


@drawing
def _batch(generator, size=33, spread=0.4, base=-2.0, **scalars):
    """Log-ratios of a policy that has moved by `spread`; `base` is the actions' typical log-probability."""
    log_ratio = off_bounds(spread * normal(generator, size), **scalars)
    return _arguments(generator, log_ratio, normal(generator, size) + 0.3, base, **scalars)


@drawing
def _quadrants(generator, distance, **scalars):
    """Ratios well outside on either side, for either sign of the advantage."""
    side = torch.tensor([1.0, 1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
    sign = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0], dtype=torch.float64)
    log_ratio = side * distance * (1 + 0.2 * uniform(generator, 5))
    return _arguments(generator, log_ratio, sign * (0.2 + normal(generator, 5).abs()), **scalars)


@drawing
def _one_action(generator, side, sign):
    """One of those quadrants alone, so that nothing else hides it."""
    return _arguments(generator, torch.full((1,), side, dtype=torch.float64), sign * (0.2 + normal(generator, 1).abs()))


@drawing
def _constant(generator, log_ratio, **scalars):
    """Every action's probability has changed by the same factor."""
    return _arguments(generator, torch.full((7,), log_ratio, dtype=torch.float64), normal(generator, 7) + 0.3, **scalars)


def _zero_advantage(generator):
    drawn = _batch(clip_range=INF)(generator)
    drawn["advantages"][3] = 0.0
    return drawn


def _close_calls(generator):
    """Ratios for which bounds that are nearly right (exp(±0.2), 1 / 1.2) count other samples as outside than the right ones."""
    ratios = torch.tensor([1.21, 1.21, 1.21, 0.81, 0.825, 1.0, 1.1], dtype=torch.float64)
    ratios = ratios + 0.004 * (uniform(generator, 7) - 0.5)
    return _arguments(generator, ratios.log(), normal(generator, 7))


def _bare(inputs):
    return without(inputs, "advantages", "clip_range")


def _shape_cases(inputs, names):
    """Bad shapes: a column broadcasts silently to all pairs, a batch that is too short fails later and elsewhere."""
    columns = {f"{name} as a column": reshaped(inputs, name, lambda x: x[:, None]) for name in names}
    short = {f"{names[-1]} with an entry too few": reshaped(inputs, names[-1], lambda x: x[:-1])}
    shown = f"{names[-1]} as a column"
    return tuple(Case(name, bad, raises=names, visible=name == shown, draws=1) for name, bad in (columns | short).items())


# ------------------------------------------------------------------------------------------------ versions of the exercises

_NOT_NEGATIVE = satisfies(lambda clip_range: clip_range >= 0)


def _ratio(new, old):
    return (new - old).exp()


def _inverted(new, old):
    return (old - new).exp()


def _quotient(new, old):
    return new.exp() / old.exp()


def _difference(new, old):
    return new - old


def _by_ratio(version):
    """Versions whose formula takes the ratio, or what another function makes of the log-probabilities, in place of these."""

    def family(formula, ratio=_ratio, **options):
        return version(lambda new, old, *rest: formula(ratio(new, old), *rest), **options)

    return family


def _losses(reference, *checks, data=("old_log_probs", "advantages")):
    """Versions of a loss: an objective takes the ratio, the advantages and, where there is one, the clip range."""
    return _by_ratio(versions_of(reference, one_shape(*TRIPLE), *checks, data=data))


def _metrics(reference, *checks):
    """Versions of a metric: a formula takes the ratio and, where there is one, the clip range."""
    return _by_ratio(versions_of(reference, one_shape(*PAIR), *checks, data=PAIR))


def _in_double(objective):
    return lambda d, *rest: objective(d.double(), *rest).to(d.dtype)


# ---------------------------------------------------------------------------------------------- wrong answers, in general

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


def normalised(a):
    return (a - a.mean()) / (a.std() + 1e-8)


def _wrong_losses(objective, reference, *checks):
    """What goes wrong alike with and without the clip."""
    loss = _losses(reference, *checks)
    old_leaks, advantages_leak = (_losses(reference, *checks, data=[kept]) for kept in ("advantages", "old_log_probs"))
    return {
        "sign-missing": (loss(lambda *given: -objective(*given)), _SIGN),
        "sum-instead-of-mean": (loss(lambda r, a, *e: objective(r, a, *e) * len(a)), _SUM),
        "ratio-inverted": (loss(objective, _inverted), _INVERTED),
        "exponential-missing": (loss(objective, _difference), _NO_EXP),
        "probabilities-divided": (loss(objective, _quotient), _QUOTIENT),
        "advantages-sign-lost": (
            loss(lambda r, a, *e: objective(r, a.abs(), *e)),
            "Every action is made likelier, bad ones too: use the advantage with its sign.",
        ),
        "advantages-normalised-inside": (
            loss(lambda r, a, *e: objective(r, normalised(a), *e)),
            "The loss takes the advantages as they come; whoever calls it decides on normalising.",
        ),
        "ratio-detached": (loss(objective, lambda new, old: _ratio(new, old).detach()), _DETACHED),
        "gradient-into-old-log-probs": (
            old_leaks(objective),
            "The old log-probabilities are data of the rollout: detach them. On the same network, both gradients cancel.",
        ),
        "gradient-into-advantages": (advantages_leak(objective), _CRITIC),
        "nothing-detached": (
            loss(objective, leak=True),
            "Gradient reaches the old log-probabilities and the advantages: both are data of the rollout, detach them.",
        ),
    }


# ------------------------------------------------------------------------------------------------------ importance_ratio

_ratios = versions_of(ch43.importance_ratio, one_shape(*PAIR))

_WRONG_RATIOS = {
    "ratio-inverted": (_inverted, _INVERTED),
    "exponential-missing": (_difference, _NO_EXP),
    "probabilities-divided": (_quotient, _QUOTIENT),
    "log-probs-divided": (
        lambda new, old: new / old,
        "A quotient of logarithms is no ratio of probabilities: subtract, then exp.",
    ),
    "log-probs-added": (lambda new, old: (new + old).exp(), "This multiplies the probabilities: subtract the logarithms."),
    "minus-one": (lambda new, old: (new - old).expm1(), "This is ratio - 1: where nothing has changed the ratio itself is 1."),
    "clipped-already": (
        lambda new, old: _ratio(new, old).clamp(0.8, 1.2),
        "The ratio itself is not clipped: the loss needs it both as it is and clipped.",
    ),
    "averaged": (lambda new, old: _ratio(new, old).mean(), "One ratio for each action, shape (B,): do not average here."),
    "ratio-detached": (lambda new, old: _ratio(new, old).detach(), _DETACHED),
}

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
        *_shape_cases(_bare(_batch()), PAIR),
    ),
    misconceptions=(
        *wrong(_WRONG_RATIOS, _ratios),
        dtype_lost(ch43.importance_ratio),
        in_place(ch43.importance_ratio, "log_probs"),
        bad_input_accepted(_ratios(_ratio, checked=False)),
    ),
    variants={
        "its own buffer": _ratios(lambda new, old: (new - old.detach()).exp_()),
        "reciprocal of the inverse, gradient on both sides": _ratios(lambda new, old: (old - new).exp().reciprocal()),
        "one number at a time": _ratios(
            lambda new, old: torch.stack([torch.exp(n - o.item()) for n, o in zip(new, old, strict=True)])
        ),
        "a power of e in double precision": _ratios(lambda new, old: (math.e ** (new.double() - old.double())).to(new.dtype)),
        "detached ratio with its gradient put back": _ratios(
            lambda new, old: _ratio(new, old).detach() * (1 + new - new.detach())
        ),
    },
)

# -------------------------------------------------------------------------------------------------------- surrogate_loss

_plain_loss = _losses(ch43.surrogate_loss)


def _unclipped(inputs):
    return without(inputs, "clip_range")


def plain(r, a, _e=None):
    return -(r * a).mean()


def clip(r, a, e=0.2):
    return -torch.minimum(r * a, r.clamp(1 - e, 1 + e) * a).mean()


def _minus_mean_advantage(log_probs, old_log_probs, advantages, clip_range=0.2):
    return -advantages.mean()


def clip_by_cases(log_probs, old_log_probs, advantages, clip_range=0.2):
    """Without min: a good action's ratio counts up to the upper bound, a bad one's down to the lower bound."""
    total = 0.0
    for new, old, advantage in zip(*(x.tolist() for x in (log_probs, old_log_probs, advantages)), strict=True):
        ratio = math.exp(new - old)
        total += advantage * (min(ratio, 1 + clip_range) if advantage > 0 else max(ratio, 1 - clip_range))
    return torch.tensor(-total / len(advantages), dtype=torch.float64)


_plain_by_cases = partial(clip_by_cases, clip_range=INF)

_WRONG_SURROGATE_LOSSES = _wrong_losses(plain, ch43.surrogate_loss) | {
    "log-probability-instead-of-ratio": (
        _plain_loss(plain, lambda new, old: new),
        "This is REINFORCE's loss: it has the right gradient only before the first step. Use the ratio.",
    ),
    "probability-instead-of-ratio": (
        _plain_loss(plain, lambda new, old: new.exp()),
        "The actions came from the old policy: divide by its probability.",
    ),
    "clipped-already": (_plain_loss(clip), "There is no clip in this loss yet: it is what the next exercise adds."),
    "means-multiplied": (
        _plain_loss(lambda r, a: -r.mean() * a.mean()),
        "The product of the means forgets which action had which advantage: multiply first, then average.",
    ),
    "ratios-normalised": (
        _plain_loss(lambda r, a: -(r / r.sum() * a).sum()),
        "The ratios are divided by their sum: PPO's objective is the plain mean of ρ A.",
    ),
    "input-changed": (_plain_loss(lambda r, a: (r * a.neg_()).mean()), IN_PLACE),
}

SURROGATE_LOSS = Exercise(
    name="surrogate_loss",
    reference=ch43.surrogate_loss,
    criteria={"values": 0.8, "gradient": 0.45, "dtype": 0.05, "inputs": 0.05, "errors": 0.15},
    cases=(
        Case("a batch", _unclipped(_batch()), closed_form=_plain_by_cases, visible=True, draws=3),
        Case(
            "identical policies: minus the mean advantage",
            _unclipped(_constant(0.0)),
            closed_form=_minus_mean_advantage,
            visible=True,
        ),
        Case("ratios far from 1", _unclipped(_quadrants(1.5)), closed_form=_plain_by_cases, visible=True),
        Case("very unlikely actions", _unclipped(_batch(base=-900.0)), closed_form=_plain_by_cases, visible=True),
        Case("log-ratios around ±20", _unclipped(_quadrants(20.0)), closed_form=_plain_by_cases),
        Case("all inputs require gradient", _unclipped(_batch()), differentiate=TRIPLE, visible=True),
        Case("gradient where the policies are identical", _unclipped(_constant(0.0)), differentiate=TRIPLE),
        Case("single precision", _unclipped(_batch()), dtype=torch.float32, visible=True),
        *_shape_cases(_unclipped(_batch()), TRIPLE),
    ),
    misconceptions=(
        *wrong(_WRONG_SURROGATE_LOSSES),
        python_float(ch43.surrogate_loss),
        dtype_lost(ch43.surrogate_loss),
        bad_input_accepted(_plain_loss(plain, checked=False)),
    ),
    variants={
        "dot product": _plain_loss(lambda r, a: -(r @ a) / len(a)),
        "one number at a time": _plain_loss(
            lambda d, a: -sum(math.e**x * y.item() for x, y in zip(d, a, strict=True)) / len(a), _difference
        ),
        "double precision inside": _plain_loss(_in_double(lambda d, a: (-a.double() * d.exp()).mean()), _difference),
        "score function with detached ratio": _plain_loss(
            lambda d, a: (d.exp().detach() * -a * (1 + d - d.detach())).mean(), _difference
        ),
        "its own buffer": _plain_loss(lambda r, a: (r * a).neg_().mean()),
    },
)

# ------------------------------------------------------------------------------------------------- clipped_surrogate_loss

_clipped_loss = _losses(ch43.clipped_surrogate_loss, _NOT_NEGATIVE)


def _clipped_to(bounds):
    """min with a ratio clipped to other bounds."""
    return _clipped_loss(lambda r, a, e: -torch.minimum(r * a, r.clamp(*bounds(e)) * a).mean())


def _dual_clip(r, a, e):
    once = torch.minimum(r * a, r.clamp(1 - e, 1 + e) * a)
    return -torch.where(a < 0, once.maximum(3 * a), once).mean()


def _limits(r, a, e):
    """OpenAI Spinning Up's way to write it, which for A = 0 and an infinite range is 0 times infinity."""
    return -torch.minimum(r * a, torch.where(a > 0, (1 + e) * a, (1 - e) * a)).mean()


def _cut_outside(r, a, e):
    """The right value, but no gradient wherever the ratio is outside."""
    return clip(torch.where((r - 1).abs() > e, r.detach(), r), a, e)


def _straight_through(r, a, e):
    clipped = r + (r.clamp(1 - e, 1 + e) - r).detach()
    return -torch.minimum(r * a, clipped * a).mean()


def _clip_in_python(ratios, advantages, e):
    objectives = []
    for ratio, advantage in zip(ratios, advantages.tolist(), strict=True):
        bound = min(max(ratio.item(), 1 - e), 1 + e)
        objectives.append(ratio * advantage if ratio.item() * advantage <= bound * advantage else 0 * ratio + bound * advantage)
    return -sum(objectives) / len(objectives)


def clip_by_mask(r, a, e):
    """Where the clip holds, the ratio is a constant."""
    saturated = ((a > 0) & (r > 1 + e)) | ((a < 0) & (r < 1 - e))
    return (torch.where(saturated, r.detach().clamp(1 - e, 1 + e), r) * -a).mean()


def clip_by_excess(r, a, e):
    """ρ A minus what lies past the bound in the direction of the advantage."""
    excess = torch.where(a > 0, (r - 1 - e).relu(), (1 - e - r).relu())
    return (a.abs() * excess - a * r).mean()


_WRONG_CLIPPED_LOSSES = _wrong_losses(clip, ch43.clipped_surrogate_loss, _NOT_NEGATIVE) | {
    "max-instead-of-min": (
        _clipped_loss(lambda r, a, e: -torch.maximum(r * a, r.clamp(1 - e, 1 + e) * a).mean()),
        "Take the smaller of the two terms (the larger only once both are negated): max caps just the wrong side.",
    ),
    "clip-without-min": (
        _clipped_loss(lambda r, a, e: -(r.clamp(1 - e, 1 + e) * a).mean()),
        "A sample that has moved the wrong way is stuck outside: take the minimum with the unclipped term.",
    ),
    "not-clipped": (_clipped_loss(plain), "Nothing is clipped: good actions gain without limit."),
    "range-on-log-ratio": (_clipped_to(lambda e: (math.exp(-e), math.exp(e))), _LOG_RANGE),
    "no-lower-bound": (_clipped_to(lambda e: (-INF, 1 + e)), "Bad actions have no limit: clip at 1 - ε as well."),
    "no-upper-bound": (_clipped_to(lambda e: (1 - e, INF)), "Good actions have no limit: clip at 1 + ε as well."),
    "lower-bound-is-inverse": (_clipped_to(lambda e: (1 / (1 + e), 1 + e)), _LOWER),
    "bounds-around-zero": (
        _clipped_to(lambda e: (-e, e)),
        "An unchanged policy has ratio 1: the interval lies around 1, not around 0.",
    ),
    "product-clipped": (
        _clipped_loss(lambda r, a, e: -torch.minimum(r * a, (r * a).clamp(1 - e, 1 + e)).mean()),
        "The ratio is clipped, then multiplied by the advantage; here the product is clipped.",
    ),
    "dual-clip": (
        _clipped_loss(_dual_clip),
        "This is the dual clip, with a floor for bad actions: PPO's own pulls on them, however likely they have become.",
    ),
    "minimum-of-means": (
        _clipped_loss(lambda r, a, e: -torch.minimum((r * a).mean(), (r.clamp(1 - e, 1 + e) * a).mean())),
        "Take the minimum sample by sample, then the mean: otherwise all samples are clipped, or none.",
    ),
    "minimum-of-ratios": (
        _clipped_loss(lambda r, a, e: -(torch.minimum(r, r.clamp(1 - e, 1 + e)) * a).mean()),
        "The minimum is that of the two products, not of the ratios: times a negative advantage the larger ratio is the smaller.",
    ),
    "clip-range-ignored": (_clipped_loss(lambda r, a, e: clip(r, a, 0.2)), _RANGE),
    "zero-range-means-off": (_clipped_loss(lambda r, a, e: clip(r, a, e or INF)), _ZERO),
    "infinity-times-zero": (
        _clipped_loss(_limits),
        "An infinite range times an advantage of 0 is NaN: clip the ratio before you multiply.",
    ),
    "gradient-cut-on-both-sides": (
        _clipped_loss(_cut_outside),
        "A sample outside on the wrong side of its advantage has lost its gradient: it is the one that must come back.",
    ),
    "straight-through-clip": (
        _clipped_loss(_straight_through),
        "Past the bound the gradient still flows: that it vanishes there is the point of the clip.",
    ),
    "clipped-term-detached": (
        _clipped_loss(lambda r, a, e: -torch.minimum(r * a, r.detach().clamp(1 - e, 1 + e) * a).mean()),
        "Inside, both terms are equal and min splits the gradient between them: with one detached, half is lost.",
    ),
    "input-changed": (_clipped_loss(lambda r, a, e: torch.maximum(r * a.neg_(), r.clamp(1 - e, 1 + e) * a).mean()), IN_PLACE),
}

CLIPPED_SURROGATE_LOSS = Exercise(
    name="clipped_surrogate_loss",
    reference=ch43.clipped_surrogate_loss,
    criteria={"values": 1.6, "gradient": 1.0, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    cases=(
        Case("a batch, default clip_range", _batch(), closed_form=clip_by_cases, visible=True, draws=3),
        Case(
            "identical policies: minus the mean advantage",
            _constant(0.0),
            closed_form=_minus_mean_advantage,
            visible=True,
            draws=1,
        ),
        *(
            Case(f"{how} action, ratio {where}", _one_action(side, sign), closed_form=clip_by_cases, visible=True, draws=1)
            for how, sign in (("a good", 1), ("a bad", -1))
            for where, side in (("above", 0.7), ("below", -0.7))
        ),
        Case("clip_range = 0.05", _batch(clip_range=0.05), closed_form=clip_by_cases, visible=True, draws=1),
        Case("clip_range = 0", _batch(clip_range=0), closed_form=clip_by_cases, visible=True, draws=1),
        Case("clip_range = 1.5", _batch(spread=1.0, clip_range=1.5), closed_form=clip_by_cases, draws=1),
        Case("clip_range = infinity, one advantage is 0", _zero_advantage, closed_form=clip_by_cases, visible=True, draws=1),
        Case("very unlikely actions", _batch(base=-900.0), closed_form=clip_by_cases, visible=True, draws=1),
        Case("log-ratios around ±20", _quadrants(20.0), closed_form=clip_by_cases, draws=1),
        Case("all inputs require gradient", _batch(), differentiate=TRIPLE, visible=True),
        Case("gradient where the policies are identical", _constant(0.0), differentiate=TRIPLE, visible=True, draws=1),
        Case("gradient well outside", _quadrants(1.0), differentiate=TRIPLE, visible=True, draws=1),
        Case("gradient with clip_range = 0", _batch(clip_range=0), differentiate=TRIPLE, draws=1),
        Case("gradient with clip_range = infinity", _batch(clip_range=INF), differentiate=TRIPLE, draws=1),
        Case("single precision", _batch(), dtype=torch.float32, visible=True, draws=1),
        *_shape_cases(_batch(), TRIPLE),
        refused(_batch(), clip_range=-0.1, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_CLIPPED_LOSSES),
        python_float(ch43.clipped_surrogate_loss),
        dtype_lost(ch43.clipped_surrogate_loss),
        bad_input_accepted(_clipped_loss(clip, checked=False)),
    ),
    variants={
        "maximum of the negated terms": _clipped_loss(
            lambda r, a, e: torch.max(-a * r, -a * torch.clamp(r, 1 - e, 1 + e)).mean()
        ),
        "one number at a time": _clipped_loss(_clip_in_python),
        "mask of the saturated samples": _clipped_loss(clip_by_mask),
        "excess past the bound": _clipped_loss(clip_by_excess),
        "one-sided limits by sign": _clipped_loss(
            lambda r, a, e: -torch.where(a > 0, a * r.clamp(max=1 + e), a * r.clamp(min=1 - e)).mean()
        ),
        "amin over a stack, in double precision": _clipped_loss(
            _in_double(
                lambda d, a, e: -torch.stack([d.exp() * a.double(), d.exp().clip(1 - e, 1 + e) * a.double()]).amin(0).mean()
            ),
            _difference,
        ),
    },
)

# ------------------------------------------------------------------------------------------------------------- approx_kl

_kl = _metrics(ch43.approx_kl)


def _mean_of(formula, **options):
    """An estimator: `formula` takes the ratio and its logarithm, sample by sample."""
    return _kl(lambda d: formula(d.exp(), d).mean(), _difference, **options)


def _k3(r, d):
    return r - 1 - d


def _zero(log_probs, old_log_probs, clip_range=0.2):
    return torch.zeros((), dtype=log_probs.dtype)


def _kl_numpy(d):
    values = d.double().numpy()
    return torch.tensor(np.mean(np.expm1(values) - values), dtype=d.dtype)


_WRONG_ESTIMATORS = {
    "log-ratio-estimator": (
        lambda r, d: -d,
        "mean(-log ρ) is the estimator k1: unbiased too, but noisy, and negative for many batches. Add ρ - 1."
        + wild.also("k1", "approx_kl", "token_approx_kl"),
    ),
    "squared-log-ratio-estimator": (
        lambda r, d: d.square() / 2,
        "mean(½ (log ρ)²) is the estimator k2: small variance, but biased.",
    ),
    "reversed": (
        lambda r, d: 1 / r - 1 + d,
        "The policies are swapped: the actions came from the old one, so the ratio is new over old.",
    ),
    "mean-log-ratio": (lambda r, d: d, "The mean log-ratio has expectation minus KL: look at the sign, and add ρ - 1."),
    "one-not-subtracted": (lambda r, d: r - d, "Identical policies give 1 here and must give 0: subtract 1."),
    "log-ratio-added": (
        lambda r, d: r - 1 + d,
        "The sign of the log-ratio: ρ - 1 - log ρ is never negative, ρ - 1 + log ρ can be.",
    ),
    "log-ratio-missing": (lambda r, d: r - 1, "mean(ρ - 1) has expectation 0 whatever the policies: subtract log ρ."),
    "weighted-by-ratio": (
        lambda r, d: r * d - (r - 1),
        "This estimates the other direction, KL(new ‖ old): the log-ratio is not multiplied by the ratio here.",
    ),
}

_WRONG_KL = {
    "sum-instead-of-mean": (_kl(lambda d: (d.expm1() - d).sum(), _difference), _SUM),
    "per-sample": (
        _kl(lambda d: d.expm1() - d, _difference),
        "One number for the batch is asked for: take the mean over samples.",
    ),
    "probabilities-divided": (_kl(lambda r: (r - 1 - r.log()).mean(), _quotient), _QUOTIENT),
    "graph-kept": (_mean_of(_k3, leak=True), METRIC),
}

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
        Case("both inputs require gradient", _bare(_batch()), differentiate=PAIR, visible=True),
        Case("single precision", _bare(_batch()), dtype=torch.float32, visible=True),
        *_shape_cases(_bare(_batch()), PAIR),
    ),
    misconceptions=(
        *wrong(_WRONG_ESTIMATORS, _mean_of),
        *wrong(_WRONG_KL),
        python_float(ch43.approx_kl, NUMBER),
        dtype_lost(ch43.approx_kl),
        bad_input_accepted(_mean_of(_k3, checked=False)),
        in_place(ch43.approx_kl, "log_probs"),
    ),
    variants={
        "as the formula says": _kl(lambda d: ((d.exp() - 1) - d).mean(), _difference),
        "NumPy": _kl(_kl_numpy, _difference),
        "means of the parts, in double precision": _kl(_in_double(lambda d: d.exp().mean() - 1 - d.mean()), _difference),
        "one number at a time": _kl(
            lambda d: torch.tensor(sum(math.exp(x) - 1 - x for x in d.tolist()) / len(d), dtype=d.dtype), _difference
        ),
    },
)

# --------------------------------------------------------------------------------------------------------- clip_fraction

_fraction = _metrics(ch43.clip_fraction, _NOT_NEGATIVE)


def _ranged(inputs):
    return without(inputs, "advantages")


def _share(outside, ratio=_ratio, **options):
    """A fraction: `outside` takes ratio and clip range and gives what is averaged."""
    return _fraction(lambda r, e: outside(r, e).to(r.dtype).mean(), ratio, **options)


def _is_outside(r, e):
    return (r - 1).abs() > e


def _fraction_numpy(d, e):
    return torch.tensor(np.mean(np.abs(np.expm1(d.double().numpy())) > e), dtype=d.dtype)


def _fraction_by_logarithms(d, e):
    bounds = torch.tensor([-e, e], dtype=torch.float64).log1p()  # the lower one is NaN, and never passed, where ε > 1
    return ((d < bounds[0]) | (d > bounds[1])).to(d.dtype).mean()


_WRONG_SHARES = {
    "abs-missing": (lambda r, e: r - 1 > e, "Only ratios above 1 + ε are counted: those below 1 - ε are outside, too."),
    "only-below": (lambda r, e: 1 - r > e, "Only ratios below 1 - ε are counted: those above 1 + ε are outside, too."),
    "range-on-log-ratio": (lambda r, e: r.log().abs() > e, _LOG_RANGE),
    "share-inside": (lambda r, e: (r - 1).abs() < e, "This is the share that stays inside the interval."),
    "one-not-subtracted": (lambda r, e: r.abs() > e, "The interval lies around 1: how far is the ratio from 1, not from 0?"),
    "lower-bound-is-inverse": (lambda r, e: (r > 1 + e) | (r < 1 / (1 + e)), _LOWER),
    "mean-distance": (
        lambda r, e: ((r - 1).abs() - e).clamp(min=0),
        "This averages how far ratios are outside: count them instead.",
    ),
    "clip-range-ignored": (lambda r, e: (r - 1).abs() > 0.2, _RANGE),
    "zero-range-means-off": (lambda r, e: (r - 1).abs() > (e or INF), _ZERO),
}

_WRONG_FRACTIONS = {
    "ratio-inverted": (_share(_is_outside, _inverted), _INVERTED),
    "probabilities-divided": (_share(_is_outside, _quotient), _QUOTIENT),
    "count-instead-of-share": (
        _fraction(lambda r, e: _is_outside(r, e).to(r.dtype).sum()),
        "This counts: divide by the batch size.",
    ),
    # a count by sign() and relu() hangs on the graph, with gradient zero
    "graph-kept": (_share(lambda r, e: ((r - 1).abs() - e).relu().sign(), leak=True), METRIC),
}

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
        Case("both inputs require gradient", _ranged(_batch()), differentiate=PAIR, visible=True),
        Case("single precision", _ranged(_batch()), dtype=torch.float32, visible=True),
        *_shape_cases(_ranged(_batch()), PAIR),
        refused(_ranged(_batch()), clip_range=-0.1, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_SHARES, _share),
        *wrong(_WRONG_FRACTIONS),
        python_float(ch43.clip_fraction, NUMBER),
        dtype_lost(ch43.clip_fraction),
        bad_input_accepted(_share(_is_outside, checked=False)),
    ),
    variants={
        "what the clip changes": _share(lambda r, e: r != r.clamp(1 - e, 1 + e)),
        "NumPy": _fraction(_fraction_numpy, _difference),
        "bounds of the log-ratio": _fraction(_fraction_by_logarithms, _difference),
        "one number at a time": _fraction(
            lambda d, e: torch.tensor(sum(abs(math.exp(x) - 1) > e for x in d.tolist()) / len(d), dtype=d.dtype), _difference
        ),
        "counted with torch.where": _fraction(
            lambda d, e: torch.where(d.expm1().abs() <= e, 0.0, torch.ones_like(d)).sum() / len(d), _difference
        ),
    },
)

# ------------------------------------------------------------------------------------------------------- repaired_losses


@drawing
def _rollout(generator, epochs=4, size=16, spread=0.35, base=-2.0, **scalars):
    """Log-probabilities that drift away from those of row 0."""
    drift = spread * normal(generator, epochs, size).cumsum(0)
    drift = off_bounds(drift - drift[0], **scalars)
    return {"log_probs": drift + base + normal(generator, size), "advantages": normal(generator, size) + 0.3} | scalars


def _standstill(generator):
    drawn = _rollout()(generator)
    return drawn | {"log_probs": drawn["log_probs"][:1].expand(3, -1).clone()}


def _losses_by_cases(log_probs, advantages, clip_range=0.2):
    return torch.stack([clip_by_cases(current, log_probs[0], advantages, clip_range) for current in log_probs])


def _epochs(old=lambda log_probs, epoch: log_probs[0], loss=ch43.clipped_surrogate_loss):
    """A version of the program: `old` gives an epoch's old log-probabilities, `loss` its loss."""

    def version(log_probs, advantages, clip_range=0.2):
        losses = [loss(current, old(log_probs, epoch), advantages, clip_range) for epoch, current in enumerate(log_probs)]
        return torch.stack(losses)

    return version


def _of_all_epochs(objective):
    """Another: `objective` takes the log-ratios (K, B), the advantages and the clip range, and gives K losses."""

    def version(log_probs, advantages, clip_range=0.2):
        _clipped_loss(clip)(log_probs[0], log_probs[0], advantages, clip_range)  # refuses what is to be refused
        return objective(log_probs - log_probs[0].detach(), advantages.detach(), clip_range)

    return version


def _losses_in_a_buffer(d, a, e):
    losses = d.new_zeros(len(d))
    for epoch, log_ratio in enumerate(d):
        losses[epoch] = clip_by_mask(log_ratio.exp(), a, e)
    return losses


_old_leaks = _losses(ch43.clipped_surrogate_loss, _NOT_NEGATIVE, data=["advantages"])
_advantages_leak = _losses(ch43.clipped_surrogate_loss, _NOT_NEGATIVE, data=["old_log_probs"])
_BOTH = ("log_probs", "advantages")

_WRONG_REPAIRS = {
    "old-from-current-epoch": (
        _epochs(lambda log_probs, epoch: log_probs[epoch]),
        "This is the suspect program's own bug. What is the ratio in every epoch, and when can it reach a bound?",
    ),
    "old-from-current-epoch-with-graph": (
        _epochs(lambda log_probs, epoch: log_probs[epoch], _old_leaks(clip)),
        "The ratio is a policy over itself: it is 1 in every epoch, and without detach its two gradients cancel as well.",
    ),
    "old-from-previous-epoch": (
        _epochs(lambda log_probs, epoch: log_probs[max(epoch - 1, 0)]),
        "The old policy is the one that acted, in all epochs; here it follows an epoch behind, and steps add up.",
    ),
    "old-from-last-epoch": (
        _epochs(lambda log_probs, epoch: log_probs[-1]),
        "The rollout was collected before the first epoch: row 0, not -1.",
    ),
    "losses-cut-from-graph": (
        after(ch43.repaired_losses, torch.Tensor.detach),
        "The losses carry no graph: torch.tensor([…]) and .item() make plain numbers. Use torch.stack.",
    ),
    "averaged-over-epochs": (after(ch43.repaired_losses, torch.mean), "One loss for each epoch is asked for, shape (K,)."),
    "sign-missing": (after(ch43.repaired_losses, torch.neg), _SIGN),
}

_WRONG_EPOCHS = {
    "gradient-into-old-log-probs": (
        _old_leaks(clip),
        "Row 0 receives gradient from later epochs too: as old log-probabilities it is data, so detach it.",
    ),
    "gradient-into-advantages": (_advantages_leak(clip), _CRITIC),
    "nothing-detached": (
        _clipped_loss(clip, leak=True),
        "Gradient reaches row 0 as old log-probabilities, and the advantages: both are data of the rollout, detach them.",
    ),
    "not-clipped": (_clipped_loss(plain), "The ratio is right again, but nothing is clipped."),
    "sum-instead-of-mean": (_clipped_loss(lambda r, a, e: clip(r, a, e) * len(a)), _SUM),
    "clip-range-ignored": (_clipped_loss(lambda r, a, e: clip(r, a, 0.2)), _RANGE),
}

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
            reshaped(_rollout(), "advantages", lambda a: a[:, None]),
            raises=_BOTH,
            visible=True,
            draws=1,
        ),
        Case("advantages of a single action", reshaped(_rollout(), "advantages", lambda a: a[:1]), raises=_BOTH, draws=1),
        Case("advantages for every epoch", reshaped(_rollout(), "advantages", lambda a: a.repeat(4, 1)), raises=_BOTH, draws=1),
        refused(_rollout(), clip_range=-0.1, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_REPAIRS),
        *wrong(_WRONG_EPOCHS, lambda loss: _epochs(loss=loss)),
        dtype_lost(ch43.repaired_losses),
        bad_input_accepted(_epochs(loss=_clipped_loss(clip, checked=False))),
    ),
    variants={
        "all epochs at once": _of_all_epochs(
            lambda d, a, e: -torch.min(d.exp() * a, d.exp().clamp(1 - e, 1 + e) * a).mean(dim=1)
        ),
        "one number at a time": _of_all_epochs(lambda d, a, e: torch.stack([_clip_in_python(row.exp(), a, e) for row in d])),
        "its own buffer": _of_all_epochs(_losses_in_a_buffer),
        "excess past the bound, in double precision": _of_all_epochs(
            lambda d, a, e: torch.stack([clip_by_excess(row.double().exp(), a.double(), e) for row in d]).to(d.dtype)
        ),
    },
)

EXERCISES = (IMPORTANCE_RATIO, SURROGATE_LOSS, CLIPPED_SURROGATE_LOSS, APPROX_KL, CLIP_FRACTION, REPAIRED_LOSSES)
