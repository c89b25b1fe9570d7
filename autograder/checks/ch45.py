"""Checks of chapter 45: cases, named misconceptions and correct variants for the parts of a PPO agent."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch.distributions import Independent, Normal

from autograder.authoring.parts import (
    DTYPE,
    after,
    bad_input_accepted,
    cut_from_graph,
    drawing,
    dtype_lost,
    integers,
    misshapen,
    normal,
    one_shape,
    replaced,
    satisfies,
    spoilt,
    versions_of,
    wrong,
)
from autograder.authoring.spec import Artefact, Case, Exercise, Misconception, Tuning
from autograder.checks.ch43 import clip, clip_by_cases, clip_by_excess, clip_by_mask, normalised, off_bounds, plain
from course_lib.checks.cases import built
from course_lib.control import envs as environments
from course_lib.control.policies import Adam, make_policy
from course_lib.control.rollouts import Rollout, true_next_obs
from solutions import ch43, ch45

INF = math.inf
HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


def _case(name, inputs, **options):
    """A case that is either visible or hidden, unless `draws` says otherwise: what it asks for is asked for in others, too."""
    return Case(name, inputs, **({"draws": 0 if options.get("visible") else 1} | options))


def _misshapen(*given, visible=False):
    return misshapen(*given, visible=visible, draws=0 if visible else 1)


# ----------------------------------------------------------------------------------------------------- gaussian_log_prob


@drawing
def _actions(generator, size=7, dims=3, spread=1.0, per_sample=False, base=-0.4):
    """Actions at `spread` standard deviations from the mean or so."""
    mean = normal(generator, size, dims)
    log_std = base + 0.5 * normal(generator, *((size, dims) if per_sample else (dims,)))
    return {"mean": mean, "log_std": log_std, "actions": mean + spread * log_std.exp() * normal(generator, size, dims)}


def _at_the_mean(generator):
    drawn = _actions()(generator)
    return drawn | {"actions": drawn["mean"].clone()}


def _mode_density(mean, log_std, actions):
    return -(log_std.sum() + mean.shape[1] * HALF_LOG_TWO_PI).expand(len(mean))


def _density_by_hand(mean, log_std, actions):
    """One number at a time, by Python's floats."""
    numbers = zip(*(x.flatten().tolist() for x in (mean, log_std.expand_as(mean), actions)), strict=True)
    terms = [-0.5 * ((a - m) / math.exp(s)) ** 2 - s - HALF_LOG_TWO_PI for m, s, a in numbers]
    return torch.tensor(terms, dtype=mean.dtype).view_as(mean).sum(-1)


_PAIR = ("mean", "actions")
_densities = versions_of(
    ch45.gaussian_log_prob, one_shape(*_PAIR), satisfies(lambda log_std, mean: log_std.shape in (mean.shape, mean.shape[1:]))
)


def _density(terms):
    """A version whose `terms` take z = (a - mean) / std and log_std, both (B, A), and give the (B,) sums."""
    return _densities(lambda m, s, a: terms((a - m) / s.exp(), s.expand(a.shape)))


def _each(z, log_std):
    return -0.5 * z**2 - log_std - HALF_LOG_TWO_PI


def _summed(z, log_std):
    return _each(z, log_std).sum(-1)


_WRONG_TERMS = {
    "not-summed": (_each, "One number for each sample, (B,): the dimensions are independent, so their log-densities add up."),
    "averaged-over-dimensions": (
        lambda z, s: _each(z, s).mean(-1),
        "This is the mean over the action's dimensions. A joint density is a product: take the sum of the logarithms.",
    ),
    "summed-over-samples": (
        lambda z, s: _each(z, s).sum(0),
        "Sum over the action's dimensions, the last axis, not over the samples.",
    ),
    "summed-over-everything": (lambda z, s: _each(z, s).sum(), "One number for each sample, (B,): sum over the last axis only."),
    "half-missing": (
        lambda z, s: (-(z**2) - s - HALF_LOG_TWO_PI).sum(-1),
        "The exponent of the normal density is -z² / 2: the half is missing.",
    ),
    "two-pi-missing": (
        lambda z, s: (-0.5 * z**2 - s).sum(-1),
        "The constant ½ log 2π of each dimension is missing. Ratios do not see it; a logged log-probability does.",
    ),
    "two-pi-once": (
        lambda z, s: (-0.5 * z**2 - s).sum(-1) - HALF_LOG_TWO_PI,
        "½ log 2π belongs to every dimension; here it is subtracted once for each sample.",
    ),
    "two-pi-not-halved": (
        lambda z, s: (-0.5 * z**2 - s - 2 * HALF_LOG_TWO_PI).sum(-1),
        "The density has 2π under a square root, so its logarithm has ½ log 2π.",
    ),
    "width-not-normalised": (
        lambda z, s: (-0.5 * z**2 - HALF_LOG_TWO_PI).sum(-1),
        "A wider density is a lower one: -log σ of each dimension is missing, and σ grows without bound.",
    ),
    "width-with-the-wrong-sign": (
        lambda z, s: (-0.5 * z**2 + s - HALF_LOG_TWO_PI).sum(-1),
        "A wider density is a lower one: subtract log σ.",
    ),
    "sign-missing": (
        lambda z, s: -_summed(z, s),
        "This is the negative log-likelihood, which one minimises. A ratio needs the log-probability itself.",
    ),
    "density-instead-of-logarithm": (lambda z, s: _summed(z, s).exp(), "This is the density itself; return its logarithm."),
    "logarithm-of-the-density": (
        lambda z, s: ((-0.5 * z**2).exp() / (s.exp() * math.sqrt(2 * math.pi))).prod(-1).log(),
        "Far from the mean, or in many dimensions, the density is 0 to the computer and its logarithm is -inf: "
        "add logarithms, never form the density.",
    ),
    "log-std-clamped": (
        lambda z, s: _summed(z * (s - s.clamp(-20, 2)).exp(), s.clamp(-20, 2)),
        "log_std is clamped here. Where a policy limits its width is the policy's affair: use log_std as it comes.",
    ),
}

_WRONG_DENSITIES = {
    "log-std-taken-as-std": (
        lambda m, s, a: (-0.5 * ((a - m) / s) ** 2 - s.abs().log() - HALF_LOG_TWO_PI).sum(-1),
        "log_std is the logarithm of the standard deviation: take its exponential before dividing.",
    ),
    "log-std-taken-as-log-variance": (
        lambda m, s, a: _summed((a - m) / (0.5 * s).exp(), 0.5 * s),
        "log_std is log σ, not log σ²: the standard deviation is exp(log_std).",
    ),
    "variance-not-squared": (
        lambda m, s, a: (-0.5 * (a - m) ** 2 / s.exp() - s - HALF_LOG_TWO_PI).sum(-1),
        "The squared distance is divided by the variance σ², here it is divided by σ.",
    ),
    "log-std-detached": (
        lambda m, s, a: _summed((a - m) / s.detach().exp(), s.detach()),
        "No gradient reaches log_std: the policy would never learn how much to explore.",
    ),
    "mean-detached": (
        lambda m, s, a: _summed((a - m.detach()) / s.exp(), s),
        "No gradient reaches the mean: the policy would never learn what to do.",
    ),
}

GAUSSIAN_LOG_PROB = Exercise(
    name="gaussian_log_prob",
    reference=ch45.gaussian_log_prob,
    criteria={"values": 0.65, "gradient": 0.15, "dtype": 0.05, "inputs": 0.05, "errors": 0.1},
    axes=("sample",),
    cases=(
        _case("log_std of shape (A,)", _actions(), closed_form=_density_by_hand, visible=True, draws=1),
        _case("log_std of shape (B, A)", _actions(per_sample=True), closed_form=_density_by_hand, visible=True),
        _case("actions at the mean", _at_the_mean, closed_form=_mode_density, visible=True),
        _case("a single action dimension", _actions(dims=1), closed_form=_density_by_hand, visible=True),
        _case("as many samples as dimensions", _actions(size=4, dims=4), closed_form=_density_by_hand),
        _case("twenty dimensions, far from the mean", _actions(dims=20, spread=12.0), closed_form=_density_by_hand, visible=True),
        _case("a very wide policy", _actions(base=4.0), closed_form=_density_by_hand),
        _case("a very narrow policy", _actions(base=-8.0), closed_form=_density_by_hand),
        _case("mean and log_std require gradient", _actions(), differentiate=("mean", "log_std"), visible=True, draws=1),
        _case("log_std (B, A) requires gradient", _actions(per_sample=True), differentiate=("mean", "log_std")),
        _case("single precision", _actions(), dtype=torch.float32, visible=True),
        _misshapen("actions with a dimension too few", _actions(), "actions", lambda a: a[:, :1], _PAIR, visible=True),
        _misshapen("actions of one sample", _actions(), "actions", lambda a: a[:1], _PAIR),
        _misshapen("log_std for another number of dimensions", _actions(), "log_std", lambda s: s[:1], visible=True),
        _misshapen("log_std as a column, one for each sample", _actions(per_sample=True), "log_std", lambda s: s[:, :1]),
    ),
    misconceptions=(
        *wrong(_WRONG_TERMS, _density),
        *wrong(_WRONG_DENSITIES, _densities),
        *spoilt(ch45.gaussian_log_prob, dtype_lost, changed="actions"),
        bad_input_accepted(_densities(lambda m, s, a: _summed((a - m) / s.exp(), s), checked=False)),
    ),
    variants={
        "torch.distributions": _densities(lambda m, s, a: Independent(Normal(m, s.exp()), 1).log_prob(a)),
        "torch.distributions, summed": _densities(lambda m, s, a: Normal(m, torch.exp(s)).log_prob(a).sum(dim=1)),
        "one dimension after the other": _density(lambda z, s: sum(map(_each, z.unbind(1), s.unbind(1)))),
        "variance and its logarithm": _densities(
            lambda m, s, a: -0.5 * ((a - m).square() / (2 * s).exp() + 2 * s + math.log(2 * math.pi)).sum(-1)
        ),
        "one sample at a time, double precision inside": _density(
            lambda z, s: torch.stack(list(map(_summed, z.double(), s.double()))).to(z.dtype)
        ),
    },
)

