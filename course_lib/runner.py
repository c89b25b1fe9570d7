"""Call a function on one case and write down what it does: values, gradients, dtypes, changes to its inputs, errors.

The same code runs in a learner's notebook, in the grader's sandbox, and (on the reference and the misconceptions) when the
checks are frozen, so that all of them see alike.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from course_lib.cases import Observation


def observe(function: Callable, arguments: Mapping[str, Any], differentiate: Sequence[str] = ()) -> Observation:
    """Call `function` on `arguments` and return what could be seen.

    Args:
      function: the exercise's function.
      arguments: by name, in the order of the signature; arrays become tensors.
      differentiate: names of the arguments that require gradient. They are handed over as non-leaf tensors, as a network's
        outputs would be, and the gradient of Σ_i cos(i) y_i over all output elements y is taken back to them.

    Returns: an Observation; an exception that the function raises is part of it, and is not raised again.
    """
    leaves = {name: _tensor(value) for name, value in arguments.items()}
    for name in differentiate:
        leaves[name].requires_grad_(True)
    given = {name: value.clone() if isinstance(value, torch.Tensor) else value for name, value in leaves.items()}
    before = {name: value.detach().clone() for name, value in given.items() if isinstance(value, torch.Tensor)}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            returned = _call(function, given)
    except Exception as error:
        return Observation(error=type(error).__name__, message=text_of(error), mutated=_changed(given, before))
    kind, tensors = _tensors(returned)
    return Observation(
        kind=kind,
        outputs={key: _array(tensor) for key, tensor in tensors.items()},
        graph=[key for key, tensor in tensors.items() if tensor.requires_grad],
        gradients=_gradients(tensors, {name: leaves[name] for name in differentiate}),
        mutated=_changed(given, before),
    )


def _call(function: Callable, given: dict[str, Any]) -> Any:
    try:
        inspect.signature(function).bind(**given)
    except (TypeError, ValueError):  # renamed parameters are no mistake: go by position
        return function(*given.values())
    return function(**given)


def _tensor(value: Any) -> Any:
    return torch.from_numpy(value.copy()) if isinstance(value, np.ndarray) else value


def _array(tensor: torch.Tensor) -> np.ndarray:
    tensor = tensor.detach().cpu()
    return tensor.float().numpy() if tensor.dtype in (torch.bfloat16, torch.float16) else tensor.numpy().copy()


def _tensors(returned: Any) -> tuple[str, dict[str, torch.Tensor]]:
    if isinstance(returned, torch.Tensor):
        return "tensor", {"": returned}
    if isinstance(returned, tuple | list) and all(isinstance(entry, torch.Tensor) for entry in returned):
        return f"tuple of {len(returned)}", {str(position): entry for position, entry in enumerate(returned)}
    if isinstance(returned, dict) and all(isinstance(entry, torch.Tensor) for entry in returned.values()):
        return f"dict of {', '.join(sorted(map(str, returned)))}", {str(key): entry for key, entry in returned.items()}
    return type(returned).__name__, {}


def _gradients(tensors: dict[str, torch.Tensor], leaves: dict[str, torch.Tensor]) -> dict[str, np.ndarray | None]:
    roots = [tensor for tensor in tensors.values() if tensor.requires_grad]
    if not roots or not leaves:
        return dict.fromkeys(leaves)
    weights = [torch.arange(root.numel(), dtype=root.dtype).cos().reshape(root.shape) for root in roots]
    try:
        gradients = torch.autograd.grad(roots, list(leaves.values()), weights, allow_unused=True)
    except RuntimeError:  # a graph that was broken in place: as good as a wrong gradient everywhere
        return {name: np.full(tuple(leaf.shape), np.nan) for name, leaf in leaves.items()}
    return {
        name: None if gradient is None or not gradient.any() else _array(gradient)
        for name, gradient in zip(leaves, gradients, strict=True)
    }


def _changed(given: dict[str, Any], before: dict[str, torch.Tensor]) -> list[str]:
    return [name for name, old in before.items() if not _same(given[name].detach(), old)]


def _same(new: torch.Tensor, old: torch.Tensor) -> bool:
    return new.dtype == old.dtype and new.shape == old.shape and torch.equal(new.nan_to_num(), old.nan_to_num())


def text_of(error: BaseException) -> str:
    """What the exception says, or nothing if it refuses to say it."""
    try:
        return str(error)[:500]
    except BaseException:
        return ""
