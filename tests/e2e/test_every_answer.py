"""Every named mistake and every correct variant of a chapter's exercises, handed in and judged by the real command, in the sandbox.

Of chapter 44, or of the one that --only names. Student k hands in the k-th mistake, or the k-th variant, of every exercise at once, so
that few notebooks hold them all. A function comes from the checks' module, a file beside the notebook, as learners do with their own.
"""

import copy
import inspect
import json
import os
import shutil
import subprocess
import sys

import nbformat
import pytest

from autograder import checks
from autograder.authoring.spec import Artefact, Exercise
from autograder.paths import ROOT
from autograder.publishing import release

CHAPTER = os.environ.get("COURSE_ONLY", "ch44")
ALL = checks.exercises(CHAPTER)
EXERCISES = {number: exercise for number, exercise in enumerate(ALL) if isinstance(exercise, Exercise)}
MISTAKES = max((len(exercise.misconceptions) for exercise in EXERCISES.values()), default=0)
VARIANTS = max((len(exercise.variants) for exercise in EXERCISES.values()), default=0)
POINTS = sum(exercise.points for exercise in ALL)
BESIDE = ("autograder/__init__.py", "autograder/authoring/*.py", "autograder/checks/*.py", "solutions/*.py")
BESIDE += (
    "experiments/__init__.py",
    "experiments/atlas/given.py",
    "experiments/atlas/keeping.py",
    "experiments/atlas/records/*.json",
)  # whose rule a mistake is


def filled_in(released, source):
    """The notebook with `source(number, exercise)` in the place of each stub."""
    notebook = copy.deepcopy(released)
    for number, exercise in enumerate(ALL):
        [cell] = (cell for cell in notebook.cells if cell.metadata.get("nbgrader", {}).get("grade_id") == exercise.name)
        cell.source = source(number, exercise)
    return notebook


def taken(number, exercise, which):
    """A cell that takes a function of the checks' module; of what is judged by a file or by training, the reference."""
    if not isinstance(exercise, Exercise):
        return inspect.getsource(exercise.reference)
    return f"from autograder.checks.{CHAPTER} import EXERCISES\n{exercise.name} = {which.format(e=f'EXERCISES[{number}]')}"


@pytest.fixture(scope="module")
def verdicts(tmp_path_factory):
    """All is released, handed in and graded once: the verdict of each student."""
    base = tmp_path_factory.mktemp("answers")
    bundle = release.release(base / "release", [CHAPTER])
    released = nbformat.read(bundle / CHAPTER / f"{CHAPTER}.ipynb", as_version=4)

    def hand_in(student, notebook, patterns=()):
        folder = base / "submitted" / student / CHAPTER
        folder.mkdir(parents=True)
        nbformat.write(notebook, folder / f"{CHAPTER}.ipynb")
        for path in [path for pattern in patterns for path in ROOT.glob(pattern)]:
            (folder / path.relative_to(ROOT)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, folder / path.relative_to(ROOT))
        return folder

    hand_in("blank", released)
    perfect = hand_in("perfect", filled_in(released, lambda number, exercise: inspect.getsource(exercise.reference)))
    for exercise in ALL:
        if isinstance(exercise, Artefact):
            shutil.copy(ROOT / "solutions" / exercise.file, perfect)
    for k in range(MISTAKES):
        which = f"{{e}}.misconceptions[{k} % len({{e}}.misconceptions)].function"
        hand_in(f"mistake-{k}", filled_in(released, lambda number, exercise, w=which: taken(number, exercise, w)), BESIDE)
    for k in range(VARIANTS):
        which = f"[*{{e}}.variants.values()][{k} % len({{e}}.variants)]"
        hand_in(f"variant-{k}", filled_in(released, lambda number, exercise, w=which: taken(number, exercise, w)), BESIDE)
    command = [sys.executable, "-m", "autograder", "grade", str(base / "submitted"), "--out", str(base / "grades"), "--jobs", "2"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=os.environ | {"COLUMNS": "200"})
    assert run.returncode == 0, run.stdout + run.stderr
    found = (base / "grades" / "verdicts").glob(f"*/{CHAPTER}.json")
    return {path.parent.name: json.loads(path.read_text(encoding="utf-8")) for path in found}


def items(verdict):
    return {item["exercise"]: item for item in verdict["items"] if item["state"] != "manual"}


def test_the_reference_gets_full_marks_and_the_stub_none(verdicts):
    perfect, blank = verdicts["perfect"], verdicts["blank"]
    assert (perfect["score"], blank["score"]) == (POINTS, 0.0), items(perfect)
    assert [item["state"] for item in items(perfect).values()] == ["correct"] * len(ALL) and perfect["flags"] == []
    functions = {exercise.name for exercise in EXERCISES.values()}
    assert {item["state"] for name, item in items(blank).items() if name in functions} == {"not_implemented"}


@pytest.mark.parametrize("k", range(MISTAKES))
def test_every_mistake_loses_points_and_is_named(verdicts, k):
    judged = items(verdicts[f"mistake-{k}"])
    for exercise in EXERCISES.values():
        item, mistake = judged[exercise.name], exercise.misconceptions[k % len(exercise.misconceptions)]
        assert item["misconceptions"] == [mistake.name], (exercise.name, item)
        assert item["score"] < item["max_score"] and mistake.message in item["message"], (exercise.name, item)


@pytest.mark.parametrize("k", range(VARIANTS))
def test_every_correct_variant_gets_full_marks(verdicts, k):
    judged = items(verdicts[f"variant-{k}"])
    lost = {
        exercise.name: judged[exercise.name] for exercise in EXERCISES.values() if judged[exercise.name]["state"] != "correct"
    }
    assert not lost
