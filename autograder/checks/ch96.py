"""Checks of chapter 96: cases, named misconceptions and correct variants for reward models and best-of-n."""

from __future__ import annotations

import math
import statistics

import numpy as np
import torch
import torch.nn.functional as F

from autograder.authoring.parts import (
    CUT,
    DTYPE,
    IN_PLACE,
    METRIC,
    after,
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
    number,
    one_shape,
    python_float,
    refused,
    replaced,
    reshaped,
    rows_cut,
    satisfies,
    shape_cases,
    versions_of,
    wrong,
)
from autograder.authoring.spec import Case, Exercise, Misconception
from solutions import ch96

# ----------------------------------------------------------------------------------------------------- last_token_scores


@drawing
def _padded(generator, side, batch=5, length=7, dtype=torch.bool):
    """Texts of 2 to 5 tokens, padded on one side or on both; numbers at padding are as large as any."""
    lengths = integers(generator, 2, 6, batch)
    start = {"right": torch.zeros(batch), "left": length - lengths, "both": torch.ones(batch)}[side].long()
    columns = torch.arange(length)
    mask = (columns >= start[:, None]) & (columns < (start + lengths)[:, None])
    return {"values": normal(generator, batch, length), "attention_mask": mask.to(dtype)}


def _single_tokens(generator):
    drawn = _padded("right")(generator)
    return drawn | {"attention_mask": torch.arange(7) == integers(generator, 0, 7, 5)[:, None]}


_NO_PADDING = reshaped(_padded("right"), "attention_mask", torch.ones_like)
_LOUD = loud_padding(_padded("both"), "values", mask="attention_mask")
# padding between prompt and completion, as when left-padded prompts meet right-padded answers of a batch
_INTERRUPTED = replaced(_padded("both"), attention_mask=torch.tensor([[True, True, False, False, True, False, False]] * 5))


def _by_reading_backwards(values, attention_mask):
    return torch.stack([row[kept.bool()].flip(0)[0] for row, kept in zip(values, attention_mask, strict=True)])


_TOKENS = ("values", "attention_mask")
_texts = versions_of(ch96.last_token_scores, one_shape(*_TOKENS))


def _scores(formula, **options):
    """A version: `formula` takes values and a bool mask."""
    return _texts(lambda v, m: formula(v, m.bool()), **options)


def _picked(values, index):
    return values[torch.arange(len(index)), index]


def _last(mask):
    """The column of each row's last kept token."""
    return (mask * torch.arange(mask.shape[1])).argmax(1)


_WRONG_LAST_TOKEN_SCORES = {
    "last-column": (
        lambda v, m: v[:, -1],
        "The last column is padding wherever a text is shorter than the longest one: look for the last kept token.",
    ),
    "number-of-tokens-as-position": (
        lambda v, m: _picked(v, m.sum(1) - 1),
        "The number of kept tokens less one is the last one's column only with padding on the right: search by position.",
    ),
    "before-the-first-padding": (
        lambda v, m: _picked(v, (~m).int().argmax(1) - 1),
        "This takes the token before the first padding, which under left padding, or with none, is another one.",
    ),
    "first-token": (
        lambda v, m: _picked(v, m.int().argmax(1)),
        "argmax finds the first of equal values: this is the first kept token, which has read nothing yet.",
    ),
    "first-padding": (
        lambda v, m: _picked(v, (_last(m) + 1).clamp(max=m.shape[1] - 1)),
        "One column too far: behind the last kept token there is padding.",
    ),
    "mean-over-tokens": (
        lambda v, m: (v * m).sum(1) / m.sum(1),
        "Earlier tokens have read only a part of the text: the score is the last one's value alone.",
    ),
    "sum-over-tokens": (
        lambda v, m: (v * m).sum(1),
        "A sum over tokens grows with the length: the score is the last one's value alone.",
    ),
    "highest-value": (lambda v, m: v.where(m, -math.inf).amax(1), "The score is the last kept token's value, not the highest."),
    "column-of-scores": (
        lambda v, m: v.gather(1, _last(m)[:, None]),
        "The shape is (B, 1): one number for each text is asked for, (B,).",
    ),
}

