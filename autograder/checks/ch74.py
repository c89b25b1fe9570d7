"""Checks of chapter 74: cases, named misconceptions and correct variants for behavioural cloning and its measurements."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch.distributions import Categorical, MultivariateNormal, Normal
from torch.nn import functional as F

from autograder.authoring.parts import (
    DTYPE,
    NUMBER,
    bad_input_accepted,
    drawing,
    dtype_lost,
    integers,
    misshapen,
    normal,
    number,
    one_shape,
    python_float,
    replaced,
    satisfies,
    spoilt,
    uniform,
    versions_of,
    wrong,
)
from autograder.authoring.spec import Case, Exercise, Misconception
from course_lib.checks.cases import built
from course_lib.control.demonstrations import Demonstrations
from solutions import ch74

# ---------------------------------------------------------------------------------------------------------------- inputs


def _integer(generator, high):
    return int(torch.randint(high, (), generator=generator))


_SIGN = "This is the log-likelihood, to be made large; a loss is to be made small: negate it."
_SUM = "A sum grows with the batch, and with it the step: take the mean over the batch."

# ----------------------------------------------------------------------------------------------- collect_demonstrations


@drawing
def _drive(generator, env, policy, **settings):
    """A policy on a road; `policy` makes what is built from the case's generator."""
    return {"policy": policy(generator), "env": env, "num_episodes": 2, "seed": _integer(generator, 10_000)} | settings


def _driver(_generator):
    return built("control.road.RoadDriver")


def _strong(generator):
    """Commands far beyond ±1, that lead off the road at once."""
    return built("control.road.LinearPolicy", weights=normal(generator, 1, 5), bias=torch.full((1,), 3.0, dtype=torch.float64))


def _weak(generator):
    """Hardly any command: the rover leaves the road where it bends, sooner or later."""
    return built("control.road.LinearPolicy", weights=0.05 * normal(generator, 1, 5), bias=0.6 + 0.1 * normal(generator, 1).abs())


def _three_commands(generator):
    return built("control.road.LinearPolicy", weights=normal(generator, 3, 5), bias=0.1 * normal(generator, 3), discrete=True)


_ROAD = built("control.road.RoadEnv", time_limit=4, gust=0.05, start=0.7)
_ONE_ARRAY = built("control.road.RoadEnv", time_limit=4, gust=0.05, start=0.7, one_array=True)
_OPEN_ROAD = built("control.road.RoadEnv", time_limit=None, gust=0.05, start=0.7)
_LONG_ROAD = built("control.road.RoadEnv", time_limit=80, gust=0.05, start=0.7)
_DISCRETE_ROAD = built("control.road.RoadEnv", time_limit=4, gust=0.05, discrete=True)
_NO_EPISODE = Case("num_episodes = 0", _drive(_ROAD, _driver, num_episodes=0), raises=["num_episodes"], visible=True)


def _episodes(
    policy,
    env,
    num_episodes,
    seed,
    reset=lambda env, seed, episode: env.reset(seed=seed + episode),
    ended=lambda terminated, truncated: terminated or truncated,
    call=lambda policy, obs: policy(obs.unsqueeze(0)).squeeze(0),
    no_graph=torch.no_grad,
    tensor=lambda obs: torch.tensor(obs, dtype=torch.float32),
):
    """The loop of both exercises: each episode's steps, (obs, action, reward, next obs). Every setting is the place of a mistake."""
    episodes = []
    for episode in range(num_episodes):
        (obs, _), steps, over = reset(env, seed, episode), [], False
        while not over:
            before = tensor(obs)
            with no_graph():
                action = call(policy, before)
            obs, reward, terminated, truncated, _ = env.step(action.detach().numpy())
            over = ended(terminated, truncated)
            steps.append((before, action, reward, tensor(obs)))
        episodes.append(steps)
    return episodes


def _paid(episodes, returns):
    """`returns` makes them of the rewards, a list for each episode."""
    return torch.tensor(returns([[reward for _, _, reward, _ in steps] for steps in episodes]))


def _befores(steps):
    return [before for before, *_ in steps]


def _sums(rewards):
    return [sum(episode) for episode in rewards]


_rolled = versions_of(ch74.collect_demonstrations, satisfies(lambda num_episodes: num_episodes >= 1))


def _demonstrations(
    kept=lambda steps: steps,
    obs=_befores,
    returns=_sums,
    change=lambda seen: {},
    checked=True,
    **mistake,
):
    """A version: `obs` of each episode's `kept` steps, and its return; `change` gives fields of the result anew."""

    def version(*given):
        episodes = _episodes(*given, **mistake)
        written = [kept(steps) for steps in episodes]
        seen = Demonstrations(
            torch.stack([row for steps in written for row in obs(steps)]),
            torch.stack([action for steps in written for _, action, *_ in steps]),
            torch.tensor([number for number, steps in enumerate(written) for _ in steps]),
            _paid(episodes, returns),
        )
        return replace(seen, **change(seen))

    return _rolled(version, checked)


def _from_whole_episodes(policy, env, num_episodes, seed):
    episodes = []
    for k in range(num_episodes):
        obs, actions, rewards, ends = [env.reset(seed=seed + k)[0].copy()], [], [], [False]
        while not any(ends):
            with torch.inference_mode():
                actions.append(policy(torch.from_numpy(obs[-1])[None])[0].clone())
            after, reward, *ends, _ = env.step(actions[-1].numpy())
            rewards.append(reward)
            obs.append(after.copy())
        episodes.append((np.stack(obs[:-1]), torch.stack(actions), np.full(len(actions), k), sum(rewards)))
    seen, taken, numbers, returns = zip(*episodes, strict=True)
    rows, ids = (torch.from_numpy(np.concatenate(column)) for column in (seen, numbers))
    return Demonstrations(rows, torch.cat(taken).clone(), ids, returns=torch.tensor(returns, dtype=torch.float32))


def _in_numpy(policy, env, num_episodes, seed):
    table, returns = [], np.zeros(num_episodes, dtype=np.float32)
    for k in range(num_episodes):
        obs, terminated, truncated = env.reset(seed=seed + k)[0], False, False
        while not (terminated or truncated):
            action = policy(torch.as_tensor(obs).reshape(1, -1)).detach().numpy()[0]
            table.append((obs.copy(), action, k))
            obs, reward, terminated, truncated, _ = env.step(action)
            returns[k] += reward
    obs, actions, ids = (torch.from_numpy(np.array(column)) for column in zip(*table, strict=True))
    return Demonstrations(obs, actions, ids, torch.from_numpy(returns))


def _one_step_at_a_time(policy, env, num_episodes, seed):
    """A single loop over steps, that resets in between."""
    rows, rewards, obs = [], [0.0], env.reset(seed=seed)[0]
    while len(rewards) <= num_episodes:
        batch = torch.tensor(np.array([obs]))
        action = policy(batch).detach()
        rows.append((batch, action, torch.tensor([len(rewards) - 1])))
        obs, reward, terminated, truncated, _ = env.step(action[0].numpy())
        rewards[-1] += reward
        if terminated or truncated:
            obs = env.reset(seed=seed + len(rewards))[0]
            rewards.append(0.0)
    obs, actions, ids = (torch.cat(column) for column in zip(*rows, strict=True))
    return Demonstrations(obs, actions, ids, torch.tensor(rewards[:-1]))


# of this exercise and of `evaluate`: settings of the loop, and ways to make returns of rewards
_WRONG_LOOPS = {
    "same-seed-each-episode": (
        {"reset": lambda env, seed, _: env.reset(seed=seed)},
        "All episodes begin alike, on the same road: episode k is reset with seed + k.",
    ),
    "seeded-once": (
        {"reset": lambda env, seed, episode: env.reset(seed=None if episode else seed)},
        "Only the first reset gets a seed: an episode then depends on those before it. Episode k is reset with seed + k.",
    ),
    "truncation-ignored": (
        {"ended": lambda terminated, _: terminated},
        "The loop runs on after a truncated episode: an episode ends when it is terminated *or* truncated.",
    ),
    "termination-ignored": (
        {"ended": lambda _, truncated: truncated},
        "The loop runs on after a terminated episode: an episode ends when it is terminated *or* truncated.",
    ),
    "last-reward-missing": (
        {"returns": lambda rewards: [sum(episode[:-1], 0.0) for episode in rewards]},
        "The reward of the last step is missing: add it before you leave the loop.",
    ),
    "lengths-for-returns": (
        {"returns": lambda rewards: [float(len(episode)) for episode in rewards]},
        "These are the episodes' lengths: add up the rewards.",
    ),
    "batch-axis-missing": (
        {"call": lambda policy, obs: policy(obs)},
        "A policy takes a batch of observations, (B, O): call it with policy(obs.unsqueeze(0)), and take the row out of its answer.",
    ),
}
_DISCOUNTED = (
    {"returns": lambda rewards: [sum(0.99**t * reward for t, reward in enumerate(episode)) for episode in rewards]},
    "Report the undiscounted return: gamma belongs to learning, not to the measurement.",
)
_ADDED_UP = (
    {"returns": lambda rewards: np.cumsum(_sums(rewards)).tolist()},
    "The sum of rewards runs on from episode to episode: set it back to 0 at each reset.",
)
_EPISODES_NEEDED = "num_episodes = 0 asks for nothing: refuse it with a ValueError that names num_episodes."

