"""A person makes a provisional score final: for this submission alone, with who, when and why, and whatever is graded again."""

import json
import sqlite3
from types import SimpleNamespace

import nbformat
import pytest
from nbformat.v4 import new_notebook
from typer.testing import CliRunner

from autograder import cli, grade
from autograder.authoring import assemble, chapter
from autograder.grading import judge
from autograder.grading.verdicts import Item, Verdict
from autograder.reporting.gradebook import GradebookWriter

QUESTION = "gae_tradeoff"
PAGE = chapter.load("ch44")


@pytest.fixture(scope="module")
def released():
    return nbformat.writes(assemble.for_learners(PAGE))


@pytest.fixture
def course(tmp_path, monkeypatch, released):
    """Grades submissions of chapter 44 without running anything: five of ten points, and what repair says of the notebook."""

    outline = assemble.outline(PAGE)
    release = SimpleNamespace(  # freezing its checks takes seconds
        notebook=nbformat.reads(released, as_version=4),
        form=judge.repair.form(nbformat.reads(released, as_version=4)),
        exercises=[SimpleNamespace(name=name, points=points) for name, points in outline.exercises],
        open_questions=outline.open_questions,
    )

    def judged(submission, release, timeout=60.0, trusted=False, wall="bubblewrap"):
        repaired = judge.repair.repair(submission.notebook, release.form)
        submission.notebook = repaired.notebook
        items = [Item(one.name, one.points / 2, one.points, "partial") for one in release.exercises]
        items += [Item(name, 0.0, points, "manual") for name, points in release.open_questions]
        status = "needs_review" if repaired.ambiguous else "graded"
        flags = (*repaired.ambiguous, *repaired.flags)
        return Verdict(submission.student, submission.assignment, status, 5.0, 10.0, None, 4.0, tuple(items), flags)

    monkeypatch.setattr(judge, "judge", judged)
    monkeypatch.setattr(judge, "released", lambda _assignment: release)
    monkeypatch.setattr(chapter, "all_chapters", lambda: [PAGE])  # assembling them all takes seconds, in every run
    monkeypatch.setattr(assemble, "for_learners", lambda _page: nbformat.reads(released, as_version=4))
    return _Course(tmp_path, released)


class _Course:
    def __init__(self, folder, released):
        self.out, self.submitted, self._released = folder / "grades", folder / "submitted", released

    def hand_in(self, student="ada", without=(QUESTION,), source=""):
        notebook = nbformat.reads(self._released, as_version=4)
        notebook.cells = [cell for cell in notebook.cells if cell.metadata.get("nbgrader", {}).get("grade_id") not in without]
        if source:
            notebook.cells.append(nbformat.v4.new_code_cell(source, id="own"))
        target = self.submitted / student / "ch44"
        target.mkdir(parents=True, exist_ok=True)
        (target / "ch44.ipynb").write_text(nbformat.writes(notebook))

    def grade(self):
        return grade.grade(self.submitted, self.out, trusted=True)

    def accept(self, *arguments):
        words = ["accept", "ada", "ch44", "--out", str(self.out), "--by", "Prof. X", "--because", "talked to her", *arguments]
        return CliRunner().invoke(cli.app, words)

    def verdict(self, student="ada"):
        return json.loads((self.out / "verdicts" / student / "ch44.json").read_text())

    def row(self, student="ada"):
        """The total in grades.csv, None if there is no row."""
        rows = [line.split(",") for line in (self.out / "grades.csv").read_text().splitlines()]
        return next((float(row[rows[0].index("score")]) for row in rows[1:] if row[rows[0].index("student_id")] == student), None)


def test_a_provisional_score_becomes_final_everywhere(course):
    course.hand_in()
    course.grade()
    assert course.verdict()["status"] == "needs_review" and course.row() is None
    result = course.accept()
    assert result.exit_code == 0 and "ada/ch44: 5 of 10 is final, accepted by Prof. X" in result.output
    assert course.verdict()["status"] == "graded" and course.row() == 5.0
    first, *others = course.verdict()["flags"]
    assert first.startswith("accepted: by Prof. X on 20") and first.endswith(", because talked to her")
    assert others == [f"missing_cell: {QUESTION}"]
    assert (
        ",5.0" in (course.out / "canvas.csv").read_text()
        and (course.out / "autograded" / "ada" / "ch44" / "ch44.ipynb").is_file()
    )
    assert not list((course.out / "review").rglob("*.ipynb"))


def test_who_when_and_why_stand_in_the_gradebook(course):
    course.hand_in()
    course.grade()
    course.accept()
    database = sqlite3.connect(course.out / "gradebook.db")
    [row] = database.execute("SELECT student, assignment, accepted_by, reason, length(submission) FROM course_accepted")
    assert row == ("ada", "ch44", "Prof. X", "talked to her", 64)


def test_the_same_submission_graded_again_stays_accepted(course):
    course.hand_in()
    course.grade()
    course.accept()
    before = course.verdict()
    for _ in range(2):
        course.grade()
        assert course.verdict() == before and course.row() == 5.0


def test_outputs_do_not_make_another_submission(course):
    course.hand_in()
    course.grade()
    course.accept()
    path = course.submitted / "ada" / "ch44" / "ch44.ipynb"
    path.write_text(
        path.read_text().replace('"outputs": []', '"outputs": [{"output_type": "stream", "name": "stdout", "text": "x"}]')
    )
    course.grade()
    assert course.verdict()["status"] == "graded"


