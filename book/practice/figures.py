"""The page's `course_lib.figures.interactive`: what a cell gives to `explore` is kept, so that the page can draw it."""

from __future__ import annotations

import dataclasses
import math
import sys
import types
from collections.abc import Callable, Sequence
from typing import Any


@dataclasses.dataclass(frozen=True)
class Series:
    """One set of values to draw."""

    y: Any
    kind: str = "line"
    panel: str = "value"
    x: Any = None


given: dict[str, tuple[Callable[..., dict[str, Series]], dict[str, Sequence]]] = {}
"""By title, the function that a cell gave to `explore` last, and its sliders."""


def explore(
    series: Callable[..., dict[str, Series]], *, title: str, x_label: str, start: dict | None = None, **sliders: Sequence
) -> None:
    given[title] = (series, sliders)


def values(title: str, positions: Sequence[int]) -> list[list[float | None]]:
    """The values of each series with the sliders at these positions, to four significant digits, as the book records them."""
    series, sliders = given[title]
    setting = {name: choices[at] for (name, choices), at in zip(sliders.items(), positions, strict=True)}
    return [[_rounded(number) for number in _flat(one.y)] for one in series(**setting).values()]


def _flat(value: Any) -> list[float]:
    if hasattr(value, "tolist"):
        value = value.tolist()
    return [number for entry in value for number in _flat(entry)] if isinstance(value, list | tuple) else [float(value)]


def _rounded(number: float) -> float | None:
    """None leaves a gap, as for what no axis can hold."""
    return float(f"{number:.4g}") if math.isfinite(number) and abs(number) < 1e100 else None


def install() -> None:
    package, module = types.ModuleType("course_lib.figures"), types.ModuleType("course_lib.figures.interactive")
    package.__path__ = []
    module.__dict__.update(Series=Series, explore=explore)
    sys.modules.update({package.__name__: package, module.__name__: module})
