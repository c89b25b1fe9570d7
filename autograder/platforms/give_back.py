"""Give back what was graded, as each learning platform takes it: `course return`.

Scores come from the verdicts and, where a teacher has given points, from nbgrader's gradebook as it is now. What has no final verdict
is never given back; whoever is left out is named with the reason. Files are written whole and replaced atomically.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from autograder.grading import sources
from autograder.grading.verdicts import FINAL, Verdict, clean_text, read_all
from autograder.reporting import collected
from autograder.reporting.collected import Handed
from autograder.reporting.database import UnusableURL
from autograder.reporting.gradebook import GradebookWriter, Mark
from autograder.reporting.report import STATE_WORDS, points
from autograder.reporting.tables import Person, person


class GiveBackError(ValueError):
    """Nothing can be given back; the message says what to do."""


@dataclass(frozen=True)
class Question:
    """An exercise or open question with its points; None as long as a teacher has to give them."""

    name: str
    by_hand: bool
    score: float | None
    max_score: float
    state: str
    misconceptions: tuple[str, ...] = ()
    message: str = ""


@dataclass(frozen=True)
class Result:
    """A submission with a final verdict, and everything that is known of it."""

    verdict: Verdict
    questions: tuple[Question, ...]
    marks: tuple[Mark, ...]
    penalty: float
    person: Person
    handed: Handed | None = None

    @property
    def student(self) -> str:
        return self.verdict.student

    @property
    def assignment(self) -> str:
        return self.verdict.assignment

    @property
    def automatic(self) -> float:
        return round(sum(one.score or 0.0 for one in self.questions if not one.by_hand), 4)

    @property
    def automatic_max(self) -> float:
        return sum(one.max_score for one in self.questions if not one.by_hand)

    @property
    def waits(self) -> bool:
        """Whether a teacher still has to give points."""
        return any(one.score is None for one in self.questions)

    @property
    def maximum(self) -> float:
        return sum(one.max_score for one in self.questions)

    def total(self, automatic_only: bool = False) -> tuple[float, float]:
        """Points without what a late submission loses, and their maximum."""
        got = self.automatic if automatic_only else round(sum(one.score or 0.0 for one in self.questions), 4)
        return max(0.0, got - self.penalty), self.automatic_max if automatic_only else self.maximum

    def summary(self, automatic_only: bool = False) -> str:
        """The result in one line, in words of ours alone."""
        got, most = self.total(automatic_only)
        parts = [f"{points(got)} of {points(most)} points"]
        if self.penalty:
            parts.append(f"{points(self.penalty)} points are taken off because it was late")
        for one in self.questions:
            if one.state != "correct" and not (one.by_hand and (automatic_only or one.score is None)):
                words = STATE_WORDS[one.state] + "".join(f", {name}" for name in one.misconceptions)
                parts.append(f"{one.name}: {words} ({points(one.score or 0.0)} of {points(one.max_score)})")
        return clean_text("; ".join(parts) + ".")


@dataclass
class Given:
    """What was written, what there is to say about it, and who was left out and why."""

    files: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def leave_out(self, result: Result, why: str) -> None:
        self.left_out.append(f"{result.student} {result.assignment}: {why}")


def graded_from(grades: Path, submitted: Path | None) -> list[Path]:
    """The folders of submissions that were graded into `grades`, the last one last; or `submitted` alone, if it is given.

    Raises: GiveBackError if that is no folder."""
    if submitted is None:
        return [path for path in sources.read(grades) if path.is_dir()]
    if not submitted.is_dir():
        raise GiveBackError(f"{submitted}: no such folder. Give the folder that was graded, or leave --submitted out.")
    return [submitted]


def collected_in(folders: Iterable[Path]) -> dict[tuple[str, str], Handed]:
    """As `collected.read`. Raises: GiveBackError for a damaged list."""
    try:
        return collected.read(folders)
    except ValueError as error:
        raise GiveBackError(str(error)) from None


def load(grades: Path, submitted: Path | None, db_url: str | None = None, only: Sequence[str] = ()) -> tuple[list[Result], Given]:
    """All final results in `grades`, and a `Given` that names those that are not final.

    Raises: GiveBackError if nothing was graded there, or an assignment of `only` was not.
    """
    handed = collected_in(graded_from(grades, submitted))
    try:
        verdicts = read_all(grades / "verdicts")
    except ValueError as error:
        raise GiveBackError(str(error)) from None
    database = Path(db_url.removeprefix("sqlite:///")) if db_url and db_url.startswith("sqlite:///") else grades / "gradebook.db"
    if db_url and db_url.startswith("sqlite:///") and not database.is_file():
        raise GiveBackError(f"--db-url: there is no gradebook {database}; name the one that `course grade` wrote")
    if not verdicts or not (db_url or database.is_file()):
        raise GiveBackError(
            f"{grades}: nothing was graded into this folder. Run `course grade` first, or name its folder with --out."
        )
    unknown = set(only) - {verdict.assignment for verdict in verdicts}
    if unknown:
        known = ", ".join(sorted({verdict.assignment for verdict in verdicts}))
        raise GiveBackError(f"nothing of {', '.join(sorted(unknown))} was graded in {grades}; there is {known}")
    try:
        writer = GradebookWriter(db_url or f"sqlite:///{(grades / 'gradebook.db').resolve()}")
    except UnusableURL as error:
        raise GiveBackError(str(error)) from None
    with writer as book:
        marks = book.marks()
        rows = {(row["student_id"], row["assignment"]): row for row in book.grades()}
    results, given = [], Given()
    for verdict in verdicts:
        key = (verdict.student, verdict.assignment)
        if only and verdict.assignment not in only:
            continue
        if verdict.status not in FINAL:
            given.left_out.append(f"{verdict.student} {verdict.assignment}: {_why_not(verdict)}")
        elif key not in marks:
            given.left_out.append(
                f"{verdict.student} {verdict.assignment}: not an assignment of this course, so there is no grade"
            )
        else:
            results.append(_result(verdict, marks[key], rows[key], handed.get(key)))
    graded = {(verdict.student, verdict.assignment) for verdict in verdicts}
    for student, assignment in sorted(handed.keys() - graded):
        if not only or assignment in only:
            given.left_out.append(f"{student} {assignment}: collected, but not graded yet (`course grade`)")
    return results, given


def _why_not(verdict: Verdict) -> str:
    if verdict.status == "needs_review":
        return (
            f"needs review, its points are provisional (`course accept {verdict.student} {verdict.assignment}` makes them final)"
        )
    return "the grader failed on it, there are no points (grade again)"


def _result(verdict: Verdict, marks: list[Mark], row: Mapping[str, Any], handed: Handed | None) -> Result:
    scores = {mark.cell: mark for mark in marks}
    questions = []
    for item in verdict.items:
        by_hand = item.state == "manual"
        mark = scores.get(item.exercise if by_hand else f"test_{item.exercise}")
        score = (mark.score if mark else None) if by_hand else item.score if mark is None or mark.score is None else mark.score
        questions.append(Question(item.exercise, by_hand, score, item.max_score, item.state, item.misconceptions, item.message))
    given = [mark.score for mark in marks if mark.question]
    total = None if None in given or not given else sum(score for score in given if score is not None)
    return Result(
        replace(verdict, manual_score=total),
        tuple(questions),
        tuple(marks),
        row["late_submission_penalty"],
        person(row, handed),
        handed,
    )


def by_assignment(results: Iterable[Result]) -> dict[str, list[Result]]:
    """The results of each assignment, by student."""
    groups: dict[str, list[Result]] = {}
    for result in sorted(results, key=lambda one: (one.assignment, one.student)):
        groups.setdefault(result.assignment, []).append(result)
    return groups


def the_assignment(results: Iterable[Result], worksheet: Path) -> list[Result]:
    """The results of the only assignment that there is: a worksheet belongs to one. Raises GiveBackError if there are several."""
    groups = by_assignment(results)
    if len(groups) > 1:
        raise GiveBackError(
            f"{worksheet} is of one assignment, and {', '.join(groups)} were graded: say which, as in --only ch44"
        )
    return next(iter(groups.values()), [])


def matched(
    results: Iterable[Result],
    rows: Mapping[int, Iterable[str]],
    names: Callable[[Result], Iterable[str]],
    given: Given,
    cure: str,
) -> dict[int, Result]:
    """Row → result, where exactly one row answers to one of a result's names, taken in turn; others are left out, and named."""
    places: dict[str, list[int]] = {}
    for number, keys in rows.items():
        for key in {key for key in keys if key}:
            places.setdefault(key, []).append(number)
    found: dict[int, Result] = {}
    for result in results:
        numbers: list[int] = next((places[name] for name in names(result) if name in places), [])
        if len(numbers) != 1:
            given.leave_out(result, f"{'no row' if not numbers else f'{len(numbers)} rows'} of the worksheet {cure}")
        elif numbers[0] in found:
            given.leave_out(result, f"its row of the worksheet is already that of {found[numbers[0]].student}")
        else:
            found[numbers[0]] = result
    return found