_WRONG_COLLECT_DEMONSTRATIONS = _WRONG_LOOPS | {
    "returns-discounted": _DISCOUNTED,
    "returns-added-up": _ADDED_UP,
    "obs-not-copied": (
        {"tensor": torch.from_numpy},
        "The environment fills one array anew at every step, and all rows of an episode are its last observation: copy what you keep;"
        " torch.tensor copies, torch.from_numpy and torch.as_tensor do not.",
    ),
    "obs-after-the-action": (
        {"obs": lambda steps: [after for *_, after in steps]},
        "Each row pairs an action with the observation that it led to: pair it with the one that the expert had seen.",
    ),
    "last-obs-included": (
        {"obs": lambda steps: [steps[0][0], *(after for *_, after in steps)]},
        "There are more observations than actions: to the last one of an episode nobody answered. Leave it out.",
    ),
    "last-step-missing": (
        {"kept": lambda steps: steps[:-1]},
        "The rows of the last step are missing: write a step down before you ask whether it was the last.",
    ),
    "actions-clipped": (
        {"change": lambda seen: {"actions": seen.actions.clamp(-1, 1) if seen.actions.ndim > 1 else seen.actions}},
        "Write the actions down as the policy returned them; what the environment makes of them is its own affair.",
    ),
    "ids-from-one": ({"change": lambda seen: {"episode_ids": seen.episode_ids + 1}}, "Episodes are numbered from 0."),
    "steps-numbered": (
        {"change": lambda seen: {"episode_ids": torch.arange(len(seen.obs))}},
        "episode_ids numbers the steps: all steps of one episode share one number.",
    ),
    "batch-axis-kept": (
        {"change": lambda seen: {"obs": seen.obs.unsqueeze(1), "actions": seen.actions.unsqueeze(1)}},
        "Each row still has the axis of its batch of one: take the row out with [0] or squeeze(0), or join rows with torch.cat.",
    ),
    "graph-kept": (
        {"no_graph": torch.enable_grad},
        "The actions carry the expert's graph, the whole network with them: call the policy under torch.no_grad().",
    ),
    "dtype-lost": (
        {"change": lambda seen: {"obs": seen.obs.double(), "returns": seen.returns.double()}},
        "Observations and returns are to be float32, as networks take them; NumPy's own numbers are float64.",
    ),
}

COLLECT_DEMONSTRATIONS = Exercise(
    name="collect_demonstrations",
    reference=ch74.collect_demonstrations,
    criteria={"values": 1.2, "gradient": 0.1, "dtype": 0.1, "errors": 0.1},
    cases=(
        Case("episodes that are cut off", _drive(_ROAD, _driver), visible=True),
        Case("episodes that end off the road", _drive(_OPEN_ROAD, _weak), visible=True),
        Case("commands beyond ±1", _drive(_ROAD, _strong), visible=True),
        Case("discrete commands", _drive(_DISCRETE_ROAD, _three_commands)),
        Case("a single episode", _drive(_ROAD, _driver, num_episodes=1)),
        Case("one step an episode", _drive(built("control.road.RoadEnv", time_limit=1), _driver, num_episodes=4)),
        Case("a road that fills one array anew", _drive(_ONE_ARRAY, _driver), visible=True),
        _NO_EPISODE,
    ),
    misconceptions=(
        *wrong(_WRONG_COLLECT_DEMONSTRATIONS, lambda mistake: _demonstrations(**mistake)),
        bad_input_accepted(_demonstrations(checked=False), _EPISODES_NEEDED),
    ),
    variants={
        "whole episodes joined": _rolled(_from_whole_episodes),
        "rows of arrays": _rolled(_in_numpy),
        "one loop over steps": _rolled(_one_step_at_a_time),
        "the loop with its parts": _demonstrations(),
    },
)

# ------------------------------------------------------------------------------------------------------ split_by_episode


def _steps(lengths, ids=None):
    """Episode ids of episodes with these lengths; numbered from 0 unless `ids` says otherwise."""
    numbers = torch.arange(len(lengths)) if ids is None else torch.as_tensor(ids)
    return numbers.repeat_interleave(torch.as_tensor(lengths))


@drawing
def _split(generator, episode_ids, fraction):
    """`episode_ids` is made from the case's generator."""
    ids = episode_ids(generator)
    return {"episode_ids": ids, "fraction": fraction, "generator": built("seeding.generator", seed=_integer(generator, 10_000))}


def _split_case(name, episode_ids, fraction, **options):
    return Case(name, _split(episode_ids, fraction), **{"view": "episode_split"} | options)


def _even(count, length=7):
    return lambda _generator: _steps([length] * count)


def _one_giant(generator):
    """Thirty episodes of which one holds nearly all steps."""
    lengths = [2] * 30
    lengths[_integer(generator, 30)] = 240
    return _steps(lengths)


def _odd_numbers(generator):
    """Numbers with gaps, and the steps of all episodes mixed."""
    return (5 + 13 * torch.arange(400))[torch.randperm(400, generator=generator)]


_splits = versions_of(
    ch74.split_by_episode,
    satisfies(lambda fraction: 0 <= fraction <= 1),
    satisfies(lambda episode_ids: len(episode_ids.unique()) > 1),
)


def _count(number, fraction):
    return min(max(round(fraction * number), 1), number - 1)


def _shuffled(number, generator):
    return torch.randperm(number, generator=generator)


def _held(ids, fraction, generator, *, episodes=None, count=_count, order=_shuffled):
    """The mask of the steps that are held out; every setting is the place of a mistake."""
    episodes = ids.unique() if episodes is None else episodes
    return torch.isin(ids, episodes[order(len(episodes), generator)[: count(len(episodes), fraction)]])


def _halves(held=_held, sides=lambda held: (~held, held), checked=True):
    """A version: what is `held` out, and the `sides` made of it."""
    return _splits(lambda *given: sides(held(*given)), checked)


def _until_steps(ids, fraction, generator):
    """Episodes are held out until they have the share of the steps."""
    episodes, sizes = ids.unique(return_counts=True)
    order = _shuffled(len(episodes), generator)
    still_short = sizes[order].cumsum(0) < fraction * len(ids)
    return torch.isin(ids, episodes[order[:-1][: 1 + still_short.sum()]])


def _with_a_set(ids, fraction, generator):
    numbers = sorted(set(ids.tolist()))
    keys = torch.rand(len(numbers), generator=generator, dtype=torch.float64).tolist()
    count = max(1, min(len(numbers) - 1, math.ceil(fraction * len(numbers))))
    chosen = {number for _, number in sorted(zip(keys, numbers, strict=True))[:count]}
    return torch.tensor([number in chosen for number in ids.tolist()])


def _with_inverse(ids, fraction, generator):
    episodes, inverse = torch.unique(ids, return_inverse=True)
    count = int(fraction * len(episodes))
    count = 1 if count < 1 else count - (count == len(episodes))
    return torch.randperm(len(episodes), generator=generator)[inverse] < count


def _with_training_episodes(ids, fraction, generator):
    episodes = ids.unique().numpy()
    picks = np.random.default_rng(int(torch.randint(2**31, (), generator=generator)))
    kept = len(episodes) - _count(len(episodes), fraction)
    return torch.from_numpy(~np.isin(ids.numpy(), picks.choice(episodes, size=kept, replace=False)))


_WRONGLY_HELD = {
    "split-by-steps": (
        lambda ids, *rest: _held(torch.arange(len(ids)), *rest),
        "Steps are drawn, not episodes: nearly every episode is on both sides, and neighbours in time are near-copies. Draw episodes.",
    ),
    "cut-through-an-episode": (
        lambda ids, fraction, _: torch.arange(len(ids)) >= len(ids) - _count(len(ids), fraction),
        "The steps are cut at a position, in their order, and an episode may lie on both sides of the cut. Draw whole episodes.",
    ),
    "a-coin-for-each-episode": (
        lambda ids, fraction, generator: (torch.rand(int(ids.max()) + 1, generator=generator) < fraction)[ids],
        "The number of held-out episodes is left to chance, and may be 0: shuffle the episodes and take a fixed number.",
    ),
    "counted-in-steps": (_until_steps, "fraction is a share of the episodes, not of the steps: long and short ones count alike."),
    "rounded-to-none": (
        lambda *given: _held(*given, count=lambda number, fraction: int(fraction * number)),
        "With few episodes the count rounds down to 0, and nothing is held out: at least one episode stays on either side.",
    ),
    "rounded-to-all": (
        lambda *given: _held(*given, count=lambda number, fraction: max(math.ceil(fraction * number), 1)),
        "With few episodes the count rounds up to all, and nothing is left to train on: at least one episode stays on either side.",
    ),
    "numbers-assumed": (
        lambda ids, *rest: _held(ids, *rest, episodes=torch.arange(int(ids.max()) + 1)),
        "The episodes are not always numbered 0, 1, 2, …: find out which numbers occur, with episode_ids.unique().",
    ),
    "not-shuffled": (
        lambda *given: _held(*given, order=lambda number, _generator: torch.arange(number)),
        "It is always the same episodes that are held out, the first ones: draw their order from the generator.",
    ),
    "global-generator": (
        lambda *given: _held(*given, order=lambda number, _generator: torch.randperm(number)),
        "The order comes from the global generator: pass generator=generator, so that a seed makes the split again.",
    ),
    "reseeded-inside": (
        lambda ids, fraction, generator: _held(ids, fraction, generator.manual_seed(0)),
        "The generator is set back at every call, so every split is the same one: use it as it comes.",
    ),
}

