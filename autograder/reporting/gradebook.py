"""nbgrader's gradebook: the single writer of automatic scores, and the course folder that formgrader opens.

nbgrader's own tables and models (0.9.6) are used as they are; only the transactions are ours. Its API commits after every row,
so that a kill leaves half a submission; here each submission is one transaction, and so is the creation of the database. What
teachers type (manual scores, extra credit, comments, names) is never written, due dates and penalties only from a file of them. One
table is ours, `course_accepted`: who made a provisional score final, when and why (`course accept`). Which database it is, and how several
graders take turns in it, is for `database`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import nbformat
from alembic.config import Config
from alembic.script import ScriptDirectory
from nbformat import NotebookNode
from nbformat.v4 import new_notebook, new_output
from nbgrader import utils
from nbgrader.api import (
    Assignment,
    Base,
    BaseCell,
    Comment,
    Course,
    Grade,
    GradeCell,
    Notebook,
    SolutionCell,
    SourceCell,
    Student,
    SubmittedAssignment,
    SubmittedNotebook,
)
from nbgrader.dbutil import ALEMBIC_DIR
from sqlalchemy import (
    URL,
    Column,
    MetaData,
    String,
    Table,
    Text,
    and_,
    delete,
    func,
    inspect,
    select,
    text,
    true,
)
from sqlalchemy.orm import Session, aliased

from autograder.grading.deadlines import UNKNOWN, HandedIn
from autograder.grading.verdicts import Item, Verdict, plain_name, write_atomically
from autograder.reporting import database, passive

COURSE = "default_course"  # nbgrader's own name for the course of a folder that names none
NAME_LENGTH = 255
GRADE_COLUMNS = (
    "assignment", "duedate", "timestamp", "student_id", "last_name", "first_name", "email",
    "raw_score", "late_submission_penalty", "score", "max_score",
)  # fmt: skip


# --- notebooks ---------------------------------------------------------------------------------------------------------------


def graded_cells(notebook: NotebookNode) -> dict[str, NotebookNode]:
    """The cells that nbgrader knows, by `grade_id`; the first of a name counts."""
    cells: dict[str, NotebookNode] = {}
    for cell in notebook.cells:
        nbgrader = cell.metadata.get("nbgrader")
        name = nbgrader.get("grade_id") if isinstance(nbgrader, dict) else None
        if isinstance(name, str) and name:
            cells.setdefault(name, cell)
    return cells


def _is_open_question(cell: NotebookNode) -> bool:
    return utils.is_grade(cell) and utils.is_solution(cell)


def _answer(notebook: NotebookNode | None, name: str) -> str | None:
    cell = graded_cells(notebook).get(name) if notebook else None
    return passive.text(cell.source).strip() if cell else None


@dataclass(frozen=True)
class Acceptance:
    """A person's word that the provisional score of one submission counts."""

    student: str
    assignment: str
    submission: str
    """Its fingerprint (see intake): another submission of the same student is not meant."""
    accepted_by: str
    accepted_on: str
    reason: str


_ACCEPTED = Table(
    "course_accepted",
    MetaData(),
    Column("student", String(NAME_LENGTH), primary_key=True),
    Column("assignment", String(NAME_LENGTH), primary_key=True),
    Column("submission", String(64), nullable=False),
    Column("accepted_by", Text, nullable=False),
    Column("accepted_on", String(32), nullable=False),
    Column("reason", Text, nullable=False),
)


# --- the database ------------------------------------------------------------------------------------------------------------


def _create_schema(connection) -> None:
    """What nbgrader's Gradebook does on its first visit, in one transaction and without a subprocess."""
    Base.metadata.create_all(connection)
    if connection.dialect.name == "postgresql":
        _widen_names(connection)
    if not inspect(connection).has_table("alembic_version"):
        config = Config()
        config.set_main_option("script_location", ALEMBIC_DIR.replace("%", "%%"))
        version = ScriptDirectory.from_config(config).get_current_head()
        connection.execute(text("CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL)"))
        connection.execute(text("INSERT INTO alembic_version (version_num) VALUES (:version)"), {"version": version})
    if not connection.execute(select(Course.id).where(Course.id == COURSE)).first():
        connection.execute(Course.__table__.insert().values(id=COURSE))


