"""Stock nbgrader on the course that we lay out for it. The judge behind the hidden tests is a fake of a few lines."""

import csv
import os
import sys
from pathlib import Path

import nbformat
import pytest
from nbgrader.apps import NbGraderAPI
from nbgrader.coursedir import CourseDirectory
from nbgrader.plugins.export import CsvExportPlugin
from nbgrader.validator import Validator
from traitlets.config import Config, PyFileConfigLoader

from autograder.authoring import assemble
from autograder.publishing import release

FAKE_JUDGE = """
def score(name, function):
    points, expected = {"double": (1.0, 0.5), "quadruple": (3.0, 1.0)}[name]
    try:
        return points if function(0.25) == expected else points / 2
    except NotImplementedError:
        return 0.0
"""
WRONG = {"double": "def double(x):\n    return 3 * x", "why_double": "Because."}


def _importable(folder):
    """What the kernels import in place of this project."""
    for name, text in {
        "autograder/publishing/hub.py": FAKE_JUDGE,
        "course_lib/__init__.py": "def check(function): pass",
        "course_lib/validate.py": (release.paths.COURSE_LIB / "validate.py").read_text(encoding="utf-8"),
    }.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def _submit(course, student, notebook, answers=()):
    for cell in notebook.cells:
        name = cell.metadata.get("nbgrader", {}).get("grade_id")
        if name in answers:
            cell.source = answers[name]
    place = course / "submitted" / student / "ch99" / "ch99.ipynb"
    place.parent.mkdir(parents=True)
    nbformat.write(notebook, place)


@pytest.fixture(scope="module")
def course(tiny, tmp_path_factory):
    """The course's folder and nbgrader's interface to it, after generate_assignment."""
    root = tmp_path_factory.mktemp("course")
    outputs = {98: [], 99: tiny.outputs}
    release.write_nbgrader_course(root, recorded=lambda c: outputs[c.number], chapters=tiny.directory, sources=tiny.sources)
    _importable(root / "importable")
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("PYTHONPATH", str(root / "importable"))
        patched.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")  # alembic
        patched.chdir(root)
        config = PyFileConfigLoader("nbgrader_config.py", path=str(root)).load_config()
        config.merge(Config({"CourseDirectory": {"root": str(root)}}))
        api = NbGraderAPI(CourseDirectory(config=config), config=config)
        made = api.generate_assignment("ch99")
        assert made["success"], made["log"]
        yield root, api


def test_nbgraders_release_is_the_student_notebook(course, tiny):
    root, _ = course
    released = nbformat.read(root / "release" / "ch99" / "ch99.ipynb", as_version=4)
    ours = assemble.for_learners(tiny.chapter, tiny.outputs, tiny.sources(tiny.chapter))
    for cell in released.cells:
        cell.metadata.get("nbgrader", {}).pop("checksum", None)
    assert released.cells == ours.cells


def test_the_source_notebook_passes_nbgrader_validate(course):
    root, _ = course
    assert Validator().validate(str(root / "source" / "ch99" / "ch99.ipynb")) == {}


def test_nbgrader_gives_the_reference_full_marks_the_stub_none_and_wrong_work_a_part(course, tiny):
    root, api = course
    sources = tiny.sources(tiny.chapter)
    _submit(root, "reference", nbformat.read(root / "source" / "ch99" / "ch99.ipynb", as_version=4))
    _submit(root, "stub", assemble.for_learners(tiny.chapter, tiny.outputs, sources))
    _submit(root, "wrong", assemble.for_learners(tiny.chapter, tiny.outputs, sources), WRONG)
    for student in ("reference", "stub", "wrong"):
        graded = api.autograde("ch99", student)
        assert graded["success"], graded["log"]
    with api.gradebook as gradebook:
        scores = {name: gradebook.find_submission("ch99", name) for name in ("reference", "stub", "wrong")}
        assert {name: found.score for name, found in scores.items()} == {"reference": 4.0, "stub": 0.0, "wrong": 0.5}
        assert scores["wrong"].needs_manual_grade and not scores["stub"].needs_manual_grade  # an untouched answer is a zero
        assert scores["wrong"].max_score == 6.0
        CsvExportPlugin(to="grades.csv").export(gradebook)
    with open(root / "grades.csv", newline="") as file:
        assert {row["student_id"]: row["score"] for row in csv.DictReader(file)}["reference"] == "4.0"
    assert api.generate_feedback("ch99", "wrong")["success"]
    assert (root / "feedback" / "wrong" / "ch99" / "ch99.html").is_file()
