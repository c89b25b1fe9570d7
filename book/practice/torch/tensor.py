"""A tensor: numbers in a row, a shape, and strides that say how far apart neighbours along each axis lie. Views share the row."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from . import dtypes
from .autograd import Leaf, Node, accumulate, is_recording
from .missing import Missing, missing
from .printing import shown
from .shapes import Size, axis_of, broadcast_shapes, count, positions, strides_of

ONLY_LEAVES = "you can only change requires_grad flags of leaf variables."
DETACH = (
    " If you want to use a computed variable in a subgraph that doesn't require differentiation use var_no_grad = var.detach()."
)


class Storage:
    """The row of numbers that a tensor and its views share; `version` counts the changes in place."""

    def __init__(self, numbers: list[Any]) -> None:
        self.numbers = numbers
        self.version = 0


class Tensor:
    """See the module. `step` is what made it (autograd.Node), `base` the tensor that it is a view of."""

    __slots__ = (
        "__weakref__",
        "_base_step",
        "_requires_grad",
        "base",
        "dtype",
        "grad",
        "offset",
        "one_of",
        "shape",
        "step",
        "storage",
        "strides",
    )

    def __init__(
        self,
        storage: Storage,
        shape: Sequence[int] = (),
        kind: dtypes.dtype = dtypes.float32,
        strides: Sequence[int] | None = None,
        offset: int = 0,
    ):
        if not isinstance(storage, Storage):  # a learner's torch.Tensor([1.0])
            raise Missing("torch.Tensor as a function")
        self.storage, self.offset, self.dtype = storage, offset, kind
        self.shape = Size(shape)
        self.strides = tuple(strides_of(shape) if strides is None else strides)
        self._requires_grad = False
        self.grad: Tensor | None = None
        self.step: Node | None = None
        self.base: Tensor | None = None
        self._base_step: Node | None = None
        self.one_of = ""  # which of several views, made at once, this is

    if TYPE_CHECKING:  # `names` gives tensors their operators

        def __add__(self, other: Any) -> Tensor: ...
        def __radd__(self, other: Any) -> Tensor: ...
        def __sub__(self, other: Any) -> Tensor: ...
        def __rsub__(self, other: Any) -> Tensor: ...
        def __mul__(self, other: Any) -> Tensor: ...
        def __rmul__(self, other: Any) -> Tensor: ...
        def __truediv__(self, other: Any) -> Tensor: ...
        def __rtruediv__(self, other: Any) -> Tensor: ...
        def __pow__(self, other: Any) -> Tensor: ...
        def __rpow__(self, other: Any) -> Tensor: ...
        def __matmul__(self, other: Any) -> Tensor: ...
        def __rmatmul__(self, other: Any) -> Tensor: ...
        def __and__(self, other: Any) -> Tensor: ...
        def __rand__(self, other: Any) -> Tensor: ...
        def __or__(self, other: Any) -> Tensor: ...
        def __ror__(self, other: Any) -> Tensor: ...
        def __xor__(self, other: Any) -> Tensor: ...
        def __rxor__(self, other: Any) -> Tensor: ...
        def __lt__(self, other: Any) -> Tensor: ...
        def __le__(self, other: Any) -> Tensor: ...
        def __gt__(self, other: Any) -> Tensor: ...
        def __ge__(self, other: Any) -> Tensor: ...
        def __eq__(self, other: Any) -> Tensor: ...  # type: ignore[override]
        def __ne__(self, other: Any) -> Tensor: ...  # type: ignore[override]
        def __neg__(self) -> Tensor: ...
        def __invert__(self) -> Tensor: ...

    def __getattr__(self, name: str) -> Any:
        raise missing("Tensor", name)

    # ---- looking

    @property
    def ndim(self) -> int:
        return len(self.shape)

    dim = lambda self: len(self.shape)  # noqa: E731
    numel = lambda self: count(self.shape)  # noqa: E731
    nelement = numel

    def size(self, dim: int | None = None) -> Any:
        return self.shape if dim is None else self.shape[axis_of(dim, self.ndim)]

    def stride(self, dim: int | None = None) -> Any:
        return self.strides if dim is None else self.strides[axis_of(dim, self.ndim)]

    @property
    def is_leaf(self) -> bool:
        return self.grad_fn is None

    @property
    def grad_fn(self) -> Node | None:
        return self.step if self.step is not None and not isinstance(self.step, Leaf) else None

    @property
    def is_cuda(self) -> bool:
        return False

    @property
    def data(self) -> Tensor:
        """The same numbers, whose changes nobody notices."""
        return Tensor(Storage(self.storage.numbers), self.shape, self.dtype, self.strides, self.offset)

    def is_floating_point(self) -> bool:
        return self.dtype.is_floating_point

    def is_contiguous(self) -> bool:
        return all(
            size == 1 or stride == want
            for size, stride, want in zip(self.shape, self.strides, strides_of(self.shape), strict=True)
        )

    def flat(self) -> list[Any]:
        """The entries in reading order."""
        if self.is_contiguous():
            return self.storage.numbers[self.offset : self.offset + count(self.shape)]
        return list(map(self.storage.numbers.__getitem__, positions(self.shape, self.strides, self.offset)))

    def places(self) -> list[int]:
        """Where the entries lie in the row."""
        return positions(self.shape, self.strides, self.offset)

    def item(self) -> Any:
        if count(self.shape) != 1:
            raise RuntimeError(f"a Tensor with {count(self.shape)} elements cannot be converted to Scalar")
        return self.flat()[0]

    def tolist(self) -> Any:
        nested: list[Any] = self.flat()
        for axis in reversed(range(1, self.ndim)):
            size = self.shape[axis]
            nested = [nested[i * size : (i + 1) * size] for i in range(count(self.shape[:axis]))]
        return nested if self.shape else nested[0]

    def _single(self) -> Any:
        if count(self.shape) != 1:
            raise ValueError("only one element tensors can be converted to Python scalars")
        return self.flat()[0]

    def __float__(self) -> float:
        return float(self._single())

    def __int__(self) -> int:
        return int(self._single())

    def __index__(self) -> int:
        if self.dtype.category == 2 or count(self.shape) != 1:
            raise TypeError("only integer tensors of a single element can be converted to an index")
        return int(self.flat()[0])

    def __bool__(self) -> bool:
        if count(self.shape) > 1:
            raise RuntimeError("Boolean value of Tensor with more than one value is ambiguous")
        if count(self.shape) == 0:
            raise RuntimeError("Boolean value of Tensor with no values is ambiguous")
        return bool(self.flat()[0])

    def __len__(self) -> int:
        if not self.shape:
            raise TypeError("len() of a 0-d tensor")
        return self.shape[0]

    def __iter__(self) -> Iterator[Tensor]:
        if not self.shape:
            raise TypeError("iteration over a 0-d tensor")
        return iter(self.unbind())

    def __contains__(self, value: Any) -> bool:
        return bool((self == value).any())

    __hash__ = object.__hash__

    def __format__(self, spec: str) -> str:
        return format(self.item(), spec) if not self.shape else format(repr(self), spec)

    def __repr__(self) -> str:
        if count(self.shape) > 1000:
            raise Missing("printing of more than 1000 entries")
        body = shown(self.flat(), self.tolist(), self.shape, len("tensor(")) if count(self.shape) else "[]"
        size = f", size={tuple(self.shape)}" if not count(self.shape) and self.ndim > 1 else ""
        kind = "" if self.dtype in (dtypes.float32, dtypes.int64, dtypes.bool_) else f", dtype={self.dtype}"
        grad = f", grad_fn=<{self.grad_fn.name}>" if self.grad_fn else ", requires_grad=True" if self.requires_grad else ""
        return f"tensor({body}{size}{kind}{grad})"

    def numpy(self) -> Any:
        raise Missing("Tensor.numpy")

    # ---- gradients

    @property
    def requires_grad(self) -> bool:
        self.follow_base()
        return self._requires_grad

    @requires_grad.setter
    def requires_grad(self, value: bool) -> None:
        if self.grad_fn is not None:
            raise RuntimeError(ONLY_LEAVES + ("" if value else DETACH))
        if value and not self.dtype.is_floating_point:
            raise RuntimeError("only Tensors of floating point and complex dtype can require gradients")
        self._requires_grad = value

    def requires_grad_(self, requires_grad: bool = True) -> Tensor:
        if requires_grad and not self.dtype.is_floating_point:
            raise RuntimeError("only Tensors of floating point dtype can require gradients")
        if not requires_grad or self.grad_fn is None:
            self.requires_grad = requires_grad
        return self

    def detach(self) -> Tensor:
        """The same numbers, without a graph."""
        return Tensor(self.storage, self.shape, self.dtype, self.strides, self.offset)

    def backward(
        self, gradient: Tensor | None = None, retain_graph: bool | None = None, create_graph: bool = False, inputs: Any = None
    ) -> None:
        """Add to the `grad` of every leaf behind this tensor."""
        if create_graph or inputs is not None:
            raise Missing(f"Tensor.backward with {'create_graph' if create_graph else 'inputs'}=")
        accumulate(self, gradient, retain_graph)

    def follow_base(self) -> None:
        """A view of something that was changed in place since is, by now, a view of what that has become."""
        if self.base is not None:
            self.base.follow_base()
            if self.base.step is not self._base_step:
                self._made_as_view(self.base)

    def _made_as_view(self, base: Tensor) -> None:
        """Record where this view lies in its base: the gradient goes back to those places."""
        self.base, self._base_step = base, base.step
        if base.requires_grad and is_recording():
            places, size = self._places_in(base), count(base.shape)

            def send_back(gradient: Tensor) -> tuple[Tensor]:
                numbers = [0.0] * size
                for place, value in zip(places, gradient.flat(), strict=True):
                    numbers[place] += value
                return (Tensor(Storage(numbers), base.shape, base.dtype),)

            self._requires_grad, self.step = True, Node("ViewBackward0", (base,), send_back)
            self._base_step = base.step

    def _places_in(self, base: Tensor) -> Sequence[int]:
        """The positions of the entries among the base's, in reading order."""
        mine = positions(self.shape, self.strides, self.offset)
        if base.is_contiguous():
            return [place - base.offset for place in mine]
        order = {place: number for number, place in enumerate(positions(base.shape, base.strides, base.offset))}
        return [order[place] for place in mine]

    def as_view(self, shape: Sequence[int], strides: Sequence[int], offset: int) -> Tensor:
        """A tensor of other shape on the same numbers."""
        view = Tensor(self.storage, shape, self.dtype, strides, offset)
        view.one_of = self.one_of
        view._made_as_view(self)
        return view

    # ---- taking parts and writing to them

    def __getitem__(self, index: Any) -> Tensor:
        view, rest = self._basic(index)
        return view if rest is None else view._taken(rest)

    def __setitem__(self, index: Any, value: Any) -> None:
        view, rest = self._basic(index)
        if rest is None:
            view.write(value)
            return
        places, shape = view._picked(rest)
        given, value = value, _tensor_of(value, self.dtype)
        if value.dtype is not self.dtype and (count(value.shape) != 1 or not self.ndim) and isinstance(given, Tensor):
            raise RuntimeError(
                f"Index put requires the source and destination dtypes match, got {self.dtype.long_name} for the destination and"
                f" {value.dtype.long_name} for the source."
            )
        if value.storage.numbers is self.storage.numbers and set(value.places()) & set(self.places()):
            raise RuntimeError(ONE_LOCATION)
        if not _fits(value.shape, shape):
            raise RuntimeError(
                f"shape mismatch: value tensor of shape {list(value.shape)} cannot be broadcast to indexing result of shape {list(shape)}"
            )
        numbers = spread(value, shape)
        view._write_places(places, shape, value, numbers)

    def _basic(self, index: Any) -> tuple[Tensor, list[Any] | None]:
        """The view that the integers, slices and None of an index give; and, for each of its axes, the tensor that picks there or None."""
        entries = list(index) if isinstance(index, tuple) else [index]
        entries = [_as_index(entry) for entry in entries]
        used = sum(
            0 if _is_truth_value(entry) else entry.ndim if _is_mask(entry) else 1
            for entry in entries
            if entry is not None and entry is not Ellipsis
        )
        if used > self.ndim:
            if not self.ndim and not isinstance(index, tuple):
                _no_parts_of_a_number(index)
            raise IndexError(f"too many indices for tensor of dimension {self.ndim}")
        at = next((i for i, entry in enumerate(entries) if entry is Ellipsis), len(entries))
        full = [slice(None)] * (self.ndim - used)
        entries = entries[:at] + full + entries[at + 1 :]
        shape, strides, offset, axis = [], [], self.offset, 0
        picks: list[Any] = []
        for entry in entries:
            if entry is None or _is_truth_value(entry):
                shape.append(1)
                strides.append(0)
                picks.append(None if entry is None else from_nested([0] if entry.item() else [], dtypes.int64))
                continue
            size, stride = self.shape[axis], self.strides[axis]
            if isinstance(entry, slice):
                first, last, by = entry.indices(size)
                if by < 1:
                    raise ValueError("step must be greater than zero")
                shape.append(len(range(first, last, by)))
                strides.append(stride * by)
                picks.append(None)
                offset += first * stride if shape[-1] else 0
            elif isinstance(entry, int):
                if not -size <= entry < size:
                    raise IndexError(f"index {entry} is out of bounds for dimension {axis} with size {size}")
                offset += (entry % size) * stride
            else:
                width = entry.ndim if _is_mask(entry) else 1
                if _is_mask(entry) and entry.shape != self.shape[axis : axis + width]:
                    differs = next(i for i in range(width) if entry.shape[i] != self.shape[axis + i])
                    raise IndexError(
                        f"The shape of the mask {list(entry.shape)} at index {differs} does not match the shape of the indexed tensor"
                        f" {list(self.shape)} at index {axis + differs}"
                    )
                shape += self.shape[axis : axis + width]
                strides += self.strides[axis : axis + width]
                picks += _as_integers(entry) if _is_mask(entry) else [entry]
                axis += width - 1
            axis += 1
        view = self.as_view(shape, strides, offset)
        return view, picks if any(pick is not None for pick in picks) else None

    def _picked(self, picks: list[Any]) -> tuple[list[int], tuple[int, ...]]:
        """Where the entries lie that tensors of integers pick, and the shape that they have together."""
        axes = [axis for axis, pick in enumerate(picks) if pick is not None]
        together = broadcast_shapes(*(picks[axis].shape for axis in axes))
        chosen = []
        for axis in axes:
            size = self.shape[axis]
            for entry in picks[axis].flat():
                if not size:
                    raise IndexError("index is out of bounds for dimension with size 0")
                if not -size <= entry < size and count(self.shape):
                    raise IndexError(f"index {entry} is out of bounds for dimension {axis} with size {size}")
            chosen.append([entry % max(size, 1) for entry in spread(picks[axis], together)])
        first = axes[0] if axes == list(range(axes[0], axes[-1] + 1)) else 0
        others = [axis for axis in range(self.ndim) if axis not in axes]
        before = [axis for axis in others if axis < first]
        after = [axis for axis in others if axis >= first]
        jumps = [
            sum(i * self.strides[axis] for i, axis in zip(tuple_, axes, strict=True)) for tuple_ in zip(*chosen, strict=False)
        ]
        lead = positions([self.shape[axis] for axis in before], [self.strides[axis] for axis in before], self.offset)
        tail = positions([self.shape[axis] for axis in after], [self.strides[axis] for axis in after], 0)
        places = [a + b + c for a in lead for b in jumps for c in tail]
        return places, (*(self.shape[axis] for axis in before), *together, *(self.shape[axis] for axis in after))

    def _taken(self, picks: list[Any]) -> Tensor:
        places, shape = self._picked(picks)
        result = Tensor(Storage([self.storage.numbers[place] for place in places]), shape, self.dtype)
        if self.requires_grad and is_recording():
            order = {place: number for number, place in enumerate(positions(self.shape, self.strides, self.offset))}

            def send_back(gradient: Tensor) -> tuple[Tensor]:
                numbers = [0.0] * count(self.shape)
                for place, value in zip(places, gradient.flat(), strict=True):
                    numbers[order[place]] += value
                return (Tensor(Storage(numbers), self.shape, self.dtype),)

            result._requires_grad, result.step = True, Node("IndexBackward0", (self,), send_back)
        return result

    def write(self, value: Any) -> Tensor:
        """Put these numbers in place of the tensor's own, with their graph."""
        value = _tensor_of(value, self.dtype)
        if value is not self and value.storage.numbers is self.storage.numbers and meet_halfway(self, value):
            raise RuntimeError(ONE_LOCATION)
        if any(size > 1 and not stride for size, stride in zip(self.shape, self.strides, strict=True)):
            raise RuntimeError(
                "unsupported operation: more than one element of the written-to tensor refers to a single memory location. Please"
                " clone() the tensor before performing the operation."
            )
        self._write_places(positions(self.shape, self.strides, self.offset), self.shape, value, spread(value, self.shape))
        return self

    def refuse_if_leaf(self) -> Tensor:
        """What this tensor is a view of in the end; a leaf of the graph can't be changed in place while steps are recorded."""
        owner = self
        while owner.base is not None:
            owner = owner.base
        if is_recording() and self.one_of and self.requires_grad:
            raise RuntimeError(
                f"Output {self.one_of} is a view and is being modified inplace. This view is the output of a function that returns"
                " multiple views. Such functions do not allow the output views to be modified inplace. You should replace the inplace"
                " operation by an out-of-place one."
            )
        if is_recording() and owner.requires_grad and owner.grad_fn is None:
            what = "a leaf Variable that requires grad" if owner is self else "a view of a leaf Variable that requires grad"
            raise RuntimeError(f"{what} is being used in an in-place operation.")
        return owner

    def _write_places(self, places: Sequence[int], shape: Sequence[int], value: Tensor, numbers: list[Any]) -> None:
        """Write to `places` of the row. Whatever the tensor is a view of has a new step from now on, and so have its other views."""
        owner = self.refuse_if_leaf()
        for place, number in zip(places, self.dtype.numbers(numbers), strict=True):
            self.storage.numbers[place] = number
        self.storage.version += 1
        if not is_recording() or not self.dtype.is_floating_point or not (owner.requires_grad or value.requires_grad):
            return
        order = {place: number for number, place in enumerate(positions(owner.shape, owner.strides, owner.offset))}
        written = [order[place] for place in places]

        def send_back(gradient: Tensor) -> tuple[Tensor, Tensor]:
            kept = gradient.flat()
            to_value = Tensor(Storage([kept[place] for place in written]), shape, gradient.dtype)
            for place in written:
                kept[place] = 0.0
            return Tensor(Storage(kept), gradient.shape, gradient.dtype), _as_kind(sum_to(to_value, value.shape), value.dtype)

        owner.step = Node("torch::autograd::CopySlices", (owner, value), send_back)
        owner._requires_grad = True
        if owner is not self:
            self._requires_grad = True
            self.follow_base()


