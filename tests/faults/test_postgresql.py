"""The gradebook in a real PostgreSQL: the grades of SQLite, two graders at once, a server that refuses and one that goes away."""

from __future__ import annotations

import shutil
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from threading import Barrier

import pytest
from nbgrader.api import Gradebook, SubmittedAssignment
from sqlalchemy.exc import SQLAlchemyError

from autograder import grade as grading
from autograder.reporting import database
from autograder.reporting.gradebook import Acceptance, GradebookWriter
from tests.autograder.gradebook_samples import judged, release, submission
from tests.faults.postgresql import PASSWORD, Server
from tests.faults.runs import CLASS, grade, refused, results, start, verdicts

numbers = count()


@pytest.fixture(scope="module")
def server():
    running = Server()
    yield running
    running.remove()


@pytest.fixture
def url(server):
    return server.new(f"course{next(numbers)}")


def test_grades_and_points_by_hand_are_those_of_sqlite(submitted, undisturbed, url, tmp_path):
    grade(submitted, tmp_path / "grades", "--db-url", url)
    assert results(tmp_path / "grades") == results(undisturbed[0])
    assert not (tmp_path / "grades" / "gradebook.db").exists()
    config = (tmp_path / "grades" / "nbgrader_config.py").read_text()
    assert "'postgresql+psycopg://teacher@/course" in config and "two" not in config  # the password
    with Gradebook(database.address(url)) as book:  # nbgrader's own eyes
        assert {one.student_id: one.score for one in book.assignment_submissions("ch44")} == CLASS
        for question, points in (("gae_tradeoff", 1.5), ("gae_time_limit", 1.0)):
            book.find_grade(question, "ch44", "ch44", "ann").manual_score = points
        book.db.commit()
    grade(submitted, tmp_path / "grades", "--db-url", url)
    assert verdicts(tmp_path / "grades")["ann"]["manual_score"] == 2.5
    assert ",ann,,,,12.5,0.0,12.5,14.0\n" in (tmp_path / "grades" / "grades.csv").read_text()


def test_two_graders_of_one_class_in_folders_of_their_own_lose_nothing(submitted, undisturbed, url, tmp_path):
    both = [start(submitted, tmp_path / folder, "--db-url", url) for folder in ("first", "second")]
    for process in both:
        text = process.communicate(timeout=180)[0]
        assert process.returncode == 0 and "Traceback" not in text, text
    assert results(tmp_path / "first") == results(tmp_path / "second") == results(undisturbed[0])


def test_four_writers_that_meet_at_every_step_write_each_row_once(url):
    students, gate = [f"s{number:03}" for number in range(20)], Barrier(4, timeout=20)

    def write(_):
        gate.wait()
        with GradebookWriter(url) as book:
            gate.wait()
            book.register("ch44", release())
            for student in students:
                gate.wait()
                assert book.record(judged(student=student, scores={"compute_gae": 1.0}), submission())

    with ThreadPoolExecutor(4) as graders:
        list(graders.map(write, range(4)))
    with GradebookWriter(url) as book:
        assert [(row["student_id"], row["score"]) for row in book.grades()] == [(student, 3.0) for student in students]
    with Gradebook(database.address(url)) as stock:
        assert stock.db.query(SubmittedAssignment).count() == len(students)


def test_a_name_longer_than_nbgraders_and_a_persons_word_are_kept(url):
    student = "A" * 249
    with GradebookWriter(url) as book:
        book.register("ch44", release())
        assert book.record(judged(student=student), submission())
        said = Acceptance(student, "ch44", "0" * 64, "M. Curie", "2026-11-30", "by mail")
        book.accept(said)
    with GradebookWriter(url) as book:
        assert book.accepted(student, "ch44") == said
        assert [row["student_id"] for row in book.grades()] == [student]


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (lambda server: server.url("postgres", "wrong"), "password authentication failed for user"),
        (lambda server: server.url("nowhere"), 'database "nowhere" does not exist'),
        (lambda server: "postgresql://teacher:secret@127.0.0.1:1/course", "Connection refused"),
    ],
    ids=["password", "database", "port"],
)
def test_one_that_refuses_is_a_line_and_what_is_graded_is_kept(server, submitted, undisturbed, tmp_path, wrong, says):
    out = tmp_path / "grades"
    shutil.copytree(undisturbed[0], out)
    line = refused(submitted, out, "--db-url", wrong(server))
    assert says in line and "secret" not in line and "wrong" not in line and PASSWORD not in line
    assert results(out) == results(undisturbed[0])


def test_one_that_goes_away_in_the_middle_costs_nothing(server, submitted, undisturbed, url, tmp_path):
    out = tmp_path / "grades"
    with pytest.raises(SQLAlchemyError) as failed:
        grading.grade(submitted, out, db_url=url, progress=lambda done, total, name: server.stop() if done == 1 else None)
    assert "\n" not in database.why(failed.value)
    kept = verdicts(out)
    assert len(kept) == 1 and kept.items() <= verdicts(undisturbed[0]).items()
    server.start()
    grade(submitted, out, "--db-url", url)
    assert results(out) == results(undisturbed[0])
