"""Kept records: they fit the code as it stands, they say what is printed, and a change of what they rest on is noticed."""

import dataclasses
import json
import shutil

import pytest

from autograder import checks
from autograder.authoring import chapter
from autograder.authoring.spec import Artefact, Tuning
from autograder.paths import ROOT
from autograder.proving import kept
from autograder.proving.killmatrix import SEEDS
from autograder.publishing import book


@pytest.fixture(scope="module")
def keys():
    return kept.Keys()


@pytest.mark.parametrize("assignment", checks.assignments())
def test_every_record_fits(assignment, keys):
    if missing := kept.unproved(assignment, keys):
        lines = [f"{name}: {reason}" for name, reason in missing.items()]
        pytest.fail("\n".join([*lines, f"`{kept.remedy(assignment)}`"]), pytrace=False)


@pytest.mark.parametrize("assignment", checks.assignments())
def test_a_record_says_that_everything_was_rejected_named_and_accepted(assignment):
    exercises = {exercise.name: exercise for exercise in checks.exercises(assignment)}
    records = kept.load(assignment)
    assert list(records) == list(exercises)
    for name, record in records.items():
        exercise, rows = exercises[name], record.rows
        if isinstance(exercise, Artefact | Tuning):
            assert rows["agents"] and rows["thresholds"] == list(exercise.thresholds)
            continue
        assert rows["seeds"] == SEEDS
        assert {wrong["name"]: (wrong["rejected"], wrong["named"]) for wrong in rows["misconceptions"]} == {
            mistake.name: (SEEDS, SEEDS) for mistake in exercise.misconceptions
        }
        assert {right["name"]: right["accepted"] for right in rows["variants"]} == dict.fromkeys(exercise.variants, SEEDS)


@pytest.mark.parametrize("page", chapter.all_chapters(), ids=lambda page: page.assignment)
def test_the_book_prints_what_is_recorded(page, keys, capsys):
    recorded = json.loads((kept.FOLDER / f"{page.assignment}.json").read_text(encoding="utf-8"))
    rows = book.kill_rows(page, keys)
    assert [row["exercise"] for row in rows] == list(recorded)
    assert capsys.readouterr().err == ""
    for row in rows:
        assert recorded[row["exercise"]].items() >= {name: value for name, value in row.items() if name != "exercise"}.items()
    printed = book.kill_matrix_page({"Chapter": rows})
    for entry in recorded.values():
        for wrong in entry.get("misconceptions", []):
            assert f"| `{wrong['name']}` | {book._plain(wrong['message'])} | {wrong['rejected']} | {wrong['named']} |" in printed


def test_the_book_says_what_is_not_proved_and_draws_nothing(monkeypatch, tmp_path, capsys):
    page = chapter.load("ch44")
    first, second, *_ = [exercise.name for exercise in checks.exercises("ch44")]
    rows = {"seeds": 1, "misconceptions": [], "variants": []}
    kept.keep("ch44", [kept.Proved(first, "stale", "2026-01-02", rows)], tmp_path)
    monkeypatch.setattr(kept, "FOLDER", tmp_path)
    monkeypatch.setattr("autograder.authoring.freeze.complete", None)
    stale, missing, *_ = book.kill_rows(page)
    assert stale == {
        "exercise": first,
        "unproved": "Not proved since 2026-01-02, after which something that it rests on has changed; `course prove --only ch44`.",
    }
    assert missing == {"exercise": second, "unproved": "Never proved; `course prove --only ch44`."}
    assert f"ch44: {second}: never proved; `course prove --only ch44`\n" in capsys.readouterr().err
    assert missing["unproved"] in book.kill_matrix_page({"Chapter": [stale, missing]})


def test_a_record_is_read_as_it_was_kept_and_takes_the_place_of_its_own_only(tmp_path):
    first, second, *_ = [exercise.name for exercise in checks.exercises("ch44")]
    rows = {"seeds": 50, "misconceptions": [{"name": "größer", "message": "a | b", "rejected": 50, "named": 50}], "variants": []}
    one, two = (kept.Proved(name, "key", "2026-01-02", rows) for name in (first, second))
    kept.keep("ch44", [two], tmp_path)
    kept.keep("ch44", [one], tmp_path)
    again = dataclasses.replace(two, key="other")
    kept.keep("ch44", [again], tmp_path)
    assert kept.load("ch44", tmp_path) == {first: one, second: again}
    assert list(kept.load("ch44", tmp_path)) == [first, second]  # in the chapter's order
    assert [path.name for path in tmp_path.iterdir()] == ["ch44.json"]
    assert kept.load("ch45", tmp_path) == {}


def test_a_record_of_an_exercise_that_has_gone_goes_too(tmp_path):
    kept.keep("ch44", [kept.Proved("withdrawn", "key", "2026-01-02", {})], tmp_path)
    assert kept.load("ch44", tmp_path) == {}


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """The project's code in a folder of its own."""
    folder = tmp_path_factory.mktemp("copy")
    for package in ("autograder", "course_lib", "solutions"):
        shutil.copytree(ROOT / package, folder / package, ignore=lambda _, names: [n for n in names if not is_code(n)])
    for name in ("requirements.txt", "constraints.txt"):
        shutil.copyfile(ROOT / name, folder / name)
    return folder


def is_code(name):
    return name.endswith(".py") or ("." not in name and name not in ("__pycache__", "frozen", "runs", "models", "data", "static"))


COMPUTE_GAE = ("ch44", "compute_gae")
SEQUENCE_LOGPS = ("ch97", "sequence_logps")


BOTH = {COMPUTE_GAE, SEQUENCE_LOGPS}


@pytest.mark.parametrize(
    ("file", "old", "new", "changed"),
    [
        ("solutions/ch44.py", "import torch", "import torch  # a comment", set()),
        ("solutions/ch44.py", "gae_lambda: ", "gae_lambda: the λ, ", set()),
        ("solutions/ch97.py", ".squeeze(-1)", ".squeeze(2)", {SEQUENCE_LOGPS}),
        ("autograder/checks/ch44.py", 'name="compute_gae"', 'last_step_first=False, name="compute_gae"', {COMPUTE_GAE}),
        ("course_lib/checks/diagnosis.py", "SINGLE_ATOL = 1e-4, 1e-5", "SINGLE_ATOL = 1e-4, 1e-6", BOTH),
        ("course_lib/language/lm.py", "import copy", "import copy\nTHING = 1", set()),
        ("constraints.txt", "numpy==", "numpy==9", BOTH),
        ("requirements.txt", "jupytext==", "jupytext==9", set()),
    ],
    ids=["comment", "docstring", "reference", "checks", "comparing", "library", "numpy", "jupytext"],
)
def test_a_key_changes_with_what_the_proof_rests_on_and_with_nothing_else(copy, file, old, new, changed):
    def found():
        keys = kept.Keys(copy)
        by_name = {name: {one.name: one for one in checks.exercises(name)} for name in ("ch44", "ch97")}
        return {target: keys.key(target[0], by_name[target[0]][target[1]]) for target in (COMPUTE_GAE, SEQUENCE_LOGPS)}

    path = copy / file
    text, before = path.read_text(encoding="utf-8"), found()
    try:
        assert old in text
        path.write_text(text.replace(old, new), encoding="utf-8")
        after = found()
    finally:
        path.write_text(text, encoding="utf-8")
    assert {target for target, key in after.items() if key != before[target]} == changed