# -------------------------------------------------------------------------------------------------------- shapes that meet


def spread_strides(tensor: Tensor, shape: Sequence[int]) -> tuple[int, ...]:
    """Strides with which a tensor has this larger shape: 0 along the axes that it lacks."""
    lacking = len(shape) - tensor.ndim
    own = [
        0 if size == 1 and want != 1 else stride
        for size, stride, want in zip(tensor.shape, tensor.strides, shape[lacking:], strict=True)
    ]
    return (*[0] * lacking, *own)


def spread(tensor: Tensor, shape: Sequence[int]) -> list[Any]:
    """The entries of a tensor as they fill a larger shape. Raises RuntimeError if they do not fit."""
    if tuple(tensor.shape) == tuple(shape):
        return tensor.flat()
    sizes, strides = list(tensor.shape), list(tensor.strides)
    while len(sizes) > len(shape) and sizes[0] == 1:  # a single row, written to a vector
        sizes, strides = sizes[1:], strides[1:]
    lead = len(shape) - len(sizes)
    if lead < 0:
        raise RuntimeError(
            f"expand(torch.{tensor.dtype.long_name}Tensor{{{sizes}}}, size={list(shape)}): the number of sizes provided ({len(shape)}) must"
            f" be greater or equal to the number of dimensions in the tensor ({len(sizes)})"
        )
    for axis, size in enumerate(sizes):
        want = shape[lead + axis]
        if size not in (1, want):
            raise RuntimeError(
                f"The expanded size of the tensor ({want}) must match the existing size ({size}) at non-singleton dimension"
                f" {lead + axis}.  Target sizes: {list(shape)}.  Tensor sizes: {sizes}"
            )
    whole = Tensor(tensor.storage, sizes, tensor.dtype, strides, tensor.offset)
    return list(map(whole.storage.numbers.__getitem__, positions(shape, spread_strides(whole, shape), whole.offset)))


