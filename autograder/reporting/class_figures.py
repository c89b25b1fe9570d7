"""What a class did, counted from its verdicts: how exercises went, which mistakes were made, what stopped notebooks, who needs help.

Of the verdicts only numbers are kept here, and the names of students in what is for their teacher alone. All texts (titles, mistakes' names
and messages, causes) come from the course: a learner can choose what a message or a flag says, and a folder's name.
"""

from __future__ import annotations

import builtins
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from autograder import checks
from autograder.authoring import chapter
from autograder.authoring.spec import Exercise
from autograder.grading.verdicts import Item, Verdict

OUTCOMES = {
    "all": "all points",
    "most": "half or more",
    "some": "under half",
    "none": "no points",
    "stopped": "stopped",
    "untried": "not tried",
}
TENTHS = ("0–20%", "20–40%", "40–60%", "60–80%", "80–100%")
FEW = 5  # fewer students than this are no group that a whole class should look at
MANY = 0.25  # of the notebooks: what hits so many is seldom theirs
SHOWN = 4  # exercises that are named beside a student

_HEADING = re.compile(r"^#{2,6} (.+)$", re.MULTILINE)
_CELL = re.compile(r"cell_(\d{1,4})_(stopped|did_not_finish|ended_the_process)(?:: line -?\d+, (\w+))?")
_ERRORS = frozenset(name for name, kind in vars(builtins).items() if isinstance(kind, type) and issubclass(kind, Exception))
_ENDINGS = {"did_not_finish": "did not finish in time", "ended_the_process": "ended its process"}
_BLAMELESS = {  # what many may share although nothing is broken
    "found_as": "the notebook had another name, or lay elsewhere",
    "no_time": "nobody knows when it was handed in",
    "acceptance_dropped": "another notebook was handed in after one had been accepted",
}
_FLAGS = _BLAMELESS | {
    "repaired": "cells were put right: copied, split, moved, or without their marks",
    "missing_cell": "an open question is missing",
    "duplicate_cell": "an open question stands twice",
    "could_not_compare": "an answer could not be compared with the right one",
    "newer_python": "a cell is written for a newer Python than the grader's",
    "other_kernel": "the notebook is not of Python",
    "other_chapter": "it is another chapter's notebook",
    "text_cell": "code stands in a cell of text",
    "ignored_file": "a file beside the notebook was not taken",
    "ignored_files": "files beside the notebook were not taken",
    "ignored_cells": "cells without type or text were left out",
    "the_courses_own_file": "the course's own file was handed in",
}
_STATUSES = {"student_error": "there was no notebook to grade", "infra_error": "the grader failed: grade again"}


# --- what the course says ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stub:
    """An exercise as the chapter announces it, and what learners read of each mistake."""

    name: str
    title: str
    number: int
    level: int
    minutes: int
    messages: Mapping[str, str]


@dataclass(frozen=True)
class Assignment:
    """A chapter of the course."""

    name: str
    title: str
    stubs: Mapping[str, Stub]


def of_course(names: Iterable[str]) -> list[Assignment]:
    """Those of the names that are chapters of this course, in its order."""
    numbers = {f"ch{number}": number for number in chapter.page_files()}
    return [_assignment(chapter.load(name)) for name in sorted(numbers.keys() & set(names), key=lambda name: numbers[name])]


def _assignment(page: chapter.Chapter) -> Assignment:
    messages = {
        one.name: {wrong.name: wrong.message for wrong in one.misconceptions}
        for one in checks.exercises(page.assignment)
        if isinstance(one, Exercise)
    }
    stubs: dict[str, Stub] = {}
    title = ""
    for cell in page.cells:
        if cell.kind == "markdown":
            title = (_HEADING.findall(cell.source) or [title])[-1]
        elif cell.exercise:
            known = messages.get(cell.exercise, {})
            stubs[cell.exercise] = Stub(cell.exercise, title, len(stubs) + 1, cell.difficulty, cell.minutes, known)
    return Assignment(page.assignment, f"{page.number}. {page.title}", stubs)


# --- how an assignment went --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mistake:
    """A named mistake, how many students made it, and where; what learners read is the same there."""

    name: str
    message: str
    students: int
    stubs: tuple[Stub, ...]


