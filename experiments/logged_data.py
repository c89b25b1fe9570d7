"""SAC on Pendulum from a log alone: what it learns from 5,000 steps that somebody else made, without a step of its own.

A variant says who made them. `replay`: SAC while it trained, from its first even actions on. `even`: actions drawn evenly. `trained`: the
policy that such a training ends with, its noise included. `disturbed`: the same policy, but for one action in ten, by chance, which is
drawn evenly. Then a new agent, with the settings of experiments/sensitivity.py, makes 5,000 updates on batches of that log.

Policies are evaluated as in experiments/control.py, and what the critics believe is set beside what comes as in
experiments/soft_actor_critic.py; neither adds to the log. `data_return` of the summary is the mean return of the log's episodes.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from course_lib.control import sac
from course_lib.control.replay import ReplayBuffer
from experiments.campaign import Report, Result
from experiments.control import evaluate
from experiments.sensitivity import ENVIRONMENT, SAC
from experiments.soft_actor_critic import TAUGHT, beliefs
from solutions import ch48

OBS_DIM, TORQUE = 3, [2.0]  # of Pendulum: what is seen, and the bounds of what is sent
UPDATES, EVERY = SAC.total_steps, 1_000  # in all, and between evaluations
EVEN = {"even": 1.0, "trained": 0.0, "disturbed": 0.1}  # share of actions that are drawn evenly
VARIANTS: dict[str, dict[str, Any]] = {
    variant: {"environment": ENVIRONMENT, "updates": UPDATES, "every": EVERY, "even": EVEN.get(variant)} | asdict(SAC)
    for variant in ("replay", *EVEN)
}
SEEDS = 5
LATER = 1_000  # seeds of the log and of the agent that learns from it are the run's and this


def online(seed: int) -> tuple[sac.Training, float]:
    """A whole training in the environment, and the mean return of its episodes."""
    training = sac.Training(gym.make(ENVIRONMENT), SAC, seed, TAUGHT, ch48.fast_sac_update)
    return training, training.advance(SAC.total_steps)["mean_return"]


def logged(agent: sac.Agent, share: float, seed: int) -> tuple[ReplayBuffer, float]:
    """Steps of a policy with its noise, a share of its actions replaced by even ones, and the mean return of the episodes."""
    env, generator = gym.make(ENVIRONMENT), torch.Generator().manual_seed(seed)
    buffer = ReplayBuffer(SAC.total_steps, OBS_DIM, len(TORQUE))
    obs, running, returns = env.reset(seed=seed)[0], 0.0, []
    for _ in range(SAC.total_steps):
        actions = agent.act(obs[None], generator)
        if torch.rand((), generator=generator) < share:
            actions = 2 * torch.rand(actions.shape, generator=generator) - 1
        next_obs, reward, terminated, truncated, _ = env.step(agent.scaled(actions)[0].numpy())
        buffer.add(obs[None], actions, [reward], next_obs[None], [terminated])
        obs, running = next_obs, running + float(reward)
        if terminated or truncated:
            returns.append(running)
            obs, running = env.reset()[0], 0.0
    return buffer, float(np.mean(returns))


def new_agent(seed: int) -> sac.Agent:
    """An agent that has learnt nothing."""
    return sac.Agent(OBS_DIM, [-torque for torque in TORQUE], TORQUE, SAC, seed)


def log_of(variant: str, seed: int) -> tuple[ReplayBuffer, float]:
    """The steps that a variant learns from, and the mean return of their episodes."""
    if variant == "replay":
        training, data_return = online(seed)
        return training.buffer, data_return
    agent = new_agent(seed) if variant == "even" else online(seed)[0].agent
    return logged(agent, EVEN[variant], LATER + seed)


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Make a log and learn from it; it takes seconds, so that no checkpoint is kept."""
    buffer, data_return = log_of(variant, seed)
    agent, generator = new_agent(LATER + seed), torch.Generator().manual_seed(seed)
    rows: list[dict[str, Any]] = []
    for update in range(1, UPDATES + 1):
        told = ch48.fast_sac_update(agent, buffer.sample(SAC.batch_size, generator), SAC, TAUGHT, generator)
        if update % EVERY == 0:
            row: dict[str, Any] = {"updates": update} | {name: metric.item() for name, metric in told.items()}
            row["eval_return"] = float(np.mean(evaluate(agent.best_action, ENVIRONMENT)))
            rows.append(row | beliefs(agent, lambda q: q.amin(0), SAC.gamma))
            report(update, UPDATES)
    return Result(rows, {"data_return": data_return, "final_return": rows[-1]["eval_return"]})
