#!/usr/bin/env bash
# nbgrader gives full marks for a share of 0 that NumPy worked out, and none for a right answer whose test warns. With 0.9.6 and NumPy 2 a
# test cell that ends in `10 * np.mean(passed)`, by nbgrader's own rule for partial credit, earns all of its 10 points whatever was handed in.
# A test cell that passes while something says a word on stderr (a deprecated call, a logger, a progress bar) earns 0.
#
# Why: marks are read off the cell's output. Its last value counts if float() can read what is printed, and NumPy 2 prints np.float64(0.0)
# where NumPy 1 printed 0.0; what cannot be read is full marks, and a warning in the log, which the right answers get as well. Anything on
# stderr is taken for an error.
#
# Seen in November 2026, marks out of 10 by `nbgrader autograde` for an answer that is right, one that is half right and one that is wrong:
#   share as a Python float             10  5  0
#   share as a NumPy float              10 10 10
#   the same, printed as by NumPy 1     10  5  0
#   an assertion                        10 10  0   (of one number, which the second answer has right)
#   an assertion, and then a warning     0  0  0
# Fails (exit 1) if that is different.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check nbgrader==0.9.6 numpy==2.4.6 ipykernel==7.4.0 nbclient==0.11.0 \
    nbconvert==7.17.2 nbformat==5.11.1 SQLAlchemy==2.1.9 alembic==1.20.1
mkdir "$folder/course"
cd "$folder/course"
export PATH="$folder/venv/bin:$PATH"
unset PYTHONWARNINGS  # it would keep the test from warning
cat >nbgrader_config.py <<'PYTHON'
get_config().CourseDirectory.course_id = "finding"
PYTHON
cat >sheet.py <<'PYTHON'
import sys
from pathlib import Path

import nbformat
from nbformat.v4 import new_code_cell, new_notebook

SHARE = "[double(x) == 2 * x for x in (1, 2, 3, 4)]"
TESTS = {
    "share as a Python float": f"10 * sum({SHARE}) / 4",
    "share as a NumPy float": f"import numpy as np\n10 * np.mean({SHARE})",
    "the same, printed as by NumPy 1": f"np.set_printoptions(legacy='1.25')\n10 * np.mean({SHARE})",
    "an assertion": "assert double(1) == 2",
    "an assertion, and then a warning": "import warnings\nassert double(1) == 2\nwarnings.warn('slow')",
}
ANSWERS = {"right": "2 * x", "half": "2 * x if x < 3 else 0", "wrong": "0"}


def cell(source, grade_id, **graded):
    facts = dict(schema_version=3, grade_id=grade_id, grade=bool(graded), solution=not graded, locked=bool(graded), task=False)
    return new_code_cell(source, metadata={"nbgrader": facts | graded})


def write(where, notebook):
    Path(where).mkdir(parents=True)
    nbformat.write(notebook, f"{where}/sheet.ipynb")


def source():
    asked = cell("def double(x):\n    ### BEGIN SOLUTION\n    return 2 * x\n    ### END SOLUTION", "double")
    write("source/sheet", new_notebook(cells=[asked] + [cell(test, f"test-{number}", points=10) for number, test in enumerate(TESTS.values())]))


def submitted():
    for student, answer in ANSWERS.items():
        sheet = nbformat.read("release/sheet/sheet.ipynb", 4)
        sheet.cells[0].source = f"def double(x):\n    return {answer}"
        write(f"submitted/{student}/sheet", sheet)


def marks():
    from nbgrader.api import Gradebook

    found = {name: [] for name in TESTS}
    with Gradebook("sqlite:///gradebook.db") as book:
        for student in ANSWERS:
            (notebook,) = book.find_submission("sheet", student).notebooks
            scores = {grade.name: grade.score for grade in notebook.grades}
            for number, name in enumerate(TESTS):
                found[name].append(scores[f"test-{number}"])
    print(f"{'':33s}", *(f"{student:>6s}" for student in ANSWERS))
    for name, row in found.items():
        print(f"{name:33s}", *(f"{mark:6.1f}" for mark in row))
    assert found["share as a Python float"] == found["the same, printed as by NumPy 1"] == [10, 5, 0]
    assert found["share as a NumPy float"] == [10, 10, 10], "this is no longer so"
    assert found["an assertion"] == [10, 10, 0]
    assert found["an assertion, and then a warning"] == [0, 0, 0], "this is no longer so"


{"source": source, "submitted": submitted, "marks": marks}[sys.argv[1]]()
PYTHON
python sheet.py source
nbgrader generate_assignment sheet 2>log || { cat log; exit 1; }
python sheet.py submitted
nbgrader autograde sheet 2>log || { cat log; exit 1; }
grep "Cell output is" log
python sheet.py marks
