"""Checks of chapter 96: cases, named misconceptions and correct variants for reward models and best-of-n."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch.nn import functional

from autograder.authoring.parts import (
    METRIC,
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
    replaced,
    reshaped,
    shape_cases,
)
from autograder.authoring.spec import Case, Exercise, Misconception
from solutions import ch96

# ----------------------------------------------------------------------------------------------------- last_token_scores


def _padded(side, whole_numbers=False, batch=5, length=7):
    """Texts of 2 to 5 tokens, padded on one side or on both; numbers at padding are as large as any."""

    def inputs(generator):
        lengths = integers(generator, 2, 6, batch)
        start = {"right": torch.zeros(batch), "left": length - lengths, "both": torch.ones(batch)}[side].long()
        columns = torch.arange(length)
        mask = (columns >= start[:, None]) & (columns < (start + lengths)[:, None])
        return {"values": normal(generator, batch, length), "attention_mask": mask.long() if whole_numbers else mask}

    return inputs


def _no_padding(generator):
    drawn = _padded("right")(generator)
    return drawn | {"attention_mask": torch.ones_like(drawn["attention_mask"])}


def _single_tokens(generator):
    drawn = _padded("right")(generator)
    return drawn | {"attention_mask": torch.arange(7) == integers(generator, 0, 7, 5)[:, None]}


def _interrupted(generator):
    """Padding between prompt and completion, as when left-padded prompts meet right-padded answers of a batch."""
    drawn = _padded("both")(generator)
    mask = torch.tensor([True, True, False, False, True, False, False])
    return drawn | {"attention_mask": mask.expand(5, 7).clone()}


def _by_reading_backwards(values, attention_mask):
    rows = [
        [value for value, keep in zip(row, kept, strict=True) if keep][-1]
        for row, kept in zip(values, attention_mask, strict=True)
    ]
    return torch.stack(rows)


_TOKENS = ("values", "attention_mask")


def _scores(formula, checked=True):
    """A version: `formula` takes values and a bool mask."""

    def version(values, attention_mask):
        if checked and values.shape != attention_mask.shape:
            raise ValueError(f"attention_mask has shape {tuple(attention_mask.shape)}, but values has {tuple(values.shape)}")
        return formula(values, attention_mask.bool())

    return version


def _picked(values, index):
    return values[torch.arange(len(index)), index]


def _flipped(values, mask):
    """The first kept token from behind."""
    return _picked(values.flip(1), mask.flip(1).int().argmax(1))


def _step_function(values, mask):
    """One where exactly one kept token remains to be read."""
    remaining = mask.flip(1).cumsum(1).flip(1)
    return (values * ((remaining == 1) & mask)).sum(1)


def _nonzero(values, mask):
    last = torch.tensor([int(row.nonzero()[-1]) for row in mask])
    return values.gather(1, last.unsqueeze(1))[:, 0]


LAST_TOKEN_SCORES = Exercise(
    name="last_token_scores",
    reference=ch96.last_token_scores,
    criteria={"values": 1.0, "gradient": 0.2, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("text",),
    cases=drawn_once(
        Case("padding on the right", _padded("right"), closed_form=_by_reading_backwards, visible=True, draws=3),
        Case("padding on the left", _padded("left"), closed_form=_by_reading_backwards, visible=True, draws=3),
        Case("padding on both sides", _padded("both"), closed_form=_by_reading_backwards),
        Case("a mask of integers", _padded("right", whole_numbers=True), closed_form=_by_reading_backwards, visible=True),
        Case("a mask of integers, padding on the left", _padded("left", whole_numbers=True), closed_form=_by_reading_backwards),
        Case("no padding", _no_padding, closed_form=_by_reading_backwards),
        Case("single tokens anywhere", _single_tokens, closed_form=_by_reading_backwards),
        Case("padding in between", _interrupted, closed_form=_by_reading_backwards),
        Case("one text", _padded("right", batch=1), closed_form=_by_reading_backwards),
        Case("values that require gradient", _padded("both"), differentiate=["values"], visible=True),
        Case(
            "gradient where padding holds ±10,000",
            loud_padding(_padded("both"), "values", mask="attention_mask"),
            differentiate=["values"],
        ),
        Case("single precision", _padded("right"), dtype=torch.float32, visible=True),
        *shape_cases(_padded("right"), _TOKENS),
        Case(
            "attention_mask a column short",
            reshaped(_padded("both"), "attention_mask", lambda mask: mask[:, :-1]),
            raises=_TOKENS,
            draws=1,
        ),
    ),
    misconceptions=(
        Misconception(
            "last-column",
            _scores(lambda v, m: v[:, -1]),
            "The last column is padding wherever a text is shorter than the longest one: look for the last kept token.",
        ),
        Misconception(
            "number-of-tokens-as-position",
            _scores(lambda v, m: _picked(v, m.sum(1) - 1)),
            "The number of kept tokens less one is the last one's column only with padding on the right: search by position.",
        ),
        Misconception(
            "before-the-first-padding",
            _scores(lambda v, m: _picked(v, (~m).int().argmax(1) - 1)),
            "This takes the token before the first padding, which under left padding, or with none, is another one.",
        ),
        Misconception(
            "first-token",
            _scores(lambda v, m: _picked(v, m.int().argmax(1))),
            "argmax finds the first of equal values: this is the first kept token, which has read nothing yet.",
        ),
        Misconception(
            "first-padding",
            _scores(lambda v, m: _picked(v, (m * torch.arange(m.shape[1])).argmax(1).add(1).clamp(max=m.shape[1] - 1))),
            "One column too far: behind the last kept token there is padding.",
        ),
        Misconception(
            "mean-over-tokens",
            _scores(lambda v, m: (v * m).sum(1) / m.sum(1)),
            "Earlier tokens have read only a part of the text: the score is the last one's value alone.",
        ),
        Misconception(
            "sum-over-tokens",
            _scores(lambda v, m: (v * m).sum(1)),
            "A sum over tokens grows with the length: the score is the last one's value alone.",
        ),
        Misconception(
            "highest-value",
            _scores(lambda v, m: v.masked_fill(~m, -math.inf).amax(1)),
            "The score is the last kept token's value, not the highest.",
        ),
        Misconception(
            "column-of-scores",
            after(ch96.last_token_scores, lambda scores: scores[:, None]),
            "The shape is (B, 1): one number for each text is asked for, (B,).",
        ),
        cut_from_graph(ch96.last_token_scores),
        dtype_lost(ch96.last_token_scores),
        in_place(ch96.last_token_scores, "values"),
        Misconception("bad-input-accepted", _scores(lambda v, m: _unchecked_scores(v, m), checked=False), SHAPES),
    ),
    variants={
        "read backwards in Python": _scores(_by_reading_backwards),
        "flipped": _scores(_flipped),
        "last True by nonzero": _scores(_nonzero),
        "a mask of one": _scores(_step_function),
        "largest position": _scores(lambda v, m: _picked(v, (m * torch.arange(m.shape[1])).max(1).indices)),
    },
)


def _unchecked_scores(values, mask):
    last = (mask * torch.arange(mask.shape[1])).argmax(1)
    rows = min(len(values), len(last)) if len(last) > 1 else len(values)
    return values[:rows].gather(1, last.expand(max(rows, len(last)))[:rows, None]).squeeze(1)


# ----------------------------------------------------------------------------------------------------- reward_model_loss

_SCORES = ("chosen_scores", "rejected_scores")
_ALL = (*_SCORES, "margin")


def _comparisons(batch=9, scale=1.5, margin=True):
    def inputs(generator):
        drawn = {"chosen_scores": 0.5 + scale * normal(generator, batch), "rejected_scores": scale * normal(generator, batch)}
        return drawn | ({"margin": normal(generator, batch).abs()} if margin else {})

    return inputs


_PLAIN = _comparisons(margin=False)


def _far(generator):
    """Scores 1,000 apart, either way."""
    side = torch.tensor([1.0, -1.0, 1.0, -1.0], dtype=torch.float64)
    base = normal(generator, 4)
    return {"chosen_scores": base + 500 * side, "rejected_scores": base - 500 * side}


def _undecided(generator):
    """A reward model that has not learnt anything: all its scores are equal."""
    chosen = normal(generator, 6)
    return {"chosen_scores": chosen, "rejected_scores": chosen.clone()}


def _margin_reached(generator):
    drawn = _comparisons()(generator)
    return drawn | {"chosen_scores": drawn["rejected_scores"] + drawn["margin"]}


def _one_comparison_each_way(generator):
    drawn = _comparisons(1)(generator)
    return drawn | {"margin": drawn["margin"] + 0.5}


def _loss_by_formula(chosen_scores, rejected_scores, margin=None):
    gaps = (
        chosen_scores.detach().numpy() - rejected_scores.detach().numpy() - (0.0 if margin is None else margin.detach().numpy())
    )
    return torch.tensor(np.logaddexp(0, -gaps).mean())


def _log_two(chosen_scores, **_rest):
    return torch.tensor(math.log(2), dtype=chosen_scores.dtype)


def _comparison(loss, gap=lambda c, r, m: c - r - m, leak=False, checked=True, reduce=torch.mean):
    """A version: `gap` of the scores and the margin (0 if there is none), `loss` of each gap."""

    def version(chosen_scores, rejected_scores, margin=None):
        if checked:
            for name, other in (("rejected_scores", rejected_scores), ("margin", margin)):
                if other is not None and other.shape != chosen_scores.shape:
                    raise ValueError(f"{name} has shape {tuple(other.shape)}, but chosen_scores has {tuple(chosen_scores.shape)}")
        if margin is None:
            margin = torch.zeros_like(rejected_scores)
        gaps = gap(chosen_scores, rejected_scores, margin if leak else margin.detach())
        return reduce(loss(gaps))

    return version


def _right(gaps):
    return functional.softplus(-gaps)


def _hand_softplus(x):
    """log(1 + e^x), right in value, but with no gradient at 0, where relu and abs have none."""
    return functional.relu(x) + torch.log1p(torch.exp(-x.abs()))


def _pair_softmax(chosen_scores, rejected_scores, margin=None):
    if chosen_scores.shape != rejected_scores.shape or (margin is not None and margin.shape != chosen_scores.shape):
        raise ValueError("chosen_scores, rejected_scores and margin must have one shape")
    chosen = chosen_scores if margin is None else chosen_scores - margin.detach()
    logits = torch.stack([chosen, rejected_scores], dim=1)  # (B, 2)
    return functional.cross_entropy(logits, torch.zeros(len(logits), dtype=torch.long))


def _one_by_one(gaps):
    return torch.stack([torch.logaddexp(torch.zeros_like(gap), -gap) for gap in gaps])


REWARD_MODEL_LOSS = Exercise(
    name="reward_model_loss",
    reference=ch96.reward_model_loss,
    criteria={"values": 1.35, "gradient": 0.6, "dtype": 0.1, "inputs": 0.1, "errors": 0.35},
    cases=drawn_once(
        Case("nine comparisons", _PLAIN, closed_form=_loss_by_formula, visible=True, draws=3),
        Case("with margins", _comparisons(), closed_form=_loss_by_formula, visible=True, draws=3),
        Case("margin=None, said aloud", replaced(_PLAIN, margin=None), closed_form=_loss_by_formula),
        Case("equal scores: log 2", _undecided, closed_form=_log_two, visible=True),
        Case("gaps equal to the margins: log 2", _margin_reached, closed_form=_log_two),
        Case("scores 1,000 apart", _far, closed_form=_loss_by_formula, visible=True),
        Case("one comparison with a margin", _one_comparison_each_way, closed_form=_loss_by_formula),
        Case("scores that require gradient", _PLAIN, differentiate=_SCORES, visible=True),
        Case("everything requires gradient", _comparisons(), differentiate=_ALL, visible=True, draws=3),
        Case("gradient where scores are equal", _undecided, differentiate=_SCORES, visible=True),
        Case("gradient where scores are 1,000 apart", _far, differentiate=_SCORES),
        Case("single precision", _comparisons(), dtype=torch.float32, visible=True),
        *shape_cases(_comparisons(), _ALL),
        Case("rejected_scores as a column", reshaped(_PLAIN, "rejected_scores", lambda x: x[:, None]), raises=_SCORES, draws=1),
        Case("margin as a column", reshaped(_comparisons(), "margin", lambda x: x[:, None]), raises=_ALL, draws=1),
    ),
    misconceptions=(
        Misconception(
            "chosen-and-rejected-swapped",
            _comparison(_right, gap=lambda c, r, m: r - c - m),
            "The loss falls as the rejected text's score rises: the gap is chosen minus rejected.",
        ),
        Misconception(
            "sign-missing",
            _comparison(lambda gaps: -_right(gaps)),
            "log σ is to be maximised, a loss minimised: negate it.",
        ),
        Misconception(
            "sigmoid-without-logarithm",
            _comparison(lambda gaps: 1 - torch.sigmoid(gaps)),
            "This is the share of wrong answers to be expected, whose gradient vanishes where the model is most wrong: take -log σ.",
        ),
        Misconception(
            "logarithm-of-sigmoid",
            _comparison(lambda gaps: -torch.sigmoid(gaps).log()),
            "σ underflows to 0 at large gaps and its logarithm is -inf: use torch.nn.functional.logsigmoid.",
        ),
        Misconception(
            "logarithm-clamped",
            _comparison(lambda gaps: _right(gaps.clamp(-30, 30))),
            "Clamping keeps the loss finite, and leaves the comparisons that are most wrong without gradient: use logsigmoid.",
        ),
        Misconception(
            "no-gradient-at-zero",
            _comparison(lambda gaps: _hand_softplus(-gaps)),
            "The values are right, but relu and abs have gradient 0 at 0, and a new reward model starts exactly there: use logsigmoid.",
        ),
        Misconception(
            "margin-added",
            _comparison(_right, gap=lambda c, r, m: c - r + m),
            "The margin makes the task harder, not easier: the gap has to exceed it, so subtract it.",
        ),
        Misconception("margin-ignored", _comparison(_right, gap=lambda c, r, m: c - r), "margin is not used."),
        Misconception(
            "margin-averaged",
            _comparison(_right, gap=lambda c, r, m: c - r - m.mean()),
            "Each comparison has a margin of its own.",
        ),
        Misconception(
            "hinge",
            _comparison(lambda gaps: functional.relu(1 - gaps)),
            "This is a hinge loss: the Bradley-Terry model's likelihood is the sigmoid of the gap.",
        ),
        Misconception(
            "squared-error",
            _comparison(lambda gaps: (1 - torch.sigmoid(gaps)) ** 2),
            "This is the Brier score, a squared error: the negative log-likelihood is -log σ.",
        ),
        Misconception(
            "sum-instead-of-mean",
            _comparison(_right, reduce=torch.sum),
            "A sum grows with the batch, and with it the step: take the mean.",
        ),
        Misconception(
            "not-averaged",
            _comparison(_right, reduce=lambda losses: losses),
            "One number is asked for: the mean over the comparisons.",
        ),
        Misconception(
            "logarithm-of-mean",
            _comparison(lambda gaps: -torch.sigmoid(gaps).mean().log().expand_as(gaps)),
            "The logarithm of the mean probability: each comparison has a likelihood of its own, so take logarithms first.",
        ),
        Misconception(
            "gradient-into-margin",
            _comparison(_right, leak=True),
            "The margin is data, from how sure the raters were: detach it.",
        ),
        Misconception(
            "rejected-detached",
            _comparison(_right, gap=lambda c, r, m: c - r.detach() - m),
            "Only chosen scores are pushed up; rejected ones are learnt from as well.",
        ),
        python_float(ch96.reward_model_loss),
        cut_from_graph(ch96.reward_model_loss),
        dtype_lost(ch96.reward_model_loss),
        in_place(ch96.reward_model_loss, "chosen_scores"),
        Misconception("bad-input-accepted", _comparison(_right, checked=False), SHAPES),
    ),
    variants={
        "softplus": _comparison(_right),
        "softmax of two": _pair_softmax,
        "comparison by comparison": _comparison(_one_by_one),
        "binary cross-entropy": _comparison(
            lambda gaps: functional.binary_cross_entropy_with_logits(gaps, torch.ones_like(gaps), reduction="none")
        ),
        "sum over count, in double precision": lambda chosen_scores, rejected_scores, margin=None: _comparison(
            lambda gaps: -functional.logsigmoid(gaps.double()),
            reduce=lambda losses: (losses.sum() / len(losses)).to(chosen_scores.dtype),
        )(chosen_scores, rejected_scores, margin),
    },
)

# ------------------------------------------------------------------------------------------------------------- best_of_n


def _candidates(batch=6, n=5, sign=0.0):
    """Scores without ties; with `sign`, all of one sign."""

    def inputs(generator):
        scores = normal(generator, batch, n)
        return {"scores": scores.abs() * sign if sign else scores}

    return inputs


def _search(scores):
    best = []
    for row in scores.tolist():
        index = 0
        for candidate, score in enumerate(row):
            if score > row[index]:
                index = candidate
        best.append(index)
    return torch.tensor(best)


def _sorted_last(scores):
    return scores.sort(dim=1).indices[:, -1]


BEST_OF_N = Exercise(
    name="best_of_n",
    reference=ch96.best_of_n,
    criteria={"values": 0.65, "dtype": 0.1},
    axes=("prompt",),
    cases=(
        Case("five candidates for six prompts", _candidates(), closed_form=_search, visible=True, draws=3),
        Case("as many prompts as candidates", _candidates(4, 4), closed_form=_search, visible=True, draws=3),
        Case("all scores negative", _candidates(sign=-1.0), closed_form=_search, visible=True),
        Case("all scores positive", _candidates(sign=1.0), closed_form=_search),
        Case("scores far below 0", lambda generator: {"scores": normal(generator, 6, 5) - 1e6}, closed_form=_search),
        Case("a single candidate", _candidates(3, 1), closed_form=_search),
        Case("many candidates for one prompt", _candidates(1, 64), closed_form=_search),
        Case("scores that require gradient", _candidates(), differentiate=["scores"]),
        Case("single precision", _candidates(), dtype=torch.float32),
    ),
    misconceptions=(
        Misconception("lowest-score", lambda scores: scores.argmin(-1), "This is the worst candidate: take the highest score."),
        Misconception(
            "scores-instead-of-indices",
            lambda scores: scores.detach().amax(-1),
            "These are the best scores: which candidates have them is asked, as int64 indices.",
        ),
        Misconception(
            "best-prompt",
            lambda scores: scores.argmax(0),
            "For each candidate this finds the best prompt: search along the last axis, over the candidates of each prompt.",
        ),
        Misconception(
            "whole-batch",
            lambda scores: scores.argmax(),
            "One index for the whole batch: without dim, argmax searches everything. Each prompt needs its own.",
        ),
        Misconception(
            "position-in-the-batch",
            lambda scores: scores.argmax(-1) + torch.arange(len(scores)) * scores.shape[1],
            "These count through the whole batch: an index from 0 to n - 1 is asked for each prompt.",
        ),
        Misconception(
            "largest-magnitude",
            lambda scores: scores.abs().argmax(-1),
            "A very bad score is no good score: do not take the absolute value.",
        ),
        Misconception(
            "all-indices-sorted",
            lambda scores: scores.argsort(-1, descending=True),
            "This is the whole ranking, (B, n): only its first column is asked for.",
        ),
        Misconception(
            "one-hot",
            lambda scores: (scores == scores.amax(-1, keepdim=True)).long(),
            "This marks the best candidate, (B, n): its index is asked for, (B,).",
        ),
        Misconception("int32", lambda scores: scores.argmax(-1).int(), "Indices are int64, or they index nothing in older code."),
    ),
    variants={
        "search": lambda scores: _search(scores),
        "last of the sorted": _sorted_last,
        "NumPy": lambda scores: torch.from_numpy(scores.detach().numpy().argmax(1)),
        "topk": lambda scores: scores.topk(1, dim=-1).indices.squeeze(-1),
        "max": lambda scores: scores.max(dim=1)[1],
    },
)

# ---------------------------------------------------------------------------------------------------------- best_of_n_kl


def _n(low, high):
    return lambda generator: {"n": int(integers(generator, low, high))}


QUADRATURE = np.polynomial.legendre.leggauss(200)


def _kl_by_integral(n):
    """KL of the best of n: the best one's rank among all texts has density n u^(n-1), so the KL is ∫ n u^(n-1) log(n u^(n-1)) du."""
    nodes, weights = QUADRATURE
    t = (nodes + 1) / 2  # with u = t^(1/n), the density of t is 1 and the logarithm's argument n t^((n-1)/n)
    return float((weights / 2 * (math.log(n) + (n - 1) / n * np.log(t))).sum())


