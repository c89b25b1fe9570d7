"""Checks of chapter 97: cases, named misconceptions and correct variants for DPO, IPO and the optimum that they rest on."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch.nn import functional

from autograder.authoring.parts import (
    SHAPES,
    after,
    cut_from_graph,
    drawn_once,
    dtype_lost,
    in_place,
    integers,
    loud_padding,
    normal,
    refused,
    reshaped,
    shape_cases,
)
from autograder.authoring.spec import Case, Exercise, Misconception
from course_lib import validate
from solutions import ch97

LOGPS = ("chosen_logps", "rejected_logps", "ref_chosen_logps", "ref_rejected_logps")

# -------------------------------------------------------------------------------------------------------- sequence_logps


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


def _two_tokens(generator):
    """Each text's only prediction: what is squeezed too much loses an axis here."""
    mask = torch.tensor([[False, True]]).repeat(3, 1)
    return _texts(generator, 3, 2) | {"completion_mask": mask}


def _whole_rows(generator):
    """Even the first column is marked."""
    drawn = _texts(generator)
    return drawn | {"completion_mask": torch.ones_like(drawn["completion_mask"])}


def _one_token_each(generator):
    drawn = _texts(generator)
    return drawn | {"completion_mask": torch.arange(9) == integers(generator, 1, 9, 4)[:, None]}


def _nothing_kept(generator):
    drawn = _texts(generator)
    drawn["completion_mask"][1] = False
    return drawn


def _unlikely(generator):
    return _texts(generator, scale=2000.0)


def _loud(generator):
    drawn = _texts(generator)
    kept = functional.pad(drawn["completion_mask"][:, 1:], (0, 1))  # the logits at t predict the token at t + 1
    return drawn | {"logits": loud_padding(lambda _: drawn | {"kept": kept}, "logits", mask="kept")(generator)["logits"]}


def _even_odds(generator):
    drawn = _texts(generator)
    return drawn | {"logits": torch.full_like(drawn["logits"], 3.0)}


def _log_of_even_odds(logits, completion_mask, **_rest):
    return -math.log(logits.shape[-1]) * completion_mask[:, 1:].sum(1).to(logits.dtype)


def _by_token(logits, input_ids, completion_mask):
    sums = []
    for row in range(len(logits)):
        total = logits.new_zeros(())
        for t in range(1, logits.shape[1]):
            if completion_mask[row, t]:
                scores = logits[row, t - 1]
                total = total + scores[input_ids[row, t]] - torch.logsumexp(scores, 0)
        sums.append(total)
    return torch.stack(sums)


_TEXTS = ("logits", "input_ids", "completion_mask")


def _text_shapes(logits, input_ids, completion_mask):
    """Another style of validation than the reference's."""
    if not logits.shape[:2] == input_ids.shape == completion_mask.shape:
        shapes = f"{tuple(logits.shape)}, {tuple(input_ids.shape)} and {tuple(completion_mask.shape)}"
        raise ValueError(f"logits, input_ids and completion_mask must agree in batch and length, got {shapes}")


def _sequence(formula, checked=True):
    """A version: `formula` takes all three arguments."""

    def version(logits, input_ids, completion_mask):
        if checked:
            _text_shapes(logits, input_ids, completion_mask)
        return formula(logits, input_ids, completion_mask)

    return version


def _gathered(logps, input_ids):
    return logps.gather(-1, input_ids[..., None]).squeeze(-1)


def _shifted(logits, input_ids):
    return _gathered(logits[:, :-1].log_softmax(-1), input_ids[:, 1:])


def _einsum(logits, input_ids, completion_mask):
    hot = functional.one_hot(input_ids[:, 1:], logits.shape[-1]).to(logits.dtype)
    return torch.einsum("blv,blv,bl->b", logits[:, :-1].log_softmax(-1), hot, completion_mask[:, 1:].to(logits.dtype))


def _cross_entropy(logits, input_ids, completion_mask):
    targets = input_ids[:, 1:].masked_fill(~completion_mask[:, 1:], -100)
    losses = functional.cross_entropy(logits[:, :-1].transpose(1, 2), targets, reduction="none", ignore_index=-100)
    return -losses.sum(1)


def _clone_of_targets(logits, input_ids, completion_mask):
    labels = input_ids[:, 1:].clone()
    mask = completion_mask[:, 1:]
    labels[~mask] = 0
    return (_gathered(logits[:, :-1] - logits[:, :-1].logsumexp(-1, keepdim=True), labels) * mask).sum(-1)


