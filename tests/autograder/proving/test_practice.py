"""What pages can judge: the records fit, say that no answer is judged differently, and are what the book prints."""

import pytest

from autograder import checks
from autograder.authoring import chapter
from autograder.authoring.spec import Exercise
from autograder.proving import kept, practice
from autograder.publishing.practice_page import practice_page, practice_rows


@pytest.fixture(scope="module")
def keys():
    return practice.Keys()


@pytest.mark.parametrize("assignment", checks.assignments())
def test_every_record_fits(assignment, keys):
    if missing := practice.unproved(assignment, keys):
        lines = [f"{name}: {reason}" for name, reason in missing.items()]
        pytest.fail("\n".join([*lines, f"`{kept.remedy(assignment)}`"]), pytrace=False)


def test_forty_exercises_are_offered_and_no_answer_to_them_is_judged_differently():
    offered = 0
    for assignment in checks.assignments():
        exercises = {one.name: one for one in checks.exercises(assignment)}
        for name, record in kept.load(assignment, practice.FOLDER).items():
            rows, exercise = record.rows, exercises[name]
            assert rows["offered"] is (not rows["reason"])
            if rows["offered"]:
                assert isinstance(exercise, Exercise)
                offered += 1
                assert rows["differ"] == [] and rows["agree"] + len(rows["elsewhere"]) == rows["answers"]
                assert rows["answers"] == 2 + len(exercise.variants) + len(exercise.misconceptions)
                assert set(rows["elsewhere"]) <= set(exercise.variants)
    assert offered >= 40


def test_answers_are_counted_apart():
    result = practice.Agreement("f")
    right = ("correct", [], "")
    practice._count(result, "variant", "same", right, right)
    practice._count(result, "variant", "with NumPy", right, ("error", [], "numpy is not in the page; it is in the notebook"))
    assert (result.answers, result.agree, result.offered) == (2, 1, True)
    assert result.elsewhere == {"with NumPy": "numpy is not in the page; it is in the notebook"}
    practice._count(result, "variant", "other words", right, ("correct", [], "well"))
    assert not result.offered and result.reason == "the page judges differently: other words"
    mistake = practice.Agreement("g")
    practice._count(mistake, "misconception", "m", right, ("error", [], "numpy is not in the page; it is in the notebook"))
    assert not mistake.offered


def test_the_gate_gives_what_is_recorded():
    recorded = kept.load("ch43", practice.FOLDER)["approx_kl"].rows
    (found,), seconds = practice.rows("ch43", ["approx_kl"])
    assert recorded == {
        "answers": found.answers, "agree": found.agree, "elsewhere": found.elsewhere, "differ": found.differ, "reason": found.reason,
        "offered": found.offered,
    }  # fmt: skip
    assert len(seconds) == found.answers


def test_an_answer_that_needs_more_of_the_library_than_a_page_has_is_not_offered(monkeypatch):
    (with_replay,), _ = practice.rows("ch48", ["repaired_transitions"])
    assert with_replay.offered and with_replay.answers
    monkeypatch.setattr(practice, "LIBRARY", tuple(name for name in practice.LIBRARY if not name.startswith("control/")))
    (without,), _ = practice.rows("ch48", ["repaired_transitions"])
    lacking = "course_lib.control.replay.Transitions is not in the page; it is in the notebook"
    assert without.elsewhere["the book's answer, as text"] == lacking and not without.offered


def test_the_book_prints_what_is_recorded(keys, capsys):
    own = chapter.load("ch43")
    page = practice_page({"Chapter": practice_rows(own, keys)})
    assert capsys.readouterr().err == ""
    assert "Of 6 exercises 6 are offered." in page and "| `approx_kl` |" in page
    stale = practice_page({"Chapter": [{"exercise": "f", "unproved": "never proved"}]})
    assert "| `f` | | | | no: never proved |" in stale
