"""Checks of chapter 80: cases, named misconceptions and correct variants for rewards learned from comparisons."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from autograder.authoring.parts import (
    METRIC,
    NUMBER,
    bad_input_accepted,
    cut_from_graph,
    drawing,
    dtype_lost,
    in_place,
    integers,
    loud_padding,
    normal,
    number,
    one_shape,
    python_float,
    refused,
    reshaped,
    satisfies,
    uniform,
    versions_of,
    wrong,
)
from autograder.authoring.spec import Case, Exercise, Misconception
from course_lib.checks.cases import built
from solutions import ch80

# ------------------------------------------------------------------------------------------------------- inputs


def _lengths_to_mask(lengths, steps):
    return torch.arange(steps) < lengths[:, None]


@drawing
def _segments(generator, batch=6, steps=9, full=False):
    """Segments of unequal length, padded behind with numbers that would be noticed."""
    lengths = integers(generator, 2, steps, batch)
    mask = torch.ones(batch, steps, dtype=torch.bool) if full else _lengths_to_mask(lengths, steps)
    rewards = 0.5 + normal(generator, batch, steps)
    return {"rewards": torch.where(mask, rewards, 3 + rewards), "mask": mask}


def _padded_in_front(generator):
    drawn = _segments()(generator)
    return {name: value.flip(1) for name, value in drawn.items()}


def _holes(generator):
    drawn = _segments()(generator)
    mask = torch.rand(6, 9, generator=generator) < 0.6
    mask[:, 0], mask[:, 4], mask[:, 7] = True, False, True
    return drawn | {"mask": mask}


def _empty_segment(generator):
    """One segment has no step at all."""
    drawn = _segments()(generator)
    drawn["mask"][2] = False
    return drawn


_EQUAL_REWARDS = reshaped(_segments(), "rewards", lambda rewards: torch.full_like(rewards, 2.0))


@drawing
def _returns(generator, spread=1.5, size=33, level=0.0, first="returns_a", second="returns_b", lead=0.0):
    """Returns of `size` pairs around `level`, the first of each pair ahead by `lead` on average."""
    drawn = level + spread * normal(generator, 2, size)
    return {first: drawn[0] + lead, second: drawn[1]}


@drawing
def _gaps(generator, *gaps, first="returns_a", second="returns_b"):
    """Pairs with exactly these gaps."""
    returns = integers(generator, -4, 5, len(gaps)).double()  # whole numbers: the gaps stay exact
    return {first: returns + torch.tensor(gaps, dtype=torch.float64), second: returns}


def _choices(**settings):
    return _returns(first="chosen_returns", second="rejected_returns", lead=0.7, **settings)


def _choice_gaps(*gaps):
    return _gaps(*gaps, first="chosen_returns", second="rejected_returns")


def _shape_cases(names, inputs):
    """A column broadcasts silently to a table of all pairs; a batch that is too short fails later and elsewhere."""
    column, short = (lambda x: x[:, None]), (lambda x: x[:-1])
    return (
        Case(f"{names[1]} as a column", reshaped(inputs, names[1], column), raises=names, visible=True, draws=1),
        Case(f"{names[0]} as a column", reshaped(inputs, names[0], column), raises=names, draws=1),
        Case(f"{names[1]} of one entry", reshaped(inputs, names[1], lambda x: x[:1]), raises=names, draws=1),
        Case(f"{names[1]} with an entry too few", reshaped(inputs, names[1], short), raises=names, draws=1),
    )


_REVERSED = "The order is reversed: the gap is the first argument minus the second."
_ONE_MASK_FOR_ALL = "A mask of one row or column broadcasts silently over all segments: compare the shapes first."

# ----------------------------------------------------------------------------------------------- segment_returns

_STEPS = ("rewards", "mask")
_masked = versions_of(ch80.segment_returns, one_shape(*_STEPS))


def _sum_in_python(rewards, mask):
    returns = []
    for row, kept in zip(rewards, mask.tolist(), strict=True):
        total = row.new_zeros(())
        for reward, keep in zip(row, kept, strict=True):
            total = total + reward if keep else total
        returns.append(total)
    return torch.stack(returns)


def _scattered(r, m):
    rows, _ = torch.nonzero(m, as_tuple=True)
    return r.new_zeros(len(r)).index_add(0, rows, r[m])


def _last_kept(r, m):
    last = m.shape[1] - 1 - m.flip(1).int().argmax(1)
    return torch.where(m.any(1), r.gather(1, last[:, None])[:, 0], 0)


_WRONG_SEGMENT_RETURNS = {
    "mask-ignored": (lambda r, m: r.sum(-1), "The padding is added as well: use the mask."),
    "mask-inverted": (lambda r, m: (r * ~m).sum(-1), "This adds up the padding: True marks the steps to keep."),
    "mean-instead-of-sum": (
        lambda r, m: (r * m).sum(-1) / m.sum(-1).clamp(min=1),
        "A mean forgets how long a segment is: ten good steps are worth more than one. Sum the kept rewards.",
    ),
    "mean-over-padded-length": (
        lambda r, m: (r * m).mean(-1),
        "Dividing by the padded length T rescales the returns, and with them what a gap of 1 means: sum instead.",
    ),
    "padding-assumed-behind": (
        lambda r, m: (r * _lengths_to_mask(m.sum(-1), m.shape[1])).sum(-1),
        "The first mask.sum() steps are taken, wherever the kept ones are: select by the mask itself.",
    ),
    "last-reward-only": (_last_kept, "Only the last kept reward counts here: sum them all."),
    "discounted": (
        lambda r, m: (r * m * 0.99 ** torch.arange(r.shape[1], dtype=r.dtype)).sum(-1),
        "No discount here: a segment's return is the plain sum.",
    ),
    "summed-over-segments": (
        lambda r, m: (r * m).sum(0),
        "This adds up different segments, step by step: sum over the last axis.",
    ),
    "one-sum-for-all": (
        lambda r, m: r[m].sum(),
        "rewards[mask] is flat and forgets which segment a reward belongs to: set padding to 0, then sum each row.",
    ),
}

SEGMENT_RETURNS = Exercise(
    name="segment_returns",
    reference=ch80.segment_returns,
    criteria={"values": 0.6, "gradient": 0.2, "dtype": 0.05, "inputs": 0.05, "errors": 0.1},
    axes=("segment",),
    cases=(
        Case("segments of unequal length", _segments(), closed_form=_sum_in_python, visible=True, draws=3),
        Case("segments of full length", _segments(full=True), closed_form=lambda rewards, mask: rewards.sum(-1), visible=True),
        Case("padding in front", _padded_in_front, closed_form=_sum_in_python, visible=True),
        Case("steps left out in the middle", _holes, closed_form=_sum_in_python),
        Case("a segment without steps", _empty_segment, closed_form=_sum_in_python, visible=True),
        Case("one segment", _segments(batch=1), closed_form=_sum_in_python),
        Case("rewards that require gradient", _segments(), differentiate=["rewards"], visible=True),
        Case("gradient where padding holds ±10,000", loud_padding(_segments(), "rewards"), differentiate=["rewards"], draws=1),
        Case("single precision", _segments(), dtype=torch.float32, visible=True),
        Case("mask of one row", reshaped(_segments(), "mask", lambda m: m[0]), raises=_STEPS, visible=True, draws=1),
        Case("mask of one column", reshaped(_segments(), "mask", lambda m: m[:, :1]), raises=_STEPS, draws=1),
        Case("mask with a step too few", reshaped(_segments(), "mask", lambda m: m[:, 1:]), raises=_STEPS, draws=1),
    ),
    misconceptions=(
        *wrong(_WRONG_SEGMENT_RETURNS, _masked),
        cut_from_graph(ch80.segment_returns),
        dtype_lost(ch80.segment_returns),
        in_place(ch80.segment_returns, "rewards"),
        bad_input_accepted(
            _masked(lambda r, m: r[:, -m.shape[-1] :].masked_fill(~m, 0).sum(-1), checked=False),
            _ONE_MASK_FOR_ALL,
        ),
    ),
    variants={
        "product with the mask": _masked(lambda r, m: (r * m).sum(-1)),
        "torch.where": _masked(lambda r, m: torch.where(m, r, torch.zeros_like(r)).sum(dim=1)),
        "one number at a time": _masked(_sum_in_python),
        "index_add": _masked(_scattered),
        "einsum in double precision": _masked(lambda r, m: torch.einsum("bt,bt->b", r.double(), m.double()).to(r.dtype)),
    },
)

# ---------------------------------------------------------------------------------------- preference_probability

_PAIR = ("returns_a", "returns_b")
_pair = versions_of(ch80.preference_probability, one_shape(*_PAIR))


def _odds_by_hand(returns_a, returns_b):
    return torch.tensor(
        [1 / (1 + math.exp(b - a)) for a, b in zip(returns_a.tolist(), returns_b.tolist(), strict=True)], dtype=torch.float64
    )


_WRONG_PREFERENCE_PROBABILITY = {
    "order-reversed": (lambda a, b: torch.sigmoid(b - a), _REVERSED),
    "exponentials-divided": (
        lambda a, b: a.exp() / (a.exp() + b.exp()),
        "Right on paper, but exp(1000) is infinite and the quotient NaN: only the difference of the returns matters, so form it first.",
    ),
    "returns-divided": (
        lambda a, b: a / (a + b),
        "a / (a + b) is the model for positive strengths; a return may be negative. The strengths are exp(return).",
    ),
    "certain-choice": (
        lambda a, b: (a > b).to(a.dtype),
        "A person errs where two segments are nearly alike: the answer is a probability, not a decision.",
    ),
    "difference-only": (lambda a, b: a - b, "This is the log-odds: the probability is its sigmoid."),
    "log-probability": (lambda a, b: F.logsigmoid(a - b), "This is the logarithm of the probability."),
    "second-return-ignored": (lambda a, b: torch.sigmoid(a), "A return says nothing alone: compare it with the other."),
    "tanh-instead-of-sigmoid": (
        lambda a, b: torch.tanh(a - b),
        "tanh runs from -1 to 1: a tie must give one half, which the sigmoid does.",
    ),
    "normal-instead-of-logistic": (
        lambda a, b: torch.special.ndtr(a - b),
        "This is Thurstone's model (normal noise on each side). Bradley and Terry's is logistic: odds of exp(a - b).",
    ),
    "softmax-over-batch": (
        lambda a, b: torch.softmax(a - b, dim=0),
        "The pairs compete with one another here: the softmax runs over the two segments of a pair, not over the batch.",
    ),
}

PREFERENCE_PROBABILITY = Exercise(
    name="preference_probability",
    reference=ch80.preference_probability,
    criteria={"values": 0.65, "gradient": 0.15, "dtype": 0.05, "inputs": 0.05, "errors": 0.1},
    axes=("pair",),
    cases=(
        Case("a batch of pairs", _returns(), closed_form=_odds_by_hand, visible=True, draws=3),
        Case("equal returns: a coin", _gaps(0.0, 0.0, 0.0), closed_form=number(0.5, 0.5, 0.5), visible=True),
        Case(
            "gaps of log 3: three to one, either way",
            _gaps(math.log(3), -math.log(3)),
            closed_form=number(0.75, 0.25),
            visible=True,
        ),
        Case("gaps of ±1000", _gaps(1000.0, -1000.0), visible=True),
        Case("large returns, small gaps", _returns(level=2000.0), closed_form=_odds_by_hand, visible=True),
        Case("negative returns", _returns(level=-50.0), closed_form=_odds_by_hand),
        Case("both inputs require gradient", _returns(), differentiate=_PAIR, visible=True),
        Case("gradient where the returns are equal", _gaps(0.0, 0.0), differentiate=_PAIR),
        Case("single precision", _returns(), dtype=torch.float32, visible=True),
        *_shape_cases(_PAIR, _returns()),
    ),
    misconceptions=(
        *wrong(_WRONG_PREFERENCE_PROBABILITY, _pair),
        cut_from_graph(ch80.preference_probability),
        dtype_lost(ch80.preference_probability),
        in_place(ch80.preference_probability, "returns_a"),
        bad_input_accepted(
            _pair(lambda a, b: torch.sigmoid(a[: len(b)] - b[: len(a)]) if len(b) > 1 else torch.sigmoid(a - b), checked=False)
        ),
    ),
    variants={
        "softmax over the two": _pair(lambda a, b: torch.stack([a, b]).softmax(0)[0]),
        "quotient with the difference": _pair(lambda a, b: (1 + (b - a).exp()).reciprocal()),
        "exponential of logsigmoid": _pair(lambda a, b: F.logsigmoid(a - b).exp()),
        "tanh of half the difference": _pair(lambda a, b: (1 + torch.tanh((a - b) / 2)) / 2),
        "log-sum-exp in double precision": _pair(
            lambda a, b: (a.double() - torch.logaddexp(a.double(), b.double())).exp().to(a.dtype)
        ),
    },
)

# -------------------------------------------------------------------------------------------- bradley_terry_loss

_CHOICE = ("chosen_returns", "rejected_returns")
_choice = versions_of(ch80.bradley_terry_loss, one_shape(*_CHOICE))


def _loss_by_hand(chosen_returns, rejected_returns):
    losses = []
    for gap in (chosen_returns - rejected_returns).tolist():
        losses.append(math.log1p(math.exp(-abs(gap))) + max(-gap, 0.0))
    return torch.tensor(sum(losses) / len(losses), dtype=torch.float64)


def _sum_or_all_pairs(c, r):
    """What a broadcast of bad shapes gives, without complaint."""
    count = min(c.shape[0], r.shape[0]) if r.shape[0] > 1 else None
    return -F.logsigmoid(c[:count] - r[:count]).mean()


def _by_pairs(c, r):
    losses = [torch.logaddexp(chosen, rejected) - chosen for chosen, rejected in zip(c, r, strict=True)]
    return sum(losses) / len(losses)


_WRONG_BRADLEY_TERRY_LOSS = {
    "sign-missing": (
        lambda c, r: F.logsigmoid(c - r).mean(),
        "This is the log-likelihood, which is to be made large: a loss is minus that.",
    ),
    "order-reversed": (
        lambda c, r: -F.logsigmoid(r - c).mean(),
        "It rewards the model for disliking what was chosen: the gap is chosen minus rejected.",
    ),
    "sum-instead-of-mean": (
        lambda c, r: -F.logsigmoid(c - r).sum(),
        "A sum grows with the batch, and with it the step: take the mean over the pairs.",
    ),
    "not-averaged": (lambda c, r: -F.logsigmoid(c - r), "One loss for each pair comes back: take their mean."),
    "overflow": (
        lambda c, r: -torch.sigmoid(c - r).log().mean(),
        "Where the model is very wrong this is infinite and its gradient NaN: sigmoid(-1000) is 0, and its logarithm "
        "-inf (likewise log(1 + exp(1000))). F.logsigmoid takes both in one step.",
    ),
    "exponentials-divided": (
        lambda c, r: -(c.exp() / (c.exp() + r.exp())).log().mean(),
        "exp of a return of 1000 is infinite and the quotient NaN: form the difference of the returns first.",
    ),
    "probability-clamped": (
        lambda c, r: -torch.sigmoid(c - r).clamp(min=1e-8).log().mean(),
        "A probability kept away from 0 (by clamp or + 1e-8) caps the loss and stops the gradient just where the model "
        "is most wrong. F.logsigmoid needs no such help.",
    ),
    "gap-clipped": (
        lambda c, r: -F.logsigmoid((c - r).clamp(-20, 20)).mean(),
        "Clipping the gap caps the loss and stops the gradient just where the model is most wrong.",
    ),
    "no-gradient-at-zero": (
        lambda c, r: (torch.relu(r - c) + torch.log1p(torch.exp(-(c - r).abs()))).mean(),
        "The values are right, but at a gap of exactly 0 both relu and abs have gradient 0 in PyTorch: a model that starts "
        "with equal returns never moves. F.softplus(-x) or F.logsigmoid(x) are right there.",
    ),
    "probability-not-its-logarithm": (
        lambda c, r: (1 - torch.sigmoid(c - r)).mean(),
        "This is the expected number of mistakes. The likelihood's logarithm punishes confident mistakes much more.",
    ),
    "hinge": (
        lambda c, r: torch.relu(1 - (c - r)).mean(),
        "This is a hinge loss, which asks for a margin of 1 and then stops. Bradley-Terry never quite stops.",
    ),
    "share-of-mistakes": (
        lambda c, r: (c < r).to(c.dtype).mean(),
        "Counting mistakes passes no gradient: use the log-likelihood.",
    ),
    "segments-scored-apart": (
        lambda c, r: -(F.logsigmoid(c) + F.logsigmoid(-r)).mean(),
        "This classifies each segment as good or bad. A comparison says nothing of the level: only the gap may enter.",
    ),
    "mean-of-gaps-first": (
        lambda c, r: -F.logsigmoid((c - r).mean()),
        "The mean comes last: the average gap hides the pairs that the model has wrong.",
    ),
    "mean-of-probabilities-first": (
        lambda c, r: -torch.sigmoid(c - r).mean().log(),
        "Independent choices multiply: take each pair's logarithm, then the mean.",
    ),
    "base-two": (lambda c, r: -F.logsigmoid(c - r).mean() / math.log(2), "This is in bits: use the natural logarithm."),
    "rejected-detached": (
        lambda c, r: -F.logsigmoid(c - r.detach()).mean(),
        "Both segments were scored by the model that learns: the rejected returns need their gradient, too.",
    ),
    "chosen-detached": (
        lambda c, r: -F.logsigmoid(c.detach() - r).mean(),
        "Both segments were scored by the model that learns: the chosen returns need their gradient, too.",
    ),
}

BRADLEY_TERRY_LOSS = Exercise(
    name="bradley_terry_loss",
    reference=ch80.bradley_terry_loss,
    criteria={"values": 1.5, "gradient": 1.0, "dtype": 0.1, "inputs": 0.1, "errors": 0.3},
    cases=(
        Case("a batch of choices", _choices(), closed_form=_loss_by_hand, visible=True),
        Case(
            "a model that sees no difference: log 2",
            _choice_gaps(0.0, 0.0, 0.0),
            closed_form=number(math.log(2)),
            visible=True,
            draws=1,
        ),
        Case("one choice, against the model", _choice_gaps(-2.0), closed_form=_loss_by_hand, visible=True, draws=1),
        Case("a gap of +1000: nothing to learn", _choice_gaps(1000.0), closed_form=number(0.0), visible=True, draws=1),
        Case("a gap of -1000: a loss of 1000", _choice_gaps(-1000.0), closed_form=number(1000.0), visible=True, draws=1),
        Case("gaps of ±30", _choice_gaps(30.0, -30.0, 30.0), closed_form=_loss_by_hand, draws=1),
        Case("large returns, small gaps", _choices(level=2000.0), closed_form=_loss_by_hand, visible=True, draws=1),
        Case("both inputs require gradient", _choices(), differentiate=_CHOICE, visible=True, draws=1),
        Case("gradient at a gap of exactly 0", _choice_gaps(0.0, 0.0, 0.0), differentiate=_CHOICE, visible=True, draws=1),
        Case("gradient at a gap of -1000", _choice_gaps(-1000.0, 1.0), differentiate=_CHOICE, visible=True, draws=1),
        Case("gradient at a gap of +1000", _choice_gaps(1000.0, 1.0), differentiate=_CHOICE, draws=1),
        Case("single precision", _choices(), dtype=torch.float32, visible=True, draws=1),
        Case("single precision, gaps of ±1000 and 0", _choice_gaps(1000.0, -1000.0, 0.0), dtype=torch.float32, draws=1),
        *_shape_cases(_CHOICE, _choices()),
    ),
    misconceptions=(
        *wrong(_WRONG_BRADLEY_TERRY_LOSS, _choice),
        cut_from_graph(ch80.bradley_terry_loss),
        dtype_lost(ch80.bradley_terry_loss),
        python_float(ch80.bradley_terry_loss),
        in_place(ch80.bradley_terry_loss, "chosen_returns"),
        bad_input_accepted(_choice(_sum_or_all_pairs, checked=False)),
    ),
    variants={
        "softplus of the negated gap": _choice(lambda c, r: F.softplus(r - c).mean()),
        "binary cross-entropy with logits": _choice(lambda c, r: F.binary_cross_entropy_with_logits(c - r, torch.ones_like(c))),
        "cross-entropy of two logits": _choice(
            lambda c, r: F.cross_entropy(torch.stack([c, r], dim=1), torch.zeros(len(c), dtype=torch.int64))
        ),
        "log-sum-exp": _choice(lambda c, r: (torch.logaddexp(c, r) - c).mean()),
        "pair by pair, in double precision": _choice(lambda c, r: _by_pairs(c.double(), r.double()).to(c.dtype)),
    },
)

# ------------------------------------------------------------------------------------------- preference_accuracy


def _counted(returns, others):
    hits = sum(c > r for c, r in zip(returns.tolist(), others.tolist(), strict=True))
    return torch.tensor(hits / len(returns), dtype=returns.dtype)


def _both_positive_and_negative(generator):
    """Pairs on either side of zero and across it, so that the sign of a return alone decides nothing."""
    drawn = _choices(spread=2.0)(generator)
    extra = torch.tensor([5.0, 5.0, 6.0, -5.0, -6.0, 1.0], dtype=torch.float64)
    other = torch.tensor([4.0, 6.0, 5.0, -6.0, -5.0, -1.0], dtype=torch.float64)
    return {name: torch.cat([drawn[name], more]) for name, more in zip(_CHOICE, (extra, other), strict=True)}


_WRONG_PREFERENCE_ACCURACY = {
    "order-reversed": (
        lambda c, r: (c < r).to(c.dtype).mean(),
        "This counts the mistakes: the chosen segment should have the larger return.",
    ),
    "count-instead-of-share": (lambda c, r: (c > r).to(c.dtype).sum(), "A count grows with the batch: take the mean."),
    "percent": (lambda c, r: 100 * (c > r).to(c.dtype).mean(), "Return a share between 0 and 1, not per cent."),
    "mean-sign": (
        lambda c, r: (c - r).sign().mean(),
        "The mean sign runs from -1 to 1: a coin would score 0 instead of one half.",
    ),
    "mean-probability": (
        lambda c, r: torch.sigmoid(c - r).mean().detach(),
        "This is how sure the model is, not how often it is right: compare, then take the mean.",
    ),
    "chosen-positive": (
        lambda c, r: (c > 0).to(c.dtype).mean(),
        "The sign of a return means nothing, its level is arbitrary: compare the two of a pair.",
    ),
    "all-or-nothing": (lambda c, r: (c > r).all().to(c.dtype), "One miss spoils it all here: take the mean."),
    "means-compared": (
        lambda c, r: (c.mean() > r.mean()).to(c.dtype),
        "The averages are compared: compare pair by pair, then take the mean.",
    ),
    "all-pairs-compared": (
        lambda c, r: (c[:, None] > r).to(c.dtype).mean(),
        "Every chosen segment is compared with every rejected one: only those of one pair were ever compared.",
    ),
}

PREFERENCE_ACCURACY = Exercise(
    name="preference_accuracy",
    reference=ch80.preference_accuracy,
    criteria={"values": 0.7, "gradient": 0.05, "dtype": 0.1, "inputs": 0.05, "errors": 0.1},
    cases=(
        Case("a batch of choices", _both_positive_and_negative, closed_form=_counted, visible=True, draws=3),
        Case("every choice foreseen", _choice_gaps(1.0, 2.0, 0.5), closed_form=_counted, visible=True),
        Case("no choice foreseen", _choice_gaps(-1.0, -2.0), closed_form=_counted, visible=True),
        Case("three of four", _choice_gaps(1.0, -9.0, 2.0, 0.5), closed_form=_counted, visible=True),
        Case("one choice", _choice_gaps(3.0), closed_form=_counted),
        Case("returns of a thousand", _choices(level=1000.0), closed_form=_counted),
        Case("both inputs require gradient", _choices(), differentiate=_CHOICE, visible=True),
        Case("single precision", _both_positive_and_negative, dtype=torch.float32, visible=True),
        *_shape_cases(_CHOICE, _choices()),
    ),
    misconceptions=(
        *wrong(_WRONG_PREFERENCE_ACCURACY, _choice),
        dtype_lost(ch80.preference_accuracy),
        Misconception("graph-kept", _choice(lambda c, r: (c > r).to(c.dtype).mean() + 0 * (c - r).sum()), METRIC),
        python_float(ch80.preference_accuracy, NUMBER),
        in_place(ch80.preference_accuracy, "chosen_returns"),
        bad_input_accepted(_choice(lambda c, r: (c[: len(r) if len(r) > 1 else None] > r).to(c.dtype).mean(), checked=False)),
    ),
    variants={
        "one number at a time": _choice(_counted),
        "sign of the gap": _choice(lambda c, r: (c - r).detach().sign().clamp(min=0).mean()),
        "one minus the mistakes": _choice(lambda c, r: 1 - torch.le(c, r).to(c.dtype).mean()),
        "count_nonzero": _choice(lambda c, r: torch.count_nonzero(c > r).to(c.dtype) / c.numel()),
        "NumPy": _choice(lambda c, r: torch.tensor(np.mean(c.detach().numpy() > r.detach().numpy()), dtype=c.dtype)),
    },
)

# ------------------------------------------------------------------------------------------- standardize_rewards

_standardised = versions_of(ch80.standardize_rewards, one_shape(*_STEPS))


def _scaled(r, m, mean, deviation, eps):
    return ((r - mean) / (deviation + eps)).masked_fill(~m, 0)


def _per_axis(axis):
    def formula(r, m, eps):
        count = m.sum(axis, keepdim=True).clamp(min=1)
        mean = (r * m).sum(axis, keepdim=True) / count
        deviation = (((r - mean) * m).square().sum(axis, keepdim=True) / count).sqrt()
        return _scaled(r, m, mean, deviation, eps)

    return formula


def _standardised_by_sums(r, m, eps):
    count = m.sum()
    mean = (r * m).sum() / count
    variance = ((r - mean).square() * m).sum() / count
    return (r - mean) * m / (variance + eps * eps).sqrt()


def _standardised_in_python(r, m, eps):
    kept = [x for x, keep in zip(r.flatten().tolist(), m.flatten().tolist(), strict=True) if keep]
    mean = sum(kept) / len(kept)
    deviation = math.sqrt(sum((x - mean) ** 2 for x in kept) / (len(kept) - 1))
    out = [
        (x - mean) / (deviation + eps) if keep else 0.0
        for x, keep in zip(r.flatten().tolist(), m.flatten().tolist(), strict=True)
    ]
    return torch.tensor(out, dtype=r.dtype).reshape(r.shape)


def _standardised_scatter(r, m, eps):
    kept = r[m]
    return torch.zeros_like(r).masked_scatter(m, (kept - kept.mean()) / torch.sqrt(kept.var() + eps * eps))


def _standardised_numpy(r, m, eps):
    kept = np.ma.array(r.detach().double().numpy(), mask=~m.numpy())
    return torch.from_numpy(((kept - kept.mean()) / (kept.std() + eps)).filled(0.0)).to(r.dtype)


def _biased(r, m, eps):
    """The other right answer: the biased deviation."""
    return _scaled(r, m, r[m].mean(), r[m].std(unbiased=False), eps)


_WRONG_STANDARDIZE_REWARDS = {
    "mask-ignored-in-statistics": (
        lambda r, m, eps: _scaled(r, m, r.mean(), r.std(), eps),
        "The padding shifts mean and deviation: take both over the kept steps only, rewards[mask].",
    ),
    "padding-counted-as-zeros": (
        lambda r, m, eps: _scaled(r, m, (r * m).mean(), (r * m).std(), eps),
        "Padding set to 0 still counts as a reward of 0 in mean and deviation: take both over rewards[mask].",
    ),
    "padding-not-zeroed": (
        lambda r, m, eps: (r - r[m].mean()) / (r[m].std() + eps),
        "The statistics are right, but the padding comes back with numbers in it: it must be 0.",
    ),
    "standardised-per-segment": (
        _per_axis(1),
        "Each segment is standardised for itself, so that all have return 0 and nothing is left to compare: take the "
        "statistics over all kept steps of the batch.",
    ),
    "standardised-per-step": (
        _per_axis(0),
        "Each time step is standardised for itself: take the statistics over all kept steps of the batch.",
    ),
    "mean-not-subtracted": (
        lambda r, m, eps: _scaled(r, m, 0, r[m].std(), eps),
        "The level is still there: subtract the mean over the kept steps.",
    ),
    "deviation-not-divided": (
        lambda r, m, eps: _scaled(r, m, r[m].mean(), 1, 0),
        "Centred, but still in the model's unit: divide by the standard deviation.",
    ),
    "variance-instead-of-deviation": (
        lambda r, m, eps: _scaled(r, m, r[m].mean(), r[m].var(), eps),
        "The divisor is the variance: take its square root.",
    ),
    "scaled-to-unit-range": (
        lambda r, m, eps: _scaled(r, m, r[m].min(), r[m].max() - r[m].min(), eps),
        "This maps to [0, 1]: use mean and standard deviation.",
    ),
    "eps-missing": (
        lambda r, m, eps: _scaled(r, m, r[m].mean(), r[m].std(), 0),
        "When all rewards are equal this is 0 / 0: eps belongs in the denominator.",
    ),
    "kept-steps-only": (
        lambda r, m, eps: (r[m] - r[m].mean()) / (r[m].std() + eps),
        "rewards[mask] is flat: put the numbers back into their places, (B, T), with 0 in the padding.",
    ),
}

STANDARDIZE_REWARDS = Exercise(
    name="standardize_rewards",
    reference=ch80.standardize_rewards,
    also_right=(_standardised(_biased),),
    criteria={"values": 0.75, "dtype": 0.05, "inputs": 0.1, "errors": 0.1},
    axes=("segment", "t"),
    cases=(
        Case("segments of unequal length", _segments(), visible=True, draws=3),
        Case("segments of full length", _segments(full=True), visible=True),
        Case("padding in front", _padded_in_front),
        Case("steps left out in the middle", _holes, visible=True),
        Case("a segment without steps", _empty_segment, visible=True),
        Case(
            "all rewards equal: zero everywhere",
            _EQUAL_REWARDS,
            closed_form=lambda rewards, mask: torch.zeros_like(rewards),
            visible=True,
        ),
        Case("single precision", _segments(), dtype=torch.float32, visible=True),
        Case("mask of one row", reshaped(_segments(), "mask", lambda m: m[:1]), raises=_STEPS, visible=True, draws=1),
        Case("mask with a step too few", reshaped(_segments(), "mask", lambda m: m[:, 1:]), raises=_STEPS, draws=1),
    ),
    misconceptions=(
        *wrong(_WRONG_STANDARDIZE_REWARDS, _standardised),
        dtype_lost(ch80.standardize_rewards),
        in_place(ch80.standardize_rewards, "rewards"),
        bad_input_accepted(
            _standardised(
                lambda r, m, eps: ch80.standardize_rewards(r[:, -m.shape[1] :], m.expand(len(r), -1), eps), checked=False
            ),
            _ONE_MASK_FOR_ALL,
        ),
    ),
    variants={
        "sums written out, biased deviation": _standardised(_standardised_by_sums),
        "one number at a time": _standardised(_standardised_in_python),
        "scattered back into zeros": _standardised(_standardised_scatter),
        "NumPy's masked arrays": _standardised(_standardised_numpy),
        "torch.where, in double precision": _standardised(
            lambda r, m, eps: torch.where(
                m, (r.double() - r[m].double().mean()) / (r[m].double().std() + eps), torch.zeros((), dtype=torch.float64)
            ).to(r.dtype)
        ),
    },
)

# ------------------------------------------------------------------------------------------ simulate_preferences

_ANSWERS = ("true_returns_a", "true_returns_b")
_PER_GROUP = 5000
_SPREAD = 0.06
"""Six standard deviations of the difference between two frequencies of _PER_GROUP answers each."""


@drawing
def _groups(generator, *gaps, temperature=1.0, level=0.0):
    """Many pairs for each of these gaps, so that frequencies can be told apart."""
    returns = level + integers(generator, -4, 5, len(gaps)).double()
    ahead = returns + torch.tensor(gaps, dtype=torch.float64)
    seed = int(torch.randint(2**31, (), generator=generator))
    return {
        "true_returns_a": ahead.repeat_interleave(_PER_GROUP),
        "true_returns_b": returns.repeat_interleave(_PER_GROUP),
        "temperature": temperature,
        "generator": built("seeding.generator", seed=seed),
    }


@drawing
def _few(generator, **changes):
    """A handful of pairs, which are enough for errors and for answers that are certain."""
    drawn = {name: 3 * normal(generator, 5) for name in _ANSWERS}
    return drawn | {"temperature": 1.0, "generator": built("seeding.generator", seed=1)} | changes


# gaps so large, for their temperature, that nobody errs, and the answers
_CERTAIN = _few(
    true_returns_a=torch.tensor([1000.0, -1000.0, 3.0, 2.0, -60.0], dtype=torch.float64),
    true_returns_b=torch.tensor([-1000.0, 1000.0, 2.0, 3.0, 60.0], dtype=torch.float64),
    temperature=0.01,
)
_CHOSEN = torch.tensor([True, False, True, False, False])
_answers = versions_of(ch80.simulate_preferences, one_shape(*_ANSWERS), satisfies(lambda temperature: temperature > 0))


def _uniform(x, generator):
    return torch.rand(x.shape, generator=generator, dtype=x.dtype)


def _with_probability(probability):
    return lambda a, b, t, g: _uniform(a, g) < probability(a, b, t)


def _gumbel(x, generator):
    return -torch.empty_like(x).exponential_(generator=generator).log()


def _by_numpy(a, b, t, g):
    rng = np.random.default_rng(int(torch.randint(2**62, (), generator=g)))
    with np.errstate(over="ignore"):
        probability = 1 / (1 + np.exp((b - a).double().numpy() / t))
    return torch.from_numpy(rng.random(len(a)) < probability)


_FREQUENCIES: dict[str, Any] = {"view": "group_frequencies", "atol": _SPREAD}

_WRONG_SIMULATE_PREFERENCES = {
    "temperature-ignored": (
        _with_probability(lambda a, b, t: torch.sigmoid(a - b)),
        "The person is as sure as at temperature 1, whatever the argument says: divide the gap by the temperature.",
    ),
    "temperature-multiplied": (
        _with_probability(lambda a, b, t: torch.sigmoid((a - b) * t)),
        "A hot person errs more, not less: divide the gap by the temperature.",
    ),
    "order-reversed": (
        _with_probability(lambda a, b, t: torch.sigmoid((b - a) / t)),
        "True should mean that a is preferred, which is likelier the better a is.",
    ),
    "never-mistaken": (
        lambda a, b, t, g: (_uniform(a, g) < 2) & (a > b),
        "The better segment always wins here, as when the probability is rounded: compare it with a random number, one for each pair.",
    ),
    "mistakes-whatever-the-gap": (
        lambda a, b, t, g: (a > b) ^ (_uniform(a, g) < 0.1),
        "One answer in ten is flipped, however clear the case: mistakes must grow rare as the gap grows.",
    ),
    "one-draw-for-all": (
        lambda a, b, t, g: torch.rand((), generator=g, dtype=a.dtype) < torch.sigmoid((a - b) / t),
        "All pairs share one random number, so that equal gaps get equal answers: draw one for each pair.",
    ),
    "normal-noise": (
        lambda a, b, t, g: a - b + t * torch.randn(a.shape, generator=g, dtype=a.dtype) > 0,
        "Normal noise on the gap gives Thurstone's model. The sigmoid is the distribution of logistic noise.",
    ),
    "uniform-noise": (
        lambda a, b, t, g: a - b + t * (2 * _uniform(a, g) - 1) > 0,
        "Uniform noise on the gap gives probabilities on a straight line that ends at a gap of one temperature; the sigmoid never ends.",
    ),
    "generator-ignored": (
        lambda a, b, t, g: torch.rand_like(a) < torch.sigmoid((a - b) / t),
        "The answers come from another source of randomness, so a seed does not fix them: pass generator=generator.",
    ),
    "seeded-inside": (
        lambda a, b, t, g: _uniform(a, torch.Generator().manual_seed(0)) < torch.sigmoid((a - b) / t),
        "A seed inside the function gives the same answers at every call: draw from the generator that is handed in.",
    ),
    "probabilities-returned": (
        lambda a, b, t, g: torch.sigmoid((a - b) / t) + 0 * _uniform(a, g),
        "These are the probabilities: draw the answers, as a bool tensor.",
    ),
}

SIMULATE_PREFERENCES = Exercise(
    name="simulate_preferences",
    reference=ch80.simulate_preferences,
    criteria={"values": 1.2, "dtype": 0.05, "inputs": 0.05, "errors": 0.2},
    axes=("group",),
    cases=(
        Case("5000 answers to each of five gaps", _groups(-2.0, -0.7, 0.0, 0.7, 2.0), **_FREQUENCIES, visible=True),
        Case("temperature 5", _groups(-5.0, 2.0, 5.0, temperature=5.0), **_FREQUENCIES, visible=True, draws=1),
        Case("temperature 0.25", _groups(-0.25, 0.1, 0.25, temperature=0.25), **_FREQUENCIES, draws=1),
        Case("returns around 1000", _groups(-1.0, 0.0, 1.0, level=1000.0), **_FREQUENCIES, visible=True, draws=1),
        Case("asked twice", _groups(0.0, 1.0), repeat=2, **_FREQUENCIES, visible=True, draws=1),
        Case("gaps that leave no doubt", _CERTAIN, closed_form=lambda **_given: _CHOSEN, visible=True, draws=1),
        Case("what is drawn from", _few(), returns=("generator",), view="drawn_from", visible=True, draws=1),
        Case("single precision", _groups(-1.0, 1.0), **_FREQUENCIES, dtype=torch.float32, draws=1),
        Case("temperature = 0", _few(temperature=0.0), raises=["temperature"], visible=True, draws=1),
        Case("temperature = -1", _few(temperature=-1.0), raises=["temperature"], draws=1),
        *_shape_cases(_ANSWERS, _few()),
    ),
    misconceptions=(
        *wrong(_WRONG_SIMULATE_PREFERENCES, _answers),
        in_place(ch80.simulate_preferences, "true_returns_a"),
        bad_input_accepted(
            _answers(
                lambda a, b, t, g: (
                    _uniform(a, g) < torch.sigmoid((a - b[: None if len(b) == 1 else len(a)]) / t)
                    if len(a) == len(b) or len(b) == 1
                    else _uniform(b, g) < torch.sigmoid((a[: len(b)] - b) / t)
                ),
                checked=False,
            ),
            "A temperature of 0 or less, and shapes that differ, must be refused: course_lib.validate raises errors that name them.",
        ),
    ),
    variants={
        "torch.bernoulli": _answers(lambda a, b, t, g: torch.bernoulli(torch.sigmoid((a - b) / t), generator=g).bool()),
        "logistic noise on the gap": _answers(lambda a, b, t, g: a - b + t * _uniform(a, g).logit(eps=1e-12) > 0),
        "Gumbel noise on both returns": _answers(lambda a, b, t, g: a / t + _gumbel(a, g) > b / t + _gumbel(b, g)),
        "a drawn index": _answers(
            lambda a, b, t, g: torch.multinomial((torch.stack([a, b], 1) / t).softmax(1), 1, generator=g)[:, 0] == 0
        ),
        "NumPy, seeded from the generator": _answers(_by_numpy),
    },
)

# ---------------------------------------------------------------------------------------------------- fit_reward_model


@drawing
def _compared(generator, pairs=6, held_out=(3, 1), epochs=7, batch_size=50, learning_rate=0.4, steps=4, alike=False):
    """Comparisons of numbered clips: in training the clip that lies further along one direction is always chosen. In those held out it
    is chosen `held_out[0]` times and rejected `held_out[1]` times, so that they are foreseen best by weights that are not too large.
    Where all pairs are alike, their order makes no difference."""
    direction = normal(generator, 3)
    direction = direction / direction.norm()

    def clips(first, count, sign, spread):
        lengths = integers(generator, 2, steps + 1, count)
        obs = spread * normal(generator, count, steps, 3)
        if alike:
            lengths, obs = lengths[:1].expand(count), obs[:1].repeat(count, 1, 1)
        mask = _lengths_to_mask(lengths, steps)
        obs += (sign.reshape(-1, 1) * direction / (2 * lengths[:, None]))[:, None]
        numbers = first + 2 * torch.arange(count, dtype=torch.float64)
        parts = {
            "obs": obs,
            "actions": numbers[:, None, None].expand(count, steps, 1).clone(),
            "rewards": torch.zeros(count, steps),
        }
        return built("control.clips.Segments", **parts, mask=mask)

    def sides(first, signs, spread):
        return [clips(first + side, len(signs), way * signs, spread) for side, way in enumerate((1, -1))]

    unseen = torch.tensor([1.0] * held_out[0] + [-1.0] * held_out[1], dtype=torch.float64)
    return {
        "scorer": built("control.clips.WatchedScorer", weights=0.05 * normal(generator, 3)),
        "training_pairs": sides(0, torch.ones(pairs, dtype=torch.float64), 0.05),
        "held_out_pairs": sides(2 * pairs, unseen, 0.0),
        "num_epochs": epochs,
        "batch_size": batch_size,
        "learning_rate": learning_rate,
        "generator": built("seeding.generator", seed=int(integers(generator, 0, 2**31, 1))),
    }


def _pair_loss(scorer, chosen, rejected):
    return ch80.bradley_terry_loss(scorer(chosen), scorer(rejected))


def _shuffled(pairs, size, generator):
    """An epoch's minibatches: rows of the chosen and of the rejected clips."""
    order = torch.randperm(pairs, generator=generator)
    return [(rows, rows) for rows in order.split(size)]


