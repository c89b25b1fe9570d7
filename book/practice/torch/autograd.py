"""Reverse mode: a tensor that was computed remembers the step that made it, and each step knows how to send a gradient back.

`Node` is such a step. `backward` walks from the result to the leaves, each step after all those that used what it made.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from .missing import Missing, missing

_recording = [True]


class Node:
    """A step: what it was made from, and how the gradient of its result becomes gradients of those.

    `send_back` takes the gradient of the result and gives one for each of `sources`, or None. `relies_on` are tensors whose numbers it
    needs: if one has been changed in place meanwhile, the gradient would be wrong, and is refused.
    """

    def __init__(
        self, name: str, sources: Sequence[Any], send_back: Callable[[Any], Sequence[Any]], relies_on: Sequence[Any] = ()
    ) -> None:
        self.name = name
        self.sources = [step_of(source) for source in sources]
        self.send_back = send_back
        self.relies_on = [(tensor, tensor.storage.version) for tensor in relies_on]
        self.is_used_up = False
        self.result: Any = None

    def backward(self, gradient: Any, keep: bool) -> Sequence[Any]:
        """The gradients of the sources. Unless they are to be kept, the numbers that the step relied on are gone afterwards."""
        if self.is_used_up:
            raise RuntimeError(USED_UP)
        for tensor, version in self.relies_on:
            if tensor.storage.version != version:
                raise RuntimeError(_changed(tensor, version, self.name if tensor is self.result else None))
        self.is_used_up = bool(self.relies_on) and not keep
        return self.send_back(gradient)

    def result_is_written_to(self, result: Any, target: Any) -> None:
        """The result now lives in another tensor, over which it was written: that one must not change, then."""
        self.result = target
        self.relies_on = [
            (target, target.storage.version) if one is result else (one, version) for one, version in self.relies_on
        ]

    def __repr__(self) -> str:
        return f"<{self.name} object>"


USED_UP = (
    "Trying to backward through the graph a second time (or directly access saved tensors after they have already been freed). Saved"
    " intermediate values of the graph are freed when you call .backward() or autograd.grad(). Specify retain_graph=True if you need to"
    " backward through the graph a second time or if you need to access saved tensors after calling backward."
)


def _changed(tensor: Any, version: int, name: str | None) -> str:
    name = name or (tensor.grad_fn.name if tensor.grad_fn else "")
    made_by = f", which is output 0 of {name.removesuffix('Backward0')}," if name else ""
    return (
        "one of the variables needed for gradient computation has been modified by an inplace operation:"
        f" [torch.{tensor.dtype.long_name}Tensor {list(tensor.shape)}]{made_by} is at version {tensor.storage.version}; expected version"
        f" {version} instead. Hint: enable anomaly detection to find the operation that failed to compute its gradient, with"
        " torch.autograd.set_detect_anomaly(True, check_nan=False)."
    )


class Leaf(Node):
    """The end of the way back: a tensor that requires gradient and was not computed."""

    def __init__(self, tensor: Any) -> None:
        super().__init__("AccumulateGrad", (), lambda gradient: ())
        self.tensor = tensor


def step_of(tensor: Any) -> Node | None:
    """The step that made a tensor, a Leaf of its own for one that only requires gradient; None if no gradient is asked for."""
    if not tensor.requires_grad:
        return None
    if tensor.step is None:
        tensor.step = Leaf(tensor)
    return tensor.step


def backward(roots: Sequence[Any], gradients: Sequence[Any], keep: bool = False) -> dict[Node, Any]:
    """The gradient that arrives at each step on the way from `roots`, given those of the roots."""
    arrived: dict[Node, Any] = {}

    def add(step: Node | None, gradient: Any) -> None:
        if step is not None and gradient is not None:
            arrived[step] = arrived[step] + gradient if step in arrived else gradient

    with no_grad():  # gradients are made of tensors, too, and need no history of their own
        for root, gradient in zip(roots, gradients, strict=True):
            add(step_of(root), gradient)
        for step in _latest_first([step_of(root) for root in roots]):
            if step in arrived:  # complete: all steps that used this one's result have been visited
                for source, gradient in zip(step.sources, step.backward(arrived[step], keep), strict=True):
                    add(source, gradient)
    return arrived


def _latest_first(roots: Sequence[Node | None]) -> Iterator[Node]:
    """All steps behind `roots`, each before those that it was made from."""
    finished: list[Node] = []  # each step after those that it was made from: read backwards, the order that is asked for
    seen: set[int] = set()
    waiting: list[tuple[Node, bool]] = [(root, False) for root in roots if root is not None]
    while waiting:
        step, sources_done = waiting.pop()
        if sources_done:
            finished.append(step)
        elif id(step) not in seen:
            seen.add(id(step))
            waiting.append((step, True))  # to be finished once its sources, which now come above it on the stack, are
            waiting.extend((source, False) for source in step.sources if source is not None)
    return reversed(finished)


# ----------------------------------------------------------------------------------------------------- what learners call


def accumulate(output: Any, gradient: Any = None, retain_graph: bool | None = None) -> None:
    """`output.backward()`: add to the `grad` of every leaf behind the output."""
    for step, arrived in backward([output], [start(output, gradient)], bool(retain_graph)).items():
        if isinstance(step, Leaf):  # added to what is there, which is why training loops call zero_grad
            step.tensor.grad = arrived.clone() if step.tensor.grad is None else step.tensor.grad + arrived


def grad(
    outputs: Any,
    inputs: Any,
    grad_outputs: Any = None,
    retain_graph: bool | None = None,
    create_graph: bool = False,
    *,
    allow_unused: bool = False,
) -> tuple[Any, ...]:
    """The gradients of `outputs` with regard to `inputs`, as `torch.autograd.grad` gives them."""
    if create_graph:
        raise Missing("torch.autograd.grad with create_graph=")
    outputs = list(outputs) if isinstance(outputs, (tuple, list)) else [outputs]
    inputs = list(inputs) if isinstance(inputs, (tuple, list)) else [inputs]
    weights = list(grad_outputs) if isinstance(grad_outputs, (tuple, list)) else [grad_outputs] * len(outputs)
    if not inputs:
        raise RuntimeError("`inputs` argument to `grad()` cannot be empty.")
    seeds = [start(output, weight, number) for number, (output, weight) in enumerate(zip(outputs, weights, strict=True))]
    if not all(tensor.requires_grad for tensor in inputs):
        raise RuntimeError("One of the differentiated Tensors does not require grad")
    arrived = backward(outputs, seeds, bool(retain_graph))
    found = [arrived.get(step_of(tensor)) for tensor in inputs]  # type: ignore[arg-type]  # all of them have a step
    if not allow_unused and any(gradient is None for gradient in found):
        raise RuntimeError(
            "One of the differentiated Tensors appears to not have been used in the graph. Set allow_unused=True if this is the"
            " desired behavior."
        )
    return tuple(found)


def start(output: Any, weight: Any, number: int = 0) -> Any:
    """The gradient to begin with at an output: 1 for a single number."""
    if not output.requires_grad:
        raise RuntimeError(f"element {number} of tensors does not require grad and does not have a grad_fn")
    if weight is not None:
        if weight.shape != output.shape:
            raise RuntimeError(
                f"Mismatch in shape: grad_output[{number}] has a shape of {weight.shape} and output[{number}] has a shape of"
                f" {output.shape}."
            )
        return weight.detach()
    if output.numel() != 1:
        raise RuntimeError("grad can be implicitly created only for scalar outputs")
    return output.detach().new_ones(output.shape)


def is_recording() -> bool:
    """Whether steps are remembered: not within `no_grad`."""
    return _recording[-1]


class _Switch(contextlib.ContextDecorator):
    """`with no_grad():` or `@no_grad()`."""

    state = False

    def __init__(self, function: Callable | None = None) -> None:
        self._function = function

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if self._function is None:
            return super().__call__(*args, **kwargs)
        with type(self)():  # `@no_grad` without brackets
            return self._function(*args, **kwargs)

    def __get__(self, instance: Any, owner: Any = None) -> Any:
        return functools.partial(self, instance)

    def __enter__(self) -> None:
        _recording.append(self.state)

    def __exit__(self, *exc: object) -> None:
        _recording.pop()


class no_grad(_Switch):
    """Nothing that is computed within remembers how."""


class inference_mode(_Switch):
    """The same, here."""


class enable_grad(_Switch):
    """Within `no_grad`, an exception from it."""

    state = True


class set_grad_enabled(_Switch):
    """One or the other, from now on or within a `with`."""

    def __init__(self, mode: bool) -> None:
        super().__init__()
        self.state = mode
        self._before = _recording[-1]
        _recording[-1] = mode

    def __exit__(self, *exc: object) -> None:
        _recording.pop()
        _recording[-1] = self._before


def __getattr__(name: str) -> Any:
    raise missing("torch.autograd", name)
