"""Chapter 45's PPO on LunarLanderContinuous-v3: what each part contributes, settings tried, and agents with a mistake in them.

Every run ends with 100 episodes of the likeliest actions: the summary has their returns and lengths. "ours" and the agents with a
mistake keep their policies; seed 0 of "ours" also keeps its first and middle policy, and a video of each.

The mistakes (`broken_…`), by which the points for a landing policy are calibrated, are made in "ours". The ablations (`no_…`,
`entropy_bonus`, `rollout_STEPS`, with STEPS of all environments together between updates) and the settings tried (`PARAMETER_VALUE`)
are each one change of "ours_200k", which is "ours" with half as many steps, and is to be compared with them.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import gymnasium as gym
import numpy as np
import torch

from course_lib.control import envs
from course_lib.control.policies import ActorCritic, load_policy, policy_for, save_policy
from course_lib.control.ppo import LANDER_SETTINGS, PPOSettings
from course_lib.figures import videos
from experiments.campaign import Report, Result
from solutions import ch44, ch45

ENVIRONMENT, NUM_ENVS = "LunarLanderContinuous-v3", 16
EPISODES, EVALUATION_SEED, FILMED_SEED = 100, 1_000_000, 7
INFINITE = float("inf")

OURS = LANDER_SETTINGS
SHORT = OURS.but(total_steps=200_000)  # half as long: enough to tell the ablations and the settings tried apart
SETTINGS: dict[str, PPOSettings] = {
    "ours": OURS,
    "ours_200k": SHORT,
    "no_clip": SHORT.but(clip_range=INFINITE),
    "no_gae": SHORT.but(gae_lambda=1.0),  # the return of the whole episode, minus the value
    "no_gae_td": SHORT.but(gae_lambda=0.0),  # one step and the next value
    "no_normalisation": SHORT.but(normalize_advantages=False),
    "entropy_bonus": SHORT.but(ent_coef=0.01),
    "rollout_512": SHORT.but(num_steps=512 // NUM_ENVS),
    "rollout_2048": SHORT.but(num_steps=2048 // NUM_ENVS),
    "rollout_16384": SHORT.but(num_steps=16384 // NUM_ENVS),
}
MISTAKES: dict[str, Callable[[], list]] = {}


def mistake(function):
    """Registers a mistake as the variant `broken_NAME`: a function that gives the patches of ch45 that make it."""
    MISTAKES[f"broken_{function.__name__}"] = function
    return function


@mistake
def terminated_ignored():
    """The value of what follows a crash or a landing is bootstrapped, as if the flight went on."""

    def compute_gae(rewards, values, next_values, terminated, truncated, *discounts):
        return ch44.compute_gae(rewards, values, next_values, torch.zeros_like(terminated), terminated | truncated, *discounts)

    return [mock.patch.object(ch45, "compute_gae", compute_gae)]


@mistake
def sign_flipped():
    """The policy descends the objective."""
    return [_with_batch(lambda batch, *others: replace(batch, advantages=-batch.advantages))]


@mistake
def ratio_inverted():
    """The ratio is that of the old policy to the new one."""

    def gradient(log_probs, old_log_probs, *others):
        metrics, d_log_ratio = correct(old_log_probs, log_probs, *others)
        return metrics, -d_log_ratio

    correct = ch45.clipped_surrogate_gradient
    return [mock.patch.object(ch45, "clipped_surrogate_gradient", gradient)]


@mistake
def mean_action():
    """The log-probabilities are those of the likeliest actions, not of the ones taken."""

    def changed(batch, settings, policy):
        actions = policy.best_action(batch.obs)
        with torch.no_grad():
            old_log_probs, _, _ = ch45.evaluate_actions(policy, batch.obs, actions)
        return replace(batch, actions=actions, old_log_probs=old_log_probs)

    return [_with_batch(changed)]


@mistake
def returns_from_normalised():
    """The critic's targets are made of advantages that are normalised already."""

    def lambda_returns(advantages, values):
        return ch44.lambda_returns(ch44.normalize_advantages(advantages), values)

    return [mock.patch.object(ch45, "lambda_returns", lambda_returns)]


@mistake
def misaligned():
    """Advantages are flattened environment by environment, everything else step by step."""

    def changed(batch, settings, policy):
        return replace(batch, advantages=batch.advantages.view(settings.num_steps, -1).T.flatten())

    return [_with_batch(changed)]


@mistake
def executed():
    """The actions stored are those executed, clipped to the engines' bounds, and the log-probabilities are theirs."""

    def changed(batch, settings, policy):
        actions = batch.actions.clamp(-1, 1)
        with torch.no_grad():
            old_log_probs, _, _ = ch45.evaluate_actions(policy, batch.obs, actions)
        return replace(batch, actions=actions, old_log_probs=old_log_probs)

    return [_with_batch(changed)]


@mistake
def rewards_centred():
    """The mean reward of each rollout is taken from every step's, which is what normalised targets do to a critic."""

    def compute_gae(rewards, *others):
        return ch44.compute_gae(rewards - rewards.mean(), *others)

    return [mock.patch.object(ch45, "compute_gae", compute_gae)]


