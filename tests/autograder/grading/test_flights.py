"""An exercise that is judged by a file, through all that exercises go through: notebook, bundle, checks, grader, hub."""

import json
import os
import sys
from pathlib import Path

import nbformat
import numpy as np
import pytest

from autograder.authoring import artefacts, assemble, chapter, freeze
from autograder.grading import flights
from autograder.grading.verdicts import Verdict
from autograder.publishing import hub, release
from autograder.reporting import exports
from course_lib import earlier
from course_lib.checks import artefact as frozen
from course_lib.checks import client, command

sys.path.insert(0, str(Path(__file__).parents[1] / "fixtures" / "flight"))
import course

PAGE = chapter.parse(course.HERE / "chapters" / "ch97_flight.md")
SOURCES = course.sources(PAGE)
HIDDEN = artefacts.hidden(course.TRAIN)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory with the frozen checks of chapter 97 and a policy's file."""
    freeze.write(course.EXERCISES["ch97"], tmp_path / "frozen")
    monkeypatch.setattr(client, "FROZEN", tmp_path / "frozen")
    client.visible_cases.cache_clear()
    monkeypatch.chdir(tmp_path)
    (tmp_path / course.FILE).write_bytes(course.policy())
    return tmp_path


def train(path):
    raise NotImplementedError


# ---- points


@pytest.mark.parametrize(
    ("mean", "points", "state"),
    [
        (-401, 0, "wrong"),
        (-400, 0, "wrong"),
        (-399.5, 0, "wrong"),
        (-200, 2, "partial"),
        (-0.01, 3.99, "partial"),
        (0, 4, "correct"),
    ],
)
def test_points_grow_on_a_straight_line_and_are_full_only_where_all_is_reached(mean, points, state):
    finding = frozen.landed(HIDDEN, np.array([mean - 5.0, mean + 5.0]))
    assert (finding.score, finding.state, finding.max_score) == (points, state, 4)


def test_the_message_says_what_was_seen_and_what_it_pays():
    message = frozen.landed(HIDDEN, np.array([-300.0, -200.0, -100.0])).message
    assert message == (
        "Mean return -200.0 over 3 episodes (standard error 57.7; the worst -300, the best -100)."
        " Points grow from 0 at -400 to 4 at 0."
    )


def test_learners_and_grader_fly_other_episodes_and_learners_few():
    shown = artefacts.visible(course.TRAIN)
    assert (len(shown.seeds), len(HIDDEN.seeds)) == (4, 12) and not set(shown.seeds) & set(HIDDEN.seeds)
    assert len(set(HIDDEN.seeds)) == 12 and artefacts.hidden(course.TRAIN) == HIDDEN
    assert all(0 <= seed < 2**31 for seed in HIDDEN.seeds)


# ---- the grader


def judged(folder, timeout=60.0):
    return flights.judge(HIDDEN, folder, timeout)


def test_the_grader_flies_the_file_and_keeps_a_receipt(folder):
    finding, flags = judged(folder)
    assert finding.state == "partial" and 2 < finding.score < 4
    assert flags[0].startswith("handed_in: lander_policy.safetensors sha256 ") and len(flags) == 1
    assert judged(folder) == (finding, flags)


def test_a_file_of_the_courses_own_is_flagged(folder, monkeypatch):
    monkeypatch.setattr(artefacts, "ROOT", folder)
    (folder / "solutions").mkdir()
    artefacts.answer(HIDDEN).write_bytes(course.policy())
    assert judged(folder)[1][1:] == ["the_courses_own_file: lander_policy.safetensors"]


def test_without_a_file_it_says_how_to_write_one(folder):
    (folder / course.FILE).unlink()
    finding, flags = judged(folder)
    assert (finding.state, finding.score, flags) == ("not_implemented", 0, [])
    assert 'course_lib.control.policies.save_policy(policy, "lander_policy.safetensors")' in finding.message


def test_an_unreadable_file_is_refused(folder, monkeypatch):
    def denied(path, limit):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(flights.intake, "read_regular", denied)
    assert "it can't be read (Permission denied)" in judged(folder)[0].message


def test_flights_end_in_time(folder):
    finding, _ = judged(folder, timeout=0.05)
    assert (finding.state, finding.score) == ("timeout", 0) and finding.message == "The flights took more than 0.05 s."


def test_a_program_of_ours_that_fails_is_our_failure(folder, monkeypatch):
    (folder / "flight.py").write_text("import nothing_of_this_name")
    monkeypatch.setattr(flights, "PROGRAM", folder / "flight.py")
    with pytest.raises(flights.FlightFailed, match="No module named 'nothing_of_this_name'"):
        judged(folder)


def test_a_files_points_do_not_depend_on_the_graders_environment(folder, monkeypatch):
    finding, _ = judged(folder)
    for name in ("PYTHONPATH", "PYTHONSTARTUP", "PYTHONHOME"):
        monkeypatch.setenv(name, str(folder))
    (folder / "numpy.py").write_text("raise SystemExit")
    assert judged(folder)[0] == finding


# ---- notebook and bundle


