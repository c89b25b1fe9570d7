"""Checks of chapter 51: cases, named misconceptions and correct variants for learning from a model of the world."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch.distributions import Normal
from torch.nn import functional as F

from autograder.authoring.parts import (
    bad_input_accepted,
    cut_from_graph,
    drawing,
    drawn_once,
    dtype_lost,
    misshapen,
    normal,
    number,
    one_shape,
    python_float,
    refused,
    satisfies,
    shape_cases,
    spoilt,
    uniform,
    versions_of,
    wrong,
)
from autograder.authoring.spec import Case, Exercise, Misconception
from course_lib.checks.cases import built
from solutions import ch51

LOG_TWO_PI = math.log(2 * math.pi)

# ------------------------------------------------------------------------------------------------------------ gaussian_nll

_PREDICTED = ("mean", "log_var", "targets")


@drawing
def _ensemble(generator, members=3, batch=5, dims=4, own_samples=False):
    shape = members, batch, dims
    return {
        "mean": normal(generator, *shape),
        "log_var": -0.7 + 0.8 * normal(generator, *shape),
        "targets": normal(generator, *(shape if own_samples else shape[1:])),
    }


def _extremes(generator):
    """Standard deviations of e^±5.5, and targets within them."""
    drawn = _ensemble(own_samples=True)(generator)
    log_var = 11 * drawn["log_var"].sign()
    return drawn | {"log_var": log_var, "targets": drawn["mean"] + (0.5 * log_var).exp() * drawn["targets"]}


def _standard_and_right(generator):
    """Every mean is right, and every variance 1."""
    drawn = _ensemble()(generator)
    return drawn | {"log_var": torch.zeros_like(drawn["mean"]), "mean": drawn["targets"].expand_as(drawn["mean"]).clone()}


def _nll_by_hand(mean, log_var, targets):
    rows = zip(mean.flatten().tolist(), log_var.flatten().tolist(), targets.expand_as(mean).flatten().tolist(), strict=True)
    terms = [0.5 * (s + (y - m) ** 2 / math.exp(s) + LOG_TWO_PI) for m, s, y in rows]
    return torch.tensor(sum(terms) / len(terms), dtype=mean.dtype)


_nll = versions_of(
    ch51.gaussian_nll,
    one_shape("mean", "log_var"),
    satisfies(lambda targets, mean: targets.shape in (mean.shape, mean.shape[1:])),
    data=["targets"],
)


def _terms(m, s, y):
    return 0.5 * (s + (y - m) ** 2 / s.exp() + LOG_TWO_PI)


def _mean_of_terms(m, s, y):
    return _terms(m, s, y).mean()


def _averaged_prediction(m, s, y):
    """The ensemble as one model: mean of means, mean of variances."""
    y = y if y.dim() == 2 else y.mean(0)
    return _terms(m.mean(0), s.exp().mean(0).log(), y).mean()


_WRONG_GAUSSIAN_NLL = {
    "squared-error": (
        lambda m, s, y: (y - m).square().mean(),
        "This is the squared error: a model that knows how sure it is divides it by its variance and pays log σ².",
    ),
    "log-variance-missing": (
        lambda m, s, y: 0.5 * ((y - m) ** 2 / s.exp() + LOG_TWO_PI).mean(),
        "Without the term log σ² the loss falls as the variance grows, for ever: the model learns to be sure of nothing.",
    ),
    "log-variance-with-the-wrong-sign": (
        lambda m, s, y: 0.5 * (-s + (y - m) ** 2 / s.exp() + LOG_TWO_PI).mean(),
        "A wide distribution is a low one: log σ² is added to the loss.",
    ),
    "error-multiplied-by-the-variance": (
        lambda m, s, y: 0.5 * (s + (y - m) ** 2 * s.exp() + LOG_TWO_PI).mean(),
        "The squared error is divided by the variance, that is, multiplied by exp(-log_var).",
    ),
    "log-var-taken-as-log-std": (
        lambda m, s, y: 0.5 * (2 * s + (y - m) ** 2 / (2 * s).exp() + LOG_TWO_PI).mean(),
        "log_var is log σ², not log σ: the variance is exp(log_var).",
    ),
    "log-var-taken-as-variance": (
        lambda m, s, y: 0.5 * (s.abs().log() + (y - m) ** 2 / s + LOG_TWO_PI).mean(),
        "log_var is the logarithm of the variance: take its exponential.",
    ),
    "error-not-squared": (
        lambda m, s, y: 0.5 * (s + (y - m).abs() / s.exp() + LOG_TWO_PI).mean(),
        "The exponent of the normal density has the error squared.",
    ),
    "half-missing": (
        lambda m, s, y: (s + (y - m) ** 2 / s.exp() + LOG_TWO_PI).mean(),
        "This is twice the negative log-likelihood: the half is missing.",
    ),
    "half-of-the-error-only": (
        lambda m, s, y: (s + 0.5 * (y - m) ** 2 / s.exp() + 0.5 * LOG_TWO_PI).mean(),
        "log σ is half of log σ²: log_var has no half here, and the variances come out too small.",
    ),
    "two-pi-missing": (
        lambda m, s, y: 0.5 * (s + (y - m) ** 2 / s.exp()).mean(),
        "The constant ½ log 2π is missing: it moves no gradient, but what is reported is no likelihood.",
    ),
    "likelihood": (lambda *given: -_mean_of_terms(*given), "This is the log-likelihood: a loss is minus that."),
    "summed-over-dimensions": (
        lambda m, s, y: _terms(m, s, y).sum(-1).mean(),
        "The mean over every element is asked for: here the dimensions are summed.",
    ),
    "summed-over-members": (
        lambda m, s, y: _terms(m, s, y).mean((1, 2)).sum(),
        "The mean over every element is asked for: here the members are summed.",
    ),
    "summed": (lambda m, s, y: _terms(m, s, y).sum(), "This is a sum: the mean over every element is asked for."),
    "one-loss-for-each-member": (
        lambda m, s, y: _terms(m, s, y).mean((1, 2)),
        "One number is asked for: the mean over the members as well.",
    ),
    "ensemble-averaged-first": (
        _averaged_prediction,
        "The members' predictions are averaged before they are judged. Then only the average has to be right, and their"
        " disagreement no longer says where the model is unsure: each member is to be judged for itself.",
    ),
    "variance-detached": (
        lambda m, s, y: _mean_of_terms(m, s.detach(), y),
        "No gradient reaches log_var: the model never learns how sure it may be.",
    ),
}

GAUSSIAN_NLL = Exercise(
    name="gaussian_nll",
    reference=ch51.gaussian_nll,
    criteria={"values": 1.2, "gradient": 0.4, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    cases=drawn_once(
        Case("three members, targets for all", _ensemble(), closed_form=_nll_by_hand, visible=True, draws=2),
        Case("three members, samples of their own", _ensemble(own_samples=True), closed_form=_nll_by_hand, visible=True, draws=2),
        Case("right, with variance 1: half of log 2π", _standard_and_right, closed_form=number(0.5 * LOG_TWO_PI), visible=True),
        Case("as many members as samples", _ensemble(4, 4, 2), closed_form=_nll_by_hand),
        Case("a single member", _ensemble(1, 6, 2), closed_form=_nll_by_hand),
        Case("members that are very sure, or not at all", _extremes, closed_form=_nll_by_hand),
        Case("all inputs require gradient", _ensemble(), differentiate=_PREDICTED, visible=True, draws=2),
        Case("own samples, gradient", _ensemble(own_samples=True), differentiate=_PREDICTED),
        Case("single precision", _ensemble(), dtype=torch.float32, visible=True),
        misshapen("log_var without its first member", _ensemble(), "log_var", lambda x: x[1:], ("log_var", "mean")),
        misshapen("log_var the same for all members", _ensemble(), "log_var", lambda x: x[:1], ("log_var", "mean"), visible=True),
        misshapen("targets with one dimension", _ensemble(), "targets", lambda x: x[:, :1], ("targets", "mean"), visible=True),
        misshapen("targets of one sample", _ensemble(), "targets", lambda x: x[:1], ("targets", "mean")),
    ),
    misconceptions=(
        *wrong(_WRONG_GAUSSIAN_NLL, _nll),
        Misconception("gradient-into-targets", _nll(_mean_of_terms, leak=True), "Targets are data: detach them."),
        *spoilt(ch51.gaussian_nll, python_float, dtype_lost, changed="mean"),
        bad_input_accepted(_nll(_mean_of_terms, checked=False)),
    ),
    variants={
        "torch.distributions": _nll(lambda m, s, y: -Normal(m, (0.5 * s).exp()).log_prob(y).mean()),
        "PyTorch's own loss": _nll(lambda m, s, y: F.gaussian_nll_loss(m, y.expand_as(m), s.exp(), full=True, eps=1e-12)),
        "member by member": _nll(
            lambda m, s, y: torch.stack([_terms(m[e], s[e], y if y.dim() == 2 else y[e]).mean() for e in range(len(m))]).mean()
        ),
        "terms apart": _nll(lambda m, s, y: 0.5 * s.mean() + 0.5 * ((y - m) * (-0.5 * s).exp()).pow(2).mean() + 0.5 * LOG_TWO_PI),
        "in double precision": _nll(lambda m, s, y: _mean_of_terms(m.double(), s.double(), y.double()).to(m.dtype)),
    },
)

# ----------------------------------------------------------------------------------------------------------------- imagine


def _world(generator, obs_dim, action_dim, noise, limit):
    """A linear model and a linear policy, as descriptions; noise in one of them is noise in both."""
    dynamics = torch.eye(obs_dim, dtype=torch.float64) + 0.3 * normal(generator, obs_dim, obs_dim)
    control = normal(generator, action_dim, obs_dim)
    model = built("control.dynamics.LinearModel", dynamics=dynamics, control=control, noise=noise, limit=limit, drift=2.0)
    return model, built("control.dynamics.LinearPolicy", gains=0.4 * normal(generator, obs_dim, action_dim), noise=noise)


@drawing
def _dreams(generator, batch=6, obs_dim=3, action_dim=2, horizon=5, noise=0.0, limit=math.inf):
    model, policy = _world(generator, obs_dim, action_dim, noise, limit)
    return {
        "model": model,
        "policy": policy,
        "start_obs": 0.5 * normal(generator, batch, obs_dim),
        "horizon": horizon,
        "generator": built("seeding.generator", seed=int(1e6 * uniform(generator, 1))),
    }


def _ending(generator):
    """One trajectory ends with its first step and leaves the bounds; the others never do. After the end the model says that the
    trajectory goes on again."""
    drawn = _dreams(batch=4, obs_dim=2, action_dim=1, horizon=4)(generator)
    turn = torch.tensor([[0.0, 1.0], [-1.0, 0.0]], dtype=torch.float64)  # a quarter of a turn: the first component comes back
    control = torch.zeros(1, 2, dtype=torch.float64)
    drawn["model"] = built("control.dynamics.LinearModel", dynamics=turn, control=control, limit=1.0, drift=2.0)
    start = 0.2 + 0.3 * uniform(generator, 4, 2)
    start[1, 1], start[2, 0] = 3.0, 5.0  # what is second now is first after a step; what is first, after two
    return drawn | {"start_obs": start}


def _all_ending(generator):
    return _ending(generator) | {"start_obs": 3 + normal(generator, 4, 2).abs()}


def _view(name, inputs, **options):
    return Case(name, inputs, view="until_the_end", **options)


_PARTS = ("obs", "actions", "rewards", "continues")


def _stacked(*columns):
    return {name: torch.stack(column) for name, column in zip(_PARTS, columns, strict=True)}


def _dream(
    condition=lambda start, latest: latest,
    asked=lambda start, latest: latest,
    act=lambda policy, obs, generator: policy(obs, generator),
    ends=lambda alive, goes_on: alive * goes_on,
    **changed,
):
    """A version of imagine, each step of which can be another; `changed` gives parts of the result anew."""

    def version(model, policy, start_obs, horizon, generator):
        obs, actions, rewards, continues = [start_obs], [], [], []
        alive = torch.ones(len(start_obs), dtype=start_obs.dtype)
        for _ in range(horizon):
            seen = condition(start_obs, obs[-1])
            chosen = act(policy, asked(start_obs, seen), generator)
            following, reward, goes_on = model(seen, chosen, generator)
            alive = ends(alive, goes_on)
            obs.append(following)
            actions.append(chosen)
            rewards.append(reward)
            continues.append(alive)
        result = _stacked(obs, actions, rewards, continues)
        return result | {name: change(result[name]) for name, change in changed.items()}

    return version


def _row_by_row(model, policy, start_obs, horizon, generator):
    """One trajectory after the other."""
    rows = [ch51.imagine(model, policy, start[None], horizon, generator) for start in start_obs]
    return {name: torch.cat([row[name] for row in rows], 1) for name in rows[0]}


def _filled(model, policy, start_obs, horizon, generator):
    """Into arrays that were made before."""
    batch, obs_dim = start_obs.shape
    obs = start_obs.new_zeros(horizon + 1, batch, obs_dim)
    rewards, continues = start_obs.new_zeros(horizon, batch), start_obs.new_ones(horizon, batch)
    obs[0] = start_obs
    actions = []
    for t in range(horizon):
        actions.append(policy(obs[t], generator))
        obs[t + 1], rewards[t], continues[t] = model(obs[t], actions[t], generator)
    return {"obs": obs, "actions": torch.stack(actions), "rewards": rewards, "continues": continues.cumprod(0)}


def _frozen_after_the_end(model, policy, start_obs, horizon, generator):
    """Trajectories that have ended stay where they are, and earn nothing."""
    obs, actions, rewards, continues = [start_obs], [], [], []
    alive = torch.ones(len(start_obs), dtype=torch.bool)
    for _ in range(horizon):
        action = policy(obs[-1], generator)
        following, reward, goes_on = model(obs[-1], action, generator)
        obs.append(torch.where(alive[:, None], following, obs[-1]))
        actions.append(action)
        rewards.append(torch.where(alive, reward, 0))
        alive = alive & (goes_on > 0)
        continues.append(alive.to(start_obs.dtype))
    return _stacked(obs, actions, rewards, continues)


def _recursive(model, policy, start_obs, horizon, generator):
    def onwards(obs, alive, left):
        if not left:
            return []
        action = policy(obs, generator)
        following, reward, goes_on = model(obs, action, generator)
        alive = torch.minimum(alive, goes_on)
        return [(following, action, reward, alive), *onwards(following, alive, left - 1)]

    obs, actions, rewards, continues = zip(*onwards(start_obs, torch.ones_like(start_obs[:, 0]), horizon), strict=True)
    return _stacked([start_obs, *obs], actions, rewards, continues)


def _last_step_lost(stays):
    """The step that ends a trajectory pays nothing, and with `stays` leads nowhere either."""

    def version(model, policy, start_obs, horizon, generator):
        dream = ch51.imagine(model, policy, start_obs, horizon, generator)
        obs = [start_obs]
        for following, goes_on in zip(dream["obs"][1:], dream["continues"], strict=True):
            obs.append(torch.where(goes_on[:, None] > 0, following, obs[-1]) if stays else following)
        return dream | {"obs": torch.stack(obs), "rewards": dream["rewards"] * dream["continues"]}

    return version


_LAST_STEP = (
    "The step that ends a trajectory still counts: its reward is earned and its state reached. Only what comes after it does not."
)

_WRONG_IMAGINE = {
    "last-step-unpaid": (_last_step_lost(stays=False), _LAST_STEP),
    "last-step-not-taken": (_last_step_lost(stays=True), _LAST_STEP),
    "always-from-the-start": (
        _dream(condition=lambda start, latest: start),
        "Every step begins at start_obs again: the next one begins where the last one led to.",
    ),
    "policy-asked-about-the-start": (
        _dream(asked=lambda start, latest: start),
        "The policy is asked about start_obs at every step: ask it about the state that the last step led to.",
    ),
    "horizon-taken-for-an-end": (
        _dream(continues=lambda x: torch.cat([x[:-1], torch.zeros_like(x[-1:])])),
        "The last step's continues is 0 because the loop ends there. The trajectory does not: only the model says where one ends.",
    ),
    "end-forgotten": (
        _dream(ends=lambda alive, goes_on: goes_on),
        "A trajectory that has ended comes back to life as soon as the model finds its state harmless: once continues is 0, it stays 0.",
    ),
    "end-a-step-late": (
        _dream(continues=lambda x: torch.cat([torch.ones_like(x[:1]), x[:-1]])),
        "continues[t] says whether the trajectory goes on after step t, not whether it had ended before it.",
    ),
    "never-ends": (_dream(ends=lambda alive, goes_on: alive), "What the model says about the end is not used."),
    "ends-instead-of-continues": (
        _dream(continues=lambda x: 1 - x),
        "This is 1 where the trajectory has ended: continues is 1 where it goes on.",
    ),
    "all-end-together": (
        _dream(ends=lambda alive, goes_on: alive * goes_on.min()),
        "Where one trajectory ends, all do here: each has its own end.",
    ),
    "start-left-out": (_dream(obs=lambda x: x[1:]), "obs begins with start_obs: it has H + 1 entries."),
    "last-state-left-out": (
        _dream(obs=lambda x: x[:-1]),
        "The state that the last step led to is missing: obs has H + 1 entries, and the last value is bootstrapped from it.",
    ),
    "batch-first": (_dream(**dict.fromkeys(_PARTS, lambda x: x.transpose(0, 1))), "Time comes first: (H, B), not (B, H)."),
    "policy-asked-twice": (
        _dream(act=lambda policy, obs, generator: [policy(obs, generator) for _ in range(2)][-1]),
        "The policy is called more than once in a step: what is recorded must be the action that the model was given.",
    ),
    "trajectory-by-trajectory": (
        _row_by_row,
        "The model is called for each trajectory apart: one call for the whole batch does the same in a fraction of the time.",
    ),
    "dtype-lost": (_dream(**dict.fromkeys(_PARTS, torch.Tensor.float)), "The results have lost the dtype of start_obs."),
}

IMAGINE = Exercise(
    name="imagine",
    reference=ch51.imagine,
    criteria={"values": 1.7, "dtype": 0.1, "inputs": 0.2},
    axes=("t", "trajectory"),
    cases=drawn_once(
        _view("five steps, no noise", _dreams(), visible=True, draws=2),
        _view("noise in the policy and the model", _dreams(noise=0.3), visible=True, draws=2),
        _view("trajectories that end", _ending, visible=True, draws=2),
        _view("all end with the first step", _all_ending),
        _view("one step", _dreams(horizon=1), visible=True),
        _view("a single start", _dreams(batch=1)),
        _view("as many starts as steps", _dreams(batch=4, horizon=4, obs_dim=4)),
        Case("calls of the model and of the policy", _dreams(noise=0.3), returns=("model", "policy"), visible=True),
        _view("single precision", _dreams(), dtype=torch.float32, visible=True),
    ),
    misconceptions=(*wrong(_WRONG_IMAGINE), *spoilt(ch51.imagine, changed="start_obs")),
    variants={
        "into arrays made before": _filled,
        "frozen after the end": _frozen_after_the_end,
        "recursion": _recursive,
        "cumulative product": _dream(ends=lambda alive, goes_on: goes_on, continues=lambda x: x.cumprod(0)),
    },
)


# --------------------------------------------------------------------------------------------------- dreamer_lambda_returns

_IMAGINED = ("rewards", "values", "continues")


@drawing
def _imagined(generator, steps=6, batch=4, gamma=0.95, lam=0.8, ends=0.2):
    return {
        "rewards": normal(generator, steps, batch),
        "values": 5 + 3 * normal(generator, steps, batch),
        "continues": (uniform(generator, steps, batch) >= ends).double(),
        "gamma": gamma,
        "lam": lam,
    }


def _fractions(generator):
    """A model that is not sure whether the trajectory goes on."""
    drawn = _imagined()(generator)
    return drawn | {"continues": uniform(generator, *drawn["rewards"].shape)}


def _as_sum(rewards, values, continues, gamma, lam):
    """R_t as the weighted sum of n-step returns."""
    steps = len(rewards)
    result = torch.zeros_like(rewards)
    for t in range(steps):
        discount, total, weight = torch.ones_like(rewards[0]), torch.zeros_like(rewards[0]), 1.0
        for k in range(t, steps):
            total = total + discount * rewards[k]
            discount = discount * gamma * continues[k]
            n_step = total + discount * values[k]
            share = weight * (1 - lam) if k < steps - 1 else weight
            result[t] = result[t] + share * n_step
            weight *= lam
    return result


def _one_step(rewards, values, continues, gamma, **_rest):
    return rewards + gamma * continues * values


_dreamer = versions_of(
    ch51.dreamer_lambda_returns,
    one_shape(*_IMAGINED),
    satisfies(lambda gamma: 0 <= gamma <= 1),
    satisfies(lambda lam: 0 <= lam <= 1),
)


def _right(r, v, c, following, gamma, lam):
    return r + gamma * c * ((1 - lam) * v + lam * following)


def _backwards(mix=_right, last=lambda v: v[-1], r=None, v=None, c=None):
    """A recursion: `mix` takes r, v, c, what follows, gamma, lam of one step; `r`, `v` and `c` change the columns beforehand."""

    def formula(rewards, values, continues, gamma, lam):
        columns = [change(x) if change else x for change, x in ((r, rewards), (v, values), (c, continues))]
        following = last(columns[1])
        found: list[torch.Tensor] = []
        for step in reversed(list(zip(*columns, strict=False))):
            following = mix(*step, following, gamma, lam)
            found.insert(0, following)
        return torch.stack(found)

    return formula


def _forwards(r, v, c, gamma, lam):
    following, found = v[0], []
    for step in zip(r, v, c, strict=True):
        following = _right(*step, following, gamma, lam)
        found.append(following)
    return torch.stack(found)


def _from_deltas(r, v, c, gamma, lam):
    """As a generalised advantage on top of one-step targets."""
    targets, above = r + gamma * c * v, torch.zeros_like(r[0])
    found = [targets[-1]]
    for t in reversed(range(len(r) - 1)):
        above = gamma * lam * c[t] * (found[0] - v[t])
        found.insert(0, targets[t] + above)
    return torch.stack(found)


def _by_matrix(r, v, c, gamma, lam):
    """The recursion is linear: solve for all steps at once."""
    share = torch.full_like(r, lam)
    share[-1] = 0
    constant = r + gamma * c * (1 - share) * v
    coupling = torch.diag_embed((gamma * c * share)[:-1].T, 1)  # of each step to the next, one matrix for each trajectory
    return torch.linalg.solve(torch.eye(len(r), dtype=r.dtype) - coupling, constant.T).T


_WRONG_DREAMER_LAMBDA_RETURNS = {
    "values-of-the-state-before": (
        _backwards(v=lambda v: torch.cat([v[1:], v[-1:]])),
        "values[t] belongs to the state that rewards[t] led to: it is what bootstraps step t. Here values[t + 1] does.",
    ),
    "last-value-forgotten": (
        _backwards(last=lambda v: torch.zeros_like(v[-1])),
        "Behind the horizon stands nothing here: the last return bootstraps from values[-1] alone, with no 1 - λ before it.",
    ),
    "no-bootstrap-at-the-end": (
        lambda r, v, c, *rest: torch.cat([_backwards()(r[:-1], v[:-1], c[:-1], *rest), r[-1:]]) if len(r) > 1 else r.clone(),
        "The last return is its reward only: it bootstraps from values[-1], and the returns before it go on from there.",
    ),
    "lam-swapped": (
        _backwards(lambda r, v, c, f, gamma, lam: _right(r, v, c, f, gamma, 1 - lam)),
        "λ weights the longer return and 1 - λ the value: here it is the other way round.",
    ),
    "end-ignored": (
        _backwards(lambda r, v, c, f, gamma, lam: _right(r, v, 1.0, f, gamma, lam)),
        "continues is not used: where a trajectory has ended nothing follows.",
    ),
    "end-stops-the-recursion-only": (
        _backwards(lambda r, v, c, f, gamma, lam: r + gamma * ((1 - lam) * v + lam * c * f)),
        "After an end the value is still bootstrapped: continues multiplies both, the value and the return that follows.",
    ),
    "end-stops-the-value-only": (
        _backwards(lambda r, v, c, f, gamma, lam: r + gamma * ((1 - lam) * c * v + lam * f)),
        "After an end the following returns still count: continues multiplies both, the value and the return that follows.",
    ),
    "end-of-the-next-step": (
        _backwards(c=lambda c: torch.cat([c[1:], torch.ones_like(c[:1])])),
        "continues[t] belongs to step t: here that of step t + 1 is used.",
    ),
    "end-taken-as-flag": (_backwards(c=torch.round), "continues may be a probability: multiply by it, do not round it."),
    "gamma-missing": (
        _backwards(lambda r, v, c, f, gamma, lam: _right(r, v, c, f, 1.0, lam)),
        "What follows is not discounted: multiply it by gamma.",
    ),
    "gamma-on-the-return-only": (
        _backwards(lambda r, v, c, f, gamma, lam: r + c * ((1 - lam) * v + gamma * lam * f)),
        "gamma multiplies both: the value is one step away, too.",
    ),
    "weights-do-not-sum-to-one": (
        _backwards(lambda r, v, c, f, gamma, lam: r + gamma * c * (v + lam * f)),
        "The value has the weight 1 - λ: with 1 what follows is counted 1 + λ times.",
    ),
    "lam-missing": (
        _backwards(lambda r, v, c, f, gamma, lam: _right(r, v, c, f, gamma, 1.0)),
        "lam is not used: these are the sums of all rewards.",
    ),
    "one-step-only": (lambda r, v, c, gamma, lam: r + gamma * c * v, "lam is not used: these are one-step targets."),
    "advantages": (
        lambda r, v, *rest: _backwards()(r, v, *rest) - v,
        "values are subtracted: the returns themselves are asked for.",
    ),
    "forwards": (_forwards, "Time runs the wrong way: a return depends on what comes after, so begin with the last step."),
    "order-reversed": (
        lambda *given: _backwards()(*given).flip(0),
        "The returns come in the order in which they were computed, last step first: turn them round.",
    ),
    "values-detached": (
        _backwards(v=torch.Tensor.detach),
        "No gradient reaches values: Dreamer's policy learns through them what lies behind the horizon.",
    ),
}

DREAMER_LAMBDA_RETURNS = Exercise(
    name="dreamer_lambda_returns",
    reference=ch51.dreamer_lambda_returns,
    criteria={"values": 1.2, "gradient": 0.4, "dtype": 0.1, "inputs": 0.1, "errors": 0.2},
    axes=("t", "trajectory"),
    last_step_first=True,
    cases=drawn_once(
        Case("six steps", _imagined(), closed_form=_as_sum, visible=True, draws=2),
        Case("no ends", _imagined(ends=0.0), closed_form=_as_sum, visible=True),
        Case("lam = 0: one step and the next value", _imagined(lam=0.0), closed_form=_one_step, visible=True),
        Case("lam = 1: all rewards and the last value", _imagined(lam=1.0, ends=0.0), closed_form=_as_sum, visible=True),
        Case("gamma = 1", _imagined(gamma=1.0), closed_form=_as_sum),
        Case("one step", _imagined(1), closed_form=_as_sum),
        Case("one step, which ends", _imagined(1, ends=1.0), closed_form=_as_sum),
        Case("as many trajectories as steps", _imagined(5, 5), closed_form=_as_sum),
        Case("a model that is not sure of the end", _fractions, closed_form=_as_sum, visible=True),
        Case("rewards and values require gradient", _imagined(), differentiate=("rewards", "values"), visible=True, draws=2),
        Case("single precision", _imagined(), dtype=torch.float32, visible=True),
        *shape_cases(_imagined(), _IMAGINED),
        refused(_imagined(), gamma=1.1, visible=True),
        refused(_imagined(), lam=-0.2, visible=True),
        refused(_imagined(), lam=1.5),
    ),
    misconceptions=(
        *wrong(_WRONG_DREAMER_LAMBDA_RETURNS, _dreamer),
        *spoilt(ch51.dreamer_lambda_returns, cut_from_graph, dtype_lost, changed="values"),
        bad_input_accepted(_dreamer(_backwards(), checked=False)),
    ),
    variants={
        "sum of n-step returns": _dreamer(_as_sum),
        "recursion by indices": _dreamer(_backwards()),
        "corrections on one-step targets": _dreamer(_from_deltas),
        "linear system": _dreamer(_by_matrix),
        "difference form": _dreamer(_backwards(lambda r, v, c, f, gamma, lam: r + gamma * c * (v + lam * (f - v)))),
    },
)

# ---------------------------------------------------------------------------------------------------- model_error_by_horizon

_STEPS = ("obs", "actions")


@drawing
def _trajectories(generator, steps=5, batch=6, obs_dim=3, action_dim=2, noise=0.0, limit=math.inf):
    """Real trajectories that a model does not quite know."""
    model, _ = _world(generator, obs_dim, action_dim, noise, limit)
    return {
        "model": model,
        "obs": normal(generator, steps + 1, batch, obs_dim) * torch.linspace(0.5, 2.0, obs_dim, dtype=torch.float64),
        "actions": normal(generator, steps, batch, action_dim),
        "generator": built("seeding.generator", seed=int(1e6 * uniform(generator, 1))),
    }


def _perfect(generator):
    """Trajectories that the model made itself."""
    drawn = _trajectories()(generator)
    parts = drawn["model"]["arguments"]
    obs = [drawn["obs"][0]]
    for taken in drawn["actions"]:
        obs.append(obs[-1] @ parts["dynamics"] + taken @ parts["control"])
    return drawn | {"obs": torch.stack(obs)}


_forecast = versions_of(
    ch51.model_error_by_horizon, satisfies(lambda obs, actions: len(obs) == len(actions) + 1 and obs.shape[1] == actions.shape[1])
)


def _root_mean_square(gaps):
    return gaps.square().mean((1, 2)).sqrt()


def _error(
    measure=_root_mean_square,
    predict=lambda model, predicted, real, taken, generator: model(predicted, taken, generator)[0],
    act=lambda actions: actions,
    checked=True,
):
    """A version: `measure` takes predictions minus truth, (H, B, O)."""

    def version(model, obs, actions, generator):
        latest, predictions = obs[0], []
        for real, taken in zip(obs, act(actions), strict=False):
            latest = predict(model, latest, real, taken, generator)
            predictions.append(latest)
        return measure(torch.stack(predictions) - obs[1 : len(actions) + 1])

    return _forecast(version, checked)


def _numpy_errors(gaps):
    differences = gaps.numpy().reshape(len(gaps), -1)
    return torch.from_numpy(np.linalg.norm(differences, axis=1) / math.sqrt(differences.shape[1])).to(gaps.dtype)


def _other_order(model, obs, actions, generator):
    """Predictions first, into one tensor, then all errors."""
    predictions = [obs[0]]
    with torch.no_grad():
        for taken in actions.unbind(0):
            predictions.append(model(predictions[-1], taken, generator)[0])
    gaps = torch.stack(predictions)[1:] - obs[1:]
    return (gaps**2).flatten(1).sum(1).div(gaps[0].numel()).pow(0.5)


_WRONG_MEASURES = {
    "mean-square": (
        lambda gap: gap.square().mean((1, 2)),
        "This is the mean square error: take its root, which is in units of the observations.",
    ),
    "mean-of-distances": (
        lambda gap: gap.square().sum(-1).sqrt().mean(1),
        "This is the mean Euclidean distance: the mean over samples and components comes before the root.",
    ),
    "mean-of-roots": (
        lambda gap: gap.square().mean(-1).sqrt().mean(1),
        "The root is taken for each sample: the mean over samples and components comes before the root.",
    ),
    "absolute-error": (lambda gap: gap.abs().mean((1, 2)), "This is the mean absolute error: the root mean square is asked for."),
    "summed-over-components": (
        lambda gap: gap.square().sum(-1).mean(1).sqrt(),
        "The squares are summed over the components: take their mean.",
    ),
    "error-of-the-mean": (
        lambda gap: gap.mean(1).square().mean(-1).sqrt(),
        "Errors of opposite sign cancel: square before averaging over samples.",
    ),
    "per-component": (
        lambda gap: gap.square().mean(1).sqrt(),
        "One number for each horizon is asked for: take the mean over components, too.",
    ),
    "accumulated": (
        lambda gap: _root_mean_square(gap).cumsum(0),
        "The errors of all horizons so far are added up: each horizon has its own.",
    ),
    "averaged-over-horizons": (
        lambda gap: _root_mean_square(gap).mean(),
        "One number for each horizon is asked for: how the error grows is the point.",
    ),
    "start-included": (
        lambda gap: torch.cat([torch.zeros_like(gap[:1, 0, 0]), _root_mean_square(gap)]),
        "The horizon begins at 1: the error at the start, 0, is left out.",
    ),
}

_WRONG_MODEL_ERROR_BY_HORIZON = {
    "one-step-predictions": (
        _error(predict=lambda model, predicted, real, taken, generator: model(real, taken, generator)[0]),
        "Each prediction starts from the real observation, so errors never add up: go on from what the model predicted.",
    ),
    "first-action-repeated": (
        _error(act=lambda actions: actions[:1].expand_as(actions)),
        "The first action is used at every step: step h takes actions[h].",
    ),
}

MODEL_ERROR_BY_HORIZON = Exercise(
    name="model_error_by_horizon",
    reference=ch51.model_error_by_horizon,
    criteria={"values": 1.2, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("h",),
    cases=drawn_once(
        Case("five steps", _trajectories(), visible=True, draws=2),
        Case("a noisy model", _trajectories(noise=0.5), visible=True),
        Case("a perfect model", _perfect, closed_form=lambda actions, **_rest: actions.new_zeros(len(actions)), visible=True),
        Case("one step", _trajectories(1), visible=True),
        Case("a single trajectory", _trajectories(batch=1)),
        Case("as many trajectories as steps", _trajectories(4, 4, 4)),
        Case("calls of the model", _trajectories(), returns=("model",)),
        Case("a model that believes in ends", _trajectories(limit=0.5)),
        Case("single precision", _trajectories(), dtype=torch.float32, visible=True),
        misshapen("as many obs as actions", _trajectories(), "obs", lambda x: x[:-1], _STEPS, visible=True),
        misshapen("obs of one trajectory", _trajectories(), "obs", lambda x: x[:, :1], _STEPS),
        misshapen("obs a step too long", _trajectories(), "obs", lambda x: torch.cat([x, x[-1:]]), _STEPS),
    ),
    misconceptions=(
        *wrong(_WRONG_MEASURES, _error),
        *wrong(_WRONG_MODEL_ERROR_BY_HORIZON),
        *spoilt(ch51.model_error_by_horizon, dtype_lost, changed="obs"),
        bad_input_accepted(_error(checked=False)),
    ),
    variants={
        "all predictions first": _forecast(_other_order),
        "by indices": _error(),
        "NumPy": _error(_numpy_errors),
        "vector norm": _error(lambda gaps: torch.linalg.vector_norm(gaps, dim=(1, 2)) / math.sqrt(gaps.shape[1] * gaps.shape[2])),
        "mean squared error, step by step": _error(
            lambda gaps: torch.stack([F.mse_loss(gap, torch.zeros_like(gap)).sqrt() for gap in gaps])
        ),
    },
)

# -------------------------------------------------------------------------------------------------------- repaired_next_obs


@drawing
def _planned(generator, batch=5, seen=40, obs_dim=3, action_dim=2, spread=1.0):
    """States to predict from, `spread` wide, and the steps that were seen; each component has a level and a scale of its own."""
    level, scale = 2 * normal(generator, obs_dim), 0.5 + 2 * uniform(generator, obs_dim)
    obs, actions = level + scale * normal(generator, seen, obs_dim), 1 + 2 * normal(generator, seen, action_dim)
    changes = normal(generator, obs_dim) + (0.3 + uniform(generator, obs_dim)) * normal(generator, seen, obs_dim)
    return {
        "network": built("control.dynamics.FixedNetwork", weights=0.7 * normal(generator, obs_dim + action_dim, obs_dim)),
        "obs": level + scale * (normal(generator, obs_dim) + spread * normal(generator, batch, obs_dim)),
        "actions": normal(generator, batch, action_dim),
        "seen": {"obs": obs, "actions": actions, "next_obs": obs + changes},
    }


def _moments(x, deviation=lambda x: x.std(0)):
    return x.mean(0), deviation(x)


_next_obs = versions_of(ch51.repaired_next_obs, satisfies(lambda obs, actions: len(obs) == len(actions)))


def _predicted(
    of_inputs=lambda inputs, seen: _moments(seen),
    of_changes=lambda seen: _moments(seen["next_obs"] - seen["obs"]),
    finish=lambda obs, change, level, scale: obs + level + scale * change,
    checked=True,
):
    """A version of the repair: which moments scale the inputs, which the changes, and what is made of them."""

    def version(network, obs, actions, seen):
        inputs = torch.cat([obs, actions], 1)
        level, scale = of_inputs(inputs, torch.cat([seen["obs"], seen["actions"]], 1))
        return finish(obs, network((inputs - level) / scale), *of_changes(seen))

    return _next_obs(version, checked)


def _biased(x):
    return _moments(x, lambda x: x.std(0, correction=0))


_BIASED = _predicted(lambda inputs, seen: _biased(seen), lambda seen: _biased(seen["next_obs"] - seen["obs"]))


def _observations_only(inputs, seen):
    """The actions by their own batch."""
    count = 3  # of observations, in every case
    return tuple(torch.cat([of_seen[:count], own[count:]]) for of_seen, own in zip(_moments(seen), _moments(inputs), strict=True))


def _row_at_a_time(network, obs, actions, seen):
    inputs = np.concatenate([seen["obs"].numpy(), seen["actions"].numpy()], 1)
    changes = seen["next_obs"].numpy() - seen["obs"].numpy()
    rows = []
    for state, action in zip(obs.numpy(), actions.numpy(), strict=True):
        scaled = (np.concatenate([state, action]) - inputs.mean(0)) / inputs.std(0, ddof=1)
        change = network(torch.from_numpy(scaled[None]).to(obs.dtype))[0].numpy()
        rows.append(torch.from_numpy(state + changes.mean(0) + changes.std(0, ddof=1) * change))
    return torch.stack(rows).to(obs.dtype)


def _among_the_seen(network, obs, actions, seen):
    """Scale everything in one go."""
    inputs, known = torch.cat([obs, actions], 1), torch.cat([seen["obs"], seen["actions"]], 1)
    variance, level = torch.var_mean(known, 0)
    spread, drift = torch.std_mean(seen["next_obs"] - seen["obs"], 0)
    return torch.addcmul(obs + drift, spread, network((inputs - level) * variance.rsqrt()))


_WRONG_REPAIRED_NEXT_OBS = {
    "scaled-by-its-own-batch": (
        _predicted(lambda inputs, seen: _moments(inputs)),
        "This is the suspect program's own bug. What does the network see of a state whose neighbours in the batch are the same state?",
    ),
    "actions-scaled-by-their-own-batch": (
        _predicted(_observations_only),
        "The actions are still scaled by the batch that they come in: a prediction must not depend on its neighbours.",
    ),
    "scaled-with-the-batch": (
        _predicted(lambda inputs, seen: _moments(torch.cat([seen, inputs]))),
        "The batch has joined the steps that were seen: the scale must be the one that the network was trained with.",
    ),
    "not-scaled": (
        _predicted(lambda inputs, seen: (0.0, 1.0)),
        "The network was trained on inputs of mean 0 and deviation 1: here it gets them in their own units.",
    ),
    "not-centred": (
        _predicted(lambda inputs, seen: (0.0, seen.std(0))),
        "The inputs are divided by their scale, but the mean is not subtracted.",
    ),
    "divided-by-the-variance": (
        _predicted(lambda inputs, seen: _moments(seen, lambda x: x.var(0))),
        "The inputs are divided by their variance: it is the standard deviation that brings them to 1.",
    ),
    "one-scale-for-all-components": (
        _predicted(lambda inputs, seen: (seen.mean(), seen.std())),
        "One mean and one deviation for all components: each component has its own.",
    ),
    "change-taken-for-the-state": (
        _predicted(finish=lambda obs, change, level, scale: level + scale * change),
        "This is the change: add it to the observation.",
    ),
    "change-left-scaled": (
        _predicted(finish=lambda obs, change, level, scale: obs + change),
        "The network gives changes of mean 0 and deviation 1: bring them back to units of observations.",
    ),
    "mean-change-forgotten": (
        _predicted(finish=lambda obs, change, level, scale: obs + scale * change),
        "The mean change was subtracted before training: add it again.",
    ),
    "mean-change-scaled-too": (
        _predicted(finish=lambda obs, change, level, scale: obs + scale * (level + change)),
        "The mean change is in units of observations already: scale what the network gives, then add it.",
    ),
    "scale-of-the-next-observations": (
        _predicted(of_changes=lambda seen: _moments(seen["next_obs"])),
        "The outputs are scaled back by the moments of next_obs: the network learned changes, next_obs - obs.",
    ),
    "scale-of-the-observations": (
        _predicted(of_changes=lambda seen: _moments(seen["obs"])),
        "The outputs are scaled back by the moments of the observations: the network learned changes, next_obs - obs.",
    ),
    "change-the-wrong-way-round": (
        _predicted(of_changes=lambda seen: _moments(seen["obs"] - seen["next_obs"])),
        "The change is what comes after minus what was before.",
    ),
}

REPAIRED_NEXT_OBS = Exercise(
    name="repaired_next_obs",
    reference=ch51.repaired_next_obs,
    also_right=(_BIASED,),
    criteria={"values": 1.7, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    axes=("step", "component"),
    cases=(
        Case("five states", _planned(), visible=True, draws=2),
        Case("five states that are nearly alike", _planned(spread=0.05), visible=True, draws=2),
        Case("a single state", _planned(1), visible=True),
        Case("more states than were seen", _planned(30, 12)),
        Case("single precision", _planned(), dtype=torch.float32, visible=True),
        misshapen("actions of one step", _planned(), "actions", lambda x: x[:1], _STEPS, visible=True),
        misshapen("obs without the last", _planned(), "obs", lambda x: x[:-1], _STEPS),
    ),
    misconceptions=(
        *wrong(_WRONG_REPAIRED_NEXT_OBS),
        *spoilt(ch51.repaired_next_obs, dtype_lost, changed="obs"),
        bad_input_accepted(_predicted(checked=False)),
    ),
    variants={
        "biased deviations": _BIASED,
        "moments passed along": _predicted(),
        "a row at a time, in NumPy": _next_obs(_row_at_a_time),
        "var_mean and addcmul": _next_obs(_among_the_seen),
    },
)

EXERCISES = (GAUSSIAN_NLL, IMAGINE, DREAMER_LAMBDA_RETURNS, MODEL_ERROR_BY_HORIZON, REPAIRED_NEXT_OBS)
