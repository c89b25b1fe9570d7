"""SAC on Pendulum with one part taken away or changed, and what its critics believe beside what their actions bring.

A variant is `reference`, the setting `sac` of experiments/sensitivity.py, or the same with one change: a single critic is asked, the
temperature is fixed, the slow copies are copied at once, the buffer forgets; rewards are multiplied by a number, once with the
temperature's loss of Stable-Baselines3, log α in place of α (`rewards_0.01_log_alpha`). `ratio_5` makes five updates after each step,
`one_critic_5` does so with a single critic, and `redq_5` is the sibling that is made for it, of Chen et al. (2021), algorithm 1,
https://arxiv.org/abs/2101.05982: ten critics, of which two drawn at random make a target, and one step of the policy, against the mean of
all ten, after five of the critics.

Policies are evaluated as in experiments/control.py. Beside that, each evaluation plays ten episodes with the policy's own noise:
`predicted` is what the critics say of the first hundred actions of each, as the policy is told it, and `realised` the discounted soft
return that followed, wages at the temperature of the time. Evaluation is not in the processor time that the rows tell.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from course_lib.control import sac
from course_lib.control.networks import Adam, Networks
from experiments.campaign import Report, Result
from experiments.control import EPISODES, EVALUATION_SEED, evaluate
from experiments.sensitivity import SAC as REFERENCE
from solutions import ch47

ENVIRONMENT, EVERY = "Pendulum-v1", 250  # environment steps between evaluations
STEPS, JUDGED = 200, 100  # of an episode, and how many of its actions are judged: later ones have too little future left
CRITICS = 10  # of REDQ

SCALES = (0.01, 0.1, 10.0, 100.0)
CHANGES: dict[str, dict[str, Any]] = {
    "reference": {},
    "one_critic": {"asked": "first"},
    "alpha_0.01": {"initial_alpha": 0.01, "adapts": False},
    "alpha_0.1": {"initial_alpha": 0.1, "adapts": False},
    "alpha_1": {"initial_alpha": 1.0, "adapts": False},
    "tau_1": {"tau": 1.0},
    "buffer_64": {"buffer_size": 64},
    "buffer_500": {"buffer_size": 500},
    "ratio_5": {"updates": 5},
    "one_critic_5": {"updates": 5, "asked": "first"},
    "redq_5": {"updates": 5, "asked": "mean of ten"},
    "lab_suspect": {"follow": "by masks"},
    **{f"rewards_{scale:g}": {"reward_scale": scale} for scale in SCALES},
    "rewards_0.01_log_alpha": {"reward_scale": 0.01, "priced": "log alpha"},
}
OURS = {"asked": "smaller of two", "adapts": True, "updates": 1}  # what SACSettings does not have
VARIANTS: dict[str, dict[str, Any]] = {
    variant: {"environment": ENVIRONMENT, "every": EVERY} | asdict(REFERENCE) | OURS | changes
    for variant, changes in CHANGES.items()
}
FEWER = {variant: 3 for variant in CHANGES if variant.startswith("rewards")}
FEWER |= {"ratio_5": 3, "one_critic_5": 3, "redq_5": 3, "lab_suspect": 5}  # runs of the first three take a minute of a core each
SEEDS = {variant: FEWER.get(variant, 10) for variant in CHANGES}
TAUGHT = sac.Taught.of(vars(ch47))


def first_alone() -> sac.Taught:
    """The functions of the chapter, told the first critic's values in place of the second's."""

    def target(rewards, terminated, next_q1, next_q2, *others):
        return TAUGHT.soft_q_target(rewards, terminated, next_q1, next_q1, *others)

    def actor_loss(q1, q2, log_probs, alpha):
        return TAUGHT.sac_actor_loss(q1, q1, log_probs, alpha)

    return replace(TAUGHT, soft_q_target=target, sac_actor_loss=actor_loss)


def by_log_alpha() -> sac.Taught:
    """The functions of the chapter, but for the temperature's loss, which multiplies by log α, as in Stable-Baselines3."""

    def loss(log_alpha, log_probs, target_entropy):
        return -(log_alpha * (log_probs.detach() + target_entropy)).mean()

    return replace(TAUGHT, temperature_loss=loss)


