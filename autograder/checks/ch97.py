"""Checks of chapter 97: cases, named misconceptions and correct variants for DPO, IPO and the optimum that they rest on."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from autograder.authoring import wild
from autograder.authoring.parts import (
    altered,
    bad_input_accepted,
    cut_from_graph,
    drawing,
    drawn_once,
    dtype_lost,
    in_place,
    integers,
    loud_padding,
    normal,
    one_shape,
    refused,
    replaced,
    reshaped,
    rows_cut,
    satisfies,
    shape_cases,
    versions_of,
    without,
    wrong,
)
from autograder.authoring.spec import Case, Exercise, Misconception
from course_lib.checks.cases import built
from solutions import ch97

# -------------------------------------------------------------------------------------------------------- sequence_logps


@drawing
def _texts(generator, batch=4, length=9, vocabulary=7, scale=2.0):
    """Prompts with completions, padded on either side: the mask begins and ends somewhere within the row."""
    start = integers(generator, 2, 5, batch)
    stop = start + integers(generator, 1, 4, batch)
    columns = torch.arange(length)
    return {
        "logits": scale * normal(generator, batch, length, vocabulary),
        "input_ids": integers(generator, 0, vocabulary, batch, length),
        "completion_mask": (columns >= start[:, None]) & (columns < stop[:, None]),
    }


def _one_token_each(generator):
    drawn = _texts()(generator)
    return drawn | {"completion_mask": torch.arange(9) == integers(generator, 1, 9, 4)[:, None]}


_TWO_TOKENS = replaced(_texts(3, 2), completion_mask=torch.tensor([[False, True]] * 3))
_WHOLE_ROWS = reshaped(_texts(), "completion_mask", torch.ones_like)
_NOTHING_KEPT = reshaped(_texts(), "completion_mask", lambda mask: mask.index_fill(0, torch.tensor([1]), False))
_SHIFTED_MASK = reshaped(_texts(), "completion_mask", lambda mask: mask[:, 1:])
_EVEN_ODDS = reshaped(_texts(), "logits", lambda logits: torch.full_like(logits, 3.0))
_PREDICTING = altered(_texts(), lambda drawn: {"kept": F.pad(drawn["completion_mask"][:, 1:], (0, 1))})
_LOUD = without(loud_padding(_PREDICTING, "logits", mask="kept"), "kept")  # the logits at t predict the token at t + 1


def _log_of_even_odds(logits, completion_mask, **_rest):
    return -math.log(logits.shape[-1]) * completion_mask[:, 1:].sum(1).to(logits.dtype)


def _by_token(logits, input_ids, completion_mask):
    sums = logits.new_zeros(len(logits)).unbind()
    for t in range(1, logits.shape[1]):
        logps = [scores[token] - scores.logsumexp(0) for scores, token in zip(logits[:, t - 1], input_ids[:, t], strict=True)]
        sums = [total + logp if keep else total for total, logp, keep in zip(sums, logps, completion_mask[:, t], strict=True)]
    return torch.stack(list(sums))


_TEXTS = ("logits", "input_ids", "completion_mask")
_aligned = satisfies(lambda logits, input_ids, completion_mask: logits.shape[:2] == input_ids.shape == completion_mask.shape)
_sequence = versions_of(ch97.sequence_logps, _aligned)


def _chosen(table, ids):
    """The entries of the tokens `ids` (B, L) in a table of all tokens (B, L, V)."""
    return table.gather(-1, ids[..., None]).squeeze(-1)


def _shifted(x, i):
    return _chosen(x[:, :-1].log_softmax(-1), i[:, 1:])


def _summed(of):
    """A formula that is shifted and masked rightly: `of` makes the table of all tokens from the logits."""
    return lambda x, i, m: torch.where(m[:, 1:], _chosen(of(x[:, :-1]), i[:, 1:]), 0).sum(1)


def _einsum(x, i, m):
    hot = F.one_hot(i[:, 1:], x.shape[-1]).to(x.dtype)
    return torch.einsum("blv,blv,bl->b", x[:, :-1].log_softmax(-1), hot, m[:, 1:].to(x.dtype))


def _cross_entropy(x, i, m):
    targets = i[:, 1:].masked_fill(~m[:, 1:], -100)
    return -F.cross_entropy(x[:, :-1].transpose(1, 2), targets, reduction="none", ignore_index=-100).sum(1)


_WRONG_SEQUENCE_LOGPS = {
    "not-shifted": (
        lambda x, i, m: (_chosen(x.log_softmax(-1), i) * m).sum(1),
        "The logits at position t predict the token at t + 1: drop the last logits and the first token before gathering.",
    ),
    "mask-not-shifted": (
        lambda x, i, m: (_shifted(x, i) * m[:, :-1]).sum(1),
        "Tokens and logits are shifted, the mask is not: it is aligned with input_ids, so the tokens input_ids[:, 1:] go with"
        " completion_mask[:, 1:].",
    ),
    "shifted-the-wrong-way": (
        lambda x, i, m: (_chosen(x[:, 1:].log_softmax(-1), i[:, :-1]) * m[:, :-1]).sum(1),
        "Each token is looked up in logits that come after it, which have seen it: logits[:, :-1] go with input_ids[:, 1:].",
    ),
    "first-token-counted": (
        lambda x, i, m: (_chosen(x.roll(1, 1).log_softmax(-1), i) * m).sum(1),
        "Nothing predicts the first token, but here the last position's logits wrap around to it: slice instead of rolling.",
    ),
    "mask-ignored": (
        lambda x, i, m: _shifted(x, i).sum(1),
        "Prompt and padding are summed too: only the completion's tokens are the policy's choice.",
    ),
    "mask-inverted": (
        lambda x, i, m: (_shifted(x, i) * ~m[:, 1:]).sum(1),
        "The mask is True at what counts: here everything else is summed.",
    ),
    "mean-instead-of-sum": (
        lambda x, i, m: (_shifted(x, i) * m[:, 1:]).sum(1) / m[:, 1:].sum(1).clamp(min=1),
        "The probability of a text is the product over its tokens, so log-probabilities are summed. The mean is another"
        " quantity, which forgets the length.",
    ),
    "logits-not-normalised": (
        _summed(lambda x: x),
        "Logits are log-probabilities only up to a constant for each position: take log_softmax over the vocabulary.",
    ),
    "normalised-over-positions": (
        _summed(lambda x: x.log_softmax(1)),
        "softmax is taken over positions: the probabilities of one position's tokens sum to 1, so use dim=-1.",
    ),
    "probabilities-summed": (_summed(lambda x: x.softmax(-1)), "These are probabilities: take their logarithm before summing."),
    "logarithm-of-softmax": (
        _summed(lambda x: x.softmax(-1).log()),
        "The softmax of an unlikely token underflows to 0, whose logarithm is -inf: use log_softmax.",
    ),
}

SEQUENCE_LOGPS = Exercise(
    name="sequence_logps",
    reference=ch97.sequence_logps,
    criteria={"values": 1.25, "gradient": 0.25, "dtype": 0.15, "inputs": 0.1, "errors": 0.25},
    axes=("text",),
    cases=drawn_once(
        Case("prompts, completions, padding", _texts(), closed_form=_by_token, visible=True, draws=3),
        Case("one token kept in each row", _one_token_each, closed_form=_by_token, visible=True),
        Case("all tokens equally likely: -log V for each", _EVEN_ODDS, closed_form=_log_of_even_odds, visible=True),
        Case("a mask that includes column 0", _WHOLE_ROWS, closed_form=_by_token, visible=True),
        Case("a row with nothing kept: 0", _NOTHING_KEPT, closed_form=_by_token),
        Case("tokens that the model finds impossible", _texts(scale=2000.0), closed_form=_by_token),
        Case("one long text", _texts(1, 40, 11), closed_form=_by_token),
        Case("texts of two tokens", _TWO_TOKENS, closed_form=_by_token),  # what is squeezed too much loses an axis here
        Case("logits that require gradient", _texts(), differentiate=["logits"], visible=True),
        Case("gradient where what is not kept has logits of ±10,000", _LOUD, differentiate=["logits"]),
        Case("single precision", _texts(), dtype=torch.float32, visible=True),
        *shape_cases(_texts(), _TEXTS),
        Case("completion_mask already shifted", _SHIFTED_MASK, raises=_TEXTS, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_SEQUENCE_LOGPS, _sequence),
        cut_from_graph(ch97.sequence_logps),
        dtype_lost(ch97.sequence_logps),
        in_place(ch97.sequence_logps, "logits"),
        bad_input_accepted(_sequence(rows_cut(lambda x, i, m: (_shifted(x, i) * m[:, 1 - x.shape[1] :]).sum(1)), checked=False)),
    ),
    variants={
        "token by token": _sequence(_by_token),
        "one-hot and einsum": _sequence(_einsum),
        "cross-entropy with ignored targets": _sequence(_cross_entropy),
        "logsumexp, in double precision": _sequence(
            lambda x, i, m: _summed(lambda logits: logits - logits.logsumexp(-1, keepdim=True))(x.double(), i, m).to(x.dtype)
        ),
        "mask product": _sequence(lambda x, i, m: torch.mul(_shifted(x, i), m[:, 1:]).sum(dim=-1)),
    },
)

# -------------------------------------------------------------------------------------------------------------- dpo_loss

LOGPS = ("chosen_logps", "rejected_logps", "ref_chosen_logps", "ref_rejected_logps")


@drawing
def _pairs(generator, batch=9, **scalars):
    """Log-probabilities of completions of some 20 tokens, policy and reference a few nats apart."""
    ref_chosen, ref_rejected = -40 + 10 * normal(generator, batch), -40 + 10 * normal(generator, batch)
    chosen, rejected = ref_chosen + 4 * normal(generator, batch), ref_rejected + 4 * normal(generator, batch)
    return dict(zip(LOGPS, (chosen, rejected, ref_chosen, ref_rejected), strict=True)) | scalars


def _ahead(chosen, rejected, batch=9, **scalars):
    """A policy whose log-ratios are these numbers, or vectors, exactly."""
    ahead = {"chosen_logps": chosen, "rejected_logps": rejected}
    return altered(_pairs(batch, **scalars), lambda drawn: {name: drawn[f"ref_{name}"] + by for name, by in ahead.items()})


def _agreeing(**scalars):
    """A policy that is still the reference, as DPO starts: all gaps are exactly 0."""
    return _ahead(0, 0, **scalars)


def _far_apart(**scalars):
    """Gaps between the log-ratios of ±10,000 nats."""
    far = torch.tensor([5000.0, -5000.0, 5000.0, -5000.0], dtype=torch.float64)
    return _ahead(far - 5100, -far - 5100, batch=4, **scalars)


def _numpy(*tensors):
    return [tensor.detach().numpy().astype(np.float64) for tensor in tensors]


def _dpo_by_formula(chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps, beta=0.1, label_smoothing=0.0):
    """log(1 + e^x) for both labels, weighted, in NumPy."""
    chosen, rejected, ref_chosen, ref_rejected = _numpy(chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps)
    rewards = beta * (chosen - ref_chosen), beta * (rejected - ref_rejected)
    x = rewards[0] - rewards[1]
    losses = (1 - label_smoothing) * np.logaddexp(0, -x) + label_smoothing * np.logaddexp(0, x)
    return tuple(torch.from_numpy(result).to(chosen_logps.dtype) for result in (losses, *rewards))


def _each(value):
    """A closed form where every pair's loss is known: this number."""
    return lambda chosen_logps, **_rest: torch.full_like(chosen_logps, value)


