"""Operations on single entries: what is computed of them, and its slope, which is all that a gradient needs."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

from . import dtypes
from .making import inf, make, nan, need_tensor, record, tensor_like
from .missing import Missing
from .shapes import broadcast_shapes
from .tensor import Storage, Tensor, spread, sum_to


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
    says which numbers it needs, and which must not be changed in place therefore: "operands", "others" (than the one whose gradient is
    asked for), "divisor", "result", "all" or "nothing". If `compute` only chooses among its operands, what is not chosen gets a
    gradient of 0, even of an infinite one.
    """
    kind = kind or dtypes.result_type(*operands)
    tensors = [tensor_like(operand, None if isinstance(operand, Tensor) else _number_kind(operand, kind)) for operand in operands]
    shape = broadcast_shapes(*(tensor.shape for tensor in tensors))
    columns = [spread(tensor, shape) for tensor in tensors]
    numbers = kind.numbers(map(compute, *columns))
    result = Tensor(Storage(numbers), shape, kind)
    if slopes is None:
        return result

    def send_back(gradient: Tensor) -> list[Tensor | None]:
        arriving = gradient.flat()
        back: list[Tensor | None] = []
        for tensor, slope in zip(tensors, slopes, strict=True):
            if not tensor.requires_grad:
                back.append(None)
                continue
            here = [slope(*entries) for entries in zip(*columns, numbers, strict=True)]
            parts = [g * s if s or not chooses else 0.0 for g, s in zip(arriving, here, strict=True)]
            back.append(sum_to(make(parts, shape, tensor.dtype), tensor.shape))
        return back

    asked = [tensor.requires_grad for tensor in tensors]
    kept = {
        "operands": tensors,
        "others": [tensor for i, tensor in enumerate(tensors) if any(asked[:i] + asked[i + 1 :])],
        "divisor": tensors if asked[-1] else tensors[1:],
        "result": [result],
        "all": [*tensors, result],
        "nothing": [],
    }[keeps]
    return record(result, f"{name.capitalize()}Backward0", tensors, send_back, kept)


def _number_kind(number: Any, kind: dtypes.dtype) -> dtypes.dtype | None:
    """A float next to integers, of which a truth value or an integer is made, stays what it is; else it is rounded as the result is."""
    return kind if kind.is_floating_point else None


def float_kind(x: Tensor) -> dtypes.dtype:
    """The kind of what is computed of x and can't be an integer."""
    return x.dtype if x.dtype.is_floating_point else dtypes.float32


# ------------------------------------------------------------------------------------------- arithmetic as processors do it


def guarded(function: Callable, overflow: float = inf) -> Callable:
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
    """a / b, infinite or nan where b is 0."""
    if b == 0:
        return nan if a == 0 or a != a else math.copysign(inf, a) * math.copysign(1.0, b)
    return guarded(operator.truediv)(a, b)


def logarithm(x: float) -> float:
    """log x, also of 0 and below."""
    return math.log(x) if x > 0 else (-inf if x == 0 else nan)


def _log1p(x: float) -> float:
    return math.log1p(x) if x > -1 else (-inf if x == -1 else nan)


def logistic(x: float) -> float:
    """The sigmoid, without overflow."""
    if x >= 0:
        return 1 / (1 + math.exp(-x))
    e = math.exp(x)
    return e / (1 + e)


def _sigmoid(largest: float, x: float) -> float:
    """As torch computes it, which is 0 where exp(-x) is more than the kind holds: `largest` is that number's logarithm."""
    return 0.0 if -x > largest else logistic(x)


def log_logistic(x: float) -> float:
    """log sigmoid x, exact on both sides."""
    return min(x, 0.0) - math.log1p(math.exp(-abs(x))) if x == x else nan