@dataclass
class ExerciseFigures:
    """How one exercise went."""

    stub: Stub
    counts: Counter[str] = field(default_factory=Counter)  # of OUTCOMES
    points: float = 0.0
    possible: float = 0.0

    @property
    def notebooks(self) -> int:
        """That have it."""
        return self.counts.total()

    @property
    def tried(self) -> int:
        """Those that have more than the stub."""
        return self.notebooks - self.counts["untried"]

    @property
    def solved(self) -> float:
        """The share of those who tried it that have all points."""
        return self.counts["all"] / self.tried if self.tried else 1.0

    @property
    def too_hard(self) -> bool:
        """Fewer than half of those who tried it have all points."""
        return self.tried >= FEW and self.solved < 0.5

    @property
    def left_out(self) -> bool:
        """Fewer than half tried it."""
        return self.notebooks >= FEW and 2 * self.tried < self.notebooks

    @property
    def broken(self) -> bool:
        """At least half of those who tried it were stopped, by an error or by the clock."""
        return self.counts["stopped"] >= FEW and 2 * self.counts["stopped"] >= self.tried

    @property
    def share(self) -> float:
        """Of the points."""
        return self.points / self.possible if self.possible else 0.0


@dataclass
class Figures:
    """How an assignment went. Exercises, mistakes and points are those of graded notebooks."""

    assignment: Assignment
    absent: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    exercises: list[ExerciseFigures] = field(default_factory=list)
    totals: Counter[str] = field(default_factory=Counter)  # of TENTHS
    mistakes: list[Mistake] = field(default_factory=list)  # the most common first
    causes: Counter[str] = field(default_factory=Counter)
    points: float = 0.0
    possible: float = 0.0
    unknown: int = 0  # outcomes of exercises and mistakes that the course no longer has

    @property
    def handed_in(self) -> int:
        """Submissions of any status."""
        return self.statuses.total()

    @property
    def graded(self) -> int:
        """Notebooks that count."""
        return self.statuses["graded"]

    @property
    def share(self) -> float:
        """Of the points."""
        return self.points / self.possible if self.possible else 0.0

    @property
    def too_hard(self) -> list[ExerciseFigures]:
        """The exercises that are, by the rule."""
        return [one for one in self.exercises if one.too_hard]

    @property
    def suspicions(self) -> list[tuple[str, int, int]]:
        """What points at the release rather than at students: what, in how many notebooks, of how many."""
        blameless = set(_BLAMELESS.values())
        found = [
            (cause, count, self.handed_in)
            for cause, count in ordered(self.causes)
            if cause not in blameless and count >= max(FEW, MANY * self.handed_in)
        ]
        return found + [
            (f"{one.stub.name} stopped, with an error or at the time limit", one.counts["stopped"], one.notebooks)
            for one in self.exercises
            if one.broken
        ]


def ordered(counts: Mapping[str, int]) -> list[tuple[str, int]]:
    """The largest count first, equal ones by name."""
    return sorted(counts.items(), key=lambda one: (-one[1], one[0]))


def figures(verdicts: Iterable[Verdict], students: int) -> list[Figures]:
    """How each assignment of the course went, in the course's order; `students` are in the class."""
    by_name: dict[str, list[Verdict]] = defaultdict(list)
    for verdict in verdicts:
        by_name[verdict.assignment].append(verdict)
    return [_figures(one, by_name[one.name], students) for one in of_course(by_name)]


def _figures(assignment: Assignment, verdicts: Sequence[Verdict], of_class: int) -> Figures:
    result = Figures(assignment, of_class - len(verdicts))
    exercises = {name: ExerciseFigures(stub) for name, stub in assignment.stubs.items()}
    made: dict[tuple[str, str], set[str]] = defaultdict(set)  # a mistake's name and message → students
    where: dict[tuple[str, str], set[str]] = defaultdict(set)  # → exercises
    for verdict in verdicts:
        result.statuses[verdict.status] += 1
        result.causes.update(causes(verdict))
        if verdict.status != "graded":
            continue
        result.points, result.possible = result.points + verdict.score, result.possible + verdict.max_score
        if verdict.max_score:
            result.totals[TENTHS[min(4, int(5 * verdict.score / verdict.max_score + 1e-9))]] += 1
        for item in verdict.automatic:
            if item.exercise not in exercises:
                result.unknown += 1
                continue
            one = exercises[item.exercise]
            one.counts[outcome(item)] += 1
            one.points, one.possible = one.points + item.score, one.possible + item.max_score
            for name in item.misconceptions:
                if name in one.stub.messages:
                    made[name, one.stub.messages[name]].add(verdict.student)
                    where[name, one.stub.messages[name]].add(item.exercise)
                else:
                    result.unknown += 1
    mistakes = [
        Mistake(*key, len(students), tuple(stub for name, stub in assignment.stubs.items() if name in where[key]))
        for key, students in made.items()
    ]
    result.mistakes = sorted(mistakes, key=lambda one: (-one.students, one.stubs[0].number, one.name))
    result.exercises = sorted(
        exercises.values(), key=lambda one: (not one.too_hard, not one.left_out, one.solved, one.stub.number)
    )
    return result