def _kl_version(formula):
    def version(n):
        if n < 1:
            raise ValueError(f"expected n >= 1, but received {n!r}")
        return formula(n)

    return version


BEST_OF_N_KL = Exercise(
    name="best_of_n_kl",
    reference=ch96.best_of_n_kl,
    criteria={"values": 0.6, "errors": 0.15},
    cases=(
        Case("n = 1: nothing is chosen", lambda generator: {"n": 1}, closed_form=lambda n: 0.0, visible=True, draws=1),
        Case("n = 2", lambda generator: {"n": 2}, closed_form=lambda n: 0.6931471805599453 - 0.5, visible=True, draws=1),
        Case("n = 4", lambda generator: {"n": 4}, closed_form=lambda n: 2 * math.log(2) - 0.75, visible=True, draws=1),
        Case("a few", _n(3, 20), closed_form=_kl_by_integral, atol=1e-4, draws=3),
        Case("dozens", _n(20, 300), closed_form=_kl_by_integral, atol=1e-4, visible=True, draws=3),
        Case("a million", lambda generator: {"n": 1_000_000}, closed_form=_kl_by_integral, atol=1e-4, draws=1),
        refused(_n(2, 3), n=0, visible=True),
        refused(_n(2, 3), n=-3),
        refused(_n(2, 3), n=0.5),
    ),
    misconceptions=(
        Misconception(
            "logarithm-alone",
            _kl_version(math.log),
            "log n is the surprise at the very best text; averaged over the best of n it is (n - 1) / n less.",
        ),
        Misconception(
            "correction-added",
            _kl_version(lambda n: math.log(n) + (n - 1) / n),
            "(n - 1) / n is subtracted: at n = 1 either sign gives 0, at n = 2 it has to be log 2 - 1/2.",
        ),
        Misconception("base-two", _kl_version(lambda n: math.log2(n) - (n - 1) / n), "log2 gives bits: nats are asked for."),
        Misconception(
            "one-over-n",
            _kl_version(lambda n: math.log(n) - 1 / n),
            "The correction is (n - 1) / n: at n = 1 there is no choice and no KL.",
        ),
        Misconception(
            "not-divided", _kl_version(lambda n: math.log(n) - (n - 1)), "A KL is never negative: the correction is (n - 1) / n."
        ),
        Misconception("n-plus-one", _kl_version(lambda n: math.log(n) - (n - 1) / (n + 1)), "The correction's denominator is n."),
        Misconception(
            "the-wrong-way-round",
            _kl_version(lambda n: n - 1 - math.log(n)),
            "This is KL(policy ‖ best of n), the other direction: the expectation is over the best of n.",
        ),
        Misconception(
            "tensor",
            _kl_version(lambda n: torch.tensor(math.log(n) - (n - 1) / n)),
            "A Python float is asked for: nothing here is learnt.",
        ),
        Misconception(
            "bad-input-accepted",
            lambda n: math.log(max(n, 1)) - (n - 1) / n if n else 0.0,
            "n < 1 must be refused with a ValueError that names n.",
        ),
    ),
    variants={
        "1 / n - 1": _kl_version(lambda n: math.log(n) + 1 / n - 1),
        "NumPy": _kl_version(lambda n: float(np.log(n) - (n - 1) / n)),
        "torch": _kl_version(lambda n: (torch.tensor(float(n), dtype=torch.float64).log() - 1 + 1 / n).item()),
        "log1p": _kl_version(lambda n: math.log1p(n - 1) - (1 - 1 / n)),
    },
)

