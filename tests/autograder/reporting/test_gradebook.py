import contextlib
import os
import signal
import sqlite3
import subprocess
import sys
from html.parser import HTMLParser

import nbformat
import pytest
from gradebook_samples import HOSTILE, POINTS, QUESTION_TEXT, judged, release, submission
from nbformat.v4 import new_code_cell, new_markdown_cell, new_output, new_raw_cell
from nbgrader import utils
from nbgrader.api import Gradebook
from nbgrader.plugins import CsvExportPlugin

from autograder.reporting import exports, gradebook
from autograder.reporting.gradebook import GradebookWriter, graded_cells, read_autograded, write_autograded, write_course


@pytest.fixture
def url(tmp_path):
    return f"sqlite:///{tmp_path}/gradebook.db"


@pytest.fixture
def writer(url):
    with GradebookWriter(url) as opened:
        opened.register("ch44", release())
        yield opened


@contextlib.contextmanager
def stock(url):
    """nbgrader's own view of the database, in which a teacher works."""
    with Gradebook(url) as book:
        yield book


def by_hand(url, cell, score, student="s001"):
    """What formgrader does when a teacher types a score."""
    with stock(url) as book:
        grade = book.find_grade(cell, "ch44", "ch44", student)
        grade.manual_score, grade.needs_manual_grade = score, False
        book.db.commit()


def facts(url, student="s001"):
    """Everything the gradebook says about a submission's grades."""
    with stock(url) as book:
        notebook = book.find_submission("ch44", student).notebooks[0]
        return {g.name: (g.auto_score, g.manual_score, g.needs_manual_grade) for g in notebook.grades}


def total(url, student="s001"):
    with stock(url) as book:
        return book.find_submission("ch44", student).score


def in_child(function):
    """Run function in a forked process; a function that waits for its exit status."""
    child = os.fork()
    if child == 0:
        try:
            function()
            os._exit(0)
        except BaseException as problem:
            print(repr(problem), file=sys.stderr)
            os._exit(1)
    return lambda: os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


# --- register --------------------------------------------------------------------------------------------------------------


def test_registering_gives_nbgrader_the_release(url, writer):
    writer.register("ch44", release())
    with stock(url) as book:
        assert book.find_assignment("ch44").max_score == 7.0
        notebook = book.find_notebook("ch44", "ch44")
        assert {cell.name: cell.max_score for cell in notebook.grade_cells} == {
            "test_compute_gae": 3.0,
            "test_td_residuals": 2.0,
            "tradeoff": 2.0,
        }
        assert {cell.name for cell in notebook.solution_cells} == {"compute_gae", "td_residuals", "tradeoff"}
        sources = {cell.name: (cell.source, cell.locked) for cell in notebook.source_cells}
        assert sources["test_compute_gae"] == ("check(compute_gae)", True)
        assert sources["tradeoff"] == (QUESTION_TEXT, False)