def _power(a: float, b: float) -> float:
    if isinstance(a, int) and isinstance(b, int) and b < 0:
        return a ** (-b) if a in (1, -1) else 0
    if a == 0 and b < 0:
        return -inf if math.copysign(1, a) < 0 and b % 2 == 1 else inf
    if -inf < a < 0 and isinstance(b, float) and b == b and abs(b) != inf and b != int(b):
        return nan
    try:
        return a**b
    except OverflowError:
        return -inf if a < 0 and b % 2 == 1 else inf


def log_add_exp(a: float, b: float) -> float:
    """log(exp a + exp b)."""
    if a != a or b != b:
        return nan
    top = max(a, b)
    return top if abs(top) == inf else top + math.log1p(math.exp(-abs(a - b)))


def sign_of(x: float) -> float:
    """-1, 0 or 1."""
    return (x > 0) - (x < 0)


def _smaller(a: Any, b: Any) -> Any:
    return a if a < b or a != a else b


def _larger(a: Any, b: Any) -> Any:
    return a if a > b or a != a else b


exponential = guarded(math.exp)

# --------------------------------------------------------------------------------------------------------- of one tensor

_FLOATS: dict[str, tuple[Callable, Callable]] = {
    "exp": (exponential, lambda x, y: y),
    "expm1": (guarded(math.expm1), lambda x, y: y + 1),
    "exp2": (guarded(lambda x: 2.0**x), lambda x, y: y * math.log(2)),
    "log": (logarithm, lambda x, y: divide(1.0, x)),
    "log2": (lambda x: math.log2(x) if x > 0 else logarithm(x), lambda x, y: divide(1.0, x * math.log(2))),
    "log10": (lambda x: math.log10(x) if x > 0 else logarithm(x), lambda x, y: divide(1.0, x * math.log(10))),
    "log1p": (_log1p, lambda x, y: divide(1.0, 1 + x)),
    "sqrt": (guarded(math.sqrt), lambda x, y: divide(0.5, y)),
    "rsqrt": (lambda x: divide(1.0, guarded(math.sqrt)(x)), lambda x, y: -0.5 * y * y * y),
    "reciprocal": (lambda x: divide(1.0, x), lambda x, y: -y * y),
    "sigmoid": (logistic, lambda x, y: y * (1 - y)),
    "tanh": (math.tanh, lambda x, y: 1 - y * y),
    "sin": (guarded(math.sin), lambda x, y: guarded(math.cos)(x)),
    "cos": (guarded(math.cos), lambda x, y: -guarded(math.sin)(x)),
    "atan": (math.atan, lambda x, y: 1 / (1 + x * x)),
    "atanh": (lambda x: math.copysign(inf, x) if abs(x) == 1 else guarded(math.atanh)(x), lambda x, y: divide(1.0, 1 - x * x)),
    "erf": (math.erf, lambda x, y: 2 / math.sqrt(math.pi) * math.exp(-x * x)),
    "erfc": (math.erfc, lambda x, y: -2 / math.sqrt(math.pi) * math.exp(-x * x)),
    "logit": (lambda x: logarithm(divide(x, 1 - x)), lambda x, y: divide(1.0, x * (1 - x)) if 0 <= x <= 1 else nan),
    "ndtr": (lambda x: 0.5 * math.erfc(-x / math.sqrt(2)), lambda x, y: math.exp(-x * x / 2) / math.sqrt(2 * math.pi)),
}
_KEEPING_THEIR_KIND: dict[str, tuple[Callable, Callable]] = {
    "abs": (abs, lambda x, y: sign_of(x)),
    "neg": (operator.neg, lambda x, y: -1.0),
    "square": (lambda x: x * x, lambda x, y: 2 * x),
    "sign": (sign_of, lambda x, y: 0.0),
    "floor": (lambda x: x if isinstance(x, int) or x != x or abs(x) == inf else math.floor(x), lambda x, y: 0.0),
    "ceil": (lambda x: x if isinstance(x, int) or x != x or abs(x) == inf else math.ceil(x), lambda x, y: 0.0),
    "round": (lambda x: x if isinstance(x, int) or x != x or abs(x) == inf else round(x), lambda x, y: 0.0),
    "trunc": (lambda x: x if isinstance(x, int) or x != x or abs(x) == inf else math.trunc(x), lambda x, y: 0.0),
    "relu": (lambda x: x if x > 0 or x != x else type(x)(0), lambda x, y: float(not x <= 0)),
}
_QUESTIONS: dict[str, Callable] = {
    "isnan": lambda x: x != x,
    "isinf": lambda x: abs(x) == inf,
    "isfinite": lambda x: x == x and abs(x) != inf,
    "logical_not": operator.not_,
    "signbit": lambda x: math.copysign(1, x) < 0,
}
_KEEPS_RESULT = {"exp", "expm1", "exp2", "sigmoid", "tanh", "sqrt", "rsqrt", "reciprocal", "relu"}
_FLAT = {"sign", "floor", "ceil", "round", "trunc", "relu"}  # where nothing changes, not even an infinite gradient comes through
_KEEPS_NOTHING = {"neg", "ndtr", "sign", "floor", "ceil", "round", "trunc"}
_NOT_OF_TRUTH_VALUES = {
    "neg": "Negation, the `-` operator, on a bool tensor is not supported. If you are trying to invert a mask, use the `~` or"
    " `logical_not()` operator instead.",
    "relu": "Boolean inputs not supported for relu",
}
_NOT_IMPLEMENTED_OF_TRUTH_VALUES = {
    "abs": "abs",
    "floor": "floor_vml",
    "ceil": "ceil_vml",
    "round": "round_vml",
    "trunc": "trunc_vml",
}


