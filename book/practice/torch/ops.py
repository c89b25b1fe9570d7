"""What can be done with tensors: each operation with its numbers and, where it has one, its derivative.

Operations on single entries go through `entrywise`; all others say themselves how the gradient of the result becomes that of the input.
"""

from __future__ import annotations

import math
import operator
from collections import namedtuple
from typing import Any, Callable, Sequence

from . import dtypes
from .autograd import Node, is_recording
from .tensor import Missing, Size, Storage, Tensor, axis_of, broadcast_shapes, count, from_nested, positions, spread, spread_strides, strides_of, sum_to

inf, nan = math.inf, math.nan


def make(numbers: Sequence[Any], shape: Sequence[int], kind: dtypes.dtype) -> Tensor:
    """A new tensor of these numbers, rounded to its kind."""
    return Tensor(Storage(kind.numbers(numbers)), shape, kind)


def record(result: Tensor, name: str, sources: Sequence[Tensor], send_back: Callable, relies_on: Sequence[Tensor] = ()) -> Tensor:
    """Let the result remember how it was made, if a gradient may be asked for."""
    if is_recording() and result.dtype.is_floating_point and any(source.requires_grad for source in sources):
        result.requires_grad, result.step = True, Node(name, sources, send_back, relies_on)
    return result


def tensor_like(value: Any, kind: dtypes.dtype | None = None) -> Tensor:
    """The tensor, or one of a Python number, which is not rounded until it meets another."""
    return value if isinstance(value, Tensor) else from_nested(value, kind or (dtypes.float64 if isinstance(value, float) else None))


def need_tensor(function: str, argument: str, position: int, value: Any) -> None:
    if not isinstance(value, Tensor):
        raise TypeError(f"{function}(): argument '{argument}' (position {position}) must be Tensor, not {type(value).__name__}")


# --------------------------------------------------------------------------------------------------------- entry by entry


def entrywise(
    name: str,
    compute: Callable,
    slopes: Sequence[Callable] | None,
    operands: Sequence[Any],
    kind: dtypes.dtype | None = None,
    keeps: str = "operands",
    chooses: bool = False,
) -> Tensor:
    """`compute` of each entry of the operands, which are spread to one shape.

    `slopes` has for each operand the derivative of `compute` with regard to it, a function of the entries and of the result's. `keeps`
    says which numbers it needs, and which must not be changed in place therefore: "operands", "others", "result" or "nothing". If
    `compute` only chooses among its operands, what is not chosen gets a gradient of 0, even of an infinite one.
    """
    tensors = [tensor_like(operand) for operand in operands]
    kind = kind or dtypes.result_type(*operands)
    shape = broadcast_shapes(*(tensor.shape for tensor in tensors))
    columns = [spread(tensor, shape) for tensor in tensors]
    if dtypes.float32 is kind and any(not isinstance(operand, Tensor) for operand in operands):
        columns = [column if isinstance(operand, Tensor) else kind.numbers(column) for column, operand in zip(columns, operands)]
    numbers = kind.numbers(map(compute, *columns))
    result = Tensor(Storage(numbers), shape, kind)
    if slopes is None:
        return result

    def send_back(gradient: Tensor) -> list[Tensor | None]:
        arriving = gradient.flat()
        back: list[Tensor | None] = []
        for tensor, slope in zip(tensors, slopes):
            if not tensor.requires_grad:
                back.append(None)
                continue
            slopes_here = [slope(*entries) for entries in zip(*columns, numbers)]
            parts = [g * s if s or not chooses else 0.0 for g, s in zip(arriving, slopes_here)]
            back.append(sum_to(make(parts, shape, tensor.dtype), tensor.shape))
        return back

    asked = [tensor.requires_grad for tensor in tensors]
    kept = {
        "operands": tensors,
        "others": [tensor for i, tensor in enumerate(tensors) if any(asked[:i] + asked[i + 1 :])],
        "result": [result],
        "nothing": [],
    }[keeps]
    return record(result, f"{name.capitalize()}Backward0", tensors, send_back, kept)


def _float_kind(x: Any) -> dtypes.dtype:
    return x.dtype if x.dtype.is_floating_point else dtypes.float32


def _guarded(function: Callable, overflow: float = inf) -> Callable:
    """Arithmetic as the processor does it, where Python would raise an error."""

    def safe(*entries: float) -> float:
        try:
            return function(*entries)
        except OverflowError:
            return overflow
        except (ValueError, ZeroDivisionError):
            return nan

    return safe


def divide(a: float, b: float) -> float:
    if b == 0:
        return nan if a == 0 or a != a else math.copysign(inf, a) * math.copysign(1.0, b)
    return a / b


def _log(x: float) -> float:
    return math.log(x) if x > 0 else (-inf if x == 0 else nan)


def _log1p(x: float) -> float:
    return math.log1p(x) if x > -1 else (-inf if x == -1 else nan)


def _sigmoid(x: float) -> float:
    if x >= 0:
        return 1 / (1 + math.exp(-x)) if x > -700 else 0.0
    e = math.exp(x)
    return e / (1 + e)


def _logsigmoid(x: float) -> float:
    return min(x, 0.0) - math.log1p(math.exp(-abs(x))) if x == x else nan


def _softplus(x: float) -> float:
    return x if x > 20 else math.log1p(_exp(x))


def _power(a: float, b: float) -> float:
    if a == 0 and b < 0:
        return inf if not (math.copysign(1, a) < 0 and b % 2 == 1) else -inf
    if a < 0 and isinstance(b, float) and b == b and abs(b) != inf and b != int(b):
        return nan
    try:
        return a**b
    except OverflowError:
        return -inf if a < 0 and b % 2 == 1 else inf


def _log_add_exp(a: float, b: float) -> float:
    top = a if a > b else b
    return top if abs(top) == inf else top + math.log1p(math.exp(-abs(a - b)))


def _sign(x: float) -> float:
    return (x > 0) - (x < 0) if x == x else x


def _smaller(a: Any, b: Any) -> Any:
    return a if a < b or a != a else b


def _larger(a: Any, b: Any) -> Any:
    return a if a > b or a != a else b


def _share(first: bool, second: bool) -> float:
    """Of a gradient that goes to whichever was chosen; where both were, half each."""
    return 0.5 if first and second else float(first)


_exp = _guarded(math.exp)
_expm1 = _guarded(math.expm1)