def _widen_names(connection) -> None:
    """PostgreSQL keeps to nbgrader's 128 characters for a student, SQLite never did, and a folder's name may have more."""
    for table, column in (("student", "id"), ("submitted_assignment", "student_id")):
        [found] = (one for one in inspect(connection).get_columns(table) if one["name"] == column)
        if found["type"].length < NAME_LENGTH:
            connection.execute(text(f"ALTER TABLE {table} ALTER COLUMN {column} TYPE VARCHAR({NAME_LENGTH})"))


def _get_or_add(db: Session, model: Any, **key: Any) -> Any:
    row = db.scalars(select(model).filter_by(**key)).one_or_none()
    if row is None:
        row = model(**key)
        db.add(row)
    return row


def _get_or_add_each(db: Session, model: Any, cells: Iterable[BaseCell], paper: SubmittedNotebook) -> dict[str, Any]:
    """A submission's grades (or comments) by cell name. All are missing the first time, later those of newly released cells."""
    rows = {row.cell_id: row for row in db.scalars(select(model).filter_by(notebook_id=paper.id))}
    for cell in cells:
        if cell.id not in rows:
            rows[cell.id] = model(cell_id=cell.id, notebook_id=paper.id)
            db.add(rows[cell.id])
    return {cell.name: rows[cell.id] for cell in cells}


def _given_by_hand(db: Session, cell: BaseCell) -> bool:
    grades = db.scalars(select(Grade).filter_by(cell_id=cell.id))
    comments = db.scalars(select(Comment).filter_by(cell_id=cell.id))
    return any(grade.manual_score is not None or grade.extra_credit is not None for grade in grades) or any(
        comment.manual_comment is not None for comment in comments
    )


@dataclass(frozen=True)
class Mark:
    """What the gradebook holds for one cell of a submission: None as long as a question waits for points by hand."""

    cell: str
    question: bool
    score: float | None
    max_score: float


