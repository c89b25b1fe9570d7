"""Checks of chapter 101: cases, named misconceptions and correct variants for learning from a verifier."""

from __future__ import annotations

from dataclasses import replace as changed
from itertools import combinations, pairwise
from typing import Any

import torch

from autograder.authoring.parts import (
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
    uniform,
    versions_of,
    wrong,
)
from autograder.authoring.spec import Case, Exercise, Misconception
from course_lib.checks.cases import built
from solutions import ch45, ch95, ch101

# ---------------------------------------------------------------------------------------------------------- verify_sorted


@drawing
def _answers(generator, spoil=lambda right: right):
    sizes = integers(generator, 2, 8, 6).tolist()
    prompts = ["".join(map(str, integers(generator, 0, 10, size).tolist())) + "=" for size in sizes]
    right = ["".join(sorted(prompt[:-1])) for prompt in prompts]
    return {"prompts": prompts, "completions": [spoil(text) if row % 2 else text for row, text in enumerate(right)]}


def _strings(*pairs):
    prompts, completions = ([pair[side] for pair in pairs] for side in (0, 1))
    return lambda _generator: {"prompts": prompts, "completions": completions}


_by_strings = versions_of(ch101.verify_sorted, satisfies(lambda prompts, completions: len(prompts) == len(completions)))


def _judging(right):
    """An answer from a rule for one prompt and one completion."""
    return _by_strings(lambda prompts, texts: torch.tensor([float(right(p, t)) for p, t in zip(prompts, texts, strict=False)]))


def _ascending(text):
    return all(a <= b for a, b in pairwise(text))


_VERIFIED = _strings(("31=", "13"), ("31=", "31"), ("31=", "133"), ("31=", ""), ("77=", "77"), ("90=", "09"))
VERIFY_SORTED = Exercise(
    name="verify_sorted",
    reference=ch101.verify_sorted,
    criteria={"values": 0.75, "errors": 0.25},
    cases=drawn_once(
        Case("right, wrong order, too long, empty", _VERIFIED, closed_form=number(1, 0, 0, 0, 1, 1), visible=True),
        Case("half of the answers reversed and longer", _answers(lambda right: right[::-1] + "0"), visible=True),
        Case(
            "other digits in order, or each only once",
            _strings(("321=", "124"), ("321=", "1234"), ("1123=", "123"), ("21=", "12"), ("21=", "112")),
            closed_form=number(0, 0, 0, 1, 0),
            visible=True,
        ),
        Case(
            "text around the answer",
            _strings(("21=", "12 "), ("21=", " 12"), ("21=", "12="), ("21=", "12."), ("21=", "12")),
            closed_form=number(0, 0, 0, 0, 1),
            visible=True,
        ),
        Case("a leading zero lost", _strings(("210=", "12"), ("210=", "012")), closed_form=number(0, 1), visible=True),
        Case("digits of another script", _strings(("21=", "١٢"), ("21=", "12")), closed_form=number(0, 1)),
        Case("the prompt given back", _strings(("12=", "12="), ("21=", "21=")), closed_form=number(0, 0)),
        Case("one completion too few", _strings(("21=", "12"), ("31=", "13")), closed_form=number(1, 1)),
        changed(
            Case("fewer completions than prompts", lambda _g: {"prompts": ["21=", "3="], "completions": ["12"]}),
            raises=["prompts", "completions"],
            visible=True,
        ),
    ),
    misconceptions=(
        *wrong(
            {
                "ascending-is-enough": (lambda p, t: _ascending(t), "Any ascending text passes, 0000 and nothing at all too."),
                "other-digits-accepted": (
                    lambda p, t: _ascending(t) and len(t) == len(p) - 1,
                    "The answer must have the prompt's own digits: here their number is looked at, not which they are.",
                ),
                "order-ignored": (lambda p, t: sorted(p[:-1]) == sorted(t), "The right digits in any order pass."),
                "set-of-digits": (
                    lambda p, t: sorted(set(p[:-1])) == sorted(set(t)) and _ascending(t),
                    "A set forgets how often a digit comes.",
                ),
                "numbers-compared": (
                    lambda p, t: t.isdigit() and int(t) == int("".join(sorted(p[:-1]))),
                    "As numbers 012 and 12 are equal, and int() reads other scripts' digits: compare texts.",
                ),
                "blanks-stripped": (
                    lambda p, t: t.strip() == "".join(sorted(p[:-1])),
                    "Blanks around the answer are forgiven: the answer is the digits and nothing else.",
                ),
                "beginning-is-enough": (
                    lambda p, t: t.startswith("".join(sorted(p[:-1]))),
                    "Whatever stands behind the answer is forgiven: the policy may go on for ever.",
                ),
                "anywhere-is-enough": (
                    lambda p, t: "".join(sorted(p[:-1])) in t,
                    "The answer may stand anywhere in the text: a policy that writes everything is always right.",
                ),
                "equals-sign-sorted-too": (
                    lambda p, t: t == "".join(sorted(p)),
                    "The = of the prompt is none of its digits.",
                ),
                "minus-one-for-wrong": (
                    lambda p, t: 1 if t == "".join(sorted(p[:-1])) else -1,
                    "A wrong answer is worth 0 here, not -1.",
                ),
            },
            _judging,
        ),
        bad_input_accepted(
            lambda prompts, completions: ch101.verify_sorted(prompts[: len(completions)], completions[: len(prompts)]),
            "Texts without a partner are dropped in silence: compare the numbers first, zip(..., strict=True) or an if.",
        ),
    ),
    variants={
        "counting digits": _judging(lambda p, t: t == "".join(d * p.count(d) for d in "0123456789")),
        "lists of characters": _judging(lambda p, t: list(t) == sorted(p.rstrip("="))),
        "ascending and the same digits": _judging(lambda p, t: _ascending(t) and sorted(t) == sorted(p.replace("=", ""))),
        "filled in": _by_strings(
            lambda p, t: torch.stack([torch.tensor(float(b == "".join(sorted(a[:-1])))) for a, b in zip(p, t, strict=True)])
        ),
    },
)

# -------------------------------------------------------------------------------------------------------------- pass_at_k


@drawing
def _counts(generator, n=10, k=3, prompts=7):
    return {"num_samples": n, "num_correct": integers(generator, 0, n + 1, prompts), "k": k}


def _enumerated(num_samples, num_correct, k):
    picks = list(combinations(range(num_samples), k))
    shares = [sum(min(pick) < c for pick in picks) / len(picks) for c in num_correct.tolist()]
    return torch.tensor(shares, dtype=torch.float64)


_tried = versions_of(
    ch101.pass_at_k,
    satisfies(lambda k, num_samples: 1 <= k <= num_samples),
    satisfies(lambda num_correct, num_samples: bool(((num_correct >= 0) & (num_correct <= num_samples)).all())),
)


def _log_comb(n, k):
    n, k = torch.as_tensor(n, dtype=torch.float64), torch.as_tensor(k, dtype=torch.float64)
    return torch.lgamma(n + 1) - torch.lgamma(k + 1) - torch.lgamma(n - k + 1)


def _by_lgamma(n, c, k):
    wrong_ones = (n - c).double()
    inside = (_log_comb(wrong_ones.clamp(min=k), k) - _log_comb(n, k)).exp()
    return torch.where(wrong_ones < k, 1.0, 1 - inside)


def _one_by_one(n, c, k):
    missed = torch.ones(len(c), dtype=torch.float64)
    for i in range(k):
        missed = missed * (n - c - i).clamp(min=0) / (n - i)
    return 1 - missed


def _none_right(num_samples, num_correct, k):
    return torch.zeros(len(num_correct), dtype=torch.float64)


