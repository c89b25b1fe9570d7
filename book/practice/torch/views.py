"""Other shapes of the same numbers: nothing is copied, and whoever writes to a view writes to what it is a view of."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

from . import dtypes
from .making import sizes_of
from .missing import Missing
from .shapes import axes_of, axis_of, broadcast_shapes, count, strides_of
from .tensor import Tensor, spread_strides


def view_of(x: Tensor, shape: Sequence[int], strides: Sequence[int], offset: int | None = None) -> Tensor:
    return x.as_view(shape, strides, x.offset if offset is None else offset)


def _with_inferred(shape: Sequence[int], total: int) -> tuple[int, ...]:
    shape = tuple(operator.index(size) for size in shape)
    known = count([size for size in shape if size != -1])
    fits = total == known if -1 not in shape else known and total % known == 0 and shape.count(-1) == 1
    if not fits:
        raise RuntimeError(f"shape '{list(shape)}' is invalid for input of size {total}")
    return tuple(total // known if size == -1 else size for size in shape)


def _view_strides(x: Tensor, shape: Sequence[int]) -> tuple[int, ...] | None:
    """The strides with which the same numbers have another shape; None if there are none.

    Axes that lie in the row without gaps form a run; the new axes must divide each run between them.
    """
    if x.is_contiguous() or not count(shape):
        return strides_of(shape)
    strides, axis, last = [0] * len(shape), len(shape) - 1, x.strides[-1]
    old = new = 1
    for place in reversed(range(x.ndim)):
        old *= x.shape[place]
        if place and (x.shape[place - 1] == 1 or x.strides[place - 1] == old * last):
            continue
        while axis >= 0 and (new < old or shape[axis] == 1):
            strides[axis] = new * last
            new *= shape[axis]
            axis -= 1
        if new != old:
            return None
        if place:
            last, old, new = x.strides[place - 1], 1, 1
    return tuple(strides) if axis == -1 else None


def reshape(input: Tensor, *shape: Any) -> Tensor:
    sizes = _with_inferred(sizes_of(shape), count(input.shape))
    strides = _view_strides(input, sizes)
    return view_of(input.clone(), sizes, strides_of(sizes)) if strides is None else view_of(input, sizes, strides)


def view(input: Tensor, *shape: Any) -> Tensor:
    if len(shape) == 1 and isinstance(shape[0], dtypes.dtype):
        raise Missing("Tensor.view of another dtype")
    sizes = _with_inferred(sizes_of(shape), count(input.shape))
    strides = _view_strides(input, sizes)
    if strides is None:
        raise RuntimeError(
            "view size is not compatible with input tensor's size and stride (at least one dimension spans across two contiguous"
            " subspaces). Use .reshape(...) instead."
        )
    return view_of(input, sizes, strides)


def flatten(input: Tensor, start_dim: int = 0, end_dim: int = -1) -> Tensor:
    first, last = axis_of(start_dim, input.ndim), axis_of(end_dim, input.ndim)
    return reshape(input, (*input.shape[:first], count(input.shape[first : last + 1]), *input.shape[last + 1 :]))


def unsqueeze(input: Tensor, dim: int) -> Tensor:
    axis = axis_of(dim, input.ndim + 1)
    return view_of(input, (*input.shape[:axis], 1, *input.shape[axis:]), (*input.strides[:axis], 1, *input.strides[axis:]))


def squeeze(input: Tensor, dim: Any = None) -> Tensor:
    axes = axes_of(dim, input.ndim)
    kept = [axis for axis in range(input.ndim) if axis not in axes or input.shape[axis] != 1]
    return view_of(input, [input.shape[axis] for axis in kept], [input.strides[axis] for axis in kept])


def permute(input: Tensor, *dims: Any) -> Tensor:
    wanted = _flat_arguments(dims)
    if len(wanted) != input.ndim:
        raise RuntimeError(
            "permute(sparse_coo): number of dimensions in the tensor input does not match the length of the desired ordering of"
            f" dimensions i.e. input.dim() = {input.ndim} is not equal to len(dims) = {len(wanted)}"
        )
    axes = [axis_of(dim, input.ndim) for dim in wanted]
    if len(set(axes)) < len(axes):
        raise RuntimeError("permute(): duplicate dims are not allowed.")
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
    if not input.ndim:
        return view_of(input, (), ())
    axes = [axis for axis in range(input.ndim) if axis != axis_of(source, input.ndim)]
    axes.insert(axis_of(destination, input.ndim), axis_of(source, input.ndim))
    return permute(input, axes)


def expand(input: Tensor, *sizes: Any) -> Tensor:
    wanted = list(sizes_of(sizes))
    lead = len(wanted) - input.ndim
    if lead < 0:
        raise RuntimeError(
            f"expand(torch.{input.dtype.long_name}Tensor{{{list(input.shape)}}}, size={wanted}): the number of sizes provided"
            f" ({len(wanted)}) must be greater or equal to the number of dimensions in the tensor ({input.ndim})"
        )
    if any(size < 0 and not (size == -1 and axis >= lead) for axis, size in enumerate(wanted)):
        axis = next(axis for axis, size in enumerate(wanted) if size < 0 and not (size == -1 and axis >= lead))
        raise RuntimeError(
            f"The expanded size of the tensor ({wanted[axis]}) isn't allowed in a leading, non-existing dimension {axis}"
        )
    shape = [input.shape[axis - lead] if size == -1 and axis >= lead else size for axis, size in enumerate(wanted)]
    for axis, (size, want) in enumerate(zip(input.shape, shape[lead:], strict=True)):
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
    if not input.ndim:
        raise RuntimeError("narrow() cannot be applied to a 0-dim tensor.")
    axis = axis_of(dim, input.ndim)
    size = input.shape[axis]
    first = start + size if start < 0 else start
    if length < 0 or not 0 <= first <= size or first + length > size:
        raise RuntimeError(f"start ({start}) + length ({length}) exceeds dimension size ({size}).")
    return input[(slice(None),) * axis + (slice(first, first + length),)]


def select(input: Tensor, dim: int, index: int) -> Tensor:
    if not input.ndim:
        raise IndexError("select() cannot be applied to a 0-dim tensor.")
    return input[(slice(None),) * axis_of(dim, input.ndim) + (index,)]


def unbind(input: Tensor, dim: int = 0) -> tuple[Tensor, ...]:
    axis_of(dim, input.ndim)
    if not input.ndim:
        raise IndexError("Dimension specified as 0 but tensor has no dimensions")
    return _of_several("Unbind", [select(input, dim, i) for i in range(input.shape[axis_of(dim, input.ndim)])])


def _of_several(name: str, views: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Views that were made at once, none of which may be written to while steps are recorded."""
    for number, view in enumerate(views):
        view.one_of = f"{number} of {name}"
    return tuple(views)


