"""What grading a folder writes down beside the judge's verdicts: here no submission runs."""

from __future__ import annotations

import csv

import pytest
from nbgrader.api import Gradebook

from autograder import grade
from autograder.authoring import assemble, chapter
from autograder.grading.verdicts import Item, Verdict, read_all

DUE = """\
zone: Europe/London
penalty: {per_day: 0.1, at_most: 0.5}
assignments:
  ch44:
    due: 2026-11-20 12:00
    extensions: {cyd: 2026-11-22 12:00}
"""


@pytest.fixture
def submitted(tmp_path):
    for student, at in (
        ("ada", "2026-11-20 11:00:00"),
        ("bob", "2026-11-21 13:00:00"),
        ("cyd", "2026-11-21 13:00:00"),
        ("dan", ""),
    ):
        folder = tmp_path / "submitted" / student / "ch44"
        folder.mkdir(parents=True)
        if at:
            (folder / "timestamp.txt").write_text(f"{at} UTC")
    return tmp_path / "submitted"


@pytest.fixture
def grades(tmp_path, monkeypatch):
    """Grade with everything right but nothing run; returns the rows of grades.csv by student."""
    outline = assemble.outline(chapter.load("ch44"))
    every = [(cell.exercise, 2.0, "correct") for cell in chapter.load("ch44").exercises]
    every += [(name, points, "manual") for name, points in outline.open_questions]
    items = tuple(Item(name, points if state == "correct" else 0.0, points, state) for name, points, state in every)
    total = sum(item.score for item in items)

    def judge(student, assignment, folder, timeout, trusted=False, wall="bubblewrap"):
        return Verdict(student, assignment, "graded", total, total, items=items), None

    monkeypatch.setattr(grade, "judge_folder", judge)

    def run(submitted, **options):
        grade.grade(submitted, tmp_path / "grades", trusted=True, **options)
        with open(tmp_path / "grades" / "grades.csv", encoding="utf-8-sig", newline="") as file:
            return {row["student_id"]: row for row in csv.DictReader(file)}

    return run


def test_lateness_stands_in_nbgraders_columns(submitted, grades, tmp_path):
    (submitted / ".due.yml").write_text(DUE)
    rows = grades(submitted)
    raw = float(rows["ada"]["raw_score"])
    assert raw > 0 and {row["duedate"] for row in rows.values()} == {"2026-11-20 12:00:00"}
    assert rows["bob"]["timestamp"] == "2026-11-21 13:00:00" and rows["dan"]["timestamp"] == ""
    penalties = {student: float(row["late_submission_penalty"]) for student, row in rows.items()}
    assert penalties == {"ada": 0.0, "bob": pytest.approx(0.2 * raw), "cyd": 0.0, "dan": 0.0}
    assert float(rows["bob"]["score"]) == pytest.approx(0.8 * raw)
    assert [verdict.score for verdict in read_all(tmp_path / "grades" / "verdicts")] == [raw] * 4  # of the work, not of the hour
    with Gradebook(f"sqlite:///{tmp_path}/grades/gradebook.db") as book:
        late = {student: book.find_submission("ch44", student).total_seconds_late for student in ("ada", "bob", "cyd", "dan")}
        grade_id = book.find_submission("ch44", "bob").notebooks[0].grades[0]
        grade_id.manual_score = grade_id.auto_score + 10 if grade_id.auto_score is not None else 10
        book.db.commit()
    assert late == {"ada": 0, "bob": 25 * 3600, "cyd": 0, "dan": 0}
    again = grades(submitted)  # points by hand count for the penalty, too
    assert float(again["bob"]["late_submission_penalty"]) == pytest.approx(0.2 * float(again["bob"]["raw_score"]))
    assert float(again["bob"]["raw_score"]) > raw


def test_another_file_of_due_dates_replaces_what_the_first_said_and_none_leaves_it(submitted, grades, tmp_path):
    other = tmp_path / "other.yml"
    other.write_text(DUE.replace("per_day: 0.1", "per_day: 0.3").replace("cyd", "bob"))
    (submitted / ".due.yml").write_text(DUE)
    grades(submitted)
    rows = grades(submitted, due=other)
    assert float(rows["bob"]["late_submission_penalty"]) == 0 and float(rows["cyd"]["late_submission_penalty"]) > 0
    (submitted / ".due.yml").unlink()
    assert grades(submitted) == rows


def test_without_due_dates_nothing_is_late_and_the_time_is_noted(submitted, grades):
    rows = grades(submitted)
    assert rows["bob"]["timestamp"] == "2026-11-21 13:00:00" and rows["bob"]["duedate"] == ""
    assert {float(row["late_submission_penalty"]) for row in rows.values()} == {0.0}


def test_a_time_that_nobody_understands_is_a_flag_and_a_slip_in_due_dates_stops_the_run(submitted, grades, tmp_path):
    (submitted / "ada" / "ch44" / "timestamp.txt").write_text("yesterday")
    grades(submitted)
    flags = {verdict.student: verdict.flags for verdict in read_all(tmp_path / "grades" / "verdicts")}
    assert len(flags["ada"]) == 1 and flags["ada"][0].startswith("no_time: timestamp.txt says no time") and not flags["bob"]
    (submitted / ".due.yml").write_text("zone: Mars")
    with pytest.raises(grade.GradingError, match="zone: Mars is no time zone"):
        grades(submitted)
