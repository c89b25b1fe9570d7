"""A run's checkpoint: one file, replaced whole, of tensors and plain values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from course_lib.figures.records import whole

NAME = "checkpoint.pt"


def save(folder: Path, state: dict[str, Any]) -> None:
    """Keep `state` (tensors, numbers, text, lists, dicts) in a run's checkpoint folder, in place of what was there."""
    with whole(folder / NAME) as unfinished:
        torch.save(state, unfinished)


def load(folder: Path) -> dict[str, Any] | None:
    """What was saved last, or None for a run that begins."""
    path = folder / NAME
    return torch.load(path, weights_only=True) if path.exists() else None
