"""Call a function on one case and write down what it does: values, gradients, dtypes, changes to its inputs, errors.

The same code runs in a learner's notebook, in the grader's sandbox, and (on the reference and the misconceptions) when the
checks are frozen, so that all of them see alike.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import itertools
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch

from course_lib.checks.cases import Observation
from course_lib.checks.telling import text_of

MAX_ENTRIES = 10_000
"""Of an iterator that never ends, so many entries are taken."""
OWN_DRAWS = 3_141_592_653_589_793
"""Seeds torch's own generator before a function is called, so that what it draws there is the same whenever it is observed. No case
seeds a generator with it: a function that should have drawn from that generator, and did not, is found out.
"""


def observe(
    function: Callable,
    arguments: Mapping[str, Any],
    differentiate: Sequence[str] = (),
    repeat: int = 1,
    returns: Sequence[str] = (),
) -> Observation:
    """Call `function` on `arguments` and return what could be seen. torch's own generator is seeded for it, and put back afterwards.

    Args:
      function: the exercise's function.
      arguments: by name, in the order of the signature; tensors are copied, also within lists and dicts, and what
        course_lib.checks.cases.built describes is made.
      differentiate: names of the arguments that require gradient. They are handed over as non-leaf tensors, as a network's
        outputs would be, and the gradient of Σ_i cos(i) y_i over all output elements y is taken back to them.
      repeat: how often the function is called, with the same objects; what it returns is then a tuple of so many.
      returns: names of arguments whose contents after the calls are looked at in place of what the function returns; of a module, its
        parameters and buffers, of a generator its state.

    Returns: an Observation; an exception that the function raises is part of it, and is not raised again.
    """
    leaves = {name: _given(value) for name, value in arguments.items()}
    for name in differentiate:
        leaves[name].requires_grad_(True)
    given = {name: value.clone() if isinstance(value, torch.Tensor) else value for name, value in leaves.items()}
    guarded = {name: value for name, value in given.items() if name not in returns}
    before = _copies(guarded)
    try:
        with warnings.catch_warnings(), torch.random.fork_rng(devices=[]):
            warnings.simplefilter("ignore")
            torch.default_generator.manual_seed(OWN_DRAWS)
            results = [_taken_apart(_call(function, given)) for _ in range(repeat)]
    except Exception as error:
        return Observation(error=type(error).__name__, message=text_of(error), mutated=_changed(guarded, before))
    if returns:
        results = [_taken_apart(given[name]) for name in returns]
    result = results[0] if len(results) == 1 else tuple(results)
    outputs = dict(_leaves(result))
    return Observation(
        kind=_kind(result),
        outputs={path: _array(leaf) for path, leaf in outputs.items()},
        graph=[path for path, leaf in outputs.items() if isinstance(leaf, torch.Tensor) and leaf.requires_grad],
        gradients=_gradients(outputs, {name: leaves[name] for name in differentiate}),
        mutated=_changed(guarded, before),
    )


def _call(function: Callable, given: dict[str, Any]) -> Any:
    try:
        inspect.signature(function).bind(**given)
    except (TypeError, ValueError):  # renamed parameters are no mistake: go by position
        return function(*given.values())
    return function(**given)


def _given(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return value.clone()
    if isinstance(value, list):
        return [_given(entry) for entry in value]
    if not isinstance(value, dict):
        return value
    if "@built" not in value:
        return {name: _given(entry) for name, entry in value.items()}
    module, _, maker = value["@built"].rpartition(".")
    return getattr(importlib.import_module(f"course_lib.{module}"), maker)(**_given(value["arguments"]))


def _taken_apart(value: Any) -> Any:
    """The value with modules, data classes and iterators made dicts and tuples, and a generator its state."""
    if isinstance(value, torch.nn.Module):
        return dict(value.state_dict())
    if isinstance(value, torch.Generator):
        return value.get_state()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _taken_apart(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(name): _taken_apart(entry) for name, entry in value.items()}
    if isinstance(value, tuple | list | Iterator):
        return tuple(_taken_apart(entry) for entry in itertools.islice(value, MAX_ENTRIES))
    return value


def _kind(value: Any) -> str:
    """What came back, in words: "tensor", "tuple of 2", "dict of a, b", "float"; of its entries, those that are no tensors."""
    if isinstance(value, torch.Tensor):
        return "tensor"
    if isinstance(value, tuple):
        kinds = [_kind(entry) for entry in value]
        return f"tuple of {len(value)}" + (f" ({', '.join(kinds)})" if set(kinds) - {"tensor"} else "")
    if isinstance(value, dict):
        entries = {name: _kind(value[name]) for name in sorted(value)}
        return f"dict of {', '.join(name if kind == 'tensor' else f'{name} ({kind})' for name, kind in entries.items())}"
    return "float" if isinstance(value, float) else type(value).__name__


def _leaves(value: Any, path: str = "") -> list[tuple[str, Any]]:
    """The tensors and numbers in a value that was taken apart, with their paths."""
    if isinstance(value, torch.Tensor | int | float):
        return [(path, value)]
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, tuple) else ()
    return [leaf for name, entry in entries for leaf in _leaves(entry, f"{path}.{name}" if path else str(name))]


def _array(leaf: torch.Tensor | float) -> torch.Tensor:
    """The entries, as they are now; an integer beyond 64 bits becomes a float, the largest if need be."""
    if isinstance(leaf, torch.Tensor):
        if type(leaf) is not torch.Tensor:  # a learner's subclass, whose operations may do anything
            leaf = torch.tensor(leaf.tolist(), dtype=leaf.dtype).reshape(tuple(leaf.shape))
        leaf = leaf.detach().cpu()
        return leaf.float() if leaf.dtype in (torch.bfloat16, torch.float16) else leaf.clone()
    kind = torch.bool if isinstance(leaf, bool) else torch.int64 if isinstance(leaf, int) and abs(leaf) < 2**63 else torch.float64
    return torch.tensor(min(max(leaf, -(2**1023)), 2**1023) if isinstance(leaf, int) else leaf, dtype=kind)


def _gradients(outputs: dict[str, Any], leaves: dict[str, torch.Tensor]) -> dict[str, torch.Tensor | None]:
    roots = [leaf for leaf in outputs.values() if isinstance(leaf, torch.Tensor) and leaf.requires_grad]
    if not roots or not leaves:
        return dict.fromkeys(leaves)
    weights = [torch.arange(root.numel(), dtype=root.dtype).cos().reshape(root.shape) for root in roots]
    try:
        gradients = torch.autograd.grad(roots, list(leaves.values()), weights, allow_unused=True)
    except RuntimeError:  # a graph that was broken in place: as good as a wrong gradient everywhere
        return {name: torch.full_like(leaf.detach(), math.nan) for name, leaf in leaves.items()}
    return {
        name: None if gradient is None or not gradient.any() else _array(gradient)
        for name, gradient in zip(leaves, gradients, strict=True)
    }


def _copies(given: dict[str, Any]) -> dict[str, torch.Tensor]:
    """Copies of the tensors among the arguments, also of those in lists and dicts; of what was built, nothing: it may change."""
    return {path: tensor.detach().clone() for path, tensor in _tensors(given)}


def _tensors(given: dict[str, Any]) -> list[tuple[str, torch.Tensor]]:
    plain = {name: value for name, value in given.items() if isinstance(value, torch.Tensor | dict | list)}
    return [(path, leaf) for path, leaf in _leaves(_taken_apart(plain)) if isinstance(leaf, torch.Tensor)]


def _changed(given: dict[str, Any], before: dict[str, torch.Tensor]) -> list[str]:
    after = dict(_tensors(given))
    changed = [path for path, old in before.items() if path not in after or not _same(after[path].detach(), old)]
    return list(dict.fromkeys(path.partition(".")[0] for path in changed))


def _same(new: torch.Tensor, old: torch.Tensor) -> bool:
    if new.dtype != old.dtype or new.shape != old.shape:
        return False
    return torch.equal(new, old) or torch.equal(new.nan_to_num(), old.nan_to_num())
