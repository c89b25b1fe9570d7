"""What is wrong with an exercise's checks, told before the reference or anything else of the exercise is called.

Only the inputs of the cases are drawn. Each complaint is one sentence that names the exercise, the case where there is one, and the cure.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from autograder.authoring.spec import Case, Exercise
from course_lib.checks import views
from course_lib.checks.cases import FACETS


def of_criteria(exercise: Exercise) -> Iterator[str]:
    """Points for something that no check looks at."""
    for name in exercise.criteria:
        if name not in FACETS:
            known = f"points are for {', '.join(FACETS)}"
            yield f"{exercise.name}: its criteria pay for {name!r}, which nothing looks at{_or(name, FACETS)}; {known}"


def of_case(exercise: Exercise, case: Case, arguments: Mapping[str, Any]) -> Iterator[str]:
    """Arguments, drawn for a case, that are not those of the reference; and names in the case that stand for nothing."""
    place = f"{exercise.name}, case {case.name!r}"
    parameters = inspect.signature(exercise.reference).parameters
    for name in arguments:
        if name not in parameters and not _takes_any(exercise.reference):
            yield f"{place}: the reference takes no argument {name!r}{_or(name, parameters)}; it takes {', '.join(parameters)}"
    needed = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    for name, parameter in parameters.items():
        if parameter.default is parameter.empty and parameter.kind in needed and name not in arguments:
            yield f"{place}: the argument {name!r} of the reference is missing; its inputs must draw one"
    for option in ("differentiate", "returns"):
        for name in getattr(case, option):
            if name not in arguments:
                yield f"{place}: its {option!r} names {name!r}, which is no argument{_or(name, arguments)}"


def of_view(exercise: Exercise, case: Case) -> Iterator[str]:
    """A view that does not exist. Not part of `of_case`, on which all frozen cases rest: a proof should rest on the views that it uses."""
    if case.view and not hasattr(views, case.view):
        place = f"{exercise.name}, case {case.name!r}"
        yield f"{place}: there is no view {case.view!r}{_or(case.view, vars(views))}; views are functions of course_lib/checks/views.py"


def of_built(exercise: Exercise, case: Case, arguments: Any) -> Iterator[str]:
    """Objects to be built that course_lib has not. Not part of `of_case`, as `of_view` is not."""
    if isinstance(arguments, Mapping):
        if "@built" in arguments:
            module, _, maker = str(arguments["@built"]).rpartition(".")
            try:
                known = hasattr(importlib.import_module(f"course_lib.{module}"), maker)
            except ModuleNotFoundError:
                known = False
            if not known:
                place = f"{exercise.name}, case {case.name!r}"
                yield f"{place}: course_lib has no {arguments['@built']}, which `built` is to make; it takes module.name"
        arguments = list(arguments.values())
    if isinstance(arguments, list):
        for entry in arguments:
            yield from of_built(exercise, case, entry)


def checks_file(exercise: Exercise) -> Path | None:
    """Where an exercise's checks stand, `autograder/checks/chNN.py`, which follows from its reference; None outside the course."""
    package, _, assignment = exercise.reference.__module__.partition(".")
    return Path("autograder", "checks", f"{assignment}.py") if package == "solutions" and assignment else None


def _takes_any(function: Callable) -> bool:
    return any(parameter.kind is parameter.VAR_KEYWORD for parameter in inspect.signature(function).parameters.values())


def _or(name: str, known: Collection[str]) -> str:
    """(did you mean …?), if something that is known looks like it."""
    close = difflib.get_close_matches(name, list(known), 1)
    return f" (did you mean {close[0]}?)" if close else ""
