"""Chapter 44 through nbgrader's own commands, as a teacher on a hub would run them, with the real hidden tests in the kernel."""

import csv
import inspect
import os
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from autograder import checks
from autograder.paths import ROOT
from autograder.publishing import release

REFERENCES = {exercise.name: inspect.getsource(exercise.reference) for exercise in checks.exercises("ch44")}


def grade_id(cell):
    return cell.metadata.get("nbgrader", {}).get("grade_id")


@pytest.fixture(scope="module")
def course(tmp_path_factory):
    """A course folder after generate_assignment, autograde, generate_feedback and export."""
    root = release.write_nbgrader_course(tmp_path_factory.mktemp("hub"))
    nbgrader(root, "generate_assignment", "ch44", "--create", "--force")
    released = nbformat.read(root / "release" / "ch44" / "ch44.ipynb", as_version=4)
    for cell in released.cells:
        if "live" in cell.metadata.get("tags", []):
            cell.source = "pass"  # training and plots carry no points, and take half a minute
    hand_in(root, "blank", released)
    for cell in released.cells:
        cell.source = REFERENCES.get(grade_id(cell), cell.source)
        if cell.cell_type == "markdown" and grade_id(cell):
            cell.source += "\n\nMy answer."
    hand_in(root, "perfect", released)
    for cell in released.cells:
        if grade_id(cell) == "compute_gae":
            cell.source = cell.source.replace("return advantages", "return advantages.float()")
        if grade_id(cell) == "td_residuals":
            cell.source = cell.source.replace("~terminated", "1")
    hand_in(root, "partly", released)
    for command in (["autograde", "ch44", "--create"], ["generate_feedback", "ch44"], ["export"]):
        nbgrader(root, *command)
    return root


def hand_in(root, student, notebook):
    folder = root / "submitted" / student / "ch44"
    folder.mkdir(parents=True)
    nbformat.write(notebook, folder / "ch44.ipynb")


def nbgrader(root, *arguments):
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    run = subprocess.run(
        [sys.executable, "-m", "nbgrader", *arguments], cwd=root, capture_output=True, text=True, env=environment
    )
    assert run.returncode == 0, run.stderr[-3000:]
    return run.stdout + run.stderr


def test_the_reference_gets_full_marks_the_stub_none_and_a_partial_answer_its_share(course):
    with open(course / "grades.csv", newline="") as file:
        raw = {row["student_id"]: float(row["raw_score"]) for row in csv.DictReader(file)}
    # partly: compute_gae loses its dtype (0.2 of 3), and as it calls td_residuals, whose mask is gone, all of its values
    assert raw == {"perfect": 10.0, "blank": 0.0, "partly": pytest.approx(10 - 2 - 3 - 2)}


def test_validate_passes_a_solved_notebook_and_fails_a_blank_one(course):
    submitted = course / "submitted"
    assert "Success" in nbgrader(course, "validate", str(submitted / "perfect" / "ch44" / "ch44.ipynb"))
    assert "failed" in nbgrader(course, "validate", str(submitted / "blank" / "ch44" / "ch44.ipynb"))


def test_feedback_shows_no_solution_and_no_hidden_check(course):
    feedback = (course / "feedback" / "blank" / "ch44" / "ch44.html").read_text()
    assert "torch.where(ended[t], 0, following)" not in feedback
    assert "misconception" not in feedback and "_many_ends" not in feedback