_WRONG_SIDES = {
    "sides-swapped": (
        lambda held: (held, ~held),
        "The masks come in the order train, held_out, and fraction is the share of the held-out side.",
    ),
    "held-out-in-training": (
        lambda held: (torch.ones_like(held), held),
        "The held-out steps are trained on as well: the two masks must exclude each other.",
    ),
    "indices-returned": (
        lambda held: ((~held).nonzero().squeeze(1), held.nonzero().squeeze(1)),
        "Bool masks over the steps are asked for, not indices.",
    ),
    "masks-as-numbers": (
        lambda held: ((~held).long(), held.long()),
        "Masks are bool: as numbers, 0 and 1 would be taken for indices.",
    ),
}

SPLIT_BY_EPISODE = Exercise(
    name="split_by_episode",
    reference=ch74.split_by_episode,
    criteria={"values": 1.3, "inputs": 0.1, "errors": 0.1},
    cases=(
        _split_case("ten even episodes, a fifth held out", _even(10), 0.2, visible=True),
        _split_case(
            "forty uneven episodes, a quarter held out",
            lambda generator: _steps(integers(generator, 2, 30, 40)),
            0.25,
            visible=True,
        ),
        _split_case("thirty episodes, one of them a giant", _one_giant, 0.1),
        _split_case("two hundred short episodes, half held out", _even(200, 3), 0.5),
        _split_case("numbers with gaps, steps in any order", _odd_numbers, 0.3, visible=True, draws=3),
        _split_case("episodes in turns", lambda _: torch.arange(12).repeat(5), 0.3),
        _split_case("three episodes, a tenth held out", _even(3), 0.1, visible=True),
        _split_case("five episodes, fraction = 0", _even(5), 0.0),
        _split_case("five episodes, fraction = 1", _even(5), 1.0),
        _split_case("three episodes, nearly all held out", _even(3), 0.95),
        _split_case("two splits in a row", _even(60, 2), 0.5, repeat=2, view="two_splits", visible=True),
        _split_case("the generator is drawn from", _even(20), 0.3, returns=("generator",), view="drawn_from", visible=True),
        Case("fraction = -0.1", _split(_even(5), -0.1), raises=["fraction"]),
        Case("fraction = 20", _split(_even(5), 20.0), raises=["fraction"], visible=True),
        Case("a single episode", _split(_even(1), 0.5), raises=["episode_ids"]),
    ),
    misconceptions=(
        *wrong(_WRONGLY_HELD, _halves),
        *wrong(_WRONG_SIDES, lambda sides: _halves(sides=sides)),
        bad_input_accepted(
            _halves(checked=False),
            "A fraction outside [0, 1] is a percentage or a slip, and one episode cannot be split: refuse both.",
        ),
    ),
    variants={
        "a set of numbers, rounded up": _halves(_with_a_set),
        "ranks of the episodes, rounded down": _halves(_with_inverse),
        "training episodes drawn, by NumPy seeded from the generator": _halves(_with_training_episodes),
        "the reference's way, by parts": _halves(),
    },
)

# ----------------------------------------------------------------------------------------------- behavioural_cloning_loss


@drawing
def _choices(generator, size=24, actions=4, spread=1.5):
    return {"logits": spread * normal(generator, size, actions), "expert_actions": integers(generator, 0, actions, size)}


def _right_by_far(generator):
    """Logits that are sure of the expert's action, and of another one in a few rows."""
    drawn = _choices(9, 5)(generator)
    drawn["logits"] = 0.1 * drawn["logits"] + 900 * F.one_hot((drawn["expert_actions"] + (torch.arange(9) % 3 == 0)) % 5, 5)
    return drawn


_DISCRETE = ("logits", "expert_actions")
_discrete = versions_of(
    ch74.behavioural_cloning_loss,
    satisfies(lambda logits, expert_actions: logits.ndim == 2 and expert_actions.shape == logits.shape[:1]),
)


def _of_expert(x, actions):
    return x.gather(1, actions.reshape(-1, 1)).squeeze(1)


def _by_hand(logits, expert_actions):
    rows = [[number - max(row) for number in row] for row in logits.tolist()]
    taken = zip(rows, expert_actions.tolist(), strict=True)
    surprises = [math.log(sum(map(math.exp, row))) - row[action] for row, action in taken]
    return torch.tensor(sum(surprises) / len(surprises), dtype=torch.float64)


_WRONG_BEHAVIOURAL_CLONING_LOSS = {
    "softmax-twice": (
        lambda x, a: F.cross_entropy(x.softmax(-1), a),
        "cross_entropy applies the softmax itself: hand it the logits, or the loss can never come near 0.",
    ),
    "softmax-missing": (
        lambda x, a: F.nll_loss(x, a),
        "nll_loss takes log-probabilities, and these are logits: use cross_entropy, or log_softmax first.",
    ),
    "log-of-softmax": (
        lambda x, a: -_of_expert(x.softmax(-1).log(), a).mean(),
        "softmax underflows to 0 for an action that the policy finds impossible, and its log is -inf: use log_softmax.",
    ),
    "softmax-over-the-batch": (
        lambda x, a: -_of_expert(x.log_softmax(0), a).mean(),
        "The softmax runs over the batch: actions are the last axis.",
    ),
    "sign-missing": (lambda x, a: -F.cross_entropy(x, a), _SIGN),
    "sum-instead-of-mean": (lambda x, a: F.cross_entropy(x, a, reduction="sum"), _SUM),
    "per-step-losses": (
        lambda x, a: F.cross_entropy(x, a, reduction="none"),
        "One number is asked for: take the mean over the batch.",
    ),
    "mean-over-actions": (
        lambda x, a: -(F.one_hot(a, x.shape[1]) * x.log_softmax(-1)).mean(),
        "The mean also runs over the actions, and divides by A once too often: sum over them, then take the mean over the batch.",
    ),
    "one-minus-probability": (
        lambda x, a: 1 - _of_expert(x.softmax(-1), a).mean(),
        "This is a mean probability: the likelihood of independent steps is a product, whose logarithm adds log-probabilities.",
    ),
    "squared-error": (
        lambda x, a: (x.softmax(-1) - F.one_hot(a, x.shape[1])).square().sum(-1).mean(),
        "This is a squared error against the one-hot action: the loss is the cross-entropy.",
    ),
    "label-smoothing": (
        lambda x, a: F.cross_entropy(x, a, label_smoothing=0.1),
        "The labels are smoothed: the expert's action counts in full.",
    ),
    "bits-for-nats": (
        lambda x, a: F.cross_entropy(x, a) / math.log(2),
        "The logarithm is natural in this course: nats, not bits.",
    ),
    "logits-detached": (
        lambda x, a: F.cross_entropy(x.detach(), a),
        "The loss reaches no parameter: detach only what is data, never the policy's outputs.",
    ),
}

BEHAVIOURAL_CLONING_LOSS = Exercise(
    name="behavioural_cloning_loss",
    reference=ch74.behavioural_cloning_loss,
    criteria={"values": 0.6, "gradient": 0.2, "dtype": 0.05, "inputs": 0.05, "errors": 0.1},
    cases=(
        Case("four actions", _choices(), closed_form=_by_hand, visible=True, draws=3),
        Case("two actions", _choices(10, 2), closed_form=_by_hand),
        Case("no preference: log A", _choices(8, 6, 0.0), closed_form=number(math.log(6)), visible=True),
        Case("logits around 900", _right_by_far, closed_form=_by_hand, visible=True),
        Case("logits that require gradient", _choices(7, 3), differentiate=["logits"], visible=True),
        Case("gradient of logits around 900", _right_by_far, differentiate=["logits"]),
        Case("single precision", _choices(), dtype=torch.float32, visible=True),
        misshapen("expert_actions as a column", _choices(), "expert_actions", lambda x: x[:, None], _DISCRETE, visible=True),
        misshapen("an expert action too few", _choices(), "expert_actions", lambda x: x[:-1], _DISCRETE),
    ),
    misconceptions=(
        *wrong(_WRONG_BEHAVIOURAL_CLONING_LOSS, _discrete),
        *spoilt(ch74.behavioural_cloning_loss, python_float, dtype_lost),
        bad_input_accepted(
            _discrete(lambda x, a: -_of_expert(x.log_softmax(-1), a)[: len(x)].mean(), checked=False),
            "logits must be (B, A) with one expert action for each row, (B,): a column of actions fails late or, worse, not at all.",
        ),
    ),
    variants={
        "log_softmax and gather": _discrete(lambda x, a: -_of_expert(x.log_softmax(-1), a).mean()),
        "logsumexp minus the logit": _discrete(lambda x, a: (x.logsumexp(-1) - x[torch.arange(len(a)), a]).mean()),
        "a categorical distribution": _discrete(lambda x, a: -Categorical(logits=x).log_prob(a).mean()),
        "nll_loss of log_softmax": _discrete(lambda x, a: F.nll_loss(F.log_softmax(x, dim=1), a)),
        "one row at a time": _discrete(
            lambda x, a: torch.stack([torch.logsumexp(row - row[i], 0) for row, i in zip(x, a, strict=True)]).mean()
        ),
        "in double precision": _discrete(lambda x, a: F.cross_entropy(x.double(), a).to(x.dtype)),
    },
)

