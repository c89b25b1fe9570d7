"""The trusted side: run a submission in a sandbox, send inputs, receive arrays, compare them here, and write the verdict.

What the learner's process says is data: it is parsed strictly, compared with expectations that never leave this process, and whatever
it does wrong (hangs, exits, talks nonsense) costs the exercise at hand and nothing else.
"""

from __future__ import annotations

import functools
import hashlib
import re
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import course_lib
from autograder import checks
from autograder.authoring import artefacts, assemble, chapter, freeze
from autograder.authoring.spec import Artefact
from autograder.grading import flights, intake
from autograder.grading.sandbox import Sandbox, SandboxDied, SandboxError, SandboxGarbage, SandboxTimeout
from autograder.grading.verdicts import Item, Verdict, clean_text
from autograder.paths import ROOT
from course_lib.checks.artefact import FrozenArtefact
from course_lib.checks.cases import FrozenExercise, Observation, decode, encode
from course_lib.checks.diagnosis import Finding, diagnose, view
from course_lib.checks.notebook import is_check, is_live

WORKER = Path(__file__).with_name("worker.py")
COURSE_LIB = Path(course_lib.__file__).parent
START_SECONDS = 120.0  # importing torch on a busy machine; nothing of the learner's has run by then
GRACE_SECONDS = 5.0  # how much longer the judge waits than the worker's own timer
MAX_TEXT = 4 << 20  # bytes of a worker's answer that are not numbers; honest ones have a hundredth of it
SLACK_SECONDS = 10.0  # for starting sandboxes, on top of (exercises + 1) * timeout


class WorkerFailed(RuntimeError):
    """Our own process inside the sandbox did not come up: no fault of the learner's."""


@dataclass(frozen=True)
class Released:
    """What the judge knows of an assignment, all of it from the release and nothing from a submission."""

    assignment: str
    exercises: tuple[FrozenExercise | FrozenArtefact, ...]
    open_questions: tuple[tuple[str, float], ...]
    grade_ids: frozenset[str]
    live_sources: frozenset[str]
    live_ids: frozenset[str]
    environment: str


_PREPARING = threading.Lock()


@functools.cache
def assignments() -> frozenset[str]:
    """The assignments that there are."""
    return frozenset(page.assignment for page in chapter.all_chapters())


def released(assignment: str) -> Released:
    """The release of an assignment, prepared once a process. Raises ValueError if there is no such chapter."""
    with _PREPARING:
        return _released(assignment)


@functools.cache
def _released(assignment: str) -> Released:
    page = chapter.load(assignment)
    outline = assemble.assignment(page)
    exercises = tuple(
        artefacts.hidden(exercise) if isinstance(exercise, Artefact) else freeze.complete(exercise)
        for exercise in checks.exercises(assignment)
    )
    names = {exercise.name for exercise in exercises}
    tests = {f"test_{name}" for name in names}
    questions = {name for name, _ in outline.open_questions}
    live = [cell for cell in assemble.student_view(page).cells if cell.cell_type == "code" and is_live(cell)]
    return Released(
        assignment,
        exercises,
        tuple(outline.open_questions),
        frozenset(names | tests | questions),
        frozenset(_squeezed(cell.source) for cell in live),
        frozenset(cell.id for cell in live),
        environment(),
    )