def sum_to(tensor: Tensor, shape: Sequence[int]) -> Tensor:
    """Undo broadcasting: add up along the axes that were spread."""
    if tuple(tensor.shape) == tuple(shape):
        return tensor
    if tensor.ndim < len(shape):  # a row was written to a vector
        tensor = Tensor(tensor.storage, (*[1] * (len(shape) - tensor.ndim), *tensor.shape), tensor.dtype)
    numbers = [0.0] * count(shape)
    lead = tensor.ndim - len(shape)
    steps = [0] * lead + [0 if size == 1 else stride for size, stride in zip(shape, strides_of(shape), strict=True)]
    for place, value in zip(positions(tensor.shape, steps, 0), tensor.flat(), strict=True):
        numbers[place] += value
    return Tensor(Storage(numbers), shape, tensor.dtype)


# ------------------------------------------------------------------------------------------------------------------- small


ONE_LOCATION = (
    "unsupported operation: some elements of the input tensor and the written-to tensor refer to a single memory location. Please"
    " clone() the tensor before performing the operation."
)


def meet_halfway(a: Tensor, b: Tensor) -> bool:
    """Whether two tensors overlap in the row and are not the same: torch sees it if both lie without gaps."""
    one, other = a.places(), b.places()
    if not one or not other or any(max(p) - min(p) + 1 != len(set(p)) for p in (one, other)):
        return False
    return one != other and max(min(one), min(other)) <= min(max(one), max(other))