class GradebookWriter:
    """Writes automatic scores into the database at `db_url`, which is created on first use. A context manager."""

    def __init__(self, db_url: str | URL):
        self._engine = database.engine(db_url)
        with self._engine.begin() as connection:
            _create_schema(connection)

    def __enter__(self) -> GradebookWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._engine.dispose()

    @contextmanager
    def _transaction(self) -> Iterator[Session]:
        with Session(self._engine) as db, db.begin():
            yield db

    def register(self, assignment: str, release: NotebookNode, due: datetime | None = None) -> None:
        """Make the database's assignment agree with `release`, the notebook handed out, whose metadata names cells and points.

        Calling it again changes nothing; with other points it updates them, with other cells it adds and removes. Without `due` the
        due date that a teacher gave stays.
        Raises: ValueError, and changes nothing, if a cell that went away holds a score or comment given by hand.
        """
        cells = graded_cells(release)
        with self._transaction() as db:
            row = _get_or_add(db, Assignment, name=plain_name(assignment))
            row.duedate = _utc(due) or row.duedate
            db.flush()
            notebook = _get_or_add(db, Notebook, name=assignment, assignment_id=row.id)
            notebook.kernelspec = json.dumps(release.metadata.get("kernelspec", {}), sort_keys=True)
            db.flush()
            self._remove_other_cells(db, notebook, cells)
            for name, cell in cells.items():
                key = {"name": name, "notebook_id": notebook.id}
                if utils.is_grade(cell):
                    graded = _get_or_add(db, GradeCell, **key)
                    graded.max_score, graded.cell_type = float(cell.metadata.nbgrader["points"]), cell.cell_type
                if utils.is_solution(cell):
                    _get_or_add(db, SolutionCell, **key)
                source = _get_or_add(db, SourceCell, **key)
                source.cell_type, source.source = cell.cell_type, cell.source
                source.locked, source.checksum = utils.is_locked(cell), utils.compute_checksum(cell)

    @staticmethod
    def _remove_other_cells(db: Session, notebook: Notebook, cells: Mapping[str, NotebookNode]) -> None:
        for model, belongs in ((GradeCell, utils.is_grade), (SolutionCell, utils.is_solution), (SourceCell, lambda cell: True)):
            for old in db.scalars(select(model).filter_by(notebook_id=notebook.id)).all():
                if old.name in cells and belongs(cells[old.name]):
                    continue
                if isinstance(old, BaseCell):
                    if _given_by_hand(db, old):
                        raise ValueError(
                            f"{notebook.name}: the cell {old.name!r} is no longer in the release, but scores or comments were "
                            "given for it by hand. Grade the new release into another gradebook."
                        )
                    db.execute(delete(Grade).filter_by(cell_id=old.id))
                    db.execute(delete(Comment).filter_by(cell_id=old.id))
                db.delete(old)

    def record(
        self,
        verdict: Verdict,
        submitted: NotebookNode | None = None,
        previous: NotebookNode | None = None,
        handed_in: HandedIn = UNKNOWN,
    ) -> bool:
        """Write the automatic scores of a verdict, in one transaction. Returns whether the verdict is one that may be written.

        `needs_review` and `infra_error` are not, nor is the `student_error` of an unknown assignment; that of a known one is zero
        everywhere. An open question needs a teacher until it has a score by hand, and again when its answer in `submitted`
        differs from the one in `previous` (see `read_autograded`). Left as released it is worth 0 without one, as in nbgrader.
        `handed_in` says when it came in, and what part of all its points, those given by hand included, being late costs.

        Raises: ValueError if the assignment is not registered, or the verdict lacks one of its exercises.
        """
        verdict = Verdict.of(verdict)
        if verdict.status not in ("graded", "student_error"):
            return False
        failed = verdict.status == "student_error"
        scores = {f"test_{item.exercise}": item.score for item in verdict.automatic}
        with self._transaction() as db:
            notebook = db.scalars(select(Notebook).join(Assignment).where(Assignment.name == verdict.assignment)).one_or_none()
            if notebook is None:
                if failed:
                    return False
                raise ValueError(f"assignment {verdict.assignment!r} is not in the gradebook: register it first")
            paper = self._submitted_notebook(db, notebook, verdict.student)
            graded, solved, sources = (
                db.scalars(select(model).filter_by(notebook_id=notebook.id)).all()
                for model in (GradeCell, SolutionCell, SourceCell)
            )
            grades = _get_or_add_each(db, Grade, graded, paper)
            comments = _get_or_add_each(db, Comment, solved, paper)
            released = {cell.name: passive.text(cell.source).strip() for cell in sources}
            for name, grade in grades.items():
                if name in comments:
                    answer = _answer(submitted, name)
                    blank = failed or answer == released[name]
                    comments[name].auto_comment = "No response." if blank else None
                    _grade_question(grade, blank, edited=previous is not None and answer != _answer(previous, name))
                elif failed:
                    _grade_exercise(grade, 0.0)
                elif name in scores:
                    _grade_exercise(grade, scores[name])
                else:
                    raise ValueError(f"{verdict.student}/{verdict.assignment}: the verdict has no item for {name!r}")
            _note_time(db, paper, handed_in)
        return True

    def accept(self, acceptance: Acceptance) -> None:
        """Keep a person's word, in the place of an earlier one on the same student's assignment."""
        key = and_(_ACCEPTED.c.student == acceptance.student, _ACCEPTED.c.assignment == acceptance.assignment)
        with self._transaction() as db:
            _ACCEPTED.create(db.connection(), checkfirst=True)  # until then the database is as nbgrader makes it
            db.execute(delete(_ACCEPTED).where(key))
            db.execute(_ACCEPTED.insert().values(**asdict(acceptance)))

    def accepted(self, student: str, assignment: str) -> Acceptance | None:
        """The last word on a student's assignment, whichever submission it was given on."""
        with self._transaction() as db:
            if not inspect(db.connection()).has_table(_ACCEPTED.name):
                return None
            row = db.execute(select(_ACCEPTED).filter_by(student=student, assignment=assignment)).one_or_none()
        return Acceptance(*row) if row else None

    @staticmethod
    def _submitted_notebook(db: Session, notebook: Notebook, student: str) -> SubmittedNotebook:
        _get_or_add(db, Student, id=student)
        submission = _get_or_add(db, SubmittedAssignment, assignment_id=notebook.assignment_id, student_id=student)
        db.flush()
        paper = _get_or_add(db, SubmittedNotebook, notebook_id=notebook.id, assignment_id=submission.id)
        db.flush()
        return paper

    def manual_scores(self, student: str, assignment: str) -> tuple[float | None, float]:
        """The points given by hand for the open questions, without extra credit, and their maximum.

        The score is None as long as an answered question waits for its first score, or no question has one.
        """
        solution = aliased(SolutionCell, flat=True)
        question = and_(solution.name == GradeCell.name, solution.notebook_id == GradeCell.notebook_id)
        with self._transaction() as db:
            cells = db.scalars(
                select(GradeCell).join(solution, question).join(Notebook, Notebook.id == GradeCell.notebook_id)
                .join(Assignment).where(Assignment.name == assignment)
            ).all()  # fmt: skip
            grades = db.scalars(
                select(Grade).join(SubmittedNotebook).join(SubmittedAssignment)
                .where(SubmittedAssignment.student_id == student, Grade.cell_id.in_([cell.id for cell in cells]))
            ).all()  # fmt: skip
            waiting = any(grade.manual_score is None and grade.auto_score is None for grade in grades)
            given = [grade.manual_score for grade in grades if grade.manual_score is not None]
            return (sum(given) if given and not waiting else None), float(sum(cell.max_score for cell in cells))

    def grades(self) -> list[dict[str, Any]]:
        """The rows of nbgrader's CSV exporter, by student and assignment, with one query instead of one for each row.

        As there, a student of the gradebook who has not submitted an assignment has a row with score 0 and no timestamp.
        Each row has in addition `lms_user_id`, `submitted` (whether there is a submission), and the score in its two parts:
        `automatic` of `automatic_max`, and `by_hand` (None until no question waits) of `by_hand_max`, penalty not yet taken off.
        """
        mine = and_(SubmittedAssignment.assignment_id == Assignment.id, SubmittedAssignment.student_id == Student.id)
        query = (
            select(
                Assignment.name, Assignment.duedate, SubmittedAssignment.timestamp,
                Student.id, Student.last_name, Student.first_name, Student.email,
                func.coalesce(SubmittedAssignment.score, 0.0), func.coalesce(SubmittedAssignment.late_submission_penalty, 0.0),
                Assignment.max_score, Student.lms_user_id, SubmittedAssignment.id,
            )
            .select_from(Assignment).join(Student, true()).outerjoin(SubmittedAssignment, mine)
            .order_by(Student.id, Assignment.name)
        )  # fmt: skip
        with self._transaction() as db:
            found = db.execute(query).all()
        marks = self.marks()
        maxima = self._maxima()
        rows = []
        for *first, raw, penalty, maximum, lms_user_id, submission in found:
            row = dict(zip(GRADE_COLUMNS, (*first, raw, penalty, max(0.0, raw - penalty), maximum), strict=True))
            mine_all = marks.get((row["student_id"], row["assignment"]), ())
            by_hand = [mark.score for mark in mine_all if mark.question]
            given = [score for score in by_hand if score is not None]
            rows.append(
                row
                | {"lms_user_id": lms_user_id, "submitted": submission is not None}
                | maxima.get(row["assignment"], {"automatic_max": 0.0, "by_hand_max": 0.0})
                | {"automatic": sum(mark.score or 0.0 for mark in mine_all if not mark.question)}
                | {"by_hand": sum(given) if len(given) == len(by_hand) else None}
            )
        return rows

    def _maxima(self) -> dict[str, dict[str, float]]:
        """Assignment → the points of its exercises and of its open questions."""
        solution = aliased(SolutionCell, flat=True)
        query = (
            select(Assignment.name, GradeCell.max_score, solution.id)
            .select_from(GradeCell).join(Notebook, Notebook.id == GradeCell.notebook_id).join(Assignment)
            .outerjoin(solution, and_(solution.name == GradeCell.name, solution.notebook_id == GradeCell.notebook_id))
        )  # fmt: skip
        with self._transaction() as db:
            found = db.execute(query).all()
        maxima: dict[str, dict[str, float]] = {}
        for assignment, points, question in found:
            of = maxima.setdefault(assignment, {"automatic_max": 0.0, "by_hand_max": 0.0})
            of["automatic_max" if question is None else "by_hand_max"] += points
        return maxima

    def marks(self) -> dict[tuple[str, str], list[Mark]]:
        """(student, assignment) → its marks by cell, as a teacher left them: points by hand count before automatic ones.

        A question that was left as released has 0 without a teacher, as in nbgrader."""
        solution = aliased(SolutionCell, flat=True)
        query = (
            select(
                SubmittedAssignment.student_id, Assignment.name, GradeCell.name, solution.id,
                Grade.manual_score, Grade.auto_score, Grade.extra_credit, GradeCell.max_score,
            )
            .select_from(Grade).join(GradeCell, GradeCell.id == Grade.cell_id)
            .join(SubmittedNotebook, SubmittedNotebook.id == Grade.notebook_id)
            .join(SubmittedAssignment, SubmittedAssignment.id == SubmittedNotebook.assignment_id)
            .join(Assignment, Assignment.id == SubmittedAssignment.assignment_id)
            .outerjoin(solution, and_(solution.name == GradeCell.name, solution.notebook_id == GradeCell.notebook_id))
            .order_by(SubmittedAssignment.student_id, Assignment.name, GradeCell.name)
        )  # fmt: skip
        with self._transaction() as db:
            found = db.execute(query).all()
        marks: dict[tuple[str, str], list[Mark]] = {}
        for student, assignment, cell, question, by_hand, automatic, extra, points in found:
            score = automatic if by_hand is None else by_hand
            score = None if score is None else score + (extra or 0.0)
            marks.setdefault((student, assignment), []).append(Mark(cell, question is not None, score, points))
        return marks


