"""Checks of chapter 95: cases, named misconceptions and correct variants for PPO on the tokens of a language model."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch.nn import functional

from autograder.authoring.parts import (
    IN_PLACE,
    SHAPES,
    after,
    cut_from_graph,
    drawn_once,
    dtype_lost,
    in_place,
    integers,
    loud_padding,
    normal,
    python_float,
    refused,
    reshaped,
    shape_cases,
)
from autograder.authoring.spec import Case, Exercise, Misconception
from solutions import ch95

INF = math.inf

_OUTSIDE = "What lies outside the mask must not matter: padding may hold any number."
_ZERO = "Outside the mask the result is 0, so that sums over it need no second mask."
_ROW_MEANS = (
    "This is a mean of row means: a token of a short completion counts for more than one of a long completion. Divide the sum over all"
    " kept entries by their number."
)

# -------------------------------------------------------------------------------------------------------- per_token_logps


def _logits(batch=3, length=6, vocabulary=7, scale=2.0):
    def inputs(generator):
        return {
            "logits": scale * normal(generator, batch, length, vocabulary),
            "input_ids": integers(generator, 0, vocabulary, batch, length),
        }

    return inputs


def _even_odds(generator):
    drawn = _logits()(generator)
    return drawn | {"logits": torch.full_like(drawn["logits"], 3.0)}


def _token_by_token(logits, input_ids):
    rows = [
        torch.stack([row[t - 1][ids[t]] - torch.logsumexp(row[t - 1], 0) for t in range(1, len(ids))])
        for row, ids in zip(logits, input_ids, strict=True)
    ]
    return torch.stack(rows)


def _gathered(logps, input_ids):
    return logps.gather(-1, input_ids[..., None]).squeeze(-1)


def _logps(formula, checked=True):
    def version(logits, input_ids):
        if checked and logits.shape[:-1] != input_ids.shape:
            raise ValueError(
                f"logits {tuple(logits.shape)} and input_ids {tuple(input_ids.shape)} must agree in batch and length"
            )
        return formula(logits, input_ids)

    return version


def _unchecked_logps(logits, input_ids):
    rows, columns = min(len(logits), len(input_ids)), min(logits.shape[1], input_ids.shape[1])
    return _gathered(logits[:rows, : columns - 1].log_softmax(-1), input_ids[:rows, 1:columns])


def _cross_entropy(logits, input_ids):
    return -functional.cross_entropy(logits[:, :-1].transpose(1, 2), input_ids[:, 1:], reduction="none")


def _indexed(logits, input_ids):
    batch, length = input_ids.shape
    rows, columns = torch.arange(batch)[:, None], torch.arange(length - 1)
    chosen = logits[rows, columns, input_ids[:, 1:]]
    return chosen - logits[:, :-1].logsumexp(dim=-1)


_TEXT = ("logits", "input_ids")

PER_TOKEN_LOGPS = Exercise(
    name="per_token_logps",
    reference=ch95.per_token_logps,
    criteria={"values": 1.0, "gradient": 0.2, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("text", "t"),
    cases=drawn_once(
        Case("three texts of six tokens", _logits(), closed_form=_token_by_token, visible=True, draws=3),
        Case(
            "all tokens equally likely: -log V",
            _even_odds,
            closed_form=lambda logits, input_ids: torch.full(input_ids[:, 1:].shape, -math.log(7), dtype=logits.dtype),
            visible=True,
        ),
        Case("as many positions as tokens in the vocabulary", _logits(2, 7, 7), closed_form=_token_by_token),
        Case("tokens that the model finds impossible", _logits(scale=2000.0), closed_form=_token_by_token, visible=True),
        Case("a text of two tokens", _logits(1, 2), closed_form=_token_by_token),
        Case("logits that require gradient", _logits(), differentiate=["logits"], visible=True),
        Case("single precision", _logits(), dtype=torch.float32, visible=True),
        *shape_cases(_logits(), _TEXT),
        Case("input_ids already shifted", reshaped(_logits(), "input_ids", lambda ids: ids[:, 1:]), raises=_TEXT, draws=1),
    ),
    misconceptions=(
        Misconception(
            "not-shifted",
            _logps(lambda x, i: _gathered(x.log_softmax(-1), i)[:, :-1]),
            "The logits at position t predict the token at t + 1: logits[:, :-1] go with input_ids[:, 1:].",
        ),
        Misconception(
            "not-shifted-last-columns",
            _logps(lambda x, i: _gathered(x.log_softmax(-1), i)[:, 1:]),
            "Dropping the first column of the result is no shift: each token is still looked up in logits that have seen it.",
        ),
        Misconception(
            "shifted-the-wrong-way",
            _logps(lambda x, i: _gathered(x[:, 1:].log_softmax(-1), i[:, :-1])),
            "The logits and the tokens are shifted the wrong way: logits[:, :-1] go with input_ids[:, 1:].",
        ),
        Misconception(
            "logits-not-normalised",
            _logps(lambda x, i: _gathered(x[:, :-1], i[:, 1:])),
            "Logits are log-probabilities only up to a constant for each position: take log_softmax over the vocabulary.",
        ),
        Misconception(
            "normalised-over-positions",
            _logps(lambda x, i: _gathered(x[:, :-1].log_softmax(1), i[:, 1:])),
            "softmax is taken over positions: the probabilities of one position's tokens sum to 1, so use dim=-1.",
        ),
        Misconception(
            "normalised-with-the-last-position-over-everything",
            _logps(lambda x, i: _gathered(x[:, :-1].flatten(1).log_softmax(-1).view_as(x[:, :-1]), i[:, 1:])),
            "One softmax for the whole text: every position has a distribution of its own.",
        ),
        Misconception(
            "probabilities",
            _logps(lambda x, i: _gathered(x[:, :-1].softmax(-1), i[:, 1:])),
            "These are probabilities: logarithms are asked for.",
        ),
        Misconception(
            "logarithm-of-softmax",
            _logps(lambda x, i: _gathered(x[:, :-1].softmax(-1), i[:, 1:]).log()),
            "The softmax of an unlikely token underflows to 0, whose logarithm is -inf: use log_softmax.",
        ),
        Misconception(
            "losses",
            _logps(lambda x, i: -_gathered(x[:, :-1].log_softmax(-1), i[:, 1:])),
            "Cross-entropy is minus the log-probability: the sign is missing.",
        ),
        Misconception(
            "summed-over-the-text",
            after(ch95.per_token_logps, lambda logps: logps.sum(1)),
            "One number for each token is asked for, (B, L - 1).",
        ),
        cut_from_graph(ch95.per_token_logps),
        dtype_lost(ch95.per_token_logps),
        in_place(ch95.per_token_logps, "logits"),
        Misconception("bad-input-accepted", _logps(_unchecked_logps, checked=False), SHAPES),
    ),
    variants={
        "token by token": _logps(_token_by_token),
        "cross-entropy": _logps(_cross_entropy),
        "chosen logit minus logsumexp": _logps(_indexed),
        "one-hot": _logps(
            lambda x, i: (x[:, :-1].log_softmax(-1) * functional.one_hot(i[:, 1:], x.shape[-1]).to(x.dtype)).sum(-1)
        ),
        "distribution object, in double precision": _logps(
            lambda x, i: torch.distributions.Categorical(logits=x[:, :-1].double()).log_prob(i[:, 1:]).to(x.dtype)
        ),
    },
)

# -------------------------------------------------------------------------------------------------------- completion_mask

END = 2


def _sampled(batch=6, length=10, end_rate=0.2, start=(2, 6), **scalars):
    """Prompts of several lengths, tokens at random among which are end tokens, also in prompts."""

    def inputs(generator):
        ordinary = integers(generator, 3, 50, batch, length)
        ends = torch.rand(batch, length, generator=generator) < end_rate
        return {
            "input_ids": torch.where(ends, END, ordinary),
            "prompt_lengths": integers(generator, *start, batch),
            "eos_token_id": END,
        } | scalars

    return inputs


def _with_tokens(change):
    def inputs(generator):
        drawn = _sampled(end_rate=0.0)(generator)
        rows = torch.arange(len(drawn["input_ids"]))
        change(drawn["input_ids"], rows, drawn["prompt_lengths"], generator)
        return drawn

    return inputs


def _end_within_prompts(ids, rows, starts, generator):
    ids[rows, starts - 1] = END
    ids[rows, starts - 2] = END


def _end_at_once(ids, rows, starts, generator):
    ids[rows, starts] = END
    ids[rows, -1] = END


def _padded_with_ends(ids, rows, starts, generator):
    """Left padding and right padding by the end token, as GPT-2 has no other."""
    ids[:, :1] = END
    for row, start in zip(rows, starts + 1 + integers(generator, 0, 3, len(rows)), strict=True):
        ids[row, start:] = END


def _end_in_last_column(ids, rows, starts, generator):
    ids[rows, -1] = END


def _walk(input_ids, prompt_lengths, eos_token_id):
    mask = torch.zeros(input_ids.shape, dtype=torch.bool)
    for row, ids in enumerate(input_ids.tolist()):
        for column in range(int(prompt_lengths[row]), len(ids)):
            mask[row, column] = True
            if ids[column] == eos_token_id:
                break
    return mask


def _completions(formula, checked=True):
    """A version: `formula` takes "is an end token" (B, L), columns (L,) and starts (B, 1)."""

    def version(input_ids, prompt_lengths, eos_token_id):
        if checked and len(prompt_lengths) != len(input_ids):
            raise ValueError(f"prompt_lengths has {len(prompt_lengths)} rows, but input_ids has {len(input_ids)}")
        ends = input_ids == eos_token_id
        if not checked and len(prompt_lengths) not in (1, len(ends)):
            rows = min(len(prompt_lengths), len(ends))
            ends, prompt_lengths = ends[:rows], prompt_lengths[:rows]
        return formula(ends, torch.arange(input_ids.shape[1]), prompt_lengths[:, None])

    return version


def _kept(ends, columns, starts):
    ends = ends & (columns >= starts)
    return (columns >= starts) & (ends.cumsum(1) - ends.long() == 0)


def _kept_by_position(ends, columns, starts):
    ends = ends & (columns >= starts)
    last = torch.where(ends.any(1), ends.int().argmax(1), len(columns) - 1)
    return (columns >= starts) & (columns <= last[:, None])


def _kept_by_cummax(ends, columns, starts):
    begun = columns >= starts
    over = torch.cummax((ends & begun).long(), dim=1).values
    return begun & ~functional.pad(over[:, :-1], (1, 0)).bool()


def _kept_by_minimum(ends, columns, starts):
    stops = torch.where(ends & (columns >= starts), columns, len(columns)).amin(1, keepdim=True)
    return columns.ge(starts) & columns.le(stops)


_ROWS = ("input_ids", "prompt_lengths")

COMPLETION_MASK = Exercise(
    name="completion_mask",
    reference=ch95.completion_mask,
    criteria={"values": 1.2, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("text", "column"),
    cases=(
        Case("end tokens anywhere", _sampled(), closed_form=_walk, visible=True, draws=3),
        Case("no end token: all the rest is kept", _sampled(end_rate=0.0), closed_form=_walk, visible=True),
        Case("end tokens within the prompts", _with_tokens(_end_within_prompts), closed_form=_walk, visible=True),
        Case("completions that end at once", _with_tokens(_end_at_once), closed_form=_walk),
        Case("padding by end tokens on both sides", _with_tokens(_padded_with_ends), closed_form=_walk, visible=True),
        Case("the end token in the last column", _with_tokens(_end_in_last_column), closed_form=_walk),
        Case("many end tokens", _sampled(end_rate=0.6), closed_form=_walk),
        Case("prompts that fill their rows", _sampled(start=(10, 11)), closed_form=_walk),
        Case("no prompts", _sampled(start=(0, 1)), closed_form=_walk),
        Case("another end token", _sampled(eos_token_id=7, length=40), closed_form=_walk),
        *shape_cases(_sampled(), _ROWS),
    ),
    misconceptions=(
        Misconception(
            "end-token-excluded",
            _completions(lambda ends, columns, starts: _kept(ends, columns, starts) & ~ends),
            "Ending the text was the policy's choice too: the first end token is kept, or the policy never learns when to stop.",
        ),
        Misconception(
            "ends-ignored",
            _completions(lambda ends, columns, starts: columns >= starts),
            "What follows the end token is padding: keep nothing behind it.",
        ),
        Misconception(
            "prompt-included",
            _completions(lambda ends, columns, starts: _kept(ends, columns, starts) | (columns < starts)),
            "The prompt was given, not chosen: the mask begins at prompt_lengths.",
        ),
        Misconception(
            "end-tokens-of-the-prompt-count",
            _completions(lambda ends, columns, starts: (columns >= starts) & (ends.cumsum(1) - ends.long() == 0)),
            "An end token before prompt_lengths, as padding or within the prompt, ends nothing: look at or after that column only.",
        ),
        Misconception(
            "last-end-token",
            _completions(
                lambda ends, columns, starts: (
                    (columns >= starts)
                    & (
                        columns
                        <= torch.where(ends & (columns >= starts), columns, -1)
                        .amax(1, keepdim=True)
                        .where((ends & (columns >= starts)).any(1, keepdim=True), torch.tensor(len(columns)))
                    )
                )
            ),
            "The text is over at the first end token: those behind it are padding.",
        ),
        Misconception(
            "empty-without-end",
            _completions(
                lambda ends, columns, starts: _kept(ends, columns, starts) & (ends & (columns >= starts)).any(1, keepdim=True)
            ),
            "A completion that was cut off before an end token is kept to the last column: argmax of no True is 0.",
        ),
        Misconception(
            "one-column-early",
            _completions(lambda ends, columns, starts: _kept(ends, columns, starts) | (columns == starts - 1)),
            "The mask is aligned with input_ids, and begins at column prompt_lengths[b], not before it.",
        ),
        Misconception(
            "one-column-late",
            _completions(lambda ends, columns, starts: _kept(ends, columns, starts) & (columns > starts)),
            "Column prompt_lengths[b] holds the completion's first token, and is kept.",
        ),
        Misconception(
            "one-start-for-all",
            _completions(lambda ends, columns, starts: _kept(ends, columns, starts[:1].expand_as(starts))),
            "Each row has a prompt length of its own.",
        ),
        Misconception(
            "all-but-end-tokens",
            _completions(lambda ends, columns, starts: (columns >= starts) & ~ends),
            "Masking end tokens by their identity keeps what follows the first one, and drops that one itself.",
        ),
        Misconception(
            "integers",
            after(ch95.completion_mask, torch.Tensor.long),
            "Masks are bool: `~mask` of an integer is something else, and indexing with it picks rows.",
        ),
        Misconception(
            "input-changed",
            lambda input_ids, prompt_lengths, eos_token_id: (
                ch95.completion_mask(input_ids, prompt_lengths, eos_token_id),
                prompt_lengths.add_(1),
            )[0],
            IN_PLACE,
        ),
        Misconception("bad-input-accepted", _completions(_kept, checked=False), SHAPES),
    ),
    variants={
        "walk": lambda input_ids, prompt_lengths, eos_token_id: (
            _completions(lambda *_: None)(input_ids, prompt_lengths, eos_token_id)
            or _walk(input_ids, prompt_lengths, eos_token_id)
        ),
        "position of the first end": _completions(_kept_by_position),
        "running maximum": _completions(_kept_by_cummax),
        "smallest column of an end": _completions(_kept_by_minimum),
        "NumPy": _completions(
            lambda ends, columns, starts: torch.from_numpy(
                np.logical_and(
                    columns.numpy() >= starts.numpy(),
                    np.cumsum(np.pad((ends & (columns >= starts)).numpy(), ((0, 0), (1, 0)))[:, :-1], axis=1) == 0,
                )
            )
        ),
    },
)

# --------------------------------------------------------------------------------------------------- kl_penalized_rewards


def _mask(generator, batch, length, shape="middle"):
    """Contiguous kept tokens, at least one in each row; at the left, the right, or in the middle."""
    count = integers(generator, 1, length - 2, batch)
    start = {"left": torch.zeros_like(count), "right": length - count, "middle": torch.ones_like(count)}[shape]
    columns = torch.arange(length)
    return (columns >= start[:, None]) & (columns < (start + count)[:, None])


def _garbage(mask, x, times=1000):
    """Padding holds numbers a thousand times as large."""
    return torch.where(mask, x, times * x)


def _penalised(batch=5, length=8, kl_coef=0.1, shape="middle", spread=1.0):
    def inputs(generator):
        mask = _mask(generator, batch, length, shape)
        logps = -2 + normal(generator, batch, length)
        return {
            "scores": 1 + 2 * normal(generator, batch),
            "logps": logps,
            "ref_logps": _garbage(mask, logps + spread * normal(generator, batch, length)),
            "mask": mask,
            "kl_coef": kl_coef,
        }

    return inputs


def _all_kept(inputs):
    def whole(generator):
        drawn = inputs(generator)
        return drawn | {"mask": torch.ones_like(drawn["mask"])}

    return whole


def _still_the_reference(generator):
    drawn = _penalised()(generator)
    return drawn | {"ref_logps": drawn["logps"].clone()}


def _penalised_by_loop(scores, logps, ref_logps, mask, kl_coef):
    rewards = torch.zeros_like(logps)
    for row in range(len(rewards)):
        kept = mask[row].nonzero().flatten().tolist()
        for t in kept:
            rewards[row, t] = -kl_coef * (logps[row, t].item() - ref_logps[row, t].item())
        rewards[row, kept[-1]] += scores[row].item()
    return rewards


_PENALISED = ("scores", "logps", "ref_logps", "mask")


def _last(mask):
    """One-hot (B, L') at each row's last kept token."""
    return mask & (mask.flip(1).cumsum(1).flip(1) == 1)


def _penalty_version(formula, checked=True, detach=True):
    """A version: `formula` takes scores (B, 1), log-ratios, mask and coefficient."""

    def version(scores, logps, ref_logps, mask, kl_coef):
        if checked:
            if not logps.shape == ref_logps.shape == mask.shape:
                raise ValueError(f"logps, ref_logps and mask need one shape, got {logps.shape}, {ref_logps.shape}, {mask.shape}")
            if scores.shape != logps.shape[:1]:
                raise ValueError(f"scores must have one entry for each row of logps, got {tuple(scores.shape)}")
        elif len({len(scores), len(logps), len(ref_logps), len(mask)}) > 1:  # what broadcasts, or is cut short
            rows = min(len(x) for x in (scores, logps, ref_logps, mask) if len(x) > 1)
            scores, logps, ref_logps, mask = (x if len(x) == 1 else x[:rows] for x in (scores, logps, ref_logps, mask))
        rewards = formula(scores.reshape(-1)[:, None], logps - ref_logps, mask, kl_coef)
        return rewards.detach() if detach else rewards

    return version


def _penalised_right(scores, ratio, mask, kl_coef):
    return torch.where(mask, -kl_coef * ratio, 0) + scores * _last(mask)


def _penalised_by_index(scores, ratio, mask, kl_coef):
    rewards = (-kl_coef * ratio).masked_fill(~mask, 0.0)
    last = mask.shape[1] - 1 - mask.flip(1).int().argmax(1)
    return rewards.scatter_add(1, last[:, None], scores.to(rewards.dtype))


def _with_score_at(where):
    return _penalty_version(lambda s, d, m, b: torch.where(m, -b * d, 0) + torch.where(where(m), s, 0))


def _with_penalty(penalty):
    return _penalty_version(lambda s, d, m, b: torch.where(m, penalty(d, m, b), 0) + s * _last(m))


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
        Case(
            "kl_coef = 0: the score at the last token",
            _penalised(kl_coef=0.0),
            closed_form=lambda scores, mask, **_rest: scores[:, None] * _last(mask),
            visible=True,
        ),
        Case(
            "policy and reference agree",
            _still_the_reference,
            closed_form=lambda scores, mask, **_r: scores[:, None] * _last(mask),
        ),
        Case("kl_coef = 2", _penalised(kl_coef=2.0), closed_form=_penalised_by_loop),
        Case("inputs that require gradient", _penalised(), differentiate=_PENALISED[:3], visible=True),
        Case("single precision", _penalised(), dtype=torch.float32, visible=True),
        *shape_cases(_penalised(), _PENALISED),
        Case(
            "scores as a column", reshaped(_penalised(), "scores", lambda x: x[:, None]), raises=_PENALISED, visible=True, draws=1
        ),
    ),
    misconceptions=(
        Misconception(
            "penalty-added",
            _with_penalty(lambda d, m, b: b * d),
            "Moving away from the reference is rewarded: the penalty is -kl_coef * (logps - ref_logps).",
        ),
        Misconception(
            "penalty-missing",
            _with_penalty(lambda d, m, b: torch.zeros_like(d)),
            "The score alone: nothing holds the policy near the reference.",
        ),
        Misconception(
            "coefficient-missing",
            _with_penalty(lambda d, m, b: -d),
            "kl_coef is not used.",
        ),
        Misconception(
            "penalty-summed-at-the-end",
            _penalty_version(lambda s, d, m, b: (s - b * torch.where(m, d, 0).sum(1, keepdim=True)) * _last(m)),
            "The sum is right, but all of it stands at the last token: each token pays for its own departure.",
        ),
        Misconception(
            "penalty-averaged-over-the-text",
            _with_penalty(lambda d, m, b: -b * d / m.sum(1, keepdim=True)),
            "The penalty is not divided by the length: longer texts may depart further in total, and pay for it.",
        ),
        Misconception(
            "absolute-difference",
            _with_penalty(lambda d, m, b: -b * d.abs()),
            "The log-ratio keeps its sign: only its mean over the policy's own samples is the KL, single ones may be negative.",
        ),
        Misconception(
            "never-negative-estimate",
            _with_penalty(lambda d, m, b: -b * ((-d).exp() - 1 + d)),
            "This is the k3 estimate, good as a metric; as a reward its gradient is another one: use the log-ratio itself.",
        ),
        Misconception(
            "score-at-every-token",
            _with_score_at(lambda m: m),
            "The score is paid once, at the last kept token: here it is paid as often as the text is long.",
        ),
        Misconception(
            "score-in-the-last-column",
            _with_score_at(lambda m: torch.arange(m.shape[1]).expand_as(m) == m.shape[1] - 1),
            "The last column is padding for most rows: the score belongs to each row's last kept token.",
        ),
        Misconception(
            "score-at-the-first-token",
            _with_score_at(lambda m: m & (m.cumsum(1) == 1)),
            "argmax finds the first kept token: the score comes when the text is finished.",
        ),
        Misconception(
            "score-behind-the-text",
            _with_score_at(lambda m: _last(m).roll(1, 1)),
            "One column too far: the score stands at the last kept token, not on the padding behind it.",
        ),
        Misconception(
            "score-replaces-the-penalty",
            _penalty_version(lambda s, d, m, b: torch.where(_last(m), s, torch.where(m, -b * d, 0))),
            "At the last token penalty and score are added; here one overwrites the other.",
        ),
        Misconception(
            "mask-ignored",
            _penalty_version(lambda s, d, m, b: -b * d + s * _last(m)),
            "Prompt and padding are penalised too: outside the mask the reward is 0.",
        ),
        Misconception(
            "graph-kept",
            _penalty_version(_penalised_right, detach=False),
            "Rewards are data: with a graph the policy would also be trained through its own penalty. Detach them.",
        ),
        dtype_lost(ch95.kl_penalized_rewards),
        in_place(ch95.kl_penalized_rewards, "logps", 1),
        Misconception("bad-input-accepted", _penalty_version(_penalised_right, checked=False), SHAPES),
    ),
    variants={
        "loop": lambda scores, logps, ref_logps, mask, kl_coef: (
            _penalty_version(lambda *_: torch.zeros(()))(scores, logps, ref_logps, mask, kl_coef)
            + _penalised_by_loop(scores, logps, ref_logps, mask, kl_coef)
        ),
        "score at the last one of a reversed count": _penalty_version(_penalised_right),
        "scatter": _penalty_version(_penalised_by_index),
        "difference of two masks": _penalty_version(
            lambda s, d, m, b: (-b * d).masked_fill(~m, 0) + s * (m & ~functional.pad(m[:, 1:], (0, 1)))
        ),
        "in double precision": _penalty_version(lambda s, d, m, b: _penalised_right(s.double(), d.double(), m, b).to(d.dtype)),
    },
)

# ------------------------------------------------------------------------------------------- masked_mean and masked_whiten


def _entries(batch=4, length=7, shape="middle"):
    def inputs(generator):
        mask = _mask(generator, batch, length, shape)
        mask[0] = torch.arange(length) == 1
        mask[1] = torch.arange(length) > 0  # rows of 1 and of 6: their means count alike only by mistake
        return {"x": _garbage(mask, 0.5 + normal(generator, batch, length)), "mask": mask}

    return inputs


def _scattered(generator):
    x = normal(generator, 5, 6)
    mask = torch.rand(5, 6, generator=generator) < 0.5
    mask[0, :3] = torch.tensor([True, True, False])
    mask[2] = False
    return {"x": x, "mask": mask}


def _whole(generator):
    return {"x": normal(generator, 3, 5), "mask": torch.ones(3, 5, dtype=torch.bool)}


def _with_zeros(generator):
    drawn = _entries()(generator)
    return drawn | {"x": drawn["x"].clamp(min=0)}


def _one_kept(generator):
    return {"x": normal(generator, 3, 5), "mask": torch.arange(15).reshape(3, 5) == int(integers(generator, 0, 15))}


def _listed(x, mask):
    return [
        value for row, kept in zip(x.tolist(), mask.tolist(), strict=True) for value, keep in zip(row, kept, strict=True) if keep
    ]


def _mean_by_list(x, mask):
    kept = _listed(x, mask)
    return torch.tensor(math.fsum(kept) / len(kept), dtype=x.dtype)


def _masked(formula, checked=True):
    def version(x, mask, *settings, **named):
        if checked and x.shape != mask.shape:
            raise ValueError(f"mask has shape {tuple(mask.shape)}, but x has {tuple(x.shape)}")
        if not checked and len(x) != len(mask):
            rows = min(len(x), len(mask))
            x, mask = x[: max(rows, 1)], mask[: max(rows, 1)]
        return formula(x, mask, *settings, **named)

    return version


def _zeroed(x, mask):
    return torch.where(mask, x, 0)


_X = ("x", "mask")

MASKED_MEAN = Exercise(
    name="masked_mean",
    reference=ch95.masked_mean,
    criteria={"values": 0.7, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    cases=drawn_once(
        Case("rows of very different lengths", _entries(), closed_form=_mean_by_list, visible=True, draws=3),
        Case("scattered entries and an empty row", _scattered, closed_form=_mean_by_list, visible=True),
        Case("everything kept", _whole, closed_form=_mean_by_list),
        Case("one entry kept", _one_kept, closed_form=_mean_by_list, visible=True),
        Case("zeros among the kept entries", _with_zeros, closed_form=_mean_by_list),
        Case("single precision", _entries(), dtype=torch.float32, visible=True),
        *shape_cases(_entries(), _X),
    ),
    misconceptions=(
        Misconception("mask-ignored", _masked(lambda x, m: x.mean()), _OUTSIDE),
        Misconception(
            "divided-by-everything",
            _masked(lambda x, m: _zeroed(x, m).mean()),
            "The sum is over kept entries, and so is the count: here the sum is divided by the size of the whole tensor.",
        ),
        Misconception(
            "mean-of-row-means", _masked(lambda x, m: (_zeroed(x, m).sum(1) / m.sum(1).clamp(min=1)).mean()), _ROW_MEANS
        ),
        Misconception(
            "one-mean-for-each-row",
            _masked(lambda x, m: _zeroed(x, m).sum(1) / m.sum(1).clamp(min=1)),
            "One number for the whole batch is asked for.",
        ),
        Misconception("sum", _masked(lambda x, m: x[m].sum()), "Divide by the number of kept entries."),
        Misconception(
            "divided-by-rows", _masked(lambda x, m: x[m].sum() / len(x)), "Divide by the number of kept entries, not of rows."
        ),
        Misconception(
            "mask-inverted",
            _masked(lambda x, m: _zeroed(x, ~m).sum() / (~m).sum().clamp(min=1)),
            "True means keep: the mask is the wrong way round.",
        ),
        Misconception(
            "count-off-by-a-constant",
            _masked(lambda x, m: x[m].sum() / (m.sum() + 1)),
            "A constant in the denominator biases small counts: divide by the number of kept entries.",
        ),
        python_float(ch95.masked_mean),
        dtype_lost(ch95.masked_mean),
        in_place(ch95.masked_mean, "x"),
        Misconception("bad-input-accepted", _masked(lambda x, m: torch.where(m, x, 0).sum() / m.sum(), checked=False), SHAPES),
    ),
    variants={
        "sum over count": _masked(lambda x, m: _zeroed(x, m).sum() / m.sum()),
        "product with the mask": _masked(lambda x, m: (x * m).sum() / m.sum()),
        "list": _masked(_mean_by_list),
        "masked_select, in double precision": _masked(lambda x, m: torch.masked_select(x, m).double().mean().to(x.dtype)),
        "nanmean": _masked(lambda x, m: x.masked_fill(~m, math.nan).nanmean()),
    },
)


def _constant(generator):
    drawn = _entries()(generator)
    return drawn | {"x": _garbage(drawn["mask"], torch.full_like(drawn["x"], 3.0))}


def _far_from_zero(generator):
    drawn = _entries()(generator)
    return drawn | {"x": torch.where(drawn["mask"], drawn["x"].sign() * 4 + 1e4, drawn["x"])}


def _whitened(centre, deviation):
    """A version: `centre` and `deviation` take x and mask."""

    def formula(x, mask, eps=1e-8):
        mean = centre(x, mask)
        return torch.where(mask, (x - mean) / (deviation(x, mask) + eps), 0)

    return _masked(formula)


def _kept_mean(x, mask):
    return x[mask].mean()


def _kept_std(x, mask):
    return x[mask].std(correction=0)


def _unbiased(x, mask, eps=1e-8):
    ch95.masked_whiten(x, mask, eps)
    return torch.where(mask, (x - x[mask].mean()) / (x[mask].std() + eps), 0)


def _eps_outside(x, mask, eps=1e-8):
    ch95.masked_whiten(x, mask, eps)
    return torch.where(mask, (x - x[mask].mean()) / (x[mask].std(correction=0) + eps), 0)


def _whiten_by_list(x, mask, eps=1e-8):
    kept = _listed(x, mask)
    mean = math.fsum(kept) / len(kept)
    variance = math.fsum((value - mean) ** 2 for value in kept) / len(kept)
    rows = [
        [(value - mean) / math.sqrt(variance + eps) if keep else 0.0 for value, keep in zip(row, flags, strict=True)]
        for row, flags in zip(x.tolist(), mask.tolist(), strict=True)
    ]
    return torch.tensor(rows, dtype=x.dtype)


def _by_placing(x, mask, eps=1e-8):
    result = torch.zeros_like(x)
    kept = x[mask]
    result[mask] = (kept - kept.mean()) / (kept.std() + eps)
    return result


def _row_stats(function):
    return lambda x, mask: torch.stack(
        [function(row[kept]) if kept.any() else row.new_zeros(()) for row, kept in zip(x, mask, strict=True)]
    )[:, None]


MASKED_WHITEN = Exercise(
    name="masked_whiten",
    reference=ch95.masked_whiten,
    also_right=(_unbiased, _eps_outside),
    criteria={"values": 0.95, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("text", "t"),
    cases=drawn_once(
        Case("rows of very different lengths", _entries(), closed_form=_whiten_by_list, visible=True, draws=3),
        Case("scattered entries and an empty row", _scattered, closed_form=_whiten_by_list, visible=True),
        Case("everything kept", _whole, closed_form=_whiten_by_list),
        Case("equal entries: 0", _constant, closed_form=lambda x, mask: torch.zeros_like(x), visible=True),
        Case("numbers far from 0", _far_from_zero, closed_form=_whiten_by_list),
        Case("single precision", _entries(), dtype=torch.float32, visible=True),
        *shape_cases(_entries(), _X),
    ),
    misconceptions=(
        Misconception(
            "statistics-over-padding",
            _whitened(lambda x, m: x.mean(), lambda x, m: x.std()),
            "Mean and deviation are taken over padding too. " + _OUTSIDE,
        ),
        Misconception(
            "padding-counted-as-zeros",
            _whitened(lambda x, m: _zeroed(x, m).mean(), lambda x, m: _zeroed(x, m).std()),
            "Padding is zeroed and then counted, which pulls the mean to 0: statistics are over kept entries only.",
        ),
        Misconception(
            "row-by-row",
            _whitened(_row_stats(torch.mean), _row_stats(lambda kept: kept.std(correction=0))),
            "Each row is whitened by itself, which erases the differences between texts: take statistics over the batch.",
        ),
        Misconception(
            "not-centred",
            _whitened(lambda x, m: 0.0, _kept_std),
            "Subtract the mean of the kept entries as well.",
        ),
        Misconception(
            "only-centred",
            _whitened(_kept_mean, lambda x, m: 1.0),
            "Divide by the standard deviation of the kept entries as well.",
        ),
        Misconception(
            "divided-by-variance",
            _whitened(_kept_mean, lambda x, m: x[m].var(correction=0)),
            "Divide by the standard deviation, the root of the variance.",
        ),
        Misconception(
            "deviation-not-around-the-mean",
            _whitened(_kept_mean, lambda x, m: x[m].square().mean().sqrt()),
            "This divides by the root mean square: subtract the mean before squaring.",
        ),
        Misconception(
            "padding-not-zeroed",
            _masked(lambda x, m, eps=1e-8: (x - _kept_mean(x, m)) / (_kept_std(x, m) + eps)),
            _ZERO,
        ),
        Misconception(
            "eps-missing",
            _masked(lambda x, m, eps=1e-8: torch.where(m, (x - _kept_mean(x, m)) / _kept_std(x, m), 0)),
            "Equal entries give 0 / 0: eps keeps the denominator above 0.",
        ),
        Misconception(
            "kept-entries-only",
            _masked(lambda x, m, eps=1e-8: (x[m] - _kept_mean(x, m)) / (_kept_std(x, m) + eps)),
            "The shape is lost: return (B, L'), with 0 outside the mask.",
        ),
        dtype_lost(ch95.masked_whiten),
        in_place(ch95.masked_whiten, "x"),
        Misconception(
            "bad-input-accepted",
            _masked(
                lambda x, m, eps=1e-8: torch.where(m, (x - x[m.expand_as(x)].mean()) / (x[m.expand_as(x)].var() + eps).sqrt(), 0),
                checked=False,
            ),
            SHAPES,
        ),
    ),
    variants={
        "list": _masked(_whiten_by_list),
        "placed into zeros, unbiased": _masked(_by_placing),
        "sums over counts": _masked(
            lambda x, m, eps=1e-8: (
                _zeroed(x - _zeroed(x, m).sum() / m.sum(), m)
                * (_zeroed(x - _zeroed(x, m).sum() / m.sum(), m).square().sum() / m.sum() + eps).rsqrt()
            )
        ),
        "layer normalisation of the kept entries": _masked(
            lambda x, m, eps=1e-8: torch.zeros_like(x).masked_scatter(m, functional.layer_norm(x[m], (int(m.sum()),), eps=eps))
        ),
        "in double precision": _masked(lambda x, m, eps=1e-8: _by_placing(x.double(), m, eps).to(x.dtype)),
    },
)

# ------------------------------------------------------------------------------------------------------------- masked_gae


def _tokens(batch=5, length=8, shape="middle", gamma=0.9, gae_lambda=0.8, padding=1000):
    def inputs(generator):
        mask = _mask(generator, batch, length, shape)
        return {
            "rewards": _garbage(mask, normal(generator, batch, length), padding),
            "values": _garbage(mask, normal(generator, batch, length), padding),
            "mask": mask,
            "gamma": gamma,
            "gae_lambda": gae_lambda,
        }

    return inputs


def _true_values(generator):
    """A score of 1 at the end, and a critic that knows it: nothing is left to explain."""
    mask = _mask(generator, 4, 7)
    gamma = 0.9
    distance = (mask.flip(1).cumsum(1).flip(1) - 1).double()  # tokens left behind this one
    return {
        "rewards": _last(mask).double(),
        "values": torch.where(mask, gamma**distance, 5.0),
        "mask": mask,
        "gamma": gamma,
        "gae_lambda": 0.7,
    }


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
    to_go = torch.where(mask, rewards, 0).flip(1).cumsum(1).flip(1)
    return torch.where(mask, to_go - values, 0)


_GAE = ("rewards", "values", "mask")


def _scan(
    next_values=lambda v, m: functional.pad(_zeroed(v, m)[:, 1:], (0, 1)),
    recursion=None,
    values_at=None,
    reward=None,
    zero=True,
    detach=True,
    checked=True,
):
    """A version of the estimator: `next_values` (B, L') from values and mask, `recursion` from mask, γ and λ, `reward` from r, γ."""

    def version(rewards, values, mask, gamma, gae_lambda):
        if checked:
            for name, other in (("values", values), ("mask", mask)):
                if other.shape != rewards.shape:
                    raise ValueError(f"{name} has shape {tuple(other.shape)}, but rewards has {tuple(rewards.shape)}")
            for name, value in (("gamma", gamma), ("gae_lambda", gae_lambda)):
                if value < 0 or value > 1:
                    raise ValueError(f"expected 0 <= {name} <= 1, but received {value!r}")
        elif len({len(rewards), len(values), len(mask)}) > 1:
            rows = min(len(x) for x in (rewards, values, mask) if len(x) > 1)
            rewards, values, mask = (x[:rows].expand(rows, -1) for x in (rewards, values, mask))
        paid = reward(rewards, gamma) if reward else rewards
        deltas = paid + gamma * next_values(values, mask) - (values if values_at is None else values_at(values, mask))
        decay = recursion(mask, gamma, gae_lambda) if recursion else gamma * gae_lambda * mask
        following = torch.zeros_like(deltas[:, 0])
        columns = []
        for t in reversed(range(deltas.shape[1])):
            following = deltas[:, t] + (decay[:, t + 1] if t + 1 < deltas.shape[1] else 0) * following
            columns.append(following)
        advantages = torch.stack(columns[::-1], dim=1)
        advantages = _zeroed(advantages, mask) if zero else advantages
        return advantages.detach() if detach else advantages

    return version


def _gae_matrix(rewards, values, mask, gamma, gae_lambda):
    """Advantages as one matrix product for each row."""
    _scan()(rewards, values, mask, gamma, gae_lambda)
    rewards, values = _zeroed(rewards, mask).detach(), _zeroed(values, mask).detach()
    deltas = rewards + gamma * functional.pad(values[:, 1:], (0, 1)) - values
    steps = torch.arange(rewards.shape[1])
    powers = torch.where(
        steps[:, None] >= steps, (gamma * gae_lambda) ** (steps[:, None] - steps).clamp(min=0).to(rewards.dtype), 0
    )
    return _zeroed(_zeroed(deltas, mask) @ powers.to(rewards.dtype), mask)


def _gae_numpy(rewards, values, mask, gamma, gae_lambda):
    _scan()(rewards, values, mask, gamma, gae_lambda)
    keep = mask.numpy().astype(float)
    r, v = (np.where(mask.numpy(), x.detach().numpy().astype(float), 0.0) for x in (rewards, values))
    advantages, following, worth = np.zeros_like(r), np.zeros(len(r)), np.zeros(len(r))
    for t in range(r.shape[1] - 1, -1, -1):
        following = keep[:, t] * (r[:, t] + gamma * worth - v[:, t] + gamma * gae_lambda * following)
        worth = v[:, t]
        advantages[:, t] = following
    return torch.from_numpy(advantages).to(rewards.dtype)


def _gae_row_by_row(rewards, values, mask, gamma, gae_lambda):
    _scan()(rewards, values, mask, gamma, gae_lambda)
    return _gae_by_sums(rewards, values, mask, gamma, gae_lambda).detach()


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
        Case(
            "gamma = 1, gae_lambda = 0.95, as in practice",
            _tokens(gamma=1, gae_lambda=0.95),
            closed_form=_gae_by_sums,
            visible=True,
        ),
        Case(
            "true values leave nothing to explain",
            _true_values,
            closed_form=lambda rewards, **_rest: torch.zeros_like(rewards),
            visible=True,
        ),
        Case("inputs that require gradient", _tokens(), differentiate=_GAE[:2], visible=True),
        Case("single precision", _tokens(), dtype=torch.float32, visible=True),
        *shape_cases(_tokens(), _GAE),
        refused(_tokens(), gamma=1.5, visible=True),
        refused(_tokens(), gae_lambda=-0.1),
    ),
    misconceptions=(
        Misconception(
            "bootstrap-behind-the-text",
            _scan(next_values=lambda v, m: functional.pad(v[:, 1:], (0, 1))),
            "The value in the column behind the last kept token is padding's: the text is over, its worth is 0.",
        ),
        Misconception(
            "bootstrap-from-itself",
            _scan(next_values=lambda v, m: torch.where(_last(m), v, functional.pad(v[:, 1:], (0, 1)))),
            "At the last kept token its own value is taken for the next one: nothing follows, so the next value is 0.",
        ),
        Misconception(
            "recursion-through-padding",
            _scan(recursion=lambda m, g, lam: torch.full(m.shape, g * lam)),
            "Residuals of padding flow back into the text: the recursion begins at the last kept token.",
        ),
        Misconception(
            "mask-ignored",
            _scan(
                next_values=lambda v, m: functional.pad(v[:, 1:], (0, 1)),
                recursion=lambda m, g, lam: torch.full(m.shape, g * lam),
                zero=False,
            ),
            "The mask is not used at all: neither the bootstrap, nor the recursion, nor the result knows where the text ends.",
        ),
        Misconception("padding-not-zeroed", _scan(zero=False), _ZERO),
        Misconception(
            "lambda-missing",
            _scan(recursion=lambda m, g, lam: g * m),
            "The recursion decays by gamma * gae_lambda: lambda is missing.",
        ),
        Misconception(
            "gamma-missing-in-recursion",
            _scan(recursion=lambda m, g, lam: lam * m),
            "The recursion decays by gamma * gae_lambda: gamma is missing.",
        ),
        Misconception(
            "recursion-missing",
            _scan(recursion=lambda m, g, lam: 0.0 * m),
            "These are one-step residuals: add gamma * gae_lambda times the next advantage.",
        ),
        Misconception(
            "gamma-missing-in-residual",
            lambda rewards, values, mask, gamma, gae_lambda: _scan(
                next_values=lambda v, m: functional.pad(_zeroed(v, m)[:, 1:], (0, 1)) / (gamma or 1) if gamma else 0 * v,
            )(rewards, values, mask, gamma, gae_lambda),
            "The next value lies one token ahead: discount it by gamma.",
        ),
        Misconception(
            "values-not-subtracted",
            _scan(values_at=lambda v, m: 0.0),
            "The residual is r + gamma V' - V: V is missing, so these are no advantages.",
        ),
        Misconception(
            "next-value-missing",
            _scan(next_values=lambda v, m: torch.zeros_like(v)),
            "The residual is r + gamma V' - V: the next token's value is missing.",
        ),
        Misconception(
            "sign-flipped",
            after(_scan(), torch.neg),
            "Positive means better than expected: the residual is r + gamma V' - V.",
        ),
        Misconception(
            "forwards-in-time",
            lambda rewards, values, mask, gamma, gae_lambda: torch.where(
                mask,
                _scan(
                    next_values=lambda v, m: functional.pad(_zeroed(values, mask)[:, 1:], (0, 1)).flip(1),
                )(rewards.flip(1), values.flip(1), mask.flip(1), gamma, gae_lambda).flip(1),
                0,
            ),
            "The recursion runs forwards: a token is credited for what came before it. Begin at the last token.",
        ),
        Misconception(
            "returns",
            lambda rewards, values, mask, gamma, gae_lambda: (
                _scan()(rewards, values, mask, gamma, gae_lambda) + _zeroed(values, mask).detach()
            ),
            "These are the returns, advantages plus values.",
        ),
        Misconception(
            "graph-kept",
            _scan(detach=False),
            "Advantages are data for the losses: detach them, or the policy's loss trains the critic.",
        ),
        dtype_lost(ch95.masked_gae),
        in_place(ch95.masked_gae, "rewards"),
        Misconception("bad-input-accepted", _scan(checked=False), SHAPES),
    ),
    variants={
        "residuals first, then a scan": _scan(),
        "definition": _gae_row_by_row,
        "matrix of powers": _gae_matrix,
        "NumPy": _gae_numpy,
    },
)