def _as_kind(gradient: Tensor, kind: dtypes.dtype) -> Tensor:
    """The gradient in the kind of what it belongs to."""
    return gradient if gradient.dtype is kind else Tensor(Storage(kind.numbers(gradient.flat())), gradient.shape, kind)


def _is_mask(entry: Any) -> bool:
    return isinstance(entry, Tensor) and entry.dtype is dtypes.bool_


def _no_parts_of_a_number(index: Any) -> None:
    if isinstance(index, slice):
        raise IndexError("slice() cannot be applied to a 0-dim tensor.")
    if isinstance(index, int) and index == 0:
        raise IndexError(
            "invalid index of a 0-dim tensor. Use `tensor.item()` in Python or `tensor.item<T>()` in C++ to convert a 0-dim tensor to a"
            " number"
        )
    if isinstance(index, int):
        raise IndexError(f"index {index} is out of bounds for dimension 0 with size 0")


def _fits(shape: Sequence[int], target: Sequence[int]) -> bool:
    """Whether a tensor of one shape can be written to one of the other; leading axes of size 1 may be too many."""
    mine = list(shape)
    while len(mine) > len(target) and mine[0] == 1:
        mine = mine[1:]
    if len(mine) > len(target):
        return False
    return all(size in (1, want) for size, want in zip(mine, target[len(target) - len(mine) :], strict=True))


