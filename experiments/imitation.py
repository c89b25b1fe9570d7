"""Clones of chapter 45's lander: return, state shift and action error against the number of demonstrations; one round of DAgger.

The expert is the agent "ours", seed 0, of the experiment "lander", flown by its likeliest actions. Every clone is flown on the same
starts as the expert; its row t says how far it has drifted t steps after the start. Seeds change the demonstrations, the network's
first weights and the minibatches. "demonstrations" keeps ten flights of the expert, one row for each step, for the page to learn from.

"dagger" and "more" have one budget of labelled steps: those of `base` demonstrations, and as many again as the clone of these flies in
`extra_flights`. The expert labels them on the clone's own way ("dagger"), or shows them on its own ("more").

"pushed" flies the expert and clones of some demonstrations alike, with a side engine at full power for some steps whatever they command:
a row for each length of the push, start and side, with the return of each.

"road" is chapter 74's rover. A clone learns from one short drive in still air, and from what is added to it: more of the driver's own
drives, or rounds of DAgger. What it has learned is asked on the road with wind, from anywhere on it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import gymnasium as gym
import torch

from course_lib.control.demonstrations import Clone, Demonstrations
from course_lib.control.policies import load_policy
from course_lib.control.road import RoadDriver, RoadEnv
from course_lib.figures import records, videos
from course_lib.seeding import seed_everything
from experiments.campaign import Report, Result
from solutions.ch74 import collect_demonstrations, dagger_round, evaluate, gaussian_cloning_loss, state_shift, train_bc

ENVIRONMENT = "LunarLanderContinuous-v3"
EVALUATION = {"episodes": 12, "evaluation_seed": 1_000_000}
TRAINING = {"num_steps": 1000, "batch_size": 128, "learning_rate": 2e-3, "hidden": 64}
FILMED_SEED = 7
SLICES = range(0, 401, 10)  # steps after the start at which the drift is measured
SAMPLE = 2000  # states of either side that a state shift is computed from

COUNTS = (1, 5, 20, 100)
VARIANTS: dict[str, dict] = {
    "demonstrations": {"episodes": 10, "seed": 0},
    **{f"clone_{count}": {"demonstrations": count, **TRAINING, **EVALUATION} for count in COUNTS},
    **{name: {"base": 1, "extra_flights": 1, **TRAINING, **EVALUATION} for name in ("more", "dagger")},
    "pushed": {"demonstrations": [1, 5, 20], "lengths": list(range(0, 21, 2)), "begin": 50, "starts": 6, **TRAINING},
    "road": {
        "drive": 60,
        "short": 10,
        "gust": 0.04,
        "aside": 0.6,
        "rounds": 3,
        "num_steps": 400,
        "learning_rate": 0.01,
        "hidden": 32,
    },
}
SEEDS = dict.fromkeys(VARIANTS, 5) | {"demonstrations": 1, "road": 20}

Policy = Callable[[torch.Tensor], torch.Tensor]


def expert() -> Policy:
    """Chapter 45's agent, its commands clipped to what the engines can do."""
    agent = load_policy(records.load("lander").artefact("ours", 0, "safetensors"))
    return lambda obs: agent.best_action(obs).clamp(-1, 1)


def lander() -> gym.Env:
    """One lander, without checks of each step."""
    return gym.make(ENVIRONMENT, disable_env_checker=True)


def fit(obs: torch.Tensor, actions: torch.Tensor, settings: dict, seed: int) -> tuple[Clone, torch.Tensor]:
    """A clone of what was done, and its losses."""
    generator = seed_everything(seed)
    clone = Clone(obs, actions.shape[1], settings["hidden"])
    losses = train_bc(
        clone, lambda outputs, taken: gaussian_cloning_loss(outputs[0], outputs[1], taken), obs, actions,
        settings["num_steps"], settings.get("batch_size", 128), settings["learning_rate"], generator,
    )  # fmt: skip
    return clone, losses


