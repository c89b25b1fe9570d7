"""Run the visible checks of a notebook from a shell: `python -m course_lib.check NOTEBOOK.ipynb`, `course check NOTEBOOK.ipynb`.

Exit status: 0 all pass, 1 some do not, 2 bad input.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from course_lib.checks import client
from course_lib.checks.cells import all_cells, complaints, outline_of, outlines, unchecked
from course_lib.checks.client import check, check_file, exercise_names, is_judged_by_file
from course_lib.checks.diagnosis import Finding
from course_lib.checks.magics import without_debuggers
from course_lib.checks.names import used_by
from course_lib.checks.notebook import (
    NotebookError,
    Stop,
    code_cells,
    is_live,
    names_set_by,
    needed,
    new_namespace,
    run_cells,
    stop,
)
from course_lib.checks.terminal import print_anything


def main(arguments: list[str]) -> int:
    """Check every exercise whose check cell is in the notebook."""
    print_anything()
    if len(arguments) != 1:
        print("usage: python -m course_lib.check NOTEBOOK.ipynb", file=sys.stderr)
        return 2
    path = Path(arguments[0])
    try:
        cells = code_cells(path)
    except NotebookError as error:
        print(error, file=sys.stderr)
        return 2
    outline = outline_of(everything := all_cells(path), outlines(client.FROZEN))
    found = complaints(everything, outline) if outline else {}
    wanted = [name for name in exercise_names() if any(f"check({name})" in cell["source"] for cell in cells)]
    wanted.sort(key=lambda name: next(i for i, cell in enumerate(cells) if f"check({name})" in cell["source"]))
    if outline:  # the grader also asks for those whose check cells are gone
        wanted += [name for name in unchecked(everything, outline) if name in exercise_names()]
    if not wanted:
        print(f"{path}: no cell of this notebook checks an exercise of the course", file=sys.stderr)
        return 2
    os.chdir(path.resolve().parent)  # files beside the notebook are found as Jupyter finds them
    home = os.getcwd()
    sys.path += [home, ""]  # and modules, which shadow nothing, as in the grader
    os.environ.setdefault("MPLBACKEND", "Agg")
    os.environ.setdefault("TORCHDYNAMO_DISABLE", "1")
    without_debuggers()
    namespace = new_namespace()
    failures = run_cells(cells, namespace)
    os.chdir(home)  # from wherever a cell went
    stops = {at + 1: stop(error, cells[at]["source"], namespace, f"cell {at + 1}") for at, error in failures.items()}
    for number, one in stops.items():
        print(f"! {one.said(number)}")
    for line in [line for lines in found.values() for line in lines]:
        print(f"! {line}")
    passed = 0
    for name in wanted:
        if is_judged_by_file(name):
            result = check_file(name)
        elif callable(namespace.get(name)):
            result = check(namespace[name])
            _name_causes(result.finding, used_by(namespace[name], namespace), stops)
        else:
            causes = "".join(f"; {stops[number].said(number)}" for number in needed(stops, name, ()))
            print(f"✗ {name}: the notebook defines no function of this name{causes}")
            continue
        print(result)
        for warning in _will_be_missing(name, cells, namespace):
            print(f"! {warning}")
        passed += result.passed
    print(f"{passed} of {len(wanted)} pass")
    return 0 if passed == len(wanted) else 1


def _name_causes(finding: Finding, uses: Sequence[str], stops: Mapping[int, Stop]) -> None:
    """Put into the message of an answer that raised something which cells stopped before, of those that it needs."""
    if finding.state == "error":
        causes = [stops[number].said(number) for number in needed(stops, finding.exercise, uses, finding.message)]
        finding.message = "; ".join([finding.message.removesuffix("."), *causes])


def _will_be_missing(name: str, cells: Sequence[dict[str, Any]], namespace: dict[str, Any]) -> list[str]:
    """A line for each name that an answer uses and that only a training cell sets, by running."""
    function = namespace.get(name)
    missing = [used for used in used_by(function, namespace) if used not in namespace]
    lines = []
    for used in missing:
        places = [
            str(at + 1) for at, cell in enumerate(cells) if is_live(cell) and used in names_set_by(cell["source"], namespace)
        ]
        if places:
            lines.append(
                f"{name} uses {used}, which is not there when it is graded: only code cell {', '.join(places)} sets it, by a call, and "
                "cells for training and plots don't run then. Set it in a cell of your own."
            )
    return lines
