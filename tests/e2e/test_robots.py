"""The whole way: release chapter 44, let robot learners fill it in, grade them with the real command, read exact verdicts.

Every mistake and every variant is handed in by tests/e2e/test_every_answer.py; here are one of each, and those who break things.
Robots that use a misconception or a correct variant bring the checks' module as files beside their notebook and import the function from
there, as a learner imports a helper module.
"""

import copy
import csv
import inspect
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from autograder import checks
from autograder.paths import ROOT
from autograder.publishing import release

EXERCISES = {exercise.name: exercise for exercise in checks.exercises("ch44")}
TIMEOUT = 8  # twice what attacks get, as other tests run beside this one


def graded_as(notebook, name):
    return next(cell for cell in notebook.cells if cell.metadata.get("nbgrader", {}).get("grade_id") == name)


BESIDE = ("autograder/__init__.py", "autograder/authoring/*.py", "autograder/checks/*.py", "solutions/*.py")
BESIDE += (
    "experiments/__init__.py",
    "experiments/atlas/keeping.py",
    "experiments/atlas/records/*.json",
)  # whose rule a mistake is


class Class:
    """A folder of submissions, made from the released notebook."""

    def __init__(self, folder: Path, released: nbformat.NotebookNode) -> None:
        self.folder, self.released = folder, released
        self.solved = copy.deepcopy(released)
        for name, exercise in EXERCISES.items():
            graded_as(self.solved, name).source = inspect.getsource(exercise.reference)

    def hand_in(self, student: str, notebook: nbformat.NotebookNode) -> Path:
        folder = self.folder / student / "ch44"
        folder.mkdir(parents=True)
        nbformat.write(notebook, folder / "ch44.ipynb")
        return folder

    def hand_in_functions(self, student: str, pick) -> None:
        """`pick(index expression)` is the Python expression for an exercise's function, given the exercise's."""
        notebook = copy.deepcopy(self.released)
        for number, name in enumerate(EXERCISES):
            graded_as(
                notebook, name
            ).source = f"from autograder.checks.ch44 import EXERCISES\n{name} = {pick(f'EXERCISES[{number}]')}"
        folder = self.hand_in(student, notebook)
        for path in [path for pattern in BESIDE for path in ROOT.glob(pattern)]:
            (folder / path.relative_to(ROOT)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, folder / path.relative_to(ROOT))


@pytest.fixture(scope="module")
def graded(tmp_path_factory):
    """Everything is released, handed in and graded once; the tests read what came out."""
    base = tmp_path_factory.mktemp("course")
    bundle = release.release(base / "release", ["ch44"])  # tests/autograder/publishing releases all
    robots = Class(base / "submitted", nbformat.read(bundle / "ch44" / "ch44.ipynb", as_version=4))
    robots.hand_in("perfect", robots.solved)
    robots.hand_in("blank", robots.released)
    robots.hand_in_functions("misconception-0", lambda e: f"{e}.misconceptions[0].function")
    robots.hand_in_functions("variant-0", lambda e: f"[*{e}.variants.values()][0]")
    broken = copy.deepcopy(robots.solved)
    graded_as(broken, "lambda_returns").source = "def lambda_returns(advantages, values)\n    return advantages + values"
    robots.hand_in("syntax-error", broken)
    looping = copy.deepcopy(robots.solved)
    graded_as(looping, "lambda_returns").source = "def lambda_returns(advantages, values):\n    while True:\n        pass"
    graded_as(looping, "repaired_targets").source = "def repaired_targets(*args):\n    import os\n    os._exit(0)"
    robots.hand_in("infinite-loop", looping)
    tampered = copy.deepcopy(robots.solved)
    tampered.cells.remove(graded_as(tampered, "test_compute_gae"))
    graded_as(tampered, "test_td_residuals").source = "assert True"
    robots.hand_in("tampered", tampered)
    rewritten = copy.deepcopy(robots.released)
    graded_as(rewritten, "test_compute_gae").source = "3.0"
    graded_as(rewritten, "test_compute_gae").metadata.nbgrader.points = 300
    robots.hand_in("points-rewritten", rewritten)
    (robots.folder / "forgetful" / "ch44").mkdir(parents=True)
    (robots.folder / "lost" / "ch4").mkdir(parents=True)
    out = base / "grades"
    command = [
        sys.executable,
        "-m",
        "autograder",
        "grade",
        str(robots.folder),
        "--out",
        str(out),
        "--jobs",
        "2",
        "--timeout",
        str(TIMEOUT),
    ]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=os.environ | {"COLUMNS": "200"})
    assert run.returncode == 0, run.stdout + run.stderr
    return out


