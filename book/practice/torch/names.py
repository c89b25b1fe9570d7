"""Torch's names for what the other modules have: functions, the same as a tensor's methods and operators, namespaces, kinds.

Whatever is called by a name or a keyword that is not here says so (`missing`).
"""

from __future__ import annotations

import functools
import inspect
import math
import sys
from collections.abc import Callable
from contextlib import nullcontext
from types import ModuleType
from typing import Any

from . import autograd, dtypes, entrywise, functional, making, moving, products, reductions, rows, views
from .inplace import in_place
from .missing import Missing, has_keyword, missing
from .shapes import Size, broadcast_shapes
from .tensor import Tensor

_FUNCTIONS = {
    entrywise: """add sub mul div floor_divide remainder pow=power minimum maximum logaddexp clamp clamp_min clamp_max where
        addcmul addcdiv masked_fill masked_scatter nan_to_num lerp xlogy bitwise_and bitwise_or bitwise_xor
        bitwise_not isclose allclose equal""",
    reductions: """sum=sum_ mean nansum nanmean norm var std prod all=all_ any=any_ count_nonzero max=max_ min=min_ amax amin
        aminmax argmax argmin logsumexp corrcoef cov""",
    rows: """median quantile log_softmax softmax cumsum cumprod cummax cummin logcumsumexp argsort sort topk kthvalue
        diff unique_consecutive bincount""",
    moving: """gather index_select masked_select nonzero argwhere take flip fliplr flipud roll tril triu diag diag_embed
        repeat_interleave index_add index_fill index_copy scatter scatter_add take_along_dim""",
    views: """reshape flatten unsqueeze squeeze permute transpose t movedim broadcast_to narrow select unbind split
        chunk diagonal unflatten ravel""",
    products: "matmul mm bmm mv dot inner outer vdot",
    making: "clone",
}
_NO_METHODS = {
    making: """tensor as_tensor scalar_tensor full zeros ones empty full_like zeros_like ones_like empty_like eye arange linspace""",
    reductions: "var_mean std_mean",
    moving: "cat stack hstack vstack meshgrid",
    views: "broadcast_tensors",
    products: "addmm=addmm_ cdist",
}
_METHODS_ONLY = {views: "view expand", making: "contiguous to", moving: "repeat"}
_ALIASES = {
    "clip": "clamp", "subtract": "sub", "multiply": "mul", "divide": "div", "true_divide": "div", "negative": "neg", "absolute": "abs",
    "less": "lt", "less_equal": "le", "greater": "gt", "greater_equal": "ge", "not_equal": "ne", "swapaxes": "transpose",
    "swapdims": "transpose", "moveaxis": "movedim", "arctan": "atan", "arctanh": "atanh",
}  # fmt: skip
_NO_METHODS_BUT_ALIASES = {"concat": "cat", "concatenate": "cat"}
_IN_PLACE = """
add sub mul div pow clamp clamp_min clamp_max addcmul addcdiv masked_fill masked_scatter exp log neg abs sqrt
rsqrt sigmoid tanh relu square reciprocal floor ceil round trunc nan_to_num lerp index_add index_fill
index_copy scatter scatter_add cumsum cumprod logical_not floor_divide remainder log1p expm1 erf sign clip
subtract multiply divide tril triu bitwise_and bitwise_or bitwise_xor bitwise_not logical_and logical_or eq ne
lt le gt ge
"""
_OTHER_NAMES = {"axis": "dim", "keepdims": "keepdim", "x": "input"}


def _found(table: dict[ModuleType, str]) -> dict[str, Callable]:
    pairs = [(module, entry.partition("=")) for module, entries in table.items() for entry in entries.split()]
    return {name: getattr(module, own or name) for module, (name, _, own) in pairs}


_MAY_BE_NONE = {"stable"}