def _utc(moment: datetime | None) -> datetime | None:
    """A time as nbgrader keeps it."""
    return moment.astimezone(UTC).replace(tzinfo=None) if moment else None


def _note_time(db: Session, paper: SubmittedNotebook, handed_in: HandedIn) -> None:
    submission = paper.assignment
    submission.timestamp = _utc(handed_in.at) or submission.timestamp
    if not handed_in.ruled:
        return
    submission.extension = handed_in.extension
    db.flush()
    points = db.scalar(select(SubmittedNotebook.score).where(SubmittedNotebook.id == paper.id)) or 0.0
    paper.late_submission_penalty = round(points * handed_in.share, 4) or None


def _grade_exercise(grade: Grade, score: float) -> None:
    if grade.manual_score is None:
        grade.needs_manual_grade = False
    elif grade.auto_score != score:
        grade.needs_manual_grade = True  # what a teacher has overruled was another score than this one
    grade.auto_score = score


def _grade_question(grade: Grade, blank: bool, edited: bool) -> None:
    grade.auto_score = 0.0 if blank else None
    if grade.manual_score is None:
        grade.needs_manual_grade = not blank
    elif edited:
        grade.needs_manual_grade = True


# --- the course folder -------------------------------------------------------------------------------------------------------

_CONFIG = """\
# Written by `course grade`. Run formgrader, `nbgrader generate_feedback ASSIGNMENT` or `nbgrader export` in this folder.
import os

c = get_config()  # noqa: F821
c.CourseDirectory.root = os.path.dirname(os.path.abspath(__file__))
{database}# Submissions run only in the sandbox of `course grade`: formgrader's autograde button neither executes nor scores them.
c.Autograde.autograde_preprocessors = []
"""


