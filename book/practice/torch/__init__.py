"""A torch for the page: tensors, autograd and the operations that this book's exercises meet, in plain Python.

It computes what torch computes, gradients included, on a thousand numbers in a blink, and says what it does not have. Read `autograd`
first: it is all of reverse-mode differentiation. `tensor` has strides and views, `ops` the operations with their derivatives.
"""

from __future__ import annotations

from typing import Any

from . import autograd, functional, ops, tensor as _tensor
from .autograd import enable_grad, inference_mode, is_recording as is_grad_enabled, no_grad
from .dtypes import BY_NAME as _KINDS
from .dtypes import bfloat16, dtype, float16, result_type
from .tensor import Missing, Size, Tensor, broadcast_shapes, missing

bool = _KINDS["bool"]  # noqa: A001
float32 = float = _KINDS["float32"]  # noqa: A001
float64 = double = _KINDS["float64"]
int64 = long = _KINDS["int64"]
int32 = int = _KINDS["int32"]  # noqa: A001
int16 = short = _KINDS["int16"]
int8, uint8 = _KINDS["int8"], _KINDS["uint8"]
inf, nan, pi, e = ops.inf, ops.nan, ops.math.pi, ops.math.e
__version__ = "2.13.0+page"

_FUNCTIONS = """
add sub mul div floor_divide remainder pow minimum maximum logaddexp clamp where addcmul addcdiv masked_fill nan_to_num lerp bitwise_and bitwise_or bitwise_xor
bitwise_not isclose allclose equal sum mean nansum nanmean norm var std var_mean std_mean prod all any count_nonzero max min amax amin argmax argmin
logsumexp median quantile log_softmax softmax cumsum cumprod argsort sort topk diff gather index_select masked_select nonzero argwhere flip roll cat
stack tril triu reshape flatten unsqueeze squeeze permute transpose t movedim broadcast_to narrow select unbind split chunk diagonal matmul mm dot outer
vdot clone repeat_interleave index_add scatter scatter_add take_along_dim
""".split()
_MAKERS = """
tensor as_tensor full zeros ones empty full_like zeros_like ones_like empty_like eye arange linspace concat concatenate broadcast_tensors
""".split()
_ALIASES = {
    "clip": "clamp", "subtract": "sub", "multiply": "mul", "divide": "div", "true_divide": "div", "negative": "neg", "absolute": "abs",
    "less": "lt", "less_equal": "le", "greater": "gt", "greater_equal": "ge", "not_equal": "ne", "swapaxes": "transpose", "moveaxis": "movedim",
}  # fmt: skip
_METHODS = """view expand contiguous repeat to""".split()
_IN_PLACE = """
add sub mul div pow clamp addcmul addcdiv masked_fill exp log neg abs sqrt sigmoid tanh relu square reciprocal floor ceil round nan_to_num lerp index_add scatter
scatter_add cumsum logical_not
""".split()

_ALL: dict[str, Any] = {name: getattr(ops, name, None) or getattr(ops, f"{name}_") for name in (*_FUNCTIONS, *_METHODS)} | ops.UNARY | ops.COMPARING
_ALL |= {alias: _ALL[name] for alias, name in _ALIASES.items()}
globals().update({name: function for name, function in _ALL.items() if name not in _METHODS})
globals().update({name: getattr(ops, name) for name in _MAKERS})


class _Namespace:
    """`torch.nn`, `torch.nn.functional`, …: what is there, and a word about the rest."""

    def __init__(self, name: str, **content: Any) -> None:
        self._name = name
        self.__dict__.update(content)

    def __getattr__(self, name: str) -> Any:
        raise missing(self._name, name)


nn = _Namespace("torch.nn", functional=functional, Module=type("Module", (), {}))
special = _Namespace("torch.special", expit=_ALL["sigmoid"], logsumexp=_ALL["logsumexp"], log_softmax=_ALL["log_softmax"], softmax=_ALL["softmax"])
Generator = type("Generator", (), {"__doc__": "Drawing at random is not in the page's torch."})


def device(name: str) -> str:
    return name


