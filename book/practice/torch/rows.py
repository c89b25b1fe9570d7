"""Rows along one axis: running sums, softmax, sorting."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

from . import dtypes
from .entrywise import OF_ONE, exponential, floats_only, lerp, log_add_exp, where
from .making import inf, make, nan, record, tensor, tensor_like
from .missing import Missing
from .moving import index_select, picked, stack
from .reductions import VALUES_AND_PLACES, chosen, groups_of, shared, sum_kind
from .shapes import axis_of, count
from .tensor import Tensor


def median(input: Tensor, dim: Any = None, keepdim: bool = False) -> Any:
    def which(values: list[Any]) -> int:
        if any(value != value for value in values):
            return next(i for i, value in enumerate(values) if value != value)
        return sorted(range(len(values)), key=values.__getitem__)[(len(values) - 1) // 2]

    if input.dtype is dtypes.bool_ and count(input.shape):
        raise NotImplementedError("\"median_cpu\" not implemented for 'Bool'")
    if dim is None:
        return shared("Median", input, None, False, which)
    return VALUES_AND_PLACES["median"](*chosen("median", input, dim, keepdim, which))


def quantile(input: Tensor, q: Any, dim: Any = None, keepdim: bool = False) -> Tensor:
    if input.dtype not in (dtypes.float32, dtypes.float64):
        raise RuntimeError("quantile() input tensor must be either float or double dtype")
    if not count(input.shape):
        raise RuntimeError("quantile() input tensor must be non-empty")
    levels = tensor_like(q, input.dtype)
    parts = [_quantile(input, level, dim, keepdim) for level in levels.reshape(-1).tolist()]
    return stack(parts) if levels.ndim else parts[0]


def _quantile(x: Tensor, level: float, dim: Any, keepdim: bool) -> Tensor:
    x, dim = (x.reshape(-1), 0) if dim is None else (x, dim)
    ordered = sort(x, dim).values
    at = level * (x.shape[axis_of(dim, x.ndim)] - 1)
    low, high = math.floor(at), math.ceil(at)
    parts = [index_select(ordered, dim, tensor([i])) for i in (low, high)]
    result = lerp(parts[0], parts[1], at - low)
    result = where(OF_ONE["isnan"](x).any(dim, True), nan, result)
    return result if keepdim else result.squeeze(dim)


def _along(name: str, x: Tensor, axis: int, compute: Callable, send: Callable | None, kind: dtypes.dtype) -> Tensor:
    """As many numbers as there are, made of each row along `axis`. `send` takes a row's gradient, its entries and its results."""
    axis = axis_of(axis, x.ndim)
    groups, places, _ = groups_of(x, [axis] if x.ndim else [])
    rows = [kind.numbers(compute(group)) for group in groups]

    def arranged(parts: Sequence[Sequence[Any]], kind: dtypes.dtype) -> Tensor:
        numbers: list[Any] = [0] * count(x.shape)
        for where_, row in zip(places, parts, strict=True):
            for place, value in zip(where_, row, strict=True):
                numbers[place] = value
        return make(numbers, x.shape, kind)

    result = arranged(rows, kind)
    if send is None:
        return result

    def send_back(gradient: Tensor) -> list[Tensor]:
        arriving = gradient.flat()
        return [
            arranged(
                [
                    send([arriving[p] for p in where_], group, row)
                    for where_, group, row in zip(places, groups, rows, strict=True)
                ],
                x.dtype,
            )
        ]

    keeps = {"Cumprod": [x, result], "Logcumsumexp": [x, result], "Softmax": [result], "LogSoftmax": [result]}.get(name, [])
    return record(result, f"{name}Backward0", [x], send_back, keeps)


def _float_rows(name: str, x: Tensor, dim: int, dtype: Any) -> Tensor:
    x = x.to(dtype) if dtype else x
    if not x.dtype.is_floating_point:
        axis_of(dim, x.ndim)
        if not count(x.shape):
            return x
        raise NotImplementedError(f"\"{name}_lastdim_kernel_impl\" not implemented for '{x.dtype.long_name}'")
    return x


def _log_softmax_row(row: list[float]) -> list[float]:
    top = max(row, default=0.0)
    if abs(top) == inf or any(v != v for v in row):
        return [nan] * len(row)
    total = math.log(math.fsum(math.exp(v - top) for v in row)) if row else 0.0
    return [v - top - total for v in row]


def log_softmax(input: Tensor, dim: int, *, dtype: Any = None) -> Tensor:
    x = _float_rows("log_softmax", input, dim, dtype)

    def send(g: list[float], row: list[float], out: list[float]) -> list[float]:
        total = sum(g)
        return [a - math.exp(b) * total for a, b in zip(g, out, strict=True)]

    return _along("LogSoftmax", x, dim, _log_softmax_row, send, x.dtype)


def softmax(input: Tensor, dim: int, *, dtype: Any = None) -> Tensor:
    x = _float_rows("softmax", input, dim, dtype)

    def send(g: list[float], row: list[float], out: list[float]) -> list[float]:
        total = sum(a * b for a, b in zip(g, out, strict=True))
        return [b * (a - total) for a, b in zip(g, out, strict=True)]

    return _along("Softmax", x, dim, lambda row: [math.exp(v) for v in _log_softmax_row(row)], send, x.dtype)


def _running(values: list[Any], combine: Callable) -> list[Any]:
    result: list[Any] = []
    for value in values:
        result.append(combine(result[-1], value) if result else value)
    return result