SEQUENCE_LOGPS = Exercise(
    name="sequence_logps",
    reference=ch97.sequence_logps,
    criteria={"values": 1.25, "gradient": 0.25, "dtype": 0.15, "inputs": 0.1, "errors": 0.25},
    axes=("text",),
    cases=drawn_once(
        Case("prompts, completions, padding", _texts, closed_form=_by_token, visible=True, draws=3),
        Case("one token kept in each row", _one_token_each, closed_form=_by_token, visible=True),
        Case("all tokens equally likely: -log V for each", _even_odds, closed_form=_log_of_even_odds, visible=True),
        Case("a mask that includes column 0", _whole_rows, closed_form=_by_token, visible=True),
        Case("a row with nothing kept: 0", _nothing_kept, closed_form=_by_token),
        Case("tokens that the model finds impossible", _unlikely, closed_form=_by_token),
        Case("one long text", lambda g: _texts(g, 1, 40, 11), closed_form=_by_token),
        Case("texts of two tokens", _two_tokens, closed_form=_by_token),
        Case("logits that require gradient", _texts, differentiate=["logits"], visible=True),
        Case("gradient where what is not kept has logits of ±10,000", _loud, differentiate=["logits"]),
        Case("single precision", _texts, dtype=torch.float32, visible=True),
        *shape_cases(_texts, _TEXTS),
        Case(
            "completion_mask already shifted",
            reshaped(_texts, "completion_mask", lambda mask: mask[:, 1:]),
            raises=_TEXTS,
            visible=True,
            draws=1,
        ),
    ),
    misconceptions=(
        Misconception(
            "not-shifted",
            _sequence(lambda x, i, m: (_gathered(x.log_softmax(-1), i) * m).sum(1)),
            "The logits at position t predict the token at t + 1: drop the last logits and the first token before gathering.",
        ),
        Misconception(
            "mask-not-shifted",
            _sequence(lambda x, i, m: (_shifted(x, i) * m[:, :-1]).sum(1)),
            "Tokens and logits are shifted, the mask is not: it is aligned with input_ids, so the tokens input_ids[:, 1:] go with"
            " completion_mask[:, 1:].",
        ),
        Misconception(
            "shifted-the-wrong-way",
            _sequence(lambda x, i, m: (_gathered(x[:, 1:].log_softmax(-1), i[:, :-1]) * m[:, :-1]).sum(1)),
            "Each token is looked up in logits that come after it, which have seen it: logits[:, :-1] go with input_ids[:, 1:].",
        ),
        Misconception(
            "first-token-counted",
            _sequence(lambda x, i, m: (_gathered(x.roll(1, 1).log_softmax(-1), i) * m).sum(1)),
            "Nothing predicts the first token, but here the last position's logits wrap around to it: slice instead of rolling.",
        ),
        Misconception(
            "mask-ignored",
            _sequence(lambda x, i, m: _shifted(x, i).sum(1)),
            "Prompt and padding are summed too: only the completion's tokens are the policy's choice.",
        ),
        Misconception(
            "mask-inverted",
            _sequence(lambda x, i, m: (_shifted(x, i) * ~m[:, 1:]).sum(1)),
            "The mask is True at what counts: here everything else is summed.",
        ),
        Misconception(
            "mean-instead-of-sum",
            _sequence(lambda x, i, m: (_shifted(x, i) * m[:, 1:]).sum(1) / m[:, 1:].sum(1).clamp(min=1)),
            "The probability of a text is the product over its tokens, so log-probabilities are summed. The mean is another"
            " quantity, which forgets the length.",
        ),
        Misconception(
            "logits-not-normalised",
            _sequence(lambda x, i, m: (_gathered(x[:, :-1], i[:, 1:]) * m[:, 1:]).sum(1)),
            "Logits are log-probabilities only up to a constant for each position: take log_softmax over the vocabulary.",
        ),
        Misconception(
            "normalised-over-positions",
            _sequence(lambda x, i, m: (_gathered(x[:, :-1].log_softmax(1), i[:, 1:]) * m[:, 1:]).sum(1)),
            "softmax is taken over positions: the probabilities of one position's tokens sum to 1, so use dim=-1.",
        ),
        Misconception(
            "probabilities-summed",
            _sequence(lambda x, i, m: (_shifted(x, i).exp() * m[:, 1:]).sum(1)),
            "These are probabilities: take their logarithm before summing.",
        ),
        Misconception(
            "logarithm-of-softmax",
            _sequence(lambda x, i, m: torch.where(m[:, 1:], _gathered(x[:, :-1].softmax(-1), i[:, 1:]).log(), 0).sum(1)),
            "The softmax of an unlikely token underflows to 0, whose logarithm is -inf: use log_softmax.",
        ),
        cut_from_graph(ch97.sequence_logps),
        dtype_lost(ch97.sequence_logps),
        in_place(ch97.sequence_logps, "logits"),
        Misconception("bad-input-accepted", _sequence(lambda x, i, m: _unchecked_sequence(x, i, m), checked=False), SHAPES),
    ),
    variants={
        "token by token": _sequence(_by_token),
        "one-hot and einsum": _sequence(_einsum),
        "cross-entropy with ignored targets": _sequence(_cross_entropy),
        "logsumexp, in double precision": _sequence(lambda x, i, m: _clone_of_targets(x.double(), i, m).to(x.dtype)),
        "mask product": _sequence(lambda x, i, m: torch.mul(_shifted(x, i), m[:, 1:]).sum(dim=-1)),
    },
)


def _unchecked_sequence(logits, input_ids, completion_mask):
    """What broadcasting and short batches make of it: a result in every case."""
    rows = min(len(logits), len(input_ids), len(completion_mask))
    mask = completion_mask[:rows] if len(completion_mask) > 1 else completion_mask
    kept = mask[:, 1 - logits.shape[1] :]
    return (_shifted(logits[:rows], input_ids[:rows]) * kept).sum(1)


# -------------------------------------------------------------------------------------------------------------- dpo_loss


def _pairs(batch=9, spread=4.0, **scalars):
    """Log-probabilities of completions of some 20 tokens, policy and reference a few nats apart."""

    def inputs(generator):
        ref_chosen, ref_rejected = -40 + 10 * normal(generator, batch), -40 + 10 * normal(generator, batch)
        return {
            "chosen_logps": ref_chosen + spread * normal(generator, batch),
            "rejected_logps": ref_rejected + spread * normal(generator, batch),
            "ref_chosen_logps": ref_chosen,
            "ref_rejected_logps": ref_rejected,
        } | scalars

    return inputs


def _agreeing(**scalars):
    """A policy that is still the reference, as DPO starts: all gaps are exactly 0."""

    def inputs(generator):
        drawn = _pairs(**scalars)(generator)
        return drawn | {name.removeprefix("ref_"): drawn[name].clone() for name in LOGPS[2:]}

    return inputs


