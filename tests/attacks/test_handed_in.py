"""Attacks with the file that an exercise asks for, in one class with honest students, graded once by the real command.

`handed_in/NAME/attack.py` says what is tried, and its `make(folder)` writes the submission; `handed_in/NAME/expected.json` holds
what must come of it. The course has two chapters more than the book, of tests/autograder/fixtures/flight.
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

from tests.attacks.handed_in import toolbox
from tests.autograder.fixtures.flight import course

ROOT = Path(__file__).parents[2]
TIMEOUT = 20
HONEST = ("honest-1", "honest-2", "honest-3")
NAMES = sorted(path.parent.name for path in (Path(__file__).parent / "handed_in").glob("*/attack.py"))


def attack(name):
    return importlib.import_module(f"tests.attacks.handed_in.{name}.attack")


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    """(process, output folder, seconds) of the one run."""
    folder = tmp_path_factory.mktemp("handed-in")
    for name in (*HONEST, *NAMES):
        assignment = "ch97" if name == "honest-3" else getattr(attack(name), "ASSIGNMENT", "ch96") if name in NAMES else "ch96"
        target = folder / "submitted" / name / assignment
        target.mkdir(parents=True)
        (toolbox.put if name in HONEST else attack(name).make)(target)
    options = ["--out", str(folder / "out"), "--jobs", "2", "--timeout", str(TIMEOUT)]
    start = time.monotonic()
    process = subprocess.run(
        [sys.executable, course.__file__, "grade", str(folder / "submitted"), *options],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    return process, folder / "out", time.monotonic() - start


def verdict(out, name):
    [path] = (out / "verdicts" / name).glob("*.json")
    return json.loads(path.read_text())


@pytest.mark.parametrize("name", NAMES)
def test_the_attack_ends_as_the_contract_says(outcome, name):
    _, out, _ = outcome
    seen = verdict(out, name)
    expected = json.loads((Path(__file__).parent / "handed_in" / name / "expected.json").read_text())
    states = {item["exercise"]: item["state"] for item in seen["items"]}
    [message] = [item["message"] for item in seen["items"] if item["exercise"] == "train"]
    assert seen["status"] == "graded", seen
    most = expected["score"]["at_most"] if isinstance(expected["score"], dict) else expected["score"]
    assert seen["score"] <= most if isinstance(expected["score"], dict) else seen["score"] == most, seen
    assert {exercise: states[exercise] for exercise in expected["states"]} == expected["states"], seen
    assert expected["message"] in message and len(message.encode()) <= 2048
    assert len(seen["flags"]) == len(expected["flags"]), seen["flags"]
    assert all(flag.startswith(start) for flag, start in zip(seen["flags"], expected["flags"], strict=True)), seen["flags"]


def test_honest_students_are_unaffected_and_earn_the_same_for_the_same_file(outcome):
    _, out, _ = outcome
    seen = [verdict(out, name) for name in HONEST]
    trained = [next(item for item in one["items"] if item["exercise"] == "train") for one in seen]
    assert {one["status"] for one in seen} == {"graded"}
    assert 2 < trained[0]["score"] < 4 and trained[0]["state"] == "partial" and trained[1:] == trained[:-1]
    assert seen[2]["score"] == trained[2]["score"] + 1


def test_the_run_succeeds_and_nothing_that_was_handed_in_has_run(outcome):
    process, out, _ = outcome
    assert process.returncode == 0, process.stderr
    assert len(list(out.glob("verdicts/*/*.json"))) == len(HONEST) + len(NAMES)
    assert not Path("/tmp/evil").exists()


def test_the_teacher_is_told_of_files_that_are_the_same(outcome):
    process, out, _ = outcome
    assert "ch96: the same lander_policy.safetensors was handed in by honest-1, honest-2" in process.stdout
    assert "handed_in: " not in process.stdout  # which no table needs
    assert "handed_in: lander_policy.safetensors sha256 " in (out / "report" / "honest-1" / "ch96.html").read_text()


def test_no_script_reaches_a_page_and_no_formula_a_table(outcome):
    _, out, _ = outcome
    for page in out.glob("report/*/*.html"):
        assert "<script>evil" not in page.read_text()
    with open(out / "questions.csv", newline="") as file:
        assert not any(cell.lstrip()[:1] in tuple("=+-@") for row in csv.reader(file) for cell in row if cell)
