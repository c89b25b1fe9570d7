"""Parts of checks that many exercises share: inputs in other shapes, and the ways in which any right answer can be spoilt."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch

from autograder.authoring.spec import Case, Inputs, Misconception

SCALAR = "Return a 0-dim tensor, not a Python float: .item() cuts the graph that the optimiser needs."
DTYPE = "The result has lost the inputs' dtype: cast masks and counts with .to(x.dtype), not with .float()."
CUT = "Nothing can be learnt from this: the result carries no graph. Detach data only, never what is being learnt."
METRIC = "A reported number carries no graph: detach it, or it keeps the whole network's activations alive."
SHAPES = (
    "Shapes that differ broadcast silently, (B, 1) against (B,) to all pairs (B, B), and impossible settings give nonsense. Check the"
    " arguments first: course_lib.validate raises errors that name them."
)
IN_PLACE = "The caller's tensor is changed (by -=, *= or a method that ends in _): whoever uses it next finds other data."


def normal(generator: torch.Generator, *shape: int) -> torch.Tensor:
    """Standard normal numbers in double precision."""
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def uniform(generator: torch.Generator, *shape: int) -> torch.Tensor:
    """Numbers in [0, 1) in double precision."""
    return torch.rand(shape, generator=generator, dtype=torch.float64)


def integers(generator: torch.Generator, low: int, high: int, *shape: int) -> torch.Tensor:
    """Integers from low to high - 1."""
    return torch.randint(low, high, shape, generator=generator)


def replaced(inputs: Inputs, **changes: Any) -> Inputs:
    """The same arguments with some of them fixed."""
    return lambda generator: inputs(generator) | changes


def without(inputs: Inputs, *names: str) -> Inputs:
    """The same arguments with some left to their defaults."""
    return lambda generator: {name: value for name, value in inputs(generator).items() if name not in names}


def reshaped(inputs: Inputs, name: str, change: Callable[[torch.Tensor], torch.Tensor]) -> Inputs:
    """The same arguments with one in another shape."""

    def wrong(generator: torch.Generator) -> dict[str, Any]:
        drawn = inputs(generator)
        return drawn | {name: change(drawn[name])}

    return wrong


def shape_cases(inputs: Inputs, names: Sequence[str]) -> tuple[Case, ...]:
    """Each argument once without its first row; a single row in its place would broadcast, and so it comes once that way."""
    cases = [
        Case(f"{name} without its first row", reshaped(inputs, name, lambda x: x[1:]), raises=names, draws=1) for name in names
    ]
    single = Case(
        f"{names[-1]} of a single row", reshaped(inputs, names[-1], lambda x: x[:1]), raises=names, visible=True, draws=1
    )
    return (*cases, single)


def refused(inputs: Inputs, visible: bool = False, **impossible: Any) -> Case:
    """A setting that must be refused."""
    ((name, value),) = impossible.items()
    return Case(f"{name} = {value}", replaced(inputs, **impossible), raises=[name], visible=visible, draws=1)


def drawn_once(*cases: Case) -> tuple[Case, ...]:
    """Cases that do not say otherwise are drawn once for the judge: with many cases each fault shows in several of them."""
    return tuple(replace(case, draws=1) if case.draws == Case.draws else case for case in cases)


def after(function: Callable, change: Callable) -> Callable:
    """Right, and then spoilt."""
    return lambda *args, **kwargs: change(function(*args, **kwargs))


def dtype_lost(function: Callable) -> Misconception:
    return Misconception("dtype-lost", after(function, torch.Tensor.float), DTYPE)


def python_float(function: Callable) -> Misconception:
    return Misconception("python-float", after(function, torch.Tensor.item), SCALAR)


def cut_from_graph(function: Callable) -> Misconception:
    return Misconception("cut-from-graph", after(function, torch.Tensor.detach), CUT)


def in_place(function: Callable, name: str, position: int = 0) -> Misconception:
    """Right, but the argument of this name has changed afterwards."""

    def wrong(*args, **kwargs):
        result = function(*args, **kwargs)
        with torch.no_grad():
            (args[position] if position < len(args) else kwargs[name]).mul_(0.5)
        return result

    return Misconception("input-changed", wrong, IN_PLACE)
