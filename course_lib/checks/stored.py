"""Cases in files and messages: plain data with tensors, none of which runs anything on arrival. No pickle is ever read."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch

from course_lib.checks.cases import FrozenExercise, exercise_of


def save(path: Path, exercise: FrozenExercise) -> None:
    """Write an exercise's frozen cases as an npz file that `load` reads without pickle."""
    text, arrays = _flatten(asdict(exercise))
    np.savez_compressed(path, allow_pickle=False, json=np.array(text), **{name: array.numpy() for name, array in arrays.items()})


def load(path: Path) -> FrozenExercise:
    """Read what `save` wrote."""
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: torch.from_numpy(archive[name]) for name in archive.files if name != "json"}
        return exercise_of(_unflatten(str(archive["json"]), arrays))


def encode(data: Any) -> bytes:
    """Plain data with tensors, as bytes in the safetensors format (which cannot hold code, and whose sizes are checked)."""
    text, arrays = _flatten(data)
    return safetensors.torch.save({"json": torch.frombuffer(bytearray(text.encode()), dtype=torch.uint8), **arrays})


def decode(payload: bytes, text_limit: int | None = None) -> Any:
    """The data that `encode` made. Raises ValueError for anything else, and for more than `text_limit` bytes beside the arrays:
    a small text of brackets parses into objects of thirty times its size."""
    try:
        if text_limit is not None and int.from_bytes(payload[:8], "little") > text_limit:  # the length of the arrays' directory
            raise ValueError("too many arrays")
        arrays = safetensors.torch.load(payload)
        if text_limit is not None and arrays["json"].nbytes > text_limit:
            raise ValueError("too much text")
        return _unflatten(arrays["json"].numpy().tobytes().decode(), arrays)
    except Exception as error:  # whatever a hostile sender provokes in a parser is one and the same to the receiver
        raise ValueError(f"not a message: {type(error).__name__}") from None


def _flatten(data: Any) -> tuple[str, dict[str, torch.Tensor]]:
    arrays: dict[str, torch.Tensor] = {}

    def plain(value: Any) -> Any:
        if isinstance(value, torch.Tensor):
            key = f"a{len(arrays)}"
            arrays[key] = value.detach().clone(memory_format=torch.contiguous_format)
            return {"@array": key}
        if isinstance(value, dict):
            return {str(name): plain(entry) for name, entry in value.items()}
        if isinstance(value, list | tuple):
            return [plain(entry) for entry in value]
        return value

    return json.dumps(plain(data)), arrays


def _unflatten(text: str, arrays: Any) -> Any:
    def whole(value: Any) -> Any:
        if isinstance(value, dict):
            return arrays[value["@array"]] if "@array" in value else {name: whole(entry) for name, entry in value.items()}
        return [whole(entry) for entry in value] if isinstance(value, list) else value

    return whole(json.loads(text))


def to_text(exercise: FrozenExercise) -> str:
    """An exercise's frozen cases as JSON, tensors included: for a page that has neither NumPy nor files."""
    text, arrays = _flatten(asdict(exercise))
    tables = {
        name: {
            "dtype": str(array.dtype).removeprefix("torch."),
            "shape": list(array.shape),
            "entries": array.reshape(-1).tolist(),
        }
        for name, array in arrays.items()
    }
    return json.dumps({"exercise": json.loads(text), "arrays": tables})


def arrays_of(value: Any) -> Any:
    """The same with NumPy's arrays in place of tensors."""
    if isinstance(value, dict):
        return {name: arrays_of(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [arrays_of(entry) for entry in value]
    return value.numpy() if isinstance(value, torch.Tensor) else value


def tensors_of(arrays: dict[str, Any]) -> dict[str, torch.Tensor]:
    """Tensors of what NumPy takes for arrays."""
    return {name: torch.from_numpy(np.asarray(array)) for name, array in arrays.items()}
