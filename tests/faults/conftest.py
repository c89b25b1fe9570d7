"""The faults share the attacks' toolbox, from wherever pytest is started, and a class of three."""

import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.faults import runs


@pytest.fixture(scope="session")
def submitted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("class") / "submitted"
    for student in runs.CLASS:
        runs.submit(folder, student)
    return folder


@pytest.fixture(scope="session")
def undisturbed(submitted, tmp_path_factory):
    """(the folder of a run that nothing disturbed, how long it took)"""
    out = tmp_path_factory.mktemp("undisturbed") / "grades"
    began = time.monotonic()
    runs.grade(submitted, out)
    assert {student: verdict["score"] for student, verdict in runs.results(out)[0].items()} == runs.CLASS
    return out, time.monotonic() - began