# --------------------------------------------------------------------------------------------------------- ppo_token_loss


def _off_bounds(log_ratio, clip_range):
    """The same log-ratios, moved where the ratio is within 0.01 of a bound: there the gradient is not graded."""
    near = (log_ratio.expm1().abs() - clip_range).abs() < 0.01
    return torch.where(near, log_ratio + 0.03, log_ratio)


def _epoch(batch=5, length=7, spread=0.35, shape="middle", **scalars):
    """A policy some steps away from the one that sampled; rows of 1 and of many tokens."""

    def inputs(generator):
        mask = _mask(generator, batch, length, shape)
        mask[0] = torch.arange(length) == 1
        mask[1] = torch.arange(length) > 0
        old_logps = -2 + normal(generator, batch, length)
        log_ratio = _off_bounds(spread * normal(generator, batch, length), scalars.get("clip_range", 0.2))
        return {
            "logps": old_logps + log_ratio,
            "old_logps": torch.where(mask, old_logps, old_logps - 3),
            "advantages": _garbage(mask, 0.3 + normal(generator, batch, length)),
            "mask": mask,
        } | scalars

    return inputs


def _one_far_ratio(generator):
    drawn = _EPOCH(generator)
    drawn["logps"][0, 1], drawn["advantages"][0, 1] = drawn["old_logps"][0, 1] + 8, -1.0
    return drawn