def _log_two(chosen_logps, **_rest):
    return tuple(torch.full_like(chosen_logps, value) for value in (math.log(2), 0.0, 0.0))


_REFERENCE = "The reference is frozen: its log-probabilities are data, so detach them (or compute them under torch.no_grad())."
_RULES = (one_shape(*LOGPS), satisfies(lambda beta: beta > 0))
_preferring = versions_of(ch97.dpo_loss, *_RULES, satisfies(lambda label_smoothing: 0 <= label_smoothing < 0.5), data=LOGPS[2:])


def _gap(c, r, ref_c, ref_r):
    return (c - ref_c) - (r - ref_r)


def _smoothed(x, s):
    return (1 - s) * F.softplus(-x) + s * F.softplus(x)


def _hand_softplus(x):
    """log(1 + e^x), right in value, but with no gradient at 0, where relu and abs have none."""
    return F.relu(x) + torch.log1p(torch.exp(-x.abs()))


def _dpo(loss=lambda gap, b, s: _smoothed(b * gap, s), gap=_gap, reward=lambda logps, ref, b: b * (logps - ref)):
    """A formula: `gap` of all four, `loss` of the gap, β and smoothing, `reward` of one completion's two and β."""

    def formula(c, r, ref_c, ref_r, b, s):
        return loss(gap(c, r, ref_c, ref_r), b, s), reward(c, ref_c, b).detach(), reward(r, ref_r, b).detach()

    return formula


def _dpo_by_pairs(c, r, ref_c, ref_r, b, s):
    rewards = [b * torch.stack(ratios) for ratios in zip(c - ref_c, r - ref_r, strict=True)]
    losses = [-(1 - s) * pair.log_softmax(0)[0] - s * pair.log_softmax(0)[1] for pair in rewards]
    return torch.stack(losses), *torch.stack(rewards).detach().unbind(1)


def _dpo_in_double(c, r, ref_c, ref_r, b, s):
    return tuple(value.to(c.dtype) for value in _dpo()(c.double(), r.double(), ref_c.double(), ref_r.double(), b, s))


