"""Model-based policy optimisation on Pendulum and Walker2d: how long to dream, what a stale model costs, and how wrong models are.

The protocol of evaluation is that of `control`, so that the records can be laid beside each other. Variants of `pendulum` and
`walker2d` change one setting each: how many steps a dream has (`h0`: no model at all, but as many updates, all on real steps), or
that the first model is the last (`stale`). Each row also has what `model_error_by_horizon` finds on fresh trajectories of the policy
as it is then: `error_1`, `error_2`, …, and for comparison `still_1`, …: the error of predicting that nothing moves. `pendulum_film`
is one run of `pendulum` and a video: a real trajectory beside what an early and the last model imagine.
"""

from __future__ import annotations

import copy
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from PIL import Image, ImageDraw

from course_lib.control import mbpo
from course_lib.control.mbpo import MBPOSettings
from course_lib.figures import videos
from experiments.campaign import Report, Result
from experiments.control import ENVIRONMENTS, EPISODES, SACRun, followed
from solutions import ch47, ch48, ch51

PENDULUM = MBPOSettings()
WALKER2D = MBPOSettings(
    total_steps=15_000,
    learning_starts=2_000,
    batch_size=256,
    learning_rate=3e-4,
    hidden=256,
    updates=5,
    horizon=1,
    refresh_every=500,
    imagined_steps=50_000,
    imagined_size=100_000,
    gamma=0.99,
    tau=0.005,
    model_hidden=200,
    model_batch=256,
    model_learning_rate=1e-3,
)
SETTINGS = {
    "pendulum": PENDULUM,
    **{f"pendulum_h{horizon}": PENDULUM.but(horizon=horizon) for horizon in (0, 1, 20)},
    "pendulum_stale": PENDULUM.but(refreshed=False),
    "pendulum_film": PENDULUM,
    "walker2d": WALKER2D,
    "walker2d_h0": WALKER2D.but(horizon=0),
}
EVERY = {"pendulum": 100, "walker2d": 1_000}  # environment steps between evaluations
CHUNK = {"pendulum": 100, "walker2d": 50}  # steps between looks at the clock
HORIZONS = (1, 2, 5, 10, 20, 50)
TRAJECTORIES, TRAJECTORY_SEED = 20, 2_000_000


def _place(variant: str) -> str:
    return variant.partition("_")[0]


def _configuration(variant: str, settings: MBPOSettings) -> dict[str, Any]:
    about = {"algorithm": "mbpo", "environment": ENVIRONMENTS[_place(variant)], "evaluation_episodes": EPISODES}
    return about | {"every": EVERY[_place(variant)]} | asdict(settings)


VARIANTS = {variant: _configuration(variant, settings) for variant, settings in SETTINGS.items()}
TEN = ("pendulum", "pendulum_h0", "pendulum_stale")
FEW = {"walker2d": 3, "walker2d_h0": 3, "pendulum_film": 1}
SEEDS = {variant: 10 if variant in TEN else FEW.get(variant, 5) for variant in VARIANTS}
EARLY, FILMED_STEPS, SIZE = 300, 100, 200  # real steps of the early model; steps of the video; pixels of each of its panels


class MBPORun(SACRun):
    """Chapter 51's agent, as `control` advances its own."""

    training: mbpo.Training

    def __init__(self, variant: str, seed: int):
        self.settings, self.environment = SETTINGS[variant], ENVIRONMENTS[_place(variant)]
        taught = mbpo.Taught.of(vars(ch51) | vars(ch47))
        self.training = mbpo.Training(gym.make(self.environment), self.settings, seed, taught, update=ch48.fast_sac_update)
        self.best_action = self.training.agent.best_action

    def model_errors(self) -> dict[str, float]:
        """Errors by horizon, once there is a model and the policy stays on its feet for long enough."""
        if not self.training.of_model:
            return {}
        generator = torch.Generator().manual_seed(TRAJECTORY_SEED)
        obs, actions = trajectories(self.training.agent, self.environment, max(HORIZONS), generator)
        if not obs.shape[1]:
            return {}
        errors = ch51.model_error_by_horizon(self.training.model, obs, actions, generator)
        still = (obs[1:] - obs[0]).square().mean((1, 2)).sqrt()
        return {f"{name}_{h}": column[h - 1].item() for h in HORIZONS for name, column in (("error", errors), ("still", still))}