def by_masks(first: torch.Tensor) -> sac.Taught:
    """The functions of the chapter, but for the bug lab's way to let the slow copies follow; `first` are the first critic's weights."""

    def follow(targets, online, tau):
        for target, ours in zip(targets, online, strict=True):
            TAUGHT.polyak_update([target[first]], [ours[first]], tau)
            TAUGHT.polyak_update([target[~first]], [ours[~first]], tau / 2)

    return replace(TAUGHT, polyak_update=follow)


def all_values(critics: Networks, obs, actions, learn=True) -> torch.Tensor:
    """What each critic says: (critics, B)."""
    return critics(torch.cat([obs, actions], -1), learn).squeeze(-1)


class Ensemble(sac.Agent):
    """SAC's agent with ten critics."""

    def __init__(self, obs_dim, low, high, settings, seed=0):
        super().__init__(obs_dim, low, high, settings, seed)
        sizes, generator = self.critics.sizes, torch.Generator().manual_seed(seed)
        self.critics = Networks(sizes, copies=CRITICS, generator=generator)
        self.targets = self.critics.frozen_copy()
        self.critics_optimizer = Adam(self.critics.weights, settings.learning_rate)


def critics_update(agent, batch, settings, generator) -> torch.Tensor:
    """One step of all critics towards a target by two of their slow copies, drawn at random."""
    alpha = agent.log_alpha.detach().exp()
    with torch.no_grad():
        next_actions, next_log_probs = agent.sample(batch.next_obs, generator, TAUGHT.squashed_gaussian_log_prob)
        pair = torch.randperm(CRITICS, generator=generator)[:2]
        next_q1, next_q2 = all_values(agent.targets, batch.next_obs, next_actions)[pair]
    targets = TAUGHT.soft_q_target(batch.rewards, batch.terminated, next_q1, next_q2, next_log_probs, alpha, settings.gamma)
    critic_loss = (all_values(agent.critics, batch.obs, batch.actions) - targets).square().mean(1).sum()
    sac.minimise(critic_loss, agent.critics_optimizer)
    TAUGHT.polyak_update([agent.targets.weights], [agent.critics.weights], settings.tau)
    return critic_loss.detach()


def policy_update(agent, batch, generator) -> dict[str, torch.Tensor]:
    """One step of the policy against the mean of all critics, and one of the temperature."""
    alpha = agent.log_alpha.detach().exp()
    actions, log_probs = agent.sample(batch.obs, generator, TAUGHT.squashed_gaussian_log_prob)
    q = all_values(agent.critics, batch.obs, actions, learn=False).mean(0)
    loss = TAUGHT.sac_actor_loss(q, q, log_probs, alpha) + TAUGHT.temperature_loss(
        agent.log_alpha, log_probs, agent.target_entropy
    )
    sac.minimise(loss, agent.actor_optimizer, agent.temperature_optimizer)
    return {"q": q.detach().mean(), "entropy": -log_probs.detach().mean(), "alpha": alpha}


class Several(sac.Training):
    """SAC with several updates after each step, each on a batch of its own."""

    updates = 5

    def learn(self):
        for _ in range(self.updates):
            told = super().learn()
        return told


class REDQ(Several):
    """Ten critics and one step of the policy after several of the critics."""

    def __init__(self, env, settings, seed, taught):
        super().__init__(env, settings, seed, taught)
        self.agent = Ensemble(len(self.obs), env.action_space.low, env.action_space.high, settings, seed)

    def learn(self):
        for _ in range(self.updates):
            batch = self.buffer.sample(self.settings.batch_size, self.generator)
            critic_loss = critics_update(self.agent, batch, self.settings, self.generator)
        return {"critic_loss": critic_loss} | policy_update(self.agent, batch, self.generator)


