"""One attack of each basic kind, behind the stronger wall: graded by the real command in gVisor, each ends as behind bubblewrap's."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.attacks import test_attacks as behind_bubblewrap
from tests.attacks import toolbox
from tests.attacks.test_attacks import graded, student, verdict

TIMEOUT = 15  # a process begins anew for each, behind a slower kernel
HONEST = "honest-1"
NAMES = (
    "environment_of_the_grader",  # secrets
    "files_of_the_host",
    "network",
    "fork_bomb",  # what a machine has
    "kill_everything",
    "exit_in_a_cell",  # its own process
    "patched_comparisons",  # the score
)


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gvisor")
    (folder / "secret.txt").write_text(toolbox.CANARY)
    return graded(folder, (HONEST, *NAMES), TIMEOUT, "--wall", "gvisor")


@pytest.mark.parametrize("name", NAMES)
def test_the_attack_ends_as_the_contract_says(outcome, name):
    _, out, _ = outcome
    seen = verdict(out, student(name))
    expected = json.loads((Path(behind_bubblewrap.__file__).parent / name / "expected.json").read_text())
    most = expected["score"]
    states = {item["exercise"]: item["state"] for item in seen["items"]}
    assert seen["status"] == expected["status"], seen
    assert seen["score"] <= most["at_most"] if isinstance(most, dict) else seen["score"] == most, seen
    correct = {exercise: state == "correct" for exercise, state in expected["states"].items()}  # the rest may end in another way
    assert {exercise: states[exercise] == "correct" for exercise in correct} == correct, seen


def test_an_honest_student_is_unaffected(outcome):
    process, out, _ = outcome
    seen = verdict(out, HONEST)
    assert process.returncode == 0, process.stderr
    assert (seen["status"], seen["score"], seen["flags"]) == ("graded", 10.0, []), seen


def test_no_secret_is_anywhere_in_the_output(outcome):
    process, out, _ = outcome
    autograded = out / "autograded"  # the learners' own cells
    files = [path for path in out.rglob("*") if path.is_file() and not path.is_relative_to(autograded)]
    assert files and [path for path in files if toolbox.CANARY.encode() in path.read_bytes()] == []
    assert toolbox.CANARY not in process.stdout + process.stderr