def _far_apart(**scalars):
    """Gaps between the log-ratios of ±10,000 nats."""

    def inputs(generator):
        drawn = _pairs(4, **scalars)(generator)
        far = torch.tensor([5000.0, -5000.0, 5000.0, -5000.0], dtype=torch.float64)
        return drawn | {
            "chosen_logps": drawn["ref_chosen_logps"] + far - 5100,
            "rejected_logps": drawn["ref_rejected_logps"] - far - 5100,
        }

    return inputs


def _numpy(*tensors):
    return [tensor.detach().numpy().astype(np.float64) for tensor in tensors]


def _dpo_by_formula(chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps, beta=0.1, label_smoothing=0.0):
    """log(1 + e^x) for both labels, weighted, in NumPy."""
    chosen, rejected, ref_chosen, ref_rejected = _numpy(chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps)
    rewards = beta * (chosen - ref_chosen), beta * (rejected - ref_rejected)
    x = rewards[0] - rewards[1]
    losses = (1 - label_smoothing) * np.logaddexp(0, -x) + label_smoothing * np.logaddexp(0, x)
    return tuple(torch.from_numpy(result).to(chosen_logps.dtype) for result in (losses, *rewards))


def _log_two(chosen_logps, **_rest):
    return torch.full_like(chosen_logps, math.log(2)), torch.zeros_like(chosen_logps), torch.zeros_like(chosen_logps)


def _checked(beta, label_smoothing=0.0, **logps):
    """Another style of validation than the reference's."""
    shapes = {name: tuple(value.shape) for name, value in logps.items()}
    if len(set(shapes.values())) != 1:
        raise ValueError(f"all log-probabilities need one shape, got {shapes}")
    if beta <= 0:
        raise ValueError(f"expected beta > 0, but received {beta!r}")
    if label_smoothing < 0 or label_smoothing >= 0.5:
        raise ValueError(f"expected 0 <= label_smoothing < 0.5, but received {label_smoothing!r}")


def _gap(c, r, ref_c, ref_r):
    return (c - ref_c) - (r - ref_r)


def _smoothed(x, s):
    return (1 - s) * functional.softplus(-x) + s * functional.softplus(x)


def _reward(logps, ref_logps, beta):
    return beta * (logps - ref_logps)


def _dpo(gap=_gap, loss=lambda gap, beta, s: _smoothed(beta * gap, s), reward=_reward, leak=False, graph=False, checked=True):
    """A version of the loss: `gap` of the log-ratios, `loss` of a gap, `reward` of a completion; `leak` leaves the reference in the
    graph, `graph` the rewards."""

    def version(chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps, beta=0.1, label_smoothing=0.0):
        logps = chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps
        if checked:
            _checked(beta, label_smoothing, **dict(zip(LOGPS, logps, strict=True)))
        c, r, ref_c, ref_r = logps if leak else (*logps[:2], *(ref.detach() for ref in logps[2:]))
        rewards = reward(c, ref_c.detach(), beta), reward(r, ref_r.detach(), beta)
        return loss(gap(c, r, ref_c, ref_r), beta, label_smoothing), *(value if graph else value.detach() for value in rewards)

    return version


def _losses_only(change):
    def version(*args, **kwargs):
        losses, *rewards = ch97.dpo_loss(*args, **kwargs)
        return change(losses), *rewards

    return version


def _hand_softplus(x):
    """log(1 + e^x), right in value, but with no gradient at 0, where relu and abs have none."""
    return functional.relu(x) + torch.log1p(torch.exp(-x.abs()))


def _dpo_variant(losses):
    """`losses` takes beta × gap and the smoothing; the rest is as it should be."""
    return _dpo(loss=lambda gap, beta, s: losses(beta * gap, s))


def _dpo_by_pairs(chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps, beta=0.1, label_smoothing=0.0):
    _checked(
        beta,
        label_smoothing,
        **dict(zip(LOGPS, (chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps), strict=True)),
    )
    losses, rewards = [], []
    for c, r, ref_c, ref_r in zip(
        chosen_logps.unbind(), rejected_logps.unbind(), ref_chosen_logps.tolist(), ref_rejected_logps.tolist(), strict=True
    ):
        odds = torch.stack([beta * (c - ref_c), beta * (r - ref_r)])
        likelihoods = odds.log_softmax(0)
        losses.append(-(1 - label_smoothing) * likelihoods[0] - label_smoothing * likelihoods[1])
        rewards.append(odds.detach())
    return torch.stack(losses), *torch.stack(rewards).unbind(1)


def _dpo_grouped(chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps, beta=0.1, label_smoothing=0.0):
    """Policy's log-ratio minus the reference's, as the original implementation has it."""
    validate.same_shape(
        chosen_logps=chosen_logps,
        rejected_logps=rejected_logps,
        ref_chosen_logps=ref_chosen_logps,
        ref_rejected_logps=ref_rejected_logps,
    )
    _checked(beta, label_smoothing, chosen_logps=chosen_logps)
    with torch.no_grad():
        ref_logratios = ref_chosen_logps - ref_rejected_logps
        rewards = beta * (chosen_logps - ref_chosen_logps), beta * (rejected_logps - ref_rejected_logps)
    x = beta * (chosen_logps - rejected_logps - ref_logratios)
    return -functional.logsigmoid(x) * (1 - label_smoothing) - functional.logsigmoid(-x) * label_smoothing, *rewards