def cumsum(input: Tensor, dim: int, *, dtype: Any = None) -> Tensor:
    def send(g: list[float], row: list[float], out: list[float]) -> list[float]:
        return _running(g[::-1], operator.add)[::-1]

    return _along("Cumsum", input, dim, lambda row: _running(row, operator.add), send, sum_kind(input, dtype))


def cumprod(input: Tensor, dim: int, *, dtype: Any = None) -> Tensor:
    def send(g: list[float], row: list[float], out: list[float]) -> list[float]:
        return [
            sum(g[j] * math.prod(v for k, v in enumerate(row[: j + 1]) if k != i) for j in range(i, len(row)))
            for i in range(len(row))
        ]

    return _along("Cumprod", input, dim, lambda row: _running(row, operator.mul), send, sum_kind(input, dtype))


def _rank(value: Any, descending: bool = False) -> tuple[bool, Any]:
    """What to sort by: what is no number counts as the largest."""
    if value != value:
        return (not descending, 0.0)
    return (descending, -value) if descending else (False, value)


def argsort(input: Tensor, dim: int = -1, descending: bool = False, stable: bool = True) -> Tensor:
    def order(row: list[Any]) -> list[int]:
        return sorted(range(len(row)), key=lambda i: _rank(row[i], descending))

    return _along("sort", input, dim, order, None, dtypes.int64)


def sort(input: Tensor, dim: int = -1, descending: bool = False, stable: bool = True) -> Any:
    indices = argsort(input, dim, descending)
    return VALUES_AND_PLACES["sort"](picked(input, dim, indices), indices)


def topk(input: Tensor, k: int, dim: int = -1, largest: bool = True, sorted: bool = True) -> Any:
    length = input.shape[axis_of(dim, input.ndim)] if input.ndim else 1
    if not 0 <= k <= length:
        raise RuntimeError("selected index k out of range")
    if input.dtype is dtypes.bool_:
        raise RuntimeError("topk does not support bool dtypes on CPU")
    indices = argsort(input, dim, largest)
    indices = indices.narrow(dim, 0, k) if input.ndim else indices
    return VALUES_AND_PLACES["topk"](picked(input, dim, indices), indices)


def diff(input: Tensor, n: int = 1, dim: int = -1) -> Tensor:
    if not input.ndim:
        raise RuntimeError("diff expects input to be at least one-dimensional")
    length = input.shape[axis_of(dim, input.ndim)]
    if not length:
        return input.clone()
    later, earlier = input.narrow(dim, 1, length - 1), input.narrow(dim, 0, length - 1)
    result = later != earlier if input.dtype is dtypes.bool_ else later - earlier
    return result if n == 1 else diff(result, n - 1, dim)


def _running_best(better: Callable) -> Callable:
    def best_so_far(row: list[Any]) -> list[int]:
        places: list[int] = []
        for i, value in enumerate(row):
            keep = places and not (value != value or (row[places[-1]] == row[places[-1]] and better(value, row[places[-1]])))
            places.append(places[-1] if keep else i)
        return places

    return best_so_far


def _cumulative(name: str, better: Callable) -> Callable:
    def function(input: Tensor, dim: int) -> Any:
        if not input.ndim and dim not in (-1, 0):
            raise IndexError(f"{name}(): Expected reduction dim -1 or 0 for scalar but got {dim}")
        if not count(input.shape):
            return VALUES_AND_PLACES[name](input.clone(), make([], input.shape, dtypes.int64))
        places = _along(name, input, dim, _running_best(better), None, dtypes.int64)
        return VALUES_AND_PLACES[name](picked(input, dim, places), places)

    return function


cummax, cummin = _cumulative("cummax", operator.ge), _cumulative("cummin", operator.le)


def logcumsumexp(input: Tensor, dim: int) -> Tensor:
    axis_of(dim, input.ndim)
    floats_only("logcumsumexp_out_cpu", input.dtype)

    def send(g: list[float], row: list[float], out: list[float]) -> list[float]:
        return [sum(g[j] * exponential(x - out[j]) for j in range(i, len(row))) for i, x in enumerate(row)]

    return _along("Logcumsumexp", input, dim, lambda row: _running(row, log_add_exp), send, input.dtype)


def kthvalue(input: Tensor, k: int, dim: int = -1, keepdim: bool = False) -> Any:
    def which(values: list[Any]) -> int:
        return sorted(range(len(values)), key=lambda i: _rank(values[i]))[k - 1]

    return VALUES_AND_PLACES["kthvalue"](*chosen("kthvalue", input, dim, keepdim, which))


def bincount(input: Tensor, weights: Any = None, minlength: int = 0) -> Tensor:
    if weights is not None:
        raise Missing("torch.bincount with weights=")
    entries = input.flat()
    if input.ndim != 1 or input.dtype.category != 1 or min(entries, default=0) < 0:
        raise RuntimeError("bincount only supports 1-d non-negative integral inputs.")
    return make(
        [entries.count(i) for i in range(max(minlength, max(entries, default=-1) + 1))],
        (max(minlength, max(entries, default=-1) + 1),),
        dtypes.int64,
    )


def unique_consecutive(input: Tensor) -> Tensor:
    entries = input.flat()
    kept = [value for i, value in enumerate(entries) if not i or value != entries[i - 1]]
    return make(kept, (len(kept),), input.dtype)
