"""Checks of chapter 102: rules that libraries follow, to write and to tell from numbers, held against the atlas's own."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from autograder.authoring import recorded, wild
from autograder.authoring.parts import (
    METRIC,
    NUMBER,
    after,
    bad_input_accepted,
    drawing,
    drawn_once,
    dtype_lost,
    in_place,
    integers,
    normal,
    one_shape,
    python_float,
    refused,
    replaced,
    reshaped,
    satisfies,
    uniform,
    versions_of,
    without,
    wrong,
)
from autograder.authoring.spec import Case, Exercise, Misconception
from autograder.checks.ch43 import off_bounds
from solutions import ch44, ch102

INF = math.inf
TRIPLE = ("log_probs", "old_log_probs", "advantages")
FLOATS = ("rewards", "values", "next_values")
ROLLOUT = (*FLOATS, "terminated", "truncated")

# --------------------------------------------------------------------------------------------------------------- batches


def _arguments(generator, log_ratio, advantages, **scalars):
    old_log_probs = normal(generator, len(log_ratio)) - 2
    return {"log_probs": old_log_probs + log_ratio, "old_log_probs": old_log_probs, "advantages": advantages} | scalars


@drawing
def _batch(generator, size=33, spread=0.4, **scalars):
    """Log-ratios of a policy that has moved by `spread`."""
    log_ratio = off_bounds(spread * normal(generator, size), **scalars)
    return _arguments(generator, log_ratio, normal(generator, size) + 0.3, **scalars)


def _four_cases(generator):
    """Ratios well outside on either side, for either sign of the advantage."""
    side = torch.tensor([1.0, 1.0, -1.0, -1.0], dtype=torch.float64)
    sign = torch.tensor([1.0, -1.0, 1.0, -1.0], dtype=torch.float64)
    return _arguments(generator, side * (1 + 0.2 * uniform(generator, 4)), sign * (0.2 + normal(generator, 4).abs()))


def _no_gain(generator):
    """Outside on either side, and no advantage at all: nothing has a gradient to lose."""
    drawn = _four_cases(generator)
    return drawn | {"advantages": torch.zeros_like(drawn["advantages"])}


def _standstill(generator):
    return _arguments(generator, torch.zeros(7, dtype=torch.float64), normal(generator, 7) + 0.3)


def _one_advantage_is_zero(generator):
    drawn = _batch(clip_range=INF)(generator)
    drawn["advantages"][3] = 0.0
    return drawn


def _minibatch_of_the_atlas(_generator):
    """The minibatch that the libraries were given."""
    return {"log_probs": recorded.given("logp"), "old_log_probs": recorded.given("old_logp"), "advantages": recorded.given("adv")}


def _tokens_of_the_atlas(_generator):
    kept = recorded.given("mask")
    names = {"log_probs": "tok_logp", "old_log_probs": "tok_old", "advantages": "tok_adv"}
    return {name: recorded.given(part)[kept] for name, part in names.items()}


def _columns(inputs):
    """A column broadcasts silently to all pairs, a batch that is too short fails later and elsewhere."""
    columns = {f"{name} as a column": reshaped(inputs, name, lambda x: x[:, None]) for name in TRIPLE}
    short = {"advantages with an entry too few": reshaped(inputs, "advantages", lambda x: x[:-1])}
    bad = columns | short
    return tuple(Case(name, of, raises=TRIPLE, visible=name.startswith("advantages as"), draws=1) for name, of in bad.items())


def _by(rule, inputs):
    return lambda generator: {"rule": rule, **inputs(generator)}


# ------------------------------------------------------------------------------------------------------------- rollouts


def _rollout(generator, steps=8, envs=3, terminated_at=(), truncated_at=(), rate=0.0):
    """A rollout as a vectorised collector would hand it over: next_values continue values except where an episode ends."""
    values = normal(generator, steps, envs)
    terminated, truncated = (torch.rand(steps, envs, generator=generator) < rate for _ in range(2))
    for flags, places in ((terminated, terminated_at), (truncated, truncated_at)):
        for place in places:
            flags[place] = True
    following = torch.cat([values[1:], normal(generator, 1, envs)])
    next_values = torch.where(terminated | truncated, normal(generator, steps, envs), following)
    rewards = normal(generator, steps, envs)
    return {"rewards": rewards, "values": values, "next_values": next_values, "terminated": terminated, "truncated": truncated}


def _position(generator, steps, envs):
    """A step that is neither the first nor the last one, in any environment."""
    return int(integers(generator, 1, steps - 1)), int(integers(generator, 0, envs))


def _column_short(inputs, name, names, visible=False):
    short = reshaped(inputs, name, lambda x: x[:, :1])
    return Case(f"{name} with a column too few", short, raises=names, visible=visible, draws=1)


def _residual(r, v, v_next, alive, gamma):
    return r + gamma * v_next * alive - v


def _backward(deltas, carry):
    advantages: list[torch.Tensor] = []
    following = torch.zeros_like(deltas[0])
    for delta, factor in zip(deltas.flip(0), carry.flip(0), strict=True):
        following = delta + factor * following
        advantages.insert(0, following)
    return torch.stack(advantages)


# ------------------------------------------------------------------------------------------- what may be refused, and said

_NOT_NEGATIVE = satisfies(lambda clip_range: clip_range >= 0)
_GAMMA = satisfies(lambda gamma: 0 <= gamma <= 1)
_LAMBDA = satisfies(lambda gae_lambda: 0 <= gae_lambda <= 1)

_INVERTED = "The ratio is old over new: it is exp(log_probs - old_log_probs), new minus old."
_RANGE = "The range is 0.2 whatever the caller says: use clip_range."
_LOG_RANGE = "The range applies to the ratio, not to its logarithm: the bounds are 1 - ε and 1 + ε."
_DETACH = "The result still hangs on the critic's graph. Advantages are data for the losses: detach the result."
_CHANGED = "+= and -= change the caller's buffer of rewards, and whoever uses it next finds others."


def _ratio(new, old):
    return (new - old).exp()


def _inverted_ratio(new, old):
    return (old - new).exp()


def _is_outside(r, e):
    return (r - 1).abs() > e


def _is_silenced(r, a, e):
    """Where the clip takes the gradient away: improved, and past the bound."""
    return ((a > 0) & (r > 1 + e)) | ((a < 0) & (r < 1 - e))


# ------------------------------------------------------------------------------------------------------ clip_fraction_as

_SILENCED_BY = wild.also("silenced", "token_clip_fraction", what="“silenced” is")
_KNOWN_FRACTIONS = ("outside", "silenced")


def _counted(outside=_is_outside, silenced=_is_silenced, ratio=_ratio, known=_KNOWN_FRACTIONS, **options):
    """A version of both rules: `outside` takes the ratio and the clip range, `silenced` also the advantages, in between; what they give is
    averaged. `known` are the names that it takes; others are refused."""

    def fraction(rule, new, old, advantages, e):
        if rule not in known:
            raise ValueError(f"no such rule: {rule}")
        r = ratio(new, old)
        return (outside(r, e) if rule == "outside" else silenced(r, advantages, e)).to(new.dtype).mean()

    checks = (one_shape(*TRIPLE), _NOT_NEGATIVE)
    return versions_of(ch102.clip_fraction_as, *checks, data=TRIPLE)(fraction, **options)


class _Anything:
    """Contains whatever one asks for."""

    def __contains__(self, _name):
        return True


def _zero_for_outside(rule, log_probs, old_log_probs, advantages, clip_range=0.2):
    return torch.tensor(0.5 if rule == "silenced" else 1.0, dtype=torch.float64)


def _minimum_prefers_the_clip(r, a, e):
    return r.clamp(1 - e, 1 + e) * a < r * a


def _gradient_vanishes(rule, new, old, advantages, e):
    """Asks autograd, sample by sample, what the clip has left."""
    ratio = (new - old).exp()
    if rule == "outside":
        return torch.ne(ratio, ratio.clamp(1 - e, 1 + e)).to(new.dtype).mean()
    given = ratio.detach().requires_grad_()
    terms = torch.minimum(given * advantages, given.clamp(1 - e, 1 + e) * advantages)
    (gradient,) = torch.autograd.grad(terms.sum(), given)
    return ((gradient == 0) & (advantages != 0)).to(new.dtype).mean()


def _fractions_one_by_one(rule, new, old, advantages, e):
    count = 0
    for n, o, a in zip(new.tolist(), old.tolist(), advantages.tolist(), strict=True):
        excess = math.exp(n - o) - 1
        count += abs(excess) > e if rule == "outside" else (excess > e if a > 0 else a < 0 and -excess > e)
    return torch.tensor(count / len(new), dtype=new.dtype)


def _fractions_numpy(rule, new, old, advantages, e):
    moved = np.expm1((new - old).double().numpy())
    counted = np.abs(moved) > e if rule == "outside" else np.sign(advantages.numpy()) * moved > e
    return torch.tensor(counted.mean(), dtype=new.dtype)


def _knowing(formula):
    """The same with the names checked first."""
    known = satisfies(lambda rule: rule in _KNOWN_FRACTIONS)
    return versions_of(ch102.clip_fraction_as, known, one_shape(*TRIPLE), _NOT_NEGATIVE, data=TRIPLE)(formula)


_WRONG_FRACTION_RULES = {
    "outside-by-either-rule": (
        _counted(silenced=lambda r, a, e: _is_outside(r, e)),
        "Both rules count what is outside. “silenced” leaves out samples on the wrong side of their advantage, which still pull."
        + _SILENCED_BY,
    ),
    "silenced-by-either-rule": (
        lambda rule, *given, **named: _counted()("silenced" if rule == "outside" else rule, *given, **named),
        "Both rules count what the clip silences. “outside” asks for the ratio alone, whatever the advantage."
        + wild.also("", "clip_fraction", what="“outside” is"),
    ),
    "rules-swapped": (
        lambda rule, *given, **named: _counted()({"outside": "silenced", "silenced": "outside"}.get(rule, rule), *given, **named),
        "The rules are the wrong way round: “silenced” is the one that needs the advantages.",
    ),
    "those-that-still-pull": (
        _counted(silenced=lambda r, a, e: _is_silenced(r, -a, e)),
        "These samples are outside and still pull, back to the interval. Silent are good actions above it and bad ones below.",
    ),
    "good-actions-only": (
        _counted(silenced=lambda r, a, e: (a > 0) & (r > 1 + e)),
        "Only good actions are counted as silenced: bad ones below 1 - ε have lost their gradient, too.",
    ),
    "bad-actions-only": (
        _counted(silenced=lambda r, a, e: (a < 0) & (r < 1 - e)),
        "Only bad actions are counted as silenced: good ones above 1 + ε have lost their gradient, too.",
    ),
    "no-advantage-counts": (
        _counted(silenced=lambda r, a, e: ((a >= 0) & (r > 1 + e)) | ((a <= 0) & (r < 1 - e))),
        "An advantage of 0 gives no gradient that the clip could take away: compare with < and >.",
    ),
    "share-of-those-outside": (
        _counted(
            silenced=lambda r, a, e: _is_silenced(r, a, e).to(r.dtype) * len(r) / _is_outside(r, e).sum().clamp(min=1),
        ),
        "This is the share among those outside: divide by the whole batch.",
    ),
    "ratio-inverted": (_counted(ratio=_inverted_ratio), _INVERTED),
    "range-on-log-ratio": (
        _counted(lambda r, e: r.log().abs() > e, lambda r, a, e: a.sign() * r.log() > e),
        _LOG_RANGE,
    ),
    "clip-range-ignored": (_counted(lambda r, e: _is_outside(r, 0.2), lambda r, a, e: _is_silenced(r, a, 0.2)), _RANGE),
    "graph-kept": (
        _counted(
            lambda r, e: ((r - 1).abs() - e).relu().sign(), lambda r, a, e: (a.sign() * (r - 1) - e).relu().sign(), leak=True
        ),
        METRIC,
    ),
    "unknown-rule-accepted": (
        _counted(known=_Anything()),
        "A rule that is neither of the two is taken for one of them (an else?): refuse it, and say so by name.",
    ),
}

CLIP_FRACTION_AS = Exercise(
    name="clip_fraction_as",
    reference=ch102.clip_fraction_as,
    criteria={"values": 1.0, "gradient": 0.1, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    cases=(
        *(
            case
            for rule in _KNOWN_FRACTIONS
            for case in (
                Case(f"“{rule}”: a batch, default clip_range", _by(rule, _batch()), visible=True, draws=3),
                Case(f"“{rule}”: the four cases outside", _by(rule, _four_cases), closed_form=_zero_for_outside, visible=True),
                Case(f"“{rule}”: identical policies", _by(rule, _standstill), visible=True, draws=1),
                Case(f"“{rule}”: clip_range = 0.05", _by(rule, _batch(clip_range=0.05)), visible=True, draws=1),
                Case(f"“{rule}”: clip_range = 0", _by(rule, _batch(clip_range=0)), draws=1),
                Case(f"“{rule}”: clip_range = infinity, one advantage is 0", _by(rule, _one_advantage_is_zero), draws=1),
                Case(f"“{rule}”: clip_range = 1.5", _by(rule, _batch(spread=1.0, clip_range=1.5)), draws=1),
                Case(f"“{rule}”: no advantage at all", _by(rule, _no_gain), visible=True, draws=1),
                Case(f"“{rule}”: all inputs require gradient", _by(rule, _batch()), differentiate=TRIPLE, visible=True, draws=1),
                Case(f"“{rule}”: single precision", _by(rule, _batch()), dtype=torch.float32, visible=True, draws=1),
            )
        ),
        Case(
            "“outside”: what Stable-Baselines3 logged",
            _by("outside", _minibatch_of_the_atlas),
            closed_form=lambda **_given: recorded.numbers("stable-baselines3", "clip_fraction"),
            visible=True,
            draws=1,
        ),
        Case(
            "“silenced”: what verl logged",
            _by("silenced", _tokens_of_the_atlas),
            closed_form=lambda **_given: recorded.numbers("verl", "token_clip_fraction", "silenced"),
            visible=True,
            draws=1,
        ),
        *_columns(_by("silenced", _batch())),
        refused(_by("silenced", _batch()), rule="clipped", visible=True),
        refused(_by("outside", _batch()), clip_range=-0.1, visible=True),
        refused(_by("silenced", _batch()), clip_range=-0.1),
    ),
    misconceptions=(
        *wrong(_WRONG_FRACTION_RULES),
        python_float(ch102.clip_fraction_as, NUMBER),
        dtype_lost(ch102.clip_fraction_as),
        bad_input_accepted(_counted(known=_Anything(), checked=False)),
    ),
    variants={
        "where min takes the clipped term": _counted(lambda r, e: r != r.clamp(1 - e, 1 + e), _minimum_prefers_the_clip),
        "the sign of the advantage": _counted(silenced=lambda r, a, e: a.sign() * (r - 1) > e),
        "what autograd leaves": _knowing(_gradient_vanishes),
        "one number at a time": _knowing(_fractions_one_by_one),
        "NumPy": _knowing(_fractions_numpy),
    },
)

# ----------------------------------------------------------------------------------------------------- which_diagnostics


def _k1(r):
    return -r.log().mean()


def _computed(r, a, e):
    """The four numbers that may have been logged."""
    fractions = (_is_outside(r, e), _is_silenced(r, a, e))
    return [_k1(r), (r - 1 - r.log()).mean(), *(counted.to(r.dtype).mean() for counted in fractions)]


def _near(logged, computed):
    return (logged - computed).abs() <= 1e-5 * logged.abs().clamp(min=1)


def _told(fits=_near, computed=_computed, order=(0, 1, 2, 3), ratio=_ratio, **options):
    """A version of the reading: `computed` gives the four numbers, `fits` compares one with what was logged under its name."""

    def reading(kl, fraction, new, old, advantages, e):
        logged, numbers = (kl, kl, fraction, fraction), computed(ratio(new, old), advantages, e)
        return torch.stack([torch.as_tensor(fits(logged[k], numbers[k])) for k in order])

    return versions_of(ch102.which_diagnostics, one_shape(*TRIPLE), _NOT_NEGATIVE, data=TRIPLE)(reading, **options)


def _nearest(kl, fraction, new, old, advantages, e):
    k1, k3, outside, silenced = _computed(_ratio(new, old), advantages, e)
    first, third = (kl - k1).abs() < (kl - k3).abs(), (fraction - outside).abs() < (fraction - silenced).abs()
    return torch.stack([first, ~first, third, ~third])


@drawing
def _log(generator, kl=0, fraction=0, by=(0.0, 0.0), **settings):
    """A batch, and what a program logged of it: numbers 0 or 1 of either pair, each `by` so much off, rounded to single precision."""
    drawn = _batch(**settings)(generator)
    ratio = _ratio(drawn["log_probs"], drawn["old_log_probs"])
    numbers = _computed(ratio, drawn["advantages"], settings.get("clip_range", 0.2))
    logged = numbers[kl] + by[0], numbers[2 + fraction] + by[1]
    kl_seen, fraction_seen = (number.float().double() for number in logged)
    return {"logged_kl": kl_seen, "logged_fraction": fraction_seen, **drawn}


def _standstill_log(generator):
    nothing = torch.zeros((), dtype=torch.float64)
    return {"logged_kl": nothing, "logged_fraction": nothing, **_standstill(generator)}


@drawing
def _log_of_the_atlas(_generator, library, rules, inputs, names):
    kl, fraction = (recorded.numbers(library, name, rule) for name, rule in zip(names, rules, strict=True))
    return {"logged_kl": kl, "logged_fraction": fraction, **inputs(None)}


_SAMPLES, _TOKENS = ("approx_kl", "clip_fraction"), ("token_approx_kl", "token_clip_fraction")


def _fit(*which):
    """A closed form: these of the four."""
    return lambda **_given: torch.tensor([k in which for k in range(4)])


def _told_one_by_one(kl, fraction, new, old, advantages, e):
    logs = [n - o for n, o in zip(new.tolist(), old.tolist(), strict=True)]
    silent = [
        math.exp(d) > 1 + e if a > 0 else a < 0 and math.exp(d) < 1 - e for d, a in zip(logs, advantages.tolist(), strict=True)
    ]
    outside = [abs(math.exp(d) - 1) > e for d in logs]
    totals = (sum(-d for d in logs), sum(math.exp(d) - 1 - d for d in logs), sum(outside), sum(silent))
    seen = [kl.item(), kl.item(), fraction.item(), fraction.item()]
    return torch.tensor([abs(s - total / len(logs)) <= 1e-5 * max(1, abs(s)) for s, total in zip(seen, totals, strict=True)])


_WRONG_DIAGNOSES = {
    "equal-to-the-last-bit": (
        _told(lambda logged, computed: logged == computed),
        "A log is rounded to single precision: compare the distance with the tolerance, not the numbers with ==.",
    ),
    "only-the-nearest": (
        versions_of(ch102.which_diagnostics, one_shape(*TRIPLE), _NOT_NEGATIVE, data=TRIPLE)(_nearest),
        "The nearest of two rules is called the one. Both may fit, or neither: compare each with the tolerance by itself.",
    ),
    "distance-without-abs": (
        _told(lambda logged, computed: logged - computed <= 1e-5 * logged.abs().clamp(min=1)),
        "A logged number far below the computed one passes, too: take the absolute value of the difference.",
    ),
    "far-too-tolerant": (
        _told(lambda logged, computed: (logged - computed).abs() <= 0.03),
        "Numbers that are a hundredth apart come from different rules: the tolerance is 1e-5, for rounding alone.",
    ),
    "tolerance-not-scaled": (
        _told(lambda logged, computed: (logged - computed).abs() <= 1e-5),
        "Rounding grows with the numbers: where what was logged is above 1, the tolerance is 1e-5 times that.",
    ),
    "k1-and-k3-swapped": (_told(order=(1, 0, 2, 3)), "k1 comes first, the mean of -log ρ, and k3 second."),
    "fractions-swapped": (_told(order=(0, 1, 3, 2)), "“outside” comes before “silenced”."),
    "k1-with-the-wrong-sign": (
        _told(computed=lambda r, a, e: [-_k1(r), *_computed(r, a, e)[1:]]),
        "k1 is the mean of -log ρ, old minus new log-probabilities: its sign can be either, but not this one.",
    ),
    "k1-never-negative": (
        _told(computed=lambda r, a, e: [_k1(r).abs(), *_computed(r, a, e)[1:]]),
        "k1 may be negative, and some libraries log it so: no absolute value, no clamp."
        + wild.also("k1", "approx_kl", "token_approx_kl", what="k1 is"),
    ),
    "outside-by-either-rule": (
        _told(computed=lambda r, a, e: [*_computed(r, a, e)[:3], _computed(r, a, e)[2]]),
        "The fourth entry asks for the silent fraction, which needs the advantages." + _SILENCED_BY,
    ),
    "ratio-inverted": (_told(ratio=_inverted_ratio), _INVERTED),
    "clip-range-ignored": (_told(computed=lambda r, a, e: _computed(r, a, 0.2)), _RANGE),
    "one-answer-for-each-number": (
        after(ch102.which_diagnostics, lambda told: told.reshape(2, 2).any(1)),
        "This says whether any rule fits each number. Which one does is asked for: four answers.",
    ),
}

WHICH_DIAGNOSTICS = Exercise(
    name="which_diagnostics",
    reference=ch102.which_diagnostics,
    criteria={"values": 1.3, "inputs": 0.1, "errors": 0.1},
    axes=("rule",),
    cases=(
        *(
            Case(f"{name} and “{_KNOWN_FRACTIONS[fraction]}”, from a log", _log(kl=kl, fraction=fraction), visible=True)
            for kl, name in enumerate(("k1", "k3"))
            for fraction in (0, 1)
        ),
        Case("a small step, k1", _log(spread=0.01), visible=True, draws=3),
        Case("a large clip_range", _log(kl=1, fraction=1, spread=1.0, clip_range=0.6)),
        Case("identical policies: all fit", _standstill_log, closed_form=_fit(0, 1, 2, 3), visible=True, draws=1),
        Case("a KL by no rule", _log(by=(2e-3, 0.0)), visible=True),
        Case("a step far too large, a little off", _log(kl=1, spread=4.0, by=(5e-5, 0.0)), visible=True),
        Case("numbers by no rule, both below", _log(kl=1, by=(-0.9, -1.5)), closed_form=_fit(), visible=True, draws=1),
        Case("numbers by no rule, both above", _log(kl=1, by=(0.9, 1.5)), closed_form=_fit(), draws=1),
        Case(
            "what Stable-Baselines3 logged",
            _log_of_the_atlas("stable-baselines3", ("", ""), _minibatch_of_the_atlas, _SAMPLES),
            closed_form=_fit(1, 2),
            visible=True,
            draws=1,
        ),
        Case(
            "what TorchRL logged",
            _log_of_the_atlas("torchrl", ("k1", ""), _minibatch_of_the_atlas, _SAMPLES),
            closed_form=_fit(0, 2),
            visible=True,
            draws=1,
        ),
        Case(
            "what verl logged",
            _log_of_the_atlas("verl", ("k1", "silenced"), _tokens_of_the_atlas, _TOKENS),
            closed_form=_fit(0, 3),
            visible=True,
            draws=1,
        ),
        Case("inputs that require gradient", _log(), differentiate=TRIPLE, visible=True, draws=1),
        Case("single precision", _log(fraction=1), dtype=torch.float32, visible=True),
        *_columns(_log()),
        refused(_log(), clip_range=-0.1, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_DIAGNOSES),
        bad_input_accepted(_told(checked=False)),
        in_place(ch102.which_diagnostics, "log_probs", 2),
    ),
    variants={
        "torch.isclose": _told(
            lambda logged, computed: torch.isclose(computed, logged, rtol=0, atol=1e-5 * max(1.0, logged.abs().item()))
        ),
        "one number at a time": versions_of(ch102.which_diagnostics, one_shape(*TRIPLE), _NOT_NEGATIVE)(_told_one_by_one),
        "in double precision": _told(lambda logged, computed: _near(logged.double(), computed.double())),
        "the distance over its scale": _told(
            lambda logged, computed: (logged - computed).abs() / torch.maximum(logged.abs(), torch.ones_like(logged)) <= 1e-5
        ),
    },
)

# ---------------------------------------------------------------------------------------------------------------- gae_as

RULES = ("textbook", "termination", "leak", "current_value", "dropped")
_RECORDED = {  # the rule's name in the atlas, and the library whose numbers are looked at
    "textbook": ("", "stable-baselines3"),
    "termination": ("truncation_as_end", "cleanrl"),
    "leak": ("truncation_ignored", "skrl"),
    "current_value": ("current_value_even_at_an_end", "rsl-rl-lib"),
    "dropped": ("truncated_step_dropped", "brax"),
}
_WILD = (*FLOATS, "last_values")


def _followers(rule, what="this is"):
    return wild.also(_RECORDED[rule][0], "gae", what=what)


@drawing
def _wild_rollout(generator, **ends):
    """A rollout with the value of the observation from which the next one starts."""
    rollout = _rollout(generator, **ends)
    ended = rollout["terminated"][-1] | rollout["truncated"][-1]
    last_values = torch.where(ended, normal(generator, len(ended)), rollout["next_values"][-1])
    return _in_order(rollout, last_values, gamma=0.9, gae_lambda=0.8)


def _in_order(rollout, last_values, **scalars):
    """In the order of the signature."""
    return {
        **{name: rollout[name] for name in FLOATS},
        "last_values": last_values,
        "terminated": rollout["terminated"],
        "truncated": rollout["truncated"],
        **scalars,
    }


@drawing
def _wild_end(generator, *flags):
    at = [_position(generator, 8, 3)]
    return _wild_rollout(**{f"{flag}_at": at for flag in flags})(generator)


_wild_ends = _wild_rollout(
    steps=24, envs=4, terminated_at=[(5, 0), (23, 1), (9, 2)], truncated_at=[(7, 1), (15, 2), (23, 3), (9, 2)], rate=0.08
)


def _rollout_of_the_atlas(_generator):
    """The rollout that the libraries were given, time first."""
    part = {name: recorded.given(name).T for name in ("rewards", "values", "terminated", "truncated", "final_values")}
    last_values = recorded.given("last_values")
    following = torch.cat([part["values"][1:], last_values[None]])
    rollout = part | {"next_values": torch.where(part["terminated"] | part["truncated"], part["final_values"], following)}
    return _in_order(rollout, last_values, gamma=0.99, gae_lambda=0.95)


def _recorded(rule):
    """What a library that follows the rule gave for that rollout."""
    name, library = _RECORDED[rule]
    return recorded.numbers(library, "gae", name).T


def _next_row(values, last_values):
    return torch.cat([values[1:], last_values[None]])


@dataclass(frozen=True)
class _Rollout:
    """What a rule sees, with the settings."""

    rewards: torch.Tensor
    values: torch.Tensor
    next_values: torch.Tensor
    last_values: torch.Tensor
    terminated: torch.Tensor
    truncated: torch.Tensor
    gamma: float
    gae_lambda: float

    @property
    def ended(self):
        return self.terminated | self.truncated

    @property
    def following(self):
        return _next_row(self.values, self.last_values)

    def residuals(self, following, alive):
        return _residual(self.rewards, self.values, following, alive, self.gamma)

    def summed(self, deltas, stop):
        return _backward(deltas, self.gamma * self.gae_lambda * (~stop).to(deltas.dtype))

    def but(self, **changes):
        return replace(self, **changes)


def _textbook(x):
    return x.summed(x.residuals(x.next_values, ~x.terminated), x.ended)


def _termination(x):
    return x.summed(x.residuals(x.following, ~x.ended), x.ended)


def _leak(x):
    return x.summed(x.residuals(x.following, ~x.terminated), x.terminated)


def _current_value(x):
    return _termination(x.but(rewards=x.rewards + x.gamma * x.values * x.truncated))


def _sums_without_dropped(x):
    deltas = torch.where(x.truncated, torch.zeros_like(x.rewards), x.residuals(x.following, ~x.ended))
    return x.summed(deltas, x.ended)


def _dropped(x, sums=_sums_without_dropped):
    targets = _next_row(x.values + sums(x), x.last_values)
    return torch.where(x.truncated, torch.zeros_like(targets), x.residuals(targets, ~x.terminated))


_BY_RULE = {
    "textbook": _textbook,
    "termination": _termination,
    "leak": _leak,
    "current_value": _current_value,
    "dropped": _dropped,
}


def _last_row(given):
    """Raises ValueError unless there is a last value for each environment."""
    if given["last_values"].shape != given["rewards"].shape[1:]:
        raise ValueError("last_values: one for each environment")


def _named_rule(given):
    if given["rule"] not in RULES:
        raise ValueError(f"rule is none of the five: {given['rule']}")


_ruled = versions_of(ch102.gae_as, _named_rule, one_shape(*ROLLOUT), _last_row, _GAMMA, _LAMBDA, data=_WILD)


def _gae_as(other="textbook", **changed):
    """A version of the five rules, some of them changed; `other` is the rule that stands in for names that are none."""
    by_rule = _BY_RULE | changed
    return lambda rule, *given: by_rule[rule if rule in by_rule else other](_Rollout(*given))


def _wild_by_hand(rule, rewards, values, next_values, last_values, terminated, truncated, gamma, gae_lambda):
    """Plain Python, an environment at a time, each rule by its own words."""
    steps, envs = rewards.shape
    out = [[0.0] * envs for _ in range(steps)]
    for env in range(envs):
        r, v, n, stop, cut = (x[:, env].tolist() for x in (rewards, values, next_values, terminated, truncated))
        after_row = [*v[1:], last_values[env].item()]
        running, sums = 0.0, [0.0] * steps
        for t in range(steps - 1, -1, -1):
            reward = r[t] + (gamma * v[t] if rule == "current_value" and cut[t] else 0.0)
            if rule in ("textbook", "leak"):
                future = 0.0 if stop[t] else gamma * (n[t] if rule == "textbook" else after_row[t])
                carried = not (stop[t] or (cut[t] and rule == "textbook"))
            else:
                future, carried = 0.0 if stop[t] or cut[t] else gamma * after_row[t], not (stop[t] or cut[t])
            running = 0.0 if rule == "dropped" and cut[t] else reward + future - v[t] + gamma * gae_lambda * running * carried
            sums[t] = running
        for t in range(steps):
            target = last_values[env].item() if t == steps - 1 else v[t + 1] + sums[t + 1]
            ahead = 0.0 if cut[t] else r[t] + (0.0 if stop[t] else gamma * target) - v[t]
            out[t][env] = ahead if rule == "dropped" else sums[t]
    return torch.tensor(out, dtype=rewards.dtype)


def _wild_by_compute_gae(rule, rewards, values, next_values, last_values, terminated, truncated, gamma, gae_lambda):
    """Everything by way of compute_gae, truncated steps left out by a reward."""
    never, ended = torch.zeros_like(truncated), terminated.logical_or(truncated)
    settings = {"gamma": gamma, "gae_lambda": gae_lambda}
    if rule == "textbook":
        return ch44.compute_gae(rewards, values, next_values, terminated, truncated, **settings)
    behind = torch.roll(values, -1, 0)
    behind[-1] = last_values
    if rule == "leak":
        return ch44.compute_gae(rewards, values, behind, terminated, never, **settings)
    extra = {"current_value": gamma * values, "dropped": values - rewards}.get(rule, torch.zeros_like(values))
    sums = ch44.compute_gae(torch.where(truncated, rewards + extra, rewards), values, behind, ended, never, **settings)
    if rule != "dropped":
        return sums
    targets = torch.roll(values + sums, -1, 0)
    targets[-1] = last_values
    return ch44.compute_gae(rewards, values, targets, terminated, never, gamma, 0.0).masked_fill(truncated, 0.0)


def _wild_in_numpy(rule, *given):
    """NumPy in double precision, factors of each rule in a table."""
    *floats, terminated, truncated, gamma, gae_lambda = given
    r, v, n, last = (x.double().numpy() for x in floats)
    stop, cut = terminated.numpy(), truncated.numpy()
    end = stop | cut
    behind = np.concatenate([v[1:], last[None]])
    reward, future, carried = {
        "textbook": (r, np.where(stop, 0, n), ~end),
        "termination": (r, np.where(end, 0, behind), ~end),
        "leak": (r, np.where(stop, 0, behind), ~stop),
        "current_value": (r + gamma * v * cut, np.where(end, 0, behind), ~end),
        "dropped": (np.where(cut, v, r), np.where(end, 0, behind), ~end),
    }[rule]
    deltas, sums, running = reward + gamma * future - v, np.zeros_like(v), np.zeros_like(last)
    for t in reversed(range(len(v))):
        running = deltas[t] + gamma * gae_lambda * carried[t] * running
        sums[t] = running
    if rule == "dropped":
        targets = np.concatenate([(v + sums)[1:], last[None]])
        sums = np.where(cut, 0.0, r + gamma * targets * ~stop - v)
    return torch.from_numpy(sums).to(given[0].dtype)


_TAKEN_FOR = "This gives “{}” the numbers of “{}”: "

_WRONG_RULES = {
    "always-textbook": (
        _gae_as(**dict.fromkeys(RULES, _textbook)),
        "Every rule gives the numbers of compute_gae: its words say what it does otherwise." + _followers("textbook"),
    ),
    "always-termination": (
        _gae_as(**dict.fromkeys(RULES, _termination)),
        "Every rule gives the numbers of “termination”: a time limit counted as an end." + _followers("termination"),
    ),
    "textbook-taken-for-termination": (
        _gae_as(textbook=_termination),
        _TAKEN_FOR.format("textbook", "termination")
        + "a time limit counted as an end. compute_gae bootstraps there."
        + _followers("termination"),
    ),
    "leak-taken-for-termination": (
        _gae_as(leak=_termination),
        _TAKEN_FOR.format("leak", "termination")
        + "a time limit counted as an end. A time limit that is not seen stops nothing: the next row's value and sum go on."
        + _followers("termination"),
    ),
    "termination-taken-for-leak": (
        _gae_as(termination=_leak),
        _TAKEN_FOR.format("termination", "leak")
        + "the next episode leaks in. An end bootstraps nothing and stops the sum."
        + _followers("leak"),
    ),
    "current-value-taken-for-termination": (
        _gae_as(current_value=_termination),
        _TAKEN_FOR.format("current_value", "termination")
        + "a time limit counted as an end. Before that, γ V(s_t) is added to the truncated step's reward."
        + _followers("termination"),
    ),
    "dropped-taken-for-termination": (
        _gae_as(dropped=_termination),
        _TAKEN_FOR.format("dropped", "termination")
        + "a time limit counted as an end. The step itself has no advantage at all."
        + _followers("termination"),
    ),
    "leak-cut": (
        _gae_as(leak=lambda x: x.summed(x.residuals(x.following, ~x.terminated), x.ended)),
        "“leak”: the next episode's value stands in, but the sum stops at the time limit, which this rule does not see.",
    ),
    "leak-with-the-true-successor": (
        _gae_as(leak=lambda x: x.summed(x.residuals(x.next_values, ~x.terminated), x.terminated)),
        "“leak”: the sum runs on, but the value is that of the true successor. This rule reads row t + 1, whatever it holds.",
    ),
    "leak-through-terminations": (
        _gae_as(leak=lambda x: x.summed(x.residuals(x.following, ~x.terminated), torch.zeros_like(x.ended))),
        "“leak” does not see time limits; an end of the task it does see, and stops there.",
    ),
    "final-value-added": (
        _gae_as(current_value=lambda x: _termination(x.but(rewards=x.rewards + x.gamma * x.next_values * x.truncated))),
        "“current_value”: the value added is next_values, of the observation after the step; this rule adds values, of the one before.",
    ),
    "current-value-not-at-an-end": (
        _gae_as(
            current_value=lambda x: _termination(x.but(rewards=x.rewards + x.gamma * x.values * (x.truncated & ~x.terminated)))
        ),
        "“current_value”: where a step is both terminated and truncated, this rule adds the value all the same.",
    ),
    "current-value-undiscounted": (
        _gae_as(current_value=lambda x: _termination(x.but(rewards=x.rewards + x.values * x.truncated))),
        "“current_value”: what is added is γ V(s_t); here γ is missing.",
    ),
    "current-value-at-every-end": (
        _gae_as(current_value=lambda x: _termination(x.but(rewards=x.rewards + x.gamma * x.values * x.ended))),
        "“current_value”: a value is added where the task ended as well. Only truncated steps get one.",
    ),
    "dropped-step-only": (
        _gae_as(dropped=lambda x: torch.where(x.truncated, torch.zeros_like(x.rewards), _termination(x))),
        "“dropped”: the truncated step is 0, but the steps before it still carry its residual, and all look further than one step ahead.",
    ),
    "dropped-without-the-look-ahead": (
        _gae_as(dropped=_sums_without_dropped),
        "“dropped”: these are the sums A. The advantage is one step ahead of a target that holds them: r + γ G - V.",
    ),
    "dropped-sums-with-its-residual": (
        _gae_as(dropped=lambda x: _dropped(x, _termination)),
        "“dropped”: the target of the truncated row is V alone, as its δ is 0; here its reward is still in it.",
    ),
    "last-values-ignored": (
        _gae_as(**{name: lambda x, by=by: by(x.but(last_values=x.next_values[-1])) for name, by in _BY_RULE.items()}),
        "After the last row comes the observation from which the next rollout starts: last_values, not next_values[-1].",
    ),
}


def _reward_raised_in_place(x):
    return _termination(x.but(rewards=x.rewards.add_(x.gamma * x.values * x.truncated)))


GAE_AS = Exercise(
    name="gae_as",
    reference=ch102.gae_as,
    criteria={"values": 2.3, "gradient": 0.2, "dtype": 0.1, "inputs": 0.15, "errors": 0.25},
    axes=("t", "env"),
    last_step_first=True,
    cases=(
        *(
            case
            for rule in RULES
            for case in (
                Case(f"“{rule}”: a time limit cuts one episode", _by(rule, _wild_end("truncated")), visible=True, draws=1),
                Case(f"“{rule}”: one episode terminates", _by(rule, _wild_end("terminated")), visible=True, draws=1),
                Case(f"“{rule}”: both in the same step", _by(rule, _wild_end("terminated", "truncated")), visible=True, draws=1),
                Case(f"“{rule}”: many ends", _by(rule, _wild_ends), closed_form=_wild_by_hand, visible=True, draws=2),
                Case(
                    f"“{rule}”: what {_RECORDED[rule][1]} computed",
                    _by(rule, _rollout_of_the_atlas),
                    closed_form=lambda rule, **_given: _recorded(rule),
                    visible=True,
                    draws=1,
                ),
                Case(
                    f"“{rule}”: values that require gradient", _by(rule, _wild_ends), differentiate=_WILD, visible=True, draws=1
                ),
                Case(f"“{rule}”: single precision", _by(rule, _wild_ends), dtype=torch.float32, visible=True, draws=1),
            )
        ),
        Case("“leak”: default gamma and gae_lambda", _by("leak", without(_wild_ends, "gamma", "gae_lambda")), draws=1),
        Case("“dropped”: one step", _by("dropped", _wild_rollout(steps=1, envs=2)), draws=1),
        refused(_by("leak", _wild_ends), rule="truncation", visible=True),
        refused(_by("leak", _wild_ends), gamma=1.5, visible=True),
        refused(_by("dropped", _wild_ends), gae_lambda=-0.1),
        *(_column_short(_by("current_value", _wild_ends), name, ROLLOUT, visible=name == "truncated") for name in ROLLOUT),
        Case(
            "last_values of one environment too few",
            reshaped(_by("leak", _wild_ends), "last_values", lambda x: x[1:]),
            raises=["last_values"],
            visible=True,
            draws=1,
        ),
    ),
    misconceptions=(
        *wrong(_WRONG_RULES, _ruled),
        Misconception(
            "unknown-rule-accepted",
            versions_of(ch102.gae_as, one_shape(*ROLLOUT), _last_row, _GAMMA, _LAMBDA, data=_WILD)(_gae_as("dropped")),
            "A name that is none of the five is taken for one of them (an else?): refuse it, and name the argument.",
        ),
        Misconception("graph-kept", _ruled(_gae_as(), leak=True), _DETACH),
        Misconception("input-changed", _ruled(_gae_as(current_value=_reward_raised_in_place)), _CHANGED),
        dtype_lost(ch102.gae_as),
        bad_input_accepted(_ruled(_gae_as(), checked=False)),
    ),
    variants={
        "a function for each rule": _ruled(_gae_as()),
        "plain Python, environment by environment": _ruled(_wild_by_hand),
        "by way of compute_gae alone": _ruled(_wild_by_compute_gae),
        "NumPy, a table of factors": _ruled(_wild_in_numpy),
    },
)

# ------------------------------------------------------------------------------------------------------------- which_gae


_one_limit = _wild_end("truncated")


@drawing
def _logged(generator, rule, inputs=_one_limit, off=0.0, scale=1.0, noise=0.0, rules=RULES, at=None):
    """What a program that follows a rule has logged, in single precision; `off` is how much too large one entry is, `noise` how far
    rounding has taken each."""
    given = inputs(generator)
    if scale != 1:
        given |= {name: scale * given[name] for name in _WILD}
    advantages = _BY_RULE[rule](_Rollout(*given.values()))
    advantages = advantages + noise * normal(generator, *advantages.shape).sign()
    entry = _position(generator, *advantages.shape) if at is None else at
    advantages[entry] += off
    return {"logged": advantages.float().double(), "rules": list(rules), **given}


@drawing
def _logged_in_the_atlas(_generator, rule):
    return {"logged": _recorded(rule), "rules": list(RULES), **_rollout_of_the_atlas(None)}


def _only(*rules, of=RULES):
    """A closed form: these of the names."""
    return lambda **_given: torch.tensor([name in rules for name in of])


def _two_envs_apart(generator):
    """Environment 0 has no time limit: there, most rules agree."""
    return _wild_rollout(steps=10, envs=2, truncated_at=[(4, 1)])(generator)


def _which(fits, checked=True, **options):
    """A version of the reading: `fits` compares the logged advantages with those by one rule."""

    def reading(logged, rules, *given):
        return torch.stack([torch.as_tensor(fits(logged, _computed_as(rule, given, checked))) for rule in rules])

    checks = (one_shape("logged", *ROLLOUT), _last_row, _GAMMA, _LAMBDA) if checked else ()
    return versions_of(ch102.which_gae, *checks, data=("logged", *_WILD))(reading, **options)


def _computed_as(rule, given, checked=True):
    if checked and rule not in RULES:
        raise ValueError(f"rules: {rule} is none of the five")
    return _BY_RULE.get(rule, _textbook)(_Rollout(*given))


def _scale(logged):
    return logged.abs().max().clamp(min=1)


def _fits(logged, computed):
    return (logged - computed).abs().max() <= 1e-4 * _scale(logged)


def _nearest_rule(logged, rules, *given):
    gaps = torch.stack([(logged - _computed_as(rule, given)).abs().max() for rule in rules])
    return torch.arange(len(rules)) == gaps.argmin()


def _in_the_usual_order(logged, rules, *given):
    return torch.stack([_fits(logged, _computed_as(rule, given)) for rule in sorted(rules, key=RULES.index)])


def _first_that_fits(logged, rules, *given):
    told = [bool(_fits(logged, _computed_as(rule, given))) for rule in rules]
    return torch.tensor([fit and not any(told[:k]) for k, fit in enumerate(told)])


def _entry_by_entry(logged, rules, *given):
    tolerance = 1e-4 * max(1.0, max(abs(x) for row in logged.tolist() for x in row))
    told = []
    for rule in rules:
        pairs = zip(logged.flatten().tolist(), _computed_as(rule, given).flatten().tolist(), strict=True)
        told.append(all(abs(x - y) <= tolerance for x, y in pairs))
    return torch.tensor(told)


def _all_at_once(logged, rules, *given):
    table = torch.stack([_computed_as(rule, given) for rule in rules])
    return (table - logged).flatten(1).abs().amax(1) <= 1e-4 * torch.maximum(logged.abs().max(), torch.ones_like(logged[0, 0]))


_readings = versions_of(ch102.which_gae, one_shape("logged", *ROLLOUT), _last_row, _GAMMA, _LAMBDA, data=("logged", *_WILD))

_WRONG_READINGS = {
    "equal-to-the-last-bit": (
        _which(lambda logged, computed: (logged == computed).all()),
        "A log is rounded to single precision: compare the largest difference with the tolerance, not the numbers with ==.",
    ),
    "only-the-nearest": (
        _readings(_nearest_rule),
        "The nearest rule is called the one. Several may fit, or none: compare each with the tolerance by itself.",
    ),
    "first-that-fits": (_readings(_first_that_fits), "Where several rules fit, all of them are the answer, not the first."),
    "some-entry-fits": (
        _which(lambda logged, computed: (logged - computed).abs().min() <= 1e-4 * _scale(logged)),
        "One entry that agrees proves nothing: most rules agree far from a time limit. Every entry has to.",
    ),
    "mean-difference": (
        _which(lambda logged, computed: (logged - computed).abs().mean() <= 1e-4 * _scale(logged)),
        "A mean hides one entry that is off among many that are right: take the largest difference.",
    ),
    "difference-without-abs": (
        _which(lambda logged, computed: (logged - computed).max() <= 1e-4 * _scale(logged)),
        "Entries far below the computed ones pass, too: take the absolute value first.",
    ),
    "first-environment-only": (
        _which(lambda logged, computed: _fits(logged[:, :1], computed[:, :1])),
        "Only the first environment is looked at: the time limit may be in another one.",
    ),
    "first-step-only": (
        _which(lambda logged, computed: _fits(logged[:1], computed[:1])),
        "Only the first step is looked at: a rule may show at its time limit and nowhere before.",
    ),
    "tolerance-of-each-entry": (
        _which(lambda logged, computed: ((logged - computed).abs() <= 1e-4 * logged.abs()).all()),
        "The tolerance shrinks with each entry, and near 0 rounding alone exceeds it: scale it by the largest entry, by 1 at least.",
    ),
    "tolerance-not-scaled": (
        _which(lambda logged, computed: (logged - computed).abs().max() <= 1e-4),
        "Rounding grows with the numbers: where entries are above 1, the tolerance is 1e-4 times the largest.",
    ),
    "far-too-tolerant": (
        _which(lambda logged, computed: (logged - computed).abs().max() <= 0.1 * _scale(logged)),
        "A tenth is no rounding: the tolerance is 1e-4.",
    ),
    "order-of-rules-ignored": (
        _readings(_in_the_usual_order),
        "The answers are in an order of their own: entry k belongs to rules[k].",
    ),
    "says-which-not": (after(ch102.which_gae, torch.logical_not), "True where a rule fits; this is True where it does not."),
}

_SOME = ("dropped", "leak", "textbook")

WHICH_GAE = Exercise(
    name="which_gae",
    reference=ch102.which_gae,
    criteria={"values": 1.3, "inputs": 0.1, "errors": 0.1},
    axes=("rule",),
    cases=(
        *(
            Case(
                f"what {_RECORDED[rule][1]} computed",
                _logged_in_the_atlas(rule),
                closed_form=_only(rule),
                visible=True,
                draws=1,
            )
            for rule in RULES
        ),
        *(
            Case(f"“{rule}”, from a log", _logged(rule, _wild_ends), closed_form=_only(rule), visible=rule == "leak")
            for rule in RULES
        ),
        Case(
            "no episode ends: most rules agree",
            _logged("leak", _wild_rollout()),
            closed_form=_only("textbook", "termination", "leak", "current_value"),
            visible=True,
        ),
        Case(
            "a task that ended: most rules agree",
            _logged("termination", _wild_end("terminated")),
            closed_form=_only("textbook", "termination", "leak", "current_value"),
        ),
        Case(
            "the time limit is in the second environment",
            _logged("leak", _two_envs_apart),
            closed_form=_only("leak"),
            visible=True,
        ),
        Case("large rewards", _logged("current_value", _wild_ends, scale=1e4), closed_form=_only("current_value"), visible=True),
        Case("rounding at every step", _logged("dropped", noise=5e-5), closed_form=_only("dropped"), visible=True),
        Case("three rules, in another order", _logged("leak", rules=_SOME), closed_form=_only("leak", of=_SOME), visible=True),
        Case("one entry is 0.01 too large", _logged("leak", _wild_ends, off=0.01), closed_form=_only(), visible=True),
        Case("one entry is 0.002 too small", _logged("textbook", _wild_ends, off=-0.002), closed_form=_only(), visible=True),
        Case("all entries are 0.01 off", _logged("termination", _wild_ends, noise=0.01), closed_form=_only(), visible=True),
        Case("one entry is far too small", _logged("textbook", _wild_rollout(), off=-9.0), closed_form=_only(), visible=True),
        Case("the last entry is too large", _logged("textbook", off=0.5, at=(7, 2)), closed_form=_only()),
        Case("inputs that require gradient", _logged("leak"), differentiate=("logged", *_WILD), visible=True, draws=1),
        Case("single precision", _logged("dropped", _wild_ends), dtype=torch.float32, visible=True),
        Case(
            "rules = leak, truncation",
            replaced(_logged("leak"), rules=["leak", "truncation"]),
            raises=["rule"],  # as gae_as has it
            visible=True,
            draws=1,
        ),
        refused(_logged("leak"), gamma=1.5),
        Case(
            "logged with a column too few",
            reshaped(_logged("leak"), "logged", lambda x: x[:, :1]),
            raises=("logged", *ROLLOUT),
            visible=True,
            draws=1,
        ),
    ),
    misconceptions=(
        *wrong(_WRONG_READINGS),
        bad_input_accepted(_which(_fits, checked=False)),
        in_place(ch102.which_gae, "logged"),
    ),
    variants={
        "torch.isclose": _which(
            lambda logged, computed: torch.isclose(computed, logged, rtol=0, atol=1e-4 * _scale(logged).item()).all()
        ),
        "entry by entry": _readings(_entry_by_entry),
        "all rules at once": _readings(_all_at_once),
        "in double precision": _which(lambda logged, computed: _fits(logged.double(), computed.double())),
    },
)

# ---------------------------------------------------------------------------------------------------------- parting_ones


@drawing
def _ends_only(generator, rules, cut=("truncated",), steps=4, envs=1, env=0, at=None, rate=0.0, **scalars):
    """Flags alone, and the rules to be told apart; `cut` names the flags of the step that ends an episode."""
    flags = {name: torch.rand(steps, envs, generator=generator) < rate for name in ("terminated", "truncated")}
    step = int(integers(generator, 1, steps - 1)) if at is None else at
    for name in cut:
        flags[name][step, env] = True
    drawn = 0.8 + 0.15 * uniform(generator, 2)
    return {"rules": list(rules), **flags, **dict(zip(("gamma", "gae_lambda"), drawn.tolist(), strict=True)), **scalars}


def _continued(values, finals, last, ended):
    """What follows each step: the next row, last_values after the last one, and the true successor where an episode ends."""
    return torch.where(ended, finals, torch.cat([values[1:], last[None]]))


def _every_two(gaps):
    return gaps[torch.ones(gaps.shape[:2], dtype=torch.bool).tril(-1)].gt(1e-3).all(0)


def _largest(difference, _truncated):
    return difference.abs().amax((0, 1))


def _parting(follow=_continued, parts=_every_two, gap=_largest, known=RULES):
    """A version of the search: what stands in next_values, which of the gaps (rules, rules, probes) must be large, and how the gap of two
    rules (T, N, probes) is measured."""

    def search(rules, terminated, truncated, gamma, gae_lambda):
        if any(rule not in known for rule in rules):
            raise ValueError(f"rules: {rules} are not all of the five")
        steps, envs = terminated.shape
        sizes = [steps * envs] * 3 + [envs]
        rewards, values, finals, last = torch.eye(sum(sizes), dtype=torch.float64).split(sizes)
        shaped = [x.reshape(steps, -1) for x in (rewards, values, finals)]
        flags = [x.repeat_interleave(sum(sizes), 1) for x in (terminated, truncated)]
        following = follow(shaped[1], shaped[2], last.flatten(), flags[0] | flags[1])
        x = _Rollout(shaped[0], shaped[1], following, last.flatten(), *flags, gamma, gae_lambda)  # type: ignore[call-arg]
        made = [_BY_RULE.get(rule, _textbook)(x).reshape(steps, envs, -1) for rule in rules]
        gaps = torch.stack([torch.stack([gap(one - other, truncated) for other in made]) for one in made])
        told = parts(gaps).split(sizes)
        names = (*FLOATS, "last_values")
        return {name: y if name == "last_values" else y.reshape(steps, envs) for name, y in zip(names, told, strict=True)}

    return search


def _parting_by_hand(rules, terminated, truncated, gamma, gae_lambda):
    """One rollout after another, one pair of rules after another."""
    steps, envs = terminated.shape
    out = {name: torch.zeros(steps, envs, dtype=torch.bool) for name in FLOATS} | {
        "last_values": torch.zeros(envs, dtype=torch.bool)
    }
    ended = terminated | truncated
    for name, told in out.items():
        for place in torch.ones(told.shape).nonzero().tolist():
            given = {part: torch.zeros(found.shape, dtype=torch.float64) for part, found in out.items()}
            if name == "next_values" and not ended[tuple(place)]:
                continue
            given[name][tuple(place)] = 1.0
            for t in range(steps):
                for env in range(envs):
                    if not ended[t, env]:
                        after = given["values"][t + 1, env] if t + 1 < steps else given["last_values"][env]
                        given["next_values"][t, env] = after
            x = _Rollout(*given.values(), terminated, truncated, gamma, gae_lambda)  # type: ignore[call-arg, arg-type]
            made = [_BY_RULE[rule](x) for rule in rules]
            pairs = ((one, other) for k, one in enumerate(made) for other in made[:k])
            told[tuple(place)] = all((one - other).abs().max() > 1e-3 for one, other in pairs)
    return out


def _parting_by_pairs(rules, *given):
    """Two rules at a time: what parts all is in every answer."""
    pairs = [(one, other) for k, one in enumerate(rules) for other in rules[:k]]
    found = [ch102.parting_ones(pair, *given) for pair in pairs]
    return {name: torch.stack([told[name] for told in found]).all(0) for name in found[0]}


def _knowing_all(search):
    """The same with the names checked first."""

    def checked(rules, *given):
        if set(rules) - set(RULES):
            raise ValueError(f"rules: {rules} are not all of the five")
        return search(rules, *given)

    return checked


_two_rules = satisfies(lambda rules: len(rules) > 1)
_parts = versions_of(ch102.parting_ones, _two_rules, one_shape("terminated", "truncated"), _GAMMA, _LAMBDA)

_WRONG_PARTINGS = {
    "one-pair-is-enough": (
        _parting(parts=lambda gaps: (gaps > 1e-3).any(0).any(0)),
        "A 1 that tells some two of the rules apart still leaves others alike: every pair must differ.",
    ),
    "neighbours-only": (
        _parting(parts=lambda gaps: torch.stack([gap[k] > 1e-3 for k, gap in enumerate(gaps[1:])]).all(0)),
        "Each rule is compared with the next one in the list only; the first and the third may agree.",
    ),
    "the-first-against-the-rest": (
        _parting(parts=lambda gaps: gaps[1:, 0].gt(1e-3).all(0)),
        "All are compared with the first rule only: among the others, two may agree.",
    ),
    "distance-without-abs": (
        _parting(gap=lambda difference, _truncated: difference.amax((0, 1))),
        "A rule whose advantages are smaller differs, too: take the absolute value of the difference.",
    ),
    "any-difference-counts": (
        _parting(parts=lambda gaps: gaps[torch.ones(gaps.shape[:2], dtype=torch.bool).tril(-1)].gt(0).all(0)),
        "A difference below 1e-3 is not seen in a log that is rounded: compare with 1e-3, not with 0.",
    ),
    "the-cut-step-only": (
        _parting(gap=lambda difference, truncated: (difference.abs() * truncated[..., None]).amax((0, 1))),
        "Only truncated steps are looked at: rules may differ at any step of the rollout.",
    ),
    "first-environment-only": (
        _parting(gap=lambda difference, _truncated: difference[:, 0].abs().amax(0)),
        "Only the first environment is looked at: the end may be in another one.",
    ),
    "no-successor-follows": (
        _parting(lambda values, finals, last, ended: finals * ended),
        "No rollout looks like this: where no episode ends, next_values holds the next row's value, and a 1 in values stands there, too.",
    ),
    "last-values-stand-alone": (
        _parting(lambda values, finals, last, ended: torch.where(ended, finals, torch.cat([values[1:], 0 * last[None]]))),
        "After the last row next_values holds last_values, unless an episode ends there: the 1 must stand in both.",
    ),
    "the-next-episode-follows": (
        _parting(lambda values, finals, last, ended: torch.cat([values[1:], last[None]]) + finals * ended),
        "Where an episode ends, row t + 1 belongs to another one: its value is not that of the successor.",
    ),
    "successors-everywhere": (
        _parting(lambda values, finals, last, ended: torch.cat([values[1:], last[None]]) * ~ended + finals),
        "Where no episode ends, next_values is not free: it holds what values holds in the next row. Leave these places False.",
    ),
}


PARTING_ONES = Exercise(
    name="parting_ones",
    reference=ch102.parting_ones,
    criteria={"values": 1.6, "inputs": 0.1, "errors": 0.3},
    axes=("t", "env"),
    cases=drawn_once(
        Case("termination and leak", _ends_only(("termination", "leak")), closed_form=_parting_by_hand, visible=True),
        Case("termination and textbook", _ends_only(("termination", "textbook")), visible=True),
        Case("textbook and termination", _ends_only(("textbook", "termination")), visible=True),
        Case("leak, current_value and dropped", _ends_only(("leak", "current_value", "dropped")), visible=True),
        Case("leak, dropped and textbook", _ends_only(("leak", "dropped", "textbook")), visible=True),
        Case("current_value, leak and termination", _ends_only(("current_value", "leak", "termination")), visible=True),
        Case("textbook, leak and termination", _ends_only(("textbook", "leak", "termination")), visible=True),
        Case("all five", _ends_only(RULES), visible=True),
        Case("no episode ends: textbook and leak", _ends_only(("textbook", "leak"), ()), visible=True),
        Case("no episode ends: dropped and textbook", _ends_only(("dropped", "textbook"), ()), visible=True),
        Case("both in the same step", _ends_only(("current_value", "termination"), ("terminated", "truncated")), visible=True),
        Case("the task ended", _ends_only(("dropped", "leak"), ("terminated",)), visible=True),
        Case("a time limit in the second environment", _ends_only(("termination", "leak"), envs=2, env=1), visible=True),
        Case("a time limit in the last row", _ends_only(("leak", "textbook"), at=3), visible=True),
        Case(
            "γ λ is small: differences fade",
            _ends_only(("leak", "termination"), steps=7, at=1, gamma=0.6, gae_lambda=0.2),
            visible=True,
        ),
        Case(
            "many ends",
            _ends_only(("dropped", "leak", "current_value"), steps=5, envs=2, rate=0.3),
            closed_form=_parting_by_hand,
            draws=2,
        ),
        Case("default gamma and gae_lambda", without(_ends_only(("leak", "current_value")), "gamma", "gae_lambda")),
        Case("gamma = 0", _ends_only(("leak", "dropped"), gamma=0.0)),
        Case("gae_lambda = 0", _ends_only(("leak", "termination"), gae_lambda=0.0)),
        Case("one rule", _ends_only(("leak",)), raises=["rules"], visible=True),
        Case("leak and truncation", _ends_only(("leak", "truncation")), raises=["rule"], visible=True),
        refused(_ends_only(("leak", "textbook")), gamma=1.5, visible=True),
        refused(_ends_only(("leak", "textbook")), gae_lambda=-0.1),
        Case(
            "truncated with a step too few",
            reshaped(_ends_only(("leak", "textbook")), "truncated", lambda x: x[1:]),
            raises=("terminated", "truncated"),
            visible=True,
        ),
    ),
    misconceptions=(
        *wrong(_WRONG_PARTINGS, _parts),
        Misconception(
            "says-which-not",
            _parts(lambda *given: {name: ~told for name, told in _parting()(*given).items()}),
            "True where a 1 tells the rules apart; this is True where it does not.",
        ),
        in_place(ch102.parting_ones, "truncated", 2),
        bad_input_accepted(_parts(_parting(known=_Anything()), checked=False)),
    ),
    variants={
        "one rollout after another": _parts(_knowing_all(_parting_by_hand)),
        "all gaps in one table": _parts(_parting()),
        "two rules at a time": _parts(_knowing_all(_parting_by_pairs)),
        "distances, none from a rule to itself": _parts(
            _parting(
                gap=lambda difference, _truncated: torch.linalg.vector_norm(difference, torch.inf, (0, 1)),
                parts=lambda gaps: (gaps + torch.eye(len(gaps))[..., None] > 1e-3).flatten(0, 1).all(0),
            )
        ),
    },
)

# ---------------------------------------------------------------------------------------------------- repaired_bootstrap

_STORED = ("stored_rewards", "values", "next_values")
_LAB = (*_STORED, "terminated", "truncated")


@drawing
def _stored(generator, gamma=0.9, gae_lambda=0.8, **settings):
    """A rollout whose rewards have been paid γ V of the true successor where a time limit alone cut."""
    drawn = _rollout(generator, **settings)
    limit = drawn["truncated"] & ~drawn["terminated"]
    stored = drawn.pop("rewards") + gamma * drawn["next_values"] * limit
    return {"stored_rewards": stored, **drawn, "gamma": gamma, "gae_lambda": gae_lambda}


@drawing
def _stored_end(generator, *flags):
    at = [_position(generator, 8, 3)]
    return _stored(**{f"{flag}_at": at for flag in flags})(generator)


_stored_ends = _stored(
    steps=24, envs=4, terminated_at=[(5, 0), (23, 1), (9, 2)], truncated_at=[(7, 1), (15, 2), (23, 3), (9, 2)], rate=0.08
)


def _for_ever(generator):
    """Reward 1 for ever, and a critic that knows it: nothing is left to explain, a time limit or not."""
    ones = torch.ones(12, 2, dtype=torch.float64)
    cut = torch.zeros(12, 2, dtype=torch.bool)
    cut[_position(generator, 12, 2)] = True
    worth = 10 * ones
    rest = {"values": worth, "next_values": worth, "terminated": torch.zeros_like(cut), "truncated": cut}
    return {"stored_rewards": ones + 0.9 * worth * cut, **rest, "gamma": 0.9, "gae_lambda": 0.95}


def _repaid(taken=lambda x: x.gamma * x.next_values * (x.truncated & ~x.terminated), advantages=_textbook):
    """A version of the repair: what it takes off the rewards, and which advantages it computes of the rest."""

    def repair(stored, values, next_values, *others):
        x = _Rollout(stored, values, next_values, next_values[-1], *others)
        return advantages(x.but(rewards=x.rewards - taken(x)))

    return repair


def _nothing(x):
    return 0.0


def _repaired_by_hand(stored, values, next_values, terminated, truncated, gamma, gae_lambda):
    """Plain Python, an environment at a time: a paid future is not asked for again."""
    steps, envs = stored.shape
    out = torch.empty_like(stored)
    for env in range(envs):
        running = 0.0
        for t in range(steps - 1, -1, -1):
            over = bool(terminated[t, env]) or bool(truncated[t, env])
            future = 0.0 if over else gamma * next_values[t, env].item()
            running = stored[t, env].item() + future - values[t, env].item() + (0.0 if over else gamma * gae_lambda * running)
            out[t, env] = running
    return out


def _repaired_in_numpy(stored, values, next_values, terminated, truncated, gamma, gae_lambda):
    r, v, n = (x.double().numpy() for x in (stored, values, next_values))
    stop, cut = terminated.numpy(), truncated.numpy()
    deltas = np.where(cut & ~stop, r - gamma * n, r) + gamma * n * ~stop - v
    sums, running = np.zeros_like(v), np.zeros_like(v[0])
    for t in reversed(range(len(v))):
        running = deltas[t] + gamma * gae_lambda * ~(stop | cut)[t] * running
        sums[t] = running
    return torch.from_numpy(sums).to(stored.dtype)


def _lowered_in_place(stored, values, next_values, terminated, truncated, gamma, gae_lambda):
    stored -= gamma * next_values * (truncated & ~terminated)
    return ch44.compute_gae(stored, values, next_values, terminated, truncated, gamma, gae_lambda)


_repaired = versions_of(ch102.repaired_bootstrap, one_shape(*_LAB), _GAMMA, _LAMBDA, data=_STORED)

_WRONG_REPAIRS = {
    "future-counted-twice": (
        _repaid(_nothing),
        "At a time limit the future is in the stored reward and is bootstrapped once more: these are the suspect's numbers."
        + wild.also("", "stored_reward", what="to store rewards so is"),
    ),
    "no-future-at-all": (
        _repaid(advantages=_termination),
        "Taken off the reward, and not bootstrapped either: now a time limit counts as an end." + _followers("termination"),
    ),
    "next-episode-leaks-in": (
        _repaid(_nothing, lambda x: x.summed(x.residuals(x.next_values, ~x.ended), x.terminated)),
        "The future is counted once, but the sum runs on over the time limit, into another episode.",
    ),
    "taken-off-where-the-task-ended": (
        _repaid(lambda x: x.gamma * x.next_values * x.truncated),
        "Where a step is both truncated and terminated the collector has added nothing: nothing is to be taken off.",
    ),
    "taken-off-at-every-end": (
        _repaid(lambda x: x.gamma * x.next_values * x.ended),
        "The collector adds at time limits only; where the task ended the stored reward is what the environment paid.",
    ),
    "current-value-taken-off": (
        _repaid(lambda x: x.gamma * x.values * (x.truncated & ~x.terminated)),
        "What was added is γ V of the successor, next_values; this takes off that of the state before.",
    ),
    "undiscounted-value-taken-off": (
        _repaid(lambda x: x.next_values * (x.truncated & ~x.terminated)),
        "What was added is γ V(s_{t+1}); here γ is missing.",
    ),
    "added-once-more": (
        _repaid(lambda x: -x.gamma * x.next_values * (x.truncated & ~x.terminated)),
        "The sign is the wrong way round: this pays for the time limit a third time.",
    ),
    "taken-off-everywhere": (
        _repaid(lambda x: x.gamma * x.next_values * ~x.terminated),
        "Only the rewards of truncated steps hold a future; all others are as the environment paid them.",
    ),
}

REPAIRED_BOOTSTRAP = Exercise(
    name="repaired_bootstrap",
    reference=ch102.repaired_bootstrap,
    criteria={"values": 1.9, "gradient": 0.15, "dtype": 0.1, "inputs": 0.15, "errors": 0.2},
    axes=("t", "env"),
    last_step_first=True,
    cases=(
        Case("no episode ends", _stored(), visible=True),
        Case("a time limit cuts one episode", _stored_end("truncated"), visible=True),
        Case("one episode terminates", _stored_end("terminated"), visible=True),
        Case("both in the same step", _stored_end("terminated", "truncated"), visible=True),
        Case("many ends", _stored_ends, closed_form=_repaired_by_hand, visible=True, draws=3),
        Case(
            "reward 1 for ever and true values: no advantage",
            _for_ever,
            closed_form=lambda stored_rewards, **_rest: torch.zeros_like(stored_rewards),
            visible=True,
        ),
        Case("default gamma and gae_lambda", without(_stored(gamma=0.99, truncated_at=[(3, 1)]), "gamma", "gae_lambda")),
        Case("one step, cut", _stored(steps=1, envs=2, truncated_at=[(0, 1)])),
        Case("values that require gradient", _stored_ends, differentiate=_STORED, visible=True),
        Case("single precision", _stored_ends, dtype=torch.float32, visible=True),
        refused(_stored_ends, gamma=1.5, visible=True),
        refused(_stored_ends, gae_lambda=-0.1),
        *(_column_short(_stored_ends, name, _LAB, visible=name == "truncated") for name in _LAB),
    ),
    misconceptions=(
        *wrong(_WRONG_REPAIRS, _repaired),
        Misconception("graph-kept", _repaired(_repaid(), leak=True), _DETACH),
        Misconception("input-changed", _repaired(_lowered_in_place), _CHANGED),
        dtype_lost(ch102.repaired_bootstrap),
        bad_input_accepted(_repaired(_repaid(), checked=False)),
    ),
    variants={
        "taken off, then the textbook": _repaired(_repaid()),
        "every end an end, as the future is in the reward": _repaired(
            _repaid(_nothing, lambda x: x.summed(x.residuals(x.next_values, ~x.ended), x.ended))
        ),
        "by way of compute_gae": _repaired(
            lambda r, v, n, terminated, truncated, *settings: ch44.compute_gae(
                r, v, n, terminated | truncated, truncated, *settings
            )
        ),
        "plain Python, environment by environment": _repaired(_repaired_by_hand),
        "NumPy": _repaired(_repaired_in_numpy),
    },
)

EXERCISES = (CLIP_FRACTION_AS, WHICH_DIAGNOSTICS, GAE_AS, WHICH_GAE, PARTING_ONES, REPAIRED_BOOTSTRAP)