def _first_step(generator):
    drawn = _epoch()(generator)
    return drawn | {"old_logps": torch.where(drawn["mask"], drawn["logps"], drawn["old_logps"])}


def _loss_by_tokens(logps, old_logps, advantages, mask, clip_range=0.2):
    terms = []
    for new, old, advantage in zip(_listed(logps, mask), _listed(old_logps, mask), _listed(advantages, mask), strict=True):
        ratio = math.exp(new - old)
        terms.append(min(ratio * advantage, min(max(ratio, 1 - clip_range), 1 + clip_range) * advantage))
    return torch.tensor(-math.fsum(terms) / len(terms), dtype=logps.dtype)


_PPO = ("logps", "old_logps", "advantages", "mask")


def _clip(r, a, e):
    return -torch.minimum(r * a, r.clamp(1 - e, 1 + e) * a)


def _mean(terms, mask):
    return terms[mask].mean()


def _ppo(objective=_clip, reduce=_mean, ratio=lambda new, old: (new - old).exp(), leaks=(), checked=True, masked_first=True):
    """A version: `objective` of ratios, advantages and range, `reduce` of the terms and the mask."""

    def version(logps, old_logps, advantages, mask, clip_range=0.2):
        if checked:
            for name, other in (("old_logps", old_logps), ("advantages", advantages), ("mask", mask)):
                if other.shape != logps.shape:
                    raise ValueError(f"{name} has shape {tuple(other.shape)}, but logps has {tuple(logps.shape)}")
            if clip_range < 0:
                raise ValueError(f"expected clip_range >= 0, but received {clip_range!r}")
        elif len({len(logps), len(old_logps), len(advantages), len(mask)}) > 1:
            rows = min(len(x) for x in (logps, old_logps, advantages, mask) if len(x) > 1)
            logps, old_logps, advantages, mask = (x[:rows].expand(rows, -1) for x in (logps, old_logps, advantages, mask))
        old = old_logps if "old_logps" in leaks else old_logps.detach()
        weights = advantages if "advantages" in leaks else advantages.detach()
        if masked_first:
            logps, old, weights = (_zeroed(x, mask) for x in (logps, old, weights))
        return reduce(objective(ratio(logps, old), weights, clip_range), mask)

    return version