def _both_shuffled(pairs, size, generator):
    orders = (torch.randperm(pairs, generator=generator).split(size) for _ in range(2))
    return list(zip(*orders, strict=True))


def _drawn_again(pairs, size, generator):
    """Minibatches drawn with replacement; that a pair comes twice is made sure of."""
    drawn = [rows for rows, _ in _shuffled(pairs, size, generator)]
    drawn[-1] = drawn[0][: len(drawn[-1])]
    return [(rows, rows) for rows in drawn]


def _adamw(scorer, rate):
    return torch.optim.AdamW(scorer.parameters(), lr=rate)


def _smallest(losses):
    return min(range(len(losses)), key=lambda epoch: losses[epoch])


def _fitting(
    loss=_pair_loss,
    batches=_shuffled,
    optimizer=_adamw,
    anew="",
    clear=True,
    learned=lambda training, held_out: training,
    looked_at=lambda training, held_out: held_out,
    keep=lambda scorer: copy.deepcopy(scorer.state_dict()),
    pick=_smallest,
    trained=lambda scorer: scorer,
    told=torch.stack,
    graph=torch.no_grad,
    checked=True,
    epochs=None,
):
    """A version of the loop, from the places where it can go wrong."""

    def version(scorer, training_pairs, held_out_pairs, num_epochs, batch_size, learning_rate, generator):
        if checked and min(num_epochs, batch_size) < 1:
            raise ValueError("num_epochs and batch_size must be at least 1")
        scorer, batch_size = trained(scorer), max(batch_size, 1)
        chosen, rejected = learned(training_pairs, held_out_pairs)
        adam, losses, weights = optimizer(scorer, learning_rate), [], []

        def look():
            with graph():
                losses.append(_pair_loss(scorer, *looked_at(training_pairs, held_out_pairs)))
            weights.append(keep(scorer))

        look()
        for _ in range(num_epochs if epochs is None else epochs):
            if anew == "epoch":
                adam = optimizer(scorer, learning_rate)
            for rows, others in batches(len(chosen), batch_size, generator):
                if anew == "step":
                    adam = optimizer(scorer, learning_rate)
                value = loss(scorer, chosen[rows], rejected[others])
                if clear:
                    adam.zero_grad()
                value.backward()
                adam.step()
            look()
        scorer.load_state_dict(weights[pick(losses)])
        return told(losses)

    return version