def _of_one(name: str) -> Callable:
    def function(input: Tensor) -> Tensor:
        need_tensor(name, "input", 1, input)
        keeps = "result" if name in _KEEPS_RESULT else "nothing" if name in _KEEPS_NOTHING else "operands"
        if name in _FLOATS:
            compute, slope = _FLOATS[name]
            kind = float_kind(input)
            if name == "sigmoid":
                compute = functools.partial(_sigmoid, 709.782712893384 if kind is dtypes.float64 else 88.72283905)
            return entrywise(name, compute, [slope], [input], kind, keeps)
        if name in _KEEPING_THEIR_KIND:
            if input.dtype is dtypes.bool_ and name in _NOT_OF_TRUTH_VALUES:
                raise RuntimeError(_NOT_OF_TRUTH_VALUES[name])
            if input.dtype is dtypes.bool_ and name in _NOT_IMPLEMENTED_OF_TRUTH_VALUES:
                raise NotImplementedError(f"\"{_NOT_IMPLEMENTED_OF_TRUTH_VALUES[name]}_cpu\" not implemented for 'Bool'")
            compute, slope = _KEEPING_THEIR_KIND[name]
            counted = dtypes.int64 if input.dtype is dtypes.bool_ and name == "square" else None
            return entrywise(name, compute, [slope], [input], counted, keeps, chooses=name in _FLAT)
        return entrywise(name, _QUESTIONS[name], None, [input], dtypes.bool_)

    function.__name__ = name
    return function


OF_ONE = {name: _of_one(name) for name in (*_FLOATS, *_KEEPING_THEIR_KIND, *_QUESTIONS)}


def nan_to_num(input: Tensor, nan: float | None = 0.0, posinf: float | None = None, neginf: float | None = None) -> Tensor:
    largest = 1.7976931348623157e308 if input.dtype is dtypes.float64 else 3.4028234663852886e38
    high, low = largest if posinf is None else posinf, -largest if neginf is None else neginf
    return entrywise(
        "nan_to_num",
        lambda x: (nan or 0.0) if x != x else high if x == inf else low if x == -inf else x,
        [lambda x, y: float(x == x and abs(x) != inf)],
        [input],
        chooses=True,
    )


# --------------------------------------------------------------------------------------------------------- of two tensors


def _no_truth_values_in_minus(a: Any, b: Any) -> None:
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
    _no_truth_values_in_minus(input, other)
    other = other if alpha == 1 else mul(other, alpha)
    return entrywise("sub", operator.sub, [lambda a, b, y: 1.0, lambda a, b, y: -1.0], [input, other], keeps="nothing")


