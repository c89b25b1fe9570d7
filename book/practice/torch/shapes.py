"""Shapes: how many entries, how far apart they lie, and what several shapes have in common."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any


class Size(tuple):
    """A shape."""

    def numel(self) -> int:
        return count(self)

    def __repr__(self) -> str:
        return f"torch.Size([{', '.join(map(str, self))}])"

    def __getitem__(self, index: Any) -> Any:
        found = super().__getitem__(index)
        return Size(found) if isinstance(index, slice) else found

    def __add__(self, other: Any) -> Size:
        return Size(tuple(self) + tuple(other))


def count(shape: Iterable[int]) -> int:
    """How many entries a tensor of this shape has."""
    total = 1
    for size in shape:
        total *= size
    return total


def strides_of(shape: Sequence[int]) -> tuple[int, ...]:
    """Strides of numbers that lie in a row, those of the last axis side by side."""
    strides, step = [], 1
    for size in reversed(shape):
        strides.append(step)
        step *= max(size, 1)
    return tuple(reversed(strides))


def positions(shape: Sequence[int], strides: Sequence[int], offset: int) -> list[int]:
    """Where the entries lie in the row, in reading order."""
    found = [offset]
    for size, stride in zip(shape, strides, strict=True):
        found = [base + stride * i for base in found for i in range(size)]
    return found


def axis_of(axis: Any, dims: int) -> int:
    """The axis, counted from the front. Raises IndexError if there is none."""
    bound = max(dims, 1)
    if not isinstance(axis, int) or isinstance(axis, bool):
        if not hasattr(axis, "__index__") or isinstance(axis, bool):
            raise TypeError(f"argument 'dim' must be int, not {type(axis).__name__}")
        axis = axis.__index__()
    if not -bound <= axis < bound:
        raise IndexError(f"Dimension out of range (expected to be in range of [{-bound}, {bound - 1}], but got {axis})")
    return axis % bound


def axes_of(dim: Any, dims: int) -> tuple[int, ...]:
    """The axes that `dim` names: one, several, or all of them for None and for ()."""
    if dim is None or (isinstance(dim, (tuple, list)) and not dim):
        return tuple(range(dims))
    axes = tuple(axis_of(axis, dims) for axis in (dim if isinstance(dim, (tuple, list)) else (dim,)))
    for number, axis in enumerate(axes):
        if axis in axes[:number]:
            raise RuntimeError(f"dim {axis} appears multiple times in the list of dims")
    return axes if dims else ()


def broadcast_shapes(*shapes: Sequence[int]) -> tuple[int, ...]:
    """The shape that all have together. Raises RuntimeError if there is none."""
    result: list[int] = []
    for shape in shapes:
        padded = [1] * (len(result) - len(shape)) + list(shape)
        result = [1] * (len(padded) - len(result)) + result
        for axis in reversed(range(len(result))):
            a, b = result[axis], padded[axis]
            if a != b and a != 1 and b != 1:
                raise RuntimeError(
                    f"The size of tensor a ({a}) must match the size of tensor b ({b}) at non-singleton dimension {axis}"
                )
            result[axis] = b if a == 1 else a
    return tuple(result)