_REFERENCE = "The reference is frozen: its log-probabilities are data, so detach them (or compute them under torch.no_grad())."
_DPO_SHAPES = _pairs(beta=0.5)

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
        *shape_cases(_DPO_SHAPES, LOGPS),
        Case(
            "ref_chosen_logps as a column", reshaped(_DPO_SHAPES, "ref_chosen_logps", lambda x: x[:, None]), raises=LOGPS, draws=1
        ),
        refused(_DPO_SHAPES, beta=0.0, visible=True),
        refused(_DPO_SHAPES, beta=-0.1),
        refused(_DPO_SHAPES, label_smoothing=0.5),
        refused(_DPO_SHAPES, label_smoothing=-0.1, visible=True),
    ),
    misconceptions=(
        Misconception(
            "chosen-and-rejected-swapped",
            _dpo(gap=lambda c, r, ref_c, ref_r: _gap(r, c, ref_r, ref_c)),
            "The loss falls as the rejected completion gets likelier: x is the chosen log-ratio minus the rejected one, and with"
            " label_smoothing the larger weight, 1 - s, goes with the label as given.",
        ),
        Misconception(
            "sign-missing",
            _losses_only(torch.neg),
            "log σ is to be maximised, a loss minimised: negate it.",
        ),
        Misconception(
            "reference-ignored",
            _dpo(gap=lambda c, r, ref_c, ref_r: c - r),
            "Without the reference nothing holds the policy near it, and pairs whose chosen text was likelier from the start are"
            " learnt for nothing: compare log-ratios, log π - log π_ref.",
        ),
        Misconception(
            "reference-added",
            _dpo(gap=lambda c, r, ref_c, ref_r: (c + ref_c) - (r + ref_r)),
            "The reference has the wrong sign: a log-ratio is log π - log π_ref of one completion, so chosen goes with ref_chosen.",
        ),
        Misconception(
            "beta-divides",
            _dpo(loss=lambda gap, beta, s: _smoothed(gap / beta, s)),
            "beta multiplies the gap. The larger beta, the sooner a given log-ratio satisfies the loss, and the closer the policy stays.",
        ),
        Misconception(
            "beta-missing",
            _dpo(loss=lambda gap, beta, s: _smoothed(gap, s)),
            "beta is not used in the losses: x = beta * (chosen log-ratio - rejected log-ratio).",
        ),
        Misconception(
            "beta-nowhere",
            _dpo(loss=lambda gap, beta, s: _smoothed(gap, s), reward=lambda a, b, beta: a - b),
            "beta is not used at all: it multiplies the gap in the losses, and the log-ratios in the rewards.",
        ),
        Misconception(
            "beta-outside",
            _dpo(loss=lambda gap, beta, s: beta * _smoothed(gap, s)),
            "beta scales the loss, which only rescales the learning rate: it belongs inside the sigmoid.",
        ),
        Misconception(
            "beta-fixed",
            _dpo(loss=lambda gap, beta, s: _smoothed(0.1 * gap, s), reward=lambda a, b, beta: 0.1 * (a - b)),
            "beta is 0.1 whatever the caller says: use the argument.",
        ),
        Misconception(
            "sigmoid-without-logarithm",
            _dpo(loss=lambda gap, beta, s: (1 - s) * torch.sigmoid(-beta * gap) + s * torch.sigmoid(beta * gap)),
            "This is the probability of the wrong label, whose gradient vanishes where the policy is most wrong: take -log σ.",
        ),
        Misconception(
            "logarithm-of-sigmoid",
            _dpo(loss=lambda gap, beta, s: -(1 - s) * torch.sigmoid(beta * gap).log() - s * torch.sigmoid(-beta * gap).log()),
            "σ(x) underflows to 0 at large gaps and its logarithm is -inf: use torch.nn.functional.logsigmoid.",
        ),
        Misconception(
            "logarithm-clamped",
            _dpo(loss=lambda gap, beta, s: _smoothed((beta * gap).clamp(-20, 20), s)),
            "Clamping keeps the loss finite, and leaves the pairs that are most wrong without gradient: use logsigmoid, which is"
            " finite by itself.",
        ),
        Misconception(
            "no-gradient-at-zero",
            _dpo(loss=lambda gap, beta, s: (1 - s) * _hand_softplus(-beta * gap) + s * _hand_softplus(beta * gap)),
            "The values are right, but relu and abs have gradient 0 at 0, and DPO starts exactly there, with the policy equal to the"
            " reference: it never leaves. Use logsigmoid.",
        ),
        Misconception(
            "hinge",
            _dpo(loss=lambda gap, beta, s: functional.relu(1 - beta * gap)),
            "This is a hinge loss: the Bradley-Terry model's likelihood is the sigmoid of the gap.",
        ),
        Misconception(
            "smoothing-ignored",
            _dpo(loss=lambda gap, beta, s: _smoothed(beta * gap, 0)),
            "label_smoothing is not used: with weight s the label is taken to be the other way round.",
        ),
        Misconception(
            "smoothing-subtracted",
            _dpo(loss=lambda gap, beta, s: (1 - s) * functional.softplus(-beta * gap) - s * functional.softplus(beta * gap)),
            "Both terms are negative log-likelihoods and are added: -(1 - s) log σ(x) - s log σ(-x).",
        ),
        Misconception(
            "averaged",
            _losses_only(lambda losses: losses.mean().expand_as(losses)),
            "One loss for each pair is asked for; whoever calls the function averages.",
        ),
        Misconception(
            "rewards-without-beta",
            _dpo(reward=lambda a, b, beta: a - b),
            "The implicit reward is beta * (log π - log π_ref), in the reward's own units: beta is missing.",
        ),
        Misconception(
            "rewards-without-reference",
            _dpo(reward=lambda a, b, beta: beta * a),
            "The implicit reward compares with the reference: beta * (log π - log π_ref).",
        ),
        Misconception("gradient-into-reference", _dpo(leak=True), _REFERENCE),
        Misconception(
            "rewards-keep-their-graph",
            _dpo(graph=True),
            "The rewards are reported, not learnt from: detach them.",
        ),
        Misconception(
            "policy-detached",
            _losses_only(torch.Tensor.detach),
            "The losses reach no parameter: detach the reference's log-probabilities, not the policy's.",
        ),
        Misconception(
            "rejected-detached",
            _dpo(gap=lambda c, r, ref_c, ref_r: _gap(c, r.detach(), ref_c, ref_r)),
            "The rejected completion is learnt from as well: only the reference is data.",
        ),
        Misconception(
            "dtype-lost",
            after(ch97.dpo_loss, lambda result: tuple(value.float() for value in result)),
            "The results have lost the inputs' dtype.",
        ),
        in_place(ch97.dpo_loss, "chosen_logps"),
        Misconception("bad-input-accepted", _dpo(checked=False), SHAPES),
    ),
    variants={
        "policy's ratio minus reference's ratio": _dpo_grouped,
        "softplus": _dpo_variant(_smoothed),
        "log-sum-exp": _dpo_variant(lambda x, s: torch.logaddexp(torch.zeros_like(x), -x) + s * x),
        "pair by pair, as a softmax of two": _dpo_by_pairs,
        "cross-entropy with soft labels": _dpo_variant(
            lambda x, s: functional.binary_cross_entropy_with_logits(x, torch.full_like(x, 1 - s), reduction="none")
        ),
        "in double precision": after(
            lambda chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps, **settings: (
                *ch97.dpo_loss(
                    chosen_logps.to(torch.float64),
                    rejected_logps.to(torch.float64),
                    ref_chosen_logps.to(torch.float64),
                    ref_rejected_logps.to(torch.float64),
                    **settings,
                ),
                chosen_logps.dtype,
            ),
            lambda result: tuple(value.to(result[-1]) for value in result[:-1]),
        ),
    },
)