# ------------------------------------------------------------------------------------------------------ gaussian_entropy

_CONSTANT = 0.5 + HALF_LOG_TWO_PI


@drawing
def _widths(generator, *shape, base=-0.5):
    return {"log_std": base + 0.7 * normal(generator, *shape)}


def _negated_mean_log_density(log_std):
    """The integral of -p log p by a sum over a fine grid, one dimension at a time."""
    z = torch.linspace(-12, 12, 4001, dtype=torch.float64)
    density = (-0.5 * z**2).exp() / math.sqrt(2 * math.pi)
    standard = -(density * density.clamp_min(1e-300).log()).sum() * (z[1] - z[0])
    return (standard + log_std).sum(-1)


_WRONG_ENTROPIES = {
    "not-summed": (lambda s: s + _CONSTANT, "The entropies of independent dimensions add up: sum over the last axis."),
    "averaged-over-dimensions": (
        lambda s: (s + _CONSTANT).mean(-1),
        "The entropies of independent dimensions add up; this is their mean.",
    ),
    "summed-over-samples": (lambda s: (s + _CONSTANT).sum(), "One entropy for each sample: sum over the last axis only."),
    "averaged-over-samples": (
        lambda s: (s + _CONSTANT).sum(-1).mean(),
        "One entropy for each sample; the loss takes the mean over the batch.",
    ),
    "constant-missing": (
        lambda s: s.sum(-1),
        "Each dimension adds ½ (1 + log 2π) to log σ. Gradients do not see it; a logged entropy does.",
    ),
    "constant-once": (lambda s: s.sum(-1) + _CONSTANT, "The constant ½ (1 + log 2π) belongs to every dimension."),
    "half-of-z-squared-missing": (
        lambda s: (s + HALF_LOG_TWO_PI).sum(-1),
        "This is minus the log-density at the mean. On average z²/2 is ½, which each dimension adds.",
    ),
    "constant-not-halved": (
        lambda s: (s + 2 * _CONSTANT).sum(-1),
        "The constant is ½ (1 + log 2π) = 1.42 for each dimension; the half is missing.",
    ),
    "std-instead-of-its-logarithm": (
        lambda s: (s.exp() + _CONSTANT).sum(-1),
        "The entropy grows with log σ, not with σ. A narrow density has a negative entropy.",
    ),
    "log-std-taken-as-log-variance": (
        lambda s: (0.5 * s + _CONSTANT).sum(-1),
        "log_std is log σ, not log σ²: the entropy has slope 1 in it.",
    ),
    "never-negative": (
        lambda s: (s + _CONSTANT).sum(-1).clamp_min(0),
        "The entropy of a density may be negative: a clamp at 0 takes the gradient away.",
    ),
    "sign-missing": (lambda s: -(s + _CONSTANT).sum(-1), "Entropy is minus the mean log-density: a wider policy has more of it."),
}

GAUSSIAN_ENTROPY = Exercise(
    name="gaussian_entropy",
    reference=ch45.gaussian_entropy,
    criteria={"values": 0.7, "gradient": 0.2, "dtype": 0.05, "inputs": 0.05},
    axes=("sample",),
    cases=(
        _case("(A,)", _widths(3), closed_form=_negated_mean_log_density, visible=True, draws=2),
        _case("(B, A)", _widths(5, 3), closed_form=_negated_mean_log_density, visible=True),
        _case("as many samples as dimensions", _widths(3, 3), closed_form=_negated_mean_log_density),
        _case("one dimension", _widths(1), closed_form=_negated_mean_log_density, visible=True),
        _case("a very narrow policy: negative", _widths(2, base=-6.0), closed_form=_negated_mean_log_density, visible=True),
        _case("a very wide policy", _widths(2, base=5.0), closed_form=_negated_mean_log_density),
        _case("requires gradient", _widths(3), differentiate=("log_std",), visible=True),
        _case("(B, A) requires gradient", _widths(5, 3), differentiate=("log_std",)),
        _case("single precision", _widths(3), dtype=torch.float32, visible=True),
    ),
    misconceptions=(*wrong(_WRONG_ENTROPIES), *spoilt(ch45.gaussian_entropy, cut_from_graph, dtype_lost, changed="log_std")),
    variants={
        "torch.distributions": lambda log_std: Normal(torch.zeros_like(log_std), log_std.exp()).entropy().sum(-1),
        "Independent": lambda log_std: Independent(Normal(torch.zeros_like(log_std), log_std.exp()), 1).entropy(),
        "constant outside the sum": lambda log_std: log_std.sum(dim=-1) + log_std.shape[-1] * 0.5 * (1 + math.log(2 * math.pi)),
        "half of a logarithm": lambda log_std: 0.5 * torch.log(2 * math.pi * math.e * torch.exp(2 * log_std)).sum(-1),
        "one dimension after the other": lambda log_std: sum(
            log_std[..., i] + 0.5 * math.log(2 * math.pi * math.e) for i in range(log_std.shape[-1])
        ),
    },
)

# ----------------------------------------------------------------------------------------------------------- minibatches


@drawing
def _epochs(generator, batch_size, minibatch_size):
    seed = int(integers(generator, 0, 2**31))
    sizes = {"batch_size": batch_size, "minibatch_size": minibatch_size}
    return sizes | {"generator": built("seeding.generator", seed=seed)}


def _epoch_case(name, batch_size, minibatch_size, **options):
    """Two epochs with one generator."""
    return _case(name, _epochs(batch_size, minibatch_size), repeat=2, view="epochs", **options)


_sized = versions_of(
    ch45.minibatches, satisfies(lambda batch_size: batch_size > 0), satisfies(lambda minibatch_size: minibatch_size > 0)
)


def _permutation(size, generator):
    return torch.randperm(size, generator=generator)


def _cut(cut=torch.Tensor.split, order=_permutation):
    """A version: the `order` of all indices, and how it is `cut`."""
    return _sized(lambda size, minibatch_size, generator: cut(order(size, generator), minibatch_size))


def _fisher_yates(size, generator):
    order = list(range(size))
    for last in range(size - 1, 0, -1):
        other = int(torch.randint(last + 1, (), generator=generator))
        order[last], order[other] = order[other], order[last]
    return torch.tensor(order)


def _by_popping(left, minibatch_size):
    while len(left):
        yield left[:minibatch_size].clone()
        left = left[minibatch_size:]


def _by_data_loader(batch_size, minibatch_size, generator):
    sampler = torch.utils.data.RandomSampler(range(batch_size), generator=generator)
    for batch in torch.utils.data.BatchSampler(sampler, minibatch_size, drop_last=False):
        yield torch.tensor(batch)


_WRONG_ORDERS = {
    "never-shuffled": (
        lambda size, generator: torch.arange(size),
        "The indices come in order: neighbours in time fill each batch, and they are alike. Draw a random order.",
    ),
    "drawn-with-replacement": (
        lambda size, generator: torch.randint(size, (size,), generator=generator),
        "Some indices come twice and others never: an epoch is a permutation, such as torch.randperm gives.",
    ),
    "same-order-every-epoch": (
        lambda size, _: torch.randperm(size, generator=torch.Generator().manual_seed(0)),
        "Each epoch has the same order: a generator of your own, seeded anew in each call, repeats itself. Use the one given.",
    ),
    "generator-not-used": (
        lambda size, _: torch.randperm(size),
        "The order is random but not drawn from the given generator, so that nobody can repeat your run: torch.randperm takes generator=….",
    ),
}

