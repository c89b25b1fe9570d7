"""SAC and PPO on Hopper, Walker2d, HalfCheetah and Pendulum, under one protocol of evaluation.

A variant is ALGORITHM_ENVIRONMENT, such as `sac_hopper`. Every `every` steps, and before the first, the policy plays the same ten
episodes, without noise, in environments of their own; the rows have the mean return and each single one, the environment steps, and the
processor time and wall time that the training alone has taken so far. The summary has the returns at the end.

A run keeps a checkpoint every 40 seconds and goes on from it in the middle of an episode, with the same numbers as if it had not
been interrupted.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from course_lib.control import envs, sac
from course_lib.control.policies import Adam, policy_for
from course_lib.control.ppo import PPOSettings
from course_lib.control.rollouts import EpisodeReturns
from course_lib.control.sac import SACSettings
from experiments import checkpoint, snapshots
from experiments.campaign import Report, Result
from solutions import ch45, ch47, ch48

ENVIRONMENTS = {
    "hopper": "Hopper-v5",
    "walker2d": "Walker2d-v5",
    "halfcheetah": "HalfCheetah-v5",
    "pendulum": "Pendulum-v1",
}
EPISODES, EVALUATION_SEED = 10, 1_000_000
SAVE_EVERY = 40.0  # seconds between checkpoints

SAC_SETTINGS = {
    "hopper": SACSettings(total_steps=200_000),
    "walker2d": SACSettings(total_steps=100_000),
    "halfcheetah": SACSettings(total_steps=100_000),
    "pendulum": SACSettings(total_steps=10_000, learning_starts=1_000, learning_rate=1e-3, hidden=64),
}
MUJOCO_PPO = PPOSettings(
    total_steps=1_000_000,
    num_steps=512,  # of each of 4 environments: 2,048 steps an update, as Schulman et al. (2017), table 3
    minibatch_size=64,
    num_epochs=10,
    learning_rate=3e-4,
    anneal=True,
    gamma=0.99,
    gae_lambda=0.95,
    ent_coef=0.0,
    reward_scale=0.1,
    normalize_obs=True,
)
PPO_SETTINGS = {
    "hopper": MUJOCO_PPO,
    "walker2d": MUJOCO_PPO,
    "halfcheetah": MUJOCO_PPO,
    "pendulum": MUJOCO_PPO.but(total_steps=200_000, gamma=0.9, learning_rate=1e-3, reward_scale=0.1),
}
NUM_ENVS = 4  # of PPO; SAC has one
EVERY = {"sac": {"pendulum": 500}, "ppo": {"pendulum": 4_096}}  # environment steps between evaluations
DEFAULT_EVERY = {"sac": 5_000, "ppo": 10_240}
CHUNK = {"sac": 500, "ppo": 1}  # steps between looks at the clock; PPO's least is a rollout


def configuration(algorithm: str, place: str, settings: Any) -> dict[str, Any]:
    """What a record says of how its run was made."""
    chosen = {name: "infinity" if value == math.inf else value for name, value in asdict(settings).items()}
    about = {"algorithm": algorithm, "environment": ENVIRONMENTS[place], "evaluation_episodes": EPISODES}
    every = EVERY[algorithm].get(place, DEFAULT_EVERY[algorithm])
    return about | {"num_envs": 1 if algorithm == "sac" else NUM_ENVS, "every": every} | chosen


VARIANTS = {
    f"{algorithm}_{place}": configuration(algorithm, place, settings[place])
    for place in ENVIRONMENTS
    for algorithm, settings in (("sac", SAC_SETTINGS), ("ppo", PPO_SETTINGS))
}
SEEDS = {variant: {"pendulum": 10, "hopper": 5}.get(variant.partition("_")[2], 3) for variant in VARIANTS}


class SACRun:
    """SAC in one environment, as `run` advances it."""

    def __init__(self, place: str, seed: int, settings: SACSettings | None = None):
        self.settings = settings or SAC_SETTINGS[place]
        taught = sac.Taught.of(vars(ch47))
        self.training = sac.Training(gym.make(ENVIRONMENTS[place]), self.settings, seed, taught, ch48.fast_sac_update)
        self.best_action = self.training.agent.best_action

    @property
    def env_steps(self) -> int:
        return self.training.env_steps

    def advance(self, num_steps: int) -> dict[str, float]:
        """Some steps; what is known of them."""
        return self.training.advance(num_steps)

    def state_dict(self) -> dict[str, Any]:
        return {"training": self.training.state_dict(), "env": snapshots.taken(self.training.env)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.training.load_state_dict(state["training"])
        snapshots.restored(self.training.env, state["env"])


class PPORun:
    """Chapter 45's PPO, an update at a time: what `ch45.train_ppo` does, with a state that can be kept."""

    def __init__(self, place: str, seed: int):
        self.settings = PPO_SETTINGS[place]
        self.envs = envs.make(ENVIRONMENTS[place], NUM_ENVS)
        self.generator = torch.Generator().manual_seed(seed)
        self.policy = policy_for(self.envs, self.settings.hidden, self.settings.log_std, seed)
        self.optimizer, self.returns = Adam(), EpisodeReturns(NUM_ENVS)
        self.obs, self.env_steps = torch.as_tensor(self.envs.reset(seed=seed)[0], dtype=torch.float32), 0

    def best_action(self, obs) -> torch.Tensor:
        return self.policy.best_action(obs)

    def advance(self, num_steps: int) -> dict[str, float]:
        """Whole rollouts, until at least so many steps are made; what is known of the last one."""
        goal, row = self.env_steps + num_steps, {}
        while self.env_steps < goal:
            left = 1 - self.env_steps / self.settings.total_steps if self.settings.anneal else 1.0
            self.optimizer.learning_rate = self.settings.learning_rate * left
            rollout = ch45.collect_rollout(self.envs, self.policy, self.settings.num_steps, self.obs, self.generator)
            batch, explained = ch45.estimate(self.policy, rollout, self.settings)
            metrics = ch45.fast_ppo_update(self.policy, self.optimizer, batch, self.settings, self.generator)
            if self.settings.normalize_obs:
                self.policy.observe(batch.obs)
            self.obs, self.env_steps = rollout.last_obs, self.env_steps + len(batch)
            finished = self.returns.add(rollout)
            row = {"mean_return": float(np.mean(finished)) if finished else math.nan, "explained_variance": explained.item()}
            row |= {name: metric.item() for name, metric in metrics.items()}
        return row

    def state_dict(self) -> dict[str, Any]:
        return {
            "weights": self.policy.weights.detach().clone(),
            "obs_mean": self.policy.obs_mean.clone(),
            "obs_std": self.policy.obs_std.clone(),
            "observed": self.policy.observed,
            "moments": [torch.from_numpy(moment.copy()) for moment in self.optimizer.moments],
            "steps": self.optimizer.steps,
            "returns": torch.from_numpy(self.returns.running.copy()),
            "generator": self.generator.get_state(),
            "obs": self.obs,
            "env_steps": self.env_steps,
            "envs": [snapshots.taken(env) for env in self.envs.envs],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        with torch.no_grad():
            self.policy.weights.copy_(state["weights"])
        self.policy.obs_mean.copy_(state["obs_mean"])
        self.policy.obs_std.copy_(state["obs_std"])
        self.policy.observed = state["observed"]
        self.optimizer.moments, self.optimizer.steps = [moment.numpy() for moment in state["moments"]], state["steps"]
        self.returns.running[:] = state["returns"].numpy()
        self.generator.set_state(state["generator"])
        self.obs, self.env_steps = state["obs"], state["env_steps"]
        for env, snapshot in zip(self.envs.envs, state["envs"], strict=True):
            snapshots.restored(env, snapshot)


def evaluate(best_action: Callable, environment: str, episodes: int = EPISODES, seed: int = EVALUATION_SEED) -> list[float]:
    """Undiscounted returns of one episode from each of the seeds `seed`, `seed` + 1, …, played side by side."""
    stages = [gym.make(environment) for _ in range(episodes)]
    obs = np.stack([stage.reset(seed=seed + i)[0] for i, stage in enumerate(stages)])
    returns, playing = np.zeros(episodes), list(range(episodes))
    while playing:
        space: Any = stages[0].action_space
        actions = best_action(obs[playing].astype(np.float32)).numpy().clip(space.low, space.high)
        ended = []
        for i, action in zip(playing, actions, strict=True):
            obs[i], reward, terminated, truncated, _ = stages[i].step(action)
            returns[i] += reward
            if terminated or truncated:
                ended.append(i)
        playing = [i for i in playing if i not in ended]
    return returns.tolist()


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train one agent and evaluate it on the way."""
    algorithm, _, place = variant.partition("_")
    made: SACRun | PPORun = SACRun(place, seed) if algorithm == "sac" else PPORun(place, seed)
    return followed(made, ENVIRONMENTS[place], VARIANTS[variant]["every"], CHUNK[algorithm], checkpoint_dir, report)


def followed(
    made,
    environment: str,
    every: int,
    chunk: int,
    checkpoint_dir: Path,
    report: Report,
    also: Callable[[], dict[str, float]] = dict,
) -> Result:
    """Train to the end what a class such as `SACRun` made, and evaluate it every so many steps; `also` adds to each row."""
    total = made.settings.total_steps
    rows: list[dict[str, Any]] = []
    spent = {"train_seconds": 0.0, "train_cpu_seconds": 0.0}
    state = checkpoint.load(checkpoint_dir)
    if state is not None:
        made.load_state_dict(state["run"])
        rows, spent = state["rows"], state["spent"]

    def play() -> dict[str, Any]:
        returns = evaluate(made.best_action, environment)
        return {"eval_return": float(np.mean(returns))} | {f"eval_return_{i}": value for i, value in enumerate(returns)} | also()

    if not rows:
        rows.append({"env_steps": 0} | spent | play())
    saved = time.monotonic()
    while made.env_steps < total:
        due = len(rows) * every  # the steps of the next evaluation
        wall, cpu = time.perf_counter(), time.process_time()
        told = made.advance(min(max(due - made.env_steps, 1), total - made.env_steps, chunk))
        spent["train_seconds"] += time.perf_counter() - wall
        spent["train_cpu_seconds"] += time.process_time() - cpu
        if made.env_steps >= min(due, total):
            rows.append(told | {"env_steps": made.env_steps} | spent | play())
        report(min(made.env_steps, total), total)
        if time.monotonic() - saved > SAVE_EVERY:
            checkpoint.save(checkpoint_dir, {"run": made.state_dict(), "rows": rows, "spent": spent})
            saved = time.monotonic()
    final = evaluate(made.best_action, environment)
    return Result(rows, {"final_returns": [round(value, 2) for value in final]} | spent)
