"""Every promise on the page *What the grader promises* is proved by a test that pytest finds under the name that the page gives it."""

import os
import re
import subprocess
import sys

import pytest

from autograder.paths import ROOT
from autograder.publishing.book import BOOK

PAGE = (BOOK / "threat-model.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| (?!promise|---)(.*?) \| (.*) \|$", PAGE.partition("its proof")[2].partition("\n## ")[0], re.M)
NAMED = [f"tests/{name}" for _, proof in ROWS for name in re.findall(r"`([^`]+)`", proof)]
INVENTED = "tests/autograder/test_cli.py::test_that_nobody_wrote"


@pytest.fixture(scope="module")
def said():
    """What pytest says of the tests that are named and of one that there is not."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-n", "0", "-p", "no:cacheprovider", *NAMED, INVENTED]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "PYTEST_ADDOPTS": ""})
    return done.stdout + done.stderr


def test_every_promise_names_its_proof():
    assert len(ROWS) > 20
    assert [
        promise for promise, proof in ROWS if not re.fullmatch(r"`[\w/.]+::\w+(\[\w+\])?`(, `[\w/.]+::\w+(\[\w+\])?`)*", proof)
    ] == []


def test_every_test_that_is_named_exists(said):
    assert [name.removeprefix(f"{ROOT}/") for name in re.findall(r"(?:not found:|no collectors for) (\S+)", said)] == [
        INVENTED
    ], said[-3000:]