def _is_truth_value(entry: Any) -> bool:
    return _is_mask(entry) and not entry.shape


def _as_index(entry: Any) -> Any:
    if isinstance(entry, bool):
        return from_nested(entry)
    if entry is None or entry is Ellipsis or isinstance(entry, (int, slice)):
        if isinstance(entry, slice):
            return slice(*(None if part is None else part.__index__() for part in (entry.start, entry.stop, entry.step)))
        return entry
    if isinstance(entry, (list, range)):
        entry = from_nested(list(entry))
    if isinstance(entry, Tensor):
        if entry.dtype.category == 2:
            raise IndexError("tensors used as indices must be long, int, byte or bool tensors")
        return int(entry.item()) if not entry.shape and entry.dtype is not dtypes.bool_ else entry
    raise IndexError(
        "only integers, slices (`:`), ellipsis (`...`), None and long or byte Variables are valid indices"
        f" (got {type(entry).__name__})"
    )


def _as_integers(mask: Tensor) -> list[Tensor]:
    """The places where a mask is True, as one tensor of integers for each of its axes."""
    found = [index for index, kept in zip(itertools.product(*map(range, mask.shape)), mask.flat(), strict=True) if kept]
    return [Tensor(Storage([index[axis] for index in found]), (len(found),), dtypes.int64) for axis in range(mask.ndim)]


