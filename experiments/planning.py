"""Planning on Pendulum with a learned ensemble: what eight hundred real steps bring, and how far the models on the way can see.

The program of chapter 51's first experiment, for more seeds than a page has time for. The first episode is random; each later one is
planned with a model of everything before it. Rows are horizons: `error_200`, `mean_200`, … are what `model_error_by_horizon` finds,
on the last episode, of the models of 200, 400 and 600 steps as they draw and of their expectation, and `still` the error of
predicting that nothing moves. The summary has the return of each episode. `plan_40_held` has five pieces of a plan as `swing_up` does,
each held for longer; `capped` expects no reward above the highest that it has earned.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch

from course_lib.control import mbpo
from course_lib.control.replay import ReplayBuffer, Transitions
from experiments.campaign import Report, Result
from solutions.ch51 import gaussian_nll, imagine, model_error_by_horizon

ENVIRONMENT = "Pendulum-v1"
SETTINGS = mbpo.MBPOSettings().but(model_hidden=64)
OF_THE_MODEL = "members", "elites", "model_hidden", "model_batch", "model_learning_rate", "held_out", "patience"
PLANNER = {"candidates": 100, "pieces": 5, "hold": 4}
EPISODES, STEPS, CARRIED_OUT = 4, 200, 2
HORIZON, APART = 50, 10  # steps of a piece of the last episode, and between the starts of two

CHANGES: dict[str, dict[str, Any]] = {
    "swing_up": {},
    **{f"plan_{pieces * PLANNER['hold']}": {"pieces": pieces} for pieces in (1, 2, 3, 10)},
    "plan_40_held": {"hold": 8},
    "capped": {"capped": True},
}
VARIANTS: dict[str, dict[str, Any]] = {
    variant: {"environment": ENVIRONMENT, "episodes": EPISODES, "steps": STEPS, "carried_out": CARRIED_OUT}
    | PLANNER
    | change
    | {name: getattr(SETTINGS, name) for name in OF_THE_MODEL}
    for variant, change in CHANGES.items()
}
SEEDS = dict.fromkeys(VARIANTS, 6) | {"swing_up": 10, "capped": 10}


def best_plan(model, obs, generator, candidates, pieces, hold):
    """The best of many sequences of actions, each of which is held for some steps: (pieces * hold, 1)."""
    plans = (2 * torch.rand(pieces, candidates, 1, generator=generator) - 1).repeat_interleave(hold, 0)
    upcoming = iter(plans)
    starts = torch.as_tensor(obs).expand(candidates, -1)
    dream = imagine(model, lambda obs, generator: next(upcoming), starts, len(plans), generator)
    return plans[:, dream["rewards"].sum(0).argmax()]


def capped(model, highest: float):
    """The model, but for rewards above `highest`, which it does not expect."""

    def step(obs, actions, generator):
        next_obs, rewards, continues = model(obs, actions, generator)
        return next_obs, rewards.clamp(max=highest), continues

    return step


def swing_up(
    seed: int,
    report: Report,
    planner: Mapping[str, int] = PLANNER,
    episodes: int = EPISODES,
    steps: int = STEPS,
    cap: bool = False,
):
    """Returns of each episode, the model after each but the last, and all steps."""
    env, generator = gym.make(ENVIRONMENT), torch.Generator().manual_seed(seed)
    model = mbpo.Ensemble(3, 1, SETTINGS, gaussian_nll, seed=seed)
    buffer, returns, models, highest = ReplayBuffer(steps * episodes, 3, 1), [], [], 0.0
    for episode in range(episodes):
        obs, _ = env.reset(seed=seed if episode == 0 else None)
        returns.append(0.0)
        for step in range(steps):
            if episode and step % CARRIED_OUT == 0:
                plan = best_plan(capped(model, highest) if cap else model, obs, generator, **planner)
            action = plan[step % CARRIED_OUT] if episode else 2 * torch.rand(1, generator=generator) - 1
            next_obs, reward, terminated, _, _ = env.step(2 * action.numpy())
            buffer.add(obs[None], action[None], [reward], next_obs[None], [terminated])
            obs, returns[-1] = next_obs, returns[-1] + float(reward)
        if episode < episodes - 1:
            model.fit(buffer[torch.arange(len(buffer))], generator)
            models.append(copy.deepcopy(model))
            highest = buffer[torch.arange(len(buffer))].rewards.max().item()
        report(episode + 1, episodes)
    return returns, models, buffer[torch.arange(len(buffer))]


def episode_of(everything: Transitions, steps: int = STEPS) -> tuple[torch.Tensor, torch.Tensor]:
    """The last episode: obs (steps + 1, 3) and actions (steps, 1)."""
    return torch.cat([everything.obs[-steps:], everything.next_obs[-1:]]), everything.actions[-steps:]


def pieces_of(obs: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Overlapping pieces of an episode: obs (HORIZON + 1, B, 3) and actions (HORIZON, B, 1)."""
    starts = torch.arange(0, len(actions) - HORIZON + 1, APART)
    return obs[starts + torch.arange(HORIZON + 1)[:, None]], actions[starts + torch.arange(HORIZON)[:, None]]


def without_dice(model: mbpo.Ensemble):
    """The model's expectation in place of a draw from it: the mean of its elite members."""

    def expected(obs, actions, generator):
        mean = model.distributions(obs, actions)[0][model.elites].mean(0)
        return mean[:, :-1], mean[:, -1], torch.ones(len(obs))

    return expected


def promised(model: mbpo.Ensemble) -> float:
    """The reward that the members expect for standing still at the top, on average; in truth it is 0."""
    mean, _ = model.distributions(torch.tensor([[1.0, 0.0, 0.0]]), torch.zeros(1, 1))
    return mean[:, 0, -1].mean().item()


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Swing up once, and measure the models; it takes seconds, so that no checkpoint is kept."""
    planner = {name: VARIANTS[variant][name] for name in PLANNER}
    returns, models, everything = swing_up(seed, report, planner, cap="capped" in VARIANTS[variant])
    real, taken = pieces_of(*episode_of(everything))
    columns = {"still": (real[1:] - real[0]).square().mean((1, 2)).sqrt()}
    for i, model in enumerate(models, start=1):
        for name, asked in (("error", model), ("mean", without_dice(model))):
            generator = torch.Generator().manual_seed(0)
            columns[f"{name}_{STEPS * i}"] = model_error_by_horizon(asked, real, taken, generator)
    rows = [{"horizon": h + 1} | {name: column[h].item() for name, column in columns.items()} for h in range(HORIZON)]
    upper = (everything.next_obs[:, 0] > 0).float().view(len(returns), -1).mean(1)
    return Result(rows, {"returns": returns, "upper": upper.tolist(), "promised": promised(models[0])})