_WRONG_DPO_LOSS = {
    "chosen-and-rejected-swapped": (
        _dpo(gap=lambda c, r, ref_c, ref_r: _gap(r, c, ref_r, ref_c)),
        "The loss falls as the rejected completion gets likelier: x is the chosen log-ratio minus the rejected one, and with"
        " label_smoothing the larger weight, 1 - s, goes with the label as given.",
    ),
    "sign-missing": (_dpo(lambda gap, b, s: -_smoothed(b * gap, s)), "log σ is to be maximised, a loss minimised: negate it."),
    "reference-ignored": (
        _dpo(gap=lambda c, r, ref_c, ref_r: c - r),
        "Without the reference nothing holds the policy near it, and pairs whose chosen text was likelier from the start are"
        " learnt for nothing: compare log-ratios, log π - log π_ref.",
    ),
    "reference-added": (
        _dpo(gap=lambda c, r, ref_c, ref_r: (c + ref_c) - (r + ref_r)),
        "The reference has the wrong sign: a log-ratio is log π - log π_ref of one completion, so chosen goes with ref_chosen.",
    ),
    "beta-divides": (
        _dpo(lambda gap, b, s: _smoothed(gap / b, s)),
        "beta multiplies the gap. The larger beta, the sooner a given log-ratio satisfies the loss, and the closer the policy stays.",
    ),
    "beta-missing": (
        _dpo(lambda gap, b, s: _smoothed(gap, s)),
        "beta is not used in the losses: x = beta * (chosen log-ratio - rejected log-ratio).",
    ),
    "beta-nowhere": (
        _dpo(lambda gap, b, s: _smoothed(gap, s), reward=lambda logps, ref, b: logps - ref),
        "beta is not used at all: it multiplies the gap in the losses, and the log-ratios in the rewards.",
    ),
    "beta-outside": (
        _dpo(lambda gap, b, s: b * _smoothed(gap, s)),
        "beta scales the loss, which only rescales the learning rate: it belongs inside the sigmoid.",
    ),
    "beta-fixed": (
        _dpo(lambda gap, b, s: _smoothed(0.1 * gap, s), reward=lambda logps, ref, b: 0.1 * (logps - ref)),
        "beta is 0.1 whatever the caller says: use the argument.",
    ),
    "sigmoid-without-logarithm": (
        _dpo(lambda gap, b, s: (1 - s) * torch.sigmoid(-b * gap) + s * torch.sigmoid(b * gap)),
        "This is the probability of the wrong label, whose gradient vanishes where the policy is most wrong: take -log σ.",
    ),
    "logarithm-of-sigmoid": (
        _dpo(lambda gap, b, s: -(1 - s) * torch.sigmoid(b * gap).log() - s * torch.sigmoid(-b * gap).log()),
        "σ(x) underflows to 0 at large gaps and its logarithm is -inf: use torch.nn.functional.logsigmoid.",
    ),
    "logarithm-clamped": (
        _dpo(lambda gap, b, s: _smoothed((b * gap).clamp(-20, 20), s)),
        "Clamping keeps the loss finite, and leaves the pairs that are most wrong without gradient: use logsigmoid, which is"
        " finite by itself.",
    ),
    "no-gradient-at-zero": (
        _dpo(lambda gap, b, s: (1 - s) * _hand_softplus(-b * gap) + s * _hand_softplus(b * gap)),
        "The values are right, but relu and abs have gradient 0 at 0, and DPO starts exactly there, with the policy equal to the"
        " reference: it never leaves. Use logsigmoid.",
    ),
    "hinge": (
        _dpo(lambda gap, b, s: F.relu(1 - b * gap)),
        "This is a hinge loss: the Bradley-Terry model's likelihood is the sigmoid of the gap.",
    ),
    "smoothing-ignored": (
        _dpo(lambda gap, b, s: _smoothed(b * gap, 0)),
        "label_smoothing is not used: with weight s the label is taken to be the other way round."
        + wild.also("ignored", "dpo_loss_smoothed_mean"),
    ),
    "smoothing-subtracted": (
        _dpo(lambda gap, b, s: (1 - s) * F.softplus(-b * gap) - s * F.softplus(b * gap)),
        "Both terms are negative log-likelihoods and are added: -(1 - s) log σ(x) - s log σ(-x).",
    ),
    "unbiased-for-turned-labels": (
        _dpo(lambda gap, b, s: ((1 - s) * F.softplus(-b * gap) - s * F.softplus(b * gap)) / (1 - 2 * s)),
        "This is the unbiased estimate of the loss for labels of which a share s is turned round, 'robust DPO': smoothing adds the two"
        " terms, and divides by nothing." + wild.also("robust", "dpo_loss_smoothed_mean"),
    ),
    "averaged": (
        _dpo(lambda gap, b, s: _smoothed(b * gap, s).mean().expand_as(gap)),
        "One loss for each pair is asked for; whoever calls the function averages.",
    ),
    "rewards-without-beta": (
        _dpo(reward=lambda logps, ref, b: logps - ref),
        "The implicit reward is beta * (log π - log π_ref), in the reward's own units: beta is missing.",
    ),
    "rewards-without-reference": (
        _dpo(reward=lambda logps, ref, b: b * logps),
        "The implicit reward compares with the reference: beta * (log π - log π_ref).",
    ),
    "rewards-keep-their-graph": (
        lambda c, r, ref_c, ref_r, b, s: (_smoothed(b * _gap(c, r, ref_c, ref_r), s), b * (c - ref_c), b * (r - ref_r)),
        "The rewards are reported, not learnt from: detach them.",
    ),
    "policy-detached": (
        _dpo(lambda gap, b, s: _smoothed(b * gap, s).detach()),
        "The losses reach no parameter: detach the reference's log-probabilities, not the policy's.",
    ),
    "rejected-detached": (
        _dpo(gap=lambda c, r, ref_c, ref_r: _gap(c, r.detach(), ref_c, ref_r)),
        "The rejected completion is learnt from as well: only the reference is data.",
    ),
    "dtype-lost": (lambda *given: tuple(x.float() for x in ch97.dpo_loss(*given)), "The results have lost the inputs' dtype."),
}

_AT_HALF = _pairs(beta=0.5)
_REF_COLUMN = reshaped(_AT_HALF, "ref_chosen_logps", lambda x: x[:, None])