PASS_AT_K = Exercise(
    name="pass_at_k",
    reference=ch101.pass_at_k,
    criteria={"values": 1.25, "errors": 0.25},
    axes=("prompt",),
    cases=drawn_once(
        Case("three of ten", _counts(), closed_form=_enumerated, visible=True, draws=3),
        Case(
            "k = 1: the share of right samples",
            _counts(8, 1),
            closed_form=lambda num_samples, num_correct, k: num_correct.double() / 8,
            visible=True,
        ),
        Case("all of them", _counts(6, 6), closed_form=_enumerated, visible=True),
        Case(
            "none right",
            replaced(_counts(9, 4), num_correct=torch.zeros(3, dtype=torch.int64)),
            closed_form=_none_right,
            visible=True,
        ),
        Case("all right", replaced(_counts(9, 4), num_correct=torch.full((3,), 9)), closed_form=number(1, 1, 1)),
        Case("thousands of samples", _counts(5000, 900, 5), closed_form=_one_by_one, visible=True),
        Case(
            "few of many right",
            altered(_counts(400, 5), lambda d: {"num_correct": d["num_correct"] % 4}),
            closed_form=_one_by_one,
        ),
        refused(_counts(), k=0, visible=True),
        refused(_counts(), k=11, visible=True),
        refused(_counts(), num_correct=torch.tensor([3, 11])),
        refused(_counts(), num_correct=torch.tensor([-1, 4]), visible=True),
    ),
    misconceptions=(
        *wrong(
            {
                "plug-in": (
                    lambda n, c, k: 1 - (1 - c.double() / n) ** k,
                    "Raising the estimated share to the power k is biased: it draws the same sample twice. Draw k of the n without"
                    " replacement.",
                ),
                "all-of-k": (
                    lambda n, c, k: (_log_comb(c.double().clamp(min=k), k) - _log_comb(n, k)).exp() * (c >= k),
                    "This is the chance that all k are right, not at least one.",
                ),
                "pass-at-1": (lambda n, c, k: c.double() / n, "k is not used: this is pass@1."),
                "k-times-pass-at-1": (
                    lambda n, c, k: (k * c.double() / n).clamp(max=1),
                    "Chances add up only if they exclude each other.",
                ),
                "fails-at-k": (
                    lambda n, c, k: 1 - _one_by_one(n, c, k),
                    "This is the chance that all k are wrong: subtract it from 1.",
                ),
                "any-right": (lambda n, c, k: (c > 0).double(), "This is pass@n, whatever k is."),
                "right-and-wrong-swapped": (
                    lambda n, c, k: _one_by_one(n, n - c, k),
                    "The samples that must all be missed are the wrong ones, n - c.",
                ),
                "factorials": (
                    lambda n, c, k: (
                        1 - _log_comb((n - c).double().clamp(min=k), k).exp() / _log_comb(n, k).exp() * ((n - c) >= k)
                    ),
                    "Numbers of combinations overflow with many samples, and inf / inf is nan: multiply the ratios one by one.",
                ),
                "one-number": (
                    lambda n, c, k: _one_by_one(n, c, k).mean(),
                    "Return one probability for each prompt: the caller takes the mean.",
                ),
            },
            _tried,
        ),
        bad_input_accepted(_tried(_one_by_one, checked=False)),
    ),
    variants={
        "one factor after the other": _tried(_one_by_one),
        "log-gamma": _tried(_by_lgamma),
        "product over the missed": _tried(
            lambda n, c, k: torch.stack(
                [
                    1 - (1 - k / torch.arange(n - m + 1, n + 1, dtype=torch.float64)).prod()
                    if n - m >= k
                    else torch.tensor(1.0).double()
                    for m in c.tolist()
                ]
            )
        ),
        "NumPy": _tried(lambda n, c, k: torch.from_numpy(_one_by_one(n, c, k).numpy().copy())),
    },
)

# ------------------------------------------------------------------------------------------------------- group_advantages


@drawing
def _groups(generator, groups=5, size=4, binary=False, **settings):
    rewards = integers(generator, 0, 2, groups * size).double() if binary else normal(generator, groups * size)
    return {"rewards": rewards, "group_size": size, **settings}


@drawing
def _priced(generator, groups=5, size=4, all_wrong=False, **settings):
    right = integers(generator, 0, 2, groups * size).double() * (0 if all_wrong else 1)
    return {"rewards": right - 1e-3 * integers(generator, 0, 8, groups * size).double(), "group_size": size, **settings}


def _alike(generator):
    return {"rewards": uniform(generator, 4).repeat_interleave(3), "group_size": 3, "eps": 1e-3}


def _row_by_row(rewards, group_size, baseline="mean", scale="group", eps=1e-6):
    found = []
    everything = ((rewards - rewards.mean()) ** 2).mean().sqrt()
    for group in rewards.split(group_size):
        for i, reward in enumerate(group):
            others = torch.cat([group[:i], group[i + 1 :]])
            base = group.mean() if baseline == "mean" else others.mean()
            own = ((group - group.mean()) ** 2).mean().sqrt()
            found.append((reward - base) / (own + eps if scale == "group" else everything + eps if scale == "batch" else 1))
    return torch.stack(found)


_GROUP_RULES = (
    satisfies(lambda group_size: group_size >= 2),
    satisfies(lambda rewards, group_size: len(rewards) % group_size == 0),
    satisfies(lambda baseline: baseline in ("mean", "leave_one_out")),
    satisfies(lambda scale: scale in ("group", "batch", "none")),
)
_grouped = versions_of(ch101.group_advantages, *_GROUP_RULES, data=("rewards",))


def _advantages(
    fold=lambda r, g: r.reshape(-1, g),
    unfold=lambda a: a.flatten(),
    centre=lambda r, g: r.mean(1, keepdim=True),
    leave=lambda g: g / (g - 1),
    own=lambda r, e: r.std(1, keepdim=True, correction=0) + e,
    whole=lambda r, e: r.std(correction=0) + e,
):
    """A formula with one of its places changed."""

    def formula(rewards, size, baseline, scale, eps):
        r = fold(rewards, size)
        a = (r - centre(r, size)) * (leave(size) if baseline == "leave_one_out" else 1)
        return unfold(a / (own(r, eps) if scale == "group" else whole(r, eps) if scale == "batch" else 1))

    return formula


_CORRECTED: dict[str, Any] = {"own": lambda r, e: r.std(1, keepdim=True) + e, "whole": lambda r, e: r.std() + e}


def _unbiased(rewards, group_size, baseline="mean", scale="group", eps=1e-6):
    return _grouped(_advantages(**_CORRECTED))(rewards, group_size, baseline, scale, eps)


def _inside(rewards, group_size, baseline="mean", scale="group", eps=1e-6):
    return _grouped(
        _advantages(
            own=lambda r, e: (r.var(1, keepdim=True, correction=0) + e).sqrt(),
            whole=lambda r, e: (r.var(correction=0) + e).sqrt(),
        )
    )(rewards, group_size, baseline, scale, eps)


def _unbiased_inside(rewards, group_size, baseline="mean", scale="group", eps=1e-6):
    return _grouped(_advantages(own=lambda r, e: (r.var(1, keepdim=True) + e).sqrt(), whole=lambda r, e: (r.var() + e).sqrt()))(
        rewards, group_size, baseline, scale, eps
    )