def mul(input: Any, other: Any) -> Tensor:
    return entrywise("mul", operator.mul, [lambda a, b, y: b, lambda a, b, y: a], [input, other], keeps="others")


def div(input: Any, other: Any, *, rounding_mode: str | None = None) -> Tensor:
    if rounding_mode == "floor":
        return floor_divide(input, other)
    if rounding_mode is not None:
        raise Missing(f"torch.div with rounding_mode={rounding_mode!r}")
    kind = dtypes.result_type(input, other)
    kind = kind if kind.is_floating_point else dtypes.float32
    slopes = [lambda a, b, y: divide(1.0, b), lambda a, b, y: -divide(divide(a, b), b)]
    return entrywise("div", divide, slopes, [input, other], kind, keeps="divisor")


def _floor_of_quotient(a: Any, b: Any) -> Any:
    if not b:
        if isinstance(a, int) and isinstance(b, int):
            raise RuntimeError("ZeroDivisionError")
        return divide(a, b)
    return a // b


def floor_divide(input: Any, other: Any) -> Tensor:
    _no_truth_values("div_floor_cpu", input, other)
    return _underivable(entrywise("floor_divide", _floor_of_quotient, None, [input, other]), "floor_divide", [input, other])


def _underivable(result: Tensor, name: str, operands: Sequence[Any]) -> Tensor:
    """The result of an operation through which torch sends no gradient: asking for one is an error."""

    def refuse(gradient: Tensor) -> list[Tensor]:
        raise RuntimeError(f"derivative for aten::{name} is not implemented")

    return record(result, "torch::autograd::NotImplemented", [x for x in operands if isinstance(x, Tensor)], refuse)


def _no_truth_values(kernel: str, *operands: Any) -> None:
    if dtypes.result_type(*operands) is dtypes.bool_:
        raise NotImplementedError(f"\"{kernel}\" not implemented for 'Bool'")


def _rest(a: Any, b: Any) -> Any:
    if not b:
        if isinstance(a, int) and isinstance(b, int):
            raise RuntimeError("ZeroDivisionError")
        return nan
    return guarded(operator.mod)(a, b)


def remainder(input: Any, other: Any) -> Tensor:
    def slope(a: float, b: float, y: float) -> float:
        return -float(_floor_of_quotient(a, b))

    _no_truth_values("remainder_cpu", input, other)
    keeps = "others" if isinstance(other, Tensor) else "nothing"
    return entrywise("remainder", _rest, [lambda a, b, y: 1.0, slope], [input, other], keeps=keeps)


def power(input: Any, exponent: Any) -> Tensor:
    """`torch.pow`."""

    def by_base(a: float, b: float, y: float) -> float:
        return 0.0 if b == 0 else b * _power(a, b - 1)

    def by_exponent(a: float, b: float, y: float) -> float:
        return 0.0 if a == 0 and b >= 0 else y * logarithm(a)

    kind = dtypes.result_type(input, exponent)
    if kind is dtypes.bool_:
        raise NotImplementedError("\"pow\" not implemented for 'Bool'")
    if kind.category == 1 and isinstance(exponent, int) and exponent < 0:
        raise RuntimeError("Integers to negative integer powers are not allowed.")
    keeps = "all" if isinstance(exponent, Tensor) else "operands"
    return entrywise("pow", _power, [by_base, by_exponent], [input, exponent], keeps=keeps)


def _share(mine: float, others: float, larger: bool) -> float:
    """Of a gradient that goes to whichever is chosen; where both are, half each."""
    return 0.5 if mine == others else 0.0 if (mine < others) is larger and mine == mine and others == others else 1.0


def minimum(input: Tensor, other: Tensor) -> Tensor:
    need_tensor("minimum", "input", 1, input)
    need_tensor("minimum", "other", 2, other)
    slopes = [lambda a, b, y: _share(a, b, False), lambda a, b, y: _share(b, a, False)]
    return entrywise("minimum", _smaller, slopes, [input, other], chooses=True)