class _SomePairs:
    """Clips of two sets, one behind the other."""

    def __init__(self, *parts):
        self.parts = parts

    def __len__(self):
        return sum(map(len, self.parts))

    def __getitem__(self, rows):
        from course_lib.control.clips import Segments

        names = ("obs", "actions", "rewards", "mask")
        return Segments(*(torch.cat([getattr(part, name) for part in self.parts])[rows] for name in names))


def _flat_loop(scorer, training_pairs, held_out_pairs, num_epochs, batch_size, learning_rate, generator):
    """A variant: one loop over all steps, slices of an order, the best weights as tensors of parameters."""
    if num_epochs < 1 or batch_size < 1:
        raise ValueError(f"num_epochs and batch_size must be at least 1, got {num_epochs}, {batch_size}")
    optimizer = torch.optim.AdamW(scorer.parameters(), lr=learning_rate)
    (chosen, rejected), held_out = training_pairs, held_out_pairs
    pairs, order, place = len(chosen), torch.arange(0), 0
    with torch.no_grad():
        losses = [F.softplus(scorer(held_out[1]) - scorer(held_out[0])).mean().item()]
    best = [parameter.detach().clone() for parameter in scorer.parameters()]
    while len(losses) <= num_epochs:
        if place >= len(order):
            order, place = torch.randperm(pairs, generator=generator), 0
        rows = order[place : place + batch_size]
        optimizer.zero_grad(set_to_none=False)
        F.softplus(scorer(rejected[rows]) - scorer(chosen[rows])).mean().backward()
        optimizer.step()
        place += batch_size
        if place >= pairs:
            with torch.inference_mode():
                losses.append(F.softplus(scorer(held_out[1]) - scorer(held_out[0])).mean().item())
            if losses[-1] < min(losses[:-1]):
                best = [parameter.detach().clone() for parameter in scorer.parameters()]
    with torch.no_grad():
        for parameter, kept in zip(scorer.parameters(), best, strict=True):
            parameter.copy_(kept)
    return torch.tensor(losses, dtype=torch.float64)


