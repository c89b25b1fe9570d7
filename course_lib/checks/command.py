"""Run the visible checks of a notebook from a shell: `python -m course_lib.check NOTEBOOK.ipynb`, `course check NOTEBOOK.ipynb`.

Exit status: 0 all pass, 1 some do not, 2 bad input.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from course_lib.checks import client
from course_lib.checks.cells import all_cells, complaints, outline_of, outlines, unchecked
from course_lib.checks.client import check, check_file, exercise_names, is_judged_by_file
from course_lib.checks.notebook import NotebookError, code_cells, new_namespace, run_cells


def main(arguments: list[str]) -> int:
    """Check every exercise whose check cell is in the notebook."""
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
    sys.path.append(os.getcwd())  # and modules, which shadow nothing, as in the grader
    os.environ.setdefault("MPLBACKEND", "Agg")
    namespace = new_namespace()
    failures = run_cells(cells, namespace)
    for position, failure in failures.items():
        print(f"! code cell {position + 1} stopped: {type(failure).__name__}: {failure}")
    for line in [line for lines in found.values() for line in lines]:
        print(f"! {line}")
    passed = 0
    for name in wanted:
        if is_judged_by_file(name):
            result = check_file(name)
        elif callable(namespace.get(name)):
            result = check(namespace[name])
        else:
            print(f"✗ {name}: the notebook defines no function of this name")
            continue
        print(result)
        passed += result.passed
    print(f"{passed} of {len(wanted)} pass")
    return 0 if passed == len(wanted) else 1
