"""Reverse mode: a tensor that was computed remembers the step that made it, and each step knows how to send a gradient back.

`Node` is such a step. `backward` walks from the result to the leaves, each step after all those that used what it made.
"""

from __future__ import annotations

import contextlib
import functools
from typing import Any, Callable, Iterator, Sequence

_recording = [True]


class Node:
    """A step: what it was made from, and how the gradient of its result becomes gradients of those.

    `send_back` takes the gradient of the result and gives one for each of `sources`, or None. `relies_on` are tensors whose numbers it
    needs: if one has been changed in place meanwhile, the gradient would be wrong, and is refused.
    """

    def __init__(self, name: str, sources: Sequence[Any], send_back: Callable[[Any], Sequence[Any]], relies_on: Sequence[Any] = ()) -> None:
        self.name = name
        self.sources = [step_of(source) for source in sources]
        self.send_back = send_back
        self._versions = [(tensor.storage, tensor.storage.version) for tensor in relies_on]

    def backward(self, gradient: Any) -> Sequence[Any]:
        for storage, version in self._versions:
            if storage.version != version:
                raise RuntimeError(
                    "one of the variables needed for gradient computation has been modified by an inplace operation: it is at version "
                    f"{storage.version}; expected version {version} instead."
                )
        with no_grad():
            return self.send_back(gradient)

    def __repr__(self) -> str:
        return f"<{self.name} object>"


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


def is_recording() -> bool:
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
    pass


class inference_mode(_Switch):
    pass


class enable_grad(_Switch):
    state = True


def backward(roots: Sequence[Any], gradients: Sequence[Any]) -> dict[Node, Any]:
    """The gradient that arrives at each step on the way from `roots`, given those of the roots."""
    arrived: dict[Node, Any] = {}

    def add(step: Node | None, gradient: Any) -> None:
        if step is not None and gradient is not None:
            arrived[step] = arrived[step] + gradient if step in arrived else gradient

    with no_grad():
        for root, gradient in zip(roots, gradients):
            add(step_of(root), gradient)
        for step in _latest_first([step_of(root) for root in roots]):
            if step in arrived:
                for source, gradient in zip(step.sources, step.backward(arrived[step])):
                    add(source, gradient)
    return arrived


def _latest_first(roots: Sequence[Node | None]) -> Iterator[Node]:
    """All steps behind `roots`, each before those that it was made from."""
    finished: list[Node] = []
    seen: set[int] = set()
    waiting: list[tuple[Node, bool]] = [(root, False) for root in roots if root is not None]
    while waiting:
        step, sources_done = waiting.pop()
        if sources_done:
            finished.append(step)
        elif id(step) not in seen:
            seen.add(id(step))
            waiting.append((step, True))
            waiting.extend((source, False) for source in step.sources if source is not None)
    return reversed(finished)


def grad(outputs: Any, inputs: Any, grad_outputs: Any = None, retain_graph: bool | None = None, create_graph: bool = False,
         allow_unused: bool = False) -> tuple[Any, ...]:
    """The gradients of `outputs` with regard to `inputs`, as `torch.autograd.grad` gives them."""
    if create_graph:
        raise NotImplementedError("create_graph is not in the page's torch; it is in the notebook")
    outputs = list(outputs) if isinstance(outputs, (tuple, list)) else [outputs]
    inputs = list(inputs) if isinstance(inputs, (tuple, list)) else [inputs]
    weights = list(grad_outputs) if isinstance(grad_outputs, (tuple, list)) else [grad_outputs] * len(outputs)
    arrived = backward(outputs, [start(output, weight) for output, weight in zip(outputs, weights)])
    found = []
    for tensor in inputs:
        if not tensor.requires_grad:
            raise RuntimeError("One of the differentiated Tensors does not require grad")
        gradient = arrived.get(step_of(tensor))
        if gradient is None and not allow_unused:
            raise RuntimeError(
                "One of the differentiated Tensors appears to not have been used in the graph. Set allow_unused=True if this is the desired behavior."
            )
        found.append(gradient)
    return tuple(found)


def start(output: Any, weight: Any) -> Any:
    """The gradient to begin with at an output: 1 for a single number."""
    if not output.requires_grad:
        raise RuntimeError("element 0 of tensors does not require grad and does not have a grad_fn")
    if weight is not None:
        if weight.shape != output.shape:
            raise RuntimeError(
                f"Mismatch in shape: grad_output[0] has a shape of {weight.shape} and output[0] has a shape of {output.shape}."
            )
        return weight.detach()
    if output.numel() != 1:
        raise RuntimeError("grad can be implicitly created only for scalar outputs")
    return output.detach().new_ones(output.shape)