# ---------------------------------------------------------------------------------------------------- length_correlation


def _lengths(slope, batch=12, whole_numbers=True):
    """Scores that rise by `slope` standard deviations of theirs for one of the lengths'."""

    def inputs(generator):
        lengths = integers(generator, 5, 60, batch)
        lengths[:2] = torch.tensor([5, 60])
        scores = slope * (lengths - lengths.double().mean()) / lengths.double().std() + normal(generator, batch) + 3.0
        return {"scores": scores, "lengths": lengths if whole_numbers else lengths.double()}

    return inputs


def _straight_line(generator):
    drawn = _lengths(0.0)(generator)
    return drawn | {"scores": 2.0 - 0.25 * drawn["lengths"].double()}


def _one_outlier(generator):
    """A very long text: ranks and values say different things."""
    drawn = _lengths(0.5)(generator)
    drawn["lengths"][3] = 500
    return drawn


def _by_numpy(scores, lengths):
    return torch.tensor(np.corrcoef(scores.detach().numpy(), lengths.numpy())[0, 1], dtype=scores.dtype)


def _correlation(formula, checked=True):
    """A version: `formula` takes both, detached and in the scores' dtype."""

    def version(scores, lengths):
        if checked and scores.shape != lengths.shape:
            raise ValueError(f"lengths has shape {tuple(lengths.shape)}, but scores has {tuple(scores.shape)}")
        return formula(scores.detach(), lengths.detach().to(scores.dtype))

    return version