# -------------------------------------------------------------------------------------------------- gaussian_cloning_loss

_HALF_LOG_TWO_PI = math.log(2 * math.pi) / 2
_PAIR = ("mean", "expert_actions")
_GAUSSIAN = ("mean", "log_std", "expert_actions")


@drawing
def _continuous(generator, size=11, actions=3, per_state=False, log_std=-0.5, spread=0.8):
    mean = normal(generator, size, actions)
    log_stds = log_std + 0.4 * normal(generator, *((size, actions) if per_state else (actions,)))
    taken = mean + spread * log_stds.exp() * normal(generator, size, actions)
    return {"mean": mean, "log_std": log_stds, "expert_actions": taken}


def _perfect(generator):
    """The mean is what the expert did, and σ is 1: only the constant is left."""
    mean = normal(generator, 6, 2)
    return {"mean": mean, "log_std": torch.zeros(2, dtype=torch.float64), "expert_actions": mean}


def _surprise(mean, log_std, actions):
    return ((actions - mean) / log_std.exp()).square() / 2 + log_std + _HALF_LOG_TWO_PI


def _mean_surprise(mean, log_std, actions):
    return _surprise(mean, log_std, actions).sum(-1).mean()


_gaussian = versions_of(
    ch74.gaussian_cloning_loss,
    one_shape(*_PAIR),
    satisfies(lambda log_std, mean: log_std.shape in (mean.shape, mean.shape[1:])),
    data=["expert_actions"],
)


def _gaussian_by_hand(mean, log_std, expert_actions):
    total = 0.0
    for m, s, a in zip(*(x.flatten().tolist() for x in (mean, log_std.expand_as(mean), expert_actions)), strict=True):
        density = math.exp(-((a - m) ** 2) / (2 * math.exp(2 * s))) / (math.exp(s) * math.sqrt(2 * math.pi))
        total -= math.log(density)
    return torch.tensor(total / len(mean), dtype=torch.float64)


_WRONG_GAUSSIAN_CLONING_LOSS = {
    "log-std-taken-as-std": (
        lambda m, s, a: ((a - m) / s).square().div(2).add(s.abs().log()).add(_HALF_LOG_TWO_PI).sum(-1).mean(),
        "log_std is the logarithm of σ: σ = log_std.exp().",
    ),
    "log-std-taken-as-log-variance": (
        lambda m, s, a: _mean_surprise(m, s / 2, a),
        "log_std is log σ, not log σ²: the square is σ² = exp(2 log_std), and log σ enters without a half.",
    ),
    "divided-by-std-once": (
        lambda m, s, a: ((a - m).square() / s.exp() / 2 + s + _HALF_LOG_TWO_PI).sum(-1).mean(),
        "The squared error is divided by σ: divide by σ², or divide the error by σ before squaring.",
    ),
    "log-std-missing": (
        lambda m, s, a: (_surprise(m, s, a) - s).sum(-1).mean(),
        "The term log σ is missing: without it a large σ costs nothing, and training makes it ever larger.",
    ),
    "constant-missing": (
        lambda m, s, a: (_surprise(m, s, a) - _HALF_LOG_TWO_PI).sum(-1).mean(),
        "½ log 2π per action is missing. It changes no gradient, but the number is no longer a log-likelihood in nats.",
    ),
    "constant-once": (
        lambda m, s, a: (_surprise(m, s, a) - _HALF_LOG_TWO_PI).sum(-1).mean() + _HALF_LOG_TWO_PI,
        "½ log 2π belongs to every action component, and counts A times.",
    ),
    "half-missing": (
        lambda m, s, a: (_surprise(m, s, a) + ((a - m) / s.exp()).square() / 2).sum(-1).mean(),
        "The ½ before the squared error is missing.",
    ),
    "mean-over-actions": (
        lambda m, s, a: _surprise(m, s, a).mean(),
        "Components of one action are independent, so their log-likelihoods add up: sum over A, mean over B.",
    ),
    "sum-over-batch": (lambda m, s, a: _surprise(m, s, a).sum(), _SUM),
    "per-step-losses": (lambda m, s, a: _surprise(m, s, a).sum(-1), "One number is asked for: take the mean over B."),
    "sign-missing": (lambda m, s, a: -_mean_surprise(m, s, a), _SIGN),
    "squared-error": (
        lambda m, s, a: (a - m).square().sum(-1).mean(),
        "This is the squared error: right up to a factor while σ is fixed, but log_std has no part in it.",
    ),
    "log-std-detached": (
        lambda m, s, a: _mean_surprise(m, s.detach(), a),
        "No gradient reaches log_std, so σ is never learned: only the expert's actions are data.",
    ),
    "mean-detached": (lambda m, s, a: _mean_surprise(m.detach(), s, a), "No gradient reaches the mean, which is to learn."),
}

GAUSSIAN_CLONING_LOSS = Exercise(
    name="gaussian_cloning_loss",
    reference=ch74.gaussian_cloning_loss,
    criteria={"values": 0.8, "gradient": 0.45, "dtype": 0.05, "inputs": 0.05, "errors": 0.15},
    cases=(
        Case("three actions, one σ each", _continuous(), closed_form=_gaussian_by_hand, visible=True, draws=3),
        Case("a σ for every state", _continuous(per_state=True), closed_form=_gaussian_by_hand, visible=True),
        Case("a perfect clone: A/2 log 2π", _perfect, closed_form=number(math.log(2 * math.pi)), visible=True),
        Case("one action", _continuous(actions=1), closed_form=_gaussian_by_hand),
        Case("as many actions as rows", _continuous(4, 4), closed_form=_gaussian_by_hand),
        Case("σ around e⁻⁸", _continuous(log_std=-8.0), closed_form=_gaussian_by_hand),
        Case("σ around e⁴", _continuous(log_std=4.0), closed_form=_gaussian_by_hand),
        Case("all inputs require gradient", _continuous(), differentiate=_GAUSSIAN, visible=True),
        Case("gradient to a σ for every state", _continuous(per_state=True), differentiate=_GAUSSIAN),
        Case("single precision", _continuous(), dtype=torch.float32, visible=True),
        misshapen(
            "expert_actions with an action too few", _continuous(), "expert_actions", lambda x: x[:, :1], _PAIR, visible=True
        ),
        misshapen("expert_actions of a single row", _continuous(), "expert_actions", lambda x: x[0], _PAIR),
        misshapen("log_std as a column", _continuous(per_state=True), "log_std", lambda x: x[:, :1]),
    ),
    misconceptions=(
        *wrong(_WRONG_GAUSSIAN_CLONING_LOSS, _gaussian),
        Misconception(
            "gradient-into-expert-actions", _gaussian(_mean_surprise, leak=True), "The expert's actions are data: detach them."
        ),
        *spoilt(ch74.gaussian_cloning_loss, python_float, dtype_lost),
        bad_input_accepted(
            _gaussian(_mean_surprise, checked=False),
            "Shapes that differ broadcast silently, (B, 1) against (B, A) or a row against all rows: compare them first.",
        ),
    ),
    variants={
        "a normal distribution": _gaussian(lambda m, s, a: -Normal(m, s.exp()).log_prob(a).sum(-1).mean()),
        "a multivariate normal distribution": _gaussian(
            lambda m, s, a: -MultivariateNormal(m, scale_tril=s.exp().expand_as(m).diag_embed()).log_prob(a).mean()
        ),
        "with the variance": _gaussian(
            lambda m, s, a: 0.5 * ((a - m) ** 2 * (-2 * s).exp() + 2 * s + math.log(2 * math.pi)).sum(dim=1).mean()
        ),
        "gaussian_nll_loss": _gaussian(
            lambda m, s, a: F.gaussian_nll_loss(m, a, (2 * s).exp().expand_as(m), full=True, eps=1e-30, reduction="sum") / len(m)
        ),
        "one row at a time": _gaussian(
            lambda m, s, a: torch.stack([_surprise(x, y, z).sum() for x, y, z in zip(m, s.expand_as(m), a, strict=True)]).mean()
        ),
    },
)