DPO_LOSS = Exercise(
    name="dpo_loss",
    reference=ch97.dpo_loss,
    criteria={"values": 1.6, "gradient": 0.75, "dtype": 0.15, "inputs": 0.1, "errors": 0.4},
    axes=("pair",),
    cases=drawn_once(
        Case("nine pairs, default beta", _pairs(), closed_form=_dpo_by_formula, visible=True, draws=3),
        Case(
            "beta = 0.5, label_smoothing = 0.2", _pairs(beta=0.5, label_smoothing=0.2), closed_form=_dpo_by_formula, visible=True
        ),
        Case("beta = 2", _pairs(beta=2), closed_form=_dpo_by_formula),
        Case("label_smoothing = 0.4", _pairs(label_smoothing=0.4), closed_form=_dpo_by_formula),
        Case("policy and reference agree: log 2", _agreeing(), closed_form=_log_two, visible=True),
        Case("policy and reference agree, smoothed: log 2", _agreeing(beta=1, label_smoothing=0.3), closed_form=_log_two),
        Case("gaps of ±10,000", _far_apart(), closed_form=_dpo_by_formula, visible=True),
        Case("gaps of ±10,000, smoothed", _far_apart(beta=1, label_smoothing=0.1), closed_form=_dpo_by_formula),
        Case("a single pair", _pairs(1), closed_form=_dpo_by_formula),
        Case("all inputs require gradient", _pairs(beta=0.3), differentiate=LOGPS, visible=True, draws=3),
        Case("gradient, smoothed", _pairs(beta=0.3, label_smoothing=0.2), differentiate=LOGPS),
        Case("gradient where policy and reference agree", _agreeing(), differentiate=LOGPS, visible=True),
        Case("gradient at gaps of ±10,000", _far_apart(), differentiate=LOGPS),
        Case("gradient at gaps of ±10,000, smoothed", _far_apart(beta=1, label_smoothing=0.1), differentiate=LOGPS),
        Case("single precision", _pairs(label_smoothing=0.1), dtype=torch.float32, visible=True),
        Case("gaps of ±10,000 in single precision", _far_apart(), dtype=torch.float32),
        *shape_cases(_AT_HALF, LOGPS),
        Case("ref_chosen_logps as a column", _REF_COLUMN, raises=LOGPS),
        refused(_AT_HALF, beta=0.0, visible=True),
        refused(_AT_HALF, beta=-0.1),
        refused(_AT_HALF, label_smoothing=0.5),
        refused(_AT_HALF, label_smoothing=-0.1, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_DPO_LOSS, _preferring),
        Misconception("gradient-into-reference", _preferring(_dpo(), leak=True), _REFERENCE),
        in_place(ch97.dpo_loss, "chosen_logps"),
        bad_input_accepted(_preferring(_dpo(), checked=False)),
    ),
    variants={
        "policy's ratio minus reference's ratio": _preferring(_dpo(gap=lambda c, r, ref_c, ref_r: (c - r) - (ref_c - ref_r))),
        "softplus": _preferring(_dpo()),
        "log-sum-exp": _preferring(_dpo(lambda gap, b, s: torch.logaddexp(torch.zeros_like(gap), -b * gap) + s * b * gap)),
        "pair by pair, as a softmax of two": _preferring(_dpo_by_pairs),
        "cross-entropy with soft labels": _preferring(
            _dpo(lambda gap, b, s: F.binary_cross_entropy_with_logits(b * gap, torch.full_like(gap, 1 - s), reduction="none"))
        ),
        "in double precision": _preferring(_dpo_in_double),
    },
)

# -------------------------------------------------------------------------------------------------------------- ipo_loss


def _ipo_by_formula(chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps, beta=0.1):
    """Squared distance, multiplied out."""
    chosen, rejected, ref_chosen, ref_rejected = _numpy(chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps)
    margin = chosen - rejected - ref_chosen + ref_rejected
    return torch.from_numpy(margin**2 - margin / beta + 0.25 / beta**2).to(chosen_logps.dtype)


_pulling = versions_of(ch97.ipo_loss, *_RULES, data=LOGPS[2:])


def _ipo(loss=lambda gap, b: (gap - 1 / (2 * b)) ** 2, gap=_gap):
    """A formula: `gap` of all four, `loss` of the gap and β."""
    return lambda c, r, ref_c, ref_r, b: loss(gap(c, r, ref_c, ref_r), b)


_WRONG_IPO_LOSS = {
    "target-without-the-half": (_ipo(lambda gap, b: (gap - 1 / b) ** 2), "The target is 1 / (2 beta), half of this."),
    "target-proportional-to-beta": (
        _ipo(lambda gap, b: (gap - b / 2) ** 2),
        "The target is 1 / (2 beta): a larger beta asks for a smaller margin.",
    ),
    "target-of-a-half": (_ipo(lambda gap, b: (gap - 0.5) ** 2), "The target does not depend on beta here: it is 1 / (2 beta)."),
    "no-target": (_ipo(lambda gap, b: gap**2), "This pulls the margin to 0, back to the reference: its target is 1 / (2 beta)."),
    "gap-scaled-by-beta": (
        _ipo(lambda gap, b: (b * gap - 0.5) ** 2),
        "This is beta² times the loss: the gap is not scaled in IPO, so that steps do not shrink with beta.",
    ),
    "absolute-value": (_ipo(lambda gap, b: (gap - 1 / (2 * b)).abs()), "The distance is to be squared."),
    "logistic-loss": (
        _ipo(lambda gap, b: F.softplus(-b * gap)),
        "This is DPO's loss, which is never satisfied; IPO's is a squared distance from a target.",
    ),
    "chosen-and-rejected-swapped": (
        _ipo(gap=lambda c, r, ref_c, ref_r: _gap(r, c, ref_r, ref_c)),
        "The margin is the chosen log-ratio minus the rejected one, and the target, 1 / (2 beta), is subtracted from it: here the"
        " rejected completion is pulled up.",
    ),
    "reference-ignored": (
        _ipo(gap=lambda c, r, ref_c, ref_r: c - r),
        "The margin is between log-ratios, log π - log π_ref: the reference is missing.",
    ),
    "references-crossed": (
        _ipo(gap=lambda c, r, ref_c, ref_r: (c - ref_r) - (r - ref_c)),
        "Each completion is compared with the reference's opinion of the other one.",
    ),
    "averaged": (
        lambda *given: ch97.ipo_loss(*given).mean(),
        "One loss for each pair is asked for; whoever calls the function averages.",
    ),
}

IPO_LOSS = Exercise(
    name="ipo_loss",
    reference=ch97.ipo_loss,
    criteria={"values": 1.0, "gradient": 0.3, "dtype": 0.1, "inputs": 0.1, "errors": 0.25},
    axes=("pair",),
    cases=drawn_once(
        Case("nine pairs, default beta", _pairs(), closed_form=_ipo_by_formula, visible=True, draws=3),
        Case("beta = 0.5", _pairs(beta=0.5), closed_form=_ipo_by_formula, visible=True),
        Case("beta = 2", _pairs(beta=2), closed_form=_ipo_by_formula),
        Case("margins on target: 0", _ahead(1.5, -0.5, beta=0.25), closed_form=_each(0.0), visible=True),
        Case("policy and reference agree: 1 / (4 beta²)", _agreeing(beta=0.25), closed_form=_each(4.0)),
        Case("a single pair", _pairs(1), closed_form=_ipo_by_formula),
        Case("all inputs require gradient", _pairs(beta=0.3), differentiate=LOGPS, visible=True, draws=3),
        Case("single precision", _pairs(beta=0.5), dtype=torch.float32, visible=True),
        *shape_cases(_AT_HALF, LOGPS),
        refused(_AT_HALF, beta=0.0, visible=True),
        refused(_AT_HALF, beta=-0.1),
    ),
    misconceptions=(
        *wrong(_WRONG_IPO_LOSS, _pulling),
        Misconception("gradient-into-reference", _pulling(_ipo(), leak=True), _REFERENCE),
        cut_from_graph(ch97.ipo_loss),
        dtype_lost(ch97.ipo_loss),
        in_place(ch97.ipo_loss, "chosen_logps"),
        bad_input_accepted(_pulling(_ipo(), checked=False)),
    ),
    variants={
        "pair by pair": _pulling(_ipo(lambda gap, b: torch.stack([(x - 0.5 / b) * (x - 0.5 / b) for x in gap]))),
        "mean squared error": _pulling(_ipo(lambda gap, b: F.mse_loss(gap, torch.full_like(gap, 1 / (2 * b)), reduction="none"))),
        "multiplied out": _pulling(_ipo(lambda gap, b: gap.square() - gap / b + 1 / (4 * b**2))),
        "ratios grouped by model": _pulling(_ipo(gap=lambda c, r, ref_c, ref_r: (c - r) - (ref_c - ref_r))),
    },
)

