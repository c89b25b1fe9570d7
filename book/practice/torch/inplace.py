"""Operations that write their result over their first operand: `x.add_(y)`, `x += y`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .autograd import is_recording
from .tensor import ONE_LOCATION, Storage, Tensor, meet_halfway


def in_place(function: Callable, name: str) -> Callable:
    """`function` as a method that changes the tensor."""

    def changed(self: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        self.refuse_if_leaf()
        for one in args:
            if isinstance(one, Tensor) and one.storage.numbers is self.storage.numbers and meet_halfway(self, one):
                raise RuntimeError(ONE_LOCATION)
        original = _as_it_was(self) if is_recording() else self
        result = function(original, *args, **kwargs)
        if result.shape != self.shape:
            raise RuntimeError(f"output with shape {list(self.shape)} doesn't match the broadcast shape {list(result.shape)}")
        if result.dtype.category > self.dtype.category:
            kinds = f"{result.dtype.long_name} can't be cast to the desired output type {self.dtype.long_name}"
            raise RuntimeError(f"result type {kinds}")
        step = result.step
        self.write(result)
        if step is not None:
            step.result_is_written_to(result, self)
            if self.base is None and self.step is not None:
                self.step.name = step.name
        return self

    changed.__name__ = name
    return changed


def _as_it_was(x: Tensor) -> Tensor:
    """A copy of the tensor before the change, with its graph: steps may rely on it."""
    kept = Tensor(Storage(x.flat()), x.shape, x.dtype)
    kept._requires_grad, kept.step = x.requires_grad, x.step
    return kept