def split(input: Tensor, split_size_or_sections: Any, dim: int = 0) -> tuple[Tensor, ...]:
    if not input.ndim:
        raise RuntimeError("split expects at least a 1-dimensional tensor")
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
    return _of_several("Split", [narrow(input, dim, start, size) for start, size in zip(starts, sizes, strict=True)])


def chunk(input: Tensor, chunks: int, dim: int = 0) -> tuple[Tensor, ...]:
    if not input.ndim:
        raise RuntimeError("chunk expects at least a 1-dimensional tensor")
    return split(input, max(-(-input.shape[axis_of(dim, input.ndim)] // chunks), 1), dim)


def diagonal(input: Tensor, offset: int = 0, dim1: int = 0, dim2: int = 1) -> Tensor:
    if input.ndim != 2 or offset:
        raise Missing("torch.diagonal with offset= or of more than two axes")
    return view_of(input, (min(input.shape),), (sum(input.strides),))


def ravel(input: Tensor) -> Tensor:
    return reshape(input, -1)


def unflatten(input: Tensor, dim: int, sizes: Sequence[int]) -> Tensor:
    axis = axis_of(dim, input.ndim)
    return reshape(input, (*input.shape[:axis], *_with_inferred(sizes, input.shape[axis]), *input.shape[axis + 1 :]))
