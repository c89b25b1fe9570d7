"""Many entries become one: sums, means, deviations, the largest."""

from __future__ import annotations

import math
import operator
from collections import namedtuple
from collections.abc import Callable, Sequence
from typing import Any

from . import dtypes
from .entrywise import OF_ONE, divide, entrywise, exponential, float_kind, guarded, maximum, minimum, where
from .making import inf, make, nan, record
from .missing import Missing
from .moving import picked
from .shapes import axes_of, axis_of, count, positions, strides_of
from .tensor import Storage, Tensor


def _named(name: str, *fields: str) -> Any:
    """A named tuple that shows itself as torch's do."""

    def shown(self: Any) -> str:
        entries = ",\n".join(f"{field}={value!r}" for field, value in zip(fields, self, strict=True))
        return f"torch.return_types.{name}(\n{entries})"

    return type(name, (namedtuple(name, fields),), {"__repr__": shown, "__slots__": ()})


VALUES_AND_PLACES: dict[str, Any] = {
    name: _named(name, "values", "indices") for name in ("min", "max", "sort", "topk", "cummax", "cummin", "median", "kthvalue")
}
VALUES_AND_PLACES["aminmax"] = _named("aminmax", "min", "max")


def groups_of(x: Tensor, axes: Sequence[int]) -> tuple[list[list[Any]], list[list[int]], tuple[int, ...]]:
    """The entries that are taken together, the places in reading order where they stand, and the shape with 1 along `axes`."""
    strides = strides_of(x.shape)
    kept = [1 if axis in axes else size for axis, size in enumerate(x.shape)]
    inner = positions([x.shape[axis] for axis in axes], [strides[axis] for axis in axes], 0)
    starts = positions(kept, strides, 0)
    flat = x.flat()
    places = [[start + jump for jump in inner] for start in starts]
    return [[flat[place] for place in group] for group in places], places, tuple(kept)


def _without(shape: Sequence[int], axes: Sequence[int]) -> tuple[int, ...]:
    return tuple(size for axis, size in enumerate(shape) if axis not in axes)


def reduced(
    name: str, x: Tensor, dim: Any, keepdim: bool, compute: Callable, kind: dtypes.dtype, slopes: Callable | None = None
) -> Tensor:
    """One number for each group of entries. `slopes` gives, for a group and its number, the derivative by each entry."""
    axes = axes_of(dim, x.ndim)
    groups, places, kept = groups_of(x, axes)
    numbers = kind.numbers(map(compute, groups))
    shape = kept if keepdim else _without(x.shape, axes)
    result = Tensor(Storage(numbers), shape, kind)
    if slopes is None:
        return result

    def send_back(gradient: Tensor) -> list[Tensor]:
        back = [0.0] * count(x.shape)
        for g, group, where_, number in zip(gradient.flat(), groups, places, numbers, strict=True):
            for place, slope in zip(where_, slopes(group, number), strict=True):
                back[place] = g * slope
        return [make(back, x.shape, x.dtype)]

    return record(result, f"{name}Backward0", [x], send_back, {"Sum": [], "Mean": [], "Var": [x]}.get(name, [x, result]))


def sum_kind(x: Tensor, kind: Any) -> dtypes.dtype:
    return kind or (x.dtype if x.dtype.is_floating_point else dtypes.int64)


def _total(values: list[Any]) -> Any:
    return math.fsum(values) if values and isinstance(values[0], float) and all(map(math.isfinite, values)) else sum(values)