@functools.cache
def environment() -> str:
    """sha256 of the pins, the checks, the references and the code that judges: what a score depends on beside the submission."""
    folders = ("autograder", "solutions", "course_lib")
    files = [ROOT / "requirements.txt", ROOT / "constraints.txt"] + [
        p for folder in folders for p in (ROOT / folder).rglob("*.py")
    ]
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def judge(submission: intake.Submission, release: Released, timeout: float = 60.0, trusted: bool = False) -> Verdict:
    """Grade one submission.

    Args:
      submission: as read by intake; a submission without a notebook is a student_error.
      release: the assignment.
      timeout: seconds for each exercise, and for loading the notebook.
      trusted: run without a sandbox; for one's own code only.

    Returns: a final verdict (graded, needs_review or student_error).
    Raises: SandboxUnavailable or WorkerFailed, if our own machinery fails.
    """
    start = time.monotonic()
    flags = list(submission.flags)
    if submission.notebook is None:
        findings = [
            Finding(exercise.name, "error", 0.0, exercise.points, message=submission.problem) for exercise in release.exercises
        ]
        status = "student_error"
    else:
        tampered = tampering(submission.notebook, release)
        flags += tampered
        run = _Run(submission, release, timeout, trusted)
        found = run.findings()
        flags += run.flags
        for artefact in release.exercises:
            if isinstance(artefact, FrozenArtefact):
                found[artefact.name], receipts = flights.judge(artefact, submission.folder, timeout)
                flags = receipts + flags  # first, as the list of flags is cut at its end
        findings = [found[exercise.name] for exercise in release.exercises]
        status = "needs_review" if tampered else "graded"
    items = [Item(f.exercise, f.score, f.max_score, f.state, tuple(f.misconceptions), clean_text(f.message)) for f in findings]
    items += [Item(name, 0.0, points, "manual") for name, points in release.open_questions]
    return Verdict.of(
        Verdict(
            student=submission.student,
            assignment=submission.assignment,
            status=status,
            score=round(sum(f.score for f in findings), 4),
            max_score=round(sum(f.max_score for f in findings), 4),
            manual_max_score=sum(points for _, points in release.open_questions),
            items=tuple(items),
            flags=tuple(flags),
            seconds=round(time.monotonic() - start, 3),
            environment=release.environment,
        )
    )


def unknown_assignment(submission: intake.Submission) -> Verdict:
    """The verdict on a folder whose name is no assignment of the course."""
    flags = ("unknown_assignment", *submission.flags)
    return Verdict.of(
        Verdict(submission.student, submission.assignment, "student_error", 0.0, 0.0, flags=flags, environment=environment())
    )


def tampering(notebook: Any, release: Released) -> list[str]:
    """Released cells that are missing or stand twice; a person must look at such a notebook."""
    found = intake.grade_ids(notebook)
    missing = [f"missing_cell: {name}" for name in sorted(release.grade_ids) if not found[name]]
    twice = [f"duplicate_cell: {name}" for name in sorted(release.grade_ids) if found[name] > 1]
    return missing + twice


def runnable(notebook: Any, release: Released) -> list[tuple[int, str]]:
    """The (number, source) of the code cells that are the learner's to run: not the checks, and nothing that the release marks live."""
    cells = []
    for number, cell in enumerate((cell for cell in notebook.cells if cell.cell_type == "code"), start=1):
        is_answer = cell.metadata.get("nbgrader", {}).get("solution") is True
        if is_answer or not (is_check(cell) or _is_released_live(cell, release)):
            cells.append((number, cell.source))
    return cells


def _is_released_live(cell: Any, release: Released) -> bool:
    """A copy of a live cell keeps its tag, and may hold a learner's helpers: the tag counts only where the cells' ids are lost."""
    if _squeezed(cell.source) in release.live_sources:
        return True
    return cell.id in release.live_ids if "id" in cell else is_live(cell)


def _squeezed(source: str) -> str:
    return "".join(source.split())