_FITTED: dict[str, Any] = {"returns": ("scorer",), "view": "weights_learned"}
_DIARY: dict[str, Any] = {"returns": ("scorer",), "view": "diary_of_training"}
_SMALL = {"pairs": 7, "batch_size": 3, "epochs": 4}

_WRONG_FIT_REWARD_MODEL = {
    "gradient-never-cleared": (
        _fitting(clear=False),
        "backward() adds to the gradient that is there, so each step repeats all those before: optimizer.zero_grad() in front of it.",
    ),
    "one-step-an-epoch": (
        _fitting(batches=lambda pairs, size, g: _shuffled(pairs, pairs, g)),
        "There is one step in each epoch: clear, backward and step belong to each minibatch of batch_size pairs.",
    ),
    "optimizer-anew-each-step": (
        _fitting(anew="step"),
        "A new AdamW for each minibatch has forgotten its averages, and makes a step of full length in every coordinate: make it once.",
    ),
    "optimizer-anew-each-epoch": (
        _fitting(anew="epoch"),
        "AdamW is made anew in each epoch, without its averages: make it once.",
    ),
    "sides-exchanged": (
        _fitting(loss=lambda scorer, chosen, rejected: _pair_loss(scorer, rejected, chosen)),
        "It learns to prefer what was rejected: the chosen clips' returns come first in the loss.",
    ),
    "uphill": (
        _fitting(loss=lambda *given: -_pair_loss(*given)),
        "The loss is made large: it is the negative log-likelihood already, so go down its gradient.",
    ),
    "last-minibatch-dropped": (
        _fitting(batches=lambda pairs, size, g: [two for two in _shuffled(pairs, size, g) if len(two[0]) == min(size, pairs)]),
        "The last minibatch of an epoch is left out where it is smaller: its pairs count as well.",
    ),
    "first-minibatch-only": (
        _fitting(batches=lambda *given: _shuffled(*given)[:1]),
        "Each epoch ends after its first minibatch: a return or break is one level too deep.",
    ),
    "one-epoch-only": (_fitting(epochs=1), "There is one epoch: num_epochs says how many."),
    "never-shuffled": (
        _fitting(batches=lambda pairs, size, g: [(rows, rows) for rows in torch.arange(pairs).split(size)]),
        "The pairs come in the order given: each epoch takes a fresh random one.",
    ),
    "one-order-for-all-epochs": (
        _fitting(batches=lambda pairs, size, g: _shuffled(pairs, size, torch.Generator().manual_seed(5))),
        "All epochs have one order, or it is not drawn from the generator that was handed in: draw a fresh one in each.",
    ),
    "drawn-with-replacement": (
        _fitting(batches=_drawn_again),
        "In an epoch some pairs come twice and others never: go through a permutation, not through independent draws.",
    ),
    "sides-shuffled-apart": (
        _fitting(batches=_both_shuffled),
        "Chosen and rejected clips are shuffled each for itself, so that clips meet that nobody has compared: use one order for both.",
    ),
    "held-out-trained-on": (
        _fitting(learned=lambda training, held_out: [_SomePairs(*both) for both in zip(training, held_out, strict=True)]),
        "The held-out pairs are learned from: their loss then says nothing about unseen ones.",
    ),
    "training-loss-watched": (
        _fitting(looked_at=lambda training, held_out: training),
        "The losses are those of the training pairs, which fall whatever is learned by heart: look at the held-out ones.",
    ),
    "weights-of-the-end": (
        _fitting(keep=lambda scorer: scorer.state_dict()),
        "The scorer ends with its last weights. If you did keep the best: state_dict() holds the tensors themselves, which later steps"
        " overwrite. Copy it, as copy.deepcopy does.",
    ),
    "start-never-kept": (
        _fitting(pick=lambda losses: 1 + _smallest(losses[1:])),
        "The weights before training take part, too: where training only harms, the scorer ends as it came.",
    ),
    "worst-kept": (
        _fitting(pick=lambda losses: max(range(len(losses)), key=lambda epoch: losses[epoch])),
        "These are the weights with the *largest* held-out loss.",
    ),
    "first-loss-missing": (
        _fitting(told=lambda losses: torch.stack(losses[1:])),
        "The loss before training is missing: the result has num_epochs + 1 entries.",
    ),
    "best-loss-only": (_fitting(told=min), "This is the smallest loss: return all of them, one for each look."),
    "copy-trained": (
        _fitting(trained=copy.deepcopy),
        "The scorer that was handed in has not changed: a copy was trained. Change it in place.",
    ),
    "no-weight-decay": (
        _fitting(optimizer=lambda scorer, rate: torch.optim.Adam(scorer.parameters(), lr=rate)),
        "Adam has no weight decay: torch.optim.AdamW is asked for.",
    ),
    "graph-kept": (
        _fitting(graph=torch.enable_grad),
        "The losses carry a graph each, and with it the whole scorer of that epoch: look under torch.no_grad().",
    ),
}