_WRONG_CUTS = {
    "last-batch-dropped": (
        lambda order, size: [batch for batch in order.split(size) if len(batch) == size],
        "The short last batch is dropped: these samples are never used in this epoch. Keep it.",
    ),
    "last-batch-filled-up": (
        lambda order, size: torch.cat([order, order[: -len(order) % size]]).split(size),
        "The last batch is filled up with indices that were there before: each index comes exactly once in an epoch.",
    ),
    "equal-parts": (
        lambda order, size: order.tensor_split(-(-len(order) // size)),
        "The batches are of equal size rather than of the size asked for: only the last one may be shorter.",
    ),
    "one-tensor": (
        lambda order, size: order,
        "This is the whole order in one tensor: yield it piece by piece, minibatch_size indices at a time.",
    ),
    "lists-instead-of-tensors": (
        lambda order, size: [batch.tolist() for batch in order.split(size)],
        "Each batch is a list of numbers: yield int64 tensors, which index other tensors without a detour.",
    ),
    "not-int64": (lambda order, size: order.int().split(size), "Index tensors are int64 by contract."),
    "counted-from-one": (lambda order, size: (order + 1).split(size), "Indices run from 0 to batch_size - 1."),
}

_WRONG_MINIBATCHES = {
    "new-order-for-each-batch": (
        lambda count, size, generator: [_permutation(count, generator)[: len(part)] for part in torch.arange(count).split(size)],
        "A fresh permutation for each batch forgets which samples were used: draw one for the whole epoch, and cut it.",
    ),
    "shuffled-within-batches": (
        lambda count, size, generator: [part[_permutation(len(part), generator)] for part in torch.arange(count).split(size)],
        "Each batch holds consecutive samples, only their order within it is random: shuffle first, then cut.",
    ),
    "batches-shuffled": (
        lambda count, size, generator: [torch.arange(count).split(size)[i] for i in _permutation(-(-count // size), generator)],
        "The batches come in random order, but each holds consecutive samples: shuffle first, then cut.",
    ),
}

MINIBATCHES = Exercise(
    name="minibatches",
    reference=ch45.minibatches,
    criteria={"values": 0.9, "errors": 0.1},
    cases=(
        _epoch_case("two epochs of 64 in batches of 16", 64, 16, visible=True, draws=2),
        _epoch_case("a short last batch", 50, 16, visible=True),
        _epoch_case("one sample is left over", 33, 8, visible=True),
        _epoch_case("one batch for all", 40, 40),
        _epoch_case("a batch larger than the data", 40, 64, visible=True),
        _epoch_case("single samples", 30, 1),
        _case("what is drawn from", _epochs(64, 16), returns=("generator",), view="drawn_from", visible=True),
        _case("batch_size = 0", _epochs(0, 16), raises=("batch_size",), visible=True),
        _case("minibatch_size = 0", _epochs(16, 0), raises=("minibatch_size",)),
        _case("minibatch_size = -1", _epochs(16, -1), raises=("minibatch_size",)),
    ),
    misconceptions=(
        *wrong(_WRONG_ORDERS, lambda order: _cut(order=order)),
        *wrong(_WRONG_CUTS, _cut),
        *wrong(_WRONG_MINIBATCHES, _sized),
        bad_input_accepted(
            lambda size, minibatch_size, generator: _permutation(size, generator).split(abs(minibatch_size) or size),
            "Sizes below 1 make no minibatches: raise a ValueError that names the argument and its value.",
        ),
    ),
    variants={
        "Fisher and Yates": _cut(order=_fisher_yates),
        "sorting random numbers": _cut(order=lambda size, generator: torch.rand(size, generator=generator).argsort()),
        "taking from what is left": _cut(_by_popping),
        "torch's samplers": _sized(_by_data_loader),
        "a list of slices": _cut(lambda order, size: [order[start : start + size] for start in range(0, len(order), size)]),
    },
)

# -------------------------------------------------------------------------------------------------------------- ppo_loss


@drawing
def _update(generator, size=33, spread=0.4, base=-2.0, shared_entropy=False, clip_range=0.2, vf_coef=0.5, ent_coef=0.01):
    """A minibatch of a policy that has moved by `spread`, with a critic that is off."""
    log_ratio = off_bounds(spread * normal(generator, size), clip_range)
    old_log_probs = base + normal(generator, size)
    returns = 3 + 2 * normal(generator, size)
    return {
        "log_probs": old_log_probs + log_ratio,
        "old_log_probs": old_log_probs,
        "advantages": normal(generator, size) + 0.3,
        "values": returns + normal(generator, size) - 0.5,
        "returns": returns,
        "entropy": 1.5 + 0.3 * normal(generator, *(() if shared_entropy else (size,))),
        "clip_range": clip_range,
        "vf_coef": vf_coef,
        "ent_coef": ent_coef,
    }


def _before_the_first_step(generator):
    """Ratios of 1 and a perfect critic: what is left can be read off."""
    drawn = _update(shared_entropy=True)(generator)
    return drawn | {"log_probs": drawn["old_log_probs"].clone(), "values": drawn["returns"].clone()}


def _read_off(advantages, entropy, ent_coef, clip_range=0.2, **_rest):
    zero = torch.zeros_like(entropy)
    metrics = {"policy_loss": -advantages.mean(), "value_loss": zero, "entropy": entropy}
    return -advantages.mean() - ent_coef * entropy, metrics | {"approx_kl": zero, "clip_fraction": zero}


def _loss_by_hand(log_probs, old_log_probs, advantages, values, returns, entropy, clip_range, vf_coef, ent_coef):
    """In NumPy; the policy's part without min: a good action's ratio counts up to the upper bound."""
    change, error = (log_probs - old_log_probs).numpy(), (values - returns).numpy()
    metrics = {
        "policy_loss": clip_by_cases(log_probs, old_log_probs, advantages, clip_range),
        "value_loss": np.mean(error**2),
        "entropy": np.mean(entropy.numpy()),
        "approx_kl": np.mean(np.exp(change) - 1 - change),
        "clip_fraction": np.mean(np.abs(np.exp(change) - 1) > clip_range),
    }
    metrics = {name: torch.as_tensor(value) for name, value in metrics.items()}
    return metrics["policy_loss"] + vf_coef * metrics["value_loss"] - ent_coef * metrics["entropy"], metrics


_COLUMNS = ("log_probs", "old_log_probs", "advantages", "values", "returns")
_ALL = (*_COLUMNS, "entropy")
_CHECKS = (
    one_shape(*_COLUMNS),
    satisfies(lambda entropy, log_probs: entropy.ndim == 0 or entropy.shape == log_probs.shape),
    satisfies(lambda clip_range: clip_range >= 0),
)
_DATA = ("old_log_probs", "advantages", "returns")

_losses = versions_of(ch45.ppo_loss, *_CHECKS, data=_DATA)


def _squared(values, returns):
    return (values - returns).square().mean()


def _k3(log_ratio):
    return (log_ratio.expm1() - log_ratio).mean()


def _share_outside(log_ratio, clip_range):
    return (log_ratio.expm1().abs() > clip_range).to(log_ratio.dtype).mean()


def _detached(found, _vf_coef, _ent_coef):
    return {name: value.detach() for name, value in found.items()}


def _parts(
    policy=clip,
    critic=_squared,
    kl=_k3,
    outside=_share_outside,
    weights=lambda vf_coef, ent_coef: (1, vf_coef, -ent_coef),
    total=sum,
    log_ratio=lambda new, old: new - old,
    metrics=_detached,
    leaks=(),
    **options,
):
    """A version of the loss from its parts; `leaks` names the data that is not detached."""

    def loss(log_probs, old_log_probs, advantages, values, returns, entropy, clip_range, vf_coef, ent_coef):
        change = log_ratio(log_probs, old_log_probs)
        losses = policy(change.exp(), advantages, clip_range), critic(values, returns), entropy.mean()
        found = dict(zip(("policy_loss", "value_loss", "entropy"), losses, strict=True))
        found |= {"approx_kl": kl(change.detach()), "clip_fraction": outside(change.detach(), clip_range)}
        weighted = [weight * one for weight, one in zip(weights(vf_coef, ent_coef), losses, strict=True)]
        return total(weighted), metrics(found, vf_coef, ent_coef)

    return versions_of(ch45.ppo_loss, *_CHECKS, data=[name for name in _DATA if name not in leaks])(loss, **options)


def _one_by_one(ratios, advantages, clip_range):
    """A variant: a loop over samples that keeps the graph."""
    losses = []
    for ratio, advantage in zip(ratios, advantages, strict=True):
        bound = 1 + clip_range if advantage > 0 else 1 - clip_range
        free = ratio <= bound if advantage > 0 else ratio >= bound
        losses.append(-(ratio if free else bound + 0 * ratio) * advantage)
    return torch.stack(losses).mean()


@_losses
def _by_torch_functions(log_probs, old_log_probs, advantages, values, returns, entropy, clip_range, vf_coef, ent_coef):
    """A variant in the style of Stable-Baselines3."""
    ratio = torch.exp(log_probs - old_log_probs)
    first, second = advantages * ratio, advantages * torch.clamp(ratio, 1 - clip_range, 1 + clip_range)
    policy_loss = -torch.min(first, second).mean()
    value_loss = torch.nn.functional.mse_loss(values, returns)
    entropy_loss = -torch.mean(entropy)
    with torch.no_grad():
        log_ratio = log_probs - old_log_probs
        metrics = {
            "clip_fraction": torch.mean((torch.abs(ratio - 1) > clip_range).to(ratio.dtype)),
            "approx_kl": torch.mean((torch.exp(log_ratio) - 1) - log_ratio),
            "entropy": -entropy_loss.detach(),
            "value_loss": value_loss.detach(),
            "policy_loss": policy_loss.detach(),
        }
    return policy_loss + ent_coef * entropy_loss + vf_coef * value_loss, metrics


_WRONG_PPO_LOSS = {
    "policy-sign-missing": (
        _parts(policy=lambda *given: -clip(*given)),
        "The policy's objective is to be maximised, a loss minimised: negate it.",
    ),
    "not-clipped": (_parts(policy=plain), "Nothing is clipped: the loss takes the smaller of ρ A and clip(ρ) A."),
    "max-instead-of-min": (
        _parts(policy=lambda r, a, e: -torch.maximum(r * a, r.clamp(1 - e, 1 + e) * a).mean()),
        "Take the smaller of the two products (the larger only once both are negated): max caps just the wrong side.",
    ),
    "only-the-clipped-term": (
        _parts(policy=lambda r, a, e: -(r.clamp(1 - e, 1 + e) * a).mean()),
        "The minimum is missing: clipped on both sides, an action that went the wrong way is never pulled back.",
    ),
    "ratio-inverted": (
        _parts(log_ratio=lambda new, old: old - new),
        "The ratio is old over new: it is exp(log_probs - old_log_probs), new minus old.",
    ),
    "advantages-normalised-inside": (
        _parts(policy=lambda r, a, e: clip(r, normalised(a), e)),
        "The loss takes the advantages as they come: normalising is the caller's choice.",
    ),
    "clip-range-ignored": (
        _parts(policy=lambda r, a, e: clip(r, a, 0.2), outside=lambda d, e: _share_outside(d, 0.2)),
        "The range is 0.2 whatever the caller says: use clip_range.",
    ),
    "value-loss-halved": (
        _parts(critic=lambda v, r: 0.5 * _squared(v, r)),
        "There is no half in this value loss: vf_coef is its only factor.",
    ),
    "value-loss-summed": (
        _parts(critic=lambda v, r: _squared(v, r) * v.numel()),
        "A sum grows with the minibatch: take the mean of the squared errors.",
    ),
    "value-error-not-squared": (
        _parts(critic=lambda v, r: (v - r).abs().mean()),
        "This is the mean absolute error, which fits the median of the returns; the value is their mean: square.",
    ),
    "value-error-capped": (
        _parts(critic=torch.nn.functional.smooth_l1_loss),
        "This is the Huber loss: large errors count less than their square.",
    ),
    "values-detached": (
        _parts(critic=lambda v, r: _squared(v.detach(), r)),
        "No gradient reaches the values: the critic would never learn.",
    ),
    "entropy-sign-wrong": (
        _parts(weights=lambda vf, ent: (1, vf, ent)),
        "Adding the entropy to a loss makes the policy narrow as fast as it can: a bonus is subtracted.",
    ),
    "entropy-left-out": (_parts(weights=lambda vf, ent: (1, vf, 0)), "The entropy bonus is reported but not part of the loss."),
    "coefficients-swapped": (
        _parts(weights=lambda vf, ent: (1, ent, -vf)),
        "vf_coef weighs the value loss and ent_coef the entropy; here it is the other way round.",
    ),
    "value-coefficient-ignored": (
        _parts(weights=lambda vf, ent: (1, 1, -ent)),
        "The value loss counts in full, whatever vf_coef says.",
    ),
    "metrics-weighted": (
        _parts(
            metrics=lambda found, vf, ent: {
                name: value.detach() * {"value_loss": vf, "entropy": ent}.get(name, 1) for name, value in found.items()
            }
        ),
        "value_loss and entropy are reported as they are, without their coefficients: so that runs with different ones compare.",
    ),
    "k1-instead-of-k3": (
        _parts(kl=lambda d: -d.mean()),
        "approx_kl is mean(ρ - 1 - log ρ): the plain mean of -log ρ is as right on average, but noisy, and it can be negative.",
    ),
    "kl-of-swapped-policies": (
        _parts(kl=lambda d: _k3(-d)),
        "approx_kl has the ratio the wrong way round: the actions come from the old policy, so ρ is new over old.",
    ),
    "clip-fraction-on-one-side": (
        _parts(outside=lambda d, e: (d.expm1() > e).to(d.dtype).mean()),
        "clip_fraction counts ratios above 1 + ε only: those below 1 - ε have left the interval as well.",
    ),
    "clip-fraction-of-logarithms": (
        _parts(outside=lambda d, e: (d.abs() > e).to(d.dtype).mean()),
        "clip_fraction compares |log ρ| with ε; it is about |ρ - 1|.",
    ),
    "metrics-carry-a-graph": (
        _parts(metrics=lambda found, vf, ent: found),
        "A reported metric carries no graph: detach it, or every log entry keeps a network's activations alive.",
    ),
    "metrics-as-python-floats": (
        _parts(metrics=lambda found, vf, ent: {name: value.item() for name, value in found.items()}),
        "The metrics are 0-dim tensors: .item() in each minibatch makes a device wait; convert once, when you log.",
    ),
    "gradient-into-old-log-probs": (
        _parts(leaks=("old_log_probs",)),
        "The old log-probabilities are data of the rollout: detach them.",
    ),
    "gradient-into-advantages": (
        _parts(leaks=("advantages",)),
        "The policy's loss must not train the critic: detach the advantages.",
    ),
    "gradient-into-returns": (_parts(leaks=("returns",)), "The target must not run towards the value: detach the returns."),
    "nothing-detached": (
        _parts(leaks=_DATA),
        "Gradient reaches old_log_probs, advantages and returns: all three are data of the rollout, detach them.",
    ),
    "dtype-lost": (
        after(ch45.ppo_loss, lambda found: (found[0].float(), {name: value.float() for name, value in found[1].items()})),
        DTYPE,
    ),
}

PPO_LOSS = Exercise(
    name="ppo_loss",
    reference=ch45.ppo_loss,
    criteria={"values": 1.2, "gradient": 0.5, "dtype": 0.05, "inputs": 0.05, "errors": 0.2},
    cases=(
        _case("a minibatch", _update(), closed_form=_loss_by_hand, visible=True, draws=1),
        _case("one entropy for all", _update(shared_entropy=True), closed_form=_loss_by_hand, visible=True),
        _case("before the first step, perfect critic", _before_the_first_step, closed_form=_read_off, visible=True),
        _case("other coefficients", _update(vf_coef=1.7, ent_coef=0.3), closed_form=_loss_by_hand, visible=True),
        _case("no entropy bonus", _update(ent_coef=0.0), closed_form=_loss_by_hand),
        _case("no value loss", _update(vf_coef=0.0), closed_form=_loss_by_hand),
        _case("clip_range = 0.05", _update(clip_range=0.05), closed_form=_loss_by_hand, visible=True),
        _case("clip_range = 0", _update(clip_range=0.0), closed_form=_loss_by_hand),
        _case("clip_range = 1.5", _update(clip_range=1.5, spread=1.0), closed_form=_loss_by_hand),
        _case("clip_range = infinity", _update(clip_range=INF, spread=1.0), closed_form=_loss_by_hand),
        _case("very unlikely actions", _update(base=-900.0), closed_form=_loss_by_hand, visible=True),
        _case("all inputs require gradient", _update(), differentiate=_ALL, visible=True, draws=1),
        _case("gradient with one entropy for all", _update(shared_entropy=True, vf_coef=1.7, ent_coef=0.3), differentiate=_ALL),
        _case("single precision", _update(), dtype=torch.float32, visible=True),
        _misshapen("entropy of one sample", _update(), "entropy", lambda h: h[:1]),
        _misshapen("values as a column", _update(), "values", lambda v: v[:, None], _COLUMNS, visible=True),
        _misshapen("returns of one sample", _update(), "returns", lambda r: r[:1], _COLUMNS),
        _misshapen("advantages as a column", _update(), "advantages", lambda a: a[:, None], _COLUMNS),
        _misshapen("old_log_probs of one sample", _update(), "old_log_probs", lambda o: o[:1], _COLUMNS),
        _case("clip_range = -0.1", replaced(_update(), clip_range=-0.1), raises=("clip_range",), visible=True),
    ),
    misconceptions=(*wrong(_WRONG_PPO_LOSS), bad_input_accepted(_parts(checked=False))),
    variants={
        "torch's loss functions": _by_torch_functions,
        "one sample at a time": _parts(
            policy=_one_by_one, critic=lambda v, r: sum((x - y) ** 2 for x, y in zip(v, r, strict=True)) / len(v)
        ),
        "mask of the saturated": _parts(policy=clip_by_mask),
        "excess past the bound, dot product": _parts(policy=clip_by_excess, critic=lambda v, r: (v - r) @ (v - r) / len(v)),
        "the sum of one loss for each sample": _parts(total=lambda weighted: torch.stack(weighted).sum()),
    },
)

# ------------------------------------------------------------------------------------------------------- torch_ppo_steps

_NETWORK = ("0", "1", "out")


@drawing
def _agent(generator, size=16, num_steps=1, hidden=5, small=1.0, **settings):
    """Weights in the midst of a training, and a minibatch; float32, as networks are. `small` scales what the gradient is made of."""

    def drawn(*shape):
        return normal(generator, *shape).float().numpy()

    tensors = {}
    for network, outputs in (("actor", 2), ("critic", 1)):
        for layer, shape in zip(_NETWORK, ((3, hidden), (hidden, hidden), (hidden, outputs)), strict=True):
            tensors[f"{network}.{layer}.weight"] = drawn(*shape) / np.float32(math.sqrt(shape[0]))
            tensors[f"{network}.{layer}.bias"] = np.float32(0.3) * drawn(shape[1])
    tensors["log_std"] = np.float32(-0.6) + np.float32(0.3) * drawn(2)
    actions = np.float32(0.7) * drawn(size, 2)
    acted = ch45.gaussian_log_prob(torch.zeros(size, 2), torch.full((2,), -0.5), torch.from_numpy(actions)).numpy()
    batch = {
        "obs": drawn(size, 3),
        "actions": actions,
        "old_log_probs": acted + np.float32(0.2) * drawn(size),
        "advantages": np.float32(small) * (drawn(size) + np.float32(0.3)),
        "returns": 2 + drawn(size),
    }
    chosen = {"learning_rate": 0.01, "max_grad_norm": 0.5, "ent_coef": 0.05} | settings
    return {
        "tensors": tensors,
        "batch": built("control.ppo.Batch", **batch),
        "settings": built("control.ppo.PPOSettings", **chosen),
        "num_steps": num_steps,
    }


def _by_library(tensors, batch, settings, num_steps=1):
    """The course's own policy and Adam, in which no torch.nn and no torch.optim occurs."""
    (obs_dim, hidden), action_dim = tensors["actor.0.weight"].shape, len(tensors["log_std"])
    policy, optimizer, losses = make_policy(obs_dim, action_dim, hidden=hidden), Adam(settings.learning_rate), []
    for name, tensor in policy.tensors().items():
        tensor.copy_(tensors[name])
    for _ in range(num_steps):
        loss, _ = _loss(policy, batch, settings)
        _afresh(policy, loss)
        optimizer.step(policy, settings.max_grad_norm)
        losses.append(loss.detach())
    return torch.stack(losses), {name: tensor.clone() for name, tensor in policy.tensors().items()}


def _of_both(agent, obs, tanh):
    return agent.actor(obs, tanh), agent.critic(obs, tanh)[:, 0]


class _Network(torch.nn.Module):
    """Three layers, from weights as the library keeps them."""

    def __init__(self, tensors, name, turn):
        super().__init__()
        for layer in _NETWORK:
            weight, bias = (tensors[f"{name}.{layer}.{part}"] for part in ("weight", "bias"))
            linear = torch.nn.Linear(*weight.shape)
            with torch.no_grad():
                linear.weight.copy_(turn(weight))
                linear.bias.copy_(bias)
            self.add_module(layer, linear)

    def forward(self, obs, tanh=torch.tanh):
        first, second, last = (getattr(self, layer) for layer in _NETWORK)
        return last(tanh(second(tanh(first(obs)))))


class _Agent(torch.nn.Module):
    def __init__(self, tensors, turn, log_std):
        super().__init__()
        self.actor, self.critic = (_Network(tensors, name, turn) for name in ("actor", "critic"))
        self.log_std = log_std(tensors["log_std"])


def _kept_weights(agent, turn):
    kept = dict(agent.state_dict()) | {"log_std": agent.log_std.detach()}
    return {name: (turn(x) if x.dim() == 2 else x).clone() for name, x in kept.items()}


def _adam(parameters, settings):
    return torch.optim.Adam(parameters, lr=settings.learning_rate, eps=1e-5)


def _zeroed(optimizer, loss):
    optimizer.zero_grad()
    loss.backward()


def _norm_clipped(parameters, most):
    torch.nn.utils.clip_grad_norm_(parameters, most)


def _density_of_row(mean, log_std, actions, old):
    return ch45.gaussian_log_prob(mean, log_std, actions), old


def _by_ppo_loss(agent, out, log_std, batch, settings, density, values):
    log_probs, old = density(out[0], log_std, batch.actions, batch.old_log_probs)
    judged, returns, advantages = values(out[1], batch.returns, batch.advantages)
    entropy = ch45.gaussian_entropy(log_std)
    policy = clip((log_probs - old).exp(), advantages, settings.clip_range)
    return policy + settings.vf_coef * (judged - returns).square().mean() - settings.ent_coef * entropy


def _torch_steps(
    turn=lambda weight: weight.T,
    log_std=lambda given: torch.nn.Parameter(given.clone()),
    scale=lambda log_std: log_std,
    forward=_of_both,
    tanh=torch.tanh,
    density=_density_of_row,
    values=lambda values, returns, advantages: (values, returns, advantages),
    sign=1,
    learned=lambda agent: list(agent.parameters()),
    optimiser=_adam,
    afresh=False,
    differentiate=_zeroed,
    bound=_norm_clipped,
    told=lambda losses: torch.stack(losses).detach(),
    late=0,
    kept=_kept_weights,
    checked=True,
):
    """A version of the program, from the places where it can go wrong."""

    def version(tensors, batch, settings, num_steps=1):
        if checked and num_steps < 1:
            raise ValueError(f"num_steps = {num_steps}")
        agent, losses = _Agent(tensors, turn, log_std), []
        parameters = learned(agent)
        optimizer = optimiser(parameters, settings)
        for _ in range(num_steps + late):
            if afresh:
                optimizer = optimiser(parameters, settings)
            out = forward(agent, batch.obs, tanh)
            loss = _by_ppo_loss(agent, out, scale(agent.log_std), batch, settings, density, values)
            losses.append(loss)
            if len(losses) > num_steps:
                break
            differentiate(optimizer, sign * loss)
            bound(parameters, settings.max_grad_norm)
            optimizer.step()
        return told(losses[late:]), kept(agent, turn)

    return version


def _own_epsilon(parameters, settings):
    return torch.optim.Adam(parameters, settings.learning_rate)


def _onto_what_is_there(optimizer, loss):
    loss.backward()


def _no_bound(parameters, most):
    pass


_FOUR_LINES = "A step is zero_grad(), backward(), clip_grad_norm_(), step(), by torch.optim.Adam(…, eps=1e-5): here "


def _one_trunk(agent, obs, tanh):
    """The critic's last layer on the actor's hidden ones."""
    hidden = tanh(agent.actor.get_submodule("1")(tanh(agent.actor.get_submodule("0")(obs))))
    return agent.actor.out(hidden), agent.critic.out(hidden)[:, 0]


def _clipped_by_value(parameters, most):
    torch.nn.utils.clip_grad_value_(parameters, most)


def _each_clipped(parameters, most):
    for parameter in parameters:
        torch.nn.utils.clip_grad_norm_([parameter], most)


def _averaged_density(mean, log_std, actions, old):
    return ch45.gaussian_log_prob(mean, log_std, actions) / actions.shape[1], old


def _a_ratio_for_each_component(mean, log_std, actions, old):
    z = (actions - mean) / log_std.exp()
    return -0.5 * z**2 - log_std - HALF_LOG_TWO_PI, old[:, None]


def _aliased(given):
    return torch.nn.Parameter(given)


def _by_hand_in_torch(tensors, batch, settings, num_steps=1):
    """A variant: a ParameterDict, products in place of layers, the density and the loss of torch's own, the norm clipped by hand."""
    if num_steps < 1:
        raise ValueError("num_steps is too small")
    agent = torch.nn.ParameterDict({name.replace(".", "_"): tensor.clone() for name, tensor in tensors.items()})
    optimizer, losses = torch.optim.Adam(agent.values(), settings.learning_rate, eps=1e-5), []

    def network(name, x):
        for layer in _NETWORK:
            x = x @ agent[f"{name}_{layer}_weight"] + agent[f"{name}_{layer}_bias"]
            x = x if layer == "out" else torch.tanh(x)
        return x

    for _ in range(num_steps):
        policy = Independent(Normal(network("actor", batch.obs), agent["log_std"].exp()), 1)
        ratio = (policy.log_prob(batch.actions) - batch.old_log_probs).exp()
        bounded = ratio.clamp(1 - settings.clip_range, 1 + settings.clip_range)
        gain = torch.min(ratio * batch.advantages, bounded * batch.advantages).mean()
        error = torch.nn.functional.mse_loss(network("critic", batch.obs).squeeze(-1), batch.returns)
        loss = -gain + settings.vf_coef * error - settings.ent_coef * policy.entropy().mean()
        gradients = torch.autograd.grad(loss, list(agent.values()))
        norm = torch.stack([gradient.square().sum() for gradient in gradients]).sum().sqrt()
        for parameter, gradient in zip(agent.values(), gradients, strict=True):
            parameter.grad = gradient * min(1.0, settings.max_grad_norm / (norm.item() + 1e-6))
        optimizer.step()
        losses.append(loss.item())
    return torch.tensor(losses), {name: agent[name.replace(".", "_")].detach() for name in tensors}


def _two_optimisers(parameters, settings):
    """A variant: Adam treats every number apart, so that two of them do what one does."""

    class Both:
        parts = (_adam(parameters[:7], settings), _adam(parameters[7:], settings))

        def zero_grad(self):
            for part in self.parts:
                part.zero_grad(set_to_none=False)

        def step(self):
            for part in self.parts:
                part.step()

    return Both()


def _onto_zeros(optimizer, loss):
    """A variant: torch.autograd adds to zeros."""
    optimizer.zero_grad(set_to_none=False)
    torch.autograd.backward([loss])


_WRONG_TORCH_STEPS = {
    "gradient-never-cleared": (
        {"differentiate": _onto_what_is_there},
        "The first step is right and the later ones are not: backward() adds to the gradients that are there. optimizer.zero_grad() "
        "before it clears them.",
    ),
    "one-trunk": (
        {"forward": _one_trunk},
        "The critic's last layer reads the actor's hidden layers: the two networks share nothing, and critic.0 and critic.1 are used.",
    ),
    "log-std-not-a-parameter": (
        {"log_std": lambda given: given.clone().requires_grad_()},
        "log_std stays where it began. A tensor with requires_grad is none of the module's parameters, so the optimiser never gets it: "
        "wrap it in torch.nn.Parameter.",
    ),
    "log-std-taken-as-std": (
        {"scale": lambda log_std: log_std.abs().log()},
        "log_std is the logarithm of σ: the density and the entropy take it as it is, or its exponential as σ.",
    ),
    "log-probs-averaged": (
        {"density": _averaged_density},
        "The log-probability of an action is the sum over its components; this is their mean, and no ratio begins near 1.",
    ),
    "log-probs-not-summed": (
        {
            "density": _a_ratio_for_each_component,
            "values": lambda values, returns, advantages: (values, returns, advantages[:, None]),
        },
        "Each component has a ratio of its own: the log-densities are summed over the last axis first, (B, A) to (B,).",
    ),
    "values-as-a-column": (
        {"values": lambda values, returns, advantages: (values[:, None], returns, advantages)},
        "The critic's output is a column (B, 1), which against returns (B,) broadcasts to all pairs: squeeze its last axis.",
    ),
    "maximises": (
        {"sign": -1},
        "The weights go uphill: optimisers minimise, so hand loss.backward() the loss itself. Its minus signs are in ppo_loss.",
    ),
    "gradient-not-clipped": (
        {"bound": _no_bound},
        "The gradient's norm is not bounded, or only once the step is made: torch.nn.utils.clip_grad_norm_ between backward() and step().",
    ),
    "gradient-clipped-by-value": (
        {"bound": _clipped_by_value},
        "Each number of the gradient is cut off by itself, which turns its direction. The norm of the whole is what is bounded: "
        "clip_grad_norm_, not clip_grad_value_.",
    ),
    "gradient-clipped-tensor-by-tensor": (
        {"bound": _each_clipped},
        "Each tensor's gradient has a bound of its own: it is the joint norm over all parameters that is bounded, in one call.",
    ),
    "weights-not-turned": (
        {"turn": lambda weight: weight.reshape(weight.shape[::-1])},
        "torch.nn.Linear computes inputs @ weight.T + bias and keeps its weight as (outputs, inputs): transpose, both ways. A reshape "
        "mixes the numbers, and a square matrix fits without either.",
    ),
    "rectifiers": (
        {"tanh": torch.relu},
        "There are rectifiers between the layers: these networks have tanh, which is where their weights come from.",
    ),
    "tanh-behind-the-last-layer": (
        {"forward": lambda agent, obs, tanh: tuple(map(torch.tanh, _of_both(agent, obs, tanh)))},
        "There is a tanh behind the last layer: no value could leave [-1, 1]. Behind the hidden layers only.",
    ),
    "stochastic-gradient-descent": (
        {"optimiser": lambda parameters, settings: torch.optim.SGD(parameters, settings.learning_rate)},
        "These are steps along the gradient itself. Adam divides by its running size: torch.optim.Adam.",
    ),
    "adams-own-epsilon": (
        {"optimiser": _own_epsilon},
        "Adam's ε is 1e-8 unless you say otherwise: with eps=1e-5, as PPO programs have it, tiny gradients make smaller steps.",
    ),
    "neither-bound-nor-epsilon": (
        {"optimiser": _own_epsilon, "bound": _no_bound},
        _FOUR_LINES + "the gradient's norm is not bounded, and Adam's ε is PyTorch's 1e-8.",
    ),
    "neither-cleared-nor-epsilon": (
        {"optimiser": _own_epsilon, "differentiate": _onto_what_is_there},
        _FOUR_LINES + "gradients add up from step to step, and Adam's ε is PyTorch's 1e-8.",
    ),
    "neither-cleared-nor-bounded": (
        {"bound": _no_bound, "differentiate": _onto_what_is_there},
        _FOUR_LINES + "gradients add up from step to step, and their norm is not bounded.",
    ),
    "backward-and-step-alone": (
        {"optimiser": _own_epsilon, "bound": _no_bound, "differentiate": _onto_what_is_there},
        _FOUR_LINES + "gradients add up, their norm is not bounded, and Adam's ε is PyTorch's 1e-8.",
    ),
    "learning-rate-forgotten": (
        {"optimiser": lambda parameters, settings: torch.optim.Adam(parameters, eps=1e-5)},
        "The learning rate is PyTorch's 0.001: lr=settings.learning_rate.",
    ),
    "optimiser-made-anew": (
        {"afresh": True},
        "The optimiser is made inside the loop: Adam forgets its averages, and every step is as large as the first.",
    ),
    "actor-alone-learns": (
        {"learned": lambda agent: [*agent.actor.parameters(), agent.log_std]},
        "The critic's weights stay where they began: give the optimiser all of the module's parameters.",
    ),
    "losses-after-the-steps": (
        {"late": 1},
        "Each loss is that after its step: the first one belongs to the weights as they came.",
    ),
    "weights-as-linear-keeps-them": (
        {"kept": lambda agent, turn: _kept_weights(agent, lambda weight: weight)},
        "The weights come back as torch.nn.Linear keeps them, (outputs, inputs): turn them round again, `tensors` has (inputs, outputs).",
    ),
    "graph-kept": (
        {"told": torch.stack},
        "The losses carry a graph, and with it the activations of every step: detach what you only report.",
    ),
    "callers-weights-changed": (
        {"log_std": _aliased},
        "torch.nn.Parameter(x) shares x's memory, and the optimiser writes into it: clone what the caller has handed you.",
    ),
}


TORCH_PPO_STEPS = Exercise(
    name="torch_ppo_steps",
    reference=ch45.torch_ppo_steps,
    criteria={"values": 2.3, "gradient": 0.2, "dtype": 0.1, "inputs": 0.3, "errors": 0.1},
    cases=(
        _case(
            "learning rate 0: the loss, and the weights as they came",
            _agent(learning_rate=0.0),
            closed_form=_by_library,
            visible=True,
            draws=1,
        ),
        _case("one step, no bound that matters", _agent(max_grad_norm=1e6), closed_form=_by_library, visible=True),
        _case(
            "a step on advantages near 0", _agent(small=1e-5, vf_coef=0.0, ent_coef=0.0), closed_form=_by_library, visible=True
        ),
        _case("five steps, no bound that matters", _agent(max_grad_norm=1e6, num_steps=5), closed_form=_by_library, visible=True),
        _case("five steps with a bound", _agent(num_steps=5), closed_form=_by_library, visible=True),
        _case("a tight bound on the gradient", _agent(max_grad_norm=1e-4, num_steps=2), closed_form=_by_library),
        _case(
            "other settings",
            _agent(clip_range=0.05, vf_coef=2.0, ent_coef=0.3, learning_rate=0.03, num_steps=3),
            closed_form=_by_library,
        ),
        _case("as many hidden units as observations", _agent(hidden=3, num_steps=2), closed_form=_by_library),
        _case("num_steps = 0", _agent(num_steps=0), raises=("num_steps",), visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_TORCH_STEPS, lambda parts: _torch_steps(**parts)),
        Misconception(
            "weights-as-they-came",
            lambda tensors, *others, **named: (
                ch45.torch_ppo_steps(tensors, *others, **named)[0],
                {name: tensor.clone() for name, tensor in tensors.items()},
            ),
            "The weights that come back are those that went in: read them from the module after the last step.",
        ),
        Misconception(
            "dtype-lost",
            after(ch45.torch_ppo_steps, lambda found: (found[0].double(), {name: x.double() for name, x in found[1].items()})),
            DTYPE,
        ),
        bad_input_accepted(
            _torch_steps(checked=False, told=lambda losses: torch.stack(losses or [torch.zeros(())]).detach()),
            "Without a step there is no loss to report: raise a ValueError that names num_steps and its value.",
        ),
    ),
    variants={
        "two modules in a module": _torch_steps(),
        "a dict of parameters, torch's own density and loss": _by_hand_in_torch,
        "two optimisers": _torch_steps(optimiser=_two_optimisers),
        "gradients set to zero": _torch_steps(differentiate=_onto_zeros),
        "the course's own networks": versions_of(ch45.torch_ppo_steps, satisfies(lambda num_steps: num_steps >= 1))(_by_library),
    },
)

# ------------------------------------------------------------------------------------------------------- collect_rollout


@drawing
def _collecting(generator, maker, num_steps, log_std=0.5, steps=0, action=0.0, **options):
    """A rollout of `num_steps` steps with a wide policy, in environments in which `steps` have been made before."""
    seeds = integers(generator, 0, 2**31, 3).tolist()
    begun = {"seed": seeds[0], "steps": steps, "action": action}
    obs = np.array(environments.begun(getattr(environments, maker)(**options), **begun).observe())
    shape = {"obs_dim": obs.shape[1], "action_dim": 1, "hidden": 4}
    return {
        "envs": built("control.envs.begun", envs=built(f"control.envs.{maker}", **options), **begun),
        "policy": built("control.policies.make_policy", log_std=log_std, seed=seeds[1], **shape),
        "num_steps": num_steps,
        "obs": obs,
        "generator": built("seeding.generator", seed=seeds[2]),
    }


_LENGTHS = {"lengths": (3, 5, 2), "terminates": (True, False, True)}
_PAYING = _LENGTHS | {"action_reward": 0.1}


def _bounded(envs, actions):
    return actions.numpy().clip(envs.single_action_space.low, envs.single_action_space.high)


def _clamped(envs, actions):
    low, high = (torch.from_numpy(bound) for bound in (envs.single_action_space.low, envs.single_action_space.high))
    return torch.clamp(actions, low, high).numpy()


def _single(x):
    return torch.as_tensor(x, dtype=torch.float32).clone()


def _rollout(
    act=lambda policy, obs, generator: policy.act(obs, generator),
    executed=_bounded,
    successors=lambda obs, info, before: true_next_obs(obs, info),
    seen=_single,
    last=lambda obs, row: obs,
    begin=lambda envs, obs: obs,
    extra_steps=0,
    finish=lambda rollout: rollout,
    **changed,
):
    """A version of the program, from the places where it can go wrong; `changed` gives entries of a row of the record anew."""

    def version(envs, policy, num_steps, obs, generator):
        obs, rows = begin(envs, obs), []
        for _ in range(num_steps + extra_steps):
            before = seen(obs)
            actions = act(policy, before, generator)
            sent = executed(envs, actions)
            obs, rewards, terminated, truncated, info = envs.step(sent)
            row = {
                "obs": before,
                "actions": actions,
                "rewards": _single(rewards),
                "next_obs": _single(successors(obs, info, before)),
                "terminated": torch.tensor(terminated),
                "truncated": torch.tensor(truncated),
            }
            known = row | {"executed": torch.as_tensor(sent), "after": _single(obs)}
            rows.append(row | {name: change(known) for name, change in changed.items()})
        columns = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
        return finish(Rollout(**columns, last_obs=_single(last(obs, rows[-1]))))

    return version


def _either_end(row):
    return row["terminated"] | row["truncated"]


def _columnwise(change):
    """A change of all columns of a rollout but last_obs."""
    return lambda rollout: replace(rollout, **{name: change(x) for name, x in vars(rollout).items() if name != "last_obs"})


def _into_memory(envs, policy, num_steps, obs, generator):
    """A variant: tensors made once, filled row by row."""
    shape, obs = (num_steps, envs.num_envs), np.array(obs)
    memory = {name: torch.zeros(*shape, *envs.single_observation_space.shape) for name in ("obs", "next_obs")}
    memory |= {"actions": torch.zeros(*shape, *envs.single_action_space.shape), "rewards": torch.zeros(shape)}
    memory |= {name: torch.zeros(shape, dtype=torch.bool) for name in ("terminated", "truncated")}
    for t in range(num_steps):
        memory["obs"][t] = torch.tensor(obs)
        memory["actions"][t] = policy.act(memory["obs"][t], generator)
        obs, *outcome, info = envs.step(_bounded(envs, memory["actions"][t]))
        memory["next_obs"][t] = torch.from_numpy(true_next_obs(obs, info))
        for name, values in zip(("rewards", "terminated", "truncated"), outcome, strict=True):
            memory[name][t] = torch.as_tensor(values)
    return Rollout(**memory, last_obs=torch.tensor(obs))


def _columns_of_arrays(envs, policy, num_steps, obs, generator):
    """A variant: rows of arrays, made tensors at the end."""
    rows = []
    for _ in range(num_steps):
        before = np.array(obs, np.float32)
        with torch.no_grad():
            actions = policy.act(before, generator).numpy()
        low, high = envs.single_action_space.low, envs.single_action_space.high
        obs, rewards, terminated, truncated, info = envs.step(np.minimum(np.maximum(actions, low), high))
        successors = np.array(obs, np.float32)
        for i in range(len(successors)):
            if terminated[i] or truncated[i]:
                successors[i] = info["final_obs"][i]
        rows.append((before, actions, np.float32(rewards), successors, np.array(terminated), np.array(truncated)))
    columns = [torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True)]
    return Rollout(*[*columns, torch.from_numpy(np.array(obs, np.float32))])


_ENDS = "`terminated` and `truncated` are two facts, and one of them decides about the bootstrap: record both as they come."
_WRONG_ROLLOUTS = {
    "next-obs-after-reset": (
        _rollout(successors=lambda obs, info, before: obs),
        "Where an episode ends, next_obs shows the first observation of the next one: the true last observation is in "
        'info["final_obs"], and course_lib.control.rollouts.true_next_obs puts it in its place.',
    ),
    "next-obs-is-obs": (
        _rollout(successors=lambda obs, info, before: before),
        "next_obs repeats obs: it is what the step has led to.",
    ),
    "obs-after-the-step": (
        _rollout(obs=lambda row: row["after"]),
        "obs shows the state after the action: record what the policy saw when it chose.",
    ),
    "truncated-as-terminated": (_rollout(terminated=_either_end), _ENDS),
    "terminated-as-truncated": (_rollout(truncated=_either_end), _ENDS),
    "ends-swapped": (_rollout(terminated=lambda row: row["truncated"], truncated=lambda row: row["terminated"]), _ENDS),
    "clipped-actions-recorded": (
        _rollout(actions=lambda row: row["executed"]),
        "The actions are recorded as clipped. Their log-probability is then that of another action: record them as sampled.",
    ),
    "rewards-clipped": (
        _rollout(rewards=lambda row: row["rewards"].clamp(-1, 1)),
        "The rewards are clipped to [-1, 1]: the actions are what has bounds. Record rewards as they come.",
    ),
    "mean-action": (
        _rollout(act=lambda policy, obs, generator: policy.best_action(obs)),
        "The actions are the likeliest ones, not samples: without exploration every action is as good as expected.",
    ),
    "own-generator": (
        _rollout(act=lambda policy, obs, _: policy.act(obs, torch.Generator().manual_seed(0))),
        "The actions are drawn from a generator made anew: the same noise at every step. Use the one that is given.",
    ),
    "restarted": (
        _rollout(begin=lambda envs, _obs: envs.reset(seed=0)[0]),
        "The environments are reset at the beginning. A rollout goes on where the last one stopped: start from obs.",
    ),
    "last-obs-before-reset": (
        _rollout(last=lambda obs, row: row["next_obs"]),
        "last_obs is the true successor of the last step; where an episode has just ended the environments show the next one's start.",
    ),
    "one-step-too-many": (_rollout(extra_steps=1), "There is a step too many: a rollout has num_steps rows."),
    "axes-swapped": (
        _rollout(finish=_columnwise(lambda column: column.transpose(0, 1))),
        "Rollouts are time-major: (T, N), not (N, T).",
    ),
    "flattened": (
        _rollout(finish=_columnwise(lambda column: column.flatten(0, 1))),
        "The rows of all environments are in one axis; GAE needs (T, N).",
    ),
    "actions-not-clipped": (
        _rollout(executed=lambda envs, actions: actions.numpy()),
        "The environment gets actions beyond its bounds. Clip what is executed, and record what was sampled.",
    ),
    "bounds-guessed": (
        _rollout(executed=lambda envs, actions: actions.numpy().clip(-1, 1)),
        "-1 and 1 are the bounds of many action spaces, not of all: envs.single_action_space has low and high.",
    ),
}

COLLECT_ROLLOUT = Exercise(
    name="collect_rollout",
    reference=ch45.collect_rollout,
    criteria={"values": 1.9, "inputs": 0.1},
    axes=("t", "env"),
    cases=(
        _case(
            "episodes of 3, 5 and 2 steps",
            _collecting("TimerVectorEnv", 7, log_std=1.0, steps=1, **_PAYING),
            visible=True,
            draws=1,
        ),
        _case("an end at the last step", _collecting("TimerVectorEnv", 6, **_PAYING), visible=True),
        _case("bounds of -0.3 and 0.8", _collecting("TimerVectorEnv", 5, low=-0.3, high=0.8, **_PAYING), visible=True),
        _case("drones with a time limit", _collecting("HoverVectorEnv", 8, num_envs=4, time_limit=5), visible=True),
        _case("drones that fly away", _collecting("HoverVectorEnv", 12, steps=6, action=1.0, num_envs=3)),
    ),
    misconceptions=wrong(_WRONG_ROLLOUTS),
    variants={
        "memory made beforehand": _into_memory,
        "columns of arrays": _columns_of_arrays,
        "successors put in by where": _rollout(
            successors=lambda obs, info, before: np.where(
                np.asarray(info.get("_final_obs", np.zeros(len(obs), bool)))[:, None], info.get("final_obs", obs), obs
            )
        ),
        "clipped by torch": _rollout(executed=_clamped),
        "a dict": _rollout(finish=lambda rollout: Rollout(**{name: column.clone() for name, column in vars(rollout).items()})),
    },
)


# ------------------------------------------------------------------------------------------------------------ ppo_update


@drawing
def _updated(generator, size=16, minibatch_size=64, learning_rate=0.01, **settings):
    """A small policy, and a batch that another has collected. One minibatch for all, so that the order makes no difference."""
    seeds = integers(generator, 0, 2**31, 2).tolist()

    def drawn(*shape):
        return normal(generator, *shape).float().numpy()

    actions = np.float32(0.6) * drawn(size, 2)
    mean, log_std = torch.zeros(size, 2), torch.full((2,), -0.5)
    acted = ch45.gaussian_log_prob(mean, log_std, torch.from_numpy(actions)).numpy()
    batch = {
        "obs": drawn(size, 3),
        "actions": actions,
        "old_log_probs": acted + np.float32(0.25) * drawn(size),
        "advantages": drawn(size) + np.float32(0.3),
        "returns": 2 + drawn(size),
    }
    chosen = {"num_epochs": 2, "minibatch_size": minibatch_size, "max_grad_norm": 0.5} | settings
    return {
        "policy": built("control.policies.make_policy", obs_dim=3, action_dim=2, hidden=4, log_std=-0.5, seed=seeds[0]),
        "optimizer": built("control.policies.Adam", learning_rate=learning_rate),
        "batch": built("control.ppo.Batch", **batch),
        "settings": built("control.ppo.PPOSettings", **chosen),
        "generator": built("seeding.generator", seed=seeds[1]),
    }


@drawing
def _near_the_mean(generator, factor):
    """Learning rate 0, so that the mean KL of an epoch is known beforehand: target_kl is `factor` times that."""
    state = generator.get_state()
    drawn = _updated(12, 6, learning_rate=0.0)(generator)
    batch = {name: torch.as_tensor(column) for name, column in drawn["batch"]["arguments"].items()}
    policy = make_policy(**drawn["policy"]["arguments"])
    log_probs, *_ = ch45.evaluate_actions(policy, batch["obs"], batch["actions"])
    kl = ch43.approx_kl(log_probs, batch["old_log_probs"]).item()
    generator.set_state(state)
    return _updated(12, 6, learning_rate=0.0, target_kl=factor * kl)(generator)


def _minibatches_of(batch, settings, generator):
    return [batch[indices] for indices in ch45.minibatches(len(batch), settings.minibatch_size, generator)]


def _averaged(history):
    return {name: torch.stack([metrics[name] for metrics in history]).mean() for name in history[0]}


def _loss(
    policy,
    rows,
    settings,
    old=lambda rows, _log_probs: rows.old_log_probs,
    weights=lambda rows: rows.advantages,
    coefficients=lambda settings: (settings.clip_range, settings.vf_coef, settings.ent_coef),
):
    log_probs, entropy, values = ch45.evaluate_actions(policy, rows.obs, rows.actions)
    given = (log_probs, old(rows, log_probs), weights(rows), values, rows.returns, entropy)
    return ch45.ppo_loss(*given, *coefficients(settings))


def _afresh(policy, loss):
    policy.weights.grad = None
    loss.backward()


def _by_autograd(policy, loss):
    """A variant: the gradient is asked for, not left behind."""
    (policy.weights.grad,) = torch.autograd.grad(loss, policy.weights)


def _from_zero(policy, loss):
    if policy.weights.grad is not None:
        policy.weights.grad.zero_()
    loss.backward()


def _updating(
    parts=_minibatches_of,
    of_loss=None,
    differentiate=_afresh,
    in_the_midst=False,
    summary=_averaged,
    trained=lambda policy: policy,
    **fixed,
):
    """A version of the program, from the places where it can go wrong; `fixed` are settings of its own, whatever the caller's are."""

    def version(policy, optimizer, batch, settings, generator):
        policy, settings, history = trained(policy), replace(settings, **fixed), []
        for _ in range(settings.num_epochs):
            divergences = []
            for rows in parts(batch, settings, generator):
                loss, metrics = _loss(policy, rows, settings, **(of_loss or {}))
                differentiate(policy, loss)
                optimizer.step(policy, settings.max_grad_norm)
                history.append(metrics)
                divergences.append(metrics["approx_kl"].item())
                if in_the_midst and divergences[-1] > settings.target_kl:
                    return summary(history)
            if sum(divergences) / len(divergences) > settings.target_kl:
                break
        return summary(history)

    return version


def _running_sums(policy, optimizer, batch, settings, generator):
    """A variant: slices of a permutation, sums in place of lists, the gradient set to zero after the step."""
    sums: dict[str, torch.Tensor] = {}
    count, epoch, divergence = 0, 0, 0.0
    while epoch < settings.num_epochs and divergence <= settings.target_kl:
        order, start, divergence = torch.randperm(len(batch.obs), generator=generator), 0, 0.0
        while start < len(order):
            loss, metrics = _loss(policy, batch[order[start : start + settings.minibatch_size]], settings)
            loss.backward()
            optimizer.step(policy, settings.max_grad_norm)
            policy.weights.grad.zero_()
            sums = {name: sums.get(name, 0) + metric for name, metric in metrics.items()}
            divergence += metrics["approx_kl"].item() * settings.minibatch_size / len(order)
            start, count = start + settings.minibatch_size, count + 1
        epoch += 1
    return {name: total / count for name, total in sums.items()}


_AFTERWARDS = ("policy", "optimizer")
_UNUSUAL = {"clip_range": 0.01, "vf_coef": 0.1, "ent_coef": 0.2, "max_grad_norm": 0.1}
_STEPS = {"returns": ("optimizer",), "view": "steps_made"}

_WRONG_PPO_UPDATE = {
    "gradient-never-cleared": (
        _updating(differentiate=lambda policy, loss: loss.backward()),
        "backward() adds to the gradient that is there: set policy.weights.grad to None before it.",
    ),
    "gradient-not-clipped": (
        _updating(max_grad_norm=INF),
        "The gradient's norm is not clipped: hand settings.max_grad_norm to optimizer.step.",
    ),
    "one-epoch-only": (_updating(num_epochs=1), "The batch is used once: settings.num_epochs says how often."),
    "whole-batch-at-once": (
        _updating(parts=lambda batch, settings, generator: [batch]),
        "There is one step in each epoch: make one for each minibatch.",
    ),
    "first-minibatch-only": (
        _updating(parts=lambda *given: _minibatches_of(*given)[:1]),
        "Each epoch ends after its first minibatch: a return or break is one level too deep.",
    ),
    "old-log-probs-recomputed": (
        _updating(of_loss={"old": lambda rows, log_probs: log_probs.detach()}),
        "The old log-probabilities are those of the policy that acted, batch.old_log_probs, in every epoch.",
    ),
    "advantages-normalised-again": (
        _updating(of_loss={"weights": lambda rows: normalised(rows.advantages)}),
        "The advantages are normalised here, although they are to be taken as given: whoever made the batch has decided.",
    ),
    "clip-range-fixed": (_updating(clip_range=0.2), "The clip range is 0.2 whatever the settings say."),
    "coefficients-swapped": (
        _updating(of_loss={"coefficients": lambda given: (given.clip_range, given.ent_coef, given.vf_coef)}),
        "vf_coef and ent_coef are the wrong way round in the call of ppo_loss.",
    ),
    "target-kl-ignored": (
        _updating(target_kl=INF),
        "The update goes on although the KL divergence has passed settings.target_kl: stop after that epoch.",
    ),
    "stops-in-the-midst": (
        _updating(in_the_midst=True),
        "The update stops in the midst of an epoch: a single minibatch's KL is noisy, compare the epoch's mean.",
    ),
    "metrics-of-the-last-minibatch": (
        _updating(summary=lambda history: history[-1]),
        "The metrics are those of the last minibatch: average over all.",
    ),
    "metrics-summed": (
        _updating(summary=lambda history: {name: metric * len(history) for name, metric in _averaged(history).items()}),
        "The metrics are added up: they then depend on the number of minibatches. Average.",
    ),
    "copy-trained": (
        _updating(trained=copy.deepcopy),
        "The policy that was handed in has not changed: a copy was trained. Change policy itself, in place.",
    ),
}

PPO_UPDATE = Exercise(
    name="ppo_update",
    reference=ch45.ppo_update,
    criteria={"values": 1.0},
    cases=(
        _case("the policy after two epochs", _updated(**_UNUSUAL), returns=_AFTERWARDS, visible=True),
        _case("an update that goes too far", _updated(target_kl=1e-4), returns=_AFTERWARDS),
        _case("the metrics", _updated(), visible=True),
        _case("the metrics of two minibatches, learning rate 0", _updated(12, 6, learning_rate=0.0), visible=True),
        _case("steps, where the first epoch goes too far", _updated(12, 6, target_kl=1e-4), **_STEPS, visible=True),
        _case("steps, where nothing does", _updated(10, 4), **_STEPS),
        _case("what is drawn from", _updated(12, 6), returns=("generator",), view="drawn_from"),
        _case("steps, where the mean stays just below target_kl", _near_the_mean(1.02), **_STEPS, draws=4),
        _case("steps, where the mean is just above target_kl", _near_the_mean(0.97), **_STEPS, draws=4),
    ),
    misconceptions=wrong(_WRONG_PPO_UPDATE),
    variants={
        "the gradient on paper": after(
            ch45.fast_ppo_update, lambda metrics: {name: metric.float() for name, metric in metrics.items()}
        ),
        "running sums": _running_sums,
        "torch.autograd.grad": _updating(differentiate=_by_autograd),
        "zeros in place of None": _updating(differentiate=_from_zero),
    },
)

# ----------------------------------------------------------------------------------------------- repaired_rollout (bug lab)


def _shared(obs):
    """The environment's own array, which its next step overwrites."""
    return torch.as_tensor(obs, dtype=torch.float32)


def _shifted(rollout):
    """obs made of the successors of the row before: right, but for the row after an end."""
    return replace(rollout, obs=torch.cat([rollout.obs[:1], rollout.next_obs[:-1]]))


def _rolled_actions(rollout):
    """The suspect's pairs mended from the other side: each observation with the action of the row after it."""
    successors = torch.cat([rollout.obs[1:], rollout.last_obs[None]])
    return replace(rollout, obs=successors, actions=rollout.actions.roll(-1, dims=0))


def _blind(envs, policy, num_steps, obs, generator):
    """The copy is made once, before the loop: the policy never sees anything else."""
    first = torch.as_tensor(obs, dtype=torch.float32).clone()
    return _rollout(act=lambda policy, obs, generator: policy.act(first, generator))(envs, policy, num_steps, obs, generator)


_STILL_WRONG = ("next-obs-after-reset", "truncated-as-terminated", "clipped-actions-recorded", "mean-action", "restarted")
_WRONG_REPAIRS = {name: _WRONG_ROLLOUTS[name] for name in _STILL_WRONG} | {
    "the-suspects-own": (
        _rollout(seen=_shared, obs=lambda row: row["obs"].clone()),
        "This is the suspect's record. Compare obs[t] with next_obs[t], row by row. What does the array in `obs` hold after the step?",
    ),
    "all-rows-alike": (
        _rollout(seen=_shared),
        "All rows of obs are the last one: a list of references to one array. Copy before the next step, not at the end.",
    ),
    "shifted-by-hand": (
        _rollout(finish=_shifted),
        "obs is made of next_obs of the row before. After an end that is the last state of the old episode, not the first of the new.",
    ),
    "actions-shifted-instead": (
        _rollout(finish=_rolled_actions),
        "The actions were moved by a row so that they match the wrong observations: rewards and ends still belong to the rows before.",
    ),
    "copied-once": (
        _blind,
        "The copy is made before the loop, and the policy acts on it at every step: copy each new observation.",
    ),
}

REPAIRED_ROLLOUT = Exercise(
    name="repaired_rollout",
    reference=ch45.repaired_rollout,
    criteria={"values": 1.0},
    axes=("t", "env"),
    cases=(
        _case(
            "drones that share an array",
            _collecting("HoverVectorEnv", 8, num_envs=4, time_limit=5, copy=False),
            visible=True,
            draws=1,
        ),
        _case("drones that don't", _collecting("HoverVectorEnv", 8, num_envs=2, time_limit=4), visible=True),
        _case("drones that fly away", _collecting("HoverVectorEnv", 12, steps=6, action=1.0, num_envs=3, copy=False)),
        _case("rewards, bounds and both ends", _collecting("TimerVectorEnv", 7, log_std=1.0, **_PAYING), visible=True),
    ),
    misconceptions=wrong(_WRONG_REPAIRS),
    variants={
        "memory made beforehand, filled before the step": _into_memory,
        "columns of arrays": _columns_of_arrays,
        "the rollout of exercise 3 with a clone": _rollout(),
        "what the environment returns is copied at once": lambda envs, policy, num_steps, obs, generator: _columns_of_arrays(
            envs, policy, num_steps, np.array(obs), generator
        ),
    },
)


TRAIN_PPO = Artefact(
    name="train_ppo",
    reference=ch45.train_ppo,
    file="lander_policy.safetensors",
    task="lander",
    points=3.0,
    thresholds=(0.0, 180.0),
    experiment="lander",
    wrong=("broken_sign_flipped", "broken_misaligned", "broken_ratio_inverted", "broken_mean_action"),
)

TUNED_SETTINGS = Tuning(
    name="tuned_settings",
    reference=ch45.tuned_settings,
    train=partial(ch45.train_ppo, update=ch45.fast_ppo_update),
    points=2.0,
    thresholds=(20.0, 46.0),
    experiment="tuned",
    wrong=(
        "broken_nothing",
        "broken_only_num_steps",
        "broken_only_minibatch_size",
        "broken_only_num_epochs",
        "broken_only_learning_rate",
        "broken_only_clip_range",
    ),
)

EXERCISES = (
    GAUSSIAN_LOG_PROB,
    GAUSSIAN_ENTROPY,
    COLLECT_ROLLOUT,
    MINIBATCHES,
    PPO_LOSS,
    TORCH_PPO_STEPS,
    PPO_UPDATE,
    TRAIN_PPO,
    TUNED_SETTINGS,
    REPAIRED_ROLLOUT,
)