@dataclass
class _Run:
    """One submission's way through as many sandboxes as it takes: a fresh one whenever the last was lost."""

    submission: intake.Submission
    release: Released
    timeout: float
    trusted: bool
    flags: list[str] = field(default_factory=list)

    def findings(self) -> dict[str, Finding]:
        """What was found for every exercise that is judged by calling it, by name."""
        exercises = [exercise for exercise in self.release.exercises if isinstance(exercise, FrozenExercise)]
        self._cells = runnable(self.submission.notebook, self.release)
        self._loading_failures: dict[str, str] = {}
        self._reserved = 0
        self._apart = False  # each exercise in a sandbox of its own, with the cells up to its definition and none after it
        self._deadline = time.monotonic() + (len(exercises) + 1) * self.timeout + SLACK_SECONDS
        found: dict[str, Finding] = {}
        pending = list(exercises)
        while pending and time.monotonic() < self._deadline:
            with self._sandbox() as sandbox:
                self._wait_until_ready(sandbox)
                if not self._load(sandbox, pending):
                    continue
                while pending:
                    exercise = pending.pop(0)
                    try:
                        found[exercise.name] = self._ask(sandbox, exercise)
                    except SandboxTimeout:
                        found[exercise.name] = self._timed_out(exercise)
                        break
                    except (SandboxError, ValueError) as error:
                        if isinstance(error, SandboxDied) and self._may_be_a_later_cells_doing(exercise):
                            self._apart = True
                            pending.insert(0, exercise)
                            break
                        found[exercise.name] = _failed(exercise, "error", f"The call ended the process: {error}.")
                        break
                    if self._apart:
                        break
        return {exercise.name: found.get(exercise.name) or self._timed_out(exercise) for exercise in exercises}

    @contextmanager
    def _sandbox(self) -> Iterator[Sandbox]:
        with ExitStack() as stack:
            try:
                sandbox = stack.enter_context(Sandbox(WORKER, [COURSE_LIB], self.submission.files, trusted=self.trusted))
            except ValueError as error:  # files that changed after intake had looked at them
                self.flags.append(f"ignored_files: {error}")
                sandbox = stack.enter_context(Sandbox(WORKER, [COURSE_LIB], trusted=self.trusted))
            yield sandbox

    @staticmethod
    def _wait_until_ready(sandbox: Sandbox) -> None:
        try:
            if decode(sandbox.receive(START_SECONDS)) != {"ready": True}:
                raise WorkerFailed("the worker did not say that it is ready")
        except (SandboxTimeout, SandboxDied, SandboxGarbage, ValueError) as error:
            raise WorkerFailed(f"the worker did not start: {error}") from error

    def _may_be_a_later_cells_doing(self, exercise: FrozenExercise) -> bool:
        """Whether a process that was lost in a call may be lost to what a cell after the definition left running in it."""
        return not self._apart and 0 <= _last_definition(exercise.name, self._cells) < len(self._cells) - 1

    def _cells_for(self, exercise: FrozenExercise) -> list[tuple[int, str]]:
        defined = _last_definition(exercise.name, self._cells)
        return self._cells[: defined + 1] if self._apart and defined >= 0 else self._cells

    def _load(self, sandbox: Sandbox, pending: list[FrozenExercise]) -> bool:
        """Run the learner's cells. If one hangs or ends the process, drop it, so that the next attempt goes round it."""
        running = None
        until = time.monotonic() + self._loading_time(pending)
        try:
            sandbox.send(encode({"cells": self._cells_for(pending[0])}), self._left(until))
            while time.monotonic() < until:
                told = _told(sandbox, self._left(until))
                if "loaded" in told:
                    self._loading_failures = {str(number): str(text) for number, text in _mapping(told["loaded"]).items()}
                    return True
                running = _number(told)
            raise SandboxTimeout("the cells are not done in time")
        except (SandboxError, ValueError) as error:
            self._drop(running, error, pending)
            return False

    def _loading_time(self, pending: list[FrozenExercise]) -> float:
        """`timeout`, but a further attempt must leave their own time to the exercises that were complete before the trouble."""
        return min(self.timeout, self._deadline - time.monotonic() - self.timeout * self._reserved)

    def _drop(self, running: int | None, error: Exception, pending: list[FrozenExercise]) -> None:
        if not self._cells:
            if isinstance(error, SandboxTimeout) and time.monotonic() >= self._deadline:
                return  # all of the submission's time is spent: that is its own doing
            raise WorkerFailed(f"the worker failed with nothing to run: {error}") from error
        numbers = [number for number, _ in self._cells]
        position = numbers.index(running) if running in numbers else len(numbers) - 1
        trouble = "did_not_finish" if isinstance(error, SandboxTimeout) else "ended_the_process"
        self.flags.append(f"cell_{numbers[position]}_{trouble}")
        later = [exercise for exercise in pending if _last_definition(exercise.name, self._cells) > position]
        earlier = [exercise for exercise in pending if exercise not in later]
        pending[:] = earlier + later  # what was complete before the trouble is judged first
        self._reserved = len(earlier)
        if self._loading_time(pending) < 1 or not later:
            del self._cells[position:]
        else:
            del self._cells[position]

    def _ask(self, sandbox: Sandbox, exercise: FrozenExercise) -> Finding:
        seconds = min(self.timeout, max(self._deadline - time.monotonic(), 0.1))
        cases = [case.call for case in exercise.cases]
        sandbox.send(encode({"exercise": exercise.name, "seconds": seconds, "cases": cases}), GRACE_SECONDS)
        patience = min(seconds + GRACE_SECONDS, max(self._deadline - time.monotonic(), 0.1) + 1)
        told = _told(sandbox, patience)
        if "observations" in told:
            seen = _observations(told["observations"], exercise)
            return diagnose(exercise, [view(case, one) for case, one in zip(exercise.cases, seen, strict=True)])
        if told.get("missing"):
            return self._missing(exercise)
        if told.get("ended") == "timeout":
            return self._timed_out(exercise)
        return _failed(exercise, "error", "The call ended its process.")

    def _missing(self, exercise: FrozenExercise) -> Finding:
        where = _last_definition(exercise.name, self._cells)
        number = str(self._cells[where][0]) if where >= 0 else ""
        if number in self._loading_failures:
            return _failed(exercise, "error", f"Code cell {number}, which defines it, stops: {self._loading_failures[number]}")
        return _failed(exercise, "not_implemented", f"The notebook defines no function {exercise.name}.")

    def _timed_out(self, exercise: FrozenExercise) -> Finding:
        return _failed(exercise, "timeout", f"No answer within {self.timeout:g} s.")

    @staticmethod
    def _left(until: float) -> float:
        return max(until - time.monotonic(), 0.01)


