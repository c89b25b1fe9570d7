"""Products of matrices."""

from __future__ import annotations

import operator
from typing import Any

from .making import make, need_tensor, record
from .missing import Missing
from .reductions import root_or_zero
from .shapes import broadcast_shapes, count
from .tensor import Tensor


def matmul(input: Tensor, other: Tensor) -> Tensor:
    need_tensor("matmul", "other", 2, other)
    if input.ndim == other.ndim == 1 and input.dtype is not other.dtype:
        kinds = f"{input.dtype.long_name} and {other.dtype.long_name}"
        raise RuntimeError(f"dot : expected both vectors to have same dtype, but found {kinds}")
    if not input.ndim or not other.ndim:
        raise RuntimeError(f"both arguments to matmul need to be at least 1D, but they are {input.ndim}D and {other.ndim}D")
    a = input.unsqueeze(0) if input.ndim == 1 else input
    b = other.unsqueeze(1) if other.ndim == 1 else other
    if a.shape[-1] != b.shape[-2]:
        if input.ndim == other.ndim == 1:
            raise RuntimeError(
                f"inconsistent tensor size, expected tensor [{input.shape[0]}] and src [{other.shape[0]}] to have the same number of"
                f" elements, but got {input.shape[0]} and {other.shape[0]} elements respectively"
            )
        if other.ndim == 1:
            raise RuntimeError(
                f"size mismatch, got input ({a.shape[-2]}), mat ({a.shape[-2]}x{a.shape[-1]}), vec ({b.shape[-2]})"
            )
        if min(input.ndim, other.ndim) > 2:
            number = count(broadcast_shapes(a.shape[:-2], b.shape[:-2]))
            raise RuntimeError(
                f"Expected size for first two dimensions of batch2 tensor to be: [{number}, {a.shape[-1]}] but got: [{number},"
                f" {b.shape[-2]}]."
            )
        raise RuntimeError(
            f"mat1 and mat2 shapes cannot be multiplied ({a.shape[-2]}x{a.shape[-1]} and {b.shape[-2]}x{b.shape[-1]})"
        )
    if input.dtype is not other.dtype:
        raise RuntimeError(f"expected m1 and m2 to have the same dtype, but got: {input.dtype.c_name} != {other.dtype.c_name}")
    vectors = input.ndim == other.ndim == 1
    if input.dtype.category == 0 and (vectors or (count(a.shape) and count(b.shape))):
        raise NotImplementedError(f"\"addmm_impl_cpu_\" not implemented for '{input.dtype.long_name}'")
    batch = broadcast_shapes(a.shape[:-2], b.shape[:-2])
    result = _batched(a.expand(*batch, *a.shape[-2:]), b.expand(*batch, *b.shape[-2:]))
    if input.ndim == 1:
        result = result.squeeze(-2)
    return result.squeeze(-1) if other.ndim == 1 else result


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

    return record(
        make(product(left, right, n, k, m, times), (*a.shape[:-2], n, m), a.dtype), "MmBackward0", [a, b], send_back, [a, b]
    )


def mm(input: Tensor, mat2: Tensor) -> Tensor:
    for name, x in (("self", input), ("mat2", mat2)):
        if x.ndim != 2:
            raise RuntimeError(f"{name} must be a matrix")
    return matmul(input, mat2)


def dot(input: Tensor, other: Tensor) -> Tensor:
    if input.ndim != 1 or other.ndim != 1:
        raise RuntimeError(f"1D tensors expected, but got {input.ndim}D and {other.ndim}D tensors")
    return matmul(input, other)


def outer(input: Tensor, vec2: Tensor) -> Tensor:
    for name, x in (("self", input), ("vec2", vec2)):
        if x.ndim != 1:
            raise RuntimeError(f"outer: Expected 1-D argument {name}, but got {x.ndim}-D")
    return input.unsqueeze(1) * vec2.unsqueeze(0)


def vdot(input: Tensor, other: Tensor) -> Tensor:
    return dot(input, other)


def bmm(input: Tensor, mat2: Tensor) -> Tensor:
    if input.ndim != 3 or mat2.ndim != 3:
        raise RuntimeError(f"batch{1 if input.ndim != 3 else 2} must be a 3D tensor")
    return matmul(input, mat2)


def mv(input: Tensor, vec: Tensor) -> Tensor:
    if input.ndim != 2 or vec.ndim != 1:
        raise RuntimeError(f"vector + matrix @ vector expected, got {vec.ndim}, {input.ndim}, {vec.ndim}")
    return matmul(input, vec)


def inner(input: Tensor, other: Tensor) -> Tensor:
    if not input.ndim or not other.ndim:
        return input * other
    if input.shape[-1] != other.shape[-1]:
        raise RuntimeError(
            f"inner() the last dimension must match on both input tensors but got shapes {list(input.shape)} and {list(other.shape)}"
        )
    rows = matmul(input.reshape(-1, input.shape[-1]), other.reshape(-1, other.shape[-1]).t())
    return rows.reshape(*input.shape[:-1], *other.shape[:-1])


def addmm_(input: Tensor, mat1: Tensor, mat2: Tensor, *, beta: float = 1, alpha: float = 1) -> Tensor:
    return beta * input + alpha * mm(mat1, mat2)


def cdist(x1: Tensor, x2: Tensor, p: float = 2.0, compute_mode: str = "") -> Tensor:
    if p != 2:
        raise Missing(f"torch.cdist with p={p}")
    for number, x in ((1, x1), (2, x2)):
        if x.ndim < 2:
            raise RuntimeError(f"cdist only supports at least 2D tensors, X{number} got: {x.ndim}D")
    if x1.dtype is not x2.dtype:
        raise RuntimeError(f"expected scalar type {x2.dtype.long_name} but found {x1.dtype.long_name}")
    return root_or_zero(((x1.unsqueeze(-2) - x2.unsqueeze(-3)) ** 2).sum(-1))
