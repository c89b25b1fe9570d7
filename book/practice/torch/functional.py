"""`torch.nn.functional`, as far as the exercises meet it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from . import dtypes
from .entrywise import OF_ONE, entrywise, exponential, log_logistic, logistic, where
from .making import full, make
from .missing import Missing, missing
from .moving import cat
from .rows import log_softmax
from .tensor import Tensor

sigmoid, tanh, relu = OF_ONE["sigmoid"], OF_ONE["tanh"], OF_ONE["relu"]


def __getattr__(name: str) -> Any:
    raise missing("torch.nn.functional", name)


def logsigmoid(input: Tensor) -> Tensor:
    if not input.dtype.is_floating_point:
        raise NotImplementedError(f"\"log_sigmoid_cpu\" not implemented for '{input.dtype.long_name}'")
    return entrywise("logsigmoid", log_logistic, [lambda x, y: logistic(-x)], [input])


def _softplus(x: float) -> float:
    return x if x > 20 else math.log1p(exponential(x))


def softplus(input: Tensor, beta: float = 1.0, threshold: float = 20.0) -> Tensor:
    if beta != 1 or threshold != 20:
        return softplus(input * beta) / beta
    return entrywise("softplus", _softplus, [lambda x, y: 1.0 if x > 20 else logistic(x)], [input])


def silu(input: Tensor) -> Tensor:
    return input * sigmoid(input)


def one_hot(tensor: Tensor, num_classes: int = -1) -> Tensor:
    if tensor.dtype is not dtypes.int64:
        raise RuntimeError(f"one_hot is only applicable to index tensor of type LongTensor. Got {tensor.dtype.long_name}")
    entries = tensor.flat()
    classes = num_classes if num_classes != -1 else max(entries) + 1
    return make([i == entry for entry in entries for i in range(classes)], (*tensor.shape, classes), dtypes.int64)


def pad(input: Tensor, pad: Sequence[int], mode: str = "constant", value: float = 0.0) -> Tensor:
    if mode != "constant":
        raise Missing(f"torch.nn.functional.pad with mode={mode!r}")
    result = input
    for number in range(len(pad) // 2):
        axis = input.ndim - 1 - number
        before, after = pad[2 * number], pad[2 * number + 1]
        size = result.shape[axis]
        result = result.narrow(axis, max(-before, 0), size - max(-before, 0) - max(-after, 0))
        for length, first in ((before, True), (after, False)):
            if length > 0:
                shape = (*result.shape[:axis], length, *result.shape[axis + 1 :])
                border = full(shape, value, dtype=result.dtype)
                result = cat([border, result] if first else [result, border], axis)
    return result


def _reduced(losses: Tensor, reduction: str) -> Tensor:
    if reduction not in ("none", "mean", "sum"):
        raise ValueError(f"{reduction} is not a valid value for reduction")
    return losses if reduction == "none" else losses.mean() if reduction == "mean" else losses.sum()


def mse_loss(input: Tensor, target: Tensor, reduction: str = "mean") -> Tensor:
    return _reduced((input - target) ** 2, reduction)


def l1_loss(input: Tensor, target: Tensor, reduction: str = "mean") -> Tensor:
    return _reduced((input - target).abs(), reduction)


def smooth_l1_loss(input: Tensor, target: Tensor, reduction: str = "mean", beta: float = 1.0) -> Tensor:
    distance = (input - target).abs()
    return _reduced(where(distance < beta, 0.5 * distance**2 / beta, distance - 0.5 * beta), reduction)


def huber_loss(input: Tensor, target: Tensor, reduction: str = "mean", delta: float = 1.0) -> Tensor:
    distance = (input - target).abs()
    return _reduced(where(distance <= delta, 0.5 * distance**2, delta * (distance - 0.5 * delta)), reduction)


def binary_cross_entropy_with_logits(input: Tensor, target: Tensor, weight: Any = None, reduction: str = "mean") -> Tensor:
    if target.shape != input.shape:
        raise ValueError(f"Target size ({target.shape}) must be the same as input size ({input.shape})")
    losses = -(target * logsigmoid(input) + (1 - target) * logsigmoid(-input))
    return _reduced(losses if weight is None else losses * weight, reduction)


def binary_cross_entropy(input: Tensor, target: Tensor, weight: Any = None, reduction: str = "mean") -> Tensor:
    losses = -(target * input.log().clamp(min=-100) + (1 - target) * (1 - input).log().clamp(min=-100))
    return _reduced(losses if weight is None else losses * weight, reduction)


def cross_entropy(
    input: Tensor,
    target: Tensor,
    weight: Any = None,
    ignore_index: int = -100,
    reduction: str = "mean",
    label_smoothing: float = 0.0,
) -> Tensor:
    if weight is not None or label_smoothing:
        raise Missing("torch.nn.functional.cross_entropy with weight= or label_smoothing=")
    axis = 0 if input.ndim == 1 else 1
    logps = log_softmax(input, axis)
    if target.dtype.is_floating_point:
        losses = -(logps * target).sum(axis)
        return _reduced(losses, reduction) if reduction != "mean" else losses.sum() / max(losses.numel(), 1)
    return nll_loss(logps, target, ignore_index=ignore_index, reduction=reduction)


def nll_loss(input: Tensor, target: Tensor, weight: Any = None, ignore_index: int = -100, reduction: str = "mean") -> Tensor:
    axis = 0 if input.ndim == 1 else 1
    kept = target != ignore_index
    index = where(kept, target, 0)
    losses = where(kept, -input.gather(axis, index.unsqueeze(axis)).squeeze(axis), 0.0)
    return losses.sum() / kept.sum() if reduction == "mean" else _reduced(losses, reduction)


def normalize(input: Tensor, p: float = 2.0, dim: int = 1, eps: float = 1e-12) -> Tensor:
    if p != 2:
        raise Missing(f"torch.nn.functional.normalize with p={p}")
    return input / (input**2).sum(dim, keepdim=True).sqrt().clamp(min=eps)


def layer_norm(input: Tensor, normalized_shape: Sequence[int], weight: Any = None, bias: Any = None, eps: float = 1e-5) -> Tensor:
    axes = tuple(range(input.ndim - len(normalized_shape), input.ndim))
    result = (input - input.mean(axes, keepdim=True)) / (input.var(axes, unbiased=False, keepdim=True) + eps).sqrt()
    result = result if weight is None else result * weight
    return result if bias is None else result + bias