def world(scale: float) -> gym.Env:
    """The environment, its rewards multiplied."""
    env = gym.make(ENVIRONMENT)
    return env if scale == 1 else gym.wrappers.TransformReward(env, lambda reward: scale * float(reward))


def made(variant: str, seed: int) -> tuple[sac.Training, Callable]:
    """A variant's training, and what its policy is told of the values of several critics, (critics, B) -> (B,)."""
    changes: dict[str, Any] = OURS | CHANGES[variant]
    chosen = {field.name for field in fields(REFERENCE)}
    settings = REFERENCE.but(**{name: value for name, value in CHANGES[variant].items() if name in chosen})
    env = world(changes.get("reward_scale", 1.0))
    if changes["asked"] == "mean of ten":
        return REDQ(env, settings, seed, TAUGHT), lambda q: q.mean(0)
    kind = Several if changes["updates"] > 1 else sac.Training
    alone = changes["asked"] == "first"
    training = kind(env, settings, seed, first_alone() if alone else TAUGHT)
    if not changes["adapts"]:
        training.agent.temperature_optimizer.learning_rate = 0.0
    if "priced" in changes:
        training.taught = by_log_alpha()
    if "follow" in changes:
        weights = len(training.agent.targets.weights)
        training.taught = by_masks(torch.arange(weights) < weights // 2)
    return training, (lambda q: q[0]) if alone else (lambda q: q.amin(0))


@torch.no_grad()
def beliefs(agent: sac.Agent, told: Callable, gamma: float, scale: float = 1.0) -> dict[str, float]:
    """Of the policy's own actions: what the critics predict, and the discounted soft return that follows."""
    generator = torch.Generator().manual_seed(EVALUATION_SEED)
    stages = [world(scale) for _ in range(EPISODES)]
    obs = np.stack([stage.reset(seed=EVALUATION_SEED + i)[0] for i, stage in enumerate(stages)])
    predicted, rewards, log_probs = [], [], []
    for _ in range(STEPS):
        seen = torch.as_tensor(obs)
        actions, log_prob = agent.sample(seen, generator, TAUGHT.squashed_gaussian_log_prob)
        predicted.append(told(all_values(agent.critics, seen, actions)))
        log_probs.append(log_prob)
        made_steps = [stage.step(action) for stage, action in zip(stages, agent.scaled(actions).numpy(), strict=True)]
        obs = np.stack([step[0] for step in made_steps])
        rewards.append(torch.tensor([float(step[1]) for step in made_steps]))
    alpha, following, realised = agent.log_alpha.exp(), torch.zeros(EPISODES), []
    for reward, log_prob in zip(reversed(rewards), reversed(log_probs), strict=True):
        realised.append(reward + gamma * following)  # of an action: its reward, and the soft value of what follows
        following = realised[-1] - alpha * log_prob
    judged = {"predicted": predicted[:JUDGED], "realised": realised[::-1][:JUDGED]}
    return {name: torch.stack(values).mean().item() for name, values in judged.items()}


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train one agent and evaluate it on the way; it takes seconds, so that no checkpoint is kept."""
    training, told = made(variant, seed)
    scale = CHANGES[variant].get("reward_scale", 1.0)
    rows: list[dict[str, Any]] = []
    spent = 0.0
    while training.env_steps < training.settings.total_steps:
        begun = time.process_time()
        row: dict[str, Any] = training.advance(EVERY)
        spent += time.process_time() - begun
        row |= {"train_cpu_seconds": spent, "eval_return": float(np.mean(evaluate(training.agent.best_action, ENVIRONMENT)))}
        rows.append(row | beliefs(training.agent, told, training.settings.gamma, scale))
        report(training.env_steps, training.settings.total_steps)
    return Result(rows, {"final_return": rows[-1]["eval_return"]})
