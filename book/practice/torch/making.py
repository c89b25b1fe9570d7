"""New tensors: of numbers, of other tensors, and with a memory of how they were made (`record`)."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

from . import dtypes
from .autograd import Node, is_recording
from .missing import Missing
from .shapes import count
from .tensor import Storage, Tensor, from_nested

inf, nan = math.inf, math.nan


def make(numbers: Sequence[Any], shape: Sequence[int], kind: dtypes.dtype) -> Tensor:
    """A new tensor of these numbers, rounded to its kind."""
    return Tensor(Storage(kind.numbers(numbers)), shape, kind)


def record(result: Tensor, name: str, sources: Sequence[Tensor], send_back: Callable, relies_on: Sequence[Tensor] = ()) -> Tensor:
    """Let the result remember how it was made, if a gradient may be asked for."""
    if is_recording() and result.dtype.is_floating_point and any(source.requires_grad for source in sources):
        result._requires_grad, result.step = True, Node(name, sources, send_back, relies_on)
        result.step.result = result
    return result


def tensor_like(value: Any, kind: dtypes.dtype | None = None) -> Tensor:
    """The tensor, or one of a Python number, which is not rounded until it meets another."""
    return (
        value if isinstance(value, Tensor) else from_nested(value, kind or (dtypes.float64 if isinstance(value, float) else None))
    )


def need_tensor(function: str, argument: str, position: int, value: Any) -> None:
    if not isinstance(value, Tensor):
        raise TypeError(f"{function}(): argument '{argument}' (position {position}) must be Tensor, not {type(value).__name__}")


def tensor(data: Any, *, dtype: Any = None, device: Any = None, requires_grad: bool = False) -> Tensor:
    return from_nested(data, dtype).requires_grad_(requires_grad) if requires_grad else from_nested(data, dtype)


def as_tensor(data: Any, *, dtype: Any = None, device: Any = None) -> Tensor:
    return data.to(dtype or data.dtype) if isinstance(data, Tensor) else from_nested(data, dtype)


def sizes_of(size: Sequence[Any]) -> tuple[int, ...]:
    size = size[0] if len(size) == 1 and isinstance(size[0], (tuple, list)) else size
    return tuple(operator.index(entry) for entry in size)


def full(size: Sequence[int], fill_value: Any, *, dtype: Any = None, device: Any = None, requires_grad: bool = False) -> Tensor:
    shape = sizes_of((size,))
    fill = fill_value.item() if isinstance(fill_value, Tensor) else fill_value
    result = make([fill] * count(shape), shape, dtype or dtypes.of_number(fill))
    return result.requires_grad_() if requires_grad else result


def zeros(*size: Any, dtype: Any = None, device: Any = None, requires_grad: bool = False) -> Tensor:
    return full(sizes_of(size), 0, dtype=dtype or dtypes.float32, requires_grad=requires_grad)


def ones(*size: Any, dtype: Any = None, device: Any = None, requires_grad: bool = False) -> Tensor:
    return full(sizes_of(size), 1, dtype=dtype or dtypes.float32, requires_grad=requires_grad)


empty = zeros


def full_like(input: Tensor, fill_value: Any, *, dtype: Any = None, device: Any = None) -> Tensor:
    return full(input.shape, fill_value, dtype=dtype or input.dtype)


def zeros_like(input: Tensor, *, dtype: Any = None, device: Any = None) -> Tensor:
    return full_like(input, 0, dtype=dtype)


def ones_like(input: Tensor, *, dtype: Any = None, device: Any = None) -> Tensor:
    return full_like(input, 1, dtype=dtype)


empty_like = zeros_like


def eye(n: int, m: int | None = None, *, dtype: Any = None, device: Any = None) -> Tensor:
    m = n if m is None else m
    return make([i == j for i in range(n) for j in range(m)], (n, m), dtype or dtypes.float32)


def arange(start: Any, end: Any = None, step: Any = 1, *, dtype: Any = None, device: Any = None) -> Tensor:
    start, end = (0, start) if end is None else (start, end)
    values = [float(x) if isinstance(x, Tensor) and x.dtype.category == 2 else x for x in (start, end, step)]
    values = [operator.index(x) if isinstance(x, Tensor) else x for x in values]
    start, end, step = values
    length = max(math.ceil((end - start) / step), 0)
    whole = all(isinstance(x, int) for x in values)
    return make([start + i * step for i in range(length)], (length,), dtype or (dtypes.int64 if whole else dtypes.float32))


def linspace(start: float, end: float, steps: int, *, dtype: Any = None, device: Any = None) -> Tensor:
    step = (end - start) / (steps - 1) if steps > 1 else 0.0
    values = [start + i * step if i < steps / 2 else end - (steps - 1 - i) * step for i in range(steps)]
    return make(values, (steps,), dtype or dtypes.float32)


def to(input: Tensor, *args: Any, dtype: Any = None, device: Any = None, copy: bool = False, **_rest: Any) -> Tensor:
    for argument in map(dtypes.named, args):
        if isinstance(argument, dtypes.dtype):
            dtype = argument
        elif isinstance(argument, Tensor):
            dtype = argument.dtype
        elif str(argument) != "cpu":
            raise Missing(f"torch.device({str(argument)!r})")
    if dtype is None or (dtype is input.dtype and not copy):
        return input.clone() if copy else input
    result = make(input.flat(), input.shape, dtype)
    return record(result, "ToCopyBackward0", [input], lambda gradient: [make(gradient.flat(), input.shape, input.dtype)])


def clone(input: Tensor, **_rest: Any) -> Tensor:
    return record(Tensor(Storage(input.flat()), input.shape, input.dtype), "CloneBackward0", [input], lambda gradient: [gradient])


def contiguous(input: Tensor) -> Tensor:
    return input if input.is_contiguous() else clone(input)


def scalar_tensor(value: Any, *, dtype: Any = None) -> Tensor:
    return full((), value, dtype=dtype or dtypes.float32)