# --------------------------------------------------------------------------------------------------------------- train_bc


@drawing
def _regression(generator, gain=1.0, rows=48, batch_size=48, num_steps=17, noise=0.3):
    """Linear data for a linear network that begins at 0, and squared errors of `gain` times its output."""
    obs = math.sqrt(12) * (uniform(generator, rows, 2) - 0.5)
    if batch_size == 1:  # each row says something about one of the two weights only
        obs = 1.5 * obs.sign() * F.one_hot(torch.arange(rows) % 2)
    signs = integers(generator, 0, 2, 1, 2) * 2 - 1
    errors = noise * normal(generator, rows, 1)
    return {
        "network": built("control.road.LinearPolicy", weights=torch.zeros(1, 2), bias=torch.zeros(1)),
        "loss_fn": built("control.demonstrations.SquaredError", gain=gain),
        "obs": obs,
        "actions": obs @ (1.5 * signs.double()).T + 0.8 + errors,
        "num_steps": num_steps,
        "batch_size": batch_size,
        "learning_rate": 0.15,
        "generator": built("seeding.generator", seed=_integer(generator, 10_000)),
    }


def _lines(generator):
    """The same in single precision, where the network computes."""
    drawn = _regression(num_steps=5)(generator)
    return drawn | {name: drawn[name].float() for name in ("obs", "actions")}


# batches that one pass over the data fills, with a loss that is their size
_COUNTED = replaced(_regression(batch_size=8, num_steps=3), loss_fn=built("control.demonstrations.RowCount"))

_training = versions_of(
    ch74.train_bc, satisfies(lambda num_steps: num_steps >= 1), satisfies(lambda obs, actions: len(obs) == len(actions))
)


def _trained(
    rows=lambda count, batch_size, generator: torch.randperm(count, generator=generator)[:batch_size],
    pair=lambda rows: rows,
    loss=lambda loss_fn, outputs, actions: loss_fn(outputs, actions),
    kept=torch.Tensor.detach,
    result=torch.stack,
    network=lambda network: network,
    steps=lambda num_steps: num_steps,
    rate=lambda learning_rate: learning_rate,
    one_minibatch=False,
    stepping=True,
    clearing=True,
    checked=True,
):
    """A version of the training with plain gradient descent: every setting is the place of a mistake."""

    def version(given, loss_fn, obs, actions, num_steps, batch_size, learning_rate, generator):
        learner = network(given)
        losses: list[torch.Tensor] = []
        for _ in range(steps(num_steps)):
            if not (losses and one_minibatch):
                chosen = rows(len(obs), batch_size, generator)
            current = loss(loss_fn, learner(obs[chosen]), actions[pair(chosen)])
            current.backward()
            losses.append(kept(current))
            for weights in learner.parameters():
                if stepping:
                    weights.data.sub_(weights.grad, alpha=rate(learning_rate))
                if clearing:
                    weights.grad = None
        return result(losses)

    return _training(version, checked)


def _optimised(make, clearing=True):
    """A version with another optimiser and another way to draw a minibatch; correct if gradients are cleared."""

    def version(network, loss_fn, obs, actions, num_steps, batch_size, learning_rate, generator):
        optimizer, losses = make(network.parameters(), lr=learning_rate), torch.zeros(num_steps)
        for step in range(num_steps):
            whole = batch_size >= len(obs)
            chosen = torch.arange(len(obs)) if whole else integers(generator, 0, len(obs), batch_size)
            if clearing:
                optimizer.zero_grad()
            loss = loss_fn(network(obs[chosen]), actions[chosen])
            losses[step] = loss.item()
            loss.backward()
            optimizer.step()
        return losses

    return _training(version)


def _in_epochs(network, loss_fn, obs, actions, num_steps, batch_size, learning_rate, generator):
    """Every row once before any row twice."""
    optimizer = torch.optim.Adam(network.parameters(), lr=learning_rate)
    losses: list[torch.Tensor] = []
    while len(losses) < num_steps:
        for rows in torch.randperm(len(obs), generator=generator).split(batch_size):
            optimizer.zero_grad(set_to_none=False)
            losses.append(loss_fn(network(obs[rows]), actions[rows]))
            losses[-1].backward()
            optimizer.step()
    return torch.stack([loss.detach() for loss in losses[:num_steps]])


def _least_squares(network, loss_fn, obs, actions, **_settings):
    design = torch.cat([obs, torch.ones(len(obs), 1, dtype=obs.dtype)], 1)
    solution = torch.linalg.lstsq(design, actions).solution
    network.weights.data.copy_(solution[:2].T)
    network.bias.data.copy_(solution[2])


_NOT_CLEARED = "Gradients add up from step to step: call optimizer.zero_grad() before each backward()."

_WRONG_TRAIN_BC = {
    "gradients-not-cleared": (_trained(clearing=False), _NOT_CLEARED),
    "gradients-not-cleared-for-adam": (_optimised(torch.optim.Adam, clearing=False), _NOT_CLEARED),
    "all-rows-with-repetition": (
        _trained(rows=lambda count, size, generator: integers(generator, 0, count, min(size, count))),
        "With no more rows than batch_size a step takes each row once: this draws some twice and others not at all.",
    ),
    "no-step": (_trained(stepping=False), "The network never changes: optimizer.step() must follow backward()."),
    "uphill": (
        _trained(loss=lambda loss_fn, outputs, actions: -loss_fn(outputs, actions), kept=lambda loss: -loss.detach()),
        "The loss grows: it is descended, not climbed, and a loss has its minus already.",
    ),
    "batch-size-ignored": (
        _trained(rows=lambda count, _batch_size, generator: torch.randperm(count, generator=generator)),
        "Each step takes all rows: batch_size says how many a minibatch has.",
    ),
    "first-minibatch-only": (
        _trained(one_minibatch=True),
        "The minibatch is drawn once, outside the loop: draw a new one for each step.",
    ),
    "rows-unpaired": (
        _trained(pair=lambda rows: torch.randperm(len(rows))),
        "Observations and actions are drawn separately: use the same indices for both, or no action belongs to its observation.",
    ),
    "learning-rate-ignored": (_trained(rate=lambda _: 3e-3), "The learning rate is fixed: use the argument learning_rate."),
    "loss-fn-ignored": (
        _trained(loss=lambda _loss_fn, outputs, actions: (outputs - actions).square().mean()),
        "This minimises the squared error whatever the caller asks for: use loss_fn.",
    ),
    "copy-trained": (
        _trained(network=copy.deepcopy),
        "A copy is trained, and the caller's network stays as it was: train the network itself, in place.",
    ),
    "epochs-for-steps": (
        _trained(steps=lambda num_steps: 2 * num_steps),
        "There are more losses than num_steps: one gradient step counts as one, not one pass over the data.",
    ),
    "global-generator": (
        _trained(rows=lambda count, batch_size, _generator: torch.randperm(count)[:batch_size]),
        "The minibatches come from the global generator: pass generator=generator.",
    ),
    "a-list-of-numbers": (
        _trained(result=lambda losses: [loss.item() for loss in losses]),
        "Return a tensor of shape (num_steps,): torch.stack or torch.tensor makes one from the list.",
    ),
    "graphs-kept": (
        _trained(kept=lambda loss: loss),
        "The losses carry their graphs, and with them every batch's activations: detach them when you write them down.",
    ),
}

_ROWS = ("obs", "actions")
_TRAINED: dict[str, Any] = {"returns": ("network",)}  # it is looked at after the call
_FITTED: dict[str, Any] = _TRAINED | {"closed_form": _least_squares}

TRAIN_BC = Exercise(
    name="train_bc",
    reference=ch74.train_bc,
    criteria={"values": 0.8, "gradient": 0.05, "inputs": 0.05, "errors": 0.1},
    cases=(
        Case("a linear network on linear data", _regression(), **_FITTED, visible=True, atol=0.6),
        Case("a row at a time, no noise", _regression(batch_size=1, num_steps=48, noise=0.0), **_FITTED, atol=1.0),
        Case("a loss of twice the output", _regression(gain=2.0, num_steps=16), **_TRAINED, atol=0.6),
        Case("the losses on the way", _lines, view="training_curve", dtype=torch.float32, visible=True),
        Case("a loss that counts the rows of its batch", _COUNTED, dtype=torch.float32, visible=True),
        Case(
            "the generator is drawn from",
            _regression(batch_size=5, num_steps=2),
            returns=("generator",),
            view="drawn_from",
            visible=True,
        ),
        Case("num_steps = 0", _regression(num_steps=0), raises=["num_steps"]),
        misshapen("actions with a row too few", _regression(num_steps=2), "actions", lambda x: x[:-1], _ROWS, visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_TRAIN_BC),
        bad_input_accepted(
            _trained(checked=False, result=lambda losses: torch.stack(losses) if losses else torch.zeros(0)),
            "Rows that do not pair up train on wrong actions where no index is out of range: compare the numbers of rows first.",
        ),
    ),
    variants={
        "plain gradient descent": _trained(),
        "gradient descent with Nesterov's momentum": _optimised(
            lambda parameters, lr: torch.optim.SGD(parameters, lr=lr / 2, momentum=0.5, nesterov=True)
        ),
        "AdamW": _optimised(torch.optim.AdamW),
        "epochs": _training(_in_epochs),
    },
)