def run(variant: str, seed: int, checkpoint_dir: Path, report: Report) -> Result:
    """Make one clone and fly it; a run of a minute keeps no checkpoint."""
    if variant == "road":
        return _on_the_road(VARIANTS[variant], seed, report)
    settings, teacher, env = VARIANTS[variant], expert(), lander()
    if variant == "demonstrations":
        shown = collect_demonstrations(teacher, env, settings["episodes"], settings["seed"])
        return Result(_steps(shown), {"returns": shown.returns.tolist()}, _filmed(teacher))

    first_seed = 1000 * (seed + 1)
    if variant == "pushed":
        return Result(_pushed(settings, teacher, env, first_seed, seed, report))
    shown = collect_demonstrations(teacher, env, settings.get("base") or settings["demonstrations"], first_seed)
    obs, actions = shown.obs, shown.actions
    report(1, 4)
    if "base" in settings:
        clone, _ = fit(obs, actions, settings, seed)
        flown = collect_demonstrations(clone.act, env, settings["extra_flights"], first_seed + 500)
        extra = flown.obs
        if variant == "more":
            extra = collect_demonstrations(teacher, env, 10 * settings["extra_flights"], first_seed + 500).obs[: len(extra)]
        obs, actions = torch.cat([obs, extra]), torch.cat([actions, teacher(extra)])
    report(2, 4)
    clone, losses = fit(obs, actions, settings, seed)
    report(3, 4)

    flights = settings["episodes"], settings["evaluation_seed"]
    flown, right = collect_demonstrations(clone.act, env, *flights), collect_demonstrations(teacher, env, *flights)
    summary = {
        "labelled_steps": len(obs),
        "returns": flown.returns.tolist(),
        "expert_returns": right.returns.tolist(),
        "state_shift": _shift(right.obs, flown.obs, seed),
        "error_on_expert_states": _error(clone.act, teacher, right.obs),
        "error_on_own_states": _error(clone.act, teacher, flown.obs),
        "training_loss": losses[-100:].mean().item(),
    }
    rows = [{"step": step} | _drift(right, flown, step, clone.act, teacher) for step in SLICES]
    return Result(rows, summary, _filmed(clone.act) if seed == 0 else {})


def _on_the_road(settings: dict, seed: int, report: Report) -> Result:
    """One seed of every way to add to the first drive. For each: labelled steps, the error on the driver's drives in still air and on
    those of the test, the return of the test; the driver's own return is that of "driver".
    """
    still = {"time_limit": settings["drive"], "gust": 0.0, "start": 0.0}
    windy, aside = still | {"gust": settings["gust"]}, still | {"start": settings["aside"]}
    test, driver, summary = RoadEnv(gust=settings["gust"], start=settings["aside"]), RoadDriver(), {}
    on_path, off_path = collect_demonstrations(driver, RoadEnv(**still), 5, 8000), collect_demonstrations(driver, test, 5, 8000)

    def judged(name: str, shown: Demonstrations) -> Policy:
        clone = fit(shown.obs, shown.actions, settings, seed)[0].act
        errors = [_error(clone, driver, drives.obs) for drives in (on_path, off_path)]
        summary[name] = [len(shown.obs), *errors, evaluate(clone, test, 8, 5000).mean().item()]
        report(len(summary), 9)
        return clone

    first = collect_demonstrations(driver, RoadEnv(**still), 1, 100 * seed)
    novice, new = judged("one drive", first), 100 * seed + 50
    short = windy | {"time_limit": settings["short"]}
    added = {"three still": (still, 3), "three windy": (windy, 3), "three from aside": (aside, 3), "ten windy steps": (short, 1)}
    for name, (road, drives) in added.items():
        own = collect_demonstrations(driver, RoadEnv(**road), drives, new)
        obs, actions = torch.cat([first.obs, own.obs]), torch.cat([first.actions, own.actions])
        judged(f"and {name}", Demonstrations(obs, actions, own.episode_ids, own.returns))
    judged("DAgger, ten windy steps", dagger_round(novice, driver, RoadEnv(**short), first, 1, new))
    clone, shown = novice, first
    for k in range(settings["rounds"]):
        shown = dagger_round(clone, driver, RoadEnv(**still), shown, 1, new + k)
        clone = judged(f"DAgger, still, round {k + 1}", shown)
    returns = evaluate(driver, test, 8, 5000).mean().item()
    rows = [{"labelled_steps": steps, "return": value} for steps, *_, value in summary.values()]
    return Result(rows, summary | {"driver": returns})