def outcome(item: Item) -> str:
    """Which of OUTCOMES."""
    if item.state == "partial":
        return "most" if 2 * item.score >= item.max_score else "some"
    return {"correct": "all", "wrong": "none", "not_implemented": "untried"}.get(item.state, "stopped")


def causes(verdict: Verdict) -> set[str]:
    """What came between the learner and the points, in our words: of a flag only its kind, a cell's number and a built-in error's name."""
    found = {_STATUSES[verdict.status]} if verdict.status in _STATUSES else set()
    for flag in verdict.flags:
        if cell := _CELL.match(flag):
            number, how, error = cell.groups()
            ending = _ENDINGS.get(how) or f"stopped with {error if error in _ERRORS else 'an error'}"
            found.add(f"code cell {int(number)} {ending}")
        elif words := _FLAGS.get(flag.partition(":")[0]):
            found.add(words)
    return found


# --- who needs help: for the teacher alone -----------------------------------------------------------------------------------

Row = tuple[str, str, str]  # student, assignment or number, what there is to say


@dataclass
class People:
    """Students by name."""

    review: list[Row] = field(default_factory=list)
    ungraded: list[Row] = field(default_factory=list)  # the grader failed
    unreadable: list[Row] = field(default_factory=list)
    nothing: list[str] = field(default_factory=list)
    missing: list[Row] = field(default_factory=list)
    few_points: list[Row] = field(default_factory=list)


def people(
    verdicts: Iterable[Verdict],
    students: Iterable[str],
    course: Sequence[Figures],
    shown: Mapping[str, str] = MappingProxyType({}),
) -> People:
    """Who needs help.

    Args:
      verdicts: sorted by student.
      students: everybody in the class.
      course: the assignments' figures.
      shown: student → the name to show beside the folder's.
    """
    names = [one.assignment.name for one in course]
    expected = [one.assignment.name for one in course if one.handed_in >= one.absent]
    result = People()
    by_student: dict[str, dict[str, Verdict]] = {student: {} for student in sorted(students)}
    for verdict in verdicts:
        by_student.setdefault(verdict.student, {})[verdict.assignment] = verdict
    behind: list[tuple[float, Row]] = []
    gaps: list[tuple[int, Row]] = []
    for student, handed_in in by_student.items():
        name = shown.get(student, student)
        label = student if name == student else f"{student} ({name})"
        for verdict in handed_in.values():
            why = [flag for flag in verdict.flags if not flag.startswith("handed_in: ")]
            if verdict.status == "student_error":
                why = list(dict.fromkeys(item.message for item in verdict.automatic if item.message)) or why
            row = (label, verdict.assignment, "; ".join(why[:3]))
            groups = {"needs_review": result.review, "infra_error": result.ungraded, "student_error": result.unreadable}
            if verdict.status in groups:
                groups[verdict.status].append(row)
        if not any(one in handed_in for one in names):
            result.nothing.append(label)
            continue
        if missing := [one for one in expected if one not in handed_in]:
            gaps.append((len(missing), (label, str(len(missing)), ", ".join(missing))))
        graded = [verdict for verdict in handed_in.values() if verdict.status == "graded" and verdict.max_score]
        possible = sum(verdict.max_score for verdict in graded)
        if graded and (share := sum(verdict.score for verdict in graded) / possible) < 0.5:
            failed = [item.exercise for one in graded for item in one.automatic if outcome(item) not in ("all", "untried")]
            more = f" and {len(failed) - SHOWN} more" if len(failed) > SHOWN else ""
            said = f"{', '.join(failed[:SHOWN])}{more}" if failed else "nothing tried"
            behind.append((share, (label, f"{share:.0%}", said)))
    result.missing = [row for _, row in sorted(gaps, key=lambda one: (-one[0], one[1]))]
    result.few_points = [row for _, row in sorted(behind)]
    return result
