"""Honest work as it arrives: other names, archives, folders and cells, in one class, graded once by the real command."""

from __future__ import annotations

import copy
import io
import json
import os
import subprocess
import sys
import unicodedata
import zipfile
from pathlib import Path

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_output

from autograder.authoring import assemble, chapter
from tests.attacks import toolbox

ROOT = Path(__file__).parents[2]


def with_helper():
    """A notebook whose answer imports `helpers`."""
    notebook = toolbox.solved()
    answer = toolbox.cell(notebook, "td_residuals")
    answer.source = "from helpers import keep\n" + answer.source.replace("~terminated", "keep(terminated)")
    assert "keep(terminated)" in answer.source
    return notebook


HELPER = "def keep(x):\n    return ~x\n"


def answers_on_top(folder):
    names = [name for name in map(toolbox.graded, toolbox.solved().cells) if name in toolbox.ARGUMENTS]
    notebook = assemble.for_learners(chapter.load("ch44"))
    source = "\n\n".join(toolbox.cell(toolbox.solved(), name).source for name in names)
    notebook.cells.insert(0, new_code_cell(source.replace("def td_residuals", "@torch.no_grad()\ndef td_residuals")))
    toolbox.write(folder / "ch44", notebook)


def split_merged_and_copied(folder):
    notebook = toolbox.solved()
    answer = toolbox.cell(notebook, "td_residuals")
    upper = copy.deepcopy(answer)
    upper.id, upper.source = "split", "def half(x):\n    return ~x\n"
    answer.source = answer.source.replace("~terminated", "half(terminated)")
    notebook.cells.insert(notebook.cells.index(answer), upper)
    test = toolbox.cell(notebook, "test_lambda_returns")
    toolbox.cell(notebook, "lambda_returns").source += "\n" + test.source
    notebook.cells.remove(test)
    copied = copy.deepcopy(toolbox.cell(notebook, "compute_gae"))
    copied.id, copied.source = "copied", "# a first try\ndef compute_gae(rewards):\n    return rewards\n"
    notebook.cells.insert(3, copied)
    toolbox.write(folder / "ch44", notebook)


def archive_with_a_helper(folder):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("ch44/ch44.ipynb", nbformat.writes(with_helper()))
        archive.writestr("ch44/helpers.py", HELPER)
    (folder / "ch44" / "ch44.zip").write_bytes(buffer.getvalue())


def another_spelling_in_utf_16(folder):
    (folder / "ch44").rename(folder / "CH44 ")
    (folder / "CH44 " / "Copy of ch44.ipynb").write_text(nbformat.writes(with_helper()), encoding="utf-16")
    (folder / "CH44 " / "helpers.py").write_text(HELPER)
    (folder / "CH44 " / ".venv" / "lib").mkdir(parents=True)
    for number in range(200):
        (folder / "CH44 " / ".venv" / "lib" / f"m{number}.py").touch()


def video_and_no_marks(folder):
    notebook = toolbox.solved()
    for cell in notebook.cells:
        cell.metadata = {}
        cell.pop("id")
    notebook.nbformat_minor = 4
    setup = next(cell for cell in notebook.cells if cell.cell_type == "code")
    setup.outputs = [new_output("display_data", {"text/html": "<video src='" + "A" * (21 << 20) + "'>"})]
    toolbox.write(folder / "ch44", notebook)


CASES = {
    make.__name__: (make, flags)
    for make, flags in (
        (answers_on_top, ["repaired: an untouched stub below", "repaired: cells that stood below"]),
        (
            split_merged_and_copied,
            ["repaired: checks were put back (test_lambda_returns)", "repaired: an answer's cell stands more than once"],
        ),
        (archive_with_a_helper, ["found_as: ch44.zip/ch44/ch44.ipynb"]),
        (another_spelling_in_utf_16, ["found_as: CH44 /Copy of ch44.ipynb"]),
        (video_and_no_marks, ["repaired: the cells had lost their metadata"]),
    )
}
DECOMPOSED = unicodedata.normalize("NFD", "zoë")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """(process, student → verdict) of the one run."""
    folder = tmp_path_factory.mktemp("arrivals")
    submitted = folder / "submitted"
    for name, (make, _) in CASES.items():
        (submitted / name / "ch44").mkdir(parents=True)
        make(submitted / name)
    pages = {DECOMPOSED: "<html></html>", "empty": "", "merging": '{"cells": [\n<<<<<<< HEAD\n]}'}
    for student, content in pages.items():
        (submitted / student / "ch44").mkdir(parents=True)
        (submitted / student / "ch44" / "ch44.ipynb").write_text(content)
    (submitted / "shallow").mkdir()
    toolbox.write(submitted / "shallow", toolbox.solved())
    (submitted / "eve.zip").write_bytes(b"PK\x05\x06" + b"\0" * 18)
    (submitted / "__MACOSX" / "eve").mkdir(parents=True)
    process = subprocess.run(
        [sys.executable, "-m", "autograder", "grade", str(submitted), "--out", str(folder / "out"), "--jobs", "2"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    return process, {path.parent.name: json.loads(path.read_text()) for path in (folder / "out" / "verdicts").glob("*/ch44.json")}


@pytest.mark.parametrize("name", CASES)
def test_what_can_be_put_right_earns_full_marks_and_is_said(run, name):
    seen = run[1][name]
    assert (seen["status"], seen["score"]) == ("graded", 10.0), seen
    assert len(seen["flags"]) == len(CASES[name][1])
    assert all(flag.startswith(start) for flag, start in zip(sorted(seen["flags"]), sorted(CASES[name][1]), strict=True)), seen[
        "flags"
    ]


@pytest.mark.parametrize(
    ("student", "says"),
    [("zoë", "is a web page (HTML)"), ("empty", "is empty (0 bytes)"), ("merging", "merge conflict (line 2)")],
)
def test_what_is_no_notebook_says_what_it_is(run, student, says):
    seen = run[1][unicodedata.normalize("NFC", student)]
    assert seen["status"] == "student_error" and says in seen["items"][0]["message"]


def test_what_was_not_understood_is_named_and_the_exit_status_says_so(run):
    process, verdicts = run
    assert process.returncode == 4, process.stdout + process.stderr
    lines = [line for line in process.stderr.splitlines() if "not understood: " in line]
    assert len(lines) == 2 and "eve.zip" in lines[0] and "expected shallow/ch44/ch44.ipynb" in lines[1]
    assert len(verdicts) == len(CASES) + 3