def sum_(input: Tensor, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Tensor:
    return reduced("Sum", input, dim, keepdim, _total, sum_kind(input, dtype), lambda group, y: [1.0] * len(group))


def _floats_only(name: str, x: Tensor) -> None:
    if not x.dtype.is_floating_point:
        raise RuntimeError(
            f"{name}(): could not infer output dtype. Input dtype must be either a floating point or complex dtype. Got:"
            f" {x.dtype.long_name}"
        )


def mean(input: Tensor, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Tensor:
    x = input.to(dtype) if dtype else input
    _floats_only("mean", x)
    return reduced(
        "Mean",
        x,
        dim,
        keepdim,
        lambda v: divide(_total(v), len(v)),
        x.dtype,
        lambda group, y: [divide(1.0, len(group))] * len(group),
    )


def norm(input: Tensor, p: Any = 2, dim: Any = None, keepdim: bool = False) -> Tensor:
    if p not in (2, "fro", None):
        raise Missing(f"torch.norm with p={p!r}")
    if not input.dtype.is_floating_point:
        kind = input.dtype.long_name
        raise RuntimeError(f"linalg.vector_norm: Expected a floating point or complex tensor as input. Got {kind}")
    return root_or_zero(sum_(input * input, dim, keepdim))


def nansum(input: Tensor, dim: Any = None, keepdim: bool = False) -> Tensor:
    result = sum_(where(OF_ONE["isnan"](input), 0, input), dim, keepdim)
    if result.step is not None:
        result.step.relies_on = [(input, input.storage.version)]
    return result


def nanmean(input: Tensor, dim: Any = None, keepdim: bool = False) -> Tensor:
    if not input.dtype.is_floating_point:
        kind = input.dtype.long_name
        raise RuntimeError(f"nanmean(): expected input to have floating point or complex dtype but got {kind}")
    kept = ~OF_ONE["isnan"](input)
    return nansum(input, dim, keepdim) / sum_(kept, dim, keepdim)


def _correction(unbiased: Any, correction: Any) -> float:
    return correction if correction is not None else (1 if unbiased is None or unbiased else 0)


def var(input: Tensor, dim: Any = None, unbiased: Any = None, keepdim: bool = False, *, correction: Any = None) -> Tensor:
    if isinstance(dim, bool):  # var(x, False)
        dim, unbiased = None, dim
    if not input.dtype.is_floating_point:
        raise RuntimeError("std and var only support floating point and complex dtypes")
    less = _correction(unbiased, correction)

    def compute(values: list[float]) -> float:
        if not values:
            return nan
        centre = _total(values) / len(values)
        return divide(_total([(v - centre) ** 2 for v in values]), max(len(values) - less, 0))

    def slopes(group: list[float], y: float) -> list[float]:
        centre = divide(_total(group), len(group))
        return [divide(2 * (v - centre), max(len(group) - less, 0)) for v in group]

    return reduced("Var", input, dim, keepdim, compute, input.dtype, slopes)


def std(input: Tensor, dim: Any = None, unbiased: Any = None, keepdim: bool = False, *, correction: Any = None) -> Tensor:
    return root_or_zero(var(input, dim, unbiased, keepdim, correction=correction))


def root_or_zero(variance: Tensor) -> Tensor:
    """The deviation, whose derivative is taken as 0 where nothing deviates."""
    return entrywise(
        "std", guarded(math.sqrt), [lambda x, y: 0.5 / y if y > 0 else 0.0 if y == 0 else nan], [variance], keeps="result"
    )


def var_mean(
    input: Tensor, dim: Any = None, unbiased: Any = None, keepdim: bool = False, *, correction: Any = None
) -> tuple[Tensor, Tensor]:
    return var(input, dim, unbiased, keepdim, correction=correction), mean(input, dim, keepdim)


def std_mean(
    input: Tensor, dim: Any = None, unbiased: Any = None, keepdim: bool = False, *, correction: Any = None
) -> tuple[Tensor, Tensor]:
    return std(input, dim, unbiased, keepdim, correction=correction), mean(input, dim, keepdim)


def prod(input: Tensor, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Tensor:
    def slopes(group: list[float], y: float) -> list[float]:
        return [math.prod(v for j, v in enumerate(group) if j != i) for i in range(len(group))]

    return reduced("Prod", input, dim, keepdim, math.prod, sum_kind(input, dtype), slopes)


def all_(input: Tensor, dim: Any = None, keepdim: bool = False) -> Tensor:
    return reduced("all", input, dim, keepdim, all, dtypes.bool_)


def any_(input: Tensor, dim: Any = None, keepdim: bool = False) -> Tensor:
    return reduced("any", input, dim, keepdim, any, dtypes.bool_)


def count_nonzero(input: Tensor, dim: Any = None) -> Tensor:
    return sum_(input != 0, dim)


def _best(values: list[Any], better: Callable) -> int:
    if not values:
        raise IndexError("max(): Expected reduction dim to have non-zero size.")
    best = 0
    for i, value in enumerate(values):
        if value != value:
            return i
        if better(value, values[best]):
            best = i
    return best


def chosen(name: str, x: Tensor, axis: int, keepdim: bool, which: Callable) -> Any:
    """Along an axis the entry that is chosen, and where it stands."""
    axis = axis_of(axis, x.ndim)
    x_ = x if x.ndim else x.reshape(1)
    index = reduced(name, x_, axis, True, which, dtypes.int64)
    values = picked(x_, axis, index)
    if x.ndim and keepdim:
        return values, index
    return (values.squeeze(axis), index.squeeze(axis))


def _extreme(name: str, better: Callable, pairwise: Callable) -> Callable:
    def function(input: Tensor, dim: Any = None, keepdim: bool = False, *, other: Any = None) -> Any:
        if isinstance(dim, Tensor) or other is not None:
            return pairwise(input, dim if other is None else other)
        _not_of_nothing(name, input, dim)
        if dim is None:
            return extremes(input, (), False, better)
        return VALUES_AND_PLACES[name](*chosen(name, input, dim, keepdim, lambda v: _best(v, better)))

    return function


def extremes(x: Tensor, dim: Any, keepdim: bool, better: Callable) -> Tensor:
    """The largest or smallest; where several are, they share the gradient."""
    return shared("Amax", x, dim, keepdim, lambda values: _best(values, better))


def shared(name: str, x: Tensor, dim: Any, keepdim: bool, which: Callable) -> Tensor:
    """The entry that `which` chooses; all that are equal to it share the gradient."""

    def slopes(group: list[float], y: float) -> list[float]:
        ties = [v == y or (v != v and y != y) for v in group]
        return [tie / sum(ties) for tie in ties]

    return reduced(name, x, dim, keepdim, lambda values: values[which(values)] if values else nan, x.dtype, slopes)


max_ = _extreme("max", operator.gt, maximum)
min_ = _extreme("min", operator.lt, minimum)


def _not_of_nothing(name: str, x: Tensor, dim: Any) -> None:
    """Refuse to choose among no entries."""
    if count(x.shape) or not x.ndim:
        return
    if dim is None or dim == ():
        hint = "" if name.startswith("arg") else " Specify the reduction dim with the 'dim' argument."
        error = IndexError if name.startswith("arg") else RuntimeError
        raise error(f"{name}(): Expected reduction dim to be specified for input.numel() == 0.{hint}")
    for axis in dim if isinstance(dim, (tuple, list)) else [dim]:
        if not x.shape[axis_of(axis, x.ndim)]:
            shown = axis if name in ("amax", "amin") else axis_of(axis, x.ndim)
            raise IndexError(f"{name}(): Expected reduction dim {shown} to have non-zero size.")


def amax(input: Tensor, dim: Any = (), keepdim: bool = False) -> Tensor:
    _not_of_nothing("amax", input, dim)
    return extremes(input, dim, keepdim, operator.gt)


def amin(input: Tensor, dim: Any = (), keepdim: bool = False) -> Tensor:
    _not_of_nothing("amin", input, dim)
    return extremes(input, dim, keepdim, operator.lt)


def _arg(name: str, better: Callable) -> Callable:
    def function(input: Tensor, dim: int | None = None, keepdim: bool = False) -> Tensor:
        if input.dtype is dtypes.bool_:
            raise RuntimeError(f"{name}(): does not support bool input")
        _not_of_nothing(name, input, dim)
        return reduced("arg", input, dim, keepdim, lambda v: _best(v, better), dtypes.int64)

    return function


argmax, argmin = _arg("argmax", operator.gt), _arg("argmin", operator.lt)


def logsumexp(input: Tensor, dim: Any, keepdim: bool = False) -> Tensor:
    def compute(values: list[float]) -> float:
        if any(v != v for v in values):
            return nan
        top = max(values, default=-inf)
        if abs(top) == inf:
            return top
        return top + math.log(math.fsum(math.exp(v - top) for v in values))

    return reduced(
        "Logsumexp", input, dim, keepdim, compute, float_kind(input), lambda group, y: [exponential(v - y) for v in group]
    )


def aminmax(input: Tensor, *, dim: Any = None, keepdim: bool = False) -> Any:
    return VALUES_AND_PLACES["aminmax"](amin(input, dim, keepdim), amax(input, dim, keepdim))


def cov(input: Tensor, *, correction: int = 1) -> Tensor:
    x = input.unsqueeze(0) if input.ndim < 2 else input
    x = x.unsqueeze(0) if x.ndim < 2 else x
    if x.dtype is dtypes.bool_:
        raise RuntimeError("cov(): bool dtype is not supported for input")
    x = x if x.dtype.is_floating_point else x.to(dtypes.float32)
    if x.ndim > 2:
        raise RuntimeError(f"cov(): expected input to have two or fewer dimensions but got an input with {x.ndim} dimensions")
    deviation = x - mean(x, 1, True)
    return (deviation @ deviation.t() / max(x.shape[1] - correction, 0)).squeeze()


def corrcoef(input: Tensor) -> Tensor:
    covariance = cov(input)
    if not covariance.ndim:
        return covariance / covariance
    deviation = OF_ONE["sqrt"](covariance.diagonal())
    return (covariance / deviation.unsqueeze(1) / deviation.unsqueeze(0)).clamp(-1, 1)


def linalg_norm(x: Tensor, ord: Any = None, dim: Any = None, keepdim: bool = False) -> Tensor:
    if dim is None and x.ndim == 2 and ord not in (None, "fro"):
        raise Missing(f"torch.linalg.norm of a matrix with ord={ord!r}")
    return norm(x, 2 if ord in (None, "fro") else ord, dim, keepdim)
