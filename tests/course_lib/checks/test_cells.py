"""What a notebook has twice or not at all is said beside its checks, while a learner can still mend it; exit statuses stay."""

import copy
import json
import os
import subprocess
import sys

import pytest

from autograder.authoring import assemble, chapter, freeze
from autograder.authoring.contract import sources
from course_lib.checks import cells, client

PAGE = chapter.load("ch44")
OUTLINE = cells.Outline(
    *(tuple(name for name, _ in group) for group in (assemble.outline(PAGE).exercises, assemble.outline(PAGE).open_questions))
)
RELEASED = json.loads(json.dumps(assemble.for_learners(PAGE)))
QUESTION = OUTLINE.questions[0]


def find(document, name):
    return next(cell for cell in document["cells"] if cell["metadata"].get("nbgrader", {}).get("grade_id") == name)


def place(name, among_code=False):
    """Which of the released notebook's cells has this mark, counted from 1."""
    cells = [cell for cell in RELEASED["cells"] if cell["cell_type"] == "code" or not among_code]
    return cells.index(find(RELEASED, name)) + 1


TD, GAE_CHECK, ASKED = place("td_residuals", True), place("test_compute_gae", True), place(QUESTION)


def edited(edit):
    document = copy.deepcopy(RELEASED)
    edit(document)
    return document


def doubled(name, text=None):
    def edit(document):
        cell = find(document, name)
        copied = copy.deepcopy(cell) | ({"source": text} if text else {})
        document["cells"].insert(document["cells"].index(cell) + 1, copied)

    return edit


def removed(name):
    return lambda document: document["cells"].remove(find(document, name))


def as_text(document):
    cell = find(document, "lambda_returns")
    cell.update(cell_type="markdown", source="def lambda_returns(a):\n    return a\n")


def as_code(document):
    find(document, QUESTION)["cell_type"] = "code"


def without_marks(document):
    for cell in document["cells"]:
        cell["metadata"].pop("nbgrader", None)


def unmarked(document):
    find(document, "test_compute_gae")["metadata"] = {}


CASES = [
    (lambda document: None, "", ""),
    (
        doubled("td_residuals"),
        "td_residuals",
        f"td_residuals stands twice (code cells {TD} and {TD + 1}): the last definition counts.",
    ),
    (
        doubled("test_compute_gae"),
        "compute_gae",
        f"The check of compute_gae stands twice (code cells {GAE_CHECK} and {GAE_CHECK + 1}): the copies are ignored.",
    ),
    (removed("test_compute_gae"), "compute_gae", "The check cell of compute_gae is missing: the grader puts it back."),
    (unmarked, "compute_gae", "The check cell of compute_gae has lost its mark: the grader puts it back."),
    (removed(QUESTION), QUESTION, f"The open question {QUESTION} has no cell with its mark"),
    (
        doubled(QUESTION, "Other."),
        QUESTION,
        f"The open question {QUESTION} stands twice, with different texts (cells {ASKED} and {ASKED + 1})",
    ),
    (doubled(QUESTION), "", ""),
    (as_code, QUESTION, f"The open question {QUESTION} is in a code cell (code cell "),
    (as_text, "lambda_returns", f"lambda_returns is written in a text cell (cell {place('lambda_returns')}), which never runs"),
    (without_marks, OUTLINE.exercises[0], "The cells have lost their marks"),
]


@pytest.mark.parametrize(("edit", "name", "says"), CASES)
def test_each_thing_gets_one_line(edit, name, says):
    found = cells.complaints(edited(edit)["cells"], OUTLINE)
    assert list(found) == ([name] if name else [])
    assert not name or (len(found[name]) == 1 and found[name][0].startswith(says))


def test_the_list_is_small_and_reads_back(tmp_path):
    freeze.write_cells("ch44", assemble.outline(PAGE).exercises, assemble.outline(PAGE).open_questions, tmp_path)
    assert cells.outlines(tmp_path) == {"ch44": OUTLINE} and (tmp_path / "ch44.cells").stat().st_size < 500