def _pearson(a, b):
    a, b = a - a.mean(), b - b.mean()
    return (a @ b) / (a.norm() * b.norm())


def _ranks(x):
    return x.argsort().argsort().to(x.dtype)


def _broadcast_pearson(a, b):
    a, b = a - a.mean(), b - b.mean()
    rows = min(len(a), len(b)) if len(b) > 1 else len(a)
    a, b = a[:rows], b[:rows]
    return (a * b).sum() / (a.square().sum() * b.square().sum()).sqrt()


def _graph_kept(scores, lengths):
    ch96.length_correlation(scores, lengths)
    return _pearson(scores, lengths.to(scores.dtype))


LENGTH_CORRELATION = Exercise(
    name="length_correlation",
    reference=ch96.length_correlation,
    criteria={"values": 0.7, "gradient": 0.1, "dtype": 0.1, "inputs": 0.05, "errors": 0.05},
    cases=drawn_once(
        Case("longer is better", _lengths(1.0), closed_form=_by_numpy, visible=True, draws=3),
        Case("shorter is better", _lengths(-1.0), closed_form=_by_numpy, visible=True),
        Case("nothing to see", _lengths(0.0), closed_form=_by_numpy),
        Case("lengths as floating-point numbers", _lengths(0.5, whole_numbers=False), closed_form=_by_numpy),
        Case(
            "on a falling line: -1", _straight_line, closed_form=lambda scores, lengths: torch.tensor(-1.0).double(), visible=True
        ),
        Case("one very long text", _one_outlier, closed_form=_by_numpy),
        Case("three texts", _lengths(0.5, batch=3), closed_form=_by_numpy),
        Case("scores that require gradient", _lengths(0.5), differentiate=["scores"], visible=True),
        Case("single precision", _lengths(0.5), dtype=torch.float32, visible=True),
        *shape_cases(_lengths(0.5), ("scores", "lengths")),
    ),
    misconceptions=(
        Misconception(
            "covariance",
            _correlation(lambda a, b: ((a - a.mean()) * (b - b.mean())).mean()),
            "This is the covariance, in units of score times tokens: divide by both standard deviations.",
        ),
        Misconception(
            "slope",
            _correlation(lambda a, b: ((a - a.mean()) @ (b - b.mean())) / (b - b.mean()).square().sum()),
            "This is the slope of a regression, score per token: divide by both standard deviations instead.",
        ),
        Misconception(
            "not-centred",
            _correlation(lambda a, b: (a @ b) / (a.norm() * b.norm())),
            "This is the cosine between two lists: subtract the means first, or any two positive lists agree.",
        ),
        Misconception(
            "ranks",
            _correlation(lambda a, b: _pearson(_ranks(a), _ranks(b))),
            "This is Spearman's correlation, of ranks: Pearson's is of the values.",
        ),
        Misconception("squared", _correlation(lambda a, b: _pearson(a, b) ** 2), "This is R², which has lost the sign."),
        Misconception("absolute", _correlation(lambda a, b: _pearson(a, b).abs()), "The sign is lost: shorter may be better."),
        Misconception(
            "sign-flipped", _correlation(lambda a, b: -_pearson(a, b)), "Longer is better should give a positive number."
        ),
        Misconception(
            "mixed-deviations",
            _correlation(lambda a, b: ((a - a.mean()) * (b - b.mean())).mean() / (a.std() * b.std())),
            "A mean over B is divided by deviations over B - 1: on a straight line the result is not ±1. Use one of the two throughout.",
        ),
        Misconception(
            "logarithm-of-lengths",
            _correlation(lambda a, b: _pearson(a, b.log())),
            "Correlate with the lengths themselves.",
        ),
        Misconception("graph-kept", _graph_kept, METRIC),
        dtype_lost(ch96.length_correlation),
        in_place(ch96.length_correlation, "scores"),
        Misconception("bad-input-accepted", _correlation(_broadcast_pearson, checked=False), SHAPES),
    ),
    variants={
        "NumPy": _correlation(lambda a, b: _by_numpy(a, b)),
        "torch.corrcoef": _correlation(lambda a, b: torch.corrcoef(torch.stack([a, b]))[0, 1]),
        "cosine of centred lists": _correlation(_pearson),
        "standardised by the unbiased deviation": _correlation(
            lambda a, b: ((a - a.mean()) / a.std() * (b - b.mean()) / b.std()).sum() / (len(a) - 1)
        ),
        "in Python": _correlation(
            lambda a, b: torch.tensor(
                _pearson(torch.tensor(a.tolist()).double(), torch.tensor(b.tolist()).double()).item(), dtype=a.dtype
            )
        ),
    },
)