# --------------------------------------------------------------------------------------------------------------- evaluate


def _returns(returns=_sums, change=lambda returns: returns, checked=True, **mistake):
    return _rolled(lambda *given: change(_paid(_episodes(*given, **mistake), returns)), checked)


def _summed_afterwards(policy, env, num_episodes, seed):
    def rewards(k):
        obs, over = env.reset(seed=seed + k)[0], False
        while not over:
            obs, reward, terminated, truncated, _ = env.step(policy(torch.as_tensor(obs)[None]).detach().numpy()[0])
            over = terminated | truncated
            yield reward

    return torch.tensor([sum(rewards(k)) for k in range(num_episodes)], dtype=torch.float32)


def _in_a_buffer(policy, env, num_episodes, seed):
    returns = torch.zeros(num_episodes)
    for k in range(num_episodes):
        obs, ends = env.reset(seed=seed + k)[0], [False]
        while not any(ends):
            with torch.inference_mode():
                action = policy(torch.from_numpy(obs).unsqueeze(0))[0]
            obs, reward, *ends, _ = env.step(action.numpy())
            returns[k] += reward
    return returns


_WRONG_EVALUATE = _WRONG_LOOPS | {
    "discounted": _DISCOUNTED,
    "added-up": _ADDED_UP,
    "averaged": ({"change": torch.mean}, "One return for each episode is asked for, (E,): average later."),
    "reward-per-step": (
        {"returns": lambda rewards: [sum(episode) / len(episode) for episode in rewards]},
        "A return is a sum of rewards, not their mean.",
    ),
    "a-list-of-numbers": ({"change": torch.Tensor.tolist}, "Return a tensor of shape (E,), not a list of numbers."),
    "dtype-lost": ({"change": torch.Tensor.double}, "The returns are to be float32; NumPy's own numbers are float64."),
}

EVALUATE = Exercise(
    name="evaluate",
    reference=ch74.evaluate,
    criteria={"values": 0.75, "gradient": 0.05, "dtype": 0.1, "errors": 0.1},
    cases=(
        Case("episodes that are cut off", _drive(_ROAD, _driver), visible=True),
        Case("episodes that end off the road", _drive(_OPEN_ROAD, _weak, num_episodes=4), visible=True),
        Case("commands beyond ±1", _drive(_ROAD, _strong)),
        Case("discrete commands", _drive(_DISCRETE_ROAD, _three_commands), visible=True),
        Case("a single episode", _drive(_ROAD, _driver, num_episodes=1)),
        _NO_EPISODE,
    ),
    misconceptions=(
        *wrong(_WRONG_EVALUATE, lambda mistake: _returns(**mistake)),
        bad_input_accepted(_returns(checked=False), _EPISODES_NEEDED),
    ),
    variants={
        "rewards summed afterwards": _rolled(_summed_afterwards),
        "a buffer of returns": _rolled(_in_a_buffer),
        "the returns of demonstrations": _rolled(lambda *given: _from_whole_episodes(*given).returns),
        "the loop with its parts": _returns(),
    },
)

# ------------------------------------------------------------------------------------------------------------ state_shift


@drawing
def _clouds(generator, sizes=(18, 13), dims=4, moved=0.7, widened=1.4):
    """Two samples, the agent's shifted and wider, with units that differ from dimension to dimension."""
    units = torch.tensor([1.0, 30.0, 0.02, 5.0], dtype=torch.float64)[:dims]
    expert, agent = (normal(generator, size, dims) for size in sizes)
    return {"expert_obs": units * expert + 2 * units, "agent_obs": units * (widened * agent + moved) + 2 * units}


def _twice_the_same(generator):
    drawn = _clouds((12, 12))(generator)
    return drawn | {"agent_obs": drawn["expert_obs"].flip(0)}


def _two_points(_generator):
    """Expert at 0 and 2 (deviation √2, or 1 if biased), agent at a third place, always."""
    expert, agent = torch.tensor([[0.0], [2.0]], dtype=torch.float64), torch.full((3, 1), 4.0, dtype=torch.float64)
    return {"expert_obs": expert, "agent_obs": agent}


_SAMPLES = ("expert_obs", "agent_obs")


def _apart(x, y):
    return (x[:, None] - y[None]).square().sum(-1).sqrt()


def _energy(x, y, distance=_apart, cross=2, own=torch.mean):
    return cross * distance(x, y).mean() - own(distance(x, x)) - own(distance(y, y))


_comparable = versions_of(
    ch74.state_shift,
    satisfies(lambda expert_obs, agent_obs: expert_obs.ndim == agent_obs.ndim == 2 and expert_obs.shape[1] == agent_obs.shape[1]),
)


def _shift(formula=_energy, scale=lambda expert, agent: expert.std(0), scale_agent=None, checked=True):
    """A version: `formula` of both samples, after division by `scale`; the agent's by another if it is said."""

    def scaled(expert, agent):
        return formula(expert / scale(expert, agent), agent / (scale_agent or scale)(expert, agent))

    return _comparable(scaled, checked)


def _biased(expert, _agent):
    return expert.std(0, correction=0)


def _shift_by_hand(expert_obs, agent_obs):
    scales = np.std(expert_obs.numpy(), axis=0, ddof=1)
    x, y = expert_obs.numpy() / scales, agent_obs.numpy() / scales

    def mean(a, b):
        return sum(math.dist(p, q) for p in a for q in b) / (len(a) * len(b))

    return torch.tensor(2 * mean(x, y) - mean(x, x) - mean(y, y), dtype=torch.float64)


def _weighted(x, y):
    """One matrix of all distances, with weights +1/N and -1/M: minus a quadratic form."""
    weights = torch.cat([x.new_full((len(x),), 1 / len(x)), x.new_full((len(y),), -1 / len(y))])
    both = torch.cat([x, y])
    return -(weights @ torch.cdist(both, both, compute_mode="donot_use_mm_for_euclid_dist") @ weights)


def _row_by_row(a, b):
    return torch.stack([torch.linalg.vector_norm(row - b, dim=1) for row in a])


_WRONG_FORMULAS = {
    "factor-two-missing": (
        lambda x, y: _energy(x, y, cross=1),
        "The mean distance between the samples counts twice: with once, equal samples are not at distance 0.",
    ),
    "cross-term-only": (
        lambda x, y: _apart(x, y).mean(),
        "This is the mean distance between the samples, which is large for equal samples too: subtract the distances within each.",
    ),
    "self-pairs-excluded": (
        lambda x, y: _energy(x, y, own=lambda d: d.sum() / (len(d) * (len(d) - 1))),
        "Within a sample all ordered pairs count, i = j included: divide by N², not by N (N - 1).",
    ),
    "halves-of-the-pairs": (
        lambda x, y: _energy(x, y, own=lambda d: d.triu().sum() / d.numel()),
        "Ordered pairs: (i, j) and (j, i) both count, and here only one of them does.",
    ),
    "root-taken": (lambda x, y: _energy(x, y).clamp(min=0).sqrt(), "The *squared* energy distance is asked for: take no root."),
    "distances-squared": (
        lambda x, y: _energy(x, y, lambda a, b: _apart(a, b).square()),
        "The distances are squared: then only the means count, and two samples of one mean look equal however they differ.",
    ),
    "city-block": (
        lambda x, y: _energy(x, y, lambda a, b: (a[:, None] - b[None]).abs().sum(-1)),
        "The distance is Euclidean: the root of the sum of squares over the dimensions.",
    ),
    "dimension-by-dimension": (
        lambda x, y: torch.stack([_energy(x[:, [i]], y[:, [i]]) for i in range(x.shape[1])]).mean(),
        "The dimensions are compared one by one, which cannot see how they belong together: use the distance of whole states.",
    ),
    "sign-flipped": (lambda x, y: -_energy(x, y), "The sign is flipped: the distances within are subtracted."),
}

_WRONG_SCALES = {
    "not-scaled": (lambda expert, agent: 1.0, "Nothing is scaled: the dimension with the largest unit decides alone."),
    "scaled-by-the-agent": (
        lambda expert, agent: agent.std(0),
        "Divide both by the *expert's* deviation: with its own, an agent that strays far looks close.",
    ),
    "scaled-by-the-pooled": (
        lambda expert, agent: torch.cat([expert, agent]).std(0),
        "The deviation is that of both samples together, and grows with the shift: use the expert's alone.",
    ),
    "scaled-by-the-variance": (
        lambda expert, agent: expert.var(0),
        "Divide by the standard deviation, not by the variance: the result must not depend on the unit.",
    ),
    "one-scale-for-all": (
        lambda expert, agent: expert.std(),
        "One deviation over all entries is used: each dimension has its own, std(0).",
    ),
}

