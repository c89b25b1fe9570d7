"""Checks of chapter 95: cases, named misconceptions and correct variants for PPO on the tokens of a language model."""

from __future__ import annotations

import copy
import math
import statistics
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from autograder.authoring import wild
from autograder.authoring.parts import (
    IN_PLACE,
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
    python_float,
    refused,
    reshaped,
    rows_cut,
    satisfies,
    shape_cases,
    versions_of,
    wrong,
)
from autograder.authoring.spec import Case, Exercise, Misconception
from course_lib.checks.cases import built
from solutions import ch45, ch95

# ----------------------------------------------------------------------------------------------- masks, and what they keep


def _mask(generator, batch, length, shape="middle"):
    """Contiguous kept tokens, at least one in each row; at the left, the right, or in the middle."""
    count = integers(generator, 1, length - 2, batch)
    start = {"left": torch.zeros_like(count), "right": length - count, "middle": torch.ones_like(count)}[shape]
    columns = torch.arange(length)
    return (columns >= start[:, None]) & (columns < (start + count)[:, None])


def _uneven_mask(generator, batch, length, shape="middle"):
    """The first row keeps one token, the second nearly all: their means count alike only by mistake."""
    mask = _mask(generator, batch, length, shape)
    mask[:2] = torch.stack([torch.arange(length) == 1, torch.arange(length) > 0])
    return mask


def _garbage(mask, x, times=1000):
    """Padding holds numbers a thousand times as large."""
    return torch.where(mask, x, times * x)


def _all_kept(inputs):
    return reshaped(inputs, "mask", torch.ones_like)


def _zeroed(x, mask):
    return torch.where(mask, x, 0)


def _last(mask):
    """True at each row's last kept token."""
    return mask & (mask.flip(1).cumsum(1).flip(1) == 1)


def _nothing(x, *_rest):
    return torch.zeros_like(x)


def _listed(x, mask):
    return [value for value, keep in zip(x.flatten().tolist(), mask.flatten().tolist(), strict=True) if keep]


_OUTSIDE = "What lies outside the mask must not matter: padding may hold any number."
_ZERO = "Outside the mask the result is 0, so that sums over it need no second mask."
_ROW_MEANS = (
    "This is a mean of row means: a token of a short completion counts for more than one of a long completion. Divide the sum over all"
    " kept entries by their number."
)

# -------------------------------------------------------------------------------------------------------- per_token_logps


@drawing
def _logits(generator, batch=3, length=6, vocabulary=7, scale=2.0):
    logits = scale * normal(generator, batch, length, vocabulary)
    return {"logits": logits, "input_ids": integers(generator, 0, vocabulary, batch, length)}


def _token_by_token(logits, input_ids):
    columns = []
    for t in range(1, logits.shape[1]):
        chosen = torch.stack([row[token] for row, token in zip(logits[:, t - 1], input_ids[:, t], strict=True)])
        columns.append(chosen - logits[:, t - 1].logsumexp(-1))
    return torch.stack(columns, dim=1)


def _chosen(table, ids):
    """The entries of the tokens `ids` (B, L) in a table of all tokens (B, L, V)."""
    return table.gather(-1, ids[..., None]).squeeze(-1)


def _table(of):
    """A formula that is shifted rightly: `of` makes the table of all tokens from the logits."""
    return lambda x, i: _chosen(of(x[:, :-1]), i[:, 1:])


_TEXT = ("logits", "input_ids")
_text = versions_of(ch95.per_token_logps, satisfies(lambda logits, input_ids: logits.shape[:-1] == input_ids.shape))

_WRONG_PER_TOKEN_LOGPS = {
    "not-shifted": (
        lambda x, i: _chosen(x.log_softmax(-1), i)[:, :-1],
        "The logits at position t predict the token at t + 1: logits[:, :-1] go with input_ids[:, 1:].",
    ),
    "not-shifted-last-columns": (
        lambda x, i: _chosen(x.log_softmax(-1), i)[:, 1:],
        "Dropping the first column of the result is no shift: each token is still looked up in logits that have seen it.",
    ),
    "shifted-the-wrong-way": (
        lambda x, i: _chosen(x[:, 1:].log_softmax(-1), i[:, :-1]),
        "The logits and the tokens are shifted the wrong way: logits[:, :-1] go with input_ids[:, 1:].",
    ),
    "logits-not-normalised": (
        _table(lambda x: x),
        "Logits are log-probabilities only up to a constant for each position: take log_softmax over the vocabulary.",
    ),
    "normalised-over-positions": (
        _table(lambda x: x.log_softmax(1)),
        "softmax is taken over positions: the probabilities of one position's tokens sum to 1, so use dim=-1.",
    ),
    "normalised-with-the-last-position-over-everything": (
        _table(lambda x: x.flatten(1).log_softmax(-1).view_as(x)),
        "One softmax for the whole text: every position has a distribution of its own.",
    ),
    "probabilities": (_table(lambda x: x.softmax(-1)), "These are probabilities: logarithms are asked for."),
    "logarithm-of-softmax": (
        _table(lambda x: x.softmax(-1).log()),
        "The softmax of an unlikely token underflows to 0, whose logarithm is -inf: use log_softmax.",
    ),
    "losses": (_table(lambda x: -x.log_softmax(-1)), "Cross-entropy is minus the log-probability: the sign is missing."),
    "summed-over-the-text": (
        lambda x, i: ch95.per_token_logps(x, i).sum(1),
        "One number for each token is asked for, (B, L - 1).",
    ),
}