def _failed(exercise: FrozenExercise, state: str, message: str) -> Finding:
    return Finding(exercise.name, state, 0.0, exercise.points, message=message)


def _last_definition(name: str, cells: Sequence[tuple[int, str]]) -> int:
    """The position of the last cell that defines `name`, as text (a hostile cell is not worth parsing); -1 if none does."""
    # [ \t], for \s would run on over empty lines, from every one of them: a cell of nothing else would take for ever
    pattern = re.compile(rf"^[ \t]*(?:(?:async\s+)?def\s+{name}\s*\(|class\s+{name}\b|{name}\s*(?::[^=\n]*)?=[^=])", re.MULTILINE)
    return max((position for position, (_, source) in enumerate(cells) if pattern.search(source)), default=-1)


# -------------------------------------------------------------------------------- what comes out of the sandbox, strictly


def _told(sandbox: Sandbox, seconds: float) -> dict[str, Any]:
    return _mapping(decode(sandbox.receive(seconds), MAX_TEXT))


def _number(told: dict[str, Any]) -> int:
    number = told.get("running")
    if not isinstance(number, int):
        raise ValueError("the answer names no cell")
    return number


def _mapping(data: Any) -> dict[str, Any]:
    if not isinstance(data, dict):
        raise ValueError("the answer is no mapping")
    return data


def _observations(data: Any, exercise: FrozenExercise) -> list[Observation]:
    if not isinstance(data, list) or len(data) != len(exercise.cases):
        raise ValueError("the answer has not one observation for each case")
    return [_observation(entry) for entry in data]


def _observation(data: Any) -> Observation:
    seen = Observation(**{str(name): value for name, value in _mapping(data).items() if name in Observation.__dataclass_fields__})
    texts = (seen.error, seen.message, seen.kind)
    lists = (*_list(seen.graph), *_list(seen.mutated))
    arrays = (*_mapping(seen.outputs).values(), *(g for g in _mapping(seen.gradients).values() if g is not None))
    if not all(isinstance(text, str) for text in (*texts, *lists)):
        raise ValueError("the answer has something else where text belongs")
    if not all(isinstance(array, np.ndarray) and array.dtype.kind in "fiub" for array in arrays):
        raise ValueError("the answer has something else where numbers belong")
    return seen


def _list(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError("the answer has no list where one belongs")
    return value