STATE_SHIFT = Exercise(
    name="state_shift",
    reference=ch74.state_shift,
    also_right=(_shift(scale=_biased),),
    criteria={"values": 1.2, "dtype": 0.1, "inputs": 0.1, "errors": 0.1},
    cases=(
        Case("two clouds", _clouds(), closed_form=_shift_by_hand, visible=True, draws=3),
        Case("equal samples: 0", _twice_the_same, visible=True),
        Case("two points and one, by hand", _two_points, closed_form=_shift_by_hand, visible=True),
        Case("one dimension", _clouds(dims=1), closed_form=_shift_by_hand),
        Case("far apart", _clouds(moved=40.0), closed_form=_shift_by_hand),
        Case("a narrow agent", _clouds((9, 20), widened=0.1, moved=0.0), closed_form=_shift_by_hand),
        Case("single precision", _clouds(), dtype=torch.float32, visible=True),
        misshapen("agent_obs with a dimension too few", _clouds(), "agent_obs", lambda x: x[:, :1], _SAMPLES, visible=True),
        misshapen("agent_obs as a single row", _clouds(), "agent_obs", lambda x: x[0], _SAMPLES),
    ),
    misconceptions=(
        *wrong(_WRONG_FORMULAS, _shift),
        *wrong(_WRONG_SCALES, lambda scale: _shift(scale=scale)),
        Misconception(
            "each-by-its-own",
            _shift(scale_agent=lambda expert, agent: agent.std(0)),
            "Each sample is divided by its own deviation, which hides that one is wider: use the expert's for both.",
        ),
        python_float(ch74.state_shift, NUMBER),
        dtype_lost(ch74.state_shift),
        bad_input_accepted(
            _shift(checked=False),
            "A sample with one dimension, or a single row, broadcasts silently against the other: compare the shapes first.",
        ),
    ),
    variants={
        "all differences at once": _shift(),
        "one quadratic form": _shift(_weighted),
        "cdist with the biased deviation": _shift(lambda x, y: _energy(x, y, torch.cdist), scale=_biased),
        "standardised, one row at a time": _shift(lambda x, y: _energy(x - x.mean(0), y - x.mean(0), _row_by_row)),
        "in double precision": _comparable(lambda expert, agent: _shift()(expert.double(), agent.double()).to(expert.dtype)),
    },
)

# ------------------------------------------------------------------------------------------------------------ dagger_round


@drawing
def _round(generator, env, clone=_weak, expert=_driver, lengths=(3, 2), num_episodes=2):
    """A clone on a road, and demonstrations of which every number is another one."""
    steps = sum(lengths)
    actions = integers(generator, 0, 3, steps) if expert is _three_commands else normal(generator, steps, 1)
    columns = {"obs": normal(generator, steps, 5), "actions": actions, "episode_ids": _steps(lengths)}
    shown = built("control.demonstrations.recorded", **columns, returns=normal(generator, len(lengths)))
    asked = {"clone": clone(generator), "expert": expert(generator), "env": env, "shown": shown}
    return asked | {"num_episodes": num_episodes, "seed": _integer(generator, 10_000)}


_rounds = versions_of(ch74.dagger_round, satisfies(lambda num_episodes: num_episodes >= 1))


def _answered(expert, obs):
    with torch.no_grad():
        return expert(obs)


def _last_first(shown, flown):
    return flown, shown


def _round_of(
    fly=lambda clone, expert, *rest: ch74.collect_demonstrations(clone, *rest),
    asked=lambda expert, flown: _answered(expert, flown.obs),
    sets=lambda shown, flown: (shown, flown),
    ids=lambda shown, flown: torch.cat([shown.episode_ids, flown.episode_ids + len(shown.returns)]),
    change=lambda union: {},
    checked=True,
):
    """A version of the round: who flies, what is asked, which sets are kept. Every setting is the place of a mistake."""

    def version(clone, expert, env, shown, num_episodes, seed):
        flown = fly(clone, expert, env, num_episodes, seed)
        flown = replace(flown, actions=asked(expert, flown))
        kept = sets(shown, flown)
        numbers = ids(shown, flown) if len(kept) > 1 else kept[0].episode_ids
        columns = (torch.cat([getattr(one, name) for one in kept]) for name in ("obs", "actions", "returns"))
        obs, actions, returns = columns
        union = Demonstrations(obs, actions, numbers, returns)
        return replace(union, **change(union))

    return _rounds(version, checked)


def _step_by_step(clone, expert, env, shown, num_episodes, seed):
    """The expert is asked at each step; lists are joined at the end."""
    obs, actions, ids = list(shown.obs), list(shown.actions), shown.episode_ids.tolist()
    returns = shown.returns.tolist()
    for k in range(num_episodes):
        seen, total, over = env.reset(seed=seed + k)[0], 0.0, False
        while not over:
            row = torch.tensor(seen)
            with torch.inference_mode():
                action, answer = clone(row[None])[0], expert(row[None])[0]
            obs.append(row)
            actions.append(answer.clone())
            ids.append(len(returns))
            seen, reward, terminated, truncated, _ = env.step(action.numpy())
            total, over = total + reward, terminated or truncated
        returns.append(total)
    return Demonstrations(torch.stack(obs), torch.stack(actions), torch.tensor(ids), torch.tensor(returns))


def _filled_in(clone, expert, env, shown, num_episodes, seed):
    """New columns of the whole length, filled part by part; the number of the next episode from the old ids."""
    flown = ch74.collect_demonstrations(clone, env, num_episodes, seed)
    old, steps = len(shown.obs), len(shown.obs) + len(flown.obs)
    obs, actions = shown.obs.new_empty(steps, 5), shown.actions.new_empty(steps, *shown.actions.shape[1:])
    obs[:old], obs[old:] = shown.obs, flown.obs
    actions[:old] = shown.actions
    for row, seen in enumerate(flown.obs):
        actions[old + row] = _answered(expert, seen[None])[0]
    ids = torch.cat([shown.episode_ids, flown.episode_ids + shown.episode_ids.max() + 1])
    return Demonstrations(obs, actions, ids, torch.cat([shown.returns, flown.returns]))


def _with_columns(clone, expert, env, shown, num_episodes, seed):
    flown = ch74.collect_demonstrations(clone, env, num_episodes, seed)
    new = vars(replace(flown, actions=expert(flown.obs).detach(), episode_ids=flown.episode_ids + shown.episode_ids[-1] + 1))
    return Demonstrations(**{name: torch.cat([column, new[name]]) for name, column in vars(shown).items()})


def _flown_and_seen_late(clone, _expert, *rest):
    """The clone flies, and what it saw *after* each step is written down."""
    episodes = _episodes(clone, *rest)
    rows = [(after, action, number) for number, steps in enumerate(episodes) for _, action, _, after in steps]
    obs, actions, ids = zip(*rows, strict=True)
    return Demonstrations(torch.stack(obs), torch.stack(actions), torch.tensor(ids), _paid(episodes, _sums))


_WRONG_DAGGER_ROUND = {
    "clones-own-labels": (
        {"asked": lambda _expert, flown: flown.actions},
        "These are the clone's own actions in its own states: trained on them, it learns what it does already. Ask the expert.",
    ),
    "expert-flies": (
        {"fly": lambda _clone, expert, *rest: ch74.collect_demonstrations(expert, *rest)},
        "The expert has flown: these are its states, more demonstrations, and not one state to which the clone's mistakes lead.",
    ),
    "new-rows-only": (
        {"sets": lambda _shown, flown: (flown,)},
        "The demonstrations are gone: the union is trained on, or the clone forgets how the expert begins.",
    ),
    "old-rows-only": ({"sets": lambda shown, _flown: (shown,)}, "Nothing was added: the new rows belong to the result."),
    "new-rows-first": (
        {"sets": _last_first, "ids": lambda shown, flown: torch.cat([flown.episode_ids + len(shown.returns), shown.episode_ids])},
        "The new rows stand before the old: `shown` comes first.",
    ),
    "ids-from-zero-again": (
        {"ids": lambda shown, flown: torch.cat([shown.episode_ids, flown.episode_ids])},
        "The new episodes are numbered from 0 again, and each shares its number with an old one: a split by episodes takes them for one.",
    ),
    "ids-overlap-by-one": (
        {"ids": lambda shown, flown: torch.cat([shown.episode_ids, flown.episode_ids + len(shown.returns) - 1])},
        "The first new episode has the number of the last old one: E episodes are numbered 0 to E - 1, so the next is E.",
    ),
    "ids-count-steps": (
        {"ids": lambda shown, flown: torch.cat([shown.episode_ids, flown.episode_ids + len(shown.obs)])},
        "The new numbers begin at the number of *steps*: E is the number of episodes, len(shown.returns).",
    ),
    "asked-after-the-step": (
        {"fly": _flown_and_seen_late},
        "The expert was asked about the state that came *after* each of the clone's actions: ask about the one it acted in.",
    ),
    "answers-in-disagreement-only": (
        {
            "asked": lambda expert, flown: torch.where(
                _answered(expert, flown.obs) > 0, flown.actions, _answered(expert, flown.obs)
            )
        },
        "Some labels are the clone's: every new row gets the expert's answer.",
    ),
    "seed-off-by-the-old": (
        {"fly": lambda clone, expert, env, count, seed: ch74.collect_demonstrations(clone, env, count, seed + 2)},
        "The new episode k is reset with seed + k, whatever number it gets among the demonstrations.",
    ),
    "one-episode-only": (
        {"fly": lambda clone, expert, env, count, seed: ch74.collect_demonstrations(clone, env, 1, seed)},
        "One episode was flown: num_episodes says how many.",
    ),
    "answers-halfway": (
        {"asked": lambda expert, flown: (_answered(expert, flown.obs) + flown.actions) / 2},
        "The labels lie halfway between the clone's action and the expert's: only the expert's are labels.",
    ),
    "graph-kept": (
        {"asked": lambda expert, flown: expert(flown.obs)},
        "The answers carry the expert's graph: ask it under torch.no_grad().",
    ),
    "dtype-lost": (
        {"change": lambda union: {"obs": union.obs.double(), "returns": union.returns.double()}},
        "Observations and returns are to be float32, as networks take them; NumPy's own numbers are float64.",
    ),
}