def maximum(input: Tensor, other: Tensor) -> Tensor:
    need_tensor("maximum", "input", 1, input)
    need_tensor("maximum", "other", 2, other)
    slopes = [lambda a, b, y: _share(a, b, True), lambda a, b, y: _share(b, a, True)]
    return entrywise("maximum", _larger, slopes, [input, other], chooses=True)


def logaddexp(input: Tensor, other: Tensor) -> Tensor:
    need_tensor("logaddexp", "input", 1, input)
    need_tensor("logaddexp", "other", 2, other)
    slopes = [lambda a, b, y: exponential(a - y), lambda a, b, y: exponential(b - y)]
    floats_only("logaddexp_cpu", dtypes.result_type(input, other))
    return entrywise("logaddexp", log_add_exp, slopes, [input, other])


def floats_only(kernel: str, kind: dtypes.dtype) -> None:
    """Refuse integers, as torch does where an operation has no meaning for them."""
    if not kind.is_floating_point:
        raise NotImplementedError(f"\"{kernel}\" not implemented for '{kind.long_name}'")


# ------------------------------------------------------------------------------------------------- choosing, and of several


def clamp(input: Tensor, min: Any = None, max: Any = None) -> Tensor:
    need_tensor("clamp", "input", 1, input)
    if min is None and max is None:
        raise RuntimeError("torch.clamp: At least one of 'min' or 'max' must not be None")
    if isinstance(min, Tensor) is not isinstance(max, Tensor) and min is not None and max is not None:
        kinds = ", ".join(f"{name}={type(value).__name__}" for name, value in (("min", min), ("max", max)))
        raise TypeError(f"clamp() received an invalid combination of arguments - got (Tensor, {kinds})")
    operands = [input, -inf if min is None else min, inf if max is None else max]
    kind = dtypes.result_type(*(x for x in (input, min, max) if x is not None))
    if kind is dtypes.bool_ and not isinstance(min, Tensor) and not isinstance(max, Tensor):
        raise NotImplementedError("\"clamp_scalar_cpu\" not implemented for 'Bool'")
    slopes = [
        lambda x, low, high, y: float(low <= x <= high),
        lambda x, low, high, y: float(x < low < high),
        lambda x, low, high, y: float(high < x or high < low),
    ]
    return entrywise(
        "clamp", lambda x, low, high: x if x != x else _smaller(_larger(x, low), high), slopes, operands, kind, chooses=True
    )


def clamp_min(input: Tensor, min: Any) -> Tensor:
    return clamp(input, min=min)


def clamp_max(input: Tensor, max: Any) -> Tensor:
    return clamp(input, max=max)


def where(condition: Tensor, input: Any = None, other: Any = None) -> Any:
    need_tensor("where", "condition", 1, condition)
    if condition.dtype is not dtypes.bool_:
        raise RuntimeError(
            f"where expected condition to be a boolean tensor, but got a tensor with dtype {condition.dtype.long_name}"
        )
    if input is None and other is None:
        return condition.nonzero(as_tuple=True)
    kind = dtypes.result_type(input, other)
    slopes = [lambda c, a, b, y: 0.0, lambda c, a, b, y: float(c), lambda c, a, b, y: float(not c)]
    result = entrywise("where", lambda c, a, b: a if c else b, slopes, [condition, input, other], kind, "nothing", chooses=True)
    if result.step is not None:
        result.step.relies_on = [(condition, condition.storage.version)]
    return result