# ----------------------------------------------------------------------------------------------------- kl_optimal_policy


@drawing
def _answers(generator, *shape, scale=1.0, beta=0.5):
    return {"ref_probs": normal(generator, *shape).softmax(-1), "rewards": scale * normal(generator, *shape), "beta": beta}


def _impossible_answer(generator):
    """The reference never gives the answer with by far the highest reward."""
    drawn = _answers(6, beta=1.0)(generator)
    drawn["ref_probs"][2] = 0
    drawn["ref_probs"] /= drawn["ref_probs"].sum()
    drawn["rewards"][2] = 60.0
    return drawn


def _impossible_by_thousands(generator):
    """The same, so far above the others that all of them vanish beside it."""
    drawn = _impossible_answer(generator)
    drawn["rewards"][2] = 60_000.0
    return drawn


def _two_answers(generator):
    """Odds of 1 to 1 become odds of e^(Δr / β) to 1."""
    rewards = torch.cat([normal(generator, 1), torch.zeros(1, dtype=torch.float64)])
    return {"ref_probs": torch.full_like(rewards, 0.5), "rewards": rewards, "beta": 0.7}


_INDIFFERENT = reshaped(_answers(3, 5), "rewards", lambda rewards: torch.full_like(rewards, 7.0))


def _two_by_sigmoid(rewards, beta, **_rest):
    return torch.stack([torch.sigmoid(rewards[0] / beta), torch.sigmoid(-rewards[0] / beta)])


def _tilted(ref_probs, rewards, beta):
    """By the formula, with the largest reward among possible answers taken out first."""
    highest = torch.where(ref_probs > 0, rewards, -math.inf).amax(-1, keepdim=True)
    weights = torch.where(ref_probs > 0, ref_probs * ((rewards - highest) / beta).clamp(max=0).exp(), 0)
    return weights / weights.sum(-1, keepdim=True)


_ANSWERS = ("ref_probs", "rewards")
_optimal = versions_of(ch97.kl_optimal_policy, one_shape(*_ANSWERS), satisfies(lambda beta: beta > 0))


def _tilted_by_numpy(p, r, beta):
    probs, rewards = _numpy(p, r)
    with np.errstate(divide="ignore"):
        logits = np.log(probs) + rewards / beta
    weights = np.exp(logits - logits.max(-1, keepdims=True))
    return torch.from_numpy(weights / weights.sum(-1, keepdims=True)).to(p.dtype)


def _prompt_by_prompt(p, r, beta):
    rows = [_tilted(a, b, beta) for a, b in zip(p.reshape(-1, p.shape[-1]), r.reshape(-1, r.shape[-1]), strict=True)]
    return torch.stack(rows).reshape(p.shape)


_WRONG_KL_OPTIMAL_POLICY = {
    "reference-ignored": (
        lambda p, r, b: (r / b).softmax(-1),
        "This is the optimum for a uniform reference: each weight exp(r / beta) is multiplied by π_ref.",
    ),
    "reference-not-in-logarithms": (
        lambda p, r, b: (p + r / b).softmax(-1),
        "Inside the softmax stand logarithms: add log π_ref, not π_ref.",
    ),
    "beta-multiplies": (
        lambda p, r, b: (p.log() + r * b).softmax(-1),
        "A larger beta keeps the policy closer to the reference: rewards are divided by it.",
    ),
    "beta-missing": (lambda p, r, b: (p.log() + r).softmax(-1), "beta is not used."),
    "reference-tempered": (
        lambda p, r, b: ((p.log() + r) / b).softmax(-1),
        "Only the reward is divided by beta: the reference stands with exponent 1.",
    ),
    "reward-sign-flipped": (
        lambda p, r, b: (p.log() - r / b).softmax(-1),
        "High rewards become unlikely: the exponent is +r / beta.",
    ),
    "not-normalised": (
        lambda p, r, b: p * (r / b).exp(),
        "The weights do not sum to 1: divide by Z, their sum over the last axis.",
    ),
    "normalised-over-everything": (
        lambda p, r, b: (p.log() + r / b).flatten().softmax(0).reshape(p.shape),
        "Each prompt has its own Z: sum over the last axis only.",
    ),
    "overflow": (
        lambda p, r, b: p * (r / b).exp() / (p * (r / b).exp()).sum(-1, keepdim=True),
        "exp(r / beta) overflows, and inf / inf is not a number: subtract the largest exponent first, as softmax does.",
    ),
    "largest-of-the-impossible": (
        lambda p, r, b: (
            p * ((r - r.amax(-1, keepdim=True)) / b).exp() / (p * ((r - r.amax(-1, keepdim=True)) / b).exp()).sum(-1, True)
        ),
        "The largest reward that is taken out belongs to an answer that the reference never gives: all others vanish beside it, and 0 / 0"
        " is left. Take out the largest of log π_ref + r / beta, as softmax does.",
    ),
    "impossible-made-possible": (
        lambda p, r, b: ((p + 1e-10).log() + r / b).softmax(-1),
        "A small number added to π_ref opens answers that the reference never gives, and a large reward finds them: log 0 = -inf"
        " is what softmax needs.",
    ),
    "greedy": (
        lambda p, r, b: F.one_hot((p.log() + r / b).argmax(-1), p.shape[-1]).to(p.dtype),
        "This is the best single answer: the optimum with a KL penalty keeps every answer's share.",
    ),
}