def _pushed(settings: dict, teacher: Policy, env: gym.Env, first_seed: int, seed: int, report: Report) -> list[dict]:
    """The returns of all flights that are pushed, of the expert and of a clone for each number of demonstrations."""
    flying = {"expert": teacher}
    for count in settings["demonstrations"]:
        shown = collect_demonstrations(teacher, env, count, first_seed)
        flying[f"clone_{count}"] = fit(shown.obs, shown.actions, settings, seed)[0].act
    rows = []
    for done, length in enumerate(settings["lengths"], 1):
        for start in range(settings["starts"]):
            for side in (-1.0, 1.0):
                row: dict = {"push": length, "start": start, "side": side}
                for name, policy in flying.items():
                    disturbed = _disturbed(policy, side, settings["begin"], length)
                    returns = collect_demonstrations(disturbed, env, 1, EVALUATION["evaluation_seed"] + start).returns
                    row[name] = returns.item()
                rows.append(row)
        report(done, len(settings["lengths"]))
    return rows


def _disturbed(policy: Policy, side: float, begin: int, length: int) -> Policy:
    """The policy for one flight, but for some steps of a full side engine with the main engine off."""
    steps = itertools.count()
    push = torch.tensor([[0.0, side]])
    return lambda obs: push if begin <= next(steps) < begin + length else policy(obs)


def _drift(right: Demonstrations, flown: Demonstrations, step: int, clone: Policy, teacher: Policy) -> dict[str, float]:
    """How far the clone is from where the expert is at that moment, in the expert's standard deviations, and its error there."""
    seen, wanted = _at(flown, step), _at(right, step)
    distances = torch.linalg.vector_norm((seen - wanted) / right.obs.std(0), dim=1)
    return {"distance": distances.mean().item(), "action_error": _error(clone, teacher, seen)}


def _at(flights: Demonstrations, step: int) -> torch.Tensor:
    """Where each flight is `step` steps after its start, or where it ended before that: (E, O)."""
    lengths = flights.episode_ids.bincount()
    return flights.obs[lengths.cumsum(0) - lengths + lengths.sub(1).clamp(max=step)]


@torch.no_grad()
def _error(clone: Policy, teacher: Policy, obs: torch.Tensor) -> float:
    """Root mean square of the difference between the clone's command, as executed, and the expert's, over steps and engines."""
    return (clone(obs).clamp(-1, 1) - teacher(obs)).square().mean().sqrt().item()


def _shift(expert_obs: torch.Tensor, agent_obs: torch.Tensor, seed: int) -> float:
    """The state shift of a sample of the states."""
    generator = torch.Generator().manual_seed(seed)
    samples = [obs[torch.randperm(len(obs), generator=generator)[:SAMPLE]] for obs in (expert_obs, agent_obs)]
    return state_shift(*samples).item()


def _steps(shown: Demonstrations) -> list[dict]:
    """Demonstrations as rows: episode, obs_0 …, action_0 …."""
    columns = {"episode": shown.episode_ids.tolist()}
    columns |= {f"obs_{i}": column.tolist() for i, column in enumerate(shown.obs.T)}
    columns |= {f"action_{i}": column.tolist() for i, column in enumerate(shown.actions.T)}
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def _filmed(policy: Policy) -> dict[str, bytes]:
    """A video of one flight, and the video's poster, by their suffixes."""
    stage = gym.make(ENVIRONMENT, render_mode="rgb_array")
    frames, _ = videos.film(lambda obs: _command(policy, obs), stage, FILMED_SEED)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "flight.mp4"
        videos.save(frames, path, poster=len(frames) // 3)
        return {suffix: path.with_suffix(f".{suffix}").read_bytes() for suffix in ("mp4", "webp")}


@torch.no_grad()
def _command(policy: Policy, obs):
    return policy(torch.as_tensor(obs).unsqueeze(0)).squeeze(0).numpy()