def masked_fill(input: Tensor, mask: Tensor, value: Any) -> Tensor:
    need_tensor("masked_fill", "mask", 2, mask)
    if mask.dtype is not dtypes.bool_:
        raise RuntimeError(f"masked_fill_ only supports boolean masks, but got mask with dtype {mask.dtype.c_name}")
    if isinstance(value, Tensor) and value.ndim:
        plural = "s" if value.ndim > 1 else ""
        raise RuntimeError(
            f"masked_fill only supports a 0-dimensional value tensor, but got tensor with {value.ndim} dimension{plural}."
        )
    broadcast_shapes(mask.shape, input.shape)
    number = value.item() if isinstance(value, Tensor) else value
    if input.dtype.category == 1 and isinstance(number, float) and (number != number or abs(number) >= 2**63):
        raise RuntimeError("value cannot be converted to type int64_t without overflow")
    filler = tensor_like(value, None if isinstance(value, Tensor) else input.dtype)
    return where(mask, filler.to(input.dtype), input)


def masked_scatter(input: Tensor, mask: Tensor, source: Tensor) -> Tensor:
    shape = broadcast_shapes(input.shape, mask.shape)
    result = input.expand(shape).clone()
    result[mask.expand(shape)] = source.reshape(-1)[: int(mask.expand(shape).sum())]
    return result


def addcmul(input: Tensor, tensor1: Tensor, tensor2: Tensor, *, value: float = 1) -> Tensor:
    return input + value * tensor1 * tensor2


def addcdiv(input: Tensor, tensor1: Tensor, tensor2: Tensor, *, value: float = 1) -> Tensor:
    return input + value * tensor1 / tensor2


def lerp(input: Tensor, end: Tensor, weight: Any) -> Tensor:
    if input.dtype is not end.dtype:
        raise RuntimeError(f"expected dtype {input.dtype.c_name} for `end` but got dtype {end.dtype.c_name}")
    floats_only("lerp_kernel_scalar", input.dtype)
    if isinstance(weight, Tensor):
        return input + weight * (end - input)
    return input + weight * (end - input) if weight < 0.5 else end - (end - input) * (1 - weight)


def xlogy(input: Any, other: Any) -> Tensor:
    def compute(a: float, b: float) -> float:
        return nan if b != b else 0.0 if a == 0 else a * logarithm(b)

    def slope(a: float, b: float, y: float) -> float:
        return 0.0 if a == 0 and b <= 0 else logarithm(b)

    kind = dtypes.result_type(input, other)
    kind = kind if kind.is_floating_point else dtypes.float32
    return entrywise("xlogy", compute, [slope, lambda a, b, y: divide(a, b)], [input, other], kind)


# ------------------------------------------------------------------------------------------------------------- comparing


def _comparing(name: str, compare: Callable) -> Callable:
    def function(input: Any, other: Any) -> Tensor:
        tensors = [tensor_like(input), tensor_like(other)]
        if not name.startswith("logical"):  # as numbers of one kind: a float is rounded before it is compared with a float32
            kind = dtypes.result_type(input, other)
            tensors = [x if x.dtype is kind else make(x.flat(), x.shape, kind) for x in tensors]
        return entrywise(name, compare, None, tensors, dtypes.bool_)

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
        kind = dtypes.result_type(input, other)
        broadcast_shapes(*(x.shape for x in (input, other) if isinstance(x, Tensor)))
        if kind.category == 2:
            raise NotImplementedError(f"\"bitwise_{name}_cpu\" not implemented for '{kind.long_name}'")
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
    if input.dtype is not other.dtype:
        raise RuntimeError(f"{input.dtype.long_name} did not match {other.dtype.long_name}")

    def close(a: Any, b: Any) -> bool:
        if a != a or b != b:
            return equal_nan and a != a and b != b
        return a == b or (abs(b) != inf and abs(a) != inf and abs(a - b) <= atol + rtol * abs(b))

    return entrywise("isclose", close, None, [input, other], dtypes.bool_)


def allclose(input: Tensor, other: Tensor, rtol: float = 1e-05, atol: float = 1e-08, equal_nan: bool = False) -> bool:
    return all(isclose(input, other, rtol, atol, equal_nan).flat())


def equal(input: Tensor, other: Tensor) -> bool:
    return input.shape == other.shape and input.flat() == other.flat() and not any(x != x for x in input.flat())