FIT_REWARD_MODEL = Exercise(
    name="fit_reward_model",
    reference=ch80.fit_reward_model,
    criteria={"values": 2.3, "gradient": 0.1, "errors": 0.1},
    cases=(
        Case("the weights, all pairs in one minibatch", _compared(), **_FITTED, visible=True, draws=1),
        Case("the held-out losses", _compared(), view="losses_seen", visible=True, draws=1),
        Case(
            "three minibatches of pairs that are all alike",
            _compared(epochs=3, batch_size=2, alike=True),
            **_FITTED,
            visible=True,
        ),
        Case("every epoch is better than the one before", _compared(epochs=2, learning_rate=0.1), **_FITTED, draws=1),
        Case("held-out pairs that say the opposite: as it came", _compared(held_out=(1, 3)), **_FITTED, visible=True, draws=1),
        Case("who is learned from, and when", _compared(**_SMALL), **_DIARY, visible=True, draws=1),
        Case("minibatches of one pair", _compared(pairs=5, batch_size=1, epochs=2), **_DIARY, draws=1),
        Case("minibatches that come out even", _compared(pairs=12, batch_size=4, epochs=3), **_DIARY, draws=1),
        Case("what is drawn from", _compared(**_SMALL), returns=("generator",), view="drawn_from", draws=1),
        refused(_compared(), num_epochs=0, visible=True),
        refused(_compared(), batch_size=0),
    ),
    misconceptions=(
        *wrong(_WRONG_FIT_REWARD_MODEL),
        bad_input_accepted(
            _fitting(checked=False), "num_epochs or batch_size of 0 asks for nothing: refuse it with a ValueError that names it."
        ),
    ),
    variants={
        "one loop over all steps": _flat_loop,
        "the loop with its parts": _fitting(),
        "cross-entropy of two logits": _fitting(
            loss=lambda scorer, *both: F.cross_entropy(
                torch.stack([scorer(side) for side in both], 1), torch.zeros(len(both[0]), dtype=torch.int64)
            )
        ),
        "all weights kept, losses as numbers": _fitting(
            told=lambda losses: torch.tensor([loss.item() for loss in losses]),
            keep=lambda scorer: {name: part.clone() for name, part in scorer.state_dict().items()},
            pick=lambda losses: int(torch.stack(losses).argmin()),
        ),
    },
)