def _with_batch(change):
    """A patch of ch45 that changes every batch before it is learned from."""
    estimate = ch45.estimate

    def changed(policy, rollout, settings, reward=None):
        batch, explained = estimate(policy, rollout, settings, reward)
        return change(batch, settings, policy), explained

    return mock.patch.object(ch45, "estimate", changed)


TRIED = {"learning_rate": 3e-4, "clip_range": 0.4, "gae_lambda": 0.9, "minibatch_size": 2048, "num_epochs": 4}
SETTINGS |= {f"{name}_{value:g}": SHORT.but(**{name: value}) for name, value in TRIED.items()}
SETTINGS |= dict.fromkeys(MISTAKES, OURS)


def _configuration(variant: str) -> dict:
    chosen = {name: "infinity" if value == INFINITE else value for name, value in asdict(SETTINGS[variant]).items()}
    about = {"environment": ENVIRONMENT, "num_envs": NUM_ENVS, "evaluation_episodes": EPISODES}
    told = {"mistake": (MISTAKES[variant].__doc__ or "").strip()} if variant in MISTAKES else {}
    return about | told | chosen


VARIANTS = {variant: _configuration(variant) for variant in SETTINGS}
CLOSE = ("ours_200k", "no_clip", "no_gae", "no_normalisation")  # five seeds do not tell them apart
SEEDS = dict.fromkeys(SETTINGS, 5) | dict.fromkeys(CLOSE, 10) | {"ours": 20, "broken_rewards_centred": 3}


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train one agent and fly it. A run of a few minutes keeps no checkpoint: a landing in progress can't be saved."""
    settings, training = SETTINGS[variant], envs.make(ENVIRONMENT, NUM_ENVS)
    policy = policy_for(training, settings.hidden, settings.log_std, seed)
    stages = {"first": _content(policy)}
    rows: list[dict] = []

    def log(row: dict) -> None:
        rows.append({name: value for name, value in row.items() if name != "seconds"})
        if "middle" not in stages and 2 * row["env_steps"] >= settings.total_steps:
            stages["middle"] = _content(policy)
        report(row["env_steps"], settings.total_steps)

    with ExitStack() as patches:
        for patch in MISTAKES.get(variant, list)():
            patches.enter_context(patch)
        ch45.train_ppo(training, settings, seed, policy, log=log, update=ch45.fast_ppo_update)
    returns, lengths = fly(policy, EPISODES, EVALUATION_SEED)
    summary = {"eval_returns": [round(value, 2) for value in returns], "eval_lengths": lengths}
    artefacts = {}
    if variant == "ours" or variant in MISTAKES:
        artefacts["safetensors"] = _content(policy)
    if variant == "ours" and seed == 0:
        stages["final"] = _content(policy)
        for stage, content in stages.items():
            artefacts |= {f"{stage}.{suffix}": part for suffix, part in _filmed(content).items()}
        artefacts |= {f"{stage}.safetensors": stages[stage] for stage in ("first", "middle")}
    return Result(rows, summary, artefacts)


def fly(policy: ActorCritic, episodes: int, seed: int, num_envs: int = 20) -> tuple[list[float], list[int]]:
    """Undiscounted returns and lengths of episodes with the likeliest actions; `episodes` is a multiple of `num_envs`."""
    flying = envs.make(ENVIRONMENT, num_envs)
    obs, _ = flying.reset(seed=seed)
    totals, steps = np.zeros(num_envs), np.zeros(num_envs, int)
    returns: list[list[float]] = [[] for _ in range(num_envs)]
    lengths: list[list[int]] = [[] for _ in range(num_envs)]
    while min(map(len, returns)) < episodes // num_envs:
        obs, rewards, terminated, truncated, _ = flying.step(_clipped(policy.best_action(obs)))
        totals += rewards
        steps += 1
        for i in np.flatnonzero(terminated | truncated):
            returns[i].append(float(totals[i]))
            lengths[i].append(int(steps[i]))
            totals[i], steps[i] = 0, 0
    kept = range(episodes // num_envs)  # the same number from each: the first to end would be the short ones
    return [one[i] for one in returns for i in kept], [one[i] for one in lengths for i in kept]


def _clipped(actions: torch.Tensor) -> np.ndarray:
    return actions.numpy().clip(-1, 1)


def _content(policy: ActorCritic) -> bytes:
    """A policy's file."""
    with TemporaryDirectory() as folder:
        save_policy(policy, Path(folder) / "policy.safetensors")
        return (Path(folder) / "policy.safetensors").read_bytes()


def _filmed(content: bytes) -> dict[str, bytes]:
    """A video of one episode of the policy in a file, and the video's poster, by their suffixes."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "policy.safetensors").write_bytes(content)
        policy = load_policy(folder / "policy.safetensors")
        stage = gym.make(ENVIRONMENT, render_mode="rgb_array")
        frames, _ = videos.film(lambda obs: _clipped(policy.best_action(obs)), stage, FILMED_SEED)
        videos.save(frames, folder / "video.mp4", poster=len(frames) // 3)
        return {suffix: (folder / f"video.{suffix}").read_bytes() for suffix in ("mp4", "webp")}