DAGGER_ROUND = Exercise(
    name="dagger_round",
    reference=ch74.dagger_round,
    criteria={"values": 1.2, "gradient": 0.1, "dtype": 0.1, "errors": 0.1},
    cases=(
        Case("a clone that drifts off the road", _round(_LONG_ROAD), visible=True),
        Case("episodes that are cut off", _round(_ROAD, _strong), visible=True),
        Case("discrete commands", _round(_DISCRETE_ROAD, _three_commands, _three_commands)),
        Case("a single new episode", _round(_ROAD, num_episodes=1, lengths=(2, 1, 3)), visible=True),
        Case("an expert with a graph", _round(_ROAD, expert=_strong), visible=True),
        Case("a road that fills one array anew", _round(_ONE_ARRAY)),
        Case("num_episodes = 0", _round(_ROAD, num_episodes=0), raises=["num_episodes"], visible=True),
    ),
    misconceptions=(
        *wrong(_WRONG_DAGGER_ROUND, lambda mistake: _round_of(**mistake)),
        bad_input_accepted(
            _rounds(lambda *given: ch74.dagger_round(*given) if given[4] else given[3], checked=False), _EPISODES_NEEDED
        ),
    ),
    variants={
        "step by step": _rounds(_step_by_step),
        "columns filled in": _rounds(_filled_in),
        "column by column": _rounds(_with_columns),
        "the round with its parts": _round_of(),
    },
)

# ---------------------------------------------------------------------------------------------------------- repaired_pairs


@drawing
def _log(generator, lengths=(5, 4, 6), ids=None):
    """A suspect's log: the rows of three episodes, every number in it another one."""
    obs, actions = normal(generator, sum(lengths), 3), normal(generator, sum(lengths), 2)
    return {"obs": obs, "actions": actions, "episode_ids": _steps(lengths, ids)}


_COLUMNS = ("obs", "actions", "episode_ids")
_pairs = versions_of(
    ch74.repaired_pairs, satisfies(lambda obs, actions, episode_ids: len(obs) == len(actions) == len(episode_ids))
)


def _within(ids):
    return ids[1:] == ids[:-1]


def _by_episode(join):
    """`join` gives the two columns of one episode."""

    def choose(obs, actions, ids):
        parts = [join(obs[ids == episode], actions[ids == episode]) for episode in dict.fromkeys(ids.tolist())]
        return tuple(torch.cat(column) for column in zip(*parts, strict=True))

    return choose


def _by_index(obs, actions, ids):
    rows = [m for m in range(len(ids) - 1) if ids[m] == ids[m + 1]]
    return obs[rows], actions[[m + 1 for m in rows]]


def _by_mask(obs, actions, ids):
    last = torch.ones(len(ids), dtype=torch.bool)
    last[:-1] = ids.diff() != 0
    return obs[~last], actions[~last.roll(1)]


def _by_index_select(obs, actions, ids):
    rows = _within(ids).nonzero().flatten()
    return obs.index_select(0, rows), actions.index_select(0, rows + 1)


def _sorted_by_episode(obs, actions, ids):
    order = ids.argsort(stable=True)
    return _by_index(obs[order], actions[order], ids[order])


def _unchecked_pairs(obs, actions, ids):
    size = min(len(obs), len(actions), len(ids))
    return _by_index(obs[:size], actions[:size], ids[:size])


_WRONG_REPAIRED_PAIRS = {
    "as-logged": (
        lambda obs, actions, ids: (obs.clone(), actions.clone()),
        "This is the suspect's log as it is. What is in `obs[t]` when its copy is made: what the driver saw, or what came after?",
    ),
    "shifted-the-wrong-way": (
        lambda obs, actions, ids: (obs[1:][_within(ids)], actions[:-1][_within(ids)]),
        "Now the observations are two steps late: each row of the log holds what came *after* its action.",
    ),
    "the-wrong-way-across-episodes": (
        lambda obs, actions, ids: (obs[1:], actions[:-1]),
        "The observations are late already, and now by two steps; and the last pair of an episode crosses into the next.",
    ),
    "across-episodes": (
        lambda obs, actions, ids: (obs[:-1], actions[1:]),
        "The last observation of an episode is paired with the first action of the next: no pair may cross an end.",
    ),
    "rolled-around": (
        lambda obs, actions, ids: (obs.roll(1, 0), actions),
        "roll pairs the first action with the log's last observation, and each episode's first with the one before: drop these rows.",
    ),
    "rolled-within-episodes": (
        _by_episode(lambda obs, actions: (obs.roll(1, 0), actions)),
        "Each episode's first action is paired with the episode's last observation. What the driver saw is not in the log: drop it.",
    ),
    "first-row-kept": (
        _by_episode(lambda obs, actions: (torch.cat([obs[:1], obs[:-1]]), actions)),
        "Each episode's first action is paired with an observation that came after it. What the driver saw is lost: drop the pair.",
    ),
    "shifted-by-two": (_by_episode(lambda obs, actions: (obs[:-2], actions[2:])), "The log is late by one step, not by two."),
    "last-pairs-dropped": (
        _by_episode(lambda obs, actions: (obs[:-2], actions[1:-1])),
        "The last pair of each episode is missing, although the log holds both its halves.",
    ),
    "first-episode-only": (
        lambda obs, actions, ids: (obs[ids == ids[0]][:-1], actions[ids == ids[0]][1:]),
        "All but the first episode are gone.",
    ),
    "columns-swapped": (lambda *log: _by_index(*log)[::-1], "Return the observations first, then the actions."),
    "episodes-sorted": (_sorted_by_episode, "The rows are sorted by the episodes' numbers: keep the order of the log."),
    "dtype-lost": (lambda *log: tuple(column.float() for column in _by_index(*log)), DTYPE),
}

REPAIRED_PAIRS = Exercise(
    name="repaired_pairs",
    reference=ch74.repaired_pairs,
    criteria={"values": 0.8, "dtype": 0.05, "inputs": 0.05, "errors": 0.1},
    cases=(
        Case("three episodes", _log(), closed_form=_by_index, visible=True),
        Case("a single episode", _log((8,)), closed_form=_by_index, visible=True),
        Case("an episode of one step among others", _log((3, 1, 4, 1)), closed_form=_by_index, visible=True),
        Case("numbers with gaps, out of order", _log((4, 5, 3), [7, 2, 40]), closed_form=_by_index),
        Case("many episodes", _log((3,) * 12), closed_form=_by_index),
        Case("one pair", _log((1, 2, 1)), closed_form=_by_index),
        Case("single precision", _log(), dtype=torch.float32, visible=True),
        misshapen("actions with a row too few", _log(), "actions", lambda x: x[:-1], _COLUMNS, visible=True),
        misshapen("episode_ids with a row too many", _log(), "episode_ids", lambda x: torch.cat([x, x[-1:]]), _COLUMNS),
    ),
    misconceptions=(
        *wrong(_WRONG_REPAIRED_PAIRS, _pairs),
        bad_input_accepted(
            _pairs(_unchecked_pairs, checked=False),
            "Columns of different lengths pair up wrongly, or fail elsewhere: compare their numbers of rows first.",
        ),
    ),
    variants={
        "episode by episode": _pairs(_by_episode(lambda obs, actions: (obs[:-1], actions[1:]))),
        "a list of indices": _pairs(_by_index),
        "masks of first and last rows": _pairs(_by_mask),
        "index_select": _pairs(_by_index_select),
    },
)

EXERCISES = (
    COLLECT_DEMONSTRATIONS,
    SPLIT_BY_EPISODE,
    BEHAVIOURAL_CLONING_LOSS,
    GAUSSIAN_CLONING_LOSS,
    TRAIN_BC,
    EVALUATE,
    STATE_SHIFT,
    DAGGER_ROUND,
    REPAIRED_PAIRS,
)