# -------------------------------------------------------------------------------------- repaired_segment_returns

_LAB = ("obs", "mask")


@drawing
def _clips(generator, batch=6, steps=9, full=False, zeros=False, front=False):
    """Observations of unequal clips, padded with zeros or with noise, and a reward model that is not 0 at zero."""
    drawn = _segments(batch, steps, full)(generator)
    mask = drawn["mask"].flip(1) if front else drawn["mask"]
    obs = normal(generator, batch, steps, 3)
    model = built(
        "control.clips.QuadraticReward",
        linear=normal(generator, 3),
        quadratic=normal(generator, 3),
        bias=1 + uniform(generator, 1),
    )
    return {"reward_model": model, "obs": obs * mask.unsqueeze(-1) if zeros else obs, "mask": mask}


_learned = versions_of(ch80.repaired_segment_returns, satisfies(lambda obs, mask: obs.shape[:-1] == mask.shape))


def _learned_step_by_step(model, obs, mask):
    returns = []
    for clip, kept in zip(obs, mask, strict=True):
        returns.append(sum((model(clip[t]) for t in torch.nonzero(kept).flatten().tolist()), clip.new_zeros(())))
    return torch.stack(returns)


def _learned_kept_only(model, obs, mask):
    """The model never sees the padding."""
    rows, _ = torch.nonzero(mask, as_tuple=True)
    return obs.new_zeros(len(obs)).index_add(0, rows, model(obs[mask]))