LAST_TOKEN_SCORES = Exercise(
    name="last_token_scores",
    reference=ch96.last_token_scores,
    criteria={"values": 1.0, "gradient": 0.2, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("text",),
    cases=drawn_once(
        Case("padding on the right", _padded("right"), closed_form=_by_reading_backwards, visible=True, draws=3),
        Case("padding on the left", _padded("left"), closed_form=_by_reading_backwards, visible=True, draws=3),
        Case("padding on both sides", _padded("both"), closed_form=_by_reading_backwards),
        Case("a mask of integers", _padded("right", dtype=torch.int64), closed_form=_by_reading_backwards, visible=True),
        Case("a mask of integers, padding on the left", _padded("left", dtype=torch.int64), closed_form=_by_reading_backwards),
        Case("no padding", _NO_PADDING, closed_form=_by_reading_backwards),
        Case("single tokens anywhere", _single_tokens, closed_form=_by_reading_backwards),
        Case("padding in between", _INTERRUPTED, closed_form=_by_reading_backwards),
        Case("one text", _padded("right", batch=1), closed_form=_by_reading_backwards),
        Case("values that require gradient", _padded("both"), differentiate=["values"], visible=True),
        Case("gradient where padding holds ±10,000", _LOUD, differentiate=["values"]),
        Case("single precision", _padded("right"), dtype=torch.float32, visible=True),
        *shape_cases(_padded("right"), _TOKENS),
        Case("attention_mask a column short", reshaped(_padded("both"), "attention_mask", lambda m: m[:, :-1]), raises=_TOKENS),
    ),
    misconceptions=(
        *wrong(_WRONG_LAST_TOKEN_SCORES, _scores),
        cut_from_graph(ch96.last_token_scores),
        dtype_lost(ch96.last_token_scores),
        in_place(ch96.last_token_scores, "values"),
        bad_input_accepted(_scores(rows_cut(lambda v, m: _picked(v, _last(m))), checked=False)),
    ),
    variants={
        "read backwards in Python": _scores(_by_reading_backwards),
        "flipped": _scores(lambda v, m: _picked(v.flip(1), m.flip(1).int().argmax(1))),
        "last True by nonzero": _scores(lambda v, m: _picked(v, torch.tensor([int(row.nonzero()[-1]) for row in m]))),
        "a mask of one": _scores(lambda v, m: (v * (m & (m.flip(1).cumsum(1).flip(1) == 1))).sum(1)),
        "largest position": _scores(lambda v, m: _picked(v, _last(m))),
    },
)

# ----------------------------------------------------------------------------------------------------- reward_model_loss

_SCORES = ("chosen_scores", "rejected_scores")
_ALL = (*_SCORES, "margin")


@drawing
def _plain(generator, batch=9):
    return {"chosen_scores": 0.5 + 1.5 * normal(generator, batch), "rejected_scores": 1.5 * normal(generator, batch)}


@drawing
def _with_margins(generator, batch=9, least=0.0):
    return _plain(batch)(generator) | {"margin": least + normal(generator, batch).abs()}


def _far(generator):
    """Scores 1,000 apart, either way."""
    side = torch.tensor([1.0, -1.0, 1.0, -1.0], dtype=torch.float64)
    base = normal(generator, 4)
    return {"chosen_scores": base + 500 * side, "rejected_scores": base - 500 * side}


def _undecided(generator):
    """A reward model that has not learnt anything: all its scores are equal."""
    chosen = normal(generator, 6)
    return {"chosen_scores": chosen, "rejected_scores": chosen.clone()}


# columns broadcast silently to a table of all pairs
_REJECTED_COLUMN = reshaped(_plain(), "rejected_scores", lambda x: x[:, None])
_MARGIN_COLUMN = reshaped(_with_margins(), "margin", lambda x: x[:, None])
_MARGIN_REACHED = altered(_with_margins(), lambda drawn: {"chosen_scores": drawn["rejected_scores"] + drawn["margin"]})


def _loss_by_numpy(chosen_scores, rejected_scores, margin=None):
    gaps = (chosen_scores - rejected_scores).detach().numpy() - (0.0 if margin is None else margin.detach().numpy())
    return torch.tensor(np.logaddexp(0, -gaps).mean())


_margin_fits = satisfies(lambda margin, chosen_scores: margin is None or margin.shape == chosen_scores.shape)
_compared = versions_of(ch96.reward_model_loss, one_shape(*_SCORES), _margin_fits, data=["margin"])


def _loss(formula, **options):
    """A version: `formula` takes scores and margins, which are 0 if there are none."""
    return _compared(lambda c, r, m: formula(c, r, torch.zeros_like(r) if m is None else m), **options)


def _hand_softplus(x):
    return F.relu(x) + torch.log1p(torch.exp(-x.abs()))


_WRONG_REWARD_MODEL_LOSS = {
    "chosen-and-rejected-swapped": (
        lambda c, r, m: -F.logsigmoid(r - c - m).mean(),
        "The loss falls as the rejected text's score rises: the gap is chosen minus rejected.",
    ),
    "sign-missing": (lambda c, r, m: F.logsigmoid(c - r - m).mean(), "log σ is to be maximised, a loss minimised: negate it."),
    "sigmoid-without-logarithm": (
        lambda c, r, m: (1 - torch.sigmoid(c - r - m)).mean(),
        "This is the share of wrong answers to be expected, whose gradient vanishes where the model is most wrong: take -log σ.",
    ),
    "logarithm-of-sigmoid": (
        lambda c, r, m: -torch.sigmoid(c - r - m).log().mean(),
        "σ underflows to 0 at large gaps and its logarithm is -inf: use torch.nn.functional.logsigmoid.",
    ),
    "logarithm-clamped": (
        lambda c, r, m: -F.logsigmoid((c - r - m).clamp(-30, 30)).mean(),
        "Clamping keeps the loss finite, and leaves the comparisons that are most wrong without gradient: use logsigmoid.",
    ),
    "no-gradient-at-zero": (
        lambda c, r, m: _hand_softplus(r - c + m).mean(),
        "The values are right, but relu and abs have gradient 0 at 0, and a new reward model starts exactly there: use logsigmoid.",
    ),
    "margin-added": (
        lambda c, r, m: -F.logsigmoid(c - r + m).mean(),
        "The margin makes the task harder, not easier: the gap has to exceed it, so subtract it.",
    ),
    "margin-ignored": (lambda c, r, m: -F.logsigmoid(c - r).mean(), "margin is not used."),
    "margin-averaged": (lambda c, r, m: -F.logsigmoid(c - r - m.mean()).mean(), "Each comparison has a margin of its own."),
    "hinge": (
        lambda c, r, m: F.relu(1 - (c - r - m)).mean(),
        "This is a hinge loss: the Bradley-Terry model's likelihood is the sigmoid of the gap.",
    ),
    "squared-error": (
        lambda c, r, m: (1 - torch.sigmoid(c - r - m)).square().mean(),
        "This is the Brier score, a squared error: the negative log-likelihood is -log σ.",
    ),
    "sum-instead-of-mean": (
        lambda c, r, m: -F.logsigmoid(c - r - m).sum(),
        "A sum grows with the batch, and with it the step: take the mean.",
    ),
    "not-averaged": (lambda c, r, m: -F.logsigmoid(c - r - m), "One number is asked for: the mean over the comparisons."),
    "logarithm-of-mean": (
        lambda c, r, m: -torch.sigmoid(c - r - m).mean().log(),
        "The logarithm of the mean probability: each comparison has a likelihood of its own, so take logarithms first.",
    ),
    "rejected-detached": (
        lambda c, r, m: -F.logsigmoid(c - r.detach() - m).mean(),
        "Only chosen scores are pushed up; rejected ones are learnt from as well.",
    ),
}

REWARD_MODEL_LOSS = Exercise(
    name="reward_model_loss",
    reference=ch96.reward_model_loss,
    criteria={"values": 1.35, "gradient": 0.6, "dtype": 0.1, "inputs": 0.1, "errors": 0.35},
    cases=drawn_once(
        Case("nine comparisons", _plain(), closed_form=_loss_by_numpy, visible=True, draws=3),
        Case("with margins", _with_margins(), closed_form=_loss_by_numpy, visible=True, draws=3),
        Case("margin=None, said aloud", replaced(_plain(), margin=None), closed_form=_loss_by_numpy),
        Case("equal scores: log 2", _undecided, closed_form=number(math.log(2)), visible=True),
        Case("gaps equal to the margins: log 2", _MARGIN_REACHED, closed_form=number(math.log(2))),
        Case("scores 1,000 apart", _far, closed_form=_loss_by_numpy, visible=True),
        Case("one comparison with a margin", _with_margins(1, least=0.5), closed_form=_loss_by_numpy),
        Case("scores that require gradient", _plain(), differentiate=_SCORES, visible=True),
        Case("everything requires gradient", _with_margins(), differentiate=_ALL, visible=True, draws=3),
        Case("gradient where scores are equal", _undecided, differentiate=_SCORES, visible=True),
        Case("gradient where scores are 1,000 apart", _far, differentiate=_SCORES),
        Case("single precision", _with_margins(), dtype=torch.float32, visible=True),
        *shape_cases(_with_margins(), _ALL),
        Case("rejected_scores as a column", _REJECTED_COLUMN, raises=_SCORES),
        Case("margin as a column", _MARGIN_COLUMN, raises=_ALL),
    ),
    misconceptions=(
        *wrong(_WRONG_REWARD_MODEL_LOSS, _loss),
        Misconception(
            "gradient-into-margin",
            _loss(lambda c, r, m: -F.logsigmoid(c - r - m).mean(), leak=True),
            "The margin is data, from how sure the raters were: detach it.",
        ),
        python_float(ch96.reward_model_loss),
        cut_from_graph(ch96.reward_model_loss),
        dtype_lost(ch96.reward_model_loss),
        in_place(ch96.reward_model_loss, "chosen_scores"),
        bad_input_accepted(_loss(lambda c, r, m: -F.logsigmoid(c - r - m).mean(), checked=False)),
    ),
    variants={
        "softplus": _loss(lambda c, r, m: F.softplus(r + m - c).mean()),
        "softmax of two": _loss(lambda c, r, m: -torch.stack([c - m, r]).log_softmax(0)[0].mean()),
        "comparison by comparison": _loss(lambda c, r, m: torch.stack([-F.logsigmoid(gap) for gap in c - r - m]).mean()),
        "binary cross-entropy": _loss(lambda c, r, m: F.binary_cross_entropy_with_logits(c - r - m, torch.ones_like(c))),
        "sum over count, in double precision": _loss(
            lambda c, r, m: -F.logsigmoid((c - r - m).double()).sum().to(c.dtype) / len(c)
        ),
    },
)

# ---------------------------------------------------------------------------------------------------- in_reference_units


@drawing
def _of_two_policies(generator, batch=4, n=3, k=5, size=3.0, apart=2.0, kl_coef=0.05):
    """Scores of n texts and of the reference's k to each prompt: their levels differ by prompt, and so do the reference's deviations."""
    level = apart * normal(generator, batch, 1)
    spread = torch.linspace(0.3, 1.7, batch, dtype=torch.float64)[torch.randperm(batch, generator=generator), None]
    return {
        "scores": size * (level + 0.7 + 0.6 * normal(generator, batch, n)),
        "reference_scores": size * (level + spread * normal(generator, batch, k)),
        "kl_coef": kl_coef,
    }


def _own_texts(generator):
    """The first texts of PPO are the reference's."""
    drawn = _of_two_policies(n=5)(generator)
    return drawn | {"scores": drawn["reference_scores"].clone()}


def _in_that_unit_already(generator):
    """Each prompt's reference scores have mean 0 and variance 1."""
    drawn = _of_two_policies(k=3)(generator)
    return drawn | {"reference_scores": torch.tensor([[-1.0, 0.0, 1.0]] * 4, dtype=torch.float64)}


def _one_of_equals(generator, prompts=1):
    """The reference's texts to the first prompts all have one score."""
    drawn = _of_two_policies(k=4)(generator)
    levels = integers(generator, -5, 6, 4, 1).double()
    drawn["reference_scores"][:prompts] = levels[:prompts].expand(prompts, 4)
    return drawn


def _all_equal(generator):
    return _one_of_equals(generator, prompts=4)


_ALL_OF_TWO_POLICIES = ("scores", "reference_scores")


def _units_by_numpy(scores, reference_scores, kl_coef):
    reference = reference_scores.detach().numpy()
    unit = float(np.sqrt(np.mean(np.var(reference, axis=1, ddof=1))))
    shifted = scores.detach().numpy() - reference.mean(1, keepdims=True)
    return torch.from_numpy(shifted / unit).to(scores.dtype), kl_coef / unit


_in_units = versions_of(
    ch96.in_reference_units,
    satisfies(lambda scores, reference_scores: len(scores) == len(reference_scores)),
    satisfies(lambda kl_coef: kl_coef >= 0),
    satisfies(lambda reference_scores: reference_scores.shape[1] >= 2),
    satisfies(lambda reference_scores: (reference_scores != reference_scores[:, :1]).any()),
    data=["reference_scores"],
)


def _converted(
    zero=lambda s, r: r.mean(1, keepdim=True),
    unit=lambda s, r: r.var(1).mean().sqrt(),
    weight=lambda kl_coef, unit: kl_coef / unit,
):
    """A formula by where each prompt's zero is, what the unit is, and what becomes of the weight."""

    def formula(scores, reference_scores, kl_coef):
        of = unit(scores.detach(), reference_scores)
        shifted = scores - zero(scores.detach(), reference_scores)
        return shifted / of, weight(kl_coef, of.detach().double().mean().item())

    return formula


def _prompt_by_prompt(scores, reference_scores, kl_coef):
    rows = reference_scores.tolist()
    unit = math.sqrt(statistics.mean(statistics.variance(row) for row in rows))
    zeros = [statistics.mean(row) for row in rows]
    return torch.stack([(row - zero) / unit for row, zero in zip(scores, zeros, strict=True)]), kl_coef / unit


def _by_pairs(scores, reference_scores, kl_coef):
    """Half the mean squared difference of two texts to one prompt is their variance."""
    k = reference_scores.shape[1]
    differences = reference_scores[:, :, None] - reference_scores[:, None, :]
    unit = (differences.square().sum() / (2 * len(reference_scores) * k * (k - 1))).sqrt()
    return (scores - reference_scores.mean(1)[:, None]) / unit, float(kl_coef / unit)


def _by_residuals(scores, reference_scores, kl_coef):
    zero = reference_scores.mean(1, keepdim=True)
    residuals = (reference_scores - zero).flatten()
    unit = residuals.norm() / math.sqrt(len(residuals) - len(zero))
    return (scores - zero) / unit, (kl_coef / unit).item()


_OWN = (
    "The statistics are of the scores that are converted: every batch of PPO gets a unit of its own, and progress has mean 0. Take those of"
    " reference_scores."
)
_WRONG_IN_REFERENCE_UNITS = {
    "kl-coef-unchanged": (
        _converted(weight=lambda b, u: b),
        "β is in units of score per nat, and the unit is another one now: with the old number the optimum is another policy.",
    ),
    "kl-coef-multiplied": (
        _converted(weight=lambda b, u: b * u),
        "The optimum rests on score / β alone. The scores were divided by the unit, so β has to be divided, too.",
    ),
    "kl-coef-by-the-variance": (
        _converted(weight=lambda b, u: b / u**2),
        "β is divided by a variance and the scores by a deviation: score / β is not what it was.",
    ),
    "scores-by-the-variance": (
        _converted(unit=lambda s, r: r.var(1).mean()),
        "This divides by the variance: the unit is its square root.",
    ),
    "own-statistics": (_converted(lambda s, r: s.mean(1, keepdim=True), lambda s, r: s.var(1).mean().sqrt()), _OWN),
    "own-zero": (
        _converted(zero=lambda s, r: s.mean(1, keepdim=True)),
        "The zero is the mean of the scores that are converted, so a better policy looks no better: take the mean of reference_scores.",
    ),
    "own-unit": (
        _converted(unit=lambda s, r: s.var(1).mean().sqrt()),
        "The unit is the deviation of the scores that are converted, and moves with the policy: take that of reference_scores.",
    ),
    "both-together": (
        _converted(
            lambda s, r: torch.cat([s, r], 1).mean(1, keepdim=True), lambda s, r: torch.cat([s, r], 1).var(1).mean().sqrt()
        ),
        "Scores of both policies are in the statistics: those of reference_scores alone stay the same while the policy learns.",
    ),
    "zero-left": (
        _converted(zero=lambda s, r: 0.0),
        "Nothing is subtracted: each prompt's zero is the mean of the reference's scores there.",
    ),
    "one-zero-for-all-prompts": (
        _converted(zero=lambda s, r: r.mean()),
        "One mean for all prompts leaves in what no comparison has fixed, a constant for each prompt: take the mean along the last axis.",
    ),
    "deviation-over-everything": (
        _converted(unit=lambda s, r: r.std()),
        "This deviation also holds how far prompts' means lie apart, which no comparison has fixed: add a constant to one prompt's"
        " scores, and β' changes. Take the deviation within prompts.",
    ),
    "whitened-over-everything": (
        _converted(lambda s, r: r.mean(), lambda s, r: r.std()),
        "One mean and one deviation over all prompts: both hold how far prompts lie apart, which no comparison has fixed.",
    ),
    "a-unit-for-each-prompt": (
        _converted(unit=lambda s, r: r.std(1, keepdim=True)),
        "With a unit for each prompt no single β' keeps the optimum: it takes one number for all prompts.",
    ),
    "mean-of-the-deviations": (
        _converted(unit=lambda s, r: r.std(1).mean()),
        "Average the prompts' variances and take the root then: the mean of the deviations is smaller.",
    ),
    "biased-deviation": (
        _converted(unit=lambda s, r: r.var(1, correction=0).mean().sqrt()),
        "Each prompt's squares are divided by k: its mean was estimated from the same k scores, so divide by k - 1.",
    ),
    "one-mean-counted": (
        _converted(unit=lambda s, r: ((r - r.mean(1, keepdim=True)).square().sum() / (r.numel() - 1)).sqrt()),
        "The squares are divided by B k - 1, as if one mean had been estimated: it was one for each prompt, so B (k - 1).",
    ),
    "small-number-added": (
        _converted(unit=lambda s, r: r.var(1).mean().sqrt() + 1e-8),
        "A small number is added to the deviation: small against which unit? Scores that are small themselves come out wrong.",
    ),
    "mean-added": (
        _converted(zero=lambda s, r: -r.mean(1, keepdim=True)),
        "The reference's mean is added: it is the zero from which scores are counted, so subtract it.",
    ),
    "median": (
        _converted(zero=lambda s, r: r.median(1, keepdim=True).values),
        "The zero is the median of the reference's scores: the mean is asked for.",
    ),
    "kl-coef-as-tensor": (
        lambda s, r, b: (_converted()(s, r, b)[0], b / r.var(1).mean().sqrt()),
        "β' is a setting: a Python float is asked for.",
    ),
}

IN_REFERENCE_UNITS = Exercise(
    name="in_reference_units",
    reference=ch96.in_reference_units,
    criteria={"values": 1.4, "gradient": 0.25, "dtype": 0.1, "inputs": 0.05, "errors": 0.2},
    axes=("prompt", "text"),
    cases=drawn_once(
        Case("four prompts", _of_two_policies(), closed_form=_units_by_numpy, visible=True, draws=3),
        Case("one prompt", _of_two_policies(1, 6), closed_form=_units_by_numpy, visible=True),
        Case("one text to each prompt", _of_two_policies(n=1), closed_form=_units_by_numpy),
        Case("two texts of the reference", _of_two_policies(6, k=2), closed_form=_units_by_numpy, visible=True),
        Case("prompts far apart", _of_two_policies(apart=100.0), closed_form=_units_by_numpy, visible=True),
        Case("scores of the size of 1e-9", _of_two_policies(size=1e-9, kl_coef=1e-10), closed_form=_units_by_numpy, visible=True),
        Case("scores of thousands", _of_two_policies(size=4000.0, kl_coef=150.0), closed_form=_units_by_numpy),
        Case("in that unit already", _in_that_unit_already, closed_form=lambda scores, kl_coef, **_rest: (scores, kl_coef)),
        Case("the reference's own texts", _own_texts, closed_form=_units_by_numpy),
        Case("one prompt of equal scores", _one_of_equals, closed_form=_units_by_numpy),
        Case("kl_coef = 0", _of_two_policies(kl_coef=0.0), closed_form=_units_by_numpy),
        Case("scores that require gradient", _of_two_policies(), differentiate=["scores"], visible=True),
        Case("both require gradient", _of_two_policies(), differentiate=_ALL_OF_TWO_POLICIES, visible=True, draws=2),
        Case("single precision", _of_two_policies(), dtype=torch.float32, visible=True),
        *shape_cases(_of_two_policies(), _ALL_OF_TWO_POLICIES),
        Case("one text of the reference", _of_two_policies(k=1), raises=["reference_scores"], visible=True),
        Case("all of the reference's scores equal", _all_equal, raises=["reference_scores"], visible=True),
        refused(_of_two_policies(), kl_coef=-0.1),
    ),
    misconceptions=(
        *wrong(_WRONG_IN_REFERENCE_UNITS, _in_units),
        Misconception(
            "gradient-into-the-statistics",
            _in_units(_converted(), leak=True),
            "Gradient flows into the reference's scores: its statistics are constants, so detach them.",
        ),
        Misconception("cut-from-graph", after(ch96.in_reference_units, lambda pair: (pair[0].detach(), pair[1])), CUT),
        Misconception("dtype-lost", after(ch96.in_reference_units, lambda pair: (pair[0].float(), pair[1])), DTYPE),
        in_place(ch96.in_reference_units, "scores"),
        bad_input_accepted(_in_units(rows_cut(_converted()), checked=False)),
    ),
    variants={
        "NumPy for the statistics": _in_units(
            lambda s, r, b: (
                (s - torch.from_numpy(r.numpy().mean(1, keepdims=True))) / float(np.sqrt(r.numpy().var(1, ddof=1).mean())),
                b / float(np.sqrt(r.numpy().var(1, ddof=1).mean())),
            )
        ),
        "prompt by prompt": _in_units(_prompt_by_prompt),
        "differences of pairs": _in_units(_by_pairs),
        "residuals": _in_units(_by_residuals),
        "standard deviations squared": _in_units(_converted(unit=lambda s, r: r.std(1).square().mean().sqrt())),
    },
)

# ------------------------------------------------------------------------------------------------------------- best_of_n


@drawing
def _candidates(generator, batch=6, n=5, change=lambda scores: scores):
    """Scores without ties."""
    return {"scores": change(normal(generator, batch, n))}


def _search(scores):
    return torch.tensor([max(range(len(row)), key=row.__getitem__) for row in scores.tolist()])


_WRONG_BEST_OF_N = {
    "lowest-score": (lambda s: s.argmin(-1), "This is the worst candidate: take the highest score."),
    "scores-instead-of-indices": (
        lambda s: s.detach().amax(-1),
        "These are the best scores: which candidates have them is asked, as int64 indices.",
    ),
    "best-prompt": (
        lambda s: s.argmax(0),
        "For each candidate this finds the best prompt: search along the last axis, over the candidates of each prompt.",
    ),
    "whole-batch": (
        lambda s: s.argmax(),
        "One index for the whole batch: without dim, argmax searches everything. Each prompt needs its own.",
    ),
    "position-in-the-batch": (
        lambda s: s.argmax(-1) + torch.arange(len(s)) * s.shape[1],
        "These count through the whole batch: an index from 0 to n - 1 is asked for each prompt.",
    ),
    "largest-magnitude": (lambda s: s.abs().argmax(-1), "A very bad score is no good score: do not take the absolute value."),
    "all-indices-sorted": (
        lambda s: s.argsort(-1, descending=True),
        "This is the whole ranking, (B, n): only its first column is asked for.",
    ),
    "one-hot": (
        lambda s: (s == s.amax(-1, keepdim=True)).long(),
        "This marks the best candidate, (B, n): its index is asked for, (B,).",
    ),
    "int32": (lambda s: s.argmax(-1).int(), "Indices are int64, or they index nothing in older code."),
}

BEST_OF_N = Exercise(
    name="best_of_n",
    reference=ch96.best_of_n,
    criteria={"values": 0.65, "dtype": 0.1},
    axes=("prompt",),
    cases=(
        Case("five candidates for six prompts", _candidates(), closed_form=_search, visible=True, draws=3),
        Case("as many prompts as candidates", _candidates(4, 4), closed_form=_search, visible=True, draws=3),
        Case("all scores negative", _candidates(change=lambda scores: -scores.abs()), closed_form=_search, visible=True),
        Case("all scores positive", _candidates(change=torch.abs), closed_form=_search),
        Case("scores far below 0", _candidates(change=lambda scores: scores - 1e6), closed_form=_search),
        Case("a single candidate", _candidates(3, 1), closed_form=_search),
        Case("many candidates for one prompt", _candidates(1, 64), closed_form=_search),
        Case("scores that require gradient", _candidates(), differentiate=["scores"]),
        Case("single precision", _candidates(), dtype=torch.float32),
    ),
    misconceptions=wrong(_WRONG_BEST_OF_N),
    variants={
        "search": _search,
        "last of the sorted": lambda s: s.sort(dim=1).indices[:, -1],
        "NumPy": lambda s: torch.from_numpy(s.detach().numpy().argmax(1)),
        "topk": lambda s: s.topk(1, dim=-1).indices.squeeze(-1),
        "max": lambda s: s.max(dim=1)[1],
    },
)

# ---------------------------------------------------------------------------------------------------------- best_of_n_kl


@drawing
def _n(generator, low, high=None):
    """A number of candidates: this one, or one from low to high - 1."""
    return {"n": int(integers(generator, low, high or low + 1))}


QUADRATURE = np.polynomial.legendre.leggauss(200)


def _kl_by_integral(n):
    """KL of the best of n: the best one's rank among all texts has density n u^(n-1), so the KL is ∫ n u^(n-1) log(n u^(n-1)) du."""
    nodes, weights = QUADRATURE
    t = (nodes + 1) / 2  # with u = t^(1/n), the density of t is 1 and the logarithm's argument n t^((n-1)/n)
    return float((weights / 2 * (math.log(n) + (n - 1) / n * np.log(t))).sum())


_kl = versions_of(ch96.best_of_n_kl, satisfies(lambda n: n >= 1))

_WRONG_BEST_OF_N_KL = {
    "logarithm-alone": (
        lambda n: math.log(n),
        "log n is the surprise at the very best text; averaged over the best of n it is (n - 1) / n less.",
    ),
    "correction-added": (
        lambda n: math.log(n) + (n - 1) / n,
        "(n - 1) / n is subtracted: at n = 1 either sign gives 0, at n = 2 it has to be log 2 - 1/2.",
    ),
    "base-two": (lambda n: math.log2(n) - (n - 1) / n, "log2 gives bits: nats are asked for."),
    "one-over-n": (lambda n: math.log(n) - 1 / n, "The correction is (n - 1) / n: at n = 1 there is no choice and no KL."),
    "not-divided": (lambda n: math.log(n) - (n - 1), "A KL is never negative: the correction is (n - 1) / n."),
    "n-plus-one": (lambda n: math.log(n) - (n - 1) / (n + 1), "The correction's denominator is n."),
    "the-wrong-way-round": (
        lambda n: n - 1 - math.log(n),
        "This is KL(policy ‖ best of n), the other direction: the expectation is over the best of n.",
    ),
    "tensor": (lambda n: torch.tensor(math.log(n) - (n - 1) / n), "A Python float is asked for: nothing here is learnt."),
}

BEST_OF_N_KL = Exercise(
    name="best_of_n_kl",
    reference=ch96.best_of_n_kl,
    criteria={"values": 0.6, "errors": 0.15},
    cases=(
        Case("n = 1: nothing is chosen", _n(1), closed_form=lambda n: 0.0, visible=True, draws=1),
        Case("n = 2", _n(2), closed_form=lambda n: 0.6931471805599453 - 0.5, visible=True, draws=1),
        Case("n = 4", _n(4), closed_form=lambda n: 2 * math.log(2) - 0.75, visible=True, draws=1),
        Case("a few", _n(3, 20), closed_form=_kl_by_integral, atol=1e-4, draws=3),
        Case("dozens", _n(20, 300), closed_form=_kl_by_integral, atol=1e-4, visible=True, draws=3),
        Case("a million", _n(1_000_000), closed_form=_kl_by_integral, atol=1e-4, draws=1),
        refused(_n(2), n=0, visible=True),
        refused(_n(2), n=-3),
        refused(_n(2), n=0.5),
    ),
    misconceptions=(
        *wrong(_WRONG_BEST_OF_N_KL, _kl),
        bad_input_accepted(
            lambda n: math.log(max(n, 1)) - (n - 1) / n if n else 0.0,
            "n < 1 must be refused with a ValueError that names n.",
        ),
    ),
    variants={
        "1 / n - 1": _kl(lambda n: math.log(n) + 1 / n - 1),
        "NumPy": _kl(lambda n: float(np.log(n) - (n - 1) / n)),
        "torch": _kl(lambda n: (torch.tensor(float(n), dtype=torch.float64).log() - 1 + 1 / n).item()),
        "log1p": _kl(lambda n: math.log1p(n - 1) - (1 - 1 / n)),
    },
)

# ---------------------------------------------------------------------------------------------------- length_correlation


@drawing
def _lengths(generator, slope, batch=12, dtype=torch.int64):
    """Scores that rise by `slope` standard deviations of theirs for one of the lengths'."""
    lengths = integers(generator, 5, 60, batch)
    lengths[:2] = torch.tensor([5, 60])
    scores = slope * (lengths - lengths.double().mean()) / lengths.double().std() + normal(generator, batch) + 3.0
    return {"scores": scores, "lengths": lengths.to(dtype)}


_STRAIGHT_LINE = altered(_lengths(0.0), lambda drawn: {"scores": 2.0 - 0.25 * drawn["lengths"].double()})
# a very long text: ranks and values say different things
_ONE_OUTLIER = reshaped(_lengths(0.5), "lengths", lambda lengths: lengths.index_fill(0, torch.tensor([3]), 500))


def _by_numpy(scores, lengths):
    return torch.tensor(np.corrcoef(scores.detach().numpy(), lengths.numpy())[0, 1], dtype=scores.dtype)


_BOTH = ("scores", "lengths")
_measured = versions_of(ch96.length_correlation, one_shape(*_BOTH), data=_BOTH)


def _correlation(formula, **options):
    """A version: `formula` takes both in the scores' dtype."""
    return _measured(lambda scores, lengths: formula(scores, lengths.to(scores.dtype)), **options)


def _covariance(a, b):
    return ((a - a.mean()) * (b - b.mean())).mean()


def _cosine(a, b):
    return (a @ b) / (a.norm() * b.norm())


def _pearson(a, b):
    return _cosine(a - a.mean(), b - b.mean())


def _ranks(x):
    return x.argsort().argsort().to(x.dtype)


_WRONG_LENGTH_CORRELATION = {
    "covariance": (_covariance, "This is the covariance, in units of score times tokens: divide by both standard deviations."),
    "slope": (
        lambda a, b: _covariance(a, b) / _covariance(b, b),
        "This is the slope of a regression, score per token: divide by both standard deviations instead.",
    ),
    "not-centred": (_cosine, "This is the cosine between two lists: subtract the means first, or any two positive lists agree."),
    "ranks": (
        lambda a, b: _pearson(_ranks(a), _ranks(b)),
        "This is Spearman's correlation, of ranks: Pearson's is of the values.",
    ),
    "squared": (lambda a, b: _pearson(a, b) ** 2, "This is R², which has lost the sign."),
    "absolute": (lambda a, b: _pearson(a, b).abs(), "The sign is lost: shorter may be better."),
    "sign-flipped": (lambda a, b: -_pearson(a, b), "Longer is better should give a positive number."),
    "mixed-deviations": (
        lambda a, b: _covariance(a, b) / (a.std() * b.std()),
        "A mean over B is divided by deviations over B - 1: on a straight line the result is not ±1. Use one of the two throughout.",
    ),
    "logarithm-of-lengths": (lambda a, b: _pearson(a, b.log()), "Correlate with the lengths themselves."),
}

LENGTH_CORRELATION = Exercise(
    name="length_correlation",
    reference=ch96.length_correlation,
    criteria={"values": 0.7, "gradient": 0.1, "dtype": 0.1, "inputs": 0.05, "errors": 0.05},
    cases=drawn_once(
        Case("longer is better", _lengths(1.0), closed_form=_by_numpy, visible=True, draws=3),
        Case("shorter is better", _lengths(-1.0), closed_form=_by_numpy, visible=True),
        Case("nothing to see", _lengths(0.0), closed_form=_by_numpy),
        Case("lengths as floating-point numbers", _lengths(0.5, dtype=torch.float64), closed_form=_by_numpy),
        Case("on a falling line: -1", _STRAIGHT_LINE, closed_form=number(-1.0), visible=True),
        Case("one very long text", _ONE_OUTLIER, closed_form=_by_numpy),
        Case("three texts", _lengths(0.5, batch=3), closed_form=_by_numpy),
        Case("scores that require gradient", _lengths(0.5), differentiate=["scores"], visible=True),
        Case("single precision", _lengths(0.5), dtype=torch.float32, visible=True),
        *shape_cases(_lengths(0.5), _BOTH),
    ),
    misconceptions=(
        *wrong(_WRONG_LENGTH_CORRELATION, _correlation),
        Misconception("graph-kept", _correlation(_pearson, leak=True), METRIC),
        dtype_lost(ch96.length_correlation),
        in_place(ch96.length_correlation, "scores"),
        bad_input_accepted(_correlation(rows_cut(_pearson), checked=False)),
    ),
    variants={
        "NumPy": _correlation(_by_numpy),
        "torch.corrcoef": _correlation(lambda a, b: torch.corrcoef(torch.stack([a, b]))[0, 1]),
        "cosine of centred lists": _correlation(_pearson),
        "standardised by the unbiased deviation": _correlation(
            lambda a, b: ((a - a.mean()) / a.std() * (b - b.mean()) / b.std()).sum() / (len(a) - 1)
        ),
        "in Python": _correlation(lambda a, b: torch.tensor(statistics.correlation(a.tolist(), b.tolist()), dtype=a.dtype)),
    },
)

# ------------------------------------------------------------------------------------------------------ repaired_choices

_PAIR = ("first", "second", "first_ratings", "second_ratings")


@drawing
def _opinions(generator, low, high, batch=14, dtype=torch.int8):
    """Pairs of texts and ratings from low to high; two of the pairs are ties and two are decided, one each way."""
    texts = torch.randperm(40, generator=generator)[: 2 * batch]
    ratings = integers(generator, low, high + 1, 2, batch)
    ratings[:, :4] = torch.tensor([[low, high, high, low], [low, high, low, high]])
    ratings = ratings[:, torch.randperm(batch, generator=generator)].to(dtype)
    return dict(zip(_PAIR, (texts[:batch], texts[batch:], *ratings), strict=True))


def _one_left(generator):
    drawn = _opinions(-1, 1)(generator)
    drawn["second_ratings"] = drawn["first_ratings"].clone()
    drawn["first_ratings"][3], drawn["second_ratings"][3] = 0, 1
    return drawn


def _only(ties):
    """The pairs that are ties, or those that are not."""

    def some(drawn):
        keep = (drawn["first_ratings"] == drawn["second_ratings"]) == ties
        return {name: value[keep] for name, value in drawn.items()}

    return altered(_opinions(-4, 4), some)


_HALF_STARS = altered(_opinions(2, 9), lambda drawn: {name: drawn[name] / 2 for name in _PAIR[2:]})


def _pair_by_pair(first, second, first_ratings, second_ratings):
    kept = []
    for *texts, a, b in zip(*(x.tolist() for x in (first, second, first_ratings, second_ratings)), strict=True):
        if a != b:
            kept.append(texts if a > b else texts[::-1])
    return tuple(torch.tensor(kept, dtype=torch.int64).reshape(-1, 2).unbind(1))


_choices = versions_of(ch96.repaired_choices, one_shape(*_PAIR))


def _decided(first_wins, kept):
    """A formula by two masks, of the ratings: where the first text wins, and which pairs count."""

    def formula(first, second, a, b):
        wins, rows = first_wins(a, b), kept(a, b)
        return torch.where(wins, first, second)[rows], torch.where(wins, second, first)[rows]

    return formula


def _everything(a, b):
    return torch.ones_like(a, dtype=torch.bool)


def _by_gather(first, second, a, b):
    table = torch.stack([first, second], dim=1)[a != b]  # (B', 2)
    better = torch.stack([a, b], dim=1)[a != b].argmax(1, keepdim=True)
    return table.gather(1, better)[:, 0], table.gather(1, 1 - better)[:, 0]


def _by_sign(first, second, a, b):
    sign = (a.double() - b.double()).sign().long()
    middle, half = first + second, (first - second) * sign
    return ((middle + half) // 2)[sign != 0], ((middle - half) // 2)[sign != 0]


def _pairs_by_numpy(first, second, a, b):
    first, second, a, b = (x.numpy() for x in (first, second, a, b))
    kept = np.flatnonzero(a != b)
    return tuple(torch.from_numpy(np.where(a > b, *texts)[kept]) for texts in ((first, second), (second, first)))


def _exchanged_in_place(first, second, a, b):
    second_wins = b > a
    first[second_wins], second[second_wins] = second[second_wins], first[second_wins]
    return first[a != b], second[a != b]


_WRONG_DECISIONS = {
    "ties-to-the-first": (
        _decided(lambda a, b: a >= b, _everything),
        "This is the suspect's rule: a tie counts as a victory of the first text, and which text comes first is no accident.",
    ),
    "ties-to-the-second": (
        _decided(lambda a, b: a > b, _everything),
        "Now ties count as victories of the second text: the same fault the other way round. A tie says nothing.",
    ),
    "ties-at-random": (
        _decided(lambda a, b: (a > b) | ((a == b) & (torch.arange(len(a)) % 2 == 0)), _everything),
        "Ties that fall to either side by turns teach no length, but they are noise: leave them out.",
    ),
    "chosen-and-rejected-swapped": (
        _decided(lambda a, b: a < b, lambda a, b: a != b),
        "The text with the higher rating is chosen: here it is rejected.",
    ),
    "only-where-the-first-wins": (
        _decided(lambda a, b: a > b, lambda a, b: a > b),
        "Pairs that the second text wins are left out as well: now the first text always wins, which is worse than before.",
    ),
    "only-where-the-second-wins": (
        _decided(lambda a, b: a > b, lambda a, b: a < b),
        "Pairs that the first text wins are left out as well: only ties say nothing.",
    ),
    "neutral-left-out": (
        _decided(lambda a, b: a > b, lambda a, b: (a != 0) & (b != 0) & (a != b)),
        "A neutral text against a positive one is a clear preference: leave out equal ratings, not ratings of 0.",
    ),
    "ties-kept-the-rest-left-out": (
        _decided(lambda a, b: a >= b, lambda a, b: a == b),
        "The mask is the wrong way round: these are the pairs that say nothing.",
    ),
    "positions-of-pairs": (
        lambda first, second, a, b: ((a > b).nonzero().squeeze(1), (b > a).nonzero().squeeze(1)),
        "These are positions in the list of pairs: indices of texts are asked for, from first and second.",
    ),
    "order-lost": (
        lambda first, second, a, b: (torch.cat([first[a > b], second[b > a]]), torch.cat([second[a > b], first[b > a]])),
        "The pairs have changed their order: whatever else is known of each pair no longer belongs to it.",
    ),
    "int32": (
        lambda *given: tuple(index.int() for index in ch96.repaired_choices(*given)),
        "Indices are int64, or they index nothing in older code.",
    ),
    "input-changed": (_exchanged_in_place, IN_PLACE),
}

REPAIRED_CHOICES = Exercise(
    name="repaired_choices",
    reference=ch96.repaired_choices,
    criteria={"values": 1.6, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    cases=drawn_once(
        Case("ratings from -4 to 4", _opinions(-4, 4), closed_form=_pair_by_pair, visible=True, draws=3),
        Case("negative, neutral or positive", _opinions(-1, 1), closed_form=_pair_by_pair, visible=True, draws=3),
        Case("stars as floating-point numbers", _opinions(1, 5, dtype=torch.float32), closed_form=_pair_by_pair, visible=True),
        Case("half stars", _HALF_STARS, closed_form=_pair_by_pair),
        Case("no ties", _only(ties=False), closed_form=_pair_by_pair),
        Case("one pair left", _one_left, closed_form=_pair_by_pair),
        Case("nothing but ties", _only(ties=True), closed_form=_pair_by_pair),
        *shape_cases(_opinions(-1, 1), _PAIR),
    ),
    misconceptions=(
        *wrong(_WRONG_DECISIONS, _choices),
        bad_input_accepted(_choices(rows_cut(ch96.repaired_choices), checked=False)),
    ),
    variants={
        "pair by pair in Python": _choices(_pair_by_pair),
        "gather": _choices(_by_gather),
        "sign of the difference": _choices(_by_sign),
        "NumPy": _choices(_pairs_by_numpy),
        "masks": _choices(_decided(lambda a, b: a > b, lambda a, b: a.ne(b))),
    },
)

EXERCISES = (
    LAST_TOKEN_SCORES,
    REWARD_MODEL_LOSS,
    IN_REFERENCE_UNITS,
    BEST_OF_N,
    BEST_OF_N_KL,
    LENGTH_CORRELATION,
    REPAIRED_CHOICES,
)
