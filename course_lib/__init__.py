"""What learners import: checks, environments, rollouts, plotting. Holds no answers and imports nothing else of the project."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from course_lib.chapters import earlier
    from course_lib.checks.client import check

__all__ = ["check", "earlier"]


def __getattr__(name: str) -> Any:
    """The two functions, when they are first asked for: they load torch, for seconds in which whoever starts a process can start it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = "course_lib.checks.client" if name == "check" else "course_lib.chapters"
    globals()[name] = getattr(importlib.import_module(module), name)
    return globals()[name]