# -------------------------------------------------------------------------------------------------------------- ipo_loss


def _on_target(generator):
    """Margins that have reached 1 / (2 beta) exactly: nothing is left to lose."""
    drawn = _agreeing(beta=0.25)(generator)
    return drawn | {"chosen_logps": drawn["chosen_logps"] + 1.5, "rejected_logps": drawn["rejected_logps"] - 0.5}


def _ipo_by_formula(chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps, beta=0.1):
    """Squared distance, multiplied out."""
    chosen, rejected, ref_chosen, ref_rejected = _numpy(chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps)
    margin = chosen - rejected - ref_chosen + ref_rejected
    return torch.from_numpy(margin**2 - margin / beta + 0.25 / beta**2).to(chosen_logps.dtype)


def _ipo(loss, gap=_gap, leak=False, checked=True):
    """A version: `loss` takes gap and beta."""

    def version(chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps, beta=0.1):
        logps = chosen_logps, rejected_logps, ref_chosen_logps, ref_rejected_logps
        if checked:
            _checked(beta, **dict(zip(LOGPS, logps, strict=True)))
        c, r, ref_c, ref_r = logps if leak else (*logps[:2], *(ref.detach() for ref in logps[2:]))
        return loss(gap(c, r, ref_c, ref_r), beta)

    return version


def _square(gap, beta):
    return (gap - 1 / (2 * beta)) ** 2


def _ipo_by_pairs(gap, beta):
    return torch.stack([(x - 0.5 / beta) * (x - 0.5 / beta) for x in gap])