# ------------------------------------------------------------------------------------------------------ repaired_choices

_PAIR = ("first", "second", "first_ratings", "second_ratings")


def _opinions(low, high, batch=14, kind=torch.int8):
    """Pairs of texts and ratings from low to high; two of the pairs are ties and two are decided, one each way."""

    def inputs(generator):
        texts = torch.randperm(40, generator=generator)[: 2 * batch]
        ratings = integers(generator, low, high + 1, 2, batch)
        ratings[:, :4] = torch.tensor([[low, high, high, low], [low, high, low, high]])
        ratings = ratings[:, torch.randperm(batch, generator=generator)].to(kind)
        return dict(zip(_PAIR, (texts[:batch], texts[batch:], *ratings), strict=True))

    return inputs


def _half_stars(generator):
    drawn = _opinions(2, 9)(generator)
    return {name: value / 2 if name.endswith("ratings") else value for name, value in drawn.items()}


def _one_left(generator):
    drawn = _opinions(-1, 1)(generator)
    drawn["second_ratings"] = drawn["first_ratings"].clone()
    drawn["first_ratings"][3], drawn["second_ratings"][3] = 0, 1
    return drawn


def _without(tied):
    def inputs(generator):
        drawn = _opinions(-4, 4)(generator)
        keep = (drawn["first_ratings"] == drawn["second_ratings"]) == tied
        return {name: value[keep] for name, value in drawn.items()}

    return inputs