@pytest.mark.parametrize("change", ["source", "file"])
def test_another_submission_is_reviewed_anew_and_says_so(course, change):
    course.hand_in()
    course.grade()
    course.accept()
    if change == "source":
        course.hand_in(source="a = 1")
    else:
        (course.submitted / "ada" / "ch44" / "helpers.py").write_text("x = 1")
    course.grade()
    assert course.verdict()["status"] == "needs_review" and course.row() is None
    assert course.verdict()["flags"][0].startswith("acceptance_dropped: Prof. X accepted another submission on 20")
    assert course.accept().exit_code == 0 and course.row() == 5.0
    assert [flag.split(":")[0] for flag in course.verdict()["flags"]] == ["accepted", "missing_cell"]


def test_a_corrected_submission_is_graded_and_the_acceptance_dropped(course):
    course.hand_in()
    course.grade()
    course.accept()
    course.hand_in(without=())
    course.grade()
    assert course.verdict()["status"] == "graded" and course.verdict()["flags"][0].startswith("acceptance_dropped: ")


def test_a_kill_between_the_word_and_the_verdict_is_mended_by_either_command(course, monkeypatch):
    course.hand_in()
    course.grade()
    with monkeypatch.context() as patch:
        patch.setattr(grade.verdicts, "write", _killed)
        assert isinstance(course.accept().exception, KeyboardInterrupt | SystemExit)
    assert course.verdict()["status"] == "needs_review"
    assert course.accept().exit_code == 0 and course.verdict()["status"] == "graded"


def _killed(*_arguments):
    raise KeyboardInterrupt


def test_others_keep_their_scores(course):
    course.hand_in()
    course.hand_in("bob", without=())
    course.grade()
    before = course.verdict("bob")
    course.accept()
    assert course.verdict("bob") == before and course.row("bob") == 5.0


@pytest.mark.parametrize(
    ("state", "says"),
    [
        ("nothing", "Give the folder that `course grade` wrote"),
        ("other_student", "no verdict on a student 'ada'; did you mean 'adam'?"),
        ("other_assignment", "no verdict on ada's 'ch44'; there is one on ch43"),
        ("graded", "ada/ch44 is final already: graded, 5 of 10"),
        ("student_error", "ada/ch44 is final already: student_error"),
        ("infra_error", "was not graded (infra_error): grade it again"),
        ("no_notebook", "grade it again first"),
    ],
)
def test_what_cannot_be_accepted_says_why(course, state, says):
    if state != "nothing":
        student = "adam" if state == "other_student" else "ada"
        assignment = "ch43" if state == "other_assignment" else "ch44"
        status = state if state in ("graded", "student_error", "infra_error") else "needs_review"
        grade.verdicts.write(course.out / "verdicts", Verdict(student, assignment, status, 5.0 * (status == "graded"), 10.0))
    result = course.accept()
    assert result.exit_code == 2 and says in result.output
    assert not (course.out / "gradebook.db").exists()


def test_a_name_that_leads_elsewhere_is_no_student(course):
    course.hand_in()
    course.grade()
    result = CliRunner().invoke(cli.app, ["accept", "../../x", "ch44", "--out", str(course.out)])
    assert result.exit_code == 2 and "no verdict on a student" in result.output
    result = CliRunner().invoke(cli.app, ["accept", "ada", "../ada/ch44", "--out", str(course.out)])
    assert result.exit_code == 2


def test_the_table_is_made_when_the_first_word_is_given(course):
    course.hand_in()
    course.grade()
    database = sqlite3.connect(course.out / "gradebook.db")
    tables = "SELECT count(*) FROM sqlite_master WHERE name = 'course_accepted'"
    assert database.execute(tables).fetchone() == (0,)  # until then it is as nbgrader makes it
    assert course.accept().exit_code == 0 and database.execute(tables).fetchone() == (1,)


def test_nobody_has_accepted_what_nobody_accepted(tmp_path):
    with GradebookWriter(f"sqlite:///{tmp_path / 'g.db'}") as book:
        assert book.accepted("ada", "ch44") is None


def test_what_waits_for_review_can_hold_any_text(course):
    course.hand_in(source="x = '\\ud800'  # \x00")
    course.grade()
    assert course.accept().exit_code == 0


def test_a_notebook_without_anything_can_be_accepted(course):
    target = course.submitted / "ada" / "ch44"
    target.mkdir(parents=True)
    (target / "ch44.ipynb").write_text(nbformat.writes(new_notebook()))
    course.grade()
    assert "no_exercise_found" in course.verdict()["flags"]
    assert course.accept().exit_code == 0 and course.verdict()["status"] == "graded"


def test_an_accepted_submission_that_came_late_loses_what_the_rules_say(course):
    course.hand_in()
    (course.submitted / "ada" / "ch44" / "timestamp.txt").write_text("2026-11-22 12:00:00 UTC")
    (course.submitted / ".due.yml").write_text(
        "zone: UTC\npenalty: {per_day: 0.1, at_most: 0.5}\nassignments:\n  ch44: {due: 2026-11-21 12:00}\n"
    )
    course.grade()
    assert course.accept().exit_code == 0 and course.row() == pytest.approx(4.5)