def write_course(directory: Path, releases: Mapping[str, NotebookNode], db_url: str | URL | None = None) -> None:
    """Make `directory` a course folder of nbgrader: its configuration, and each assignment's release (formgrader lists those).

    `db_url` is needed only for a database other than `directory/gradebook.db`. Its password is left out, as others may read
    the file; PostgreSQL's client finds passwords in ~/.pgpass.
    """
    where = ""
    if db_url:
        url = database.address(db_url).difference_update_query(["password"])
        public = URL.create(url.drivername, url.username, None, url.host, url.port, url.database, url.query)
        where = f"c.CourseDirectory.db_url = {public.render_as_string()!r}\n"
    write_atomically(Path(directory) / "nbgrader_config.py", _CONFIG.format(database=where))
    for assignment, release in releases.items():
        plain_name(assignment)
        write_atomically(Path(directory) / "source" / assignment / f"{assignment}.ipynb", nbformat.writes(release) + "\n")


def _autograded_path(directory: Path, student: str, assignment: str) -> Path:
    return Path(directory) / "autograded" / plain_name(student) / plain_name(assignment) / f"{assignment}.ipynb"


def read_autograded(directory: Path, student: str, assignment: str) -> NotebookNode | None:
    """The notebook that `write_autograded` wrote last, or None."""
    path = _autograded_path(directory, student, assignment)
    return nbformat.read(path, as_version=4) if path.is_file() else None