def _pair_by_pair(first, second, first_ratings, second_ratings):
    kept = []
    for a, b, rating_a, rating_b in zip(
        first.tolist(), second.tolist(), first_ratings.tolist(), second_ratings.tolist(), strict=True
    ):
        if rating_a > rating_b:
            kept.append((a, b))
        elif rating_b > rating_a:
            kept.append((b, a))
    table = torch.tensor(kept, dtype=torch.int64).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def _choices(formula, checked=True):
    """A version: `formula` takes all four and is protected from unequal shapes."""

    def version(first, second, first_ratings, second_ratings):
        given = (second, first_ratings, second_ratings)
        if checked and any(other.shape != first.shape for other in given):
            raise ValueError(f"first has shape {tuple(first.shape)}, but second, first_ratings or second_ratings has another")
        return formula(first, second, first_ratings, second_ratings)

    return version


def _decided_by(wins, keep):
    """A version by two masks, each a function of the ratings: where the first text wins, and which pairs count."""

    def formula(first, second, a, b):
        kept, first_wins = keep(a, b), wins(a, b)
        return torch.where(first_wins, first, second)[kept], torch.where(first_wins, second, first)[kept]

    return _choices(formula)


def _everything(a, b):
    return torch.ones_like(a, dtype=torch.bool)


