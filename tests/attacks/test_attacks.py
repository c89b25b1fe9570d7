"""All attacks, in one class with two honest students, graded once by the real command; then each attack's verdict is looked at.

`NAME/attack.py` says what is tried and why it must fail, and its `make(folder, notebook)` writes the submission, given the perfect
notebook; `NAME/expected.json` holds what the contract demands. `ATTACK=NAME,NAME pytest tests/attacks` runs those alone.
"""

from __future__ import annotations

import csv
import importlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.attacks import toolbox

ROOT = Path(__file__).parents[2]
TIMEOUT, PATIENCE = 4, 30  # seconds
PATIENT = ("memory_hog",)  # must end by its limit, not by the clock, and how fast it meets that is the machine's to say
HONEST = ("honest-1", "honest-2")
NAMES = sorted(path.parent.name for path in Path(__file__).parent.glob("*/attack.py"))
NAMES = [name for name in NAMES if name in os.environ.get("ATTACK", name).split(",")]


def student(name):
    return getattr(importlib.import_module(f"tests.attacks.{name}.attack"), "STUDENT", name)


def graded(folder, names, timeout, *options):
    """(process, output folder, submitted folder) of one run."""
    submitted, out = folder / "submitted", folder / "out"
    for name in names:
        make = toolbox.write if name in HONEST else importlib.import_module(f"tests.attacks.{name}.attack").make
        target = submitted / (name if name in HONEST else student(name)) / "ch44"
        target.mkdir(parents=True)
        make(target, toolbox.solved())
    words = [sys.executable, "-m", "autograder", "grade", str(submitted), "--out", str(out), "--jobs", "2"]
    start = time.monotonic()
    process = subprocess.run(
        [*words, "--timeout", str(timeout), *options],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "GRADER_SECRET": toolbox.CANARY},
        capture_output=True,
        text=True,
    )
    print(f"\n{len(names)} submissions in {time.monotonic() - start:.0f} s\n{process.stdout}{process.stderr}")
    return process, out, submitted


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    """The one run of all attacks but the patient ones."""
    folder = tmp_path_factory.mktemp("attacks")
    (folder / "secret.txt").write_text(toolbox.CANARY)
    process, out, submitted = graded(folder, (*HONEST, *(name for name in NAMES if name not in PATIENT)), TIMEOUT)
    yield process, out, submitted
    subprocess.run(["rm", "-rf", str(submitted)], check=True)  # shutil recurses, and some of the folders have no end


@pytest.fixture(scope="module")
def patient_outcome(tmp_path_factory):
    return graded(tmp_path_factory.mktemp("patient"), PATIENT, PATIENCE)


def verdict(out, name):
    return json.loads((out / "verdicts" / name / "ch44.json").read_text())


@pytest.mark.parametrize("name", NAMES)
def test_the_attack_ends_as_the_contract_says(request, name):
    _, out, _ = request.getfixturevalue("patient_outcome" if name in PATIENT else "outcome")
    seen, expected = verdict(out, student(name)), json.loads((Path(__file__).parent / name / "expected.json").read_text())
    score = expected["score"]
    states = {item["exercise"]: item["state"] for item in seen["items"]}
    assert seen["status"] == expected["status"], seen
    assert seen["score"] <= score["at_most"] if isinstance(score, dict) else seen["score"] == score, seen
    assert {exercise: states[exercise] for exercise in expected["states"]} == expected["states"], seen
    for start in expected["flags"]:
        assert any(flag.startswith(start) for flag in seen["flags"]), seen["flags"]
    if not expected["flags"]:
        assert not seen["flags"]
    assert seen["max_score"] == 10 and seen["seconds"] <= expected["max_seconds"]
    assert all(len(item["message"].encode()) <= 2048 for item in seen["items"])


@pytest.mark.parametrize("name", HONEST)
def test_honest_students_are_unaffected(outcome, name):
    _, out, _ = outcome
    seen = verdict(out, name)
    assert (seen["status"], seen["score"], seen["flags"]) == ("graded", 10.0, []), seen


def test_the_run_succeeds_and_every_folder_has_a_verdict(outcome):
    process, out, submitted = outcome
    assert process.returncode == 0, process.stderr
    verdicts = [json.loads(path.read_text()) for path in out.glob("verdicts/*/*.json")]
    assert len(verdicts) == len(list(submitted.glob("*/*")))
    assert not any(one["status"] == "infra_error" for one in verdicts)


def test_no_secret_is_anywhere_in_the_output(outcome):
    process, out, _ = outcome
    files = [path for path in out.rglob("*") if path.is_file()]
    assert len(files) > 5 * len(HONEST)
    canary = toolbox.CANARY.encode()
    autograded = out / "autograded"  # the learners' own cells, some of which name the canary
    assert [path for path in files if not path.is_relative_to(autograded) and canary in path.read_bytes()] == []
    assert toolbox.CANARY not in process.stdout + process.stderr


def test_nothing_printed_reaches_the_graders_output(outcome):
    process, _, _ = outcome
    assert "canary-printed" not in process.stdout + process.stderr
    assert not any(line.startswith("::") for line in (process.stdout + process.stderr).splitlines())


def test_no_script_reaches_a_page_and_no_formula_a_table(outcome):
    _, out, _ = outcome
    for page in out.glob("report/*/*.html"):
        assert "<script>evil" not in page.read_text()
    for table in out.glob("*.csv"):
        for row in csv.reader(table.open(newline="")):
            assert not any(cell.lstrip()[:1] in tuple("=+-@") for cell in row if not _is_number(cell) and cell), row
    assert not Path("/tmp/evil").exists()


def _is_number(cell):
    try:
        return float(cell) is not None
    except ValueError:
        return False
