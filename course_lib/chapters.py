"""Functions that a chapter takes over from an earlier one."""

from __future__ import annotations

import functools
import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path

from course_lib.checks.client import check, is_judged_by_file
from course_lib.checks.notebook import code_cells, new_namespace, run_cells

REFERENCES = "COURSE_REFERENCES"
"""Environment variable with the package whose functions the book's own pages use: page chNN of it."""


def earlier(name: str, chapter: int) -> Callable:
    """The function `name` that you wrote in an earlier chapter, as in `compute_gae = earlier("compute_gae", chapter=44)`.

    It is looked up at the first call: in your notebook of that chapter, `../ch44/ch44.ipynb` beside this one, and checked. The pages of
    the book use the reference solution.

    Args:
      name: of an exercise.
      chapter: the number of its chapter.

    Returns: a function that behaves as yours. Its first call raises LookupError, with what to do, if your notebook is not there or the
      function does not pass its check.
    """

    def found(*args, **kwargs):
        return _function(name, chapter)(*args, **kwargs)

    found.__name__ = name
    return found


@functools.cache
def _function(name: str, chapter: int) -> Callable:
    if package := os.environ.get(REFERENCES):
        return getattr(importlib.import_module(f"{package}.ch{chapter}"), name)
    places = [Path(folder) / f"ch{chapter}.ipynb" for folder in (f"../ch{chapter}", f"ch{chapter}", ".")]
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        raise LookupError(f"{name} comes from your notebook of chapter {chapter}: put it where {places[0]} leads from here")
    cells, running = code_cells(path), sys.modules["__main__"]
    try:
        namespace = new_namespace()
        failures = run_cells(cells, namespace)
    finally:
        sys.modules["__main__"] = running
    if not callable(namespace.get(name)):
        stopped = "; ".join(f"code cell {i + 1} stops: {type(error).__name__}: {error}" for i, error in failures.items())
        raise LookupError(f"{path} defines no function {name}{f' ({stopped})' if stopped else ''}")
    if is_judged_by_file(name):  # its check looks at a file beside that notebook, and says nothing about the function
        return namespace[name]
    result = check(namespace[name])
    if not result.passed:
        raise LookupError(f"{name} in {path} does not pass its check yet; repair it there first:\n{result}")
    return namespace[name]