def _learned_minus_padding(model, obs, mask):
    """Zero the padding, and take off again what the model gives for zeros."""
    zeroed = obs * mask.unsqueeze(-1)
    return model(zeroed).sum(1) - (~mask).sum(1) * model(torch.zeros_like(obs[0, 0]))


_WRONG_REPAIRED_SEGMENT_RETURNS = {
    "observations-masked": (
        lambda f, o, m: f(o * m.unsqueeze(-1)).sum(1),
        "This is the suspect program's own bug. What reward does a model with biases give for an observation of zeros, and "
        "how often is that added up in a short clip?",
    ),
    "mask-ignored": (lambda f, o, m: f(o).sum(1), "The padding is scored and added as well: use the mask."),
    "mask-inverted": (lambda f, o, m: (f(o) * ~m).sum(1), "This adds up the padding: True marks the steps to keep."),
    "mean-instead-of-sum": (
        lambda f, o, m: (f(o) * m).sum(1) / m.sum(1),
        "The length of a clip is forgotten, and it is what these comparisons are about: sum, do not average.",
    ),
    "mean-over-padded-length": (
        lambda f, o, m: (f(o) * m).mean(1),
        "Dividing by the padded length changes the unit of the returns: sum, do not average.",
    ),
    "observations-masked-and-averaged": (
        lambda f, o, m: f(o * m.unsqueeze(-1)).sum(1) / m.sum(1),
        "The padding still enters, as an observation of zeros, and the sum has become a mean: mask the rewards, then sum.",
    ),
    "model-of-the-sum": (
        lambda f, o, m: f((o * m.unsqueeze(-1)).sum(1)),
        "The reward of a sum of observations is not the sum of their rewards: score each step first.",
    ),
    "rewards-per-step": (
        lambda f, o, m: f(o).masked_fill(~m, 0),
        "These are the rewards, (B, T), rightly masked: a clip's return is their sum.",
    ),
}