def _excess(r, a, e):
    """The plain loss, and back what went past the bound in the advantage's direction."""
    past = torch.where(a > 0, (r - (1 + e)).clamp(min=0), (r - (1 - e)).clamp(max=0))
    return -(r - past) * a


def _by_conditions(r, a, e):
    return torch.where((a > 0) & (r > 1 + e), -(1 + e) * a, torch.where((a < 0) & (r < 1 - e), -(1 - e) * a, -r * a))


_EPOCH = _epoch()
_LOUD_EPOCH = loud_padding(_EPOCH, "logps", "old_logps", "advantages")
_LOUD_UNCLIPPED = loud_padding(_epoch(clip_range=INF), "logps", "old_logps", "advantages")

PPO_TOKEN_LOSS = Exercise(
    name="ppo_token_loss",
    reference=ch95.ppo_token_loss,
    criteria={"values": 1.2, "gradient": 0.4, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    cases=drawn_once(
        Case("rows of very different lengths", _EPOCH, closed_form=_loss_by_tokens, visible=True, draws=3),
        Case("clip_range = 0.05", _epoch(clip_range=0.05), closed_form=_loss_by_tokens, visible=True),
        Case("clip_range = 0", _epoch(clip_range=0.0), closed_form=_loss_by_tokens),
        Case("clip_range = infinity", _epoch(clip_range=INF), closed_form=_loss_by_tokens),
        Case(
            "the first step: minus the mean advantage",
            _first_step,
            closed_form=lambda advantages, mask, **_rest: -advantages[mask].mean(),
            visible=True,
        ),
        Case("ratios far outside", _epoch(spread=2.0), closed_form=_loss_by_tokens),
        Case("a token that has become 3,000 times as likely", _one_far_ratio, closed_form=_loss_by_tokens),
        Case("everything kept", _all_kept(_epoch(3, 5)), closed_form=_loss_by_tokens),
        Case("what is given requires gradient", _EPOCH, differentiate=_PPO[:3], visible=True, draws=3),
        Case("gradient in the first step", _first_step, differentiate=_PPO[:3], visible=True),
        Case("gradient where padding holds ±10,000", _LOUD_EPOCH, differentiate=_PPO[:3], visible=True),
        Case("gradient where padding holds ±10,000, any range", _LOUD_UNCLIPPED, differentiate=_PPO[:3]),
        Case("single precision", _EPOCH, dtype=torch.float32, visible=True),
        *shape_cases(_EPOCH, _PPO),
        refused(_EPOCH, clip_range=-0.1, visible=True),
    ),
    misconceptions=(
        Misconception(
            "mean-of-row-means",
            _ppo(reduce=lambda t, m: (_zeroed(t, m).sum(1) / m.sum(1)).mean()),
            _ROW_MEANS,
        ),
        Misconception(
            "divided-by-everything",
            _ppo(reduce=lambda t, m: _zeroed(t, m).mean()),
            "The sum is over kept tokens, and so is the count: here it is divided by the size of the whole batch with its padding.",
        ),
        Misconception(
            "summed-over-tokens",
            _ppo(reduce=lambda t, m: _zeroed(t, m).sum(1).mean()),
            "A sum over each text, averaged over texts, weighs with the length: take the mean over all kept tokens.",
        ),
        Misconception(
            "ratio-of-sequences",
            _ppo(ratio=lambda new, old: (new - old).sum(1, keepdim=True).exp().expand_as(new)),
            "One ratio for the whole text, the product over its tokens, leaves the clip's interval almost at once: each token has its own.",
        ),
        Misconception(
            "ratio-of-padding",
            _ppo(masked_first=False),
            "The value is right and the gradient NaN: the ratio is formed for padding, too, where exp overflows, and infinity times the"
            " mask's 0 is NaN on the way back. Leave padding out before exp, as in (logps - old_logps)[mask].",
        ),
        Misconception("sign-missing", after(_ppo(), torch.neg), "The objective is to be maximised, a loss minimised: negate it."),
        Misconception("not-clipped", _ppo(lambda r, a, e: -r * a), "Nothing is clipped."),
        Misconception(
            "clipped-only",
            _ppo(lambda r, a, e: -r.clamp(1 - e, 1 + e) * a),
            "The minimum with the unclipped term is missing: tokens on the wrong side of the interval get no gradient back.",
        ),
        Misconception(
            "maximum-instead-of-minimum",
            _ppo(lambda r, a, e: -torch.maximum(r * a, r.clamp(1 - e, 1 + e) * a)),
            "The minimum of the two objectives is the pessimistic one (of the two losses, the maximum).",
        ),
        Misconception(
            "ratio-inverted",
            _ppo(ratio=lambda new, old: (old - new).exp()),
            "The ratio is new over old: exp(logps - old_logps).",
        ),
        Misconception(
            "log-ratio",
            _ppo(lambda r, a, e: -torch.minimum(r.log() * a, r.log().clamp(-e, e) * a)),
            "This is the log-ratio: take its exponential.",
        ),
        Misconception(
            "policy-gradient",
            lambda logps, old_logps, advantages, mask, clip_range=0.2: (
                _ppo()(logps, old_logps, advantages, mask, clip_range) * 0 - (logps * advantages.detach())[mask].mean()
            ),
            "This is the plain policy gradient, right for a single step: the ratio to the sampling policy is missing.",
        ),
        Misconception(
            "clip-range-ignored",
            _ppo(lambda r, a, e: _clip(r, a, 0.2)),
            "The range is 0.2 whatever the caller says: use clip_range.",
        ),
        Misconception(
            "advantages-whitened-inside",
            lambda logps, old_logps, advantages, mask, clip_range=0.2: ch95.ppo_token_loss(
                logps, old_logps, _by_placing(advantages.detach(), mask), mask, clip_range
            ),
            "The loss takes the advantages as they come; whoever calls it decides on whitening.",
        ),
        Misconception(
            "gradient-into-old-logps",
            _ppo(leaks=("old_logps",)),
            "The sampling policy is data: detach old_logps, or the gradients of the two sides cancel.",
        ),
        Misconception(
            "gradient-into-advantages",
            _ppo(leaks=("advantages",)),
            "The policy's loss must not train the critic: detach the advantages.",
        ),
        python_float(ch95.ppo_token_loss),
        cut_from_graph(ch95.ppo_token_loss),
        dtype_lost(ch95.ppo_token_loss),
        in_place(ch95.ppo_token_loss, "logps"),
        Misconception("bad-input-accepted", _ppo(checked=False), SHAPES),
    ),
    variants={
        "maximum of the losses": _ppo(lambda r, a, e: torch.maximum(-r * a, -r.clamp(1 - e, 1 + e) * a)),
        "by conditions": _ppo(_by_conditions),
        "excess past the bound": _ppo(_excess),
        "sum over count": _ppo(reduce=lambda t, m: torch.where(m, t, 0).sum() / m.sum()),
        "weights of 1 / count, in double precision": _ppo(
            reduce=lambda t, m: (t.double() * (m.double() / m.sum())).sum().to(t.dtype)
        ),
    },
)

# ------------------------------------------------------------------------------------------------- repaired_reward_scaling


def _paid(batch=5, length=8, shape="middle", score=2.0):
    """Small penalties for every token, a score at each text's last one, padding that holds anything."""

    def inputs(generator):
        mask = _mask(generator, batch, length, shape)
        mask[0] = torch.arange(length) == 1
        mask[1] = torch.arange(length) > 0
        penalties = -0.1 + 0.2 * normal(generator, batch, length)
        scores = score + normal(generator, batch, 1)
        return {"rewards": _garbage(mask, penalties + scores * _last(mask)), "mask": mask}

    return inputs


def _scaled_by_list(rewards, mask):
    kept = _listed(rewards, mask)
    mean = math.fsum(kept) / len(kept)
    deviation = math.sqrt(math.fsum((value - mean) ** 2 for value in kept) / len(kept) + 1e-8)
    return torch.tensor(
        [
            [value / deviation if keep else 0.0 for value, keep in zip(row, flags, strict=True)]
            for row, flags in zip(rewards.tolist(), mask.tolist(), strict=True)
        ],
        dtype=rewards.dtype,
    )


def _scaled(by, shift=lambda x, m: 0.0, back=lambda x, m: 0.0, zero=True):
    """A version: `shift` is subtracted, `by` divides, `back` is added; each takes rewards and mask."""

    def formula(rewards, mask, eps=1e-8):
        scaled = (rewards - shift(rewards, mask)) / (by(rewards, mask) + eps) + back(rewards, mask)
        return _zeroed(scaled, mask) if zero else scaled

    return _masked(formula)


def _other_scaling(deviation):
    """Also right: the contract leaves the kind of deviation and the place of eps open."""

    def version(rewards, mask, eps=1e-8):
        ch95.repaired_reward_scaling(rewards, mask, eps)
        return _zeroed(rewards / deviation(rewards[mask], eps), mask)

    return version


_LEVEL = (
    "A constant is taken from the reward of every token: a text of n tokens then gains or loses n times as much, and the policy learns to"
    " stop early or late. Change the unit only."
)

REPAIRED_REWARD_SCALING = Exercise(
    name="repaired_reward_scaling",
    reference=ch95.repaired_reward_scaling,
    also_right=(
        _other_scaling(lambda kept, eps: kept.std(correction=0) + eps),
        _other_scaling(lambda kept, eps: kept.std() + eps),
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
        Misconception("mean-subtracted", _scaled(_kept_std, shift=_kept_mean), _LEVEL),
        Misconception(
            "mean-subtracted-and-added-back",
            _scaled(_kept_std, shift=_kept_mean, back=_kept_mean),
            "(x - mean) / std + mean still moves every token by mean * (1 - 1 / std): divide, and subtract nothing.",
        ),
        Misconception(
            "mean-of-each-text-subtracted",
            _scaled(_kept_std, shift=_row_stats(torch.mean)),
            "With its own mean taken away, every text is worth 0 in sum: nothing tells a good one from a bad one.",
        ),
        Misconception(
            "mean-score-subtracted-at-the-end",
            _scaled(_kept_std, shift=lambda x, m: x[_last(m)].mean() * _last(m)),
            "The mean score is taken from the last reward: no text's rank changes, but the deviation of what is returned is no longer 1.",
        ),
        Misconception(
            "a-scale-for-each-text",
            _scaled(_row_stats(lambda kept: kept.std(correction=0))),
            "Each text has a unit of its own, so texts can no longer be compared: one deviation for the batch.",
        ),
        Misconception(
            "root-mean-square",
            _scaled(lambda x, m: x[m].square().mean().sqrt()),
            "This is the root mean square: the deviation is taken around the mean, although the mean is not subtracted from the rewards.",
        ),
        Misconception(
            "divided-by-variance",
            _scaled(lambda x, m: x[m].var(correction=0)),
            "Divide by the standard deviation, the root of the variance.",
        ),
        Misconception(
            "deviation-over-padding",
            _scaled(lambda x, m: x.std()),
            "The deviation is taken over padding too. " + _OUTSIDE,
        ),
        Misconception(
            "padding-counted-as-zeros",
            _scaled(lambda x, m: _zeroed(x, m).std()),
            "Padding is zeroed and then counted, which makes the deviation smaller: it is over kept entries only.",
        ),
        Misconception(
            "deviation-of-the-last-rewards",
            _scaled(lambda x, m: x[_last(m)].std(correction=0)),
            "This is the deviation of the texts' last rewards: take that of all kept entries.",
        ),
        Misconception("not-scaled", _scaled(lambda x, m: 1.0), "The rewards are as they were: bring them to unit deviation."),
        Misconception("padding-not-zeroed", _scaled(_kept_std, zero=False), _ZERO),
        dtype_lost(ch95.repaired_reward_scaling),
        in_place(ch95.repaired_reward_scaling, "rewards"),
        Misconception(
            "bad-input-accepted",
            _masked(lambda x, m, eps=1e-8: torch.where(m, x / (x[m.expand_as(x)].var() + eps).sqrt(), 0), checked=False),
            SHAPES,
        ),
    ),
    variants={
        "list": _masked(lambda x, m, eps=1e-8: _scaled_by_list(x, m)),
        "unbiased deviation": _scaled(lambda x, m: x[m].std()),
        "whitened, and the mean put back in its new unit": _masked(
            lambda x, m, eps=1e-8: _zeroed(ch95.masked_whiten(x, m, eps) + _kept_mean(x, m) / (_kept_std(x, m) + eps), m)
        ),
        "mean of squares minus square of the mean": _scaled(
            lambda x, m: (x[m].square().mean() - x[m].mean().square()).clamp(min=0).sqrt()
        ),
        "in double precision": _masked(
            lambda x, m, eps=1e-8: _zeroed(x.double() / (x[m].double().var(correction=0) + eps).sqrt(), m).to(x.dtype)
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
    REPAIRED_REWARD_SCALING,
)
