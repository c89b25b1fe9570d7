"""One module of checks per chapter, `chNN.py`, each with a tuple `EXERCISES`; found by its name, so adding one needs no change here."""

from __future__ import annotations

import importlib
import pkgutil

from autograder.authoring.spec import Artefact, Exercise, Tuning


def exercises(assignment: str) -> tuple[Exercise | Artefact | Tuning, ...]:
    """The exercises of assignment "chNN", in the chapter's order. Raises ModuleNotFoundError if it has none."""
    return importlib.import_module(f"{__name__}.{assignment}").EXERCISES


def functions(assignment: str) -> list[Exercise]:
    """Those of them that are judged by calling a function."""
    return [exercise for exercise in exercises(assignment) if isinstance(exercise, Exercise)]


def assignments() -> list[str]:
    """The chapters that have checks, "chNN" each; one need not have a page yet."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def all_exercises() -> list[Exercise | Artefact | Tuning]:
    """The exercises of every chapter."""
    return [exercise for name in assignments() for exercise in exercises(name)]