def trajectories(agent, environment: str, horizon: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """First steps of episodes with a policy's random actions: obs (H + 1, B, O) and actions (H, B, A), of those that last so long."""
    kept = []
    for i in range(TRAJECTORIES):
        env = gym.make(environment)
        obs, actions = [env.reset(seed=TRAJECTORY_SEED + i)[0]], []
        for _ in range(horizon):
            actions.append(agent.act(obs[-1][None], generator)[0])
            next_obs, _, terminated, _, _ = env.step(agent.scaled(actions[-1]).numpy())
            if terminated:
                break
            obs.append(next_obs)
        else:
            kept.append((torch.as_tensor(np.array(obs), dtype=torch.float32), torch.stack(actions)))
    if not kept:
        return torch.zeros(horizon + 1, 0, 1), torch.zeros(horizon, 0, 1)
    obs_of_all, actions_of_all = (torch.stack(columns, 1) for columns in zip(*kept, strict=True))
    return obs_of_all, actions_of_all


def filmed(obs: list[torch.Tensor], names: tuple[str, ...]) -> np.ndarray:
    """Pendulums side by side, drawn from their observations, (T, 3) each: frames (T, H, W, 3). A rod is as long as its cosine and
    sine say."""
    frames = []
    for states in zip(*(panel.tolist() for panel in obs), strict=True):
        image = Image.new("RGB", (SIZE * len(obs), SIZE), "white")
        pen, middle = ImageDraw.Draw(image), SIZE // 2
        for i, (name, (cosine, sine, _)) in enumerate(zip(names, states, strict=True)):
            x = SIZE * i + middle
            tip = x - 0.4 * SIZE * sine, middle - 0.4 * SIZE * cosine + 8
            pen.line((x, middle + 8, *tip), fill="#2a7fbf" if i == 0 else "#d55e00", width=12)
            pen.ellipse((x - 4, middle + 4, x + 4, middle + 12), fill="#222222")
            pen.text((SIZE * i + 8, 6), name, fill="#222222", font_size=14)
        frames.append(np.asarray(image))
    return np.stack(frames)


def _film(seed: int, report: Report) -> Result:
    """A real trajectory of the last policy, and what two models imagine of it from its start and its actions."""
    made = MBPORun("pendulum_film", seed)
    made.advance(EARLY)
    early = copy.deepcopy(made.training.model)
    made.advance(made.settings.total_steps - EARLY)
    report(made.env_steps, made.settings.total_steps)
    env = gym.make(made.environment)
    generator = torch.Generator().manual_seed(seed)
    real, actions = [env.reset(seed=TRAJECTORY_SEED)[0]], []
    for _ in range(FILMED_STEPS):
        actions.append(made.training.agent.act(real[-1][None], generator))
        real.append(env.step(made.training.agent.scaled(actions[-1])[0].numpy())[0])
    start = torch.as_tensor(real[0])[None]
    dreams = []
    for model in (early, made.training.model):
        upcoming = iter(actions)
        dreams.append(ch51.imagine(model, lambda obs, generator, taken=upcoming: next(taken), start, FILMED_STEPS, generator))
    columns = [torch.as_tensor(np.array(real)), *(dream["obs"][:, 0] for dream in dreams)]
    frames = filmed(columns, ("real", f"model of {EARLY} steps", f"model of {made.settings.total_steps} steps"))
    rows = [
        {"env_steps": t}
        | {name: (states[t] - columns[0][t]).norm().item() for name, states in zip(("early", "last"), columns[1:], strict=True)}
        for t in range(FILMED_STEPS + 1)
    ]
    with TemporaryDirectory() as folder:
        videos.save(frames, Path(folder) / "video.mp4", fps=20, width=3 * SIZE, poster=20)
        return Result(rows, {}, {suffix: (Path(folder) / f"video.{suffix}").read_bytes() for suffix in ("mp4", "webp")})


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Train one agent and evaluate it and its model on the way, or film them."""
    if variant == "pendulum_film":
        return _film(seed, report)
    made, place = MBPORun(variant, seed), _place(variant)
    return followed(made, made.environment, EVERY[place], CHUNK[place], checkpoint_dir, report, made.model_errors)