def _flags(function: Callable) -> dict[str, int]:
    """The arguments that torch takes no number for, and their places; one that has no place is as good as never reached."""
    parameters = inspect.signature(function).parameters.values()
    return {
        one.name: place if one.kind is one.POSITIONAL_OR_KEYWORD else len(parameters) + 1_000
        for place, one in enumerate(parameters)
        if one.annotation in (bool, "bool") or one.name == "unbiased"
    }


def _public(owner: str, name: str, function: Callable) -> Callable:
    """The function under torch's name, taking what else torch calls its arguments, and speaking up about those that it does not have."""
    parameters = inspect.signature(function).parameters
    first = next(iter(parameters.values()), None)
    needs_tensor = first is not None and first.name == "input" and first.annotation == "Tensor"
    flags = {} if owner == "torch.nn.functional" else _flags(function)
    takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())

    @functools.wraps(function)
    def public(*args: Any, **kwargs: Any) -> Any:
        if "dtype" in kwargs:
            kwargs["dtype"] = dtypes.named(kwargs["dtype"])
        for word in list(kwargs):
            if word in parameters or takes_any:
                continue
            if _OTHER_NAMES.get(word) in parameters:
                kwargs[_OTHER_NAMES[word]] = kwargs.pop(word)
            elif word == "out" and kwargs[word] is None:
                del kwargs[word]
            elif has_keyword(word):
                raise Missing(f"{owner}.{name} with {word}=")
            else:
                raise TypeError(f"{name}() got an unexpected keyword argument '{word}'")
        if needs_tensor and args and not isinstance(args[0], Tensor):
            raise TypeError(f"{name}(): argument 'input' (position 1) must be Tensor, not {type(args[0]).__name__}")
        for flag, place in flags.items():
            value = kwargs.get(flag, args[place] if place < len(args) else False)
            if not isinstance(value, bool) and not (value is None and flag in _MAY_BE_NONE):
                where = "" if flag in kwargs else f" (position {place if owner == 'Tensor' else place + 1})"
                raise TypeError(f"{name}(): argument '{flag}'{where} must be bool, not {type(value).__name__}")
        return function(*args, **kwargs)

    public.__name__ = public.__qualname__ = name
    return public


_BOTH = _found(_FUNCTIONS) | entrywise.OF_ONE | entrywise.COMPARING
_HIDDEN = {"ndtr"}  # of torch.special alone
_BOTH |= {alias: _BOTH[name] for alias, name in _ALIASES.items()}
_ALONE = _found(_NO_METHODS)
_ALONE |= {alias: _ALONE[name] for alias, name in _NO_METHODS_BUT_ALIASES.items()}


class Namespace(ModuleType):
    """`torch.nn`, `torch.special`, …: what is there, and a word about the rest."""

    def __init__(self, name: str, **content: Any) -> None:
        super().__init__(name)
        self.__dict__.update(content)
        sys.modules[f"{__package__}.{name.removeprefix('torch.')}"] = self

    def __getattr__(self, name: str) -> Any:
        raise missing(self.__name__, name)


def _functional() -> dict[str, Any]:
    own = {name: value for name, value in vars(functional).items() if getattr(value, "__module__", "") == functional.__name__}
    borrowed = {name: _BOTH[name] for name in ("sigmoid", "tanh", "relu")}
    return {name: _public("torch.nn.functional", name, value) for name, value in (own | borrowed).items() if name[0] != "_"}


nn = Namespace("torch.nn", functional=Namespace("torch.nn.functional", **_functional()), Module=type("Module", (), {}))
special = Namespace(
    "torch.special",
    **{
        name: _BOTH[name]
        for name in ("erf", "erfc", "ndtr", "logit", "log1p", "expm1", "exp2", "logsumexp", "log_softmax", "softmax", "xlogy")
    },
    expit=_BOTH["sigmoid"],
)
linalg = Namespace("torch.linalg", norm=_public("torch.linalg", "norm", reductions.linalg_norm),
                    vector_norm=_public("torch.linalg", "vector_norm", reductions.linalg_norm))  # fmt: skip