def is_tensor(value: Any) -> Any:
    return isinstance(value, Tensor)


def is_floating_point(input: Tensor) -> Any:
    return input.is_floating_point()


def numel(input: Tensor) -> Any:
    return input.numel()


def get_default_dtype() -> dtype:
    return float32


def __getattr__(name: str) -> Any:
    raise missing("torch", name)


# ---------------------------------------------------------------------------------------------- the same, as a tensor's methods


def _equip() -> None:
    for name, function in _ALL.items():
        if name not in ("where", "max", "min"):
            setattr(Tensor, name, function)
    for name in _IN_PLACE:
        setattr(Tensor, f"{name}_", ops.in_place(_ALL[name], f"{name}_"))
    Tensor.max, Tensor.min = ops.max_, ops.min_
    Tensor.clip_ = Tensor.clamp_
    Tensor.copy_ = lambda self, source: self.write(source.detach() if False else source)
    Tensor.fill_ = lambda self, value: self.write(value)
    Tensor.zero_ = lambda self: self.write(0)
    Tensor.where = lambda self, condition, other: ops.where(condition, self, other)
    Tensor.type = lambda self, kind: self.to(kind)
    for method, kind in (("float", float32), ("double", float64), ("long", int64), ("int", int32), ("bool", bool)):
        setattr(Tensor, method, lambda self, _kind=kind: self.to(_kind))
    Tensor.cpu = lambda self: self
    Tensor.view_as = lambda self, other: self.view(other.shape)
    Tensor.expand_as = lambda self, other: self.expand(other.shape)
    Tensor.reshape_as = lambda self, other: self.reshape(other.shape)
    Tensor.type_as = lambda self, other: self.to(other.dtype)
    Tensor.detach_ = _detach_
    Tensor.new_tensor = lambda self, data, *, dtype=None: ops.tensor(data, dtype=dtype or self.dtype)
    Tensor.new_zeros = lambda self, *size, dtype=None: ops.zeros(*size, dtype=dtype or self.dtype)
    Tensor.new_ones = lambda self, *size, dtype=None: ops.ones(*size, dtype=dtype or self.dtype)
    Tensor.new_empty = Tensor.new_zeros
    Tensor.new_full = lambda self, size, fill_value, *, dtype=None: ops.full(size, fill_value, dtype=dtype or self.dtype)
    Tensor.T = property(lambda self: self.permute(*reversed(range(self.ndim))))
    Tensor.mT = property(lambda self: self.transpose(-1, -2))
    _equip_operators()


def _detach_(self: Tensor) -> Tensor:
    self.requires_grad, self.step, self.base = False, None, None
    return self


def _equip_operators() -> None:
    pairs = {
        "add": ops.add, "sub": ops.sub, "mul": ops.mul, "truediv": ops.div, "floordiv": ops.floor_divide, "mod": ops.remainder,
        "pow": ops.pow_, "matmul": ops.matmul, "and": ops.bitwise_and, "or": ops.bitwise_or, "xor": ops.bitwise_xor,
    }  # fmt: skip
    for name, function in pairs.items():
        setattr(Tensor, f"__{name}__", _operator(function))
        setattr(Tensor, f"__r{name}__", _operator(lambda a, b, _function=function: _function(b, a)))
        if name not in ("matmul", "floordiv", "mod"):
            setattr(Tensor, f"__i{name}__", ops.in_place(function, f"__i{name}__"))
    for name, function in (("eq", "eq"), ("ne", "ne"), ("lt", "lt"), ("le", "le"), ("gt", "gt"), ("ge", "ge")):
        setattr(Tensor, f"__{name}__", _operator(ops.COMPARING[function]))
    Tensor.__neg__, Tensor.__abs__, Tensor.__invert__ = ops.neg, ops.absolute, ops.bitwise_not
    Tensor.__pos__ = lambda self: self


def _operator(function: Any) -> Any:
    def method(self: Tensor, other: Any) -> Any:
        if not isinstance(other, (Tensor, complex, type(1), type(1.0), type(True))):
            return NotImplemented
        return function(self, other)

    return method


_equip()
