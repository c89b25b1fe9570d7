"""One module of checks per chapter, `chNN.py`, each with a tuple `EXERCISES`; found by its name, so adding one needs no change here."""

from __future__ import annotations

import importlib

from autograder.spec import Exercise


def exercises(assignment: str) -> tuple[Exercise, ...]:
    """The exercises of assignment "chNN", in the chapter's order. Raises ModuleNotFoundError if it has none."""
    return importlib.import_module(f"{__name__}.{assignment}").EXERCISES