class Generator:
    """Stands for torch's generators in annotations and `isinstance`; drawing at random is not in the page's torch."""

    def __init__(self, device: str = "cpu") -> None:
        raise Missing("torch.Generator")

    def manual_seed(self, seed: int) -> Generator:
        return self


_default_generator = object.__new__(Generator)  # nobody draws from it, so that a seed for it changes nothing
random = Namespace("torch.random", fork_rng=lambda devices=None: nullcontext(), manual_seed=_default_generator.manual_seed)


class device:
    """There is one: the processor."""

    def __init__(self, name: Any) -> None:
        if str(name) != "cpu":
            raise Missing(f"torch.device({name!r})")
        self.type, self.index = "cpu", None

    def __eq__(self, other: object) -> Any:
        return isinstance(other, device)

    __hash__ = object.__hash__

    def __str__(self) -> str:
        return "cpu"

    def __repr__(self) -> str:
        return "device(type='cpu')"


# ---------------------------------------------------------------------------------------------- the same, as a tensor's methods


_CONVERSIONS = (
    ("half", dtypes.float16),
    ("bfloat16", dtypes.bfloat16),
    ("float", dtypes.float32),
    ("double", dtypes.float64),
    ("long", dtypes.int64),
    ("int", dtypes.int32),
    ("bool", dtypes.bool_),
)


def _type(self: Tensor, dtype: Any = None, non_blocking: bool = False) -> Tensor:
    if dtype is None or isinstance(dtype, str):
        raise Missing("Tensor.type of names")
    if isinstance(dtype, type):
        raise ValueError(f"invalid type: '{dtype.__name__}'")
    return self.to(dtype)


def _no_shift(self: Tensor, other: Any) -> Tensor:
    raise Missing("Tensor.bitwise_left_shift and its like")


def _matrices_turned(x: Tensor) -> Tensor:
    if x.ndim == 1:
        raise RuntimeError("tensor.mT is only supported on matrices or batches of matrices. Got 1-D tensor.")
    return x.transpose(-1, -2) if x.ndim else x


def _equip() -> None:
    for name, function in (_BOTH | _found(_METHODS_ONLY)).items():
        if name not in _HIDDEN and name != "where":
            setattr(Tensor, name, _public("Tensor", name, function))
    for name in _IN_PLACE.split():
        setattr(Tensor, f"{name}_", _public("Tensor", f"{name}_", in_place(_BOTH[name], f"{name}_")))
    methods: dict[str, Any] = {
        "copy_": lambda self, source: self.write(source),
        "fill_": lambda self, value: self.write(value),
        "zero_": lambda self: self.write(0),
        "where": lambda self, condition, other: entrywise.where(condition, self, other),
        "type": _type,
        "cpu": lambda self: self,
        "view_as": lambda self, other: self.view(other.shape),
        "expand_as": lambda self, other: self.expand(other.shape),
        "reshape_as": lambda self, other: self.reshape(other.shape),
        "type_as": lambda self, other: self.to(other.dtype),
        "new_tensor": lambda self, data, *, dtype=None, device=None: making.tensor(data, dtype=dtype or self.dtype),
        "new_zeros": lambda self, *size, dtype=None, device=None: making.zeros(*size, dtype=dtype or self.dtype),
        "new_ones": lambda self, *size, dtype=None, device=None: making.ones(*size, dtype=dtype or self.dtype),
        "new_empty": lambda self, *size, dtype=None, device=None: making.zeros(*size, dtype=dtype or self.dtype),
        "new_full": lambda self, size, fill_value, *, dtype=None, device=None: making.full(
            size, fill_value, dtype=dtype or self.dtype
        ),
    }
    for method, kind in _CONVERSIONS:
        methods[method] = lambda self, _kind=kind: self.to(_kind)
    for name, method in methods.items():
        setattr(Tensor, name, _public("Tensor", name, method))
    setattr(Tensor, "device", property(lambda self: device("cpu")))  # noqa: B010  # mypy knows no other way
    setattr(Tensor, "T", property(lambda self: self.permute(*reversed(range(self.ndim)))))  # noqa: B010  # mypy knows no other way
    setattr(Tensor, "mT", property(_matrices_turned))  # noqa: B010  # mypy knows no other way
    _equip_operators()