def verdict(graded, student, assignment="ch44"):
    return json.loads((graded / "verdicts" / student / f"{assignment}.json").read_text())


def states(verdict):
    return {item["exercise"]: item["state"] for item in verdict["items"] if item["state"] != "manual"}


def test_the_reference_gets_full_marks_and_the_stub_none(graded):
    perfect, blank = verdict(graded, "perfect"), verdict(graded, "blank")
    assert (perfect["status"], perfect["score"], perfect["max_score"]) == ("graded", 10.0, 10.0)
    assert set(states(perfect).values()) == {"correct"} and perfect["flags"] == []
    assert (blank["status"], blank["score"], blank["max_score"]) == ("graded", 0.0, 10.0)
    assert set(states(blank).values()) == {"not_implemented"}
    assert perfect["manual_score"] is None and perfect["manual_max_score"] > 0


def test_a_syntax_error_costs_its_cell_alone(graded):
    result = verdict(graded, "syntax-error")
    # repaired_targets of the reference calls lambda_returns
    assert states(result) == dict.fromkeys(EXERCISES, "correct") | {"lambda_returns": "error", "repaired_targets": "error"}
    assert "SyntaxError" in next(item["message"] for item in result["items"] if item["exercise"] == "lambda_returns")


def test_a_loop_and_an_exit_cost_their_exercises_alone_and_end_in_time(graded):
    result = verdict(graded, "infinite-loop")
    assert states(result) == dict.fromkeys(EXERCISES, "correct") | {"lambda_returns": "timeout", "repaired_targets": "error"}
    assert result["seconds"] < (len(EXERCISES) + 1) * TIMEOUT + 15


def test_a_check_that_was_deleted_is_put_back_and_said(graded):
    result = verdict(graded, "tampered")
    assert result["status"] == "graded" and result["flags"] == ["repaired: checks were put back (test_compute_gae)"]
    assert result["score"] == 10.0


def test_rewritten_points_and_checks_change_nothing(graded):
    result = verdict(graded, "points-rewritten")
    assert (result["score"], result["max_score"]) == (0.0, 10.0)


def test_missing_and_unknown_submissions_are_the_students_error(graded):
    missing, unknown = verdict(graded, "forgetful"), verdict(graded, "lost", "ch4")
    assert (missing["status"], missing["score"], missing["max_score"]) == ("student_error", 0.0, 10.0)
    assert "no notebook ch44.ipynb" in missing["items"][0]["message"]
    assert (unknown["status"], unknown["max_score"], unknown["flags"]) == ("student_error", 0.0, ["unknown_assignment"])


def rows(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def test_the_gradebook_and_the_tables_say_the_same_as_the_verdicts(graded):
    totals = {row["student_id"]: float(row["raw_score"]) for row in rows(graded / "grades.csv")}
    assert totals["perfect"] == 10.0 and totals["blank"] == 0.0 and totals["variant-0"] == 10.0
    questions = [
        row for row in rows(graded / "questions.csv") if row["student"] == "misconception-0" and row["exercise"] == "compute_gae"
    ]
    assert questions[0]["misconceptions"] == "truncated-treated-as-terminated" and float(questions[0]["score"]) == 0


def test_every_promised_file_is_there(graded):
    for name in ("junit.xml", "canvas.csv", "gradebook.db", "report/perfect/ch44.html", "gradescope/perfect/ch44.json"):
        assert (graded / name).stat().st_size > 0, name
