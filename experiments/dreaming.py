"""A small Dreamer on Pendulum: an actor that learns by gradients through a learned ensemble, along dreams of ten steps.

The program of chapter 51's last experiment on Pendulum, evaluated as all agents of `control` are. "lam_0" asks the critic after each
dreamt step, where "dreamer" waits longer; "pulled" adds to the policy's loss a little of its squared pre-activations, so that its tanh
does not saturate. One update for each real step; rows are evaluations.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from course_lib.control import mbpo
from course_lib.control.networks import Adam, Networks
from course_lib.control.replay import ReplayBuffer
from course_lib.control.sac import minimise
from experiments.campaign import Report, Result
from experiments.control import EPISODES, evaluate
from solutions.ch51 import dreamer_lambda_returns, gaussian_nll, imagine

ENVIRONMENT = "Pendulum-v1"
STEPS, EVERY = 1000, 100
DREAMER: dict[str, Any] = {
    "environment": ENVIRONMENT, "steps": STEPS, "evaluation_episodes": EPISODES, "hidden": 64, "learning_starts": 200,
    "refresh_every": 100, "batch_size": 64, "horizon": 10, "gamma": 0.95, "lam": 0.95, "reward_scale": 0.1, "tau": 0.02,
    "actor_learning_rate": 1e-3, "critic_learning_rate": 3e-3, "noise": 0.3,
}  # fmt: skip
VARIANTS: dict[str, dict[str, Any]] = {"dreamer": DREAMER, "lam_0": DREAMER | {"lam": 0.0}, "pulled": DREAMER | {"pull": 0.01}}
SEEDS = {"dreamer": 8, "lam_0": 4, "pulled": 8}


def differentiable(model):
    """The elite members' mean as a world: gradient passes from outputs to inputs."""

    def step(obs, actions, generator):
        inputs = (torch.cat([obs, actions], -1) - model.input_level) / model.input_scale
        mean, _ = model.networks(inputs, learn=False).chunk(2, -1)
        change = model.target_level + model.target_scale * mean[model.elites].mean(0)
        return obs + change[:, :-1], change[:, -1], torch.ones(len(obs))

    return step


def value(critic, obs):
    """Of states (H, B, O): (H, B)."""
    return critic(obs.flatten(0, 1))[0].view(obs.shape[:2])


class Dreamer:
    """A policy and a critic that learn from nothing but dreams."""

    def __init__(self, seed, lam=0.95, pull=0.0):
        generator, self.lam, self.pull = torch.Generator().manual_seed(seed), lam, pull
        self.actor = Networks((3, 64, 64, 1), generator=generator)
        self.critic = Networks((3, 64, 64, 1), generator=generator)
        self.slow = self.critic.frozen_copy()
        self.of_actor = Adam(self.actor.weights, 1e-3)
        self.of_critic = Adam(self.critic.weights, 3e-3)

    def act(self, obs, generator=None):
        return self.actor(obs)[0].tanh()

    def learn(self, world, starts, generator):
        dream = imagine(world, self.act, starts, 10, generator)
        values = value(self.slow, dream["obs"][1:])
        rewards, continues = 0.1 * dream["rewards"], dream["continues"]
        returns = dreamer_lambda_returns(rewards, values, continues, 0.95, self.lam)
        loss = -returns.mean()
        if self.pull:
            seen = dream["obs"][:-1].detach().flatten(0, 1)
            loss = loss + self.pull * self.actor(seen)[0].square().mean()
        minimise(loss, self.of_actor)
        guesses = value(self.critic, dream["obs"][:-1].detach())
        minimise((guesses - returns.detach()).square().mean(), self.of_critic)
        self.slow.weights.lerp_(self.critic.weights.detach(), 0.02)


def dreaming(seed, steps=1000, lam=0.95, pull=0.0):
    """After every 100 steps in the world: how many there were, and the agent."""
    env, generator = gym.make("Pendulum-v1"), torch.Generator().manual_seed(seed)
    model = mbpo.Ensemble(3, 1, mbpo.MBPOSettings(), gaussian_nll, seed=seed)
    agent, buffer = Dreamer(seed, lam, pull), ReplayBuffer(steps, 3, 1)
    for step in range(1, steps + 1):
        if step % 200 == 1:
            obs, _ = env.reset(seed=seed if step == 1 else None)
        if step <= 200:
            action = 2 * torch.rand(1, generator=generator) - 1
        else:
            noise = 0.3 * torch.randn(1, generator=generator)
            action = (agent.act(torch.as_tensor(obs)[None])[0].detach() + noise).clamp(-1, 1)
        next_obs, reward, terminated, _, _ = env.step(2 * action.numpy())
        buffer.add(obs[None], action[None], [reward], next_obs[None], [terminated])
        obs = next_obs
        if step >= 200:
            if step % 100 == 0:
                model.fit(buffer[torch.arange(len(buffer))], generator)
            agent.learn(differentiable(model), buffer.sample(64, generator).obs, generator)
        if step % 100 == 0:
            yield step, agent


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train one agent and evaluate it on the way; a run of a minute keeps no checkpoint."""
    settings, rows, spent = VARIANTS[variant], [], 0.0
    began = time.process_time()
    final: list[float] = []
    for steps, agent in dreaming(seed, settings["steps"], settings["lam"], settings.get("pull", 0.0)):
        spent += time.process_time() - began
        final = evaluate(lambda obs, act=agent.act: 2 * act(torch.as_tensor(obs)).detach(), ENVIRONMENT)
        rows.append({"env_steps": steps, "train_cpu_seconds": spent, "eval_return": float(np.mean(final))})
        report(steps, settings["steps"])
        began = time.process_time()
    return Result(rows, {"final_returns": [round(value, 2) for value in final]})