IPO_LOSS = Exercise(
    name="ipo_loss",
    reference=ch97.ipo_loss,
    criteria={"values": 1.0, "gradient": 0.3, "dtype": 0.1, "inputs": 0.1, "errors": 0.25},
    axes=("pair",),
    cases=drawn_once(
        Case("nine pairs, default beta", _pairs(), closed_form=_ipo_by_formula, visible=True, draws=3),
        Case("beta = 0.5", _pairs(beta=0.5), closed_form=_ipo_by_formula, visible=True),
        Case("beta = 2", _pairs(beta=2), closed_form=_ipo_by_formula),
        Case(
            "margins on target: 0",
            _on_target,
            closed_form=lambda chosen_logps, **_r: torch.zeros_like(chosen_logps),
            visible=True,
        ),
        Case(
            "policy and reference agree: 1 / (4 beta²)",
            _agreeing(beta=0.25),
            closed_form=lambda chosen_logps, **_r: torch.full_like(chosen_logps, 4.0),
        ),
        Case("a single pair", _pairs(1), closed_form=_ipo_by_formula),
        Case("all inputs require gradient", _pairs(beta=0.3), differentiate=LOGPS, visible=True, draws=3),
        Case("single precision", _pairs(beta=0.5), dtype=torch.float32, visible=True),
        *shape_cases(_DPO_SHAPES, LOGPS),
        refused(_DPO_SHAPES, beta=0.0, visible=True),
        refused(_DPO_SHAPES, beta=-0.1),
    ),
    misconceptions=(
        Misconception(
            "target-without-the-half",
            _ipo(lambda gap, beta: (gap - 1 / beta) ** 2),
            "The target is 1 / (2 beta), half of this.",
        ),
        Misconception(
            "target-proportional-to-beta",
            _ipo(lambda gap, beta: (gap - beta / 2) ** 2),
            "The target is 1 / (2 beta): a larger beta asks for a smaller margin.",
        ),
        Misconception(
            "target-of-a-half",
            _ipo(lambda gap, beta: (gap - 0.5) ** 2),
            "The target does not depend on beta here: it is 1 / (2 beta).",
        ),
        Misconception(
            "no-target",
            _ipo(lambda gap, beta: gap**2),
            "This pulls the margin to 0, back to the reference: its target is 1 / (2 beta).",
        ),
        Misconception(
            "gap-scaled-by-beta",
            _ipo(lambda gap, beta: (beta * gap - 0.5) ** 2),
            "This is beta² times the loss: the gap is not scaled in IPO, so that steps do not shrink with beta.",
        ),
        Misconception("absolute-value", _ipo(lambda gap, beta: (gap - 1 / (2 * beta)).abs()), "The distance is to be squared."),
        Misconception(
            "logistic-loss",
            _ipo(lambda gap, beta: functional.softplus(-beta * gap)),
            "This is DPO's loss, which is never satisfied; IPO's is a squared distance from a target.",
        ),
        Misconception(
            "chosen-and-rejected-swapped",
            _ipo(_square, gap=lambda c, r, ref_c, ref_r: _gap(r, c, ref_r, ref_c)),
            "The margin is the chosen log-ratio minus the rejected one, and the target, 1 / (2 beta), is subtracted from it: here the"
            " rejected completion is pulled up.",
        ),
        Misconception(
            "reference-ignored",
            _ipo(_square, gap=lambda c, r, ref_c, ref_r: c - r),
            "The margin is between log-ratios, log π - log π_ref: the reference is missing.",
        ),
        Misconception(
            "references-crossed",
            _ipo(_square, gap=lambda c, r, ref_c, ref_r: (c - ref_r) - (r - ref_c)),
            "Each completion is compared with the reference's opinion of the other one.",
        ),
        Misconception(
            "averaged",
            after(ch97.ipo_loss, torch.mean),
            "One loss for each pair is asked for; whoever calls the function averages.",
        ),
        Misconception("gradient-into-reference", _ipo(_square, leak=True), _REFERENCE),
        cut_from_graph(ch97.ipo_loss),
        dtype_lost(ch97.ipo_loss),
        in_place(ch97.ipo_loss, "chosen_logps"),
        Misconception("bad-input-accepted", _ipo(_square, checked=False), SHAPES),
    ),
    variants={
        "pair by pair": _ipo(_ipo_by_pairs),
        "mean squared error": _ipo(
            lambda gap, beta: functional.mse_loss(gap, torch.full_like(gap, 1 / (2 * beta)), reduction="none")
        ),
        "multiplied out": _ipo(lambda gap, beta: gap.square() - gap / beta + 1 / (4 * beta**2)),
        "ratios grouped by model": _ipo(_square, gap=lambda c, r, ref_c, ref_r: (c - r) - (ref_c - ref_r)),
    },
)

# ----------------------------------------------------------------------------------------------------- kl_optimal_policy


def _answers(*shape, scale=1.0, beta=0.5):
    def inputs(generator):
        return {
            "ref_probs": normal(generator, *shape).softmax(-1),
            "rewards": scale * normal(generator, *shape),
            "beta": beta,
        }

    return inputs


def _impossible_answer(generator):
    """The reference never gives the answer with by far the highest reward."""
    drawn = _answers(6, beta=1.0)(generator)
    drawn["ref_probs"][2] = 0
    drawn["ref_probs"] /= drawn["ref_probs"].sum()
    drawn["rewards"][2] = 60.0
    return drawn


def _indifferent(generator):
    drawn = _answers(3, 5)(generator)
    return drawn | {"rewards": torch.full_like(drawn["rewards"], 7.0)}


def _two_answers(generator):
    """Odds of 1 to 1 become odds of e^(Δr / β) to 1."""
    gap = normal(generator, 1)[0]
    return {
        "ref_probs": torch.tensor([0.5, 0.5], dtype=torch.float64),
        "rewards": torch.stack([gap, torch.zeros_like(gap)]),
        "beta": 0.7,
    }


def _two_by_sigmoid(rewards, beta, **_rest):
    return torch.stack([torch.sigmoid(rewards[0] / beta), torch.sigmoid(-rewards[0] / beta)])


def _tilted(ref_probs, rewards, beta):
    """By the formula, with the largest reward among possible answers taken out first."""
    highest = torch.where(ref_probs > 0, rewards, -math.inf).amax(-1, keepdim=True)
    weights = torch.where(ref_probs > 0, ref_probs * ((rewards - highest) / beta).clamp(max=0).exp(), 0)
    return weights / weights.sum(-1, keepdim=True)


def _optimal(formula, checked=True):
    def version(ref_probs, rewards, beta):
        if checked:
            if ref_probs.shape != rewards.shape:
                raise ValueError(f"rewards has shape {tuple(rewards.shape)}, but ref_probs has {tuple(ref_probs.shape)}")
            if not beta > 0:
                raise ValueError(f"expected beta > 0, but received {beta!r}")
        return formula(ref_probs, rewards, beta)

    return version


def _optimal_numpy(p, r, beta):
    p, r = _numpy(p, r)
    with np.errstate(divide="ignore"):
        logits = np.log(p) + r / beta
    weights = np.exp(logits - logits.max(-1, keepdims=True))
    return torch.from_numpy(weights / weights.sum(-1, keepdims=True))


