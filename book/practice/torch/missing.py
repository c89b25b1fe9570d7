"""What the page does not have, and how it says so: an honest word is better than a wrong number."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Iterable, Mapping
from types import ModuleType
from typing import Any

REAL: dict[str, frozenset[str]] = {}
"""The names that the notebook's torch has, by owner ("torch", "Tensor", …); what is in none of them does not exist anywhere."""

asked_for: list[str] = []
"""What was asked for in vain, in order. A judge looks here: an answer that needs what is missing is not wrong."""

OWNERS = {
    "torch": "torch",
    "Tensor": "torch.Tensor",
    "torch.nn": "torch.nn",
    "torch.nn.functional": "torch.nn.functional",
    "torch.special": "torch.special",
    "torch.linalg": "torch.linalg",
    "torch.autograd": "torch.autograd",
}
"""Whose names are known, and where they are found in the notebook's torch."""


class Missing(AttributeError):
    """Something that the page does not have, though the notebook does."""

    def __init__(self, what: str, where: str = "the page's torch") -> None:
        super().__init__(f"{what} is not in {where}; it is in the notebook")
        asked_for.append(str(self))


def missing(owner: str, name: str) -> AttributeError:
    """The error for `owner.name`: torch's own, if torch has none of that name either."""
    known = REAL.get(owner)
    if (known is not None and name not in known) or name.startswith("__"):
        who = "'Tensor' object" if owner == "Tensor" else f"module '{owner}'"
        return AttributeError(f"{who} has no attribute '{name}'")
    return Missing(f"{owner}.{name}")


def real_names(torch: ModuleType) -> dict[str, list[str]]:
    """What the notebook's torch has, by owner: for whoever builds the page, and has it."""
    found = {}
    for owner, path in OWNERS.items():
        value: Any = torch
        for part in path.split(".")[1:]:
            value = getattr(value, part)
        found[owner] = sorted(name for name in dir(value) if not name.startswith("__"))
    words = {argument.name for schema in torch._C._jit_get_all_schemas() for argument in schema.arguments}
    for name in found["torch.nn.functional"]:
        with contextlib.suppress(TypeError, ValueError):  # what is no function, or written in C++
            words |= set(inspect.signature(getattr(torch.nn.functional, name)).parameters)
    return found | {"keywords": sorted(words)}


def has_keyword(word: str) -> bool:
    """Whether any of torch's functions has an argument of this name, as far as is known."""
    return "keywords" not in REAL or word in REAL["keywords"]


def know(names: Mapping[str, Iterable[str]]) -> None:
    """From now on, say of names that are in none of these what torch says."""
    REAL.update({owner: frozenset(each) for owner, each in names.items()})