REPAIRED_SEGMENT_RETURNS = Exercise(
    name="repaired_segment_returns",
    reference=ch80.repaired_segment_returns,
    criteria={"values": 1.4, "gradient": 0.4, "dtype": 0.05, "inputs": 0.05, "errors": 0.1},
    axes=("segment",),
    cases=(
        Case("clips of unequal length", _clips(), closed_form=_learned_step_by_step, visible=True, draws=3),
        Case("padding of zeros", _clips(zeros=True), closed_form=_learned_step_by_step, visible=True),
        Case("clips of full length", _clips(full=True), closed_form=_learned_step_by_step, visible=True),
        Case("padding in front", _clips(front=True), closed_form=_learned_step_by_step),
        Case("one clip", _clips(batch=1), closed_form=_learned_step_by_step),
        Case("observations that require gradient", _clips(), differentiate=["obs"], visible=True),
        Case("gradient with padding of zeros", _clips(zeros=True), differentiate=["obs"]),
        Case("gradient where padding holds ±10,000", loud_padding(_clips(), "obs"), differentiate=["obs"], draws=1),
        Case("single precision", _clips(), dtype=torch.float32, visible=True),
        Case("mask of one row", reshaped(_clips(), "mask", lambda m: m[:1]), raises=_LAB, visible=True, draws=1),
        Case("mask of one column", reshaped(_clips(), "mask", lambda m: m[:, :1]), raises=_LAB, draws=1),
    ),
    misconceptions=(
        *wrong(_WRONG_REPAIRED_SEGMENT_RETURNS, _learned),
        cut_from_graph(ch80.repaired_segment_returns),
        dtype_lost(ch80.repaired_segment_returns),
        in_place(ch80.repaired_segment_returns, "obs", 1),
        bad_input_accepted(
            _learned(lambda f, o, m: f(o).masked_fill(~m, 0).sum(1), checked=False),
            "A mask of one row or column broadcasts silently over all clips: compare the shapes first.",
        ),
    ),
    variants={
        "product with the mask": _learned(lambda f, o, m: (f(o) * m).sum(-1)),
        "step by step": _learned(_learned_step_by_step),
        "the model never sees the padding": _learned(_learned_kept_only),
        "padding's reward taken off again": _learned(_learned_minus_padding),
        "einsum": _learned(lambda f, o, m: torch.einsum("bt,bt->b", f(o), m.to(o.dtype))),
    },
)

EXERCISES = (
    SEGMENT_RETURNS,
    PREFERENCE_PROBABILITY,
    SIMULATE_PREFERENCES,
    BRADLEY_TERRY_LOSS,
    PREFERENCE_ACCURACY,
    STANDARDIZE_REWARDS,
    FIT_REWARD_MODEL,
    REPAIRED_SEGMENT_RETURNS,
)