def from_nested(value: Any, kind: dtypes.dtype | None = None) -> Tensor:
    """A tensor of nested lists, or of a number."""
    if isinstance(value, Tensor):
        return Tensor(Storage((kind or value.dtype).numbers(value.flat())), value.shape, kind or value.dtype)
    shape: list[int] = []
    level = [value]
    while (level and isinstance(level[0], (list, tuple, range))) or (level and isinstance(level[0], Tensor) and level[0].shape):
        sizes = [len(entry) if hasattr(entry, "__len__") else -1 for entry in level]
        if len(set(sizes)) > 1:
            raise ValueError(
                f"expected sequence of length {sizes[0]} at dim {len(shape)} (got {next(s for s in sizes if s != sizes[0])})"
            )
        shape.append(sizes[0])
        level = [part for entry in level for part in entry]
    kinds = [entry.dtype if isinstance(entry, Tensor) else dtypes.of_number(entry) for entry in level]
    numbers = [entry.item() if isinstance(entry, Tensor) else entry for entry in level]
    if any(isinstance(number, complex) for number in numbers):
        raise Missing("torch.complex64")
    for number in numbers:
        if not isinstance(number, (int, float)):
            if isinstance(number, str):
                raise TypeError("new(): invalid data type 'str'")
            raise RuntimeError(f"Could not infer dtype of {type(number).__name__}")
    kind = kind or max(kinds, key=lambda one: one.rank, default=dtypes.float32)
    return Tensor(Storage(kind.numbers(numbers)), shape, kind)


def _tensor_of(value: Any, kind: dtypes.dtype) -> Tensor:
    return value if isinstance(value, Tensor) else from_nested(value, kind)