def _optimal_by_rows(p, r, beta):
    rows = [_tilted(a, b, beta) for a, b in zip(p.reshape(-1, p.shape[-1]), r.reshape(-1, r.shape[-1]), strict=True)]
    return torch.stack(rows).reshape(p.shape)


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
        Case("equal rewards change nothing", _indifferent, closed_form=lambda ref_probs, **_rest: ref_probs, visible=True),
        Case("rewards of thousands", _answers(3, 5, scale=3000.0, beta=0.1), closed_form=_tilted, visible=True),
        Case("an answer that the reference never gives", _impossible_answer, closed_form=_tilted),
        Case("beta = 100: hardly any change", _answers(3, 5, beta=100.0), closed_form=_tilted),
        Case("single precision", _answers(4, 6), dtype=torch.float32, visible=True),
        *shape_cases(_answers(4, 6), ("ref_probs", "rewards")),
        refused(_answers(4, 6), beta=0.0, visible=True),
        refused(_answers(4, 6), beta=-1.0),
    ),
    misconceptions=(
        Misconception(
            "reference-ignored",
            _optimal(lambda p, r, beta: (r / beta).softmax(-1)),
            "This is the optimum for a uniform reference: each weight exp(r / beta) is multiplied by π_ref.",
        ),
        Misconception(
            "reference-not-in-logarithms",
            _optimal(lambda p, r, beta: (p + r / beta).softmax(-1)),
            "Inside the softmax stand logarithms: add log π_ref, not π_ref.",
        ),
        Misconception(
            "beta-multiplies",
            _optimal(lambda p, r, beta: (p.log() + r * beta).softmax(-1)),
            "A larger beta keeps the policy closer to the reference: rewards are divided by it.",
        ),
        Misconception("beta-missing", _optimal(lambda p, r, beta: (p.log() + r).softmax(-1)), "beta is not used."),
        Misconception(
            "reference-tempered",
            _optimal(lambda p, r, beta: ((p.log() + r) / beta).softmax(-1)),
            "Only the reward is divided by beta: the reference stands with exponent 1.",
        ),
        Misconception(
            "reward-sign-flipped",
            _optimal(lambda p, r, beta: (p.log() - r / beta).softmax(-1)),
            "High rewards become unlikely: the exponent is +r / beta.",
        ),
        Misconception(
            "not-normalised",
            _optimal(lambda p, r, beta: p * (r / beta).exp()),
            "The weights do not sum to 1: divide by Z, their sum over the last axis.",
        ),
        Misconception(
            "normalised-over-everything",
            _optimal(lambda p, r, beta: (p.log() + r / beta).flatten().softmax(0).reshape(p.shape)),
            "Each prompt has its own Z: sum over the last axis only.",
        ),
        Misconception(
            "overflow",
            _optimal(lambda p, r, beta: p * (r / beta).exp() / (p * (r / beta).exp()).sum(-1, keepdim=True)),
            "exp(r / beta) overflows, and inf / inf is not a number: subtract the largest exponent first, as softmax does.",
        ),
        Misconception(
            "impossible-made-possible",
            _optimal(lambda p, r, beta: ((p + 1e-10).log() + r / beta).softmax(-1)),
            "A small number added to π_ref opens answers that the reference never gives, and a large reward finds them: log 0 = -inf"
            " is what softmax needs.",
        ),
        Misconception(
            "greedy",
            _optimal(lambda p, r, beta: functional.one_hot((p.log() + r / beta).argmax(-1), p.shape[-1]).to(p.dtype)),
            "This is the best single answer: the optimum with a KL penalty keeps every answer's share.",
        ),
        dtype_lost(ch97.kl_optimal_policy),
        in_place(ch97.kl_optimal_policy, "rewards", 1),
        Misconception("bad-input-accepted", _optimal(_tilted, checked=False), SHAPES),
    ),
    variants={
        "weights, largest taken out": _optimal(_tilted),
        "NumPy": _optimal(lambda p, r, beta: _optimal_numpy(p, r, beta).to(p.dtype)),
        "prompt by prompt": _optimal(_optimal_by_rows),
        "logsumexp": _optimal(
            lambda p, r, beta: torch.exp(p.log() + r / beta - torch.logsumexp(p.log() + r / beta, dim=-1, keepdim=True))
        ),
        "relative to the mean, in double precision": _optimal(
            lambda p, r, beta: (
                (p.double().log() + (r.double() - r.double().mean(-1, keepdim=True)) / beta).softmax(-1).to(p.dtype)
            )
        ),
    },
)

# ------------------------------------------------------------------------------------------------ repaired_completion_mask


def _padded(left=(0, 4), right=(0, 4), prompt=(1, 4), completion=(1, 5), batch=5):
    """Texts of unequal length with padding on either side; the ranges are half open."""

    def inputs(generator):
        before, given, written, after_it = (integers(generator, *span, batch) for span in (left, prompt, completion, right))
        columns, stop = torch.arange(int((before + given + written + after_it).max())), before + given + written
        return {
            "attention_mask": (columns >= before[:, None]) & (columns < stop[:, None]),
            "prompt_tokens": given,
        }

    return inputs


def _mask_by_walk(attention_mask, prompt_tokens):
    kept = torch.zeros_like(attention_mask)
    for row, prompt in enumerate(prompt_tokens.tolist()):
        own = attention_mask[row].nonzero().flatten()
        kept[row, own[prompt:]] = True
    return kept


def _repair(formula, checked=True):
    """A version: `formula` takes the mask (B, L), columns (L,) and the prompts' lengths (B, 1)."""

    def version(attention_mask, prompt_tokens):
        if checked and len(attention_mask) != len(prompt_tokens):
            raise ValueError(f"attention_mask has {len(attention_mask)} rows, but prompt_tokens has {len(prompt_tokens)}")
        rows = len(prompt_tokens) if len(prompt_tokens) > 1 else len(attention_mask)
        mask = attention_mask[:rows]
        return formula(mask, torch.arange(mask.shape[1]), prompt_tokens[: len(mask), None])

    return version


