"""`torch.nn.functional`, as far as the exercises meet it."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from typing import Any

from . import dtypes, rows
from .entrywise import OF_ONE, entrywise, exponential, floats_only, log_logistic, logistic, sign_of, where
from .making import full, make, nan
from .missing import Missing, missing
from .moving import cat
from .shapes import broadcast_shapes
from .tensor import Tensor

sigmoid, tanh, relu = OF_ONE["sigmoid"], OF_ONE["tanh"], OF_ONE["relu"]


def __getattr__(name: str) -> Any:
    raise missing("torch.nn.functional", name)


def _axis_taken(input: Tensor, dim: int | None) -> int:
    """Where no axis is named, torch warns and takes one."""
    return dim if dim is not None else 0 if input.ndim in (0, 1, 3) else 1


def softmax(input: Tensor, dim: int | None = None, *, dtype: Any = None) -> Tensor:
    return rows.softmax(input, _axis_taken(input, dim), dtype=dtype)


def log_softmax(input: Tensor, dim: int | None = None, *, dtype: Any = None) -> Tensor:
    return rows.log_softmax(input, _axis_taken(input, dim), dtype=dtype)


def logsigmoid(input: Tensor) -> Tensor:
    if not input.dtype.is_floating_point:
        raise NotImplementedError(f"\"log_sigmoid_cpu\" not implemented for '{input.dtype.long_name}'")
    return entrywise("logsigmoid", log_logistic, [lambda x, y: logistic(-x)], [input])


def _softplus(x: float) -> float:
    return x if x > 20 else math.log1p(exponential(x))


def softplus(input: Tensor, beta: float = 1.0, threshold: float = 20.0) -> Tensor:
    floats_only("softplus_cpu", input.dtype)
    if beta != 1 or threshold != 20:
        return softplus(input * beta) / beta
    return entrywise("softplus", _softplus, [lambda x, y: 1.0 if x > 20 else logistic(x)], [input])


def silu(input: Tensor) -> Tensor:
    floats_only("silu_cpu", input.dtype)
    return input * sigmoid(input)


def one_hot(tensor: Tensor, num_classes: int = -1) -> Tensor:
    if tensor.dtype is not dtypes.int64:
        raise RuntimeError(f"one_hot is only applicable to index tensor of type LongTensor. Got {tensor.dtype.long_name}")
    entries = tensor.flat()
    if min(entries, default=0) < 0:
        raise RuntimeError("Class values must be non-negative.")
    if num_classes == -1 and not entries:
        raise RuntimeError("Can not infer total number of classes from empty tensor.")
    if num_classes != -1 and max(entries, default=-1) >= num_classes:
        raise RuntimeError("Class values must be smaller than num_classes.")
    classes = num_classes if num_classes != -1 else max(entries) + 1
    return make([i == entry for entry in entries for i in range(classes)], (*tensor.shape, classes), dtypes.int64)


def pad(input: Tensor, pad: Sequence[int], mode: str = "constant", value: float = 0.0) -> Tensor:
    if mode != "constant":
        raise Missing(f"torch.nn.functional.pad with mode={mode!r}")
    result = input
    if len(pad) > 2 * input.ndim:
        raise RuntimeError(
            "Padding length should be less than or equal to two times the input dimension but got padding length"
            f" {len(pad)} and input of dimension {input.ndim}"
        )
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


def _together(kernel: str, input: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    shape = broadcast_shapes(input.shape, target.shape)
    kind = dtypes.result_type(input.expand(shape), target.expand(shape))
    floats_only(kernel, kind)
    return input.expand(shape).to(kind), target.expand(shape).to(kind)


def mse_loss(input: Tensor, target: Tensor, reduction: str = "mean") -> Tensor:
    input, target = _together("mse_cpu", input, target)
    return _reduced((input - target) ** 2, reduction)


def l1_loss(input: Tensor, target: Tensor, reduction: str = "mean") -> Tensor:
    shape = broadcast_shapes(input.shape, target.shape)
    return _reduced((input.expand(shape) - target.expand(shape)).abs(), reduction)


def _bent(name: str, input: Tensor, target: Tensor, knee: float, curvature: float) -> Tensor:
    """A parabola of the difference up to `knee`, and its tangents from there on."""

    def compute(a: float, b: float) -> float:
        far = abs(a - b)
        return 0.5 * curvature * far * far if far < knee else curvature * knee * (far - 0.5 * knee) if knee else far

    def slope(a: float, b: float, y: float) -> float:
        return (
            curvature * (a - b)
            if abs(a - b) < knee
            else (curvature * knee if knee else 1.0) * (sign_of(a - b) if a == a and b == b else nan)
        )

    return entrywise(name, compute, [slope, lambda a, b, y: -slope(a, b, y)], [input, target])


def smooth_l1_loss(input: Tensor, target: Tensor, reduction: str = "mean", beta: float = 1.0) -> Tensor:
    input, target = _together("smooth_l1_cpu", input, target)
    return _reduced(_bent("smooth_l1", input, target, beta, 1 / beta if beta else 0.0), reduction)


def huber_loss(input: Tensor, target: Tensor, reduction: str = "mean", delta: float = 1.0) -> Tensor:
    if target.dtype.is_floating_point and not input.dtype.is_floating_point:
        kinds = f"{target.dtype.long_name} can't be cast to the desired output type {input.dtype.long_name}"
        raise RuntimeError(f"result type {kinds}")
    kind = input.dtype
    input, target = _together("huber_cpu", input, target)
    return _reduced(_bent("huber", input, target, delta, 1.0).to(kind), reduction)


def binary_cross_entropy_with_logits(input: Tensor, target: Tensor, weight: Any = None, reduction: str = "mean") -> Tensor:
    if target.shape != input.shape:
        raise ValueError(f"Target size ({target.shape}) must be the same as input size ({input.shape})")
    floats_only("log_sigmoid_cpu", input.dtype)
    if not target.dtype.is_floating_point:
        kinds = f"{input.dtype.long_name} can't be cast to the desired output type {target.dtype.long_name}"
        raise RuntimeError(f"result type {kinds}")
    losses = (1 - target) * input - logsigmoid(input)
    losses = (losses if weight is None else losses * weight).to(target.dtype)
    return _reduced(losses, reduction)


def binary_cross_entropy(input: Tensor, target: Tensor, weight: Any = None, reduction: str = "mean") -> Tensor:
    if target.shape != input.shape:
        raise ValueError(
            f"Using a target size ({target.shape}) that is different to the input size ({input.shape}) is deprecated. "
            "Please ensure they have the same size."
        )
    if not all(0 <= x <= 1 for x in input.flat()):
        raise RuntimeError("all elements of input should be between 0 and 1")

    least = array("f", [1e-12])[0]  # torch's bound on x (1 - x), which is in single precision there

    def log(x: float, bound: float = -100.0) -> float:  # torch's bound, so that no loss is infinite
        return max(math.log(x), bound) if x > 0 else bound

    losses = entrywise(
        "binary_cross_entropy",
        lambda x, t: (t - 1) * log(1 - x) - t * log(x),
        [lambda x, t, y: (x - t) / max((1 - x) * x, least), lambda x, t, y: log(1 - x, -math.inf) - log(x, -math.inf)],
        [input, target],
    )
    return _reduced(losses if weight is None else losses * weight, reduction)


def cross_entropy(
    input: Tensor,
    target: Tensor,
    weight: Any = None,
    ignore_index: int = -100,
    reduction: str = "mean",
    label_smoothing: float = 0.0,
) -> Tensor:
    if weight is not None:
        raise Missing("torch.nn.functional.cross_entropy with weight=")
    _target_only("cross_entropy_loss", target)
    if target.shape == input.shape and not target.dtype.is_floating_point:
        raise RuntimeError(f"Expected floating point type for target with class probabilities, got {target.dtype.long_name}")
    axis = 0 if input.ndim == 1 else 1
    logps = log_softmax(input, axis)
    classes = input.shape[axis]
    if target.shape == input.shape:
        if ignore_index >= 0:
            raise RuntimeError("ignore_index is not supported for floating point target")
        smooth = target * (1 - label_smoothing) + label_smoothing / classes if label_smoothing else target
        losses = -(logps * smooth).sum(axis)
        return _reduced(losses, reduction) if reduction != "mean" else losses.sum() / losses.numel()
    losses = nll_loss(logps, target, ignore_index=ignore_index, reduction=reduction)
    if not label_smoothing:
        return losses
    kept = target != ignore_index
    spread = where(kept, -logps.sum(axis), 0.0)
    spread = spread.sum() / kept.sum() if reduction == "mean" else _reduced(spread, reduction)
    return (1 - label_smoothing) * losses + label_smoothing / classes * spread


def _target_only(name: str, target: Any) -> None:
    if not isinstance(target, Tensor):
        raise TypeError(f"{name}(): argument 'target' (position 2) must be Tensor, not {type(target).__name__}")


def nll_loss(input: Tensor, target: Tensor, weight: Any = None, ignore_index: int = -100, reduction: str = "mean") -> Tensor:
    if weight is not None:
        raise Missing("torch.nn.functional.nll_loss with weight=")
    _target_only("nll_loss_nd", target)
    if not input.ndim:
        raise ValueError("Expected 1 or more dimensions (got 0)")
    if input.ndim > 1 and target.shape[:1] != input.shape[:1]:
        sizes = f"({input.shape[0]}) to match target batch_size ({target.shape[0] if target.ndim else 0})"
        raise ValueError(f"Expected input batch_size {sizes}.")
    if target.dtype not in (dtypes.int64, dtypes.BY_NAME.get("uint8")):
        raise RuntimeError(f"expected target dtype to be Long or Byte, but got {target.dtype.long_name}")
    floats_only("nll_loss_out_frame", input.dtype)
    target = target.to(dtypes.int64)
    axis = 0 if input.ndim == 1 else 1
    if input.ndim == 1 and target.ndim == 1 and target.shape == (1,):
        target = target.reshape(())
    asked = [size for place, size in enumerate(input.shape) if place != axis]
    if input.ndim > 2 and list(target.shape) != asked:
        raise RuntimeError(f"Expected target size {asked}, got {list(target.shape)}")
    if target.ndim != input.ndim - 1:
        raise RuntimeError("0D or 1D target tensor expected, multi-target not supported")
    beyond = [entry for entry in target.flat() if entry != ignore_index and not 0 <= entry < input.shape[axis]]
    if beyond:
        raise IndexError(f"Target {beyond[0]} is out of bounds.")
    kept: Any = target != ignore_index
    index = where(kept, target, 0)
    losses = where(kept, -input.gather(axis, index.unsqueeze(axis)).squeeze(axis), 0.0)
    return losses.sum() / kept.sum() if reduction == "mean" else _reduced(losses, reduction)


def normalize(input: Tensor, p: float = 2.0, dim: int = 1, eps: float = 1e-12) -> Tensor:
    if p != 2:
        raise Missing(f"torch.nn.functional.normalize with p={p}")
    return input / input.norm(2, dim, True).clamp(min=eps)


def layer_norm(input: Tensor, normalized_shape: Sequence[int], weight: Any = None, bias: Any = None, eps: float = 1e-5) -> Tensor:
    axes = tuple(range(input.ndim - len(normalized_shape), input.ndim))
    result = (input - input.mean(axes, keepdim=True)) / (input.var(axes, unbiased=False, keepdim=True) + eps).sqrt()
    result = result if weight is None else result * weight
    return result if bias is None else result + bias


def gaussian_nll_loss(
    input: Tensor, target: Tensor, var: Any, full: bool = False, eps: float = 1e-6, reduction: str = "mean"
) -> Tensor:
    if not isinstance(var, Tensor):
        var = input.new_full(input.shape, var)
    if var.shape != input.shape and var.shape not in (input.shape[:-1], (*input.shape[:-1], 1)):
        raise ValueError("var is of incorrect size")
    if var.shape == input.shape[:-1] and var.shape != input.shape:
        var = var.unsqueeze(-1)
    if bool((var < 0).any()):
        raise ValueError("var has negative entry/entries")
    wide = var + (var.detach().clamp(min=eps) - var.detach())  # what is held up passes its gradient on all the same
    losses = 0.5 * (wide.log() + (input - target) ** 2 / wide)
    return _reduced(losses + 0.5 * math.log(2 * math.pi) if full else losses, reduction)
