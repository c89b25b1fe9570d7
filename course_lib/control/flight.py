"""Fly a policy from nothing but its weights: read a safetensors file strictly, and take it through seeded episodes.

The notebook's check and the grader fly with this code. The grader starts it as a program of its own for every file handed in
(`python flight.py`, see `main`), so it needs NumPy, Gymnasium and safetensors only, and imports nothing of course_lib: torch would
cost seconds. A file is data: it cannot hold code, and nothing that it holds is run.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import safetensors.numpy

MAX_BYTES = 256 << 10  # of a file; one of ours has an eighth of it


@dataclass(frozen=True)
class Task:
    """What is flown, and the policy's architecture, which the course fixes: policies.make_policy with these arguments."""

    environment: str
    obs_dim: int
    action_dim: int
    hidden: int

    @property
    def tensors(self) -> dict[str, tuple[int, ...]]:
        """Name and shape of everything that the file must hold, as policies.save_policy writes it."""
        shapes: dict[str, tuple[int, ...]] = {}
        for network, outputs in (("actor", self.action_dim), ("critic", 1)):
            sizes = ((self.obs_dim, self.hidden), (self.hidden, self.hidden), (self.hidden, outputs))
            for layer, (fan_in, fan_out) in zip(LAYERS, sizes, strict=True):
                shapes |= {f"{network}.{layer}.weight": (fan_in, fan_out), f"{network}.{layer}.bias": (fan_out,)}
        return shapes | {"log_std": (self.action_dim,), "obs_mean": (self.obs_dim,), "obs_std": (self.obs_dim,)}


LAYERS = ("0", "1", "out")
TASKS = {"lander": Task("LunarLanderContinuous-v3", obs_dim=8, action_dim=2, hidden=64)}


class RefusedFile(ValueError):
    """The file holds no policy of the task; the message says why, to the learner."""


def read_weights(content: bytes, task: Task) -> dict[str, np.ndarray]:
    """The tensors in the bytes of a safetensors file, by name: exactly those of the task, float32 and finite.

    Raises: RefusedFile for anything else.
    """
    if len(content) > MAX_BYTES:
        raise RefusedFile(f"it is larger than {MAX_BYTES >> 10} kB, and the task's policy needs {_size(task) >> 10} kB")
    entries = _entries(content)
    _expect_names(entries, task)
    for name, shape in task.tensors.items():
        entry = entries[name] if isinstance(entries[name], dict) else {}
        if entry.get("dtype") != "F32":
            raise RefusedFile(f"{name} has the dtype {_short(entry.get('dtype'))} where F32 (torch.float32) belongs")
        if entry.get("shape") != list(shape):
            raise RefusedFile(f"{name} has the shape {_short(entry.get('shape'))} where {list(shape)} belongs")
    try:
        weights = safetensors.numpy.load(content)
    except Exception as error:  # whatever a hostile file provokes in a parser is one and the same to us
        raise _not_safetensors() from error
    for name, tensor in weights.items():
        if not np.isfinite(tensor).all():
            raise RefusedFile(f"{name} holds numbers that are not finite (NaN or infinite): training has diverged")
    if not (weights["obs_std"] > 0).all():
        raise RefusedFile("obs_std, by which observations are divided, holds a number that is not positive")
    return weights


def _size(task: Task) -> int:
    return 4 * sum(int(np.prod(shape)) for shape in task.tensors.values())


def _entries(content: bytes) -> dict[str, Any]:
    """The file's table of tensors. The parser that reads the numbers takes the last of two equal names; here they are refused."""
    if content[:4] == b"PK\x03\x04" or content[:1] == b"\x80":
        raise RefusedFile(
            "it is a pickle, which can run code when it is read: write it with course_lib.control.policies.save_policy"
        )
    length = int.from_bytes(content[:8], "little")
    try:
        entries = json.loads(content[8 : 8 + length].decode(), object_pairs_hook=_without_repetition)
    except (ValueError, RecursionError) as error:
        if isinstance(error, RefusedFile):
            raise
        raise _not_safetensors() from error
    if not isinstance(entries, dict):
        raise _not_safetensors()
    entries.pop("__metadata__", None)
    return entries


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) < len(pairs):
        raise RefusedFile("its table names something twice: write it with course_lib.control.policies.save_policy")
    return entries


def _not_safetensors() -> RefusedFile:
    return RefusedFile("it is no safetensors file, or only a part of one: write it with course_lib.control.policies.save_policy")


def _expect_names(entries: Mapping[str, Any], task: Task) -> None:
    for what, names in (
        ("lacks", task.tensors.keys() - entries.keys()),
        ("has, beside what belongs there,", entries.keys() - task.tensors.keys()),
    ):
        if names:
            listed = ", ".join(_short(name) for name in sorted(names)[:3]) + (", …" if len(names) > 3 else "")
            raise RefusedFile(f"it {what} {listed}; the task's policy has {', '.join(task.tensors)}")


def _short(value: Any) -> str:
    text = ascii(value) if not isinstance(value, str) else value
    return text if len(text) <= 60 else text[:60] + "…"


def act(weights: Mapping[str, np.ndarray], observations: np.ndarray) -> np.ndarray:
    """The policy's likeliest actions, clipped to [-1, 1] as the environment would: (N, observations) → (N, actions), float32.

    Computed in double precision. There no finite float32 weights can overflow, and what two machines round differently is gone when the
    actions become float32 again, so that the same file lands alike on both.
    """
    hidden = (observations.astype(np.float64) - weights["obs_mean"]) / weights["obs_std"]
    for layer in LAYERS:
        hidden = hidden @ weights[f"actor.{layer}.weight"].astype(np.float64) + weights[f"actor.{layer}.bias"]
        if layer != LAYERS[-1]:
            hidden = np.tanh(hidden)
    return np.clip(hidden, -1, 1).astype(np.float32)


def fly(weights: Mapping[str, np.ndarray], seeds: Sequence[int], task: Task) -> np.ndarray:
    """One episode from each seed, all of them side by side.

    Args:
      weights: as `read_weights` gives them.
      seeds: of the environments' first reset, one for each episode.
      task: what to fly.

    Returns: undiscounted returns, (len(seeds),) float64; the same for the same arguments.
    """
    envs = [gymnasium.make(task.environment, disable_env_checker=True) for _ in seeds]
    observations = np.stack([env.reset(seed=int(seed))[0] for env, seed in zip(envs, seeds, strict=True)])
    returns, flying = np.zeros(len(envs)), np.ones(len(envs), dtype=bool)
    while flying.any():
        aloft = np.flatnonzero(flying)
        for index, action in zip(aloft, act(weights, observations[aloft]), strict=True):
            observations[index], reward, terminated, truncated, _ = envs[index].step(action)
            returns[index] += float(reward)
            flying[index] = not (terminated or truncated)
    for env in envs:
        env.close()
    return returns


def main() -> None:
    """Fly the file on standard input: argv is the task's name and the seeds; one JSON object comes out, `returns` or `refused`."""
    task, seeds = TASKS[sys.argv[1]], [int(seed) for seed in sys.argv[2:]]
    try:
        told = {"returns": fly(read_weights(sys.stdin.buffer.read(MAX_BYTES + 1), task), seeds, task).tolist()}
    except RefusedFile as refusal:
        told = {"refused": str(refusal)}
    json.dump(told, sys.stdout)


if __name__ == "__main__":
    main()