def test_the_database_is_stamped_as_nbgrader_stamps_it(url, writer, tmp_path):
    with stock(f"sqlite:///{tmp_path}/stock.db"):
        pass
    schemas, versions = [], []
    for name in ("gradebook.db", "stock.db"):
        with contextlib.closing(sqlite3.connect(tmp_path / name)) as connection:
            schemas.append(sorted(connection.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'")))
            versions.append(connection.execute("SELECT version_num FROM alembic_version").fetchall())
            courses = connection.execute("SELECT id FROM course").fetchall()
    assert [name for name, _ in schemas[0]] == [name for name, _ in schemas[1]]
    assert versions[0] == versions[1]
    assert courses == [("default_course",)]


def test_changed_points_and_new_cells_reach_old_submissions(url, writer):
    writer.record(judged())
    points = {"compute_gae": 4.0, "td_residuals": 2.0, "lambda_returns": 1.0}
    writer.register("ch44", release(points))
    writer.record(judged(points=points))
    with stock(url) as book:
        assert book.find_assignment("ch44").max_score == 9.0
    assert total(url) == 7.0


def test_a_withdrawn_cell_goes_unless_a_teacher_has_worked_on_it(url, writer):
    writer.record(judged())
    writer.register("ch44", release({"compute_gae": 3.0}))
    assert set(facts(url)) == {"test_compute_gae", "tradeoff"}
    by_hand(url, "tradeoff", 1.5)
    with pytest.raises(ValueError, match="tradeoff"):
        writer.register("ch44", release({"td_residuals": 2.0}, questions={}))
    assert facts(url)["tradeoff"][1] == 1.5
    assert "test_compute_gae" in facts(url)  # the refused release has changed nothing


# --- record ----------------------------------------------------------------------------------------------------------------


def test_recording_again_replaces_automatic_scores_only(url, writer):
    writer.record(judged(scores={"compute_gae": 1.5}), submission())
    assert facts(url) == {
        "test_compute_gae": (1.5, None, False),
        "test_td_residuals": (2.0, None, False),
        "tradeoff": (None, None, True),
    }
    by_hand(url, "tradeoff", 1.0)
    with stock(url) as book:
        comment = book.find_comment("tradeoff", "ch44", "ch44", "s001")
        comment.manual_comment = "Good."
        book.find_grade("test_td_residuals", "ch44", "ch44", "s001").extra_credit = 0.5
        book.update_or_create_student("s001", last_name="Noether", first_name="Emmy")
    writer.record(judged(), submission())
    assert facts(url)["tradeoff"] == (None, 1.0, False)
    assert total(url) == 3.0 + 2.0 + 0.5 + 1.0
    with stock(url) as book:
        assert book.find_comment("tradeoff", "ch44", "ch44", "s001").comment == "Good."
        assert book.find_student("s001").last_name == "Noether"


def test_recording_the_same_twice_changes_nothing(url, writer, tmp_path):
    def dump():
        with contextlib.closing(sqlite3.connect(tmp_path / "gradebook.db")) as connection:
            return list(connection.iterdump())

    writer.record(judged(), submission())
    before = dump()
    writer.register("ch44", release())
    writer.record(judged(), submission(), submission())
    assert dump() == before


def test_a_teacher_who_overruled_a_score_hears_when_it_changes(url, writer):
    writer.record(judged(scores={"compute_gae": 0.0}))
    by_hand(url, "test_compute_gae", 2.0)
    writer.record(judged(scores={"compute_gae": 0.0}))
    assert facts(url)["test_compute_gae"] == (0.0, 2.0, False)
    writer.record(judged())
    assert facts(url)["test_compute_gae"] == (3.0, 2.0, True)


def test_an_answer_that_changed_is_graded_again(url, writer):
    writer.record(judged(), submission())
    by_hand(url, "tradeoff", 1.0)
    writer.record(judged(), submission(), previous=submission())
    assert facts(url)["tradeoff"] == (None, 1.0, False)
    writer.record(judged(), submission("Variance."), previous=submission())
    assert facts(url)["tradeoff"] == (None, 1.0, True)
    assert writer.manual_scores("s001", "ch44") == (1.0, 2.0)


def test_a_question_left_as_released_waits_for_nobody(url, writer):
    writer.record(judged(), release())
    assert facts(url)["tradeoff"] == (0.0, None, False)
    assert writer.manual_scores("s001", "ch44") == (None, 2.0)
    with stock(url) as book:
        assert book.find_comment("tradeoff", "ch44", "ch44", "s001").comment == "No response."
    writer.record(judged(), submission(), previous=release())
    assert facts(url)["tradeoff"] == (None, None, True)
    with stock(url) as book:
        assert book.find_comment("tradeoff", "ch44", "ch44", "s001").comment is None


def test_manual_scores_wait_for_every_answer(url):
    questions = {"tradeoff": 2.0, "why": 1.0}
    with GradebookWriter(url) as writer:
        writer.register("ch44", release(questions=questions))
        assert writer.manual_scores("s001", "ch44") == (None, 3.0)
        assert writer.manual_scores("s001", "ch99") == (None, 0.0)
        writer.record(judged(), submission(questions=questions))
        by_hand(url, "tradeoff", 1.5)
        assert writer.manual_scores("s001", "ch44") == (None, 3.0)
        by_hand(url, "why", 0.0)
        assert writer.manual_scores("s001", "ch44") == (1.5, 3.0)


@pytest.mark.parametrize("status", ["needs_review", "infra_error"])
def test_verdicts_without_a_final_score_are_not_written(url, writer, status):
    assert not writer.record(judged(status=status))
    with stock(url) as book:
        assert book.students == []
    writer.record(judged())
    before = facts(url)
    assert not writer.record(judged(status=status, scores={"compute_gae": 0.0}))
    assert facts(url) == before


def test_a_student_error_is_zero_and_keeps_scores_given_by_hand(url, writer):
    writer.record(judged(), submission())
    by_hand(url, "tradeoff", 2.0)
    assert writer.record(judged(status="student_error", items=[], score=0.0))
    assert facts(url)["test_compute_gae"] == (0.0, None, False)
    assert total(url) == 2.0
    assert not writer.record(judged(status="student_error", assignment="nonsense", items=[], score=0.0, max_score=0.0))


def test_what_cannot_be_recorded_is_an_error_and_leaves_no_trace(url, writer):
    with pytest.raises(ValueError, match="register"):
        writer.record(judged(assignment="ch45"))
    with pytest.raises(ValueError, match="td_residuals"):
        writer.record(judged(points={"compute_gae": 3.0}))
    with stock(url) as book:
        assert book.students == []


# --- kills and concurrency -------------------------------------------------------------------------------------------------


def test_a_run_killed_inside_a_transaction_leaves_the_previous_scores(url, writer, monkeypatch):
    writer.record(judged(scores={"compute_gae": 0.0}))
    before = facts(url)

    def killed():
        with GradebookWriter(url) as mine:
            monkeypatch.setattr(gradebook, "_grade_question", lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL))
            mine.record(judged())

    assert in_child(killed)() == -signal.SIGKILL
    assert facts(url) == before
    writer.record(judged())
    assert facts(url)["test_compute_gae"] == (3.0, None, False)


def test_a_run_killed_between_gradebook_and_notebook_converges(url, writer, tmp_path):
    def run(answer, killed=False):
        submitted = submission(answer)
        writer.record(judged(), submitted, read_autograded(tmp_path, "s001", "ch44"))
        if not killed:
            write_autograded(tmp_path, release(), submitted, judged())

    run("First.")
    by_hand(url, "tradeoff", 1.0)
    run("Second.", killed=True)
    run("Second.")
    assert facts(url)["tradeoff"] == (None, 1.0, True)  # a teacher will see the second answer
    assert graded_cells(read_autograded(tmp_path, "s001", "ch44"))["tradeoff"].source == "Second."


def test_processes_that_start_and_write_at_once_lose_nothing(url):
    def work(offset):
        with GradebookWriter(url) as mine:
            mine.register("ch44", release())
            for number in range(offset, offset + 15):
                mine.record(judged(f"s{number:03}"), submission())

    waits = [in_child(lambda offset=offset: work(offset)) for offset in (0, 10, 20)]  # overlapping: some are written twice
    assert [wait() for wait in waits] == [0, 0, 0]
    with stock(url) as book:
        assert {student.id: student.score for student in book.students} == {f"s{number:03}": 5.0 for number in range(35)}


def test_a_reader_is_never_in_the_way(url, writer):
    writer.record(judged("s001"))
    with stock(url) as reader:
        assert reader.find_submission("ch44", "s001").score == 5.0  # its transaction stays open
        writer.record(judged("s002"))
    assert total(url, "s002") == 5.0


# --- the course folder -----------------------------------------------------------------------------------------------------


class _Active(HTMLParser):
    """What of a submission would run in a browser: here everything active says "alert("."""

    def __init__(self, page):
        super().__init__()
        self.found, self.text = [], ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.found += [(tag, name, value) for name, value in attrs if "alert(" in (value or "")]

    def handle_data(self, data):
        self.text += data
        if self.cdata_elem and "alert(" in data:
            self.found.append((self.cdata_elem, data))


def hostile_submission():
    """A submission whose every part tries to be active in the teacher's browser."""
    notebook = submission(HOSTILE)
    cells = graded_cells(notebook)
    cells["test_compute_gae"].source = "print('forged')"
    cells["test_compute_gae"].metadata.nbgrader.points = 1000
    page = new_output("display_data", data={"text/html": "<script>alert(2)</script>", "image/png": 'x" onerror="alert(3)'})
    stdout = new_output("stream", text="<script>alert(4)</script>" * 10_000)
    cells["compute_gae"].outputs = [page, stdout, new_output("execute_result", data={"text/plain": "3.0"})]
    forged = new_code_cell("1", metadata={"nbgrader": {"grade": True, "solution": False, "grade_id": "bonus", "points": 99}})
    copied = new_code_cell("2", metadata={"nbgrader": dict(cells["test_compute_gae"].metadata.nbgrader)})
    odd = new_markdown_cell(
        "[x](javascript:alert(5)) $\\href{javascript:alert(6)}{y}$", metadata={"nbgrader": {"grade_id": ["a"]}}
    )
    missing = new_markdown_cell("![x](attachment:nothing.png)\n\n[y]: javascript:alert(7)", metadata={"nbgrader": "odd"})
    notebook.cells += [forged, copied, odd, missing, new_raw_cell("<img src=x onerror=alert(8)>")]
    notebook.cells.remove(cells["test_td_residuals"])
    notebook.metadata = {"widgets": {"application/vnd.jupyter.widget-state+json": {"state": {}}}, "kernelspec": {"name": "evil"}}
    return notebook


def test_nbgraders_own_tools_work_on_the_folder(url, writer, tmp_path):
    """One real nbgrader process: its configuration file, feedback for plain and hostile submissions, with their scores."""
    write_course(tmp_path, {"ch44": release()})
    for student, notebook, scores in (
        ("s001", submission(), {"compute_gae": 1.5}),
        ("s002", hostile_submission(), {"compute_gae": 0.0}),
        ("s003", None, {}),
    ):
        status = "graded" if notebook else "student_error"
        result = judged(student, scores, status, message=HOSTILE)
        writer.record(result, notebook)
        write_autograded(tmp_path, release(), notebook, result)
    arguments = [sys.executable, "-m", "nbgrader", "generate_feedback", "ch44"]
    run = subprocess.run(arguments, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    pages = {name: (tmp_path / "feedback" / name / "ch44" / "ch44.html").read_text() for name in ("s001", "s002", "s003")}
    assert "(Score: 3.5 / 7.0)" in pages["s001"]
    assert "(Score: 2.0 / 7.0)" in pages["s002"]
    assert "(Score: 0.0 / 7.0)" in pages["s003"]
    active = _Active(pages["s002"])
    assert active.found == []
    assert "\\href{" not in active.text


def test_the_shown_notebook_says_what_the_gradebook_says(url, writer, tmp_path):
    """nbgrader's own determine_grade, which SaveAutoGrades uses, finds the recorded scores in the outputs."""
    for scores in ({}, {"compute_gae": 1.5}, {"compute_gae": 0.0, "td_residuals": 0.0}):
        for notebook in (submission(), hostile_submission()):
            result = judged(scores=scores, message="Look at\nthe mask.")
            writer.record(result, notebook)
            shown = nbformat.read(write_autograded(tmp_path, release(), notebook, result), as_version=4)
            nbformat.validate(shown)
            cells = graded_cells(shown)
            assert set(cells) == set(graded_cells(release()))
            found = {name: utils.determine_grade(cell)[0] for name, cell in cells.items() if utils.is_grade(cell)}
            assert found == {name: automatic for name, (automatic, _, _) in facts(url).items()}
            assert cells["test_compute_gae"].source == "check(compute_gae)"
            assert shown.cells[0].source == release().cells[0].source


def test_a_verdict_that_is_not_recorded_is_not_shown(tmp_path):
    assert write_autograded(tmp_path, release(), submission(), judged(status="needs_review")) is None
    assert read_autograded(tmp_path, "s001", "ch44") is None


def test_the_course_folder_never_holds_a_password(tmp_path):
    write_course(tmp_path, {}, "postgresql://course:secret@db.example/grades")
    text = (tmp_path / "nbgrader_config.py").read_text()
    assert "postgresql+psycopg://course@db.example/grades" in text
    assert "secret" not in text


# --- the gradebook's rows --------------------------------------------------------------------------------------------------


def test_grades_csv_is_nbgraders_export(url, writer, tmp_path):
    writer.register("ch45", release(POINTS))
    for student in ("s001", "s002"):
        writer.record(judged(student, {"compute_gae": 1.0}))
    writer.record(judged("s001", assignment="ch45"))
    by_hand(url, "tradeoff", 1.25)
    with stock(url) as book:
        book.update_or_create_student("s001", last_name="Noether", email="emmy@example.org")
        book.update_or_create_assignment("ch44", duedate="2026-01-01 12:00:00 UTC")
        book.update_or_create_submission("ch44", "s001", timestamp="2026-01-02 12:00:00 UTC")
        book.find_submission_notebook("ch44", "ch44", "s001").late_submission_penalty = 0.5
        book.db.commit()
        CsvExportPlugin(to=str(tmp_path / "stock.csv")).export(book)
    assert sorted((tmp_path / "stock.csv").read_text().splitlines()) == sorted(exports.grades_csv(writer.grades()).splitlines())