def test_the_notebook_says_what_the_points_are_for_and_has_the_locked_check():
    assemble.verify(PAGE, SOURCES)
    notebook = assemble.for_learners(PAGE, sources=SOURCES)
    text = "\n".join(cell.source for cell in notebook.cells)
    assert "**4 points:** for the file `lander_policy.safetensors`, handed in beside the notebook." in text
    assert "no points up to a mean return of -400, all of them from 0 on" in text
    graded = {cell.metadata.nbgrader.grade_id: cell for cell in notebook.cells if "nbgrader" in cell.metadata}
    assert graded["test_train"].source == "check(train)" and graded["test_train"].metadata.nbgrader.points == 4
    assert "NotImplementedError" in graded["train"].source
    assert "(5 points)" in notebook.cells[0].source
    assert assemble.outline(PAGE, SOURCES).exercises == (("double", 1.0), ("train", 4.0))


def test_the_bundle_has_the_visible_seeds_and_not_the_hidden_ones(tmp_path):
    release.release(tmp_path, ["ch97"], directory=course.HERE / "chapters", sources=course.sources)
    path = tmp_path / "course_lib" / "course_lib" / "frozen" / "train.json"
    assert frozen.load(path) == artefacts.visible(course.TRAIN)
    seeds = [str(seed) for seed in HIDDEN.seeds]
    assert not [
        file for file in tmp_path.rglob("*") if file.is_file() and any(seed.encode() in file.read_bytes() for seed in seeds)
    ]


# ---- the learner's check


def test_the_check_flies_the_file_whatever_the_function_does(folder):
    result = client.check(train)
    assert not result.passed and result.finding.state == "partial"
    assert "Mean return" in repr(result) and "over 4 episodes" in repr(result)
    assert f"That would be {result.finding.score:g} of 4 points. The grader flies other episodes, and more." in repr(result)


def test_the_check_praises_a_policy_that_reaches_all(folder):
    frozen.save(folder / "frozen" / "train.json", frozen.FrozenArtefact("train", course.FILE, "lander", 4.0, -900, -500, [1, 2]))
    result = client.check(train)
    assert result.passed and "✓ Passed: train\n  Mean return" in repr(result) and "That would be 4 of 4" in result._repr_html_()


def test_the_check_says_how_to_write_the_file(folder):
    (folder / course.FILE).unlink()
    text = repr(client.check(train))
    assert text.startswith("✗ Not implemented yet: train\n  There is no file lander_policy.safetensors beside the notebook.")


def test_the_check_refuses_what_the_grader_refuses(folder):
    (folder / course.FILE).write_bytes(course.policy(log_std=np.full(2, np.nan, np.float32)))
    assert "log_std holds numbers that are not finite" in repr(client.check(train))
    (folder / course.FILE).unlink()
    (folder / course.FILE).mkdir()
    assert "it can't be read (Is a directory)" in repr(client.check(train))


def test_the_command_checks_a_notebook_that_does_not_define_the_function(folder, capsys):
    cells = [
        {"cell_type": "code", "source": source, "metadata": {}}
        for source in ("def double(x): return 2 * x", "check(double)", "check(train)")
    ]
    (folder / "ch97.ipynb").write_text(json.dumps({"cells": cells, "nbformat": 4}))
    assert command.main([str(folder / "ch97.ipynb")]) == 1
    said = capsys.readouterr().out
    assert "✓ Passed: double" in said and "✗ Nearly there: train" in said and "1 of 2 pass" in said


def test_a_later_chapter_takes_over_the_function_without_its_file(folder, monkeypatch):
    (folder / course.FILE).unlink()
    cells = [{"cell_type": "code", "source": "def train(path):\n    return 3", "metadata": {}}]
    (folder / "ch97.ipynb").write_text(json.dumps({"cells": cells, "nbformat": 4}))
    monkeypatch.delenv("COURSE_REFERENCES", raising=False)
    assert earlier("train", chapter=97)("x") == 3


# ---- nbgrader, and the teacher


def test_nbgraders_hidden_line_pays_what_the_grader_pays(folder, monkeypatch):
    monkeypatch.setattr(hub.checks, "all_exercises", lambda: list(course.EXERCISES["ch97"]))
    hub._frozen.cache_clear()
    assert hub.score("train", train) == judged(folder)[0].score
    source = assemble.for_nbgrader(PAGE, sources=SOURCES)
    assert 'score("train", train)' in nbformat.writes(source).replace('\\"', '"')


def test_equal_files_are_told_to_the_teacher_for_each_assignment():
    def verdict(student, assignment, *flags):
        return Verdict.of(Verdict(student, assignment, "graded", 0.0, 1.0, flags=flags))

    first, second = "handed_in: p.safetensors sha256 aa", "handed_in: p.safetensors sha256 bb"
    verdicts = [verdict("a", "ch1", first), verdict("b", "ch1", second), verdict("c", "ch1", "ignored_file: handed_in: x", first)]
    verdicts += [verdict("a", "ch2", first), verdict("d", "ch1"), verdict("e", "ch2", second)]
    assert exports.same_files(verdicts) == ["ch1: the same p.safetensors was handed in by a, c"]


def test_the_book_runs_a_chapter_with_the_references_own_file(folder, monkeypatch):
    monkeypatch.setattr(artefacts, "ROOT", folder)
    target = folder / "page"
    target.mkdir()
    with pytest.raises(ValueError, match=r"lander_policy\.safetensors is missing: the file that the reference of train made"):
        artefacts.hand_in(course.EXERCISES["ch97"], target)
    (folder / "solutions").mkdir()
    artefacts.answer(course.TRAIN).write_bytes(course.policy())
    artefacts.hand_in(course.EXERCISES["ch97"], target)
    assert os.listdir(target) == [course.FILE]
