"""Entries that are moved and not computed: picked, turned, joined, scattered."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from . import dtypes
from .entrywise import where
from .making import make, record, sizes_of, tensor, tensor_like
from .missing import Missing
from .shapes import axes_of, axis_of, broadcast_shapes, count, positions, strides_of
from .tensor import Storage, Tensor


def _rearranged(name: str, x: Tensor, places: Sequence[int], shape: Sequence[int]) -> Tensor:
    """The entries at `places`, in reading order of x; the gradient goes back to where each came from."""
    flat = x.flat()
    result = Tensor(Storage([flat[place] for place in places]), shape, x.dtype)

    def send_back(gradient: Tensor) -> list[Tensor]:
        numbers = [0.0] * count(x.shape)
        for place, value in zip(places, gradient.flat(), strict=True):
            numbers[place] += value
        return [make(numbers, x.shape, x.dtype)]

    return record(result, f"{name}Backward0", [x], send_back)


def _own_places(x: Tensor) -> Tensor:
    return Tensor(Storage(list(range(count(x.shape)))), x.shape, dtypes.int64)


def gather(input: Tensor, dim: int, index: Tensor) -> Tensor:
    result = picked(input, dim, index)
    if result.step is not None:
        result.step.relies_on = [(one, one.storage.version) for one in (input, index)]
    return result


def picked(input: Tensor, dim: int, index: Tensor) -> Tensor:
    """`gather`, of which no step relies on what the entries were."""
    if index.dtype is not dtypes.int64:
        raise RuntimeError("gather(): Expected dtype int32/int64 for index")
    if max(index.ndim, 1) != max(input.ndim, 1) and count(index.shape):
        raise RuntimeError("Index tensor must have the same number of dimensions as input tensor")
    axis = axis_of(dim, input.ndim)
    if not count(index.shape):
        return _rearranged("Gather", input, [], index.shape)
    if not input.ndim or not index.ndim:
        return picked(input.reshape(1) if not input.ndim else input, 0, index.reshape(-1)).reshape(index.shape)
    if any(size > own for i, (size, own) in enumerate(zip(index.shape, input.shape, strict=True)) if i != axis):
        sizes = enumerate(zip(index.shape, input.shape, strict=True))
        number = next(i for i, (size, own) in sizes if i != axis and size > own)
        raise RuntimeError(
            f"Size does not match at dimension {number} expected index {list(index.shape)} to be no larger than self"
            f" {list(input.shape)} apart from dimension {dim}"
        )
    strides = list(strides_of(input.shape))
    along, strides[axis : axis + 1] = strides[axis] if strides else 1, [0] if strides else []
    places = []
    for start, chosen in zip(positions(index.shape, strides, 0), index.flat(), strict=True):
        if not 0 <= chosen < (input.shape[axis] if input.shape else 1):
            raise RuntimeError(f"index {chosen} is out of bounds for dimension {axis} with size {input.shape[axis]}")
        places.append(start + chosen * along)
    return _rearranged("Gather", input, places, index.shape)


def take_along_dim(input: Tensor, indices: Tensor, dim: int) -> Tensor:
    axis = axis_of(dim, input.ndim)
    if indices.dtype is not dtypes.int64:
        raise RuntimeError(f"torch.take_along_dim(): dtype of indices should be Long but got {indices.dtype.long_name}")
    if indices.ndim != input.ndim:
        raise RuntimeError(
            "torch.take_along_dim(): input and indices should have the same number of dimensions, but got"
            f" {input.ndim} dimensions for input, and {indices.ndim} dimensions for indices"
        )
    lengths = list(broadcast_shapes(*([*x.shape[:axis], 1, *x.shape[axis + 1 :]] for x in (input, indices))))
    wide = [x.expand([*lengths[:axis], x.shape[axis], *lengths[axis + 1 :]]) for x in (input, indices)]
    return gather(wide[0], axis, wide[1])


def index_select(input: Tensor, dim: int, index: Tensor) -> Tensor:
    axis = axis_of(dim, input.ndim)
    if index.ndim > 1:
        raise IndexError("index_select(): Index is supposed to be a vector")
    if not input.ndim:
        if count(index.shape) != 1:
            raise RuntimeError(f"index_select(): Index to scalar can have only 1 value, got {count(index.shape)} value(s)")
        return input.reshape(1)[index.reshape(1)].reshape(())
    if count(index.shape) and not input.shape[axis] and input.ndim > 1:
        raise RuntimeError("index_select(): self indexing axis dim should be positive")
    if any(not 0 <= entry < input.shape[axis] for entry in index.flat()):
        raise IndexError("index out of range in self")
    return input[(slice(None),) * axis + (index.reshape(-1),)]


def masked_select(input: Tensor, mask: Tensor) -> Tensor:
    shape = broadcast_shapes(input.shape, mask.shape)
    return input.expand(shape)[mask.expand(shape)]


def nonzero(input: Tensor, *, as_tuple: bool = False) -> Any:
    mask = input != 0
    strides = strides_of(mask.shape)
    found = [place for place, kept in enumerate(mask.flat()) if kept]
    columns = [[place // stride % size for place in found] for stride, size in zip(strides, mask.shape, strict=True)]
    if as_tuple:
        return tuple(make(column, (len(found),), dtypes.int64) for column in columns)
    return make([column[i] for i in range(len(found)) for column in columns], (len(found), mask.ndim), dtypes.int64)


def argwhere(input: Tensor) -> Tensor:
    return nonzero(input)


def flip(input: Tensor, *dims: Any) -> Tensor:
    if not dims:
        raise TypeError('flip() missing 1 required positional arguments: "dims"')
    axes = axes_of(dims[0] if len(dims) == 1 else dims, input.ndim)
    strides = strides_of(input.shape)
    first = sum((input.shape[axis] - 1) * strides[axis] for axis in axes)
    turned = [-stride if axis in axes else stride for axis, stride in enumerate(strides)]
    return _rearranged("Flip", input, positions(input.shape, turned, first), input.shape)


def roll(input: Tensor, shifts: Any, dims: Any = None) -> Tensor:
    if dims is None:
        return roll(input.reshape(-1), shifts, 0).reshape(input.shape)
    pairs = zip(shifts, dims, strict=True) if isinstance(shifts, (tuple, list)) else [(shifts, dims)]
    places = _own_places(input)
    for shift, dim in pairs:
        axis = axis_of(dim, input.ndim)
        size = input.shape[axis]
        places = index_select(places, axis, tensor([(i - shift) % size for i in range(size)], dtype=dtypes.int64))
    return _rearranged("Roll", input, places.flat(), input.shape)


def _all_tensors(entries: Sequence[Any]) -> list[Tensor]:
    for number, other in enumerate(entries):
        if not isinstance(other, Tensor):
            raise TypeError(f"expected Tensor as element {number} in argument 0, but got {type(other).__name__}")
    return list(entries)


def cat(tensors: Sequence[Tensor], dim: int = 0) -> Tensor:
    tensors = _all_tensors(tensors)
    if not tensors:
        raise ValueError("torch.cat(): expected a non-empty list of Tensors")
    if any(not t.shape for t in tensors):
        raise RuntimeError(
            f"zero-dimensional tensor (at position {next(i for i, t in enumerate(tensors) if not t.shape)}) cannot be concatenated"
        )
    every = tensors
    tensors = [t for t in every if t.shape != (0,)] or every[:1]
    axis = axis_of(dim, tensors[0].ndim)
    for number, other in enumerate(tensors):
        if other.ndim != tensors[0].ndim:
            raise RuntimeError(f"Tensors must have same number of dimensions: got {tensors[0].ndim} and {other.ndim}")
        for i, (want, got) in enumerate(zip(tensors[0].shape, other.shape, strict=True)):
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
    numbers = [
        value
        for i in range(outer)
        for flat, width in zip(flats, widths, strict=True)
        for value in flat[i * width : (i + 1) * width]
    ]

    def send_back(gradient: Tensor) -> list[Tensor | None]:
        back: list[Tensor | None] = []
        at = 0
        for t in every:
            if not any(t is one for one in tensors):
                back.append(None)
                continue
            part = gradient.narrow(axis, at, t.shape[axis])
            back.append(part.to(t.dtype) if t.dtype.is_floating_point else part)
            at += t.shape[axis]
        return back

    return record(make(numbers, shape, kind), "CatBackward0", every, send_back)


concat = concatenate = cat


def stack(tensors: Sequence[Tensor], dim: int = 0) -> Tensor:
    tensors = _all_tensors(tensors)
    if not tensors:
        raise RuntimeError("stack expects a non-empty TensorList")
    axis_of(dim, tensors[0].ndim + 1)
    for number, other in enumerate(tensors):
        if other.shape != tensors[0].shape:
            raise RuntimeError(
                f"stack expects each tensor to be equal size, but got {list(tensors[0].shape)} at entry 0 and {list(other.shape)} at entry"
                f" {number}"
            )
    axis = axis_of(dim, tensors[0].ndim + 1)
    return cat([t.unsqueeze(axis) for t in tensors], axis)


def tril(input: Tensor, diagonal: int = 0) -> Tensor:
    return _triangle("tril", input, lambda i, j: j - i <= diagonal)


def triu(input: Tensor, diagonal: int = 0) -> Tensor:
    return _triangle("triu", input, lambda i, j: j - i >= diagonal)


def _nothing(x: Tensor) -> Any:
    """0, or False."""
    return False if x.dtype is dtypes.bool_ else 0


def _triangle(name: str, x: Tensor, keeps: Callable[[int, int], bool]) -> Tensor:
    if x.ndim < 2:
        raise RuntimeError(f"{name}: input tensor must have at least 2 dimensions")
    rows, columns = x.shape[-2:]
    return where(make([keeps(i, j) for i in range(rows) for j in range(columns)], (rows, columns), dtypes.bool_), x, _nothing(x))


def repeat(input: Tensor, *sizes: Any) -> Tensor:
    times = sizes_of(sizes)
    if len(times) < input.ndim:
        raise RuntimeError("Number of dimensions of repeat dims can not be smaller than number of dimensions of tensor")
    x = input.reshape((1,) * (len(times) - input.ndim) + tuple(input.shape))
    places = _own_places(x)
    for axis, number in enumerate(times):
        places = cat([places] * number, axis)
    return _rearranged("Repeat", x, places.flat(), places.shape)


def repeat_interleave(input: Tensor, repeats: int, dim: int | None = None) -> Tensor:
    if not isinstance(repeats, int):
        raise Missing("torch.repeat_interleave by a tensor")
    x, dim = (input.reshape(-1), 0) if dim is None else (input, dim)
    if not x.ndim:
        raise IndexError("Dimension out of range (expected to be in range of [-1, 0], but got 1)")  # so torch says
    return index_select(
        x, dim, tensor([i for i in range(x.shape[axis_of(dim, x.ndim)]) for _ in range(repeats)], dtype=dtypes.int64)
    )


def index_add(input: Tensor, dim: int, index: Tensor, source: Tensor) -> Tensor:
    return _added(input, dim, index, source)


def _fits_index(name: str, x: Tensor, axis: int, index: Tensor, source: Tensor) -> None:
    if index.ndim > 1:
        raise IndexError(
            f"{name}(): Index is supposed to be a vector, but got dim: {index.ndim} with type: {index.dtype.long_name} and size:"
            f" {list(index.shape)}"
        )
    if x.dtype is not source.dtype:
        kinds = f"self ({x.dtype.long_name}) and source ({source.dtype.long_name})"
        raise RuntimeError(f"{name}(): {kinds} must have the same scalar type")
    if source.ndim and axis < source.ndim and source.shape[axis] != count(index.shape):
        raise RuntimeError(
            f"{name}(): Number of indices ({count(index.shape)}) should be equal to source.size(dim): ({source.shape[axis]}), for dim:"
            f" {axis}"
        )
    if (
        not x.ndim
        or source.ndim != x.ndim
        or any(a != b for i, (a, b) in enumerate(zip(x.shape, source.shape, strict=True)) if i != axis)
    ):
        raise RuntimeError(
            "source tensor shape must match self tensor shape, excluding the specified dimension. Got self.shape ="
            f" {list(x.shape)} source.shape = {list(source.shape)}"
        )


def _added(x: Tensor, dim: int, index: Tensor, source: Tensor) -> Tensor:
    axis = axis_of(dim, x.ndim)
    _fits_index("index_add_", x, axis, index, source)
    targets = index_select(_own_places(x), axis, index).flat()
    numbers = x.flat()
    for place, value in zip(targets, source.flat(), strict=True):
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
    if index.ndim != x.ndim and count(index.shape) and index.ndim and x.ndim:
        raise RuntimeError("Index tensor must have the same number of dimensions as self tensor")
    source = (
        src.narrow(0, 0, index.shape[0])
        if isinstance(src, Tensor) and index.shape
        else tensor_like(src, x.dtype).expand(index.shape)
    )
    if source.shape != index.shape:
        raise Missing("torch.scatter with a src larger than its index")
    targets = gather(_own_places(x), dim, index).flat() if count(index.shape) else []
    numbers = x.flat()
    for place, value in zip(targets, source.flat(), strict=True):
        numbers[place] = numbers[place] + value if adding else value

    def send_back(gradient: Tensor) -> list[Tensor]:
        kept, arriving = gradient.flat(), gradient.flat()
        for place in () if adding else targets:
            kept[place] = 0.0
        return [make(kept, x.shape, x.dtype), make([arriving[place] for place in targets], index.shape, x.dtype)]

    return record(make(numbers, x.shape, x.dtype), "ScatterBackward0", [x, source], send_back)


def take(input: Tensor, index: Tensor) -> Tensor:
    return input.reshape(-1)[index]


def fliplr(input: Tensor) -> Tensor:
    return flip(input, 1)


def flipud(input: Tensor) -> Tensor:
    return flip(input, 0)


def index_fill(input: Tensor, dim: int, index: Tensor, value: Any) -> Tensor:
    if index.ndim > 1:
        raise RuntimeError("Index has to be a vector/scalar")
    result = input.clone()
    result[(slice(None),) * axis_of(dim, input.ndim) + (index,)] = value
    return result


def index_copy(input: Tensor, dim: int, index: Tensor, source: Tensor) -> Tensor:
    return index_fill(input, dim, index, source)


def hstack(tensors: Sequence[Tensor]) -> Tensor:
    tensors = [t.reshape(1) if not t.ndim else t for t in tensors]
    return cat(tensors, 0 if tensors[0].ndim == 1 else 1)


def vstack(tensors: Sequence[Tensor]) -> Tensor:
    return cat([t.reshape(1, -1) if t.ndim < 2 else t for t in tensors], 0)


def meshgrid(*tensors: Any, indexing: str = "ij") -> tuple[Tensor, ...]:
    if indexing != "ij":
        raise Missing(f"torch.meshgrid with indexing={indexing!r}")
    tensors = tuple(tensors[0]) if len(tensors) == 1 and isinstance(tensors[0], (tuple, list)) else tensors
    shape = [t.numel() for t in tensors]
    return tuple(t.reshape([-1 if i == axis else 1 for i in range(len(shape))]).expand(shape) for axis, t in enumerate(tensors))


def diag(input: Tensor, diagonal: int = 0) -> Tensor:
    if diagonal:
        raise Missing("torch.diag with diagonal=")
    if input.ndim not in (1, 2):
        raise RuntimeError(f"diag(): Supports 1D or 2D tensors. Got {input.ndim}D")
    return input.diagonal().clone() if input.ndim == 2 else diag_embed(input)


def diag_embed(input: Tensor, offset: int = 0, dim1: int = -2, dim2: int = -1) -> Tensor:
    if (dim1, dim2) != (-2, -1):
        raise Missing("torch.diag_embed with dim1= or dim2=")
    size = input.shape[-1] + abs(offset)
    around = [
        make([0] * many, (many,), input.dtype).expand(*input.shape[:-1], many) for many in (max(-offset, 0), max(offset, 0))
    ]
    chosen = make([j - i == offset for i in range(size) for j in range(size)], (size, size), dtypes.bool_)
    return where(chosen, cat([around[0], input, around[1]], -1).unsqueeze(-1), _nothing(input))