def write_autograded(directory: Path, release: NotebookNode, submitted: NotebookNode | None, verdict: Verdict) -> Path | None:
    """Write what formgrader and `generate_feedback` show of a verdict; None, and nothing, for one that is never recorded.

    These are the learner's cells in their order, with the release's metadata and locked sources, the outcome as output of each
    test cell, and nothing that could run in the teacher's browser. Without a notebook (`student_error`) the release stands in.
    Call it after `record`: when a run is killed between the two, the next one still sees that an answer has changed.
    """
    verdict = Verdict.of(verdict)
    if verdict.status not in ("graded", "student_error"):
        return None
    originals = graded_cells(release)
    untouched = {cell.source: cell for cell in release.cells}
    items = {f"test_{item.exercise}": item for item in verdict.automatic}
    cells = [passive.cell(cell, untouched) for cell in _in_order(release, submitted or release)]
    for number, cell in enumerate(cells):
        cell.id = f"cell-{number}"
        name = cell.metadata.get("nbgrader", {}).get("grade_id")
        if name and utils.is_grade(originals[name]) and not _is_open_question(originals[name]):
            cell.outputs = _outcome(items.get(name), verdict)
    notebook = new_notebook(cells=cells, metadata=release.metadata)
    path = _autograded_path(directory, verdict.student, verdict.assignment)
    return write_atomically(path, nbformat.writes(notebook).encode(errors="replace").decode() + "\n")


def _in_order(release: NotebookNode, submitted: NotebookNode) -> list[NotebookNode]:
    """The submitted cells, the first of each known name under the release's metadata; known ones that are missing follow."""
    missing = graded_cells(release)
    cells = []
    for cell in submitted.cells:
        nbgrader = cell.metadata.get("nbgrader")
        name = nbgrader.get("grade_id") if isinstance(nbgrader, dict) else None
        original = missing.pop(name, None) if isinstance(name, str) else None
        kind, source, metadata = cell.cell_type, cell.source, {}
        if original:
            kind, metadata = original.cell_type, {"nbgrader": original.metadata.nbgrader}
            source = original.source if utils.is_locked(original) else source
        cells.append(NotebookNode(cell_type=kind, source=source, metadata=metadata, outputs=cell.get("outputs", [])))
    return cells + list(missing.values())


def _outcome(item: Item | None, verdict: Verdict) -> list[NotebookNode]:
    """Outputs from which nbgrader's `determine_grade` reads the item's score: an error is 0, a number is itself."""
    if verdict.status == "student_error" or item is None:
        return [new_output("error", ename=verdict.status, evalue="", traceback=[", ".join(verdict.flags) or verdict.status])]
    if item.score == 0 and item.state != "correct":
        return [new_output("error", ename=item.state, evalue=item.message, traceback=[item.message or item.state])]
    message = [new_output("stream", name="stdout", text=item.message + "\n")] if item.message else []
    return [*message, new_output("execute_result", data={"text/plain": repr(item.score)}, execution_count=None)]