def _by_winner(first, second, a, b):
    """First the pairs that the first text wins, then the others."""
    return torch.cat([first[a > b], second[b > a]]), torch.cat([second[a > b], first[b > a]])


def _by_gather(first, second, a, b):
    table = torch.stack([first, second], dim=1)[a != b]  # (B', 2)
    better = torch.stack([a, b], dim=1)[a != b].argmax(1, keepdim=True)
    return table.gather(1, better)[:, 0], table.gather(1, 1 - better)[:, 0]


def _by_sign(first, second, a, b):
    sign = (a.long() - b.long()).sign() if not a.is_floating_point() else (a - b).sign().long()
    rows = sign.nonzero().squeeze(1)
    middle, half = first + second, (first - second) * sign
    return ((middle + half) // 2)[rows], ((middle - half) // 2)[rows]


def _pairs_by_numpy(first, second, a, b):
    first, second, a, b = (x.numpy() for x in (first, second, a, b))
    kept = np.flatnonzero(a != b)
    return (torch.from_numpy(np.where(wins, x, y)[kept]) for wins, x, y in ((a > b, first, second), (a > b, second, first)))


def _cut_to_the_shortest(first, second, a, b):
    rows = min(map(len, (first, second, a, b)))
    return ch96.repaired_choices(first[:rows], second[:rows], a[:rows], b[:rows])


REPAIRED_CHOICES = Exercise(
    name="repaired_choices",
    reference=ch96.repaired_choices,
    criteria={"values": 1.6, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    cases=drawn_once(
        Case("ratings from -4 to 4", _opinions(-4, 4), closed_form=_pair_by_pair, visible=True, draws=3),
        Case("negative, neutral or positive", _opinions(-1, 1), closed_form=_pair_by_pair, visible=True, draws=3),
        Case("stars as floating-point numbers", _opinions(1, 5, kind=torch.float32), closed_form=_pair_by_pair, visible=True),
        Case("half stars", _half_stars, closed_form=_pair_by_pair),
        Case("no ties", _without(tied=False), closed_form=_pair_by_pair),
        Case("one pair left", _one_left, closed_form=_pair_by_pair),
        Case("nothing but ties", _without(tied=True), closed_form=_pair_by_pair),
        *shape_cases(_opinions(-1, 1), _PAIR),
    ),
    misconceptions=(
        Misconception(
            "ties-to-the-first",
            _decided_by(lambda a, b: a >= b, _everything),
            "This is the suspect's rule: a tie counts as a victory of the first text, and which text comes first is no accident.",
        ),
        Misconception(
            "ties-to-the-second",
            _decided_by(lambda a, b: a > b, _everything),
            "Now ties count as victories of the second text: the same fault the other way round. A tie says nothing.",
        ),
        Misconception(
            "ties-at-random",
            _decided_by(lambda a, b: (a > b) | ((a == b) & (torch.arange(len(a)) % 2 == 0)), _everything),
            "Ties that fall to either side by turns teach no length, but they are noise: leave them out.",
        ),
        Misconception(
            "chosen-and-rejected-swapped",
            _decided_by(lambda a, b: a < b, lambda a, b: a != b),
            "The text with the higher rating is chosen: here it is rejected.",
        ),
        Misconception(
            "only-where-the-first-wins",
            _decided_by(lambda a, b: a > b, lambda a, b: a > b),
            "Pairs that the second text wins are left out as well: now the first text always wins, which is worse than before.",
        ),
        Misconception(
            "only-where-the-second-wins",
            _decided_by(lambda a, b: a > b, lambda a, b: a < b),
            "Pairs that the first text wins are left out as well: only ties say nothing.",
        ),
        Misconception(
            "neutral-left-out",
            _decided_by(lambda a, b: a > b, lambda a, b: (a != 0) & (b != 0) & (a != b)),
            "A neutral text against a positive one is a clear preference: leave out equal ratings, not ratings of 0.",
        ),
        Misconception(
            "ties-kept-the-rest-left-out",
            _decided_by(lambda a, b: a >= b, lambda a, b: a == b),
            "The mask is the wrong way round: these are the pairs that say nothing.",
        ),
        Misconception(
            "positions-of-pairs",
            _choices(lambda first, second, a, b: ((a > b).nonzero().squeeze(1), (b > a).nonzero().squeeze(1))),
            "These are positions in the list of pairs: indices of texts are asked for, from first and second.",
        ),
        Misconception(
            "order-lost",
            _choices(_by_winner),
            "The pairs have changed their order: whatever else is known of each pair no longer belongs to it.",
        ),
        Misconception(
            "int32",
            after(ch96.repaired_choices, lambda pair: tuple(index.int() for index in pair)),
            "Indices are int64, or they index nothing in older code.",
        ),
        in_place(ch96.repaired_choices, "first"),
        Misconception("bad-input-accepted", _choices(_cut_to_the_shortest, checked=False), SHAPES),
    ),
    variants={
        "pair by pair in Python": _choices(_pair_by_pair),
        "gather": _choices(_by_gather),
        "sign of the difference": _choices(_by_sign),
        "NumPy": _choices(lambda *given: tuple(_pairs_by_numpy(*given))),
        "masks": _decided_by(lambda a, b: a > b, lambda a, b: a.ne(b)),
    },
)

EXERCISES = (LAST_TOKEN_SCORES, REWARD_MODEL_LOSS, BEST_OF_N, BEST_OF_N_KL, LENGTH_CORRELATION, REPAIRED_CHOICES)
