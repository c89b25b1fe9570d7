"""Honest notebooks as they are handed in, all in one class, graded once by the real command: none is lost, none is accused."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from autograder.authoring import assemble, chapter
from tests.attacks import toolbox

ROOT = Path(__file__).parents[2]
TIMEOUT = 6
ENDLESS = "while True:\n    pass\n"
SLEEP = f"import time\ntime.sleep({TIMEOUT / 2})\n"


def before(notebook, name, source):
    notebook.cells.insert(notebook.cells.index(toolbox.cell(notebook, name)), nbformat.v4.new_code_cell(source))


def ipython_everywhere(notebook):
    """Each answer in a cell with something that only IPython reads."""
    setup = next(one for one in notebook.cells if one.cell_type == "code")
    setup.source = (
        "%load_ext autoreload\n!pip install -q \\\n    einops\nimport asyncio\nawait asyncio.sleep(0)\nfiles = !ls\n"
        "get_ipython().run_line_magic('matplotlib', 'inline')\nfrom helpers import keep\n" + setup.source
    )
    before(notebook, "td_residuals", "%%writefile mine.py\ndef zero():\n    return 0.0\n")
    before(notebook, "td_residuals", "%run mine.py\n%time OFFSET = zero()\n")
    for name, above in (("td_residuals", "%%time\n"), ("compute_gae", "\n\n%%capture out\n"), ("lambda_returns", "%%timeit\n")):
        toolbox.cell(notebook, name).source = above + toolbox.cell(notebook, name).source
    for name in ("td_residuals", "lambda_returns"):
        cell = toolbox.cell(notebook, name)
        assert ".detach()\n" in cell.source or "~terminated" in cell.source
        cell.source = cell.source.replace(".detach()\n", ".detach()  # or without?\n").replace("~terminated", "keep(terminated)")
    cell = toolbox.cell(notebook, "explained_variance")
    cell.source = "".join(f">>> {line}" if i == 0 else f"... {line}" for i, line in enumerate(cell.source.splitlines(True)))
    toolbox.cell(notebook, "normalize_advantages").source += "\nnormalize_advantages?\n"


def half_the_limit_then_endless(notebook):
    before(notebook, "td_residuals", SLEEP)
    toolbox.last(notebook, ENDLESS)


def two_endless_cells_between(notebook):
    before(notebook, "lambda_returns", ENDLESS)
    before(notebook, "explained_variance", ENDLESS)


def longer_together_than_the_limit(notebook):
    for _ in range(3):
        before(notebook, "lambda_returns", f"import time\ntime.sleep({0.4 * TIMEOUT})\n")


def endless_below_the_answer_in_its_cell(notebook):
    toolbox.cell(notebook, "compute_gae").source += "\n\n" + ENDLESS


def helper_below_an_endless_cell(notebook):
    cell = toolbox.cell(notebook, "lambda_returns")
    cell.source = cell.source.replace("(advantages + values)", "added(advantages, values)")
    assert "added" in cell.source
    toolbox.last(notebook, ENDLESS)
    toolbox.last(notebook, "def added(a, b):\n    return a + b\n")


CASES = {
    make.__name__: (make, flagged)
    for make, flagged in (
        (ipython_everywhere, False),
        (half_the_limit_then_endless, True),
        (two_endless_cells_between, True),
        (longer_together_than_the_limit, True),
        (endless_below_the_answer_in_its_cell, True),
        (helper_below_an_endless_cell, True),
    )
}


@pytest.fixture(scope="module")
def verdicts(tmp_path_factory):
    """Student → verdict of the one run."""
    folder = tmp_path_factory.mktemp("field")
    for name, (make, _) in CASES.items():
        notebook, target = toolbox.solved(), folder / "submitted" / name / "ch44"
        target.mkdir(parents=True)
        make(notebook)
        toolbox.write(target, notebook)
    (folder / "submitted" / "ipython_everywhere" / "ch44" / "helpers.py").write_text("def keep(x):\n    return ~x\n")
    other = folder / "submitted" / "other_chapter" / "ch44"
    other.mkdir(parents=True)
    toolbox.write(other, assemble.for_learners(chapter.load("ch43")))
    options = ["--out", str(folder / "out"), "--jobs", "4", "--timeout", str(TIMEOUT)]
    process = subprocess.run(
        [sys.executable, "-m", "autograder", "grade", str(folder / "submitted"), *options],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stdout + process.stderr
    return {path.parent.name: json.loads(path.read_text()) for path in (folder / "out" / "verdicts").glob("*/*.json")}


@pytest.mark.parametrize("name", CASES)
def test_an_honest_notebook_earns_full_marks(verdicts, name):
    seen = verdicts[name]
    assert (seen["status"], seen["score"]) == ("graded", 10.0), seen
    assert all(flag.endswith("_did_not_finish") for flag in seen["flags"]), seen["flags"]
    assert bool(seen["flags"]) == CASES[name][1]


def test_a_notebook_of_another_chapter_is_named(verdicts):
    seen = verdicts["other_chapter"]
    assert (seen["status"], seen["flags"]) == ("needs_review", ["other_chapter: ch43"])
    assert all("This is chapter 43's notebook" in item["message"] for item in seen["items"] if item["state"] != "manual")