def _starts(mask):
    """The column of each row's first own token; (B, 1)."""
    return mask.int().argmax(1, keepdim=True)


def _own(mask, columns, prompts):
    return mask & (columns >= _starts(mask) + prompts)


def _last(mask):
    """True at each row's last own token."""
    return mask & (mask.flip(1).cumsum(1).flip(1) == 1)


REPAIRED_COMPLETION_MASK = Exercise(
    name="repaired_completion_mask",
    reference=ch97.repaired_completion_mask,
    criteria={"values": 1.7, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("text", "column"),
    cases=drawn_once(
        Case("padding on the right", _padded(left=(0, 1)), closed_form=_mask_by_walk, visible=True, draws=3),
        Case(
            "every text begins with one given token", _padded(left=(0, 1), prompt=(1, 2)), closed_form=_mask_by_walk, visible=True
        ),
        Case("padding on the left", _padded(right=(0, 1)), closed_form=_mask_by_walk, visible=True, draws=3),
        Case("padding on both sides", _padded(left=(1, 4), right=(1, 4)), closed_form=_mask_by_walk, draws=3),
        Case("no padding", _padded((0, 1), (0, 1), (2, 3), (4, 5)), closed_form=_mask_by_walk, visible=True),
        Case("completions of one token", _padded(completion=(1, 2)), closed_form=_mask_by_walk),
        Case("no prompt at all", _padded(prompt=(0, 1)), closed_form=_mask_by_walk),
        Case("some prompts without a completion", _padded(completion=(0, 2), right=(1, 4)), closed_form=_mask_by_walk),
        Case("one text", _padded(left=(1, 3), right=(1, 3), batch=1), closed_form=_mask_by_walk),
        *shape_cases(_padded(), ("attention_mask", "prompt_tokens")),
    ),
    misconceptions=(
        Misconception(
            "padding-counted",
            _repair(lambda mask, columns, prompts: columns >= prompts),
            "This is the suspect program's own bug: all columns behind the prompt count, also those behind the text's end, where no"
            " sample ever goes.",
        ),
        Misconception(
            "padding-behind-counted",
            _repair(lambda mask, columns, prompts: columns >= _starts(mask) + prompts),
            "The prompt is found wherever the text begins, but what stands behind the end of the text still counts: that is padding.",
        ),
        Misconception(
            "prompt-counted",
            _repair(lambda mask, columns, prompts: mask & (prompts >= 0)),
            "The prompt's tokens count as well. They were given, not written: leave out the first prompt_tokens[b] own tokens.",
        ),
        Misconception(
            "padding-on-the-left-forgotten",
            _repair(lambda mask, columns, prompts: mask & (columns >= prompts)),
            "With padding on the left the prompt does not begin in column 0: count own tokens, not columns.",
        ),
        Misconception(
            "end-token-dropped",
            _repair(lambda mask, columns, prompts: _own(mask, columns, prompts) & ~_last(mask)),
            "The last own token is the end of the text. To stop there is a choice of the policy's like any other, so it counts.",
        ),
        Misconception(
            "one-token-early",
            _repair(lambda mask, columns, prompts: mask & (columns >= _starts(mask) + prompts - 1)),
            "The mask is aligned with the tokens, and sequence_logps shifts it: it begins at the first written token, not before it.",
        ),
        Misconception(
            "one-token-late",
            _repair(lambda mask, columns, prompts: mask & (columns > _starts(mask) + prompts)),
            "The first written token is missing: the policy chose it, and the prompt's last position predicts it.",
        ),
        Misconception(
            "mask-inverted",
            _repair(lambda mask, columns, prompts: ~_own(mask, columns, prompts)),
            "True marks the tokens that count: this keeps all the others.",
        ),
        Misconception(
            "one-prompt-length-for-all",
            _repair(lambda mask, columns, prompts: _own(mask, columns, prompts.amin(0, keepdim=True))),
            "Each text has a prompt length of its own: here the shortest is used for all.",
        ),
        Misconception(
            "integers",
            after(ch97.repaired_completion_mask, torch.Tensor.long),
            "Masks are bool: `~mask` of an integer is something else, and indexing with it picks rows.",
        ),
        Misconception(
            "input-changed",
            lambda attention_mask, prompt_tokens: (
                ch97.repaired_completion_mask(attention_mask, prompt_tokens),
                attention_mask.logical_not_(),
            )[0],
            "The caller's tensor is changed (by &= or a method that ends in _), and the network is given it afterwards.",
        ),
        Misconception("bad-input-accepted", _repair(_own, checked=False), SHAPES),
    ),
    variants={
        "walk": lambda attention_mask, prompt_tokens: (
            _repair(_own)(attention_mask, prompt_tokens) & _mask_by_walk(attention_mask, prompt_tokens)
        ),
        "columns from the first own token": _repair(_own),
        "positions as the network counts them": _repair(
            lambda mask, columns, prompts: mask & ((mask.cumsum(1) - 1).clamp(min=0) >= prompts)
        ),
        "own tokens from the back": _repair(
            lambda mask, columns, prompts: mask & (mask.flip(1).cumsum(1).flip(1) <= mask.sum(1, keepdim=True) - prompts)
        ),
        "NumPy": _repair(
            lambda mask, columns, prompts: torch.from_numpy(
                np.logical_and(mask.numpy(), np.cumsum(mask.numpy(), axis=1) > prompts.numpy())
            )
        ),
    },
)

EXERCISES = (SEQUENCE_LOGPS, DPO_LOSS, IPO_LOSS, KL_OPTIMAL_POLICY, REPAIRED_COMPLETION_MASK)