def _equip_operators() -> None:
    pairs = {
        "add": entrywise.add, "sub": entrywise.sub, "mul": entrywise.mul, "truediv": entrywise.div, "floordiv": entrywise.floor_divide,
        "mod": entrywise.remainder, "pow": entrywise.power, "matmul": products.matmul, "and": entrywise.bitwise_and,
        "or": entrywise.bitwise_or, "xor": entrywise.bitwise_xor,
    }  # fmt: skip
    for name, function in pairs.items():
        setattr(Tensor, f"__{name}__", _operator(function))
        setattr(Tensor, f"__r{name}__", _operator(_turned(function)))
        if name != "matmul":
            setattr(Tensor, f"__i{name}__", _operator(in_place(function, f"__i{name}__")))
    setattr(Tensor, "__rtruediv__", _operator(_number_by))  # noqa: B010
    for name in ("eq", "ne", "lt", "le", "gt", "ge"):
        setattr(Tensor, f"__{name}__", _operator(entrywise.COMPARING[name]))
    for name in ("neg", "abs"):
        setattr(Tensor, f"__{name}__", _BOTH[name])
    setattr(Tensor, "__invert__", entrywise.bitwise_not)  # noqa: B010
    for name in ("lshift", "rshift"):
        setattr(Tensor, f"__{name}__", _no_shift)
        setattr(Tensor, f"__r{name}__", _no_shift)
    setattr(Tensor, "__reversed__", lambda self: self.flip(0) if self.shape else self)  # noqa: B010
    setattr(Tensor, "__pos__", lambda self: self)  # noqa: B010


def _number_by(x: Tensor, number: float) -> Tensor:
    """number / x, as torch computes it."""
    return entrywise.mul(entrywise.OF_ONE["reciprocal"](x), number)


def _turned(function: Callable) -> Callable:
    return lambda a, b: function(b, a)


def _operator(function: Callable) -> Callable:
    def method(self: Tensor, other: Any) -> Any:
        if isinstance(other, complex):
            raise Missing("torch.complex64")
        if not isinstance(other, (Tensor, int, float)):
            return NotImplemented
        return function(self, other)

    return method


_equip()

TORCH: dict[str, Any] = {
    **{name: _public("torch", name, function) for name, function in (_BOTH | _ALONE).items() if name not in _HIDDEN},
    **dtypes.BY_NAME,
    **{
        "float": dtypes.float32,
        "double": dtypes.float64,
        "half": dtypes.float16,
        "float16": dtypes.float16,
        "bfloat16": dtypes.bfloat16,
    },
    **{"long": dtypes.int64, "int": dtypes.int32, "short": dtypes.int16, "dtype": dtypes.dtype},
    **{"inf": math.inf, "nan": math.nan, "pi": math.pi, "e": math.e, "newaxis": None, "__version__": "2.13.0+page"},
    **{"nn": nn, "special": special, "linalg": linalg, "autograd": autograd, "Tensor": Tensor, "Size": Size, "device": device},
    **{name: getattr(autograd, name) for name in ("no_grad", "enable_grad", "inference_mode", "set_grad_enabled")},
    "is_grad_enabled": autograd.is_recording,
    "Generator": Generator,
    "random": random,
    "default_generator": _default_generator,
    "manual_seed": random.manual_seed,
    "result_type": dtypes.result_type,
    "promote_types": dtypes.promoted,
    "broadcast_shapes": lambda *shapes: Size(broadcast_shapes(*shapes)),
    "is_tensor": lambda obj: isinstance(obj, Tensor),
    "is_floating_point": lambda input: input.is_floating_point(),
    "numel": lambda input: input.numel(),
    "get_default_dtype": lambda: dtypes.float32,
    "set_num_threads": lambda number: None,
}
"""All that `torch.` is followed by."""