PER_TOKEN_LOGPS = Exercise(
    name="per_token_logps",
    reference=ch95.per_token_logps,
    criteria={"values": 1.0, "gradient": 0.2, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("text", "t"),
    cases=drawn_once(
        Case("three texts of six tokens", _logits(), closed_form=_token_by_token, visible=True, draws=3),
        Case(
            "all tokens equally likely: -log V",
            reshaped(_logits(), "logits", lambda x: torch.full_like(x, 3.0)),
            closed_form=lambda logits, input_ids: torch.full(input_ids[:, 1:].shape, -math.log(7), dtype=logits.dtype),
            visible=True,
        ),
        Case("as many positions as tokens in the vocabulary", _logits(2, 7, 7), closed_form=_token_by_token),
        Case("tokens that the model finds impossible", _logits(scale=2000.0), closed_form=_token_by_token, visible=True),
        Case("a text of two tokens", _logits(1, 2), closed_form=_token_by_token),
        Case("logits that require gradient", _logits(), differentiate=["logits"], visible=True),
        Case("single precision", _logits(), dtype=torch.float32, visible=True),
        *shape_cases(_logits(), _TEXT),
        Case("input_ids already shifted", reshaped(_logits(), "input_ids", lambda ids: ids[:, 1:]), raises=_TEXT),
    ),
    misconceptions=(
        *wrong(_WRONG_PER_TOKEN_LOGPS, _text),
        cut_from_graph(ch95.per_token_logps),
        dtype_lost(ch95.per_token_logps),
        in_place(ch95.per_token_logps, "logits"),
        bad_input_accepted(
            _text(rows_cut(lambda x, i: _chosen(x[:, : i.shape[1] - 1].log_softmax(-1), i[:, 1:])), checked=False)
        ),
    ),
    variants={
        "token by token": _text(_token_by_token),
        "cross-entropy": _text(lambda x, i: -F.cross_entropy(x[:, :-1].transpose(1, 2), i[:, 1:], reduction="none")),
        "chosen logit minus logsumexp": _text(lambda x, i: _chosen(x[:, :-1], i[:, 1:]) - x[:, :-1].logsumexp(-1)),
        "one-hot": _text(lambda x, i: (x[:, :-1].log_softmax(-1) * F.one_hot(i[:, 1:], x.shape[-1]).to(x.dtype)).sum(-1)),
        "distribution object, in double precision": _text(
            lambda x, i: torch.distributions.Categorical(logits=x[:, :-1].double()).log_prob(i[:, 1:]).to(x.dtype)
        ),
    },
)

# -------------------------------------------------------------------------------------------------------- completion_mask

END = 2


@drawing
def _sampled(generator, batch=6, length=10, end_rate=0.2, start=(2, 6), eos_token_id=END):
    """Prompts of several lengths, tokens at random among which are end tokens, also in prompts."""
    ordinary = integers(generator, 3, 50, batch, length)
    ids = torch.where(torch.rand(batch, length, generator=generator) < end_rate, END, ordinary)
    return {"input_ids": ids, "prompt_lengths": integers(generator, *start, batch), "eos_token_id": eos_token_id}


def _ended(where):
    """End tokens where `where`, of columns (L,) and starts (B, 1), says so, and nowhere else."""

    def ended(drawn):
        ids, starts = drawn["input_ids"], drawn["prompt_lengths"]
        return {"input_ids": ids.masked_fill(where(torch.arange(ids.shape[1]), starts[:, None]), END)}

    return altered(_sampled(end_rate=0.0), ended)


_IN_PROMPTS = _ended(lambda t, s: (t == s - 1) | (t == s - 2))
_AT_ONCE = _ended(lambda t, s: (t == s) | (t == 9))
_PADDING = _ended(lambda t, s: (t == 0) | (t > s + torch.arange(6)[:, None] % 3))  # as GPT-2 has no other token to pad with
_IN_LAST_COLUMN = _ended(lambda t, s: t == 9)


def _walk(input_ids, prompt_lengths, eos_token_id):
    mask = torch.zeros(input_ids.shape, dtype=torch.bool)
    for row, ids in enumerate(input_ids.tolist()):
        for column in range(int(prompt_lengths[row]), len(ids)):
            mask[row, column] = True
            if ids[column] == eos_token_id:
                break
    return mask


_ROWS = ("input_ids", "prompt_lengths")
_one_length_each = satisfies(lambda input_ids, prompt_lengths: len(input_ids) == len(prompt_lengths))
_completions = versions_of(ch95.completion_mask, _one_length_each)


def _kept_where(formula):
    """`formula` takes which tokens are end tokens, (B, L); columns, (L,); and starts, (B, 1)."""
    return lambda ids, lengths, end: formula(ids == end, torch.arange(ids.shape[1]), lengths[:, None])


def _kept(e, t, s):
    ends = e & (t >= s)
    return (t >= s) & (ends.cumsum(1) - ends.long() == 0)


def _kept_to_the_last_end(e, t, s):
    no_end = ~(e & (t >= s)).any(1, keepdim=True)
    return (t >= s) & (no_end | (e.flip(1).cumsum(1).flip(1) > 0))


def _kept_by_position(e, t, s):
    ends = e & (t >= s)
    last = torch.where(ends.any(1), ends.int().argmax(1), len(t) - 1)
    return (t >= s) & (t <= last[:, None])


def _kept_by_numpy(e, t, s):
    ends = (e & (t >= s)).numpy()
    over = np.logical_or.accumulate(np.pad(ends, ((0, 0), (1, 0)))[:, :-1], axis=1)
    return torch.from_numpy((t >= s).numpy() & ~over)


def _prompts_overwritten(ids, lengths, end):
    ids[torch.arange(ids.shape[1]) < lengths[:, None]] = -1
    return ch95.completion_mask(ids, lengths, end)


_WRONG_COMPLETION_MASK = {
    "end-token-excluded": (
        lambda e, t, s: _kept(e, t, s) & ~e,
        "Ending the text was the policy's choice too: the first end token is kept, or the policy never learns when to stop.",
    ),
    "ends-ignored": (lambda e, t, s: t >= s, "What follows the end token is padding: keep nothing behind it."),
    "prompt-included": (
        lambda e, t, s: _kept(e, t, s) | (t < s),
        "The prompt was given, not chosen: the mask begins at prompt_lengths.",
    ),
    "end-tokens-of-the-prompt-count": (
        lambda e, t, s: (t >= s) & (e.cumsum(1) - e.long() == 0),
        "An end token before prompt_lengths, as padding or within the prompt, ends nothing: look at or after that column only.",
    ),
    "last-end-token": (_kept_to_the_last_end, "The text is over at the first end token: those behind it are padding."),
    "empty-without-end": (
        lambda e, t, s: _kept(e, t, s) & (e & (t >= s)).any(1, keepdim=True),
        "A completion that was cut off before an end token is kept to the last column: argmax of no True is 0.",
    ),
    "one-column-early": (
        lambda e, t, s: _kept(e, t, s) | (t == s - 1),
        "The mask is aligned with input_ids, and begins at column prompt_lengths[b], not before it.",
    ),
    "one-column-late": (
        lambda e, t, s: _kept(e, t, s) & (t > s),
        "Column prompt_lengths[b] holds the completion's first token, and is kept.",
    ),
    "one-start-for-all": (lambda e, t, s: _kept(e, t, s[:1].expand_as(s)), "Each row has a prompt length of its own."),
    "all-but-end-tokens": (
        lambda e, t, s: (t >= s) & ~e,
        "Masking end tokens by their identity keeps what follows the first one, and drops that one itself.",
    ),
    "integers": (
        lambda e, t, s: _kept(e, t, s).long(),
        "Masks are bool: `~mask` of an integer is something else, and indexing with it picks rows.",
    ),
}

COMPLETION_MASK = Exercise(
    name="completion_mask",
    reference=ch95.completion_mask,
    criteria={"values": 1.2, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("text", "column"),
    cases=(
        Case("end tokens anywhere", _sampled(), closed_form=_walk, visible=True, draws=3),
        Case("no end token: all the rest is kept", _sampled(end_rate=0.0), closed_form=_walk, visible=True),
        Case("end tokens within the prompts", _IN_PROMPTS, closed_form=_walk, visible=True),
        Case("completions that end at once", _AT_ONCE, closed_form=_walk),
        Case("padding by end tokens on both sides", _PADDING, closed_form=_walk, visible=True),
        Case("the end token in the last column", _IN_LAST_COLUMN, closed_form=_walk),
        Case("many end tokens", _sampled(end_rate=0.6), closed_form=_walk),
        Case("prompts that fill their rows", _sampled(start=(10, 11)), closed_form=_walk),
        Case("no prompts", _sampled(start=(0, 1)), closed_form=_walk),
        Case("another end token", _sampled(eos_token_id=7, length=40), closed_form=_walk),
        *shape_cases(_sampled(), _ROWS),
    ),
    misconceptions=(
        *wrong(_WRONG_COMPLETION_MASK, lambda formula: _completions(_kept_where(formula))),
        Misconception("input-changed", _completions(_prompts_overwritten), IN_PLACE),
        bad_input_accepted(_completions(rows_cut(_kept_where(_kept)), checked=False)),
    ),
    variants={
        "walk": _completions(_walk),
        "position of the first end": _completions(_kept_where(_kept_by_position)),
        "running maximum": _completions(
            _kept_where(lambda e, t, s: (t >= s) & ~F.pad((e & (t >= s)).int().cummax(1).values[:, :-1], (1, 0)).bool())
        ),
        "smallest column of an end": _completions(
            _kept_where(lambda e, t, s: (t >= s) & (t <= torch.where(e & (t >= s), t, len(t)).amin(1, keepdim=True)))
        ),
        "NumPy": _completions(_kept_where(_kept_by_numpy)),
    },
)

# --------------------------------------------------------------------------------------------------- kl_penalized_rewards


@drawing
def _penalised(generator, batch=5, length=8, kl_coef=0.1, shape="middle"):
    mask = _mask(generator, batch, length, shape)
    logps, scores = -2 + normal(generator, batch, length), 1 + 2 * normal(generator, batch)
    ref_logps = _garbage(mask, logps + normal(generator, batch, length))
    return {"scores": scores, "logps": logps, "ref_logps": ref_logps, "mask": mask, "kl_coef": kl_coef}


_AGREEING = altered(_penalised(), lambda drawn: {"ref_logps": drawn["logps"].clone()})


def _penalised_by_loop(scores, logps, ref_logps, mask, kl_coef):
    rewards = torch.zeros_like(logps)
    for row in range(len(rewards)):
        kept = mask[row].nonzero().flatten().tolist()
        for t in kept:
            rewards[row, t] = -kl_coef * (logps[row, t].item() - ref_logps[row, t].item())
        rewards[row, kept[-1]] += scores[row].item()
    return rewards


def _score_alone(scores, mask, **_rest):
    return scores[:, None] * _last(mask)


_PENALISED = ("scores", "logps", "ref_logps", "mask")
_one_score_each = satisfies(lambda scores, logps: scores.shape == logps.shape[:1])
_rewards = versions_of(ch95.kl_penalized_rewards, one_shape(*_PENALISED[1:]), _one_score_each, data=_PENALISED[:3])


def _sum(penalty=lambda d, m, b: -b * d, paid_at=_last):
    """A formula: `penalty`, of log-ratios, mask and coefficient, for kept tokens, and the score where `paid_at`, of the mask, is True."""
    return lambda s, new, old, m, b: _zeroed(penalty(new - old, m, b), m) + _zeroed(s.reshape(-1, 1), paid_at(m))


def _scattered(s, new, old, m, b):
    last = m.shape[1] - 1 - m.flip(1).int().argmax(1)
    return (b * (old - new)).masked_fill(~m, 0.0).scatter_add(1, last[:, None], s[:, None])


_WRONG_KL_PENALIZED_REWARDS = {
    "penalty-added": (
        _sum(penalty=lambda d, m, b: b * d),
        "Moving away from the reference is rewarded: the penalty is -kl_coef * (logps - ref_logps).",
    ),
    "penalty-missing": (_sum(penalty=lambda d, m, b: 0 * d), "The score alone: nothing holds the policy near the reference."),
    "coefficient-missing": (_sum(penalty=lambda d, m, b: -d), "kl_coef is not used."),
    "penalty-summed-at-the-end": (
        _sum(penalty=lambda d, m, b: -b * _zeroed(d, m).sum(1, keepdim=True) * _last(m)),
        "The sum is right, but all of it stands at the last token: each token pays for its own departure.",
    ),
    "penalty-averaged-over-the-text": (
        _sum(penalty=lambda d, m, b: -b * d / m.sum(1, keepdim=True)),
        "The penalty is not divided by the length: longer texts may depart further in total, and pay for it.",
    ),
    "absolute-difference": (
        _sum(penalty=lambda d, m, b: -b * d.abs()),
        "The log-ratio keeps its sign: only its mean over the policy's own samples is the KL, single ones may be negative.",
    ),
    "never-negative-estimate": (
        _sum(penalty=lambda d, m, b: -b * ((-d).exp() - 1 + d)),
        "This is the k3 estimate, good as a metric; as a reward its gradient is another one: use the log-ratio itself.",
    ),
    "score-at-every-token": (
        _sum(paid_at=lambda m: m),
        "The score is paid once, at the last kept token: here it is paid as often as the text is long.",
    ),
    "score-in-the-last-column": (
        _sum(paid_at=lambda m: torch.arange(m.shape[1]) == m.shape[1] - 1),
        "The last column is padding for most rows: the score belongs to each row's last kept token.",
    ),
    "number-of-tokens-as-position": (
        _sum(paid_at=lambda m: torch.arange(m.shape[1]) == m.sum(1, keepdim=True) - 1),
        "The number of kept tokens less one is the last one's column only where the completion begins in the first column: look for the"
        " largest column that is kept.",
    ),
    "score-at-the-first-token": (
        _sum(paid_at=lambda m: m & (m.cumsum(1) == 1)),
        "argmax finds the first kept token: the score comes when the text is finished.",
    ),
    "score-behind-the-text": (
        _sum(paid_at=lambda m: _last(m).roll(1, 1)),
        "One column too far: the score stands at the last kept token, not on the padding behind it.",
    ),
    "score-replaces-the-penalty": (
        _sum(penalty=lambda d, m, b: -b * _zeroed(d, ~_last(m))),
        "At the last token penalty and score are added; here one overwrites the other.",
    ),
    "mask-ignored": (
        lambda s, new, old, m, b: b * (old - new) + s[:, None] * _last(m),
        "Prompt and padding are penalised too: outside the mask the reward is 0.",
    ),
}

KL_PENALIZED_REWARDS = Exercise(
    name="kl_penalized_rewards",
    reference=ch95.kl_penalized_rewards,
    criteria={"values": 1.2, "gradient": 0.15, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    axes=("text", "t"),
    cases=drawn_once(
        Case("completions in the middle of their rows", _penalised(), closed_form=_penalised_by_loop, visible=True, draws=3),
        Case("completions at the end of their rows", _penalised(shape="right"), closed_form=_penalised_by_loop, visible=True),
        Case("completions that begin in the first column", _penalised(shape="left"), closed_form=_penalised_by_loop),
        Case("every token kept", _all_kept(_penalised(length=4)), closed_form=_penalised_by_loop),
        Case("kl_coef = 0: the score at the last token", _penalised(kl_coef=0.0), closed_form=_score_alone, visible=True),
        Case("policy and reference agree", _AGREEING, closed_form=_score_alone),
        Case("kl_coef = 2", _penalised(kl_coef=2.0), closed_form=_penalised_by_loop),
        Case("inputs that require gradient", _penalised(), differentiate=_PENALISED[:3], visible=True),
        Case("single precision", _penalised(), dtype=torch.float32, visible=True),
        *shape_cases(_penalised(), _PENALISED),
        Case("scores as a column", reshaped(_penalised(), "scores", lambda x: x[:, None]), raises=_PENALISED, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_KL_PENALIZED_REWARDS, _rewards),
        Misconception(
            "graph-kept",
            _rewards(_sum(), leak=True),
            "Rewards are data: with a graph the policy would also be trained through its own penalty. Detach them.",
        ),
        dtype_lost(ch95.kl_penalized_rewards),
        in_place(ch95.kl_penalized_rewards, "logps", 1),
        bad_input_accepted(_rewards(rows_cut(_sum()), checked=False)),
    ),
    variants={
        "loop": _rewards(_penalised_by_loop),
        "score at the last one of a reversed count": _rewards(_sum()),
        "scatter": _rewards(_scattered),
        "difference of two masks": _rewards(_sum(paid_at=lambda m: m & ~F.pad(m[:, 1:], (0, 1)))),
        "in double precision": _rewards(lambda s, new, old, m, b: _sum()(s.double(), new.double(), old, m, b).to(new.dtype)),
    },
)

# ------------------------------------------------------------------------------------------- masked_mean and masked_whiten

_X = ("x", "mask")


def _entries(generator):
    mask = _uneven_mask(generator, 4, 7)
    return {"x": _garbage(mask, 0.5 + normal(generator, 4, 7)), "mask": mask}


def _scattered_entries(generator):
    x = normal(generator, 5, 6)
    mask = torch.rand(5, 6, generator=generator) < 0.5
    mask[0, :3] = torch.tensor([True, True, False])
    mask[2] = False
    return {"x": x, "mask": mask}


def _whole(generator):
    return {"x": normal(generator, 3, 5), "mask": torch.ones(3, 5, dtype=torch.bool)}


def _one_kept(generator):
    return {"x": normal(generator, 3, 5), "mask": torch.arange(15).reshape(3, 5) == int(integers(generator, 0, 15))}


def _mean_by_list(x, mask):
    return torch.tensor(statistics.fmean(_listed(x, mask)), dtype=x.dtype)


_masked = versions_of(ch95.masked_mean, one_shape(*_X))

_WRONG_MASKED_MEAN = {
    "mask-ignored": (lambda x, m: x.mean(), _OUTSIDE),
    "divided-by-everything": (
        lambda x, m: _zeroed(x, m).mean(),
        "The sum is over kept entries, and so is the count: here the sum is divided by the size of the whole tensor.",
    ),
    "mean-of-row-means": (lambda x, m: (_zeroed(x, m).sum(1) / m.sum(1).clamp(min=1)).mean(), _ROW_MEANS),
    "one-mean-for-each-row": (lambda x, m: _zeroed(x, m).sum(1) / m.sum(1), "One number for the whole batch is asked for."),
    "sum": (lambda x, m: x[m].sum(), "Divide by the number of kept entries."),
    "divided-by-rows": (lambda x, m: x[m].sum() / len(x), "Divide by the number of kept entries, not of rows."),
    "mask-inverted": (lambda x, m: x[~m].mean(), "True means keep: the mask is the wrong way round."),
    "count-off-by-a-constant": (
        lambda x, m: x[m].sum() / (m.sum() + 1),
        "A constant in the denominator biases small counts: divide by the number of kept entries.",
    ),
}

MASKED_MEAN = Exercise(
    name="masked_mean",
    reference=ch95.masked_mean,
    criteria={"values": 0.7, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    cases=drawn_once(
        Case("rows of very different lengths", _entries, closed_form=_mean_by_list, visible=True, draws=3),
        Case("scattered entries and an empty row", _scattered_entries, closed_form=_mean_by_list, visible=True),
        Case("everything kept", _whole, closed_form=_mean_by_list),
        Case("one entry kept", _one_kept, closed_form=_mean_by_list, visible=True),
        Case("zeros among the kept entries", reshaped(_entries, "x", lambda x: x.clamp(min=0)), closed_form=_mean_by_list),
        Case("single precision", _entries, dtype=torch.float32, visible=True),
        *shape_cases(_entries, _X),
    ),
    misconceptions=(
        *wrong(_WRONG_MASKED_MEAN, _masked),
        python_float(ch95.masked_mean),
        dtype_lost(ch95.masked_mean),
        in_place(ch95.masked_mean, "x"),
        bad_input_accepted(_masked(rows_cut(lambda x, m: x[m].mean()), checked=False)),
    ),
    variants={
        "sum over count": _masked(lambda x, m: _zeroed(x, m).sum() / m.sum()),
        "product with the mask": _masked(lambda x, m: (x * m).sum() / m.sum()),
        "list": _masked(_mean_by_list),
        "masked_select, in double precision": _masked(lambda x, m: torch.masked_select(x, m).double().mean().to(x.dtype)),
        "nanmean": _masked(lambda x, m: x.masked_fill(~m, math.nan).nanmean()),
    },
)

_CONSTANT = altered(_entries, lambda drawn: {"x": _garbage(drawn["mask"], torch.full_like(drawn["x"], 3.0))})
_FAR_FROM_ZERO = altered(_entries, lambda drawn: {"x": torch.where(drawn["mask"], drawn["x"].sign() * 4 + 1e4, drawn["x"])})


def _by_list(x, mask, eps=1e-8, centred=True):
    """Whitened, or only scaled, one number at a time."""
    kept = _listed(x, mask)
    mean, deviation = statistics.fmean(kept), math.sqrt(statistics.pvariance(kept) + eps)
    entries = zip(x.flatten().tolist(), mask.flatten().tolist(), strict=True)
    scaled = [(value - mean * centred) / deviation if keep else 0.0 for value, keep in entries]
    return torch.tensor(scaled, dtype=x.dtype).reshape(x.shape)


def _std(kept):
    return kept.std(correction=0)


def _of_rows(statistic, x, mask):
    """A statistic of each row's kept entries, (B, 1)."""
    rows = [statistic(row[kept]) if kept.any() else 0 * row.sum() for row, kept in zip(x, mask, strict=True)]
    return torch.stack(rows)[:, None]


def _scaled_by(moments):
    """A formula: `moments`, of entries and mask, are what is subtracted and what divides."""

    def formula(x, m, eps):
        centre, deviation = moments(x, m)
        return _zeroed((x - centre) / (deviation + eps), m)

    return formula


def _placed(x, m, eps):
    kept = x[m]
    return torch.zeros_like(x).masked_scatter(m, (kept - kept.mean()) / (kept.std() + eps))


def _by_sums(x, m, eps):
    centred = _zeroed(x - _zeroed(x, m).sum() / m.sum(), m)
    return centred * (centred.square().sum() / m.sum() + eps).rsqrt()


_whitened = versions_of(ch95.masked_whiten, one_shape(*_X))

_WRONG_MOMENTS = {
    "statistics-over-padding": (lambda x, m: (x.mean(), x.std()), "Mean and deviation are taken over padding too. " + _OUTSIDE),
    "padding-counted-as-zeros": (
        lambda x, m: (_zeroed(x, m).mean(), _zeroed(x, m).std()),
        "Padding is zeroed and then counted, which pulls the mean to 0: statistics are over kept entries only.",
    ),
    "row-by-row": (
        lambda x, m: (_of_rows(torch.mean, x, m), _of_rows(_std, x, m)),
        "Each row is whitened by itself, which erases the differences between texts: take statistics over the batch."
        + wild.also("by_row", "whitened"),
    ),
    "not-centred": (lambda x, m: (0, _std(x[m])), "Subtract the mean of the kept entries as well."),
    "only-centred": (lambda x, m: (x[m].mean(), 1), "Divide by the standard deviation of the kept entries as well."),
    "divided-by-variance": (
        lambda x, m: (x[m].mean(), _std(x[m]) ** 2),
        "Divide by the standard deviation, the root of the variance.",
    ),
    "deviation-not-around-the-mean": (
        lambda x, m: (x[m].mean(), x[m].square().mean().sqrt()),
        "This divides by the root mean square: subtract the mean before squaring.",
    ),
}
_WRONG_WHITENING = {
    "padding-not-zeroed": (lambda x, m, eps: (x - x[m].mean()) / (_std(x[m]) + eps), _ZERO),
    "eps-missing": (
        lambda x, m, eps: _zeroed((x - x[m].mean()) / _std(x[m]), m),
        "Equal entries give 0 / 0: eps keeps the denominator above 0.",
    ),
    "kept-entries-only": (
        lambda x, m, eps: (x[m] - x[m].mean()) / (_std(x[m]) + eps),
        "The shape is lost: return (B, L'), with 0 outside the mask.",
    ),
}

MASKED_WHITEN = Exercise(
    name="masked_whiten",
    reference=ch95.masked_whiten,
    also_right=(
        _whitened(_scaled_by(lambda x, m: (x[m].mean(), x[m].std()))),
        _whitened(_scaled_by(lambda x, m: (x[m].mean(), _std(x[m])))),
    ),
    criteria={"values": 0.95, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("text", "t"),
    cases=drawn_once(
        Case("rows of very different lengths", _entries, closed_form=_by_list, visible=True, draws=3),
        Case("scattered entries and an empty row", _scattered_entries, closed_form=_by_list, visible=True),
        Case("everything kept", _whole, closed_form=_by_list),
        Case("equal entries: 0", _CONSTANT, closed_form=_nothing, visible=True),
        Case("numbers far from 0", _FAR_FROM_ZERO, closed_form=_by_list),
        Case("single precision", _entries, dtype=torch.float32, visible=True),
        *shape_cases(_entries, _X),
    ),
    misconceptions=(
        *wrong(_WRONG_MOMENTS, lambda moments: _whitened(_scaled_by(moments))),
        *wrong(_WRONG_WHITENING, _whitened),
        dtype_lost(ch95.masked_whiten),
        in_place(ch95.masked_whiten, "x"),
        bad_input_accepted(_whitened(rows_cut(_by_sums), checked=False)),
    ),
    variants={
        "list": _whitened(_by_list),
        "placed into zeros, unbiased": _whitened(_placed),
        "sums over counts": _whitened(_by_sums),
        "layer normalisation of the kept entries": _whitened(
            lambda x, m, eps: torch.zeros_like(x).masked_scatter(m, F.layer_norm(x[m], (int(m.sum()),), eps=eps))
        ),
        "in double precision": _whitened(lambda x, m, eps: _placed(x.double(), m, eps).to(x.dtype)),
    },
)

# ------------------------------------------------------------------------------------------------------------- masked_gae


@drawing
def _tokens(generator, batch=5, length=8, shape="middle", gamma=0.9, gae_lambda=0.8, padding=1000):
    mask = _mask(generator, batch, length, shape)
    rewards, values = (_garbage(mask, normal(generator, batch, length), padding) for _ in range(2))
    return {"rewards": rewards, "values": values, "mask": mask, "gamma": gamma, "gae_lambda": gae_lambda}


def _true_values(generator):
    """A score of 1 at the end, and a critic that knows it: nothing is left to explain."""
    mask = _mask(generator, 4, 7)
    distance = (mask.flip(1).cumsum(1).flip(1) - 1).double()  # tokens left behind this one
    values = torch.where(mask, 0.9**distance, 5.0)
    return {"rewards": _last(mask).double(), "values": values, "mask": mask, "gamma": 0.9, "gae_lambda": 0.7}


_AS_IN_PRACTICE = _tokens(gamma=1, gae_lambda=0.95)


def _gae_by_sums(rewards, values, mask, gamma, gae_lambda):
    """The definition: the sum of (γλ)^k δ_{t+k} over the rest of the completion."""
    advantages = torch.zeros_like(rewards)
    for row in range(len(rewards)):
        kept = mask[row].nonzero().flatten().tolist()
        worth = [values[row, t].item() for t in kept] + [0.0]
        deltas = [rewards[row, t].item() + gamma * worth[k + 1] - worth[k] for k, t in enumerate(kept)]
        for k, t in enumerate(kept):
            advantages[row, t] = sum((gamma * gae_lambda) ** (j - k) * deltas[j] for j in range(k, len(kept)))
    return advantages


def _rewards_to_go(rewards, values, mask, gamma, gae_lambda):
    to_go = _zeroed(rewards, mask).flip(1).cumsum(1).flip(1)
    return _zeroed(to_go - values, mask)


_GAE = ("rewards", "values", "mask")
_in_range = satisfies(lambda gamma, gae_lambda: 0 <= gamma <= 1 and 0 <= gae_lambda <= 1)
_advantages = versions_of(ch95.masked_gae, one_shape(*_GAE), _in_range, data=_GAE[:2])


def _behind(x):
    """What stands in the next column; 0 behind the last one."""
    return F.pad(x[:, 1:], (0, 1))


def _residuals(r, v, m, g):
    return r + g * _behind(_zeroed(v, m)) - v


def _decay(m, g, lam):
    return g * lam * m


def _scanned(deltas, decay):
    """A_t = δ_t + decay_{t+1} A_{t+1}."""
    columns = [deltas[:, -1]]
    for t in reversed(range(deltas.shape[1] - 1)):
        columns.append(deltas[:, t] + decay[:, t + 1] * columns[-1])
    return torch.stack(columns[::-1], dim=1)


def _gae(residuals=_residuals, decay=_decay):
    """A formula: `residuals`, of rewards, values, mask and γ, summed with `decay`, of mask, γ and λ."""
    return lambda r, v, m, g, lam: _zeroed(_scanned(residuals(r, v, m, g), decay(m, g, lam)), m)


def _gae_forwards(r, v, m, g, lam):
    return _zeroed(_scanned(_residuals(r, v, m, g).flip(1), _decay(m, g, lam).flip(1)).flip(1), m)


def _gae_by_matrix(r, v, m, g, lam):
    """Advantages as one matrix product for each row."""
    steps = torch.arange(r.shape[1], dtype=r.dtype)
    powers = ((g * lam) ** (steps[:, None] - steps).clamp(min=0)).tril()
    return _zeroed(_zeroed(_residuals(r, v, m, g), m) @ powers, m)


def _gae_by_numpy(r, v, m, g, lam):
    keep = m.numpy()
    rewards, values = (np.where(keep, x.numpy().astype(float), 0.0) for x in (r, v))
    advantages, following, worth = np.zeros_like(rewards), np.zeros(len(r)), np.zeros(len(r))
    for t in range(r.shape[1] - 1, -1, -1):
        following = keep[:, t] * (rewards[:, t] + g * worth - values[:, t] + g * lam * following)
        worth = values[:, t]
        advantages[:, t] = following
    return torch.from_numpy(advantages).to(r.dtype)


_WRONG_MASKED_GAE = {
    "bootstrap-behind-the-text": (
        _gae(residuals=lambda r, v, m, g: r + g * _behind(v) - v),
        "The value in the column behind the last kept token is padding's: the text is over, its worth is 0.",
    ),
    "bootstrap-from-itself": (
        _gae(residuals=lambda r, v, m, g: r + g * torch.where(_last(m), v, _behind(v)) - v),
        "At the last kept token its own value is taken for the next one: nothing follows, so the next value is 0.",
    ),
    "recursion-through-padding": (
        _gae(decay=lambda m, g, lam: g * lam * torch.ones_like(m)),
        "Residuals of padding flow back into the text: the recursion begins at the last kept token.",
    ),
    "mask-ignored": (
        lambda r, v, m, g, lam: _scanned(r + g * _behind(v) - v, g * lam * torch.ones_like(m)),
        "The mask is not used at all: neither the bootstrap, nor the recursion, nor the result knows where the text ends.",
    ),
    "padding-not-zeroed": (lambda r, v, m, g, lam: _scanned(_residuals(r, v, m, g), _decay(m, g, lam)), _ZERO),
    "lambda-missing": (_gae(decay=lambda m, g, lam: g * m), "The recursion decays by gamma * gae_lambda: lambda is missing."),
    "gamma-missing-in-recursion": (
        _gae(decay=lambda m, g, lam: lam * m),
        "The recursion decays by gamma * gae_lambda: gamma is missing.",
    ),
    "recursion-missing": (
        _gae(decay=lambda m, g, lam: 0 * m),
        "These are one-step residuals: add gamma * gae_lambda times the next advantage.",
    ),
    "gamma-missing-in-residual": (
        _gae(residuals=lambda r, v, m, g: r + _behind(_zeroed(v, m)) - v),
        "The next value lies one token ahead: discount it by gamma.",
    ),
    "values-not-subtracted": (
        _gae(residuals=lambda r, v, m, g: r + g * _behind(_zeroed(v, m))),
        "The residual is r + gamma V' - V: V is missing, so these are no advantages.",
    ),
    "next-value-missing": (
        _gae(residuals=lambda r, v, m, g: r - v),
        "The residual is r + gamma V' - V: the next token's value is missing.",
    ),
    "sign-flipped": (
        _gae(residuals=lambda r, v, m, g: -_residuals(r, v, m, g)),
        "Positive means better than expected: the residual is r + gamma V' - V.",
    ),
    "forwards-in-time": (
        _gae_forwards,
        "The recursion runs forwards: a token is credited for what came before it. Begin at the last token.",
    ),
    "returns": (lambda r, v, m, *rest: _gae()(r, v, m, *rest) + _zeroed(v, m), "These are the returns, advantages plus values."),
}

MASKED_GAE = Exercise(
    name="masked_gae",
    reference=ch95.masked_gae,
    criteria={"values": 1.35, "gradient": 0.2, "dtype": 0.1, "inputs": 0.1, "errors": 0.25},
    axes=("text", "t"),
    last_step_first=True,
    cases=drawn_once(
        Case("completions in the middle of their rows", _tokens(), closed_form=_gae_by_sums, visible=True, draws=3),
        Case("completions at the end of their rows", _tokens(shape="right"), closed_form=_gae_by_sums, visible=True),
        Case("completions that begin in the first column", _tokens(shape="left"), closed_form=_gae_by_sums),
        Case("every token kept", _all_kept(_tokens(length=5, padding=1)), closed_form=_gae_by_sums),
        Case("gamma = 1, gae_lambda = 1: rewards to go minus values", _tokens(gamma=1, gae_lambda=1), closed_form=_rewards_to_go),
        Case("gae_lambda = 0: one-step residuals", _tokens(gae_lambda=0), closed_form=_gae_by_sums),
        Case("gamma = 0: reward minus value", _tokens(gamma=0), closed_form=_gae_by_sums),
        Case("gamma = 1, gae_lambda = 0.95, as in practice", _AS_IN_PRACTICE, closed_form=_gae_by_sums, visible=True),
        Case("true values leave nothing to explain", _true_values, closed_form=_nothing, visible=True),
        Case("inputs that require gradient", _tokens(), differentiate=_GAE[:2], visible=True),
        Case("single precision", _tokens(), dtype=torch.float32, visible=True),
        *shape_cases(_tokens(), _GAE),
        refused(_tokens(), gamma=1.5, visible=True),
        refused(_tokens(), gae_lambda=-0.1),
    ),
    misconceptions=(
        *wrong(_WRONG_MASKED_GAE, _advantages),
        Misconception(
            "graph-kept",
            _advantages(_gae(), leak=True),
            "Advantages are data for the losses: detach them, or the policy's loss trains the critic.",
        ),
        dtype_lost(ch95.masked_gae),
        in_place(ch95.masked_gae, "rewards"),
        bad_input_accepted(_advantages(rows_cut(_gae()), checked=False)),
    ),
    variants={
        "residuals first, then a scan": _advantages(_gae()),
        "definition": _advantages(_gae_by_sums),
        "matrix of powers": _advantages(_gae_by_matrix),
        "NumPy": _advantages(_gae_by_numpy),
    },
)

# --------------------------------------------------------------------------------------------------------- ppo_token_loss


def _off_bounds(log_ratio, clip_range):
    """The same log-ratios, moved where the ratio is within 0.01 of a bound: there the gradient is not graded."""
    near = (log_ratio.expm1().abs() - clip_range).abs() < 0.01
    return torch.where(near, log_ratio + 0.03, log_ratio)


@drawing
def _epoch(generator, batch=5, length=7, spread=0.35, **scalars):
    """A policy some steps away from the one that sampled; rows of 1 and of many tokens."""
    mask = _uneven_mask(generator, batch, length)
    old_logps = -2 + normal(generator, batch, length)
    logps = old_logps + _off_bounds(spread * normal(generator, batch, length), scalars.get("clip_range", 0.2))
    advantages = _garbage(mask, 0.3 + normal(generator, batch, length))
    old_logps = torch.where(mask, old_logps, old_logps - 3)
    return {"logps": logps, "old_logps": old_logps, "advantages": advantages, "mask": mask} | scalars


def _one_far_ratio(generator):
    drawn = _EPOCH(generator)
    drawn["logps"][0, 1], drawn["advantages"][0, 1] = drawn["old_logps"][0, 1] + 8, -1.0
    return drawn


_EPOCH = _epoch()
_FIRST_STEP = altered(_EPOCH, lambda drawn: {"old_logps": torch.where(drawn["mask"], drawn["logps"], drawn["old_logps"])})
_LOUD_EPOCH = loud_padding(_EPOCH, "logps", "old_logps", "advantages")
_LOUD_UNCLIPPED = loud_padding(_epoch(clip_range=math.inf), "logps", "old_logps", "advantages")


def _loss_by_tokens(logps, old_logps, advantages, mask, clip_range=0.2):
    terms = []
    for new, old, advantage in zip(*(_listed(x, mask) for x in (logps, old_logps, advantages)), strict=True):
        ratio = math.exp(new - old)
        terms.append(min(ratio * advantage, min(max(ratio, 1 - clip_range), 1 + clip_range) * advantage))
    return torch.tensor(-math.fsum(terms) / len(terms), dtype=logps.dtype)


_PPO = ("logps", "old_logps", "advantages", "mask")
_PPO_RULES = (one_shape(*_PPO), satisfies(lambda clip_range: clip_range >= 0))
_ppo = versions_of(ch95.ppo_token_loss, *_PPO_RULES, data=("old_logps", "advantages"))


def _clipped(r, a, e):
    return -torch.minimum(r * a, r.clamp(1 - e, 1 + e) * a)


def _mean(terms, m):
    return terms[m].mean()


def _ratio(new, old):
    return (new - old).exp()


def _loss(objective=_clipped, mean=_mean, ratio=_ratio):
    """A formula: `objective` of ratios, advantages and range, `mean` of the terms and the mask; padding is set to 0 before."""
    return lambda new, old, a, m, e: mean(objective(ratio(_zeroed(new, m), _zeroed(old, m)), _zeroed(a, m), e), m)


def _by_conditions(r, a, e):
    return torch.where((a > 0) & (r > 1 + e), -(1 + e) * a, torch.where((a < 0) & (r < 1 - e), -(1 - e) * a, -r * a))


def _excess(r, a, e):
    """The plain loss, and back what went past the bound in the advantage's direction."""
    past = torch.where(a > 0, (r - (1 + e)).clamp(min=0), (r - (1 - e)).clamp(max=0))
    return -(r - past) * a


_WRONG_PPO_TOKEN_LOSS = {
    "mean-of-row-means": (
        _loss(mean=lambda terms, m: (_zeroed(terms, m).sum(1) / m.sum(1)).mean()),
        _ROW_MEANS + wild.also("row_means", "token_policy_loss"),
    ),
    "divided-by-everything": (
        _loss(mean=lambda terms, m: _zeroed(terms, m).mean()),
        "The sum is over kept tokens, and so is the count: here it is divided by the size of the whole batch with its padding.",
    ),
    "summed-over-tokens": (
        _loss(mean=lambda terms, m: _zeroed(terms, m).sum(1).mean()),
        "A sum over each text, averaged over texts, weighs with the length: take the mean over all kept tokens.",
    ),
    "ratio-of-sequences": (
        _loss(ratio=lambda new, old: (new - old).sum(1, keepdim=True).exp().expand_as(new)),
        "One ratio for the whole text, the product over its tokens, leaves the clip's interval almost at once: each token has its own.",
    ),
    "ratio-of-padding": (
        lambda new, old, a, m, e: _clipped(_ratio(new, old), a, e)[m].mean(),
        "The value is right and the gradient NaN: the ratio is formed for padding, too, where exp overflows, and infinity times the"
        " mask's 0 is NaN on the way back. Leave padding out before exp, as in (logps - old_logps)[mask].",
    ),
    "sign-missing": (_loss(lambda r, a, e: -_clipped(r, a, e)), "The objective is to be maximised, a loss minimised: negate it."),
    "not-clipped": (_loss(lambda r, a, e: -r * a), "Nothing is clipped."),
    "clipped-only": (
        _loss(lambda r, a, e: -r.clamp(1 - e, 1 + e) * a),
        "The minimum with the unclipped term is missing: tokens on the wrong side of the interval get no gradient back.",
    ),
    "maximum-instead-of-minimum": (
        _loss(lambda r, a, e: -torch.maximum(r * a, r.clamp(1 - e, 1 + e) * a)),
        "The minimum of the two objectives is the pessimistic one (of the two losses, the maximum).",
    ),
    "ratio-inverted": (_loss(ratio=lambda new, old: (old - new).exp()), "The ratio is new over old: exp(logps - old_logps)."),
    "log-ratio": (
        _loss(lambda r, a, e: -torch.minimum(r.log() * a, r.log().clamp(-e, e) * a)),
        "This is the log-ratio: take its exponential.",
    ),
    "policy-gradient": (
        lambda new, old, a, m, e: -(new * a)[m].mean(),
        "This is the plain policy gradient, right for a single step: the ratio to the sampling policy is missing.",
    ),
    "clip-range-ignored": (
        _loss(lambda r, a, e: _clipped(r, a, 0.2)),
        "The range is 0.2 whatever the caller says: use clip_range.",
    ),
    "advantages-whitened-inside": (
        lambda new, old, a, m, e: ch95.ppo_token_loss(new, old, _placed(a, m, 1e-8), m, e),
        "The loss takes the advantages as they come; whoever calls it decides on whitening.",
    ),
}
_LEAKS = {
    "gradient-into-old-logps": (
        versions_of(ch95.ppo_token_loss, *_PPO_RULES, data=["advantages"]),
        "The sampling policy is data: detach old_logps, or the gradients of the two sides cancel.",
    ),
    "gradient-into-advantages": (
        versions_of(ch95.ppo_token_loss, *_PPO_RULES, data=["old_logps"]),
        "The policy's loss must not train the critic: detach the advantages.",
    ),
}

PPO_TOKEN_LOSS = Exercise(
    name="ppo_token_loss",
    reference=ch95.ppo_token_loss,
    criteria={"values": 1.2, "gradient": 0.4, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    cases=drawn_once(
        Case("rows of very different lengths", _EPOCH, closed_form=_loss_by_tokens, visible=True, draws=3),
        Case("clip_range = 0.05", _epoch(clip_range=0.05), closed_form=_loss_by_tokens, visible=True),
        Case("clip_range = 0", _epoch(clip_range=0.0), closed_form=_loss_by_tokens),
        Case("clip_range = infinity", _epoch(clip_range=math.inf), closed_form=_loss_by_tokens),
        Case(
            "the first step: minus the mean advantage",
            _FIRST_STEP,
            closed_form=lambda advantages, mask, **_rest: -advantages[mask].mean(),
            visible=True,
        ),
        Case("ratios far outside", _epoch(spread=2.0), closed_form=_loss_by_tokens),
        Case("a token that has become 3,000 times as likely", _one_far_ratio, closed_form=_loss_by_tokens),
        Case("everything kept", _all_kept(_epoch(3, 5)), closed_form=_loss_by_tokens),
        Case("what is given requires gradient", _EPOCH, differentiate=_PPO[:3], visible=True, draws=3),
        Case("gradient in the first step", _FIRST_STEP, differentiate=_PPO[:3], visible=True),
        Case("gradient where padding holds ±10,000", _LOUD_EPOCH, differentiate=_PPO[:3], visible=True),
        Case("gradient where padding holds ±10,000, any range", _LOUD_UNCLIPPED, differentiate=_PPO[:3]),
        Case("single precision", _EPOCH, dtype=torch.float32, visible=True),
        *shape_cases(_EPOCH, _PPO),
        refused(_EPOCH, clip_range=-0.1, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_PPO_TOKEN_LOSS, _ppo),
        *wrong(_LEAKS, lambda leaking: leaking(_loss())),
        python_float(ch95.ppo_token_loss),
        cut_from_graph(ch95.ppo_token_loss),
        dtype_lost(ch95.ppo_token_loss),
        in_place(ch95.ppo_token_loss, "logps"),
        bad_input_accepted(_ppo(rows_cut(_loss()), checked=False)),
    ),
    variants={
        "maximum of the losses": _ppo(_loss(lambda r, a, e: torch.maximum(-r * a, -r.clamp(1 - e, 1 + e) * a))),
        "by conditions": _ppo(_loss(_by_conditions)),
        "excess past the bound": _ppo(_loss(_excess)),
        "sum over count": _ppo(_loss(mean=lambda terms, m: _zeroed(terms, m).sum() / m.sum())),
        "weights of 1 / count, in double precision": _ppo(
            _loss(mean=lambda terms, m: (terms.double() * (m.double() / m.sum())).sum().to(terms.dtype))
        ),
    },
)

# ---------------------------------------------------------------------------------------------------------- rlhf_iteration

_LIKED = 1  # the token that the score counts
_TOKENS = 5  # of which the last one ends texts


@drawing
def _iteration(generator, prompts=("0", "21", "3", "02", "1", "30"), moved=0.4, learning_rate=0.5, **settings):
    """Tables in place of networks, and prompts of unequal length. One minibatch for all texts, so that the order makes no difference."""
    table = 0.4 * normal(generator, _TOKENS, _TOKENS)
    chosen = {"kl_coef": 0.3, "new_tokens": 5, "epochs": 2, "minibatch": 500, "max_grad_norm": 100.0, "clip_range": 0.1}
    return {
        "actor": built(
            "language.tables.TableActor",
            table=table + moved * normal(generator, _TOKENS, _TOKENS),
            weights=0.3 * normal(generator, 1, _TOKENS),
            learning_rate=learning_rate,
            critic_learning_rate=0.2,
        ),
        "reference": built("language.tables.Bigrams", table=table),
        "prompts": list(prompts),
        "score": built("language.tables.fondness", token=_LIKED),
        "settings": built("language.fine_tuning.TokenPPO", **(chosen | {"gamma": 0.9, "gae_lambda": 0.7} | settings)),
        "generator": built("seeding.generator", seed=int(integers(generator, 0, 2**31, 1))),
    }


def _written(samples, end):
    return ch95.completion_mask(samples.input_ids, samples.prompt_lengths, end)[:, 1:]


def _targets(advantages, values, mask):
    """The advantages of the loss, and what the critic should have said."""
    return ch95.masked_whiten(advantages, mask), advantages + values


def _parts(count, settings, generator):
    return ch45.minibatches(count, settings.minibatch, generator)


def _told(scores, log_ratio, mask, fractions):
    return {
        "score": scores.mean().item(),
        "kl": torch.where(mask, log_ratio, 0).sum(1).mean().item(),
        "tokens": mask.sum(1).double().mean().item(),
        "clip_fraction": statistics.fmean(fractions),
    }


def _of_policy(policy, samples):
    return ch95.per_token_logps(policy.logits(samples.input_ids, samples.attention_mask), samples.input_ids)


def _iterating(
    mask=_written,
    columns=slice(None, -1),
    rewards=ch95.kl_penalized_rewards,
    targets=_targets,
    old=lambda old, ref, new: old,
    parts: Callable[..., Any] = _parts,
    value_loss=lambda errors, kept: ch95.masked_mean(errors**2, kept),
    sign=1,
    write=lambda policy, prompts, settings, generator: policy.generate(prompts, settings.new_tokens, generator=generator),
    again=False,
    renewed=False,
    trained=lambda actor, reference: actor,
    follow=False,
    told=_told,
    **fixed,
):
    """A version of the iteration, from the places where it can go wrong; `fixed` are settings of its own, whatever the caller's are."""

    def version(actor, reference, prompts, score, settings, generator):
        s = replace(settings, **fixed)
        learner = trained(actor, reference)

        def look():
            with torch.no_grad():
                old_logps, ref_logps = (_of_policy(model, samples) for model in (learner.policy, reference))
                features = reference.hidden(samples.input_ids, samples.attention_mask)[:, columns]
                values = learner.critic(features).squeeze(-1)
            given = rewards(scores, old_logps, ref_logps, kept, s.kl_coef)
            advantages = ch95.masked_gae(given, values, kept, s.gamma, s.gae_lambda)
            return old_logps, ref_logps, features, *targets(advantages, values, kept)

        samples = write(learner.policy, prompts, s, generator)
        kept, scores, fractions = mask(samples, learner.policy.end_id), score(samples), []
        old_logps, ref_logps, features, advantages, returns = look()
        log_ratio = old_logps - ref_logps
        first = scores, log_ratio, kept
        for epoch in range(s.epochs):
            if again and epoch:
                samples = write(learner.policy, prompts, s, generator)
                kept, scores = mask(samples, learner.policy.end_id), score(samples)
            if (again or renewed) and epoch:
                ratio_to, _, features, advantages, returns = look()
                old_logps = ratio_to if again else old_logps
            for rows in parts(len(prompts), s, generator):
                logps = _of_policy(learner.policy, samples)[rows]
                before = old(old_logps[rows], ref_logps[rows], logps.detach())
                loss = ch95.ppo_token_loss(logps, before, advantages[rows], kept[rows], s.clip_range)
                errors = learner.critic(features[rows]).squeeze(-1) - returns[rows]
                learner.step(sign * loss + value_loss(errors, kept[rows]), s.max_grad_norm)
                outside = ((logps.detach() - before).exp() - 1).abs() > s.clip_range
                fractions.append(outside[kept[rows]].double().mean().item())
        if follow:
            reference.load_state_dict(actor.policy.state_dict())
        return told(*first, fractions)

    return version


class _ReferenceAsActor:
    """The reference in the policy's place."""

    def __init__(self, actor, reference):
        self.policy, self.critic, self.actor = reference, actor.critic, actor

    def step(self, loss, max_grad_norm):
        (gradient,) = torch.autograd.grad(loss, self.policy.table)
        self.policy.table.data.sub_(self.actor.rates[0] * gradient)
        self.actor.steps.add_(1)


def _row_by_row(actor, reference, prompts, score, settings, generator):
    """A variant: kept tokens flattened once, the loss by hand, slices of a permutation."""
    samples = actor.policy.generate(prompts, settings.new_tokens, generator=generator)
    ids, attention, count = samples.input_ids, samples.attention_mask, len(prompts)
    mask = ch95.completion_mask(ids, samples.prompt_lengths, actor.policy.end_id)[:, 1:]
    known = reference.hidden(ids, attention)[:, :-1].detach()
    old = ch95.per_token_logps(actor.policy.logits(ids, attention), ids).detach()
    ref = ch95.per_token_logps(reference.logits(ids, attention), ids).detach()
    values = actor.critic(known)[..., 0].detach()
    scores = score(samples)
    rewards = ch95.kl_penalized_rewards(scores, old, ref, mask, settings.kl_coef)
    advantages = ch95.masked_gae(rewards, values, mask, settings.gamma, settings.gae_lambda)
    targets, weights = values + advantages, ch95.masked_whiten(advantages, mask)
    clipped, steps = 0.0, 0
    for _ in range(settings.epochs):
        order = torch.randperm(count, generator=generator)
        for start in range(0, count, settings.minibatch):
            rows = order[start : start + settings.minibatch]
            here = mask[rows]
            logps = ch95.per_token_logps(actor.policy.logits(ids[rows], attention[rows]), ids[rows])[here]
            ratio = (logps - old[rows][here]).exp()
            bounded = ratio.clamp(1 - settings.clip_range, 1 + settings.clip_range)
            gain = torch.minimum(ratio * weights[rows][here], bounded * weights[rows][here]).mean()
            misses = actor.critic(known[rows][here])[:, 0] - targets[rows][here]
            actor.step(misses.square().mean() - gain, settings.max_grad_norm)
            clipped += float(((ratio - 1).abs() > settings.clip_range).double().mean())
            steps += 1
    per_text = ((old - ref) * mask).sum(1)
    return {
        "score": float(scores.mean()),
        "kl": float(per_text.mean()),
        "tokens": float(mask.sum() / count),
        "clip_fraction": clipped / steps,
    }


_BOTH: dict[str, Any] = {"returns": ("actor", "reference")}
_HABITS: dict[str, Any] = {"repeat": 6, "returns": ("actor",), "view": "habits_of_a_table"}
_LONG: dict[str, Any] = {"prompts": ("0", "21", "3", "02", "1", "30") * 8, "moved": 0.0, "gae_lambda": 1.0}
_iter = lambda name, inputs, **options: Case(name, inputs, **({"rtol": 1e-4, "atol": 1e-5, "draws": 1} | options))  # noqa: E731

_WRONG_RLHF_ITERATION = {
    "mask-not-shifted": (
        _iterating(mask=lambda samples, end: ch95.completion_mask(samples.input_ids, samples.prompt_lengths, end)[:, :-1]),
        "The mask is aligned with input_ids, log-probabilities begin with the second token: completion_mask(...)[:, 1:] goes with them.",
    ),
    "prompt-counted": (
        _iterating(mask=lambda samples, end: samples.attention_mask[:, 1:]),
        "The prompt's tokens are trained, too: the policy did not choose them. Use completion_mask.",
    ),
    "end-dropped": (
        _iterating(mask=lambda samples, end: _written(samples, end) & (samples.input_ids[:, 1:] != end)),
        "The end token is a choice: without its gradient the policy never learns when to stop.",
    ),
    "features-not-shifted": (
        _iterating(columns=slice(1, None)),
        "The critic reads what is known *after* each choice, which is what it should foresee: the features are hidden[:, :-1].",
    ),
    "reference-in-the-ratio": (
        _iterating(old=lambda old, ref, new: ref),
        "The ratio is against the reference: it belongs in the penalty. In the ratio stands the policy that wrote the texts.",
    ),
    "old-logps-renewed": (
        _iterating(old=lambda old, ref, new: new),
        "The old log-probabilities are computed anew in each minibatch, so that all ratios are 1 and the clip does nothing: ask once,"
        " before the first step.",
    ),
    "penalty-forgotten": (
        _iterating(kl_coef=0.0),
        "Nothing holds the policy near the reference: hand settings.kl_coef to kl_penalized_rewards.",
    ),
    "penalty-turned-round": (
        _iterating(rewards=lambda scores, old, ref, mask, price: ch95.kl_penalized_rewards(scores, ref, old, mask, price)),
        "Policy and reference are exchanged in the penalty: it pays for leaving.",
    ),
    "not-whitened": (
        _iterating(targets=lambda advantages, values, mask: (advantages, advantages + values)),
        "The advantages go into the loss as they are, in units of score: whiten them.",
    ),
    "targets-whitened": (
        _iterating(
            targets=lambda advantages, values, mask: (
                ch95.masked_whiten(advantages, mask),
                ch95.masked_whiten(advantages, mask) + values,
            )
        ),
        "The critic's targets are made of whitened advantages, which have lost the score's unit: add the values before whitening.",
    ),
    "targets-without-values": (
        _iterating(targets=lambda advantages, values, mask: (ch95.masked_whiten(advantages, mask), advantages)),
        "The critic is fitted to the advantages: its targets are advantages plus values.",
    ),
    "critic-not-trained": (
        _iterating(value_loss=lambda errors, kept: 0 * errors.sum()),
        "The critic never learns: the loss of a step is the policy's plus the mean of its squared errors.",
    ),
    "errors-halved": (
        _iterating(value_loss=lambda errors, kept: 0.5 * ch95.masked_mean(errors**2, kept)),
        "There is no half in front of the critic's squared errors.",
    ),
    "errors-in-padding": (
        _iterating(value_loss=lambda errors, kept: (errors**2).mean()),
        "The critic is fitted in prompt and padding, too, where it is asked nothing: masked_mean.",
    ),
    "uphill": (_iterating(sign=-1), "ppo_token_loss is negated already: step down its gradient."),
    "one-epoch-only": (_iterating(epochs=1), "The texts are used once: settings.epochs says how often."),
    "whole-batch-at-once": (
        _iterating(parts=lambda count, s, generator: [torch.arange(count)]),
        "There is one step in each pass: make one for each minibatch.",
    ),
    "gradient-not-shortened": (_iterating(max_grad_norm=1e9), "Hand settings.max_grad_norm to actor.step."),
    "clip-range-fixed": (_iterating(clip_range=0.2), "The clip range is 0.2 whatever the settings say."),
    "discounts-fixed": (_iterating(gamma=1.0, gae_lambda=0.95), "gamma and gae_lambda of the settings are not used."),
    "written-anew": (
        _iterating(again=True),
        "New texts are written for each epoch: PPO uses one batch several times, which is what the ratio is for.",
    ),
    "advantages-renewed": (
        _iterating(renewed=True),
        "Rewards and advantages are computed again in each epoch, with the policy and the critic as they are then: estimate once.",
    ),
    "reference-trained": (
        _iterating(trained=_ReferenceAsActor),
        "The reference writes and is changed: the policy is actor.policy.",
    ),
    "reference-follows": (
        _iterating(follow=True),
        "The reference takes over the policy's weights: it is what training began from, and stays.",
    ),
    "copy-trained": (
        _iterating(trained=lambda actor, reference: copy.deepcopy(actor)),
        "The actor that was handed in has not changed: a copy was trained. Change it in place.",
    ),
    "kl-of-a-token": (
        _iterating(
            told=lambda scores, ratio, mask, fractions: (
                _told(scores, ratio, mask, fractions) | {"kl": ch95.masked_mean(ratio, mask).item()}
            )
        ),
        "kl is that of a token: add up each text's log-ratios, then take the mean over texts.",
    ),
}

RLHF_ITERATION = Exercise(
    name="rlhf_iteration",
    reference=ch95.rlhf_iteration,
    criteria={"values": 3.0},
    cases=(
        _iter("what it learns in six iterations", _iteration(**_LONG, kl_coef=0.0, learning_rate=30.0), **_HABITS, visible=True),
        _iter("what a high price holds", _iteration(**_LONG, kl_coef=8.0, learning_rate=3.0), **_HABITS, visible=True),
        _iter("actor and reference after one iteration", _iteration(), **_BOTH, visible=True),
        _iter("a policy that is its reference", _iteration(moved=0.0), **_BOTH),
        _iter("narrow bounds, many passes", _iteration(clip_range=0.02, epochs=4), **_BOTH, visible=True),
        _iter("a short gradient", _iteration(max_grad_norm=0.003), **_BOTH),
        _iter("what is told", _iteration(clip_range=0.02, epochs=3), visible=True),
        _iter("steps of small minibatches", _iteration(minibatch=4), returns=("actor",), view="steps_made", visible=True),
        _iter("what is drawn from", _iteration(), returns=("generator",), view="drawn_from"),
    ),
    misconceptions=wrong(_WRONG_RLHF_ITERATION),
    variants={
        "parts by name": _iterating(),
        "kept tokens only": _row_by_row,
        "slices of a permutation": _iterating(
            parts=lambda count, s, generator: torch.randperm(count, generator=generator).split(s.minibatch)
        ),
        "advantages shifted and scaled by hand": _iterating(
            targets=lambda a, values, mask: ((a - a[mask].mean()) / (a[mask].var(correction=0) + 1e-8).sqrt(), a + values)
        ),
    },
)

# ------------------------------------------------------------------------------------------------- repaired_reward_scaling


@drawing
def _paid(generator, batch=5, length=8, shape="middle", score=2.0):
    """Small penalties for every token, a score at each text's last one, padding that holds anything."""
    mask = _uneven_mask(generator, batch, length, shape)
    penalties = -0.1 + 0.2 * normal(generator, batch, length)
    scores = score + normal(generator, batch, 1)
    return {"rewards": _garbage(mask, penalties + scores * _last(mask)), "mask": mask}


def _scaled_by_list(rewards, mask):
    return _by_list(rewards, mask, centred=False)


_scaled = versions_of(ch95.repaired_reward_scaling, one_shape("rewards", "mask"))

_LEVEL = (
    "A constant is taken from the reward of every token: a text of n tokens then gains or loses n times as much, and the policy learns to"
    " stop early or late. Change the unit only."
)
_WRONG_SHIFTS_AND_SCALES = {
    "mean-subtracted": (lambda r, m: (r[m].mean(), _std(r[m])), _LEVEL),
    "mean-of-each-text-subtracted": (
        lambda r, m: (_of_rows(torch.mean, r, m), _std(r[m])),
        "With its own mean taken away, every text is worth 0 in sum: nothing tells a good one from a bad one.",
    ),
    "mean-score-subtracted-at-the-end": (
        lambda r, m: (r[_last(m)].mean() * _last(m), _std(r[m])),
        "The mean score is taken from the last reward: no text's rank changes, but the deviation of what is returned is no longer 1.",
    ),
    "a-scale-for-each-text": (
        lambda r, m: (0, _of_rows(_std, r, m)),
        "Each text has a unit of its own, so texts can no longer be compared: one deviation for the batch.",
    ),
    "root-mean-square": (
        lambda r, m: (0, r[m].square().mean().sqrt()),
        "This is the root mean square: the deviation is taken around the mean, although the mean is not subtracted from the rewards.",
    ),
    "divided-by-variance": (lambda r, m: (0, _std(r[m]) ** 2), "Divide by the standard deviation, the root of the variance."),
    "deviation-over-padding": (lambda r, m: (0, r.std()), "The deviation is taken over padding too. " + _OUTSIDE),
    "padding-counted-as-zeros": (
        lambda r, m: (0, _zeroed(r, m).std()),
        "Padding is zeroed and then counted, which makes the deviation smaller: it is over kept entries only.",
    ),
    "deviation-of-the-last-rewards": (
        lambda r, m: (0, _std(r[_last(m)])),
        "This is the deviation of the texts' last rewards: take that of all kept entries.",
    ),
    "not-scaled": (lambda r, m: (0, 1), "The rewards are as they were: bring them to unit deviation."),
}
_WRONG_SCALING = {
    "mean-subtracted-and-added-back": (
        lambda r, m, eps: _zeroed((r - r[m].mean()) / (_std(r[m]) + eps) + r[m].mean(), m),
        "(x - mean) / std + mean still moves every token by mean * (1 - 1 / std): divide, and subtract nothing.",
    ),
    "padding-not-zeroed": (lambda r, m, eps: r / (_std(r[m]) + eps), _ZERO),
}

REPAIRED_REWARD_SCALING = Exercise(
    name="repaired_reward_scaling",
    reference=ch95.repaired_reward_scaling,
    also_right=(  # the contract leaves the kind of deviation and the place of eps open
        _scaled(_scaled_by(lambda r, m: (0, _std(r[m])))),
        _scaled(_scaled_by(lambda r, m: (0, r[m].std()))),
    ),
    criteria={"values": 1.7, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("text", "t"),
    cases=drawn_once(
        Case("scores at the ends of texts of all lengths", _paid(), closed_form=_scaled_by_list, visible=True, draws=3),
        Case("texts at the end of their rows", _paid(shape="right"), closed_form=_scaled_by_list, visible=True),
        Case("bad scores", _paid(score=-3.0), closed_form=_scaled_by_list),
        Case("scores a thousand times as large", _paid(score=2000.0), closed_form=_scaled_by_list),
        Case("every token kept", _all_kept(_paid(length=5)), closed_form=_scaled_by_list),
        Case("single precision", _paid(), dtype=torch.float32, visible=True),
        *shape_cases(_paid(), ("rewards", "mask")),
    ),
    misconceptions=(
        *wrong(_WRONG_SHIFTS_AND_SCALES, lambda moments: _scaled(_scaled_by(moments))),
        *wrong(_WRONG_SCALING, _scaled),
        dtype_lost(ch95.repaired_reward_scaling),
        in_place(ch95.repaired_reward_scaling, "rewards"),
        bad_input_accepted(_scaled(rows_cut(_scaled_by(lambda r, m: (0, r[m].std()))), checked=False)),
    ),
    variants={
        "list": _scaled(lambda r, m, eps: _scaled_by_list(r, m)),
        "unbiased deviation": _scaled(_scaled_by(lambda r, m: (0, r[m].std()))),
        "whitened, and the mean put back in its new unit": _scaled(
            lambda r, m, eps: _zeroed(ch95.masked_whiten(r, m, eps) + r[m].mean() / (_std(r[m]) + eps), m)
        ),
        "mean of squares minus square of the mean": _scaled(
            _scaled_by(lambda r, m: (0, (r[m].square().mean() - r[m].mean().square()).clamp(min=0).sqrt()))
        ),
        "in double precision": _scaled(
            lambda r, m, eps: _zeroed(r.double() / (r[m].double().var(correction=0) + eps).sqrt(), m).to(r.dtype)
        ),
    },
)

EXERCISES = (
    PER_TOKEN_LOGPS,
    COMPLETION_MASK,
    KL_PENALIZED_REWARDS,
    MASKED_MEAN,
    MASKED_WHITEN,
    MASKED_GAE,
    PPO_TOKEN_LOSS,
    RLHF_ITERATION,
    REPAIRED_REWARD_SCALING,
)