KL_OPTIMAL_POLICY = Exercise(
    name="kl_optimal_policy",
    reference=ch97.kl_optimal_policy,
    criteria={"values": 1.1, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    axes=("prompt", "answer"),
    cases=drawn_once(
        Case("five answers", _answers(5), closed_form=_tilted, visible=True, draws=3),
        Case("four prompts", _answers(4, 6, beta=0.3), closed_form=_tilted, visible=True),
        Case("more axes", _answers(2, 3, 4, beta=2.0), closed_form=_tilted),
        Case("two answers", _two_answers, closed_form=_two_by_sigmoid, visible=True),
        Case("equal rewards change nothing", _INDIFFERENT, closed_form=lambda ref_probs, **_rest: ref_probs, visible=True),
        Case("rewards of thousands", _answers(3, 5, scale=3000.0, beta=0.1), closed_form=_tilted, visible=True),
        Case("an answer that the reference never gives", _impossible_answer, closed_form=_tilted),
        Case("such an answer, by far the best", _impossible_by_thousands, closed_form=_tilted, visible=True),
        Case("beta = 100: hardly any change", _answers(3, 5, beta=100.0), closed_form=_tilted),
        Case("single precision", _answers(4, 6), dtype=torch.float32, visible=True),
        *shape_cases(_answers(4, 6), _ANSWERS),
        refused(_answers(4, 6), beta=0.0, visible=True),
        refused(_answers(4, 6), beta=-1.0),
    ),
    misconceptions=(
        *wrong(_WRONG_KL_OPTIMAL_POLICY, _optimal),
        dtype_lost(ch97.kl_optimal_policy),
        in_place(ch97.kl_optimal_policy, "rewards", 1),
        bad_input_accepted(_optimal(_tilted, checked=False)),
    ),
    variants={
        "weights, largest taken out": _optimal(_tilted),
        "NumPy": _optimal(_tilted_by_numpy),
        "prompt by prompt": _optimal(_prompt_by_prompt),
        "logsumexp": _optimal(lambda p, r, b: (p.log() + r / b - (p.log() + r / b).logsumexp(-1, keepdim=True)).exp()),
        "relative to the mean, in double precision": _optimal(
            lambda p, r, b: (p.double().log() + (r - r.mean(-1, keepdim=True)).double() / b).softmax(-1).to(p.dtype)
        ),
    },
)

# --------------------------------------------------------------------------------------------------------------- dpo_epoch


@drawing
def _epoch(generator, batches=((4, 0, 6), (2, 7, 1), (5, 3)), beta=0.5, moved=0.5, training=False, **settings):
    """Eight pairs of short texts, and tables in place of networks; the policy is `moved` away from its reference."""
    pairs, tokens = 8, 6
    prompts = integers(generator, 1, 3, pairs)
    lengths = prompts[:, None] + integers(generator, 1, 4, pairs, 2)
    columns = torch.arange(int(lengths.max()))
    input_ids = integers(generator, 0, tokens, pairs, 2, len(columns))
    given = columns < prompts[:, None, None]
    attention_mask = columns < lengths[:, :, None]
    texts = {
        "input_ids": torch.where(given, input_ids[:, :1], input_ids),
        "attention_mask": attention_mask,
        "completion_mask": attention_mask & ~given,
    }
    table = normal(generator, tokens, tokens)
    policy = built("language.tables.Bigrams", table=table + moved * normal(generator, tokens, tokens), training=training)
    return {
        "policy": policy,
        "reference": built("language.tables.Bigrams", table=table),
        "pairs": built("language.direct.Pairs", **texts),
        "batches": [torch.tensor(batch) for batch in batches],
    } | {"beta": beta, "learning_rate": 0.05, "max_grad_norm": 100.0, **settings}


def _text_logps(model, parts):
    """log π of both texts of each pair, (B, 2)."""
    input_ids, attention_mask, mask = (part.flatten(0, 1) for part in parts)
    return ch97.sequence_logps(model.logits(input_ids, attention_mask), input_ids, mask).unflatten(0, (-1, 2))


def _means(losses, chosen, rejected):
    right = (chosen > rejected).to(losses.dtype)
    parts = {"loss": losses, "accuracy": right, "chosen_rewards": chosen, "rejected_rewards": rejected}
    return {name: part.mean().detach() for name, part in parts.items()}


def _joined(rows):
    return {name: torch.stack([row[name] for row in rows]) for name in rows[0]}


def _ref_now(policy, reference, pairs, rows, logps):
    with torch.no_grad():
        return _text_logps(reference, pairs.of(rows))


def _from_policy_at_first(policy, reference, pairs, batches):
    """What the policy says before the first step, for all pairs."""
    with torch.no_grad():
        known = _text_logps(policy, pairs)
    return lambda policy, reference, pairs, rows, logps: known[rows]


def _asked_once(policy, reference, pairs, batches):
    """A variant: the reference is asked once, before the first step."""
    with torch.no_grad():
        known = _text_logps(reference, pairs)
    return lambda policy, reference, pairs, rows, logps: known[rows]


def _sides(logps, ref_logps):
    return (*logps.unbind(1), *ref_logps.unbind(1))


def _halved(logps, ref_logps):
    """The first half of all texts taken for the chosen ones, which alternate with the rejected."""
    return (*logps.flatten().chunk(2), *ref_logps.flatten().chunk(2))


def _stepping(
    logps_of=_text_logps,
    ref=lambda *_: _ref_now,
    sides: Callable[..., tuple] = _sides,
    reduce=torch.mean,
    clear=True,
    every_step=True,
    optimizer=lambda policy, rate: torch.optim.AdamW(policy.parameters(), lr=rate, weight_decay=0.0),
    anew=False,
    batches_of=list,
    trained=lambda policy, reference: policy,
    mode=None,
    told=_means,
    told_after=False,
    follow=False,
    summary=_joined,
    checked=True,
    **fixed,
):
    """A version of the loop, from the places where it can go wrong; `fixed` are settings of its own, whatever the caller's are."""

    def version(policy, reference, pairs, batches, beta=0.1, learning_rate=2e-4, max_grad_norm=1.0):
        given = {"beta": beta, "learning_rate": learning_rate, "max_grad_norm": max_grad_norm} | fixed
        if beta <= 0:
            if checked:
                raise ValueError(f"beta must be above 0, got {beta}")
            given["beta"] = 0.1
        policy = trained(policy, reference)
        if mode is not None:
            policy.train(mode)
        batches = batches_of(batches)
        adam = optimizer(policy, given["learning_rate"])
        rows: list[dict[str, torch.Tensor]] = []
        ref_of = ref(policy, reference, pairs, batches)
        adam.zero_grad()

        def looked_at(picked):
            logps = logps_of(policy, pairs.of(picked))
            ref_logps = ref_of(policy, reference, pairs, picked, logps)
            four = sides(logps, ref_logps)
            return ch97.dpo_loss(four[0], four[1], four[2], four[3], given["beta"]), logps

        for picked in batches:
            if anew:
                adam = optimizer(policy, given["learning_rate"])
            answers, logps = looked_at(picked)
            if clear and every_step:
                adam.zero_grad()
            reduce(answers[0]).backward()
            if every_step or len(rows) == len(batches) - 1:
                torch.nn.utils.clip_grad_norm_(policy.parameters(), given["max_grad_norm"])
                adam.step()
            if follow:
                reference.load_state_dict(policy.state_dict())
            rows.append(told(*(looked_at(picked) if told_after else (answers, logps))[0]))
        return summary(rows)

    return version


def _token_means(model, parts):
    return _text_logps(model, parts) / parts.completion_mask.sum(-1)


def _all_columns(model, parts):
    return _text_logps(model, parts._replace(completion_mask=torch.ones_like(parts.completion_mask)))


def _two_passes(policy, reference, pairs, batches, beta=0.1, learning_rate=2e-4, max_grad_norm=1.0):
    """A variant: each side goes through the network for itself, the gradient is asked for and shortened by hand, the log grows in place."""
    if not beta > 0:
        raise ValueError("beta must be above 0")
    weights = list(policy.parameters())
    optimizer = torch.optim.Adam(weights, lr=learning_rate)
    log: dict[str, list] = {"loss": [], "accuracy": [], "chosen_rewards": [], "rejected_rewards": []}
    for rows in batches:
        ids, attention, mask = pairs.of(rows)
        logps = []
        for model in (policy, reference):
            for side in (0, 1):
                logits = model.logits(ids[:, side], attention[:, side])
                logps.append(ch97.sequence_logps(logits, ids[:, side], mask[:, side]))
        losses, chosen, rejected = ch97.dpo_loss(logps[0], logps[1], logps[2].detach(), logps[3].detach(), beta=beta)
        gradients = torch.autograd.grad(losses.sum() / len(losses), weights)
        norm = sum(gradient.square().sum() for gradient in gradients) ** 0.5
        for weight, gradient in zip(weights, gradients, strict=True):
            weight.grad = gradient * min(1.0, max_grad_norm / (norm.item() + 1e-6))
        optimizer.step()
        for name, value in _means(losses, chosen, rejected).items():
            log[name].append(value.item())
    return {name: torch.tensor(values) for name, values in log.items()}


def _as_they_come(batches):
    """A variant's way through the batches, that needs no list."""
    yield from batches


_LEARNED: dict[str, Any] = {"returns": ("policy", "reference")}
_WRONG_DPO_EPOCH = {
    "gradient-never-cleared": (
        _stepping(clear=False),
        "backward() adds to the gradient that is there, so each step repeats all those before: optimizer.zero_grad() in front of it.",
    ),
    "one-step-in-all": (
        _stepping(every_step=False),
        "The gradients of all batches are added up for a single step: clear, backward and step belong to each batch.",
    ),
    "optimizer-anew-each-step": (
        _stepping(anew=True),
        "A new AdamW for each batch has forgotten its averages, and makes a step of full length in every coordinate: make it once.",
    ),
    "last-batch-dropped": (
        _stepping(batches_of=lambda batches: [rows for rows in batches if len(rows) == max(map(len, batches))]),
        "Batches that are smaller than others are left out: their pairs count as well.",
    ),
    "first-batch-only": (
        _stepping(batches_of=lambda batches: list(batches)[:1]),
        "It ends after the first batch: a return or break is one level too deep.",
    ),
    "sides-exchanged": (
        _stepping(sides=lambda logps, ref: _sides(logps.flip(1), ref.flip(1))),
        "Chosen and rejected texts are exchanged: in pairs, the chosen text stands at index 0 of the second axis.",
    ),
    "halves-for-sides": (
        _stepping(sides=_halved),
        "Flattened, chosen and rejected texts alternate: take every second one, or unflatten; the first half of the rows is not the"
        " chosen side.",
    ),
    "uphill": (
        _stepping(reduce=lambda losses: -losses.mean()),
        "The loss is made large: dpo_loss is a negative log-likelihood already, so go down its gradient.",
    ),
    "reference-is-the-policy": (
        _stepping(ref=lambda *_: lambda policy, reference, pairs, rows, logps: logps.detach()),
        "The reference's log-probabilities come from the policy as it is now. Then every gap is 0 for ever, the loss stays at log 2,"
        " and nothing holds the policy: ask `reference`.",
    ),
    "reference-is-the-start": (
        _stepping(ref=_from_policy_at_first),
        "The log-probabilities of the policy before this epoch stand in for the reference's: ask `reference`, from which a policy may"
        " have moved in epochs before.",
    ),
    "reference-follows": (
        _stepping(follow=True),
        "The reference is changed: it takes over the policy's weights after each step. It stays as it is.",
    ),
    "reference-forgotten": (
        _stepping(ref=lambda *_: lambda policy, reference, pairs, rows, logps: torch.zeros_like(logps)),
        "The reference is missing from the gap: the log-probabilities of the policy alone do not say what it has learned.",
    ),
    "reference-trained": (
        _stepping(trained=lambda policy, reference: reference),
        "It is the reference that is trained here.",
    ),
    "copy-trained": (
        _stepping(trained=lambda policy, reference: copy.deepcopy(policy)),
        "The policy that was handed in has not changed: a copy was trained. Change it in place.",
    ),
    "sum-instead-of-mean": (
        _stepping(reduce=torch.sum),
        "A sum grows with the batch, and with it the gradient that is compared with max_grad_norm: take the mean over the pairs.",
    ),
    "gradient-not-shortened": (
        _stepping(max_grad_norm=float("inf")),
        "max_grad_norm is not used: shorten the gradient before the step.",
    ),
    "beta-fixed": (_stepping(beta=0.1), "beta is 0.1 whatever the caller says: hand it to dpo_loss."),
    "learning-rate-fixed": (_stepping(learning_rate=2e-4), "The learning rate is 2e-4 whatever the caller says."),
    "weight-decay": (
        _stepping(optimizer=lambda policy, rate: torch.optim.AdamW(policy.parameters(), lr=rate)),
        "AdamW shrinks all weights by default, which is a pull that no pair asked for: weight_decay=0.0.",
    ),
    "plain-descent": (
        _stepping(optimizer=lambda policy, rate: torch.optim.SGD(policy.parameters(), lr=rate)),
        "This is plain gradient descent: torch.optim.AdamW is asked for.",
    ),
    "all-columns-counted": (
        _stepping(
            logps_of=_all_columns,
            ref=lambda *_: lambda policy, reference, pairs, rows, logps: _all_columns(reference, pairs.of(rows)).detach(),
        ),
        "Padding is counted: the third of the tensors is the mask of what the policy would have to write.",
    ),
    "mean-over-tokens": (
        _stepping(
            logps_of=_token_means,
            ref=lambda *_: lambda policy, reference, pairs, rows, logps: _token_means(reference, pairs.of(rows)).detach(),
        ),
        "Log-probabilities are divided by lengths: a text's is the sum over its tokens.",
    ),
    "training-mode": (
        _stepping(mode=True),
        "policy.train() switches dropout on, and a policy that drops units differs from its reference before it has learned anything:"
        " leave the mode as it is.",
    ),
    "eval-mode": (_stepping(mode=False), "policy.eval() changes the mode that the policy came in: leave it as it is."),
    "logged-after-the-step": (
        _stepping(told_after=True),
        "What is logged was computed after the step, on the batch that was just learned from: log what was so before it.",
    ),
    "last-batch-logged": (
        _stepping(summary=lambda rows: rows[-1]),
        "Only the last batch is logged: return (steps,) tensors, an entry for each.",
    ),
    "epoch-averaged": (
        _stepping(summary=lambda rows: {name: column.mean() for name, column in _joined(rows).items()}),
        "The epoch's means are returned: one entry for each step is asked for.",
    ),
    "graph-kept": (
        _stepping(told=lambda losses, *rewards: _means(losses, *rewards) | {"loss": losses.mean()}),
        "The logged losses carry a graph each, and keep all activations of the epoch alive: detach them.",
    ),
}

DPO_EPOCH = Exercise(
    name="dpo_epoch",
    reference=ch97.dpo_epoch,
    criteria={"values": 2.3, "gradient": 0.1, "errors": 0.1},
    cases=drawn_once(
        Case("both models after an epoch", _epoch(), **_LEARNED, visible=True, draws=2),
        Case("what is logged of it", _epoch(), view="log_of_steps", visible=True),
        Case("a policy that is its reference", _epoch(moved=0.0), view="log_of_steps", visible=True),
        Case("a long gradient", _epoch(max_grad_norm=0.01), **_LEARNED, visible=True, draws=2),
        Case("another price, and small steps", _epoch(beta=2.0, learning_rate=0.003), **_LEARNED),
        Case("batches that share a pair, and leave others out", _epoch(((1, 2), (2,), (2, 5, 1))), **_LEARNED),
        Case("one pair at a time", _epoch(((3,), (0,))), **_LEARNED),
        Case("a policy in training mode", _epoch(training=True), **_LEARNED),
        refused(_epoch(), beta=0.0, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_DPO_EPOCH),
        bad_input_accepted(_stepping(checked=False), "beta = 0 must be refused by a ValueError that names it, as dpo_loss does."),
    ),
    variants={
        "two passes, and a gradient by hand": _two_passes,
        "the loop with its parts": _stepping(),
        "the reference asked once": _stepping(ref=_asked_once),
        "batches as they come": _stepping(batches_of=lambda batches: _as_they_come(batches)),
    },
)

# ------------------------------------------------------------------------------------------------ repaired_completion_mask


@drawing
def _padded(generator, left=(0, 4), right=(0, 4), prompt=(1, 4), completion=(1, 5), batch=5):
    """Texts of unequal length with padding on either side; the ranges are half open."""
    before, given, written, after_it = (integers(generator, *span, batch) for span in (left, prompt, completion, right))
    columns, stop = torch.arange(int((before + given + written + after_it).max())), before + given + written
    return {"attention_mask": (columns >= before[:, None]) & (columns < stop[:, None]), "prompt_tokens": given}


def _walk(attention_mask, prompt_tokens):
    kept = torch.zeros_like(attention_mask)
    for row, prompt in enumerate(prompt_tokens.tolist()):
        own = attention_mask[row].nonzero().flatten()
        kept[row, own[prompt:]] = True
    return kept


_ROWS = ("attention_mask", "prompt_tokens")
_one_row_each = satisfies(lambda attention_mask, prompt_tokens: len(attention_mask) == len(prompt_tokens))
_repaired = versions_of(ch97.repaired_completion_mask, _one_row_each)


def _counting(formula):
    """`formula` takes own tokens, (B, L); columns from each text's first own token, (B, L); and the prompts' lengths, (B, 1)."""
    return lambda m, p: formula(m, torch.arange(m.shape[1]) - m.int().argmax(1, keepdim=True), p[:, None])


def _last(m):
    """True at each row's last own token."""
    return m & (m.flip(1).cumsum(1).flip(1) == 1)


_WRONG_PLACES = {
    "padding-behind-counted": (
        lambda m, t, p: t >= p,
        "The prompt is found wherever the text begins, but what stands behind the end of the text still counts: that is padding.",
    ),
    "end-token-dropped": (
        lambda m, t, p: m & (t >= p) & ~_last(m),
        "The last own token is the end of the text. To stop there is a choice of the policy's like any other, so it counts.",
    ),
    "one-token-early": (
        lambda m, t, p: m & (t >= p - 1),
        "The mask is aligned with the tokens, and sequence_logps shifts it: it begins at the first written token, not before it.",
    ),
    "one-token-late": (
        lambda m, t, p: m & (t > p),
        "The first written token is missing: the policy chose it, and the prompt's last position predicts it.",
    ),
    "mask-inverted": (lambda m, t, p: ~(m & (t >= p)), "True marks the tokens that count: this keeps all the others."),
    "one-prompt-length-for-all": (
        lambda m, t, p: m & (t >= p.min()),
        "Each text has a prompt length of its own: here the shortest is used for all.",
    ),
    "integers": (
        lambda m, t, p: (m & (t >= p)).long(),
        "Masks are bool: `~mask` of an integer is something else, and indexing with it picks rows.",
    ),
    "input-changed": (
        lambda m, t, p: m.logical_and_(t >= p),
        "The caller's tensor is changed (by &= or a method that ends in _), and the network is given it afterwards.",
    ),
}
_WRONG_COUNTS = {
    "padding-counted": (
        lambda m, p: torch.arange(m.shape[1]) >= p[:, None],
        "This is the suspect program's own bug: all columns behind the prompt count, also those behind the text's end, where no"
        " sample ever goes.",
    ),
    "prompt-counted": (
        lambda m, p: m.clone(),
        "The prompt's tokens count as well. They were given, not written: leave out the first prompt_tokens[b] own tokens.",
    ),
    "padding-on-the-left-forgotten": (
        lambda m, p: m & (torch.arange(m.shape[1]) >= p[:, None]),
        "With padding on the left the prompt does not begin in column 0: count own tokens, not columns.",
    ),
}

REPAIRED_COMPLETION_MASK = Exercise(
    name="repaired_completion_mask",
    reference=ch97.repaired_completion_mask,
    criteria={"values": 1.7, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("text", "column"),
    cases=drawn_once(
        Case("padding on the right", _padded(left=(0, 1)), closed_form=_walk, visible=True, draws=3),
        Case("every text begins with one given token", _padded(left=(0, 1), prompt=(1, 2)), closed_form=_walk, visible=True),
        Case("padding on the left", _padded(right=(0, 1)), closed_form=_walk, visible=True, draws=3),
        Case("padding on both sides", _padded(left=(1, 4), right=(1, 4)), closed_form=_walk, draws=3),
        Case("no padding", _padded((0, 1), (0, 1), (2, 3), (4, 5)), closed_form=_walk, visible=True),
        Case("completions of one token", _padded(completion=(1, 2)), closed_form=_walk),
        Case("no prompt at all", _padded(prompt=(0, 1)), closed_form=_walk),
        Case("some prompts without a completion", _padded(completion=(0, 2), right=(1, 4)), closed_form=_walk),
        Case("one text", _padded(left=(1, 3), right=(1, 3), batch=1), closed_form=_walk),
        *shape_cases(_padded(), _ROWS),
    ),
    misconceptions=(
        *wrong(_WRONG_PLACES, lambda formula: _repaired(_counting(formula))),
        *wrong(_WRONG_COUNTS, _repaired),
        bad_input_accepted(_repaired(rows_cut(_counting(lambda m, t, p: m & (t >= p))), checked=False)),
    ),
    variants={
        "walk": _repaired(_walk),
        "columns from the first own token": _repaired(_counting(lambda m, t, p: m & (t >= p))),
        "positions as the network counts them": _repaired(lambda m, p: m & ((m.cumsum(1) - 1).clamp(min=0) >= p[:, None])),
        "own tokens from the back": _repaired(
            lambda m, p: m & (m.flip(1).cumsum(1).flip(1) <= m.sum(1, keepdim=True) - p[:, None])
        ),
        "NumPy": _repaired(lambda m, p: torch.from_numpy(m.numpy() & (np.cumsum(m.numpy(), axis=1) > p.numpy()[:, None]))),
    },
)

EXERCISES = (SEQUENCE_LOGPS, DPO_LOSS, IPO_LOSS, KL_OPTIMAL_POLICY, DPO_EPOCH, REPAIRED_COMPLETION_MASK)