_UNARY: dict[str, tuple[Callable, Callable | None]] = {
    "exp": (_exp, lambda x, y: y),
    "expm1": (_expm1, lambda x, y: y + 1),
    "log": (_log, lambda x, y: divide(1.0, x)),
    "log2": (lambda x: _log(x) / math.log(2) if x > 0 and x != inf else _log(x), lambda x, y: divide(1.0, x * math.log(2))),
    "log10": (lambda x: math.log10(x) if x > 0 else _log(x), lambda x, y: divide(1.0, x * math.log(10))),
    "log1p": (_log1p, lambda x, y: divide(1.0, 1 + x)),
    "sqrt": (_guarded(math.sqrt), lambda x, y: divide(0.5, y)),
    "rsqrt": (lambda x: divide(1.0, _guarded(math.sqrt)(x)), lambda x, y: -0.5 * y**3),
    "reciprocal": (lambda x: divide(1.0, x), lambda x, y: -y * y),
    "sigmoid": (_sigmoid, lambda x, y: y * (1 - y)),
    "tanh": (math.tanh, lambda x, y: 1 - y * y),
    "sin": (_guarded(math.sin), lambda x, y: math.cos(x)),
    "cos": (_guarded(math.cos), lambda x, y: -math.sin(x)),
    "atan": (math.atan, lambda x, y: 1 / (1 + x * x)),
    "atanh": (lambda x: math.copysign(inf, x) if abs(x) == 1 else _guarded(math.atanh)(x), lambda x, y: divide(1.0, 1 - x * x)),
    "erf": (math.erf, lambda x, y: 2 / math.sqrt(math.pi) * math.exp(-x * x)),
}
_KEEPING: dict[str, tuple[Callable, Callable]] = {  # integers stay integers
    "abs": (abs, lambda x, y: _sign(x)),
    "neg": (operator.neg, lambda x, y: -1.0),
    "square": (lambda x: x * x, lambda x, y: 2 * x),
    "sign": (_sign, lambda x, y: 0.0),
    "floor": (lambda x: x if isinstance(x, int) or x != x or abs(x) == inf else math.floor(x), lambda x, y: 0.0),
    "ceil": (lambda x: x if isinstance(x, int) or x != x or abs(x) == inf else math.ceil(x), lambda x, y: 0.0),
    "round": (lambda x: x if isinstance(x, int) or x != x or abs(x) == inf else round(x), lambda x, y: 0.0),
    "relu": (lambda x: x if x > 0 or x != x else type(x)(0), lambda x, y: float(x > 0)),
}
_ASKING: dict[str, Callable] = {
    "isnan": lambda x: x != x,
    "isinf": lambda x: abs(x) == inf,
    "isfinite": lambda x: x == x and abs(x) != inf,
    "logical_not": operator.not_,
    "signbit": lambda x: math.copysign(1, x) < 0,
}


def _unary(name: str) -> Callable:
    def function(input: Tensor) -> Tensor:
        need_tensor(name, "input", 1, input)
        if name in _UNARY:
            compute, slope = _UNARY[name]
            keeps = "result" if name in ("exp", "expm1", "sigmoid", "tanh", "sqrt", "rsqrt", "reciprocal") else "operands"
            return entrywise(name, compute, [slope], [input], _float_kind(input), keeps)
        if name in _KEEPING:
            if input.dtype is dtypes.bool_ and name == "neg":
                raise RuntimeError(
                    "Negation, the `-` operator, on a bool tensor is not supported. If you are trying to invert a mask, use the `~` or"
                    " `logical_not()` operator instead."
                )
            compute, slope = _KEEPING[name]
            return entrywise(name, compute, [slope], [input], keeps="nothing" if name == "neg" else "operands", chooses=name == "relu")
        return entrywise(name, _ASKING[name], None, [input], dtypes.bool_)

    function.__name__ = name
    return function


UNARY = {name: _unary(name) for name in (*_UNARY, *_KEEPING, *_ASKING)}
exp, log, neg, sigmoid, square = (UNARY[name] for name in ("exp", "log", "neg", "sigmoid", "square"))
absolute = UNARY["abs"]


def _no_bool_minus(a: Any, b: Any) -> None:
    kinds = [isinstance(x, bool) or (isinstance(x, Tensor) and x.dtype is dtypes.bool_) for x in (a, b)]
    if all(kinds):
        raise RuntimeError(
            "Subtraction, the `-` operator, with two bool tensors is not supported. Use the `^` or `logical_xor()` operator instead."
        )
    if any(kinds):
        raise RuntimeError(
            "Subtraction, the `-` operator, with a bool tensor is not supported. If you are trying to invert a mask, use the `~` or"
            " `logical_not()` operator instead."
        )


def add(input: Any, other: Any, *, alpha: float = 1) -> Tensor:
    other = other if alpha == 1 else mul(other, alpha)
    return entrywise("add", operator.add, [lambda a, b, y: 1.0, lambda a, b, y: 1.0], [input, other], keeps="nothing")


def sub(input: Any, other: Any, *, alpha: float = 1) -> Tensor:
    _no_bool_minus(input, other)
    other = other if alpha == 1 else mul(other, alpha)
    return entrywise("sub", operator.sub, [lambda a, b, y: 1.0, lambda a, b, y: -1.0], [input, other], keeps="nothing")


def mul(input: Any, other: Any) -> Tensor:
    return entrywise("mul", operator.mul, [lambda a, b, y: b, lambda a, b, y: a], [input, other], keeps="others")


def div(input: Any, other: Any, *, rounding_mode: str | None = None) -> Tensor:
    if rounding_mode == "floor":
        return floor_divide(input, other)
    if rounding_mode is not None:
        raise Missing("div with this rounding_mode is not in the page's torch; it is in the notebook")
    kind = dtypes.result_type(input, other)
    kind = kind if kind.is_floating_point else dtypes.float32
    return entrywise("div", divide, [lambda a, b, y: divide(1.0, b), lambda a, b, y: -divide(y, b)], [input, other], kind)