GROUP_ADVANTAGES = Exercise(
    name="group_advantages",
    reference=ch101.group_advantages,
    also_right=(_unbiased, _inside, _unbiased_inside),
    criteria={"values": 1.25, "gradient": 0.25, "dtype": 0.1, "inputs": 0.1, "errors": 0.3},
    axes=("answer",),
    cases=drawn_once(
        Case("the defaults", _groups(), visible=True, draws=2),
        Case("centred only", _groups(scale="none"), closed_form=_row_by_row, visible=True, draws=2),
        Case(
            "leave one out, centred only",
            _groups(baseline="leave_one_out", scale="none"),
            closed_form=_row_by_row,
            visible=True,
            draws=2,
        ),
        Case("leave one out, scaled by the group", _groups(baseline="leave_one_out"), visible=True),
        Case("scaled by the batch", _groups(scale="batch"), visible=True, draws=2),
        Case("right and wrong only", _groups(6, 3, binary=True, scale="none"), closed_form=_row_by_row),
        Case(
            "equal rewards in each group: 0",
            _alike,
            closed_form=lambda rewards, **_rest: torch.zeros_like(rewards),
            visible=True,
            atol=1e-9,
        ),
        Case("groups of two", _groups(4, 2, baseline="leave_one_out", scale="none"), closed_form=_row_by_row),
        Case("a large eps", _groups(eps=0.5)),
        Case("rewards that differ by thousandths", _priced(all_wrong=True), visible=True),
        Case("rewards that require gradient", _groups(scale="none"), differentiate=["rewards"], visible=True),
        Case("single precision", _groups(scale="none"), dtype=torch.float32, visible=True),
        refused(_groups(), group_size=1, visible=True),
        Case("rewards that are no whole groups", _groups(group_size=3), raises=["group_size", "rewards"], visible=True),
        refused(_groups(), baseline="median", visible=True),
        refused(_groups(), scale="std", visible=True),
    ),
    misconceptions=(
        *wrong(
            {
                "groups-interleaved": (
                    _advantages(fold=lambda r, g: r.reshape(g, -1).T, unfold=lambda a: a.T.flatten()),
                    "Groups are contiguous, but here every P-th answer is put into one group: reshape(-1, group_size).",
                ),
                "groups-interleaved-unbiased": (
                    _advantages(fold=lambda r, g: r.reshape(g, -1).T, unfold=lambda a: a.T.flatten(), **_CORRECTED),
                    "Groups are contiguous, but here every P-th answer is put into one group: reshape(-1, group_size).",
                ),
                "whole-batch-centred": (
                    _advantages(centre=lambda r, g: r.mean()),
                    "The baseline is the mean of the whole batch: a hard prompt's right answer is compared with easy prompts.",
                ),
                "whole-batch-centred-unbiased": (
                    _advantages(centre=lambda r, g: r.mean(), **_CORRECTED),
                    "The baseline is the mean of the whole batch: a hard prompt's right answer is compared with easy prompts.",
                ),
                "not-centred": (_advantages(centre=lambda r, g: 0), "No baseline is subtracted."),
                "leave-one-out-ignored": (
                    _advantages(leave=lambda g: 1),
                    "The mean of the others leaves the answer's own reward out.",
                ),
                "leave-one-out-ignored-unbiased": (
                    _advantages(leave=lambda g: 1, **_CORRECTED),
                    "The mean of the others leaves the answer's own reward out.",
                ),
                "leave-one-out-inverted": (
                    _advantages(leave=lambda g: (g - 1) / g),
                    "Leaving itself out makes an advantage larger, by G / (G - 1), not smaller.",
                ),
                "leave-one-out-inverted-unbiased": (
                    _advantages(leave=lambda g: (g - 1) / g, **_CORRECTED),
                    "Leaving itself out makes an advantage larger, by G / (G - 1), not smaller.",
                ),
                "sum-of-others": (
                    lambda r, g, b, s, e: (
                        _advantages()(r, g, b, s, e)
                        if b == "mean"
                        else _advantages(centre=lambda x, n: (x.sum(1, keepdim=True) - x) / n, leave=lambda n: 1)(r, g, b, s, e)
                    ),
                    "The sum of the others is divided by G: there are G - 1 of them.",
                ),
                "never-scaled": (
                    _advantages(own=lambda r, e: 1, whole=lambda r, e: 1),
                    "scale is not looked at: nothing is divided.",
                ),
                "group-for-batch": (
                    _advantages(whole=lambda r, e: r.std(1, keepdim=True, correction=0) + e),
                    "With batch the deviation is one number, of all rewards, and not of each group.",
                ),
                "batch-for-group": (
                    _advantages(own=lambda r, e: r.std(correction=0) + e),
                    "With group each group has a deviation of its own.",
                ),
                "group-for-batch-unbiased": (
                    _advantages(**_CORRECTED | {"whole": lambda r, e: r.std(1, keepdim=True) + e}),
                    "With batch the deviation is one number, of all rewards, and not of each group.",
                ),
                "batch-for-group-unbiased": (
                    _advantages(**_CORRECTED | {"own": lambda r, e: r.std() + e}),
                    "With group each group has a deviation of its own.",
                ),
                "variance-divides-unbiased": (
                    _advantages(own=lambda r, e: r.var(1, keepdim=True) + e, whole=lambda r, e: r.var() + e),
                    "The variance divides where its root should: advantages would have the unit 1 / reward.",
                ),
                "variance-divides": (
                    _advantages(
                        own=lambda r, e: r.var(1, keepdim=True, correction=0) + e, whole=lambda r, e: r.var(correction=0) + e
                    ),
                    "The variance divides where its root should: advantages would have the unit 1 / reward.",
                ),
                "floor-for-eps": (
                    _advantages(
                        own=lambda r, e: r.std(1, keepdim=True, correction=0).clamp(min=0.1),
                        whole=lambda r, e: r.std(correction=0).clamp(min=0.1),
                    ),
                    "The deviation gets a floor in the place of eps, so that small differences of reward are hardly scaled up.",
                ),
                "eps-forgotten": (
                    _advantages(own=lambda r, e: r.std(1, keepdim=True, correction=0), whole=lambda r, e: r.std(correction=0)),
                    "A group of equal rewards has deviation 0, and 0 / 0 is nan: add eps.",
                ),
                "sign-flipped": (lambda *given: -_advantages()(*given), "Better answers must have larger advantages."),
            },
            _grouped,
        ),
        Misconception("graph-kept", _grouped(_advantages(), leak=True), "Advantages are data: detach them."),
        dtype_lost(ch101.group_advantages),
        in_place(ch101.group_advantages, "rewards"),
        bad_input_accepted(
            _grouped(
                lambda r, g, b, s, e: _advantages(fold=lambda x, n: x[: len(x) // max(n, 1) * n].reshape(-1, n))(
                    r, max(g, 1), b, s, e
                ),
                checked=False,
            )
        ),
    ),
    variants={
        "row by row": _grouped(_row_by_row),
        "unbiased deviation": _unbiased,
        "eps inside the root": _inside,
        "sum of the others": _grouped(
            lambda r, g, b, s, e: _advantages(
                centre=lambda x, n: x.mean(1, keepdim=True) if b == "mean" else (x.sum(1, keepdim=True) - x) / (n - 1),
                leave=lambda n: 1,
            )(r, g, b, s, e)
        ),
    },
)

# --------------------------------------------------------------------------------------------------------- aggregate_loss


@drawing
def _tokens(generator, batch=4, length=7, **settings):
    lengths = integers(generator, 1, length + 1, batch)
    lengths[0], lengths[1] = 1, length
    return {"terms": 1 + normal(generator, batch, length), "mask": torch.arange(length) < lengths[:, None], **settings}


_AGGREGATES = {"how": ("tokens", "sequences", "constant")}
_aggregating = versions_of(
    ch101.aggregate_loss,
    one_shape("terms", "mask"),
    satisfies(lambda how: how in _AGGREGATES["how"]),
    satisfies(lambda max_length, how: how != "constant" or (max_length is not None and max_length >= 1)),
)


def _loop(terms, mask, how="tokens", max_length=None):
    rows = [row[keep] for row, keep in zip(terms, mask, strict=True)]
    if how == "tokens":
        return torch.cat(rows).mean()
    if how == "sequences":
        return torch.stack([row.mean() for row in rows]).mean()
    return torch.stack([row.sum() / max_length for row in rows]).mean()


def _aggregate(
    tokens=lambda x, m: x.sum() / m.sum(),
    sequences=lambda x, m: (x.sum(1) / m.sum(1)).mean(),
    constant=lambda x, m, n: x.sum() / (len(x) * n),
    masked=lambda x, m: torch.where(m, x, 0),
):
    def formula(terms, mask, how, max_length):
        x = masked(terms, mask)
        return constant(x, mask, max_length) if how == "constant" else {"tokens": tokens, "sequences": sequences}[how](x, mask)

    return formula


_CONSTANT = _tokens(how="constant", max_length=10)
AGGREGATE_LOSS = Exercise(
    name="aggregate_loss",
    reference=ch101.aggregate_loss,
    criteria={"values": 1.0, "gradient": 0.25, "dtype": 0.1, "inputs": 0.1, "errors": 0.3},
    axes=("answer", "token"),
    cases=drawn_once(
        Case("tokens, the default", _tokens(), closed_form=_loop, visible=True, draws=2),
        Case("sequences", _tokens(how="sequences"), closed_form=_loop, visible=True, draws=2),
        Case("constant", _CONSTANT, closed_form=_loop, visible=True, draws=2),
        Case("constant, of three tokens", _tokens(length=3, how="constant", max_length=3), closed_form=_loop),
        Case("terms that require gradient", _tokens(how="sequences"), differentiate=["terms"], visible=True),
        Case("gradient of tokens where padding holds ±10,000", loud_padding(_tokens(), "terms"), differentiate=["terms"]),
        Case("constant where padding holds ±10,000", loud_padding(_CONSTANT, "terms"), closed_form=_loop),
        Case("single precision", _tokens(), dtype=torch.float32, visible=True),
        *shape_cases(_tokens(), ("terms", "mask")),
        refused(_tokens(), how="mean", visible=True),
        refused(_CONSTANT, max_length=0, visible=True),
        refused(_CONSTANT, max_length=None),
    ),
    misconceptions=(
        *wrong(
            {
                "padding-counted": (
                    _aggregate(masked=lambda x, m: x),
                    "Terms of padding are summed: they are no choices of the policy.",
                ),
                "padding-divides": (
                    _aggregate(tokens=lambda x, m: x.mean(), sequences=lambda x, m: x.mean()),
                    "The sum is divided by the size of the tensor, padding included: the loss depends on the longest answer.",
                ),
                "how-ignored": (
                    lambda x, m, how, n: _aggregate()(x, m, "tokens", n),
                    "how is ignored: whatever it says, the mean over all tokens comes out.",
                ),
                "tokens-by-rows": (
                    _aggregate(tokens=lambda x, m: (x.sum(1) / m.sum(1)).mean()),
                    "With tokens every token of the batch weighs the same: this is the mean of row means.",
                ),
                "sequences-by-tokens": (
                    _aggregate(sequences=lambda x, m: x.sum() / m.sum()),
                    "With sequences every answer weighs the same: take each row's mean, then the mean of these.",
                ),
                "tokens-and-sequences-swapped": (
                    _aggregate(tokens=lambda x, m: (x.sum(1) / m.sum(1)).mean(), sequences=lambda x, m: x.sum() / m.sum()),
                    "tokens and sequences are exchanged: with tokens every token weighs the same, with sequences every answer.",
                ),
                "sequences-summed": (
                    _aggregate(sequences=lambda x, m: (x.sum(1) / m.sum(1)).sum()),
                    "The rows' means are added up: the step would grow with the batch.",
                ),
                "rows-not-averaged": (
                    _aggregate(sequences=lambda x, m: x.sum(1).mean()),
                    "With sequences each row is divided by its own number of tokens first.",
                ),
                "constant-by-longest": (
                    _aggregate(constant=lambda x, m, n: x.sum() / (len(x) * m.shape[1])),
                    "The constant is max_length, and not the width of this batch, which is as long as its longest answer.",
                ),
                "constant-by-tokens": (
                    _aggregate(constant=lambda x, m, n: x.sum() / m.sum()),
                    "With constant the divisor does not depend on the answers' lengths.",
                ),
                "constant-without-batch": (
                    _aggregate(constant=lambda x, m, n: x.sum() / n),
                    "With constant the sum is divided by the number of answers, too.",
                ),
            },
            _aggregating,
        ),
        cut_from_graph(ch101.aggregate_loss),
        dtype_lost(ch101.aggregate_loss),
        python_float(ch101.aggregate_loss),
        in_place(ch101.aggregate_loss, "terms"),
        bad_input_accepted(
            _aggregating(
                lambda x, m, how, n: rows_cut(
                    lambda a, b: _aggregate()(a, b, how if how in _AGGREGATES["how"] else "tokens", n or 1)
                )(x, m),
                checked=False,
            )
        ),
    ),
    variants={
        "row by row": _aggregating(_loop),
        "by products": _aggregating(_aggregate(masked=lambda x, m: x * m)),
        "weights first": _aggregating(
            lambda x, m, how, n: (
                x.masked_fill(~m, 0)
                * {
                    "tokens": 1 / m.sum(),
                    "sequences": 1 / (m.sum(1, keepdim=True) * len(m)),
                    "constant": torch.tensor(1 / (len(m) * (n or 1))),
                }[how].to(x.dtype)
            ).sum()
        ),
        "in double precision": _aggregating(lambda x, m, how, n: _aggregate()(x.double(), m, how, n).to(x.dtype)),
    },
)

# ---------------------------------------------------------------------------------------------------------------- kl_term


@drawing
def _two_policies(generator, batch=3, length=5, **settings):
    ref = -2 + normal(generator, batch, length)
    return {"logps": ref + 0.5 * normal(generator, batch, length), "ref_logps": ref, **settings}


@drawing
def _every_token(generator, **settings):
    """Two distributions over a small vocabulary, all tokens listed: (contexts, vocabulary)."""
    return {"logps": normal(generator, 3, 6).log_softmax(-1), "ref_logps": normal(generator, 3, 6).log_softmax(-1), **settings}


def _by_exponentials(logps, ref_logps, estimator="k3"):
    ratio = (ref_logps - logps).exp()
    return {"k1": -ratio.log(), "k2": ratio.log() ** 2 / 2, "k3": ratio - 1 - ratio.log()}[estimator]


_estimating = versions_of(
    ch101.kl_term,
    one_shape("logps", "ref_logps"),
    satisfies(lambda estimator: estimator in ("k1", "k2", "k3")),
    data=("ref_logps",),
)


def _estimators(**other):
    known = {"k1": lambda x: x, "k2": lambda x: x**2 / 2, "k3": lambda x: (-x).expm1() + x} | other
    return lambda logps, ref_logps, estimator: known[estimator](logps - ref_logps)


KL_TERM = Exercise(
    name="kl_term",
    reference=ch101.kl_term,
    criteria={"values": 0.9, "gradient": 0.45, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    axes=("answer", "token"),
    cases=drawn_once(
        *(
            Case(f"{name}: values", _two_policies(estimator=name), closed_form=_by_exponentials, visible=True, draws=2)
            for name in ("k1", "k2", "k3")
        ),
        Case("k3 is the default", _two_policies(), closed_form=_by_exponentials, visible=True),
        *(
            Case(
                f"{name}: gradient, every token of a vocabulary",
                _every_token(estimator=name),
                differentiate=["logps", "ref_logps"],
                visible=True,
            )
            for name in ("k1", "k2", "k3")
        ),
        Case("equal policies: 0", altered(_two_policies(), lambda d: {"logps": d["ref_logps"].clone()}), visible=True),
        Case("single precision", _two_policies(), dtype=torch.float32, visible=True),
        *shape_cases(_two_policies(), ("logps", "ref_logps")),
        refused(_two_policies(), estimator="k4", visible=True),
    ),
    misconceptions=(
        *wrong(
            {
                "ratio-inverted": (
                    _estimators(k3=lambda x: x.expm1() - x),
                    "k3's exponential is of the reference over the policy, e^(-x): with e^x its mean under the policy is no divergence.",
                ),
                "k3-without-log": (_estimators(k3=lambda x: (-x).expm1()), "k3 adds x to e^(-x) - 1: without it the mean is 0."),
                "k3-without-one": (
                    _estimators(k3=lambda x: (-x).exp() + x),
                    "k3 is 0 where the policies agree: the 1 is missing.",
                ),
                "k2-without-half": (_estimators(k2=lambda x: x**2), "k2 has a half: its gradient is x times that of logps."),
                "k2-absolute": (_estimators(k2=lambda x: x.abs()), "k2 is the square, divided by 2, not the absolute value."),
                "k1-sign": (_estimators(k1=lambda x: -x), "x is logps - ref_logps: its mean under the policy is positive."),
                "k3-for-all": (
                    _estimators(k1=lambda x: (-x).expm1() + x, k2=lambda x: (-x).expm1() + x),
                    "estimator is not looked at.",
                ),
                "weights-of-the-policy": (
                    lambda p, r, e: p.exp() * _estimators()(p, r, e),
                    "The tokens were drawn from the policy already: weighting by its probabilities counts them twice.",
                ),
                "averaged": (
                    lambda p, r, e: _estimators()(p, r, e).mean(),
                    "Return a term for each token: the mask comes later.",
                ),
            },
            _estimating,
        ),
        Misconception("graph-to-reference", _estimating(_estimators(), leak=True), "The reference is frozen: detach ref_logps."),
        cut_from_graph(ch101.kl_term),
        dtype_lost(ch101.kl_term),
        in_place(ch101.kl_term, "logps"),
        bad_input_accepted(
            _estimating(
                lambda p, r, e: rows_cut(lambda a, b: _estimators()(a, b, e if e in ("k1", "k2", "k3") else "k3"))(p, r),
                checked=False,
            )
        ),
    ),
    variants={
        "from the ratio": _estimating(_by_exponentials),
        "from the ratio, by name": _estimating(
            lambda p, r, e: p - r if e == "k1" else 0.5 * (r - p).square() if e == "k2" else (r - p).exp() - (r - p) - 1
        ),
        "in double precision": _estimating(lambda p, r, e: _estimators()(p.double(), r.double(), e).to(p.dtype)),
        "all three, one picked": _estimating(
            lambda p, r, e: torch.stack([p - r, (p - r) ** 2 / 2, torch.exp(r - p) - 1 + p - r])[int(e[1]) - 1]
        ),
    },
)

# -------------------------------------------------------------------------------------------------------------- grpo_loss


@drawing
def _updated(generator, batch=5, length=6, ref=False, **settings):
    drawn = _tokens(batch, length)(generator)
    old = -1.5 + 0.5 * normal(generator, batch, length)
    given = {"logps": old + 0.4 * normal(generator, batch, length), "old_logps": old}
    given |= {"advantages": normal(generator, batch), "mask": drawn["mask"]}
    return given | ({"ref_logps": old + 0.3 * normal(generator, batch, length)} if ref else {}) | settings


_LOSS_NAMES = ("logps", "old_logps", "mask")
_lossy = versions_of(
    ch101.grpo_loss,
    one_shape(*_LOSS_NAMES),
    satisfies(lambda advantages, logps: len(advantages) == len(logps)),
    satisfies(lambda clip_low: clip_low >= 0),
    satisfies(lambda clip_high: clip_high >= 0),
    satisfies(lambda beta: beta >= 0),
    satisfies(lambda ref_logps, beta: beta == 0 or ref_logps is not None),
    data=("old_logps", "advantages", "ref_logps"),
)


def _share(hit, m, like):
    return ((hit & m).sum() / m.sum()).to(like.dtype).detach()


def _loss(
    ratio=lambda x: x.exp(),
    weights=lambda a, m: a[:, None],
    bounded=lambda q, w, lo, hi: torch.minimum(q * w, q.clamp(1 - lo, 1 + hi) * w),
    kl=lambda p, r: (r - p).exp() - 1 - (r - p),
    price=lambda b: b,
    sign=-1,
    total=ch101.aggregate_loss,
    low=lambda q, w, lo: (q < 1 - lo) & (w < 0),
    high=lambda q, w, hi: (q > 1 + hi) & (w > 0),
    old=lambda p, o: o,
):
    """A formula with one of its places changed."""

    def formula(p, o, a, m, lo, hi, r, b, how, n):
        q = ratio(torch.where(m, p - old(p, o), 0))
        w = weights(a, m)
        terms = sign * bounded(q, w, lo, hi)
        if b:
            terms = terms + price(b) * kl(torch.where(m, p, 0), torch.where(m, r, 0))
        return total(terms, m, how, n), {"clipped_low": _share(low(q, w, lo), m, q), "clipped_high": _share(high(q, w, hi), m, q)}

    return formula


def _grpo_by_token(
    logps, old_logps, advantages, mask, clip_low=0.2, clip_high=0.28, ref_logps=None, beta=0.0, how="tokens", max_length=None
):
    terms, low, high = torch.zeros_like(logps), 0, 0
    for row, column in mask.nonzero().tolist():
        q, weight = (logps[row, column] - old_logps[row, column]).exp(), advantages[row]
        cut_low, cut_high = bool(q < 1 - clip_low and weight < 0), bool(q > 1 + clip_high and weight > 0)
        bound = 1 - clip_low if cut_low else 1 + clip_high if cut_high else q
        terms[row, column] = -bound * weight
        if beta:
            x = logps[row, column] - ref_logps[row, column]
            terms[row, column] += beta * (torch.exp(-x) - 1 + x)
        low, high = low + cut_low, high + cut_high
    shares = [torch.tensor(hits / int(mask.sum()), dtype=logps.dtype) for hits in (low, high)]
    return _loop(terms, mask, how, max_length), {"clipped_low": shares[0], "clipped_high": shares[1]}


_WITH_REF = _updated(ref=True, beta=0.3)
_UNPADDED = ("logps", "old_logps")
GRPO_LOSS = Exercise(
    name="grpo_loss",
    reference=ch101.grpo_loss,
    criteria={"values": 1.75, "gradient": 0.5, "dtype": 0.1, "inputs": 0.1, "errors": 0.3},
    axes=("answer", "token"),
    cases=drawn_once(
        Case("the defaults", _updated(), closed_form=_grpo_by_token, visible=True, draws=3),
        Case("other bounds", _updated(clip_low=0.05, clip_high=0.5), closed_form=_grpo_by_token, visible=True, draws=2),
        Case("no bounds", _updated(clip_low=float("inf"), clip_high=float("inf")), closed_form=_grpo_by_token, visible=True),
        Case("with a divergence", _WITH_REF, closed_form=_grpo_by_token, visible=True, draws=2),
        Case("every answer alike: how = sequences", _updated(how="sequences"), closed_form=_grpo_by_token, visible=True),
        Case("how = constant", _updated(how="constant", max_length=9), closed_form=_grpo_by_token, visible=True),
        Case("first step: all ratios are 1", altered(_updated(), lambda d: {"logps": d["old_logps"].clone()}), visible=True),
        Case("gradient", _updated(), differentiate=["logps", "old_logps", "advantages"], visible=True, draws=2),
        Case("gradient of the divergence", _WITH_REF, differentiate=["logps", "ref_logps"], visible=True),
        Case("gradient where padding holds ±10,000", loud_padding(_updated(), *_UNPADDED), differentiate=["logps"], visible=True),
        Case("the same with a divergence", loud_padding(_WITH_REF, *_UNPADDED, "ref_logps"), differentiate=["logps"]),
        Case("single precision", _updated(), dtype=torch.float32, visible=True),
        *shape_cases(_updated(), _LOSS_NAMES),
        Case(
            "advantages of one answer too few",
            reshaped(_updated(), "advantages", lambda x: x[1:]),
            raises=["advantages", "logps"],
        ),
        refused(_updated(), clip_low=-0.1, visible=True),
        refused(_updated(), clip_high=-0.1),
        refused(_WITH_REF, beta=-0.1),
        Case("beta without a reference", _updated(beta=0.1), raises=["ref_logps", "beta"], visible=True),
    ),
    misconceptions=(
        *wrong(
            {
                "maximum": (
                    _loss(bounded=lambda q, w, lo, hi: torch.maximum(q * w, q.clamp(1 - lo, 1 + hi) * w)),
                    "The objective takes the smaller of the two: with the larger one nothing is held.",
                ),
                "always-clamped": (
                    _loss(bounded=lambda q, w, lo, hi: q.clamp(1 - lo, 1 + hi) * w),
                    "The clip alone also silences tokens that have moved the wrong way and should come back: take the minimum.",
                ),
                "bounds-swapped": (
                    _loss(
                        bounded=lambda q, w, lo, hi: torch.minimum(q * w, q.clamp(1 - hi, 1 + lo) * w),
                        low=lambda q, w, lo: (q < 1 - 0.28) & (w < 0) if lo == 0.2 else (q < 1 - lo) & (w < 0),
                    ),
                    "clip_low goes below 1, clip_high above.",
                ),
                "bounds-swapped-in-the-shares-too": (
                    _loss(
                        bounded=lambda q, w, lo, hi: torch.minimum(q * w, q.clamp(1 - hi, 1 + lo) * w),
                        low=lambda q, w, lo: (q < 1 - (0.28 if lo == 0.2 else lo)) & (w < 0),
                        high=lambda q, w, hi: (q > 1 + (0.2 if hi == 0.28 else hi)) & (w > 0),
                    ),
                    "clip_low goes below 1, clip_high above.",
                ),
                "one-bound": (
                    _loss(bounded=lambda q, w, lo, hi: torch.minimum(q * w, q.clamp(1 - lo, 1 + lo) * w)),
                    "clip_high is not used: the interval is 1 - clip_low to 1 + clip_high.",
                ),
                "sign-missing": (_loss(sign=1), "The objective is to be maximised and a loss minimised: negate it."),
                "log-ratio": (_loss(ratio=lambda x: x), "The ratio is the exponential of the difference of log-probabilities."),
                "ratio-inverted": (_loss(old=lambda p, o: 2 * p - o), "The ratio is new over old."),
                "no-kl": (_loss(price=lambda b: 0), "beta and ref_logps are not used."),
                "kl-rewarded": (_loss(price=lambda b: -b), "The divergence is a cost: it is added to the loss."),
                "k1-in-the-loss": (
                    _loss(kl=lambda p, r: p - r),
                    "This is k1, whose gradient is 0 in expectation: it holds nothing. Use k3.",
                ),
                "k3-inverted": (_loss(kl=lambda p, r: (p - r).exp() - 1 - (p - r)), "k3 has the reference over the policy."),
                "row-means": (
                    _loss(total=lambda t, m, how, n: ch101.aggregate_loss(t, m, "sequences" if how == "tokens" else how, n)),
                    "With tokens, the default, every token of the batch weighs the same.",
                ),
                "how-ignored": (
                    _loss(total=lambda t, m, how, n: ch101.aggregate_loss(t, m)),
                    "how is not handed to aggregate_loss.",
                ),
                "padding-counted": (
                    _loss(total=lambda t, m, how, n: ch101.aggregate_loss(t, torch.ones_like(m), how, n)),
                    "Padding counts as if it had been chosen.",
                ),
                "share-of-all-outside": (
                    _loss(low=lambda q, w, lo: q < 1 - lo, high=lambda q, w, hi: q > 1 + hi),
                    "A ratio out of the interval is silenced only where the advantage pushes it further out.",
                ),
                "shares-swapped": (
                    lambda *given: _shares_swapped(*_loss()(*given)),
                    "clipped_low counts ratios below the interval, clipped_high those above.",
                ),
            },
            _lossy,
        ),
        Misconception(
            "graph-to-data",
            _lossy(_loss(), leak=True),
            "Old and reference log-probabilities and advantages are data: detach them.",
        ),
        Misconception(
            "ratio-before-the-mask",
            _lossy(lambda p, o, a, m, lo, hi, r, b, how, n: _unmasked(p, o, a, m, lo, hi, r, b, how, n)),
            "The ratio of padding overflows, and 0 times infinity is nan in the gradient: apply the mask before exp.",
        ),
        Misconception(
            "cut-from-graph",
            after(ch101.grpo_loss, lambda pair: (pair[0].detach(), pair[1])),
            "Nothing can be learnt: the loss has no graph.",
        ),
        Misconception(
            "dtype-lost",
            after(ch101.grpo_loss, lambda pair: (pair[0].float(), {k: x.float() for k, x in pair[1].items()})),
            "The results must have the inputs' dtype.",
        ),
        in_place(ch101.grpo_loss, "logps"),
        bad_input_accepted(
            _lossy(
                lambda p, o, a, m, lo, hi, r, b, how, n: rows_cut(
                    lambda p, o, a, m: _loss()(
                        p, o, a, m, abs(lo), abs(hi), p.detach() if r is None else r[: len(p)], abs(b), how, n
                    )
                )(p, o, a, m),
                checked=False,
            )
        ),
    ),
    variants={
        "token by token": _lossy(_grpo_by_token),
        "one formula": _lossy(_loss()),
        "maximum of the negated": _lossy(
            _loss(bounded=lambda q, w, lo, hi: torch.maximum(-q * w, -q.clamp(1 - lo, 1 + hi) * w), sign=1)
        ),
        "by the sign of the advantage": _lossy(
            _loss(bounded=lambda q, w, lo, hi: torch.where(w > 0, q.clamp(max=1 + hi), q.clamp(min=1 - lo)) * w)
        ),
    },
)


def _shares_swapped(loss, told):
    return loss, {"clipped_low": told["clipped_high"], "clipped_high": told["clipped_low"]}


def _unmasked(p, o, a, m, lo, hi, r, b, how, n):
    q = (p - o).exp()
    w = a[:, None]
    terms = -torch.minimum(q * w, q.clamp(1 - lo, 1 + hi) * w)
    if b:
        terms = terms + b * ((r - p).exp() - 1 - (r - p))
    shares = {"clipped_low": _share((q < 1 - lo) & (w < 0), m, q), "clipped_high": _share((q > 1 + hi) & (w > 0), m, q)}
    return ch101.aggregate_loss(terms, m, how, n), shares


# --------------------------------------------------------------------------------------------------------- sequence_ratio

_ONLY_RATIO = ("logps", "old_logps", "mask")


def _sequences(**settings):
    drawn = _updated(**settings)
    return lambda generator: {name: value for name, value in drawn(generator).items() if name in _ONLY_RATIO}


def _geometric(logps, old_logps, mask):
    means = [(new - old)[keep].mean() for new, old, keep in zip(logps, old_logps, mask, strict=True)]
    return torch.stack(means).exp()


_ratios = versions_of(ch101.sequence_ratio, one_shape(*_ONLY_RATIO), data=("old_logps",))


def _masked(p, o, m):
    return torch.where(m, p - o, 0)


SEQUENCE_RATIO = Exercise(
    name="sequence_ratio",
    reference=ch101.sequence_ratio,
    criteria={"values": 0.75, "gradient": 0.25, "dtype": 0.1, "inputs": 0.1, "errors": 0.3},
    axes=("answer",),
    cases=drawn_once(
        Case("answers of unequal length", _sequences(), closed_form=_geometric, visible=True, draws=3),
        Case("one answer", _sequences(batch=2), closed_form=_geometric, visible=True),
        Case("gradient", _sequences(), differentiate=["logps", "old_logps"], visible=True),
        Case("gradient where padding holds ±10,000", loud_padding(_sequences(), "logps", "old_logps"), differentiate=["logps"]),
        Case("long answers", _sequences(length=300), closed_form=_geometric),
        Case("single precision", _sequences(), dtype=torch.float32, visible=True),
        *shape_cases(_sequences(), _ONLY_RATIO),
    ),
    misconceptions=(
        *wrong(
            {
                "length-forgotten": (
                    lambda p, o, m: _masked(p, o, m).sum(1).exp(),
                    "Without the root of the length the ratio of a long answer explodes or vanishes: take the mean, not the sum.",
                ),
                "arithmetic-mean": (
                    lambda p, o, m: torch.where(m, _masked(p, o, m).exp(), 0).sum(1) / m.sum(1),
                    "The mean is taken of the ratios: take it of their logarithms, then exponentiate.",
                ),
                "padding-counted": (lambda p, o, m: (p - o).mean(1).exp(), "Padding counts as if it had been chosen."),
                "padding-divides": (
                    lambda p, o, m: _masked(p, o, m).mean(1).exp(),
                    "The sum is divided by the width of the batch: divide by each answer's own number of tokens.",
                ),
                "inverted": (lambda p, o, m: (-_masked(p, o, m).sum(1) / m.sum(1)).exp(), "The ratio is new over old."),
                "logarithm": (lambda p, o, m: _masked(p, o, m).sum(1) / m.sum(1), "This is the ratio's logarithm: exponentiate."),
                "root-of-the-batch": (
                    lambda p, o, m: (_masked(p, o, m).sum(1) / m.sum() * len(m)).exp(),
                    "Every answer has a length of its own: here the mean length is used for all.",
                ),
            },
            _ratios,
        ),
        Misconception("graph-to-old", _ratios(_geometric, leak=True), "The old log-probabilities are data: detach them."),
        cut_from_graph(ch101.sequence_ratio),
        dtype_lost(ch101.sequence_ratio),
        in_place(ch101.sequence_ratio, "logps"),
        bad_input_accepted(_ratios(rows_cut(_geometric), checked=False)),
    ),
    variants={
        "row by row": _ratios(_geometric),
        "product and root": _ratios(lambda p, o, m: (_masked(p, o, m).sum(1).exp()) ** (1 / m.sum(1).to(p.dtype))),
        "weights": _ratios(lambda p, o, m: ((p - o).masked_fill(~m, 0) * (m / m.sum(1, keepdim=True)).to(p.dtype)).sum(1).exp()),
        "in double precision": _ratios(lambda p, o, m: (_masked(p.double(), o.double(), m).sum(1) / m.sum(1)).exp().to(p.dtype)),
    },
)

# --------------------------------------------------------------------------------------------------------- grpo_iteration

END = 4  # of the vocabulary 0, 1, 2, "=" and end


@drawing
def _practice(generator, answers=8, prompts=("0=", "1=", "2="), reward=None, certain=None, learning_rate=2.0, **settings):
    """A table that answers three prompts at random, and a verifier. One minibatch for all, so that the order makes no difference."""
    table = 0.3 * normal(generator, 3, 3, END + 1).float()
    table[:, :, END - 1] = -9.0
    if certain is not None:
        for digit in range(3):
            table[digit, 1, certain[digit]] = table[digit, 2, END] = 40.0
    chosen = {
        "prompts": len(prompts),
        "group_size": answers,
        "scale": "none",
        "new_tokens": 4,
        "minibatch": 500,
        "max_grad_norm": 100.0,
        "epochs": 2,
    }
    return {
        "policy": built("language.verifiable.Table", table=table, learning_rate=learning_rate),
        "prompts": list(prompts),
        "verify": built("language.verifiable.verifier", reward=reward),
        "settings": built("language.verifiable.GroupSettings", **(chosen | settings)),
        "generator": built("seeding.generator", seed=int(integers(generator, 0, 2**31, 1))),
    }


def _in_a_row(prompts, size):
    return [prompt for prompt in prompts for _ in range(size)]


def _iterating(
    ask=_in_a_row,
    advantages=lambda r, s: ch101.group_advantages(r, s.group_size, s.baseline, s.scale),
    mask=lambda samples, end: ch95.completion_mask(samples.input_ids, samples.prompt_lengths, end)[:, 1:],
    old=lambda old, new: old,
    parts=lambda n, s, generator: ch45.minibatches(n, s.minibatch, generator),
    silent=lambda r, s: (r.reshape(-1, s.group_size).std(1) == 0).float().mean().item(),
    longest=lambda s, kept: s.new_tokens,
    sign=1,
    **fixed,
):
    """A version of the program, from the places where it can go wrong; `fixed` are settings of its own, whatever the caller's are."""

    def version(policy, prompts, verify, settings, generator):
        s = changed(settings, **fixed)
        asked = ask(prompts, s.group_size)
        samples = policy.generate(asked, s.new_tokens, generator=generator)
        ids, attention = samples.input_ids, samples.attention_mask
        rewards = verify(asked, samples.texts)
        weights, kept = advantages(rewards, s), mask(samples, policy.end_id)
        before = ch95.per_token_logps(policy.logits(ids, attention), ids).detach()
        shares = []
        for _ in range(s.epochs):
            for rows in parts(len(asked), s, generator):
                now = ch95.per_token_logps(policy.logits(ids[rows], attention[rows]), ids[rows])
                given = (now, old(before[rows], now.detach()), weights[rows], kept[rows], s.clip_low, s.clip_high)
                loss, told = ch101.grpo_loss(*given, how=s.how, max_length=longest(s, kept))
                policy.step(sign * loss, s.max_grad_norm)
                shares.append([told["clipped_low"].item(), told["clipped_high"].item()])
        low, high = (sum(column) / len(shares) for column in zip(*shares, strict=True))
        return {"reward": rewards.mean().item(), "silent": silent(rewards, s), "clipped_low": low, "clipped_high": high}

    return version


_TABLE = {"returns": ("policy",)}
_LEARNS = {"returns": ("policy",), "view": "answers_of_a_table"}
_TOLD = {"rtol": 1e-4, "atol": 1e-6}
_case = lambda name, inputs, **options: Case(name, inputs, **({"rtol": 1e-4, "atol": 1e-5, "draws": 1} | options))  # noqa: E731
GRPO_ITERATION = Exercise(
    name="grpo_iteration",
    reference=ch101.grpo_iteration,
    criteria={"values": 3.0},
    cases=(
        _case("what it learns in ten iterations", _practice(32, learning_rate=20.0), repeat=10, **_LEARNS, visible=True, draws=2),
        _case("the policy after one iteration", _practice(16), **_TABLE, visible=True, draws=2),
        _case("one divisor for all tokens", _practice(16, how="constant"), **_TABLE, visible=True),
        _case(
            "leave one out, sequences",
            _practice(6, baseline="leave_one_out", how="sequences", learning_rate=6.0),
            **_TABLE,
            draws=4,
        ),
        _case("narrow bounds, many passes", _practice(16, clip_low=0.02, clip_high=0.05, epochs=6), **_TABLE),
        # whichever deviation divides, a gradient that is cut to one length keeps only its direction
        _case(
            "scaled by the group, a short gradient",
            _practice(64, scale="group", epochs=1, max_grad_norm=0.003, learning_rate=200.0),
            **_TABLE,
            visible=True,
            draws=3,
        ),
        _case("equal rewards: nothing changes", _practice(reward=1.0), **_TABLE, visible=True),
        _case("what is told of an ordinary iteration", _practice(16, clip_low=0.02, clip_high=0.05, epochs=4), visible=True),
        _case("what is told where two prompts are always right", _practice(certain=(0, 1, 0)), visible=True),
        _case("steps of small minibatches", _practice(8, minibatch=10), returns=("policy",), view="steps_made", visible=True),
        _case("what is drawn from", _practice(), returns=("generator",), view="drawn_from"),
    ),
    misconceptions=wrong(
        {
            "repeated-in-the-wrong-order": (
                _iterating(ask=lambda prompts, size: list(prompts) * size),
                "The prompts are asked one after the other, and again: each group then has answers to different prompts. Ask each prompt"
                " group_size times in a row.",
            ),
            "asked-once": (
                _iterating(
                    ask=lambda prompts, size: list(prompts), advantages=lambda r, s: r - r.mean(), silent=lambda r, s: 0.0
                ),
                "Each prompt is asked once: there is no group to compare with.",
            ),
            "raw-rewards": (
                _iterating(advantages=lambda r, s: r),
                "The rewards go into the loss as they are: compare within groups.",
            ),
            "scale-fixed": (_iterating(scale="group"), "scale is group whatever the settings say."),
            "scale-fixed-unbiased": (
                _iterating(advantages=lambda r, s: _unbiased(r, s.group_size, s.baseline)),
                "scale is group whatever the settings say.",
            ),
            "never-scaled": (_iterating(scale="none"), "scale of the settings is not used: nothing is divided."),
            "baseline-fixed": (_iterating(baseline="mean"), "baseline is mean whatever the settings say."),
            "how-fixed": (_iterating(how="tokens"), "The loss is over tokens whatever settings.how says."),
            "bounds-fixed": (_iterating(clip_low=0.2, clip_high=0.28), "clip_low and clip_high of the settings are not used."),
            "one-epoch-only": (_iterating(epochs=1), "The answers are used once: settings.epochs says how often."),
            "whole-batch-at-once": (
                _iterating(parts=lambda n, s, generator: [torch.arange(n)]),
                "There is one step in each pass: make one for each minibatch.",
            ),
            "gradient-not-bounded": (_iterating(max_grad_norm=1e9), "Hand settings.max_grad_norm to policy.step."),
            "old-logps-renewed": (
                _iterating(old=lambda old, new: new),
                "The old log-probabilities are those of the policy that answered: computed once, before the first step.",
            ),
            "prompt-counted": (
                _iterating(mask=lambda samples, end: samples.attention_mask[:, 1:]),
                "The prompt's tokens are trained, too: the policy did not choose them.",
            ),
            "mask-shifted": (
                _iterating(
                    mask=lambda samples, end: ch95.completion_mask(samples.input_ids, samples.prompt_lengths, end)[:, :-1]
                ),
                "The mask is one column late: per_token_logps begins with the second token, so the mask's first column goes.",
            ),
            "longest-of-the-batch": (
                _iterating(longest=lambda s, kept: kept.shape[1]),
                "max_length is settings.new_tokens, what an answer may have, and not the width of this batch.",
            ),
            "end-dropped": (
                _iterating(
                    mask=lambda samples, end: (
                        ch95.completion_mask(samples.input_ids, samples.prompt_lengths, end)[:, 1:]
                        & (samples.input_ids[:, 1:] != end)
                    )
                ),
                "The end token is a choice: without its gradient the policy never learns to stop.",
            ),
            "uphill": (_iterating(sign=-1), "grpo_loss is negated already: step down its gradient."),
            "silent-is-wrong": (
                _iterating(silent=lambda r, s: (r.reshape(-1, s.group_size).sum(1) == 0).float().mean().item()),
                "A group in which all answers are right has no signal either.",
            ),
        }
    ),
    variants={
        "parts by name": _iterating(),
        "with the unbiased deviation": _iterating(
            advantages=lambda r, s: _unbiased(r, s.group_size, s.baseline, s.scale),
        ),
        "with eps inside the root": _iterating(advantages=lambda r, s: _inside(r, s.group_size, s.baseline, s.scale)),
        "prompts repeated by index": _iterating(
            ask=lambda prompts, size: [prompts[i // size] for i in range(len(prompts) * size)]
        ),
        "silent groups by their ends": _iterating(
            silent=lambda r, s: sum(float(g.min() == g.max()) for g in r.split(s.group_size)) / (len(r) // s.group_size)
        ),
        "slices of a permutation": _iterating(
            parts=lambda n, s, generator: torch.randperm(n, generator=generator).split(s.minibatch)
        ),
    },
)

# ---------------------------------------------------------------------------------------------------- repaired_advantages


_repaired = versions_of(ch101.repaired_advantages, *_GROUP_RULES[:2], data=("rewards",))


def _centred(rewards, group_size):
    return torch.cat([group - group.sum() / len(group) for group in rewards.split(group_size)])


def _repair(change):
    """An answer from what is done to groups (P, G)."""
    return lambda r, g: change(r.reshape(-1, g)).flatten()


def _c(x):
    return x - x.mean(1, keepdim=True)


REPAIRED_ADVANTAGES = Exercise(
    name="repaired_advantages",
    reference=ch101.repaired_advantages,
    criteria={"values": 1.5, "gradient": 0.15, "dtype": 0.1, "inputs": 0.1, "errors": 0.15},
    axes=("answer",),
    cases=drawn_once(
        Case("right and wrong answers", _priced(), closed_form=_centred, visible=True, draws=3),
        Case("groups that are all wrong", _priced(all_wrong=True), closed_form=_centred, visible=True, draws=2),
        Case("rewards of any size", _groups(), closed_form=lambda rewards, group_size: _centred(rewards, group_size), draws=2),
        Case("groups of two", _priced(3, 2), closed_form=_centred),
        Case("rewards that require gradient", _priced(), differentiate=["rewards"], visible=True),
        Case("single precision", _priced(), dtype=torch.float32, visible=True, atol=1e-6),
        refused(_priced(), group_size=1, visible=True),
        Case("rewards that are no whole groups", _priced(size=4, group_size=3), raises=["group_size", "rewards"], visible=True),
    ),
    misconceptions=(
        *wrong(
            {
                "divided-by-the-group": (
                    _repair(lambda x: _c(x) / (x.std(1, keepdim=True, correction=0) + 1e-6)),
                    "This is the suspect's own line: in a group of wrong answers a thousandth of reward becomes a whole advantage.",
                ),
                "larger-epsilon": (
                    _repair(lambda x: _c(x) / (x.std(1, keepdim=True, correction=0) + 0.1)),
                    "A larger eps still makes one difference worth more in some groups than in others.",
                ),
                "divided-by-the-batch": (
                    _repair(lambda x: _c(x) / (x.std(correction=0) + 1e-6)),
                    "One divisor for all groups repairs it, too, but then advantages are not in units of reward, as is asked.",
                ),
                "divided-by-the-group-unbiased": (
                    _repair(lambda x: _c(x) / (x.std(1, keepdim=True) + 1e-6)),
                    "This is the suspect's own line: in a group of wrong answers a thousandth of reward becomes a whole advantage.",
                ),
                "divided-by-the-batch-unbiased": (
                    _repair(lambda x: _c(x) / (x.std() + 1e-6)),
                    "One divisor for all groups repairs it, too, but then advantages are not in units of reward, as is asked.",
                ),
                "sign-only": (
                    _repair(lambda x: _c(x).sign()),
                    "Every difference counts as much as any other: worse than before.",
                ),
                "rounded-away": (
                    _repair(lambda x: _c(x.round())),
                    "The tie-breaker is gone: two right answers of different length must still differ by their thousandths.",
                ),
                "not-centred": (_repair(lambda x: x), "The advantages of a group must add up to 0."),
                "batch-centred": (_repair(lambda x: x - x.mean()), "Centre each group, not the batch."),
                "leave-one-out": (
                    _repair(lambda x: _c(x) * x.shape[1] / (x.shape[1] - 1)),
                    "Leave one out is a right baseline, but differences then are larger than those of the rewards.",
                ),
                "wrong-groups-dropped": (
                    _repair(lambda x: _c(x) * (x.amax(1, keepdim=True) > 0.5)),
                    "Groups without a right answer get nothing: two of their answers differ in reward and so must their advantages.",
                ),
            },
            _repaired,
        ),
        Misconception("graph-kept", _repaired(_centred, leak=True), "Advantages are data: detach them."),
        dtype_lost(ch101.repaired_advantages),
        in_place(ch101.repaired_advantages, "rewards"),
        bad_input_accepted(_repaired(lambda r, g: _repair(_c)(r[: len(r) // max(g, 1) * max(g, 1)], max(g, 1)), checked=False)),
    ),
    variants={
        "group by group": _repaired(_centred),
        "folded": _repaired(_repair(_c)),
        "differences averaged": _repaired(_repair(lambda x: (x[:, :, None] - x[:, None, :]).mean(2))),
        "group_advantages": _repaired(lambda r, g: ch101.group_advantages(r, g, scale="none")),
    },
)

EXERCISES = (
    VERIFY_SORTED,
    PASS_AT_K,
    GROUP_ADVANTAGES,
    AGGREGATE_LOSS,
    KL_TERM,
    GRPO_LOSS,
    SEQUENCE_RATIO,
    GRPO_ITERATION,
    REPAIRED_ADVANTAGES,
)