def test_a_notebook_belongs_to_the_list_that_most_of_it_is_on():
    known = {"ch43": cells.Outline(("clip",), ("why",)), "ch44": OUTLINE}
    assert cells.outline_of(RELEASED["cells"], known) == OUTLINE
    assert cells.outline_of(edited(without_marks)["cells"], known) == OUTLINE
    assert cells.outline_of([{"cell_type": "code", "source": "a = 1"}], known) is None and cells.outline_of([], {}) is None


@pytest.mark.parametrize(
    "odd", [{}, {"metadata": None}, {"metadata": {"nbgrader": 3}, "source": [1]}, {"source": None, "cell_type": 4}]
)
def test_odd_cells_are_no_exception(odd):
    assert not cells.complaints([*RELEASED["cells"], odd], OUTLINE)


# -------------------------------------------------------------------------------- in the notebook


@pytest.fixture(scope="module")
def frozen(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frozen")
    freeze.write([one for one in sources(PAGE).exercises if one.name in ("lambda_returns", "repaired_targets")], folder)
    freeze.write_cells("ch44", assemble.outline(PAGE).exercises, assemble.outline(PAGE).open_questions, folder)
    return folder


def saved(tmp_path, edit):
    path = tmp_path / "ch44.ipynb"
    path.write_text(json.dumps(edited(edit)), encoding="utf-8")
    return path


def lambda_returns(advantages, values):
    return advantages + values


@pytest.mark.parametrize("editor", ["JPY_SESSION_NAME", "__session__", "__vsc_ipynb_file__"])
def test_the_check_in_the_notebook_says_it_if_the_editor_says_which_file(monkeypatch, tmp_path, frozen, editor):
    monkeypatch.setattr(client, "FROZEN", frozen)
    path = str(saved(tmp_path, doubled("lambda_returns")))
    if editor == "JPY_SESSION_NAME":
        monkeypatch.setenv(editor, path)
    else:
        monkeypatch.setitem(vars(sys.modules["__main__"]), editor, path)
    result = client.check(lambda_returns)
    assert "In the saved file: lambda_returns stands twice" in repr(result) and "stands twice" in result._repr_html_()


@pytest.mark.parametrize("name", [None, "", "missing.ipynb", "\0.ipynb", "/", "x" * 5000 + ".ipynb", "broken"])
def test_without_a_file_it_says_nothing(monkeypatch, tmp_path, frozen, name):
    monkeypatch.setattr(client, "FROZEN", frozen)
    monkeypatch.chdir(tmp_path)
    if name == "broken":
        (tmp_path / "ch44.ipynb").write_text('{"cells": [')
        name = "ch44.ipynb"
    if name is None or "\0" in name:
        monkeypatch.setitem(vars(sys.modules["__main__"]), "__session__", name)
    else:
        monkeypatch.setenv("JPY_SESSION_NAME", name)
    assert client.check(lambda_returns).notes == []


def test_open_questions_are_said_with_the_last_exercise(monkeypatch, tmp_path, frozen):
    monkeypatch.setenv("JPY_SESSION_NAME", str(saved(tmp_path, removed(QUESTION))))
    assert cells.notes("lambda_returns", frozen) == []
    assert QUESTION in cells.notes(OUTLINE.exercises[-1], frozen)[0]


# -------------------------------------------------------------------------------- at the shell


def run(path, frozen):
    code = (
        "import sys, pathlib\nfrom course_lib.checks import client\nfrom course_lib.checks.command import main\n"
        f"client.FROZEN = pathlib.Path({str(frozen)!r})\nsys.exit(main(sys.argv[1:]))"
    )
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8"}
    return subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, env=environment)


def test_the_command_warns_and_asks_for_what_has_lost_its_check(tmp_path, frozen):
    def edit(document):
        doubled(QUESTION, "Other.")(document)
        removed("test_lambda_returns")(document)
        document["cells"] = [cell for cell in document["cells"] if "live" not in cell["metadata"].get("tags", [])]

    done = run(saved(tmp_path, edit), frozen)
    assert f"! The open question {QUESTION} stands twice" in done.stdout and done.returncode == 1
    assert "! The check cell of lambda_returns is missing" in done.stdout
    assert "Not implemented yet: lambda_returns" in done.stdout and "0 of 2 pass" in done.stdout
