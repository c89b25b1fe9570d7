"""The kinds of numbers, and which kind a result has."""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Iterable
from typing import Any


class dtype:
    """float64, float32, int64, int32, uint8 or bool. `rank` orders them; two of one `category` differ in size only."""

    def __init__(self, name: str, long_name: str, category: int, rank: float) -> None:
        self.name, self.long_name, self.category, self.rank = name, long_name, category, rank

    def __repr__(self) -> str:
        return f"torch.{self.name}"

    @property
    def c_name(self) -> str:
        """As some of torch's errors call it."""
        return {
            "Float": "float",
            "Double": "double",
            "Long": "long int",
            "Byte": "unsigned char",
            "Half": "c10::Half",
            "BFloat16": "c10::BFloat16",
            "Char": "signed char",
        }.get(self.long_name, self.long_name.lower())

    @property
    def is_floating_point(self) -> bool:
        return self.category == 2

    def numbers(self, values: Iterable[Any]) -> list[Any]:
        """The values as numbers of this kind: what a float32 cannot hold is rounded, as it is there."""
        if self.name == "float16":
            return list(map(_half, values))
        if self.name == "bfloat16":
            return list(map(_brain, values))
        if self.name == "float32":
            return array("f", list(map(_single, values))).tolist()
        if self.name == "float64":
            return list(map(float, values))
        if self.name == "bool":
            return list(map(bool, values))
        bits = {"int64": 64, "int32": 32, "int16": 16, "int8": 8, "uint8": 8}[self.name]
        return [_wrapped(_whole(value), bits, self.name != "uint8") for value in values]


def _single(value: Any) -> float:
    value = float(value)
    return value if -3.4028235677973366e38 < value < 3.4028235677973366e38 or value != value else value * float("inf")


def _half(value: Any) -> float:
    value = _single(value)
    try:
        return struct.unpack("<e", struct.pack("<e", value))[0]
    except OverflowError:
        return math.copysign(math.inf, value)


def _brain(value: Any) -> float:
    """The upper half of a float32, rounded to even."""
    value = _single(value)
    if value != value or abs(value) == math.inf:
        return value
    bits = struct.unpack("<I", struct.pack("<f", value))[0]
    return struct.unpack("<f", struct.pack("<I", (bits + 0x7FFF + (bits >> 16 & 1)) & 0xFFFF0000))[0]


def _whole(value: Any) -> int:
    return int(value) if isinstance(value, int) or abs(value) < 2**63 else -(2**63)  # also of what is no number


def _wrapped(value: int, bits: int, signed: bool) -> int:
    half = 1 << (bits - 1)
    if signed:
        return value if -half <= value < half else (value + half) % (2 * half) - half
    return value % (2 * half)


bool_ = dtype("bool", "Bool", 0, 0)
uint8 = dtype("uint8", "Byte", 1, 1)
int8 = dtype("int8", "Char", 1, 1.2)
int16 = dtype("int16", "Short", 1, 1.5)
int32 = dtype("int32", "Int", 1, 2)
int64 = dtype("int64", "Long", 1, 3)
float32 = dtype("float32", "Float", 2, 4)
float64 = dtype("float64", "Double", 2, 5)
float16 = dtype("float16", "Half", 2, 3.5)
bfloat16 = dtype("bfloat16", "BFloat16", 2, 3.4)
BY_NAME = {kind.name: kind for kind in (bool_, uint8, int8, int16, int32, int64, float16, bfloat16, float32, float64)}


def named(kind: Any) -> Any:
    """Python's float, int and bool as kinds; anything else as it is."""
    return {float: float64, int: int64, bool: bool_}.get(kind, kind) if isinstance(kind, type) else kind


def of_number(value: Any) -> dtype:
    """The kind of a Python number; a float is taken for the default, float32."""
    return bool_ if isinstance(value, bool) else int64 if isinstance(value, int) else float32


def promoted(a: dtype, b: dtype) -> dtype:
    """The kind that holds both, or nearly."""
    if {a.name, b.name} == {"float16", "bfloat16"}:
        return float32
    if {a.name, b.name} == {"uint8", "int8"}:
        return int16
    return a if a.rank > b.rank else b


def result_type(*operands: Any) -> dtype:
    """The kind of a result. Tensors with axes decide among themselves; one without axes, and after it a Python number, has a say only
    if it is of a higher category (bool < integers < floats)."""
    levels: list[dtype | None] = [None, None, None]
    for operand in operands:
        is_tensor = hasattr(operand, "storage")
        level = (0 if operand.shape else 1) if is_tensor else 2
        kind = operand.dtype if is_tensor else of_number(operand)
        held = levels[level]
        levels[level] = kind if held is None else promoted(kind, held)
    decided: dtype | None = None
    for kind in levels:
        if kind is not None and (decided is None or kind.category > decided.category):
            decided = kind
    assert decided is not None
    return decided