def floor_divide(input: Any, other: Any) -> Tensor:
    return entrywise("floor_divide", lambda a, b: divide(a, b) if not b else a // b, None, [input, other])


def remainder(input: Any, other: Any) -> Tensor:
    return entrywise("remainder", _guarded(operator.mod), [lambda a, b, y: 1.0, lambda a, b, y: -float(a // b)], [input, other])


def pow_(input: Any, exponent: Any) -> Tensor:
    def by_base(a: float, b: float, y: float) -> float:
        return 0.0 if b == 0 else b * _power(a, b - 1)

    def by_exponent(a: float, b: float, y: float) -> float:
        return 0.0 if a == 0 and b >= 0 else y * _log(a)

    return entrywise("pow", _power, [by_base, by_exponent], [input, exponent])


def minimum(input: Tensor, other: Tensor) -> Tensor:
    need_tensor("minimum", "input", 1, input), need_tensor("minimum", "other", 2, other)
    return entrywise("minimum", _smaller, [lambda a, b, y: _share(a <= b, b <= a), lambda a, b, y: _share(b <= a, a <= b)], [input, other], chooses=True)


def maximum(input: Tensor, other: Tensor) -> Tensor:
    need_tensor("maximum", "input", 1, input), need_tensor("maximum", "other", 2, other)
    return entrywise("maximum", _larger, [lambda a, b, y: _share(a >= b, b >= a), lambda a, b, y: _share(b >= a, a >= b)], [input, other], chooses=True)


def logaddexp(input: Tensor, other: Tensor) -> Tensor:
    return entrywise("logaddexp", _log_add_exp, [lambda a, b, y: _exp(a - y), lambda a, b, y: _exp(b - y)], [input, other])


def clamp(input: Tensor, min: Any = None, max: Any = None) -> Tensor:  # noqa: A002
    need_tensor("clamp", "input", 1, input)
    if min is None and max is None:
        raise RuntimeError("torch.clamp: At least one of 'min' or 'max' must not be None")
    operands = [input, -inf if min is None else min, inf if max is None else max]
    kind = dtypes.result_type(*(x for x in (input, min, max) if x is not None))
    slopes = [
        lambda x, low, high, y: float(low <= x <= high),
        lambda x, low, high, y: float(x < low < high),
        lambda x, low, high, y: float(high < x or high < low),
    ]
    return entrywise("clamp", lambda x, low, high: x if x != x else _smaller(_larger(x, low), high), slopes, operands, kind, chooses=True)


def where(condition: Tensor, input: Any = None, other: Any = None) -> Any:
    need_tensor("where", "condition", 1, condition)
    if condition.dtype is not dtypes.bool_:
        raise RuntimeError(f"where expected condition to be a boolean tensor, but got a tensor with dtype {condition.dtype.long_name}")
    if input is None and other is None:
        return nonzero(condition, as_tuple=True)
    values = [tensor_like(input), tensor_like(other)]
    broadcast_shapes(values[0].shape, values[1].shape)
    kind = dtypes.result_type(input, other)
    result_shape = broadcast_shapes(condition.shape, values[0].shape, values[1].shape)
    kept = spread(condition, result_shape)
    columns = [spread(value, result_shape) for value in values]
    result = make([a if c else b for c, a, b in zip(kept, *columns)], result_shape, kind)

    def send_back(gradient: Tensor) -> list[Tensor]:
        arriving, back = gradient.flat(), []
        for value, wanted in zip(values, (True, False)):
            parts = [g if bool(c) is wanted else 0.0 for c, g in zip(kept, arriving)]
            back.append(sum_to(make(parts, result_shape, value.dtype if value.dtype.is_floating_point else gradient.dtype), value.shape))
        return back

    return record(result, "WhereBackward0", values, send_back)


def masked_fill(input: Tensor, mask: Tensor, value: Any) -> Tensor:
    if mask.dtype is not dtypes.bool_:
        raise RuntimeError(f"masked_fill_ only supports boolean masks, but got mask with dtype {mask.dtype.long_name.lower()}")
    return where(mask, tensor_like(value, input.dtype).to(input.dtype), input)


def nan_to_num(input: Tensor, nan: float = 0.0, posinf: float | None = None, neginf: float | None = None) -> Tensor:
    largest = 1.7976931348623157e308 if input.dtype is dtypes.float64 else 3.4028234663852886e38
    high, low = largest if posinf is None else posinf, -largest if neginf is None else neginf
    return entrywise(
        "nan_to_num",
        lambda x: nan if x != x else high if x == inf else low if x == -inf else x,
        [lambda x, y: float(x == x and abs(x) != inf)],
        [input],
    )


def addcmul(input: Tensor, tensor1: Tensor, tensor2: Tensor, *, value: float = 1) -> Tensor:
    return input + value * tensor1 * tensor2


def addcdiv(input: Tensor, tensor1: Tensor, tensor2: Tensor, *, value: float = 1) -> Tensor:
    return input + value * tensor1 / tensor2


def lerp(input: Tensor, end: Tensor, weight: Any) -> Tensor:
    return input + weight * (end - input)


def _comparing(name: str, compare: Callable) -> Callable:
    def function(input: Any, other: Any) -> Tensor:
        return entrywise(name, compare, None, [input, other], dtypes.bool_)

    function.__name__ = name
    return function


COMPARING = {name: _comparing(name, getattr(operator, name)) for name in ("eq", "ne", "lt", "le", "gt", "ge")}
COMPARING |= {
    "logical_and": _comparing("logical_and", lambda a, b: bool(a) and bool(b)),
    "logical_or": _comparing("logical_or", lambda a, b: bool(a) or bool(b)),
    "logical_xor": _comparing("logical_xor", lambda a, b: bool(a) is not bool(b)),
}


def _bitwise(name: str, compute: Callable) -> Callable:
    def function(input: Any, other: Any) -> Tensor:
        for operand in (input, other):
            if (operand.dtype.category == 2) if isinstance(operand, Tensor) else isinstance(operand, float):
                kind = dtypes.result_type(input, other).long_name
                raise NotImplementedError(f'"bitwise_{name}_cpu" not implemented for \'{kind}\'')
        return entrywise(name, compute, None, [input, other])

    return function


bitwise_and = _bitwise("and", operator.and_)
bitwise_or = _bitwise("or", operator.or_)
bitwise_xor = _bitwise("xor", operator.xor)


def bitwise_not(input: Tensor) -> Tensor:
    if input.dtype.category == 2:
        raise TypeError("~ (operator.invert) is only implemented on integer and Boolean-type tensors")
    return entrywise("not", operator.not_ if input.dtype is dtypes.bool_ else operator.invert, None, [input])


def isclose(input: Tensor, other: Tensor, rtol: float = 1e-05, atol: float = 1e-08, equal_nan: bool = False) -> Tensor:
    def close(a: Any, b: Any) -> bool:
        if a != a or b != b:
            return equal_nan and a != a and b != b
        return a == b or (abs(b) != inf and abs(a) != inf and abs(a - b) <= atol + rtol * abs(b))

    return entrywise("isclose", close, None, [input, other], dtypes.bool_)


def allclose(input: Tensor, other: Tensor, rtol: float = 1e-05, atol: float = 1e-08, equal_nan: bool = False) -> bool:
    return all(isclose(input, other, rtol, atol, equal_nan).flat())


def equal(input: Tensor, other: Tensor) -> bool:
    return input.shape == other.shape and input.flat() == other.flat() and not any(x != x for x in input.flat())


# ---------------------------------------------------------------------------------------------------------------- new ones


def tensor(data: Any, *, dtype: Any = None, device: Any = None, requires_grad: bool = False) -> Tensor:
    return from_nested(data, dtype).requires_grad_(requires_grad) if requires_grad else from_nested(data, dtype)


def as_tensor(data: Any, dtype: Any = None, device: Any = None) -> Tensor:
    return data.to(dtype or data.dtype) if isinstance(data, Tensor) else from_nested(data, dtype)


def _sizes(size: Sequence[Any]) -> tuple[int, ...]:
    size = size[0] if len(size) == 1 and isinstance(size[0], (tuple, list)) else size
    return tuple(operator.index(entry) for entry in size)


def full(size: Sequence[int], fill_value: Any, *, dtype: Any = None, device: Any = None, requires_grad: bool = False) -> Tensor:
    shape = _sizes((size,))
    fill = fill_value.item() if isinstance(fill_value, Tensor) else fill_value
    result = make([fill] * count(shape), shape, dtype or dtypes.of_number(fill))
    return result.requires_grad_() if requires_grad else result


def zeros(*size: Any, dtype: Any = None, device: Any = None, requires_grad: bool = False) -> Tensor:
    return full(_sizes(size), 0, dtype=dtype or dtypes.float32, requires_grad=requires_grad)


def ones(*size: Any, dtype: Any = None, device: Any = None, requires_grad: bool = False) -> Tensor:
    return full(_sizes(size), 1, dtype=dtype or dtypes.float32, requires_grad=requires_grad)


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


# --------------------------------------------------------------------------------------------------------------- reductions

minmax = {name: namedtuple(name, ["values", "indices"]) for name in ("min", "max", "sort", "topk", "cummax", "median")}


def _axes(dim: Any, dims: int) -> tuple[int, ...]:
    if dim is None or dim == () or dim == []:
        return tuple(range(dims))
    axes = tuple(axis_of(axis, dims) for axis in (dim if isinstance(dim, (tuple, list)) else (dim,)))
    if len(set(axes)) < len(axes):
        raise RuntimeError(f"dim {axes[0]} appears multiple times in the list of dims")
    return axes if dims else ()


def _groups(x: Tensor, axes: Sequence[int]) -> tuple[list[list[Any]], list[Sequence[int]], tuple[int, ...]]:
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


def _reduce(name: str, x: Tensor, dim: Any, keepdim: bool, compute: Callable, kind: dtypes.dtype, slopes: Callable | None = None) -> Tensor:
    """One number for each group of entries. `slopes` gives, for a group and its number, the derivative by each entry."""
    axes = _axes(dim, x.ndim)
    groups, places, kept = _groups(x, axes)
    numbers = kind.numbers(map(compute, groups))
    shape = kept if keepdim else _without(x.shape, axes)
    result = Tensor(Storage(numbers), shape, kind)
    if slopes is None:
        return result

    def send_back(gradient: Tensor) -> list[Tensor]:
        back = [0.0] * count(x.shape)
        for g, group, where_, number in zip(gradient.flat(), groups, places, numbers):
            for place, slope in zip(where_, slopes(group, number)):
                back[place] = g * slope
        return [make(back, x.shape, x.dtype)]

    return record(result, f"{name}Backward0", [x], send_back, [] if name in ("Sum", "Mean") else [x])


def _sum_kind(x: Tensor, kind: Any) -> dtypes.dtype:
    return kind or (x.dtype if x.dtype.is_floating_point else dtypes.int64)


def _total(values: list[Any]) -> Any:
    return math.fsum(values) if values and isinstance(values[0], float) and all(map(math.isfinite, values)) else sum(values)


def sum_(input: Tensor, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Tensor:
    return _reduce("Sum", input, dim, keepdim, _total, _sum_kind(input, dtype), lambda group, y: [1.0] * len(group))


def _floats_only(name: str, x: Tensor) -> None:
    if not x.dtype.is_floating_point:
        raise RuntimeError(
            f"{name}(): could not infer output dtype. Input dtype must be either a floating point or complex dtype. Got: {x.dtype.long_name}"
        )


def mean(input: Tensor, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Tensor:
    x = input.to(dtype) if dtype else input
    _floats_only("mean", x)
    return _reduce(
        "Mean", x, dim, keepdim, lambda v: divide(_total(v), len(v)), x.dtype, lambda group, y: [1 / len(group)] * len(group)
    )


def norm(input: Tensor, p: Any = 2, dim: Any = None, keepdim: bool = False) -> Tensor:
    if p not in (2, "fro", None):
        raise Missing("a norm other than the Euclidean one is not in the page's torch; it is in the notebook")
    return _root_or_zero(sum_(input * input, dim, keepdim))


def nansum(input: Tensor, dim: Any = None, keepdim: bool = False) -> Tensor:
    return sum_(where(UNARY["isnan"](input), 0, input), dim, keepdim)


def nanmean(input: Tensor, dim: Any = None, keepdim: bool = False) -> Tensor:
    kept = ~UNARY["isnan"](input)
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
        centre = _total(group) / len(group)
        return [divide(2 * (v - centre), max(len(group) - less, 0)) for v in group]

    return _reduce("Var", input, dim, keepdim, compute, input.dtype, slopes)


def std(input: Tensor, dim: Any = None, unbiased: Any = None, keepdim: bool = False, *, correction: Any = None) -> Tensor:
    return _root_or_zero(var(input, dim, unbiased, keepdim, correction=correction))


def _root_or_zero(variance: Tensor) -> Tensor:
    """The deviation, whose derivative is taken as 0 where nothing deviates."""
    return entrywise("std", _guarded(math.sqrt), [lambda x, y: 0.5 / y if y > 0 else 0.0 if y == 0 else nan], [variance])


def var_mean(input: Tensor, dim: Any = None, unbiased: Any = None, keepdim: bool = False, *, correction: Any = None) -> tuple[Tensor, Tensor]:
    return var(input, dim, unbiased, keepdim, correction=correction), mean(input, dim, keepdim)


def std_mean(input: Tensor, dim: Any = None, unbiased: Any = None, keepdim: bool = False, *, correction: Any = None) -> tuple[Tensor, Tensor]:
    return std(input, dim, unbiased, keepdim, correction=correction), mean(input, dim, keepdim)


def prod(input: Tensor, dim: Any = None, keepdim: bool = False, *, dtype: Any = None) -> Tensor:
    def slopes(group: list[float], y: float) -> list[float]:
        return [math.prod(v for j, v in enumerate(group) if j != i) for i in range(len(group))]

    return _reduce("Prod", input, dim, keepdim, math.prod, _sum_kind(input, dtype), slopes)


def all_(input: Tensor, dim: Any = None, keepdim: bool = False) -> Tensor:
    return _reduce("all", input, dim, keepdim, all, dtypes.bool_)


def any_(input: Tensor, dim: Any = None, keepdim: bool = False) -> Tensor:
    return _reduce("any", input, dim, keepdim, any, dtypes.bool_)


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


def _chosen(name: str, x: Tensor, axis: int, keepdim: bool, which: Callable) -> Any:
    """Along an axis the entry that is chosen, and where it stands."""
    axis = axis_of(axis, x.ndim)
    x_ = x if x.ndim else x.reshape(1)
    index = _reduce(name, x_, axis, True, which, dtypes.int64)
    values = gather(x_, axis, index)
    if x.ndim and keepdim:
        return values, index
    return (values.squeeze(axis), index.squeeze(axis))


def _extreme(name: str, better: Callable, pairwise: Callable) -> Callable:
    def function(input: Tensor, dim: Any = None, keepdim: bool = False, *, other: Any = None) -> Any:
        if isinstance(dim, Tensor) or other is not None:
            return pairwise(input, dim if other is None else other)
        if dim is None:
            if not count(input.shape):
                raise RuntimeError(f"{name}(): Expected reduction dim to be specified for input.numel() == 0. Specify the reduction dim with the 'dim' argument.")
            return extremes(input, (), False, better)
        return minmax[name](*_chosen(name, input, dim, keepdim, lambda v: _best(v, better)))

    return function


def extremes(x: Tensor, dim: Any, keepdim: bool, better: Callable) -> Tensor:
    """The largest or smallest; where several are, they share the gradient."""

    def slopes(group: list[float], y: float) -> list[float]:
        ties = [v == y or (v != v and y != y) for v in group]
        return [tie / sum(ties) for tie in ties]

    return _reduce("Amax", x, dim, keepdim, lambda v: v[_best(v, better)], x.dtype, slopes)


max_ = _extreme("max", operator.gt, maximum)
min_ = _extreme("min", operator.lt, minimum)


def amax(input: Tensor, dim: Any = (), keepdim: bool = False) -> Tensor:
    return extremes(input, dim, keepdim, operator.gt)


def amin(input: Tensor, dim: Any = (), keepdim: bool = False) -> Tensor:
    return extremes(input, dim, keepdim, operator.lt)


def _arg(better: Callable) -> Callable:
    def function(input: Tensor, dim: int | None = None, keepdim: bool = False) -> Tensor:
        return _reduce("arg", input, dim, keepdim, lambda v: _best(v, better), dtypes.int64)

    return function


argmax, argmin = _arg(operator.gt), _arg(operator.lt)


def logsumexp(input: Tensor, dim: Any, keepdim: bool = False) -> Tensor:
    def compute(values: list[float]) -> float:
        top = max(values, default=-inf)
        if abs(top) == inf or top != top:
            return top
        return top + math.log(math.fsum(math.exp(v - top) for v in values))

    return _reduce("Logsumexp", input, dim, keepdim, compute, _float_kind(input), lambda group, y: [_exp(v - y) for v in group])


def median(input: Tensor, dim: Any = None, keepdim: bool = False) -> Any:
    def which(values: list[Any]) -> int:
        return sorted(range(len(values)), key=values.__getitem__)[(len(values) - 1) // 2]

    if dim is None:
        return _chosen("median", input.reshape(-1), 0, False, which)[0]
    return minmax["median"](*_chosen("median", input, dim, keepdim, which))


def quantile(input: Tensor, q: Any, dim: Any = None, keepdim: bool = False) -> Tensor:
    levels = tensor_like(q, input.dtype)
    parts = [_quantile(input, level, dim, keepdim) for level in levels.reshape(-1).tolist()]
    return stack(parts) if levels.ndim else parts[0]


def _quantile(x: Tensor, level: float, dim: Any, keepdim: bool) -> Tensor:
    x, dim = (x.reshape(-1), 0) if dim is None else (x, dim)
    ordered = sort(x, dim).values
    at = level * (x.shape[axis_of(dim, x.ndim)] - 1)
    low, high = math.floor(at), math.ceil(at)
    parts = [index_select(ordered, dim, tensor([i])) for i in (low, high)]
    result = parts[0] + (parts[1] - parts[0]) * (at - low)
    return result if keepdim else result.squeeze(dim)


# ------------------------------------------------------------------------------------------------------ along one axis


def _along(name: str, x: Tensor, axis: int, compute: Callable, send: Callable | None, kind: dtypes.dtype) -> Tensor:
    """As many numbers as there are, made of each row along `axis`. `send` takes a row's gradient, its entries and its results."""
    axis = axis_of(axis, x.ndim)
    groups, places, _ = _groups(x, [axis] if x.ndim else [])
    rows = [kind.numbers(compute(group)) for group in groups]

    def arranged(parts: Sequence[Sequence[Any]], kind: dtypes.dtype) -> Tensor:
        numbers: list[Any] = [0] * count(x.shape)
        for where_, row in zip(places, parts):
            for place, value in zip(where_, row):
                numbers[place] = value
        return make(numbers, x.shape, kind)

    result = arranged(rows, kind)
    if send is None:
        return result

    def send_back(gradient: Tensor) -> list[Tensor]:
        arriving = gradient.flat()
        return [arranged([send([arriving[p] for p in where_], group, row) for where_, group, row in zip(places, groups, rows)], x.dtype)]

    keeps = {"Cumprod": [x], "Softmax": [result], "LogSoftmax": [result]}.get(name, [])
    return record(result, f"{name}Backward0", [x], send_back, keeps)


def _float_rows(name: str, x: Tensor, dtype: Any) -> Tensor:
    x = x.to(dtype) if dtype else x
    if not x.dtype.is_floating_point:
        raise NotImplementedError(f'"{name}_lastdim_kernel_impl" not implemented for \'{x.dtype.long_name}\'')
    return x


def _log_softmax_row(row: list[float]) -> list[float]:
    top = max(row, default=0.0)
    if abs(top) == inf or any(v != v for v in row):
        return [nan] * len(row)
    total = math.log(math.fsum(math.exp(v - top) for v in row))
    return [v - top - total for v in row]


def log_softmax(input: Tensor, dim: int, *, dtype: Any = None) -> Tensor:
    x = _float_rows("log_softmax", input, dtype)

    def send(g: list[float], row: list[float], out: list[float]) -> list[float]:
        total = sum(g)
        return [a - math.exp(b) * total for a, b in zip(g, out)]

    return _along("LogSoftmax", x, dim, _log_softmax_row, send, x.dtype)


def softmax(input: Tensor, dim: int, *, dtype: Any = None) -> Tensor:
    x = _float_rows("softmax", input, dtype)

    def send(g: list[float], row: list[float], out: list[float]) -> list[float]:
        total = sum(a * b for a, b in zip(g, out))
        return [b * (a - total) for a, b in zip(g, out)]

    return _along("Softmax", x, dim, lambda row: [math.exp(v) for v in _log_softmax_row(row)], send, x.dtype)


def _running(values: list[Any], combine: Callable) -> list[Any]:
    result: list[Any] = []
    for value in values:
        result.append(combine(result[-1], value) if result else value)
    return result


def cumsum(input: Tensor, dim: int, *, dtype: Any = None) -> Tensor:
    def send(g: list[float], row: list[float], out: list[float]) -> list[float]:
        return _running(g[::-1], operator.add)[::-1]

    return _along("Cumsum", input, dim, lambda row: _running(row, operator.add), send, _sum_kind(input, dtype))


def cumprod(input: Tensor, dim: int, *, dtype: Any = None) -> Tensor:
    def send(g: list[float], row: list[float], out: list[float]) -> list[float]:
        return [
            sum(g[j] * math.prod(v for k, v in enumerate(row[: j + 1]) if k != i) for j in range(i, len(row)))
            for i in range(len(row))
        ]

    return _along("Cumprod", input, dim, lambda row: _running(row, operator.mul), send, _sum_kind(input, dtype))


def argsort(input: Tensor, dim: int = -1, descending: bool = False, stable: bool = True) -> Tensor:
    def order(row: list[Any]) -> list[int]:
        return sorted(range(len(row)), key=lambda i: -row[i] if descending else row[i])

    return _along("sort", input, dim, order, None, dtypes.int64)


def sort(input: Tensor, dim: int = -1, descending: bool = False, stable: bool = True) -> Any:
    indices = argsort(input, dim, descending)
    return minmax["sort"](gather(input, dim, indices), indices)


def topk(input: Tensor, k: int, dim: int = -1, largest: bool = True, sorted: bool = True) -> Any:  # noqa: A002
    indices = argsort(input, dim, largest).narrow(dim, 0, k)
    return minmax["topk"](gather(input, dim, indices), indices)


def diff(input: Tensor, n: int = 1, dim: int = -1) -> Tensor:
    length = input.shape[axis_of(dim, input.ndim)]
    later, earlier = input.narrow(dim, 1, length - 1), input.narrow(dim, 0, length - 1)
    result = later != earlier if input.dtype is dtypes.bool_ else later - earlier
    return result if n == 1 else diff(result, n - 1, dim)


# ----------------------------------------------------------------------------------------------------- moved, not computed


def _rearranged(name: str, x: Tensor, places: Sequence[int], shape: Sequence[int]) -> Tensor:
    """The entries at `places`, in reading order of x; the gradient goes back to where each came from."""
    flat = x.flat()
    result = Tensor(Storage([flat[place] for place in places]), shape, x.dtype)

    def send_back(gradient: Tensor) -> list[Tensor]:
        numbers = [0.0] * count(x.shape)
        for place, value in zip(places, gradient.flat()):
            numbers[place] += value
        return [make(numbers, x.shape, x.dtype)]

    return record(result, f"{name}Backward0", [x], send_back)


def _own_places(x: Tensor) -> Tensor:
    return Tensor(Storage(list(range(count(x.shape)))), x.shape, dtypes.int64)


def gather(input: Tensor, dim: int, index: Tensor) -> Tensor:
    if index.dtype is not dtypes.int64:
        raise RuntimeError("gather(): Expected dtype int32/int64 for index")
    if index.ndim != input.ndim:
        raise RuntimeError("Index tensor must have the same number of dimensions as input tensor")
    axis = axis_of(dim, input.ndim)
    if any(size > own for i, (size, own) in enumerate(zip(index.shape, input.shape)) if i != axis):
        raise RuntimeError(
            f"Size does not match at dimension {next(i for i, (s, o) in enumerate(zip(index.shape, input.shape)) if i != axis and s > o)}"
            f" expected index {list(index.shape)} to be no larger than self {list(input.shape)} apart from dimension {dim}"
        )
    strides = list(strides_of(input.shape))
    along, strides[axis : axis + 1] = strides[axis] if strides else 1, [0] if strides else []
    places = []
    for start, chosen in zip(positions(index.shape, strides, 0), index.flat()):
        if not 0 <= chosen < (input.shape[axis] if input.shape else 1):
            raise RuntimeError(f"index {chosen} is out of bounds for dimension {axis} with size {input.shape[axis]}")
        places.append(start + chosen * along)
    return _rearranged("Gather", input, places, index.shape)


take_along_dim = lambda input, indices, dim: gather(input, dim, indices)  # noqa: E731


def index_select(input: Tensor, dim: int, index: Tensor) -> Tensor:
    return input[(slice(None),) * axis_of(dim, input.ndim) + (index,)]


def masked_select(input: Tensor, mask: Tensor) -> Tensor:
    shape = broadcast_shapes(input.shape, mask.shape)
    return input.expand(shape)[mask.expand(shape)]


def nonzero(input: Tensor, *, as_tuple: bool = False) -> Any:
    mask = input != 0
    strides = strides_of(mask.shape)
    found = [place for place, kept in enumerate(mask.flat()) if kept]
    columns = [[place // stride % size for place in found] for stride, size in zip(strides, mask.shape)]
    if as_tuple:
        return tuple(make(column, (len(found),), dtypes.int64) for column in columns)
    return make([column[i] for i in range(len(found)) for column in columns], (len(found), mask.ndim), dtypes.int64)


def argwhere(input: Tensor) -> Tensor:
    return nonzero(input)


def flip(input: Tensor, *dims: Any) -> Tensor:
    if not dims:
        raise TypeError('flip() missing 1 required positional arguments: "dims"')
    axes = _axes(dims[0] if len(dims) == 1 else dims, input.ndim)
    strides = strides_of(input.shape)
    first = sum((input.shape[axis] - 1) * strides[axis] for axis in axes)
    turned = [-stride if axis in axes else stride for axis, stride in enumerate(strides)]
    return _rearranged("Flip", input, positions(input.shape, turned, first), input.shape)


def roll(input: Tensor, shifts: Any, dims: Any = None) -> Tensor:
    if dims is None:
        return roll(input.reshape(-1), shifts, 0).reshape(input.shape)
    pairs = zip(shifts, dims) if isinstance(shifts, (tuple, list)) else [(shifts, dims)]
    places = _own_places(input)
    for shift, dim in pairs:
        axis = axis_of(dim, input.ndim)
        size = input.shape[axis]
        places = index_select(places, axis, tensor([(i - shift) % size for i in range(size)]))
    return _rearranged("Roll", input, places.flat(), input.shape)


def cat(tensors: Sequence[Tensor], dim: int = 0) -> Tensor:
    tensors = list(tensors)
    if not tensors:
        raise ValueError("torch.cat(): expected a non-empty list of Tensors")
    if any(not t.shape for t in tensors):
        raise RuntimeError(f"zero-dimensional tensor (at position {next(i for i, t in enumerate(tensors) if not t.shape)}) cannot be concatenated")
    tensors = [t for t in tensors if t.shape != (0,)] or tensors[:1]
    axis = axis_of(dim, tensors[0].ndim)
    for number, other in enumerate(tensors):
        if other.ndim != tensors[0].ndim:
            raise RuntimeError(f"Tensors must have same number of dimensions: got {tensors[0].ndim} and {other.ndim}")
        for i, (want, got) in enumerate(zip(tensors[0].shape, other.shape)):
            if i != axis and want != got:
                raise RuntimeError(
                    f"Sizes of tensors must match except in dimension {axis}. Expected size {want} but got size {got} for tensor number"
                    f" {number} in the list."
                )
    kind = dtypes.result_type(*tensors)
    shape = list(tensors[0].shape)
    shape[axis] = sum(t.shape[axis] for t in tensors)
    outer, flats = count(shape[:axis]), [t.flat() for t in tensors]
    widths = [count(t.shape[axis:]) for t in tensors]
    numbers = [value for i in range(outer) for flat, width in zip(flats, widths) for value in flat[i * width : (i + 1) * width]]

    def send_back(gradient: Tensor) -> list[Tensor]:
        back, at = [], 0
        for t in tensors:
            part = gradient.narrow(axis, at, t.shape[axis])
            back.append(part.to(t.dtype) if t.dtype.is_floating_point else part)
            at += t.shape[axis]
        return back

    return record(make(numbers, shape, kind), "CatBackward0", tensors, send_back)


concat = concatenate = cat


def stack(tensors: Sequence[Tensor], dim: int = 0) -> Tensor:
    tensors = list(tensors)
    if not tensors:
        raise RuntimeError("stack expects a non-empty TensorList")
    for number, other in enumerate(tensors):
        if other.shape != tensors[0].shape:
            raise RuntimeError(
                f"stack expects each tensor to be equal size, but got {list(tensors[0].shape)} at entry 0 and {list(other.shape)} at entry {number}"
            )
    axis = axis_of(dim, tensors[0].ndim + 1)
    return cat([t.unsqueeze(axis) for t in tensors], axis)


def tril(input: Tensor, diagonal: int = 0) -> Tensor:
    return _triangle(input, lambda i, j: j - i <= diagonal)


def triu(input: Tensor, diagonal: int = 0) -> Tensor:
    return _triangle(input, lambda i, j: j - i >= diagonal)


def _triangle(x: Tensor, keeps: Callable[[int, int], bool]) -> Tensor:
    rows, columns = x.shape[-2:]
    return where(make([keeps(i, j) for i in range(rows) for j in range(columns)], (rows, columns), dtypes.bool_), x, 0)


# ------------------------------------------------------------------------------------------------------------------ views


def view_of(x: Tensor, shape: Sequence[int], strides: Sequence[int], offset: int | None = None) -> Tensor:
    return x.as_view(shape, strides, x.offset if offset is None else offset)


def _with_inferred(shape: Sequence[int], total: int) -> tuple[int, ...]:
    shape = tuple(operator.index(size) for size in shape)
    known = count([size for size in shape if size != -1])
    fits = total == known if -1 not in shape else known and total % known == 0 and shape.count(-1) == 1
    if not fits:
        raise RuntimeError(f"shape '{list(shape)}' is invalid for input of size {total}")
    return tuple(total // known if size == -1 else size for size in shape)


def reshape(input: Tensor, *shape: Any) -> Tensor:
    sizes = _with_inferred(_sizes(shape), count(input.shape))
    x = input if input.is_contiguous() else input.clone()
    return view_of(x, sizes, strides_of(sizes))


def view(input: Tensor, *shape: Any) -> Tensor:
    sizes = _with_inferred(_sizes(shape), count(input.shape))
    if not input.is_contiguous():
        raise RuntimeError(
            "view size is not compatible with input tensor's size and stride (at least one dimension spans across two contiguous subspaces)."
            " Use .reshape(...) instead."
        )
    return view_of(input, sizes, strides_of(sizes))


def flatten(input: Tensor, start_dim: int = 0, end_dim: int = -1) -> Tensor:
    first, last = axis_of(start_dim, input.ndim), axis_of(end_dim, input.ndim)
    return reshape(input, (*input.shape[:first], count(input.shape[first : last + 1]), *input.shape[last + 1 :]))


def unsqueeze(input: Tensor, dim: int) -> Tensor:
    axis = axis_of(dim, input.ndim + 1)
    return view_of(input, (*input.shape[:axis], 1, *input.shape[axis:]), (*input.strides[:axis], 1, *input.strides[axis:]))


def squeeze(input: Tensor, dim: Any = None) -> Tensor:
    axes = _axes(dim, input.ndim)
    kept = [axis for axis in range(input.ndim) if axis not in axes or input.shape[axis] != 1]
    return view_of(input, [input.shape[axis] for axis in kept], [input.strides[axis] for axis in kept])


def permute(input: Tensor, *dims: Any) -> Tensor:
    axes = [axis_of(dim, input.ndim) for dim in _flat_arguments(dims)]
    return view_of(input, [input.shape[axis] for axis in axes], [input.strides[axis] for axis in axes])


def _flat_arguments(dims: Sequence[Any]) -> Sequence[Any]:
    return dims[0] if len(dims) == 1 and isinstance(dims[0], (tuple, list)) else dims


def transpose(input: Tensor, dim0: int, dim1: int) -> Tensor:
    axes = list(range(input.ndim))
    a, b = axis_of(dim0, input.ndim), axis_of(dim1, input.ndim)
    if axes:
        axes[a], axes[b] = axes[b], axes[a]
    return permute(input, axes)


def t(input: Tensor) -> Tensor:
    if input.ndim > 2:
        raise RuntimeError(f"t() expects a tensor with <= 2 dimensions, but self is {input.ndim}D")
    return transpose(input, 0, 1) if input.ndim == 2 else input


def movedim(input: Tensor, source: int, destination: int) -> Tensor:
    axes = [axis for axis in range(input.ndim) if axis != axis_of(source, input.ndim)]
    axes.insert(axis_of(destination, input.ndim), axis_of(source, input.ndim))
    return permute(input, axes)


def expand(input: Tensor, *sizes: Any) -> Tensor:
    wanted = list(_sizes(sizes))
    lead = len(wanted) - input.ndim
    if lead < 0:
        raise RuntimeError(
            f"expand(torch.{input.dtype.long_name}Tensor{{{list(input.shape)}}}, size={wanted}): the number of sizes provided ({len(wanted)})"
            f" must be greater or equal to the number of dimensions in the tensor ({input.ndim})"
        )
    shape = [input.shape[axis - lead] if size == -1 and axis >= lead else size for axis, size in enumerate(wanted)]
    for axis, (size, want) in enumerate(zip(input.shape, shape[lead:])):
        if size not in (1, want):
            raise RuntimeError(
                f"The expanded size of the tensor ({want}) must match the existing size ({size}) at non-singleton dimension {lead + axis}."
                f"  Target sizes: {wanted}.  Tensor sizes: {list(input.shape)}"
            )
    return view_of(input, shape, spread_strides(input, shape))


def broadcast_to(input: Tensor, size: Sequence[int]) -> Tensor:
    return expand(input, size)


def broadcast_tensors(*tensors: Tensor) -> tuple[Tensor, ...]:
    shape = broadcast_shapes(*(x.shape for x in tensors))
    return tuple(expand(x, shape) for x in tensors)


def narrow(input: Tensor, dim: int, start: int, length: int) -> Tensor:
    return input[(slice(None),) * axis_of(dim, input.ndim) + (slice(start, start + length),)]


def select(input: Tensor, dim: int, index: int) -> Tensor:
    return input[(slice(None),) * axis_of(dim, input.ndim) + (index,)]


def unbind(input: Tensor, dim: int = 0) -> tuple[Tensor, ...]:
    return tuple(select(input, dim, i) for i in range(input.shape[axis_of(dim, input.ndim)]))


def split(input: Tensor, split_size_or_sections: Any, dim: int = 0) -> tuple[Tensor, ...]:
    length = input.shape[axis_of(dim, input.ndim)]
    sizes = split_size_or_sections
    if isinstance(sizes, int):
        sizes = [min(sizes, length - start) for start in range(0, length, sizes)] or [0]
    if sum(sizes) != length:
        raise RuntimeError(
            f"split_with_sizes expects split_sizes to sum exactly to {length} (input tensor's size at dimension {dim}), but got"
            f" split_sizes={list(sizes)}"
        )
    starts = [sum(sizes[:i]) for i in range(len(sizes))]
    return tuple(narrow(input, dim, start, size) for start, size in zip(starts, sizes))


def chunk(input: Tensor, chunks: int, dim: int = 0) -> tuple[Tensor, ...]:
    return split(input, max(-(-input.shape[axis_of(dim, input.ndim)] // chunks), 1), dim)


def diagonal(input: Tensor, offset: int = 0, dim1: int = 0, dim2: int = 1) -> Tensor:
    if input.ndim != 2 or offset:
        raise Missing("diagonal of other than a matrix's main one is not in the page's torch; it is in the notebook")
    return view_of(input, (min(input.shape),), (sum(input.strides),))


# --------------------------------------------------------------------------------------------------------------- products


def matmul(input: Tensor, other: Tensor) -> Tensor:
    need_tensor("matmul", "other", 2, other)
    if not input.ndim or not other.ndim:
        raise RuntimeError(f"both arguments to matmul need to be at least 1D, but they are {input.ndim}D and {other.ndim}D")
    if input.dtype is not other.dtype:
        raise RuntimeError(f"expected m1 and m2 to have the same dtype, but got: {_c_name(input.dtype)} != {_c_name(other.dtype)}")
    a = input.unsqueeze(0) if input.ndim == 1 else input
    b = other.unsqueeze(1) if other.ndim == 1 else other
    if a.shape[-1] != b.shape[-2]:
        if input.ndim == other.ndim == 1:
            raise RuntimeError(
                f"inconsistent tensor size, expected tensor [{input.shape[0]}] and src [{other.shape[0]}] to have the same number of elements,"
                f" but got {input.shape[0]} and {other.shape[0]} elements respectively"
            )
        if other.ndim == 1:
            raise RuntimeError(f"size mismatch, got input ({a.shape[-2]}), mat ({a.shape[-2]}x{a.shape[-1]}), vec ({b.shape[-2]})")
        raise RuntimeError(f"mat1 and mat2 shapes cannot be multiplied ({a.shape[-2]}x{a.shape[-1]} and {b.shape[-2]}x{b.shape[-1]})")
    batch = broadcast_shapes(a.shape[:-2], b.shape[:-2])
    result = _batched(a.expand(*batch, *a.shape[-2:]), b.expand(*batch, *b.shape[-2:]))
    if input.ndim == 1:
        result = result.squeeze(-2)
    return result.squeeze(-1) if other.ndim == 1 else result


def _c_name(kind: dtypes.dtype) -> str:
    return {"float32": "float", "float64": "double", "int64": "long int", "int32": "int", "bool": "bool", "uint8": "unsigned char"}[kind.name]


def _batched(a: Tensor, b: Tensor) -> Tensor:
    """Products of matrices, (…, n, k) with (…, k, m)."""
    n, k, m = a.shape[-2], a.shape[-1], b.shape[-1]

    def product(left: list[Any], right: list[Any], rows: int, inner: int, columns: int, times: int) -> list[Any]:
        numbers = []
        for i in range(times):
            lines = [left[(i * rows + r) * inner : (i * rows + r + 1) * inner] for r in range(rows)]
            stacks = [right[i * inner * columns + c : (i + 1) * inner * columns : columns] for c in range(columns)]
            numbers += [sum(map(operator.mul, line, column)) for line in lines for column in stacks]
        return numbers

    times = count(a.shape[:-2])
    left, right = a.flat(), b.flat()

    def turned(numbers: list[Any], rows: int, columns: int) -> list[Any]:
        size = rows * columns
        return [numbers[i * size + r * columns + c] for i in range(times) for c in range(columns) for r in range(rows)]

    def send_back(gradient: Tensor) -> list[Tensor]:
        g = gradient.flat()
        return [
            make(product(g, turned(right, k, m), n, m, k, times), a.shape, a.dtype),
            make(product(turned(left, n, k), g, k, n, m, times), b.shape, b.dtype),
        ]

    return record(make(product(left, right, n, k, m, times), (*a.shape[:-2], n, m), a.dtype), "MmBackward0", [a, b], send_back, [a, b])


def mm(input: Tensor, mat2: Tensor) -> Tensor:
    return matmul(input, mat2)


def dot(input: Tensor, other: Tensor) -> Tensor:
    if input.ndim != 1 or other.ndim != 1:
        raise RuntimeError(f"1D tensors expected, but got {input.ndim}D and {other.ndim}D tensors")
    return matmul(input, other)


def outer(input: Tensor, vec2: Tensor) -> Tensor:
    return input.unsqueeze(1) * vec2.unsqueeze(0)


def vdot(input: Tensor, other: Tensor) -> Tensor:
    return dot(input, other)


# ------------------------------------------------------------------------------------------------- kinds, copies, in place


def to(input: Tensor, *args: Any, dtype: Any = None, device: Any = None, copy: bool = False, **_rest: Any) -> Tensor:
    for argument in args:
        if isinstance(argument, dtypes.dtype):
            dtype = argument
        elif isinstance(argument, Tensor):
            dtype = argument.dtype
        elif argument != "cpu":
            raise Missing("devices other than the processor are not in the page's torch; write x.device in place of a name")
    if dtype is None or (dtype is input.dtype and not copy):
        return input.clone() if copy else input
    result = make(map(int, input.flat()) if dtype.category == 1 and input.dtype.category == 2 else input.flat(), input.shape, dtype)
    return record(result, "ToCopyBackward0", [input], lambda gradient: [make(gradient.flat(), input.shape, input.dtype)])


def clone(input: Tensor, **_rest: Any) -> Tensor:
    return record(Tensor(Storage(input.flat()), input.shape, input.dtype), "CloneBackward0", [input], lambda gradient: [gradient])


def contiguous(input: Tensor) -> Tensor:
    return input if input.is_contiguous() else clone(input)


def repeat(input: Tensor, *sizes: Any) -> Tensor:
    times = _sizes(sizes)
    x = input.reshape((1,) * (len(times) - input.ndim) + tuple(input.shape))
    places = _own_places(x)
    for axis, number in enumerate(times):
        places = cat([places] * number, axis)
    return _rearranged("Repeat", x, places.flat(), places.shape)


def repeat_interleave(input: Tensor, repeats: int, dim: int | None = None) -> Tensor:
    x, dim = (input.reshape(-1), 0) if dim is None else (input, dim)
    return index_select(x, dim, tensor([i for i in range(x.shape[axis_of(dim, x.ndim)]) for _ in range(repeats)], dtype=dtypes.int64))


def index_add(input: Tensor, dim: int, index: Tensor, source: Tensor) -> Tensor:
    return _added(input, dim, index, source)


def _added(x: Tensor, dim: int, index: Tensor, source: Tensor) -> Tensor:
    axis = axis_of(dim, x.ndim)
    targets = index_select(_own_places(x), axis, index).flat()
    numbers = x.flat()
    for place, value in zip(targets, source.flat()):
        numbers[place] += value

    def send_back(gradient: Tensor) -> list[Tensor]:
        arriving = gradient.flat()
        return [gradient, make([arriving[place] for place in targets], source.shape, source.dtype)]

    return record(make(numbers, x.shape, x.dtype), "IndexAddBackward0", [x, source], send_back)


def scatter(input: Tensor, dim: int, index: Tensor, src: Any) -> Tensor:
    return _scattered(input, dim, index, src, adding=False)


def scatter_add(input: Tensor, dim: int, index: Tensor, src: Tensor) -> Tensor:
    return _scattered(input, dim, index, src, adding=True)


def _scattered(x: Tensor, dim: int, index: Tensor, src: Any, adding: bool) -> Tensor:
    source = src.narrow(0, 0, index.shape[0]) if isinstance(src, Tensor) and index.shape else tensor_like(src, x.dtype).expand(index.shape)
    if source.shape != index.shape:
        raise Missing("scatter with a source larger than its index is not in the page's torch; it is in the notebook")
    targets = gather(_own_places(x), dim, index).flat() if count(index.shape) else []
    numbers = x.flat()
    for place, value in zip(targets, source.flat()):
        numbers[place] = numbers[place] + value if adding else value

    def send_back(gradient: Tensor) -> list[Tensor]:
        kept, arriving = gradient.flat(), gradient.flat()
        for place in () if adding else targets:
            kept[place] = 0.0
        return [make(kept, x.shape, x.dtype), make([arriving[place] for place in targets], index.shape, x.dtype)]

    return record(make(numbers, x.shape, x.dtype), "ScatterBackward0", [x, source], send_back)


def in_place(function: Callable, name: str) -> Callable:
    """`x.add_(y)`: the operation's result, written over its first operand."""

    def changed(self: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        original = self if not (is_recording() and self.requires_grad) else _before_the_change(self)
        result = function(original, *args, **kwargs)
        if result.dtype.category > self.dtype.category:
            raise RuntimeError(f"result type {result.dtype.long_name} can't be cast to the desired output type {self.dtype.long_name}")
        if result.shape != self.shape:
            raise RuntimeError(
                f"output with shape {list(self.shape)} doesn't match the broadcast shape {list(result.shape)}"
            )
        return self.write(result)

    changed.__name__ = name
    return changed


def _before_the_change(x: Tensor) -> Tensor:
    """The tensor as it is now: steps of the graph may keep it."""
    kept = Tensor(Storage(x.flat()), x.shape, x.dtype)
    kept.requires_grad, kept.step = x.requires_grad, x.step
    if x.grad_fn is None and x.base is None:
        raise RuntimeError("a leaf Variable that requires grad is being used in an in-place operation.")
    return kept
