"""The trusted side: run a submission in a sandbox, send inputs, receive arrays, compare them here, and write the verdict.

What the learner's process says is data: it is parsed strictly, compared with expectations that never leave this process, and whatever
it does wrong (hangs, exits, talks nonsense) costs the exercise at hand and nothing else.
"""

from __future__ import annotations

import functools
import hashlib
import re
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from nbformat import NotebookNode

from autograder import checks
from autograder.authoring import artefacts, assemble, chapter, contract, freeze
from autograder.authoring.spec import Artefact, Exercise, Tuning
from autograder.grading import flights, forking, intake, repair
from autograder.grading.attempts import Attempt, Past, plan, share, suspect
from autograder.grading.sandbox import Sandbox, SandboxDied, SandboxError, SandboxGarbage, SandboxTimeout, SandboxUnavailable
from autograder.grading.verdicts import Item, Verdict, clean_text
from autograder.paths import COURSE_LIB, ROOT
from course_lib.checks.artefact import FrozenArtefact
from course_lib.checks.cases import FrozenExercise, Observation
from course_lib.checks.diagnosis import Finding, begin_with, diagnose, view
from course_lib.checks.names import WORD
from course_lib.checks.notebook import NAMED, Stop, is_check, is_live
from course_lib.checks.notebook import needed as needed_stops
from course_lib.checks.stored import decode, encode
from course_lib.checks.tuning import FrozenTuning, judged

WORKER = Path(__file__).with_name("worker.py")
START_SECONDS = 120.0  # importing torch on a busy machine; nothing of the learner's has run by then
GRACE_SECONDS = 5.0  # how much longer the judge waits than the worker's own timer
MAX_TEXT = 4 << 20  # bytes of a worker's answer that are not numbers; honest ones have a hundredth of it
SLACK_SECONDS = 10.0  # for starting sandboxes, on top of (exercises + 1) * timeout
NOT_COMPARED = "could_not_compare"  # begins the flag of an answer that our comparison did not survive
NEWER = "newer_python"  # begins the flag of a cell whose syntax this Python does not know
PYTHON = f"{sys.version_info.major}.{sys.version_info.minor}"
MOST_CAUSES = 3  # that a message names
ENDINGS = {"did_not_finish": ("timeout", "did not finish in time"), "ended_the_process": ("error", "ended its process")}


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
    form: repair.Form = field(default_factory=repair.Form)
    notebook: NotebookNode = field(default_factory=NotebookNode)
    """As it was handed out."""


_PREPARING = threading.Lock()


@functools.cache
def assignments() -> frozenset[str]:
    """The assignments that there are."""
    return frozenset(f"ch{number}" for number in chapter.page_files())


def released(assignment: str) -> Released:
    """The release of an assignment, prepared once a process. Raises ValueError if there is no such chapter."""
    with _PREPARING:
        return _released(assignment)


@functools.cache
def _released(assignment: str) -> Released:
    page = chapter.load(assignment)
    sources = contract.sources(page, alone=True)
    outline = assemble.outline(page, sources)
    exercises = tuple(_frozen(exercise) for exercise in checks.exercises(assignment))
    names = {exercise.name for exercise in exercises}
    tests = {f"test_{name}" for name in names}
    questions = {name for name, _ in outline.open_questions}
    notebook = assemble.for_learners(page, sources=sources)
    live = [cell for cell in notebook.cells if cell.cell_type == "code" and is_live(cell)]
    return Released(
        assignment,
        exercises,
        tuple(outline.open_questions),
        frozenset(names | tests | questions),
        frozenset(repair.squeezed(cell.source) for cell in live),
        frozenset(cell.id for cell in live),
        environment(),
        repair.form(notebook),
        notebook,
    )


def _frozen(exercise: Exercise | Artefact | Tuning) -> FrozenExercise | FrozenArtefact:
    if isinstance(exercise, Tuning):
        return artefacts.trained_by_grader(exercise)
    return artefacts.hidden(exercise) if isinstance(exercise, Artefact) else freeze.complete(exercise)


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


def judge(
    submission: intake.Submission, release: Released, timeout: float = 60.0, trusted: bool = False, wall: str = "bubblewrap"
) -> Verdict:
    """Grade one submission.

    Args:
      submission: as read by intake; a submission without a notebook is a student_error. Its notebook is put right (see repair).
      release: the assignment.
      timeout: seconds for each exercise, and for loading the notebook.
      trusted: run without a sandbox; for one's own code only.
      wall: what the sandbox is made of, one of sandbox.WALLS.

    Returns: a final verdict (graded, needs_review or student_error).
    Raises: SandboxUnavailable or WorkerFailed, if our own machinery fails.
    """
    start = time.monotonic()
    flags = list(submission.flags)
    timings: dict[str, float] = {}
    if submission.notebook is None:
        findings = [
            Finding(exercise.name, "error", 0.0, exercise.points, message=submission.problem) for exercise in release.exercises
        ]
        status = "student_error"
    elif other := other_chapter(submission.notebook, release):
        flags.append(f"other_chapter: {other}")
        message = (
            f"This is chapter {other.removeprefix('ch')}'s notebook ({other}), handed in as {release.assignment}; "
            f"it holds none of the exercises of {release.assignment}."
        )
        findings = [Finding(one.name, "not_implemented", 0.0, one.points, message=message) for one in release.exercises]
        status = "needs_review"
    else:
        repaired = repair.repair(submission.notebook, release.form)
        submission.notebook = repaired.notebook
        flags += repaired.ambiguous + repaired.flags
        if not trusted and wall == "bubblewrap":
            forking.course.get()  # what it takes to start is nobody's time
        run = _Run(submission, release, timeout, trusted, wall)
        found = run.findings()
        flags += run.flags
        timings = run.timings
        for artefact in release.exercises:
            if isinstance(artefact, FrozenArtefact):
                began = time.monotonic()
                found[artefact.name], receipts = flights.judge(artefact, submission.folder, timeout)
                timings[artefact.name] = round(time.monotonic() - began, 3)
                flags = receipts + flags  # first, as the list of flags is cut at its end
        findings = [found[exercise.name] for exercise in release.exercises]
        uncompared = any(flag.startswith((NOT_COMPARED, NEWER)) for flag in run.flags)
        status = "needs_review" if repaired.ambiguous or uncompared else "graded"
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
            timings=timings,
        )
    )


def unknown_assignment(submission: intake.Submission) -> Verdict:
    """The verdict on a folder whose name is no assignment of the course."""
    flags = ("unknown_assignment", *submission.flags)
    return Verdict.of(
        Verdict(submission.student, submission.assignment, "student_error", 0.0, 0.0, flags=flags, environment=environment())
    )


def other_chapter(notebook: Any, release: Released) -> str:
    """The assignment whose notebook this is, if it holds cells or answers of that one and none of `release`; else ""."""
    found = set(intake.grade_ids(notebook))
    cells = [(number, cell.source) for number, cell in enumerate(notebook.cells) if cell.cell_type == "code"]
    if found & release.grade_ids or any(_last_definition(one.name, cells) >= 0 for one in release.exercises):
        return ""
    if not any(found & ids for ids in _graded_names().values()):  # the marks may be lost
        sources = [cell.source for cell in notebook.cells if len(cell.source) < MAX_TEXT]
        found = {name for ids in _graded_names().values() for name in ids if any(f"def {name}(" in source for source in sources)}
    likeness = {name: len(found & ids) for name, ids in _graded_names().items()}
    return max((name for name in likeness if likeness[name]), key=lambda name: likeness[name], default="")


@functools.cache
def _graded_names() -> dict[str, frozenset[str]]:
    """Assignment → the ids of the cells that answer its exercises and open questions."""
    return {
        page.assignment: frozenset(str(cell.exercise or cell.open_question) for cell in (*page.exercises, *page.open_questions))
        for page in chapter.all_chapters()
    }


def runnable(notebook: Any, release: Released) -> list[tuple[int, str]]:
    """The (number, source) of the code cells that are the learner's to run: not the checks, and nothing that the release marks live.

    Cell 0 is what was put back or has to come first; of a cell, what repair says, if it says anything.
    """
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    live = _released_live(code, release)
    before = notebook.get("metadata", {}).get(repair.FIRST)
    cells = [(0, before)] if before else []
    for number, cell in enumerate(code, start=1):
        source = cell.metadata.get(repair.AS_RUN, cell.source)
        is_answer = cell.metadata.get("nbgrader", {}).get("solution") is True
        if source is not None and (is_answer or not (is_check(cell) or number in live)):
            cells.append((number, source))
    return cells


def _released_live(code: Sequence[Any], release: Released) -> set[int]:
    """The numbers of the cells that were released as live, edited or not.

    A copy of one keeps its tag, and its id in some editors, and may hold a learner's helpers: only one cell is the released one.
    Where ids are lost, it is the one that is most of it.
    """
    sources = [repair.squeezed(cell.source) for cell in code]
    missing = [source for source in release.form.live.values() if repair.squeezed(source) not in sources]
    live = {number for number, source in enumerate(sources, start=1) if source in release.live_sources}
    taken = {code[number - 1].get("id") for number in live}
    for number, cell in enumerate(code, start=1):
        if number in live:
            continue
        if "id" in cell and cell.id in release.live_ids:
            if cell.id not in taken:
                taken.add(cell.id)
                live.add(number)
        elif "id" not in cell:
            of = next((one for one in missing if repair.resembles(cell.source, one)), None)
            if of is not None and (is_live(cell) or of.count("\n") > 3):
                missing.remove(of)
                live.add(number)
            elif is_live(cell) and not release.form.live:
                live.add(number)
    return live


class _Run:
    """One submission's way through as many sandboxes as it takes: a fresh one whenever the last was lost."""

    def __init__(
        self, submission: intake.Submission, release: Released, timeout: float, trusted: bool, wall: str = "bubblewrap"
    ) -> None:
        self.flags: list[str] = []
        self.timings: dict[str, float] = {}  # exercise → seconds spent in asking for it
        self._submission, self._timeout, self._trusted, self._wall = submission, timeout, trusted, wall
        self._exercises = {one.name: one for one in release.exercises if isinstance(one, FrozenExercise)}
        self._cells, self._live = with_live(submission.notebook, release)
        own = [(number, "" if position in self._live else source) for position, (number, source) in enumerate(self._cells)]
        self._defined = {name: _last_definition(name, own) for name in self._exercises}
        self._texts = (
            [cell.source for cell in submission.notebook.cells if cell.cell_type != "code"] if submission.notebook else []
        )
        self._saved_by = getattr(submission.notebook, "metadata", {}).get("language_info", {}).get("version", "")
        self._past = Past()
        self._found: dict[str, Finding] = {}
        self._stopped: dict[int, Stop] = {}  # position of a cell → what it raised first
        self._uses: dict[str, frozenset[str]] = {}  # exercise → the names of the notebook that its function uses
        self._troubles: dict[int, str] = {}  # position of a lost cell → how it was lost
        self._deadline = time.monotonic() + (len(self._exercises) + 1) * timeout + SLACK_SECONDS

    def findings(self) -> dict[str, Finding]:
        """What was found for every exercise that is judged by calling it, by name."""
        while (attempt := plan(self._defined, len(self._cells), self._past)) and self._left() > 0:
            if not (attempt.whole or attempt.definitions):
                break
            with self._sandbox() as sandbox:
                self._wait_until_ready(sandbox)
                if self._left() > 0 and self._load(sandbox, attempt):
                    self._ask_all(sandbox, attempt)
        found = {name: self._found.get(name) or self._never_asked(exercise) for name, exercise in self._exercises.items()}
        return {
            name: begin_with(self._with_causes(finding), [found[other] for other in found if other in self._uses.get(name, ())])
            for name, finding in found.items()
        }

    @contextmanager
    def _sandbox(self) -> Iterator[Sandbox]:
        with ExitStack() as stack:
            yield self._started(stack)

    def _started(self, stack: ExitStack) -> Sandbox:
        """A sandbox; without the submission's files if they are not what intake has seen, or if twice none starts with them."""
        for last in (False, True) if self._submission.files else ():
            try:
                return self._begun(stack, self._submission.files)
            except (ValueError, SandboxUnavailable) as error:
                if last or isinstance(error, ValueError):
                    problem = error
                    break
        sandbox = self._begun(stack, {})
        if self._submission.files:
            self._flag(f"ignored_files: {problem}")
        return sandbox

    def _begun(self, stack: ExitStack, files: Mapping[str, Path]) -> Sandbox:
        """Forked by this process's server; where that fails, begun anew, and by then it is not the submission that is to blame."""
        server = None if self._trusted or self._wall != "bubblewrap" else forking.course.get()
        if server is not None:
            try:
                return stack.enter_context(Sandbox(WORKER, [COURSE_LIB], files, server=server))
            except SandboxUnavailable as error:
                problem, unasked = str(error), isinstance(error.__cause__, forking.Refused)  # before it heard of the submission
        sandbox = stack.enter_context(Sandbox(WORKER, [COURSE_LIB], files, trusted=self._trusted, wall=self._wall))
        if server is not None and (unasked or not files):
            forking.course.refused(problem)
        return sandbox

    def _flag(self, text: str) -> None:
        if text not in self.flags:
            self.flags.append(text)

    @staticmethod
    def _wait_until_ready(sandbox: Sandbox) -> None:
        try:
            if decode(sandbox.receive(START_SECONDS)) != {"ready": True}:
                raise WorkerFailed("the worker did not say that it is ready")
        except (SandboxTimeout, SandboxDied, SandboxGarbage, ValueError) as error:
            raise WorkerFailed(f"the worker did not start: {error}") from error

    def _left(self) -> float:
        return self._deadline - time.monotonic()

    def _happened(self, **changes: Any) -> None:
        self._past = replace(self._past, **changes)

    # ------------------------------------------------------------------ running the cells

    def _load(self, sandbox: Sandbox, attempt: Attempt) -> bool:
        """Run the learner's cells. If one hangs or ends the process, it is lost, and the next attempt goes round it."""
        positions = sorted((*attempt.whole, *attempt.definitions))
        running = positions[0]
        numbers = {self._cells[position][0]: position for position in positions}
        until = time.monotonic() + share(self._left(), attempt.loading_spares, self._timeout)
        try:
            cells = [[*self._cells[position], self._how(position, attempt)] for position in positions]
            sandbox.send(encode({"cells": cells}), max(until - time.monotonic(), 0.01))
            while time.monotonic() < until:
                told = _told(sandbox, max(until - time.monotonic(), 0.01))
                if "loaded" in told:
                    stops = {numbers[int(number)]: _stop(said) for number, said in _mapping(told["loaded"]).items()}
                    self._stopped = {at: stop for at, stop in self._stopped.items() if at not in positions} | stops
                    return True
                running = numbers.get(_number(told), running)
            raise SandboxTimeout("the cells are not done in time")
        except (SandboxError, ValueError, KeyError) as error:
            trouble = "did_not_finish" if isinstance(error, SandboxTimeout) else "ended_the_process"
            self._troubles[running] = trouble
            self._flag(f"cell_{self._cells[running][0]}_{trouble}")
            self._happened(lost=(*self._past.lost, running))
            return False

    def _how(self, position: int, attempt: Attempt) -> str:
        if position in self._live:
            return "live"
        return "whole" if position in attempt.whole else "definitions"

    # ------------------------------------------------------------------ asking for the exercises

    def _ask_all(self, sandbox: Sandbox, attempt: Attempt) -> None:
        """Ask for the exercises of an attempt, until the sandbox is lost to one of them."""
        for later, name in zip(range(len(attempt.exercises) - 1, -1, -1), attempt.exercises, strict=True):
            exercise, lost, began = self._exercises[name], True, time.monotonic()
            try:
                finding = self._ask(sandbox, exercise, share(self._left(), later + attempt.spares, self._timeout))
                lost = False
            except SandboxTimeout:
                finding = self._timed_out(exercise)
            except (SandboxError, ValueError) as error:
                suspected = suspect(self._defined, len(self._cells), self._past, attempt, name)
                if isinstance(error, SandboxDied) and suspected:
                    self._past = suspected
                    return
                finding = _failed(exercise, "error", f"The call ended the process: {error}.")
            self._found[name] = finding
            self.timings[name] = round(self.timings.get(name, 0.0) + time.monotonic() - began, 3)
            if finding.state == "error" and not attempt.complete:
                self._happened(tried=self._past.tried | {name})
            else:
                self._happened(found=self._past.found | {name})
            if lost or self._left() <= 0:
                return

    def _ask(self, sandbox: Sandbox, exercise: FrozenExercise, seconds: float) -> Finding:
        cases = [case.call for case in exercise.cases]
        seconds = max(seconds, 0.1)
        sandbox.send(encode({"exercise": exercise.name, "seconds": seconds, "cases": cases}), GRACE_SECONDS)
        told = _told(sandbox, min(seconds + GRACE_SECONDS, max(self._left(), 0.1) + 1))
        if "observations" in told:
            self._uses[exercise.name] = frozenset(map(str, _list(told.get("uses", []))))
            return self._compared(exercise, _observations(told["observations"], exercise))
        if told.get("missing") is True:  # a tensor has no truth of its own
            return self._missing(exercise)
        if told.get("ended") == "timeout":
            return self._timed_out(exercise)
        return _failed(exercise, "error", "The call ended its process.")

    def _compared(self, exercise: FrozenExercise, seen: list[Observation]) -> Finding:
        try:
            if isinstance(exercise, FrozenTuning) and exercise.train:
                # numbers in known ranges come from the sandbox; the training is ours
                return judged(exercise, seen[0], exercise.train)
            return diagnose(exercise, [view(case, one) for case, one in zip(exercise.cases, seen, strict=True)])
        except Exception as error:  # no answer, however odd, may end the grading; a person must look at this one
            self._flag(f"{NOT_COMPARED}: {exercise.name} ({type(error).__name__})")
            return _failed(exercise, "error", "The answer could not be compared with the right one; a person will look at it.")

    # ------------------------------------------------------------------ what to say where there is no answer

    def _missing(self, exercise: FrozenExercise) -> Finding:
        where = self._defined[exercise.name]
        if where in self._troubles:
            return self._lost_with_its_cell(exercise)
        if where in self._stopped:
            return _failed(exercise, "error", "The cell that defines it stops before.")
        return _failed(exercise, "not_implemented", f"The notebook defines no function {exercise.name}.")

    def _lost_with_its_cell(self, exercise: FrozenExercise) -> Finding:
        where = self._defined[exercise.name]
        state, ends = ENDINGS[self._troubles[where]]
        return _failed(exercise, state, f"Code cell {self._cells[where][0]}, which defines it, {ends}.")

    def _never_asked(self, exercise: FrozenExercise) -> Finding:
        if self._defined[exercise.name] in self._troubles or self._left() > 0:  # else no cell was left that could define it
            return self._missing(exercise)
        return self._timed_out(exercise)

    def _with_causes(self, finding: Finding) -> Finding:
        """The finding, naming the cells that stopped and that the answer needs; they become flags, too."""
        where = self._defined[finding.exercise]
        uses = self._uses.get(finding.exercise) or frozenset(WORD.findall(self._cells[where][1]) if where >= 0 else ())
        needed = needed_stops(self._stopped, finding.exercise, uses, finding.message)
        for at in needed:
            stop = self._stopped[at]
            self._flag(f"cell_{self._cells[at][0]}_stopped: line {stop.line}, {stop.error}")
        if finding.state != "error":
            return finding
        if not needed:
            texts = [f"{name} stands in a text cell, which does not run: make it a code cell" for name in self._in_texts(finding)]
            for text in texts:
                self._flag(f"text_cell: {text}")
            return replace(finding, message="; ".join([finding.message, *texts]))
        for at in needed:
            if newer := self._stopped[at].newer:
                self._flag(f"{NEWER}: cell {self._cells[at][0]} needs {newer}, graded with {PYTHON}")
        causes = [self._cause(at) for at in needed[:MOST_CAUSES]]
        return replace(finding, message="; ".join([finding.message.removesuffix("."), *causes]))

    def _in_texts(self, finding: Finding) -> list[str]:
        """The names that the message misses and that a cell of text defines."""
        missing = {name for found in NAMED.findall(finding.message) for name in found if name}
        return [name for name in sorted(missing) if any(_last_definition(name, [(0, text)]) == 0 for text in self._texts)]

    def _cause(self, position: int) -> str:
        number, stop = self._cells[position][0], self._stopped[position]
        if not stop.newer:
            return stop.said(number)
        told = re.match(r"3\.(\d+)", self._saved_by)
        newer = told is not None and int(told[1]) >= int(stop.newer.rpartition(".")[2])
        saved = f"Python {self._saved_by} saved the notebook" if newer else f"newer than {PYTHON}"
        return (
            f"code cell {number} is written for Python {stop.newer} ({saved}), and this is graded with Python {PYTHON}: "
            f"a person will look at it ({stop.error})"
        )

    def _timed_out(self, exercise: FrozenExercise) -> Finding:
        message = f"No answer within {self._timeout:g} s."
        for position, trouble in self._troubles.items():
            message += f" Code cell {self._cells[position][0]} {ENDINGS[trouble][1]}."
        return _failed(exercise, "timeout", message)


def with_live(notebook: Any, release: Released) -> tuple[list[tuple[int, str]], frozenset[int]]:
    """The cells to run, those that the release marks live among them, and the positions of these, which are never run as a whole."""
    own = runnable(notebook, release)
    numbers = {number for number, _ in own}
    code = enumerate((cell for cell in notebook.cells if cell.cell_type == "code"), start=1)
    live = [
        (number, cell.source)
        for number, cell in code
        if number not in numbers and not is_check(cell) and cell.metadata.get(repair.AS_RUN, "") is not None
    ]
    cells = sorted([*own, *live], key=lambda cell: cell[0])
    return cells, frozenset(position for position, (number, _) in enumerate(cells) if number not in numbers)


def _failed(exercise: FrozenExercise, state: str, message: str) -> Finding:
    return Finding(exercise.name, state, 0.0, exercise.points, message=message)


def _last_definition(name: str, cells: Sequence[tuple[int, str]]) -> int:
    """The position of the last cell that defines `name`, as text (a hostile cell is not worth parsing); -1 if none does."""
    imports = rf"(?:from[ \t]+\S+[ \t]+)?import[ \t][^\n]*\b{name}\b"
    pattern = re.compile(rf"^[ \t]*{repair.PROMPT}(?:{repair.defining(name)}|{imports})", re.MULTILINE)
    return max((position for position, (_, source) in enumerate(cells) if pattern.search(source)), default=-1)


# -------------------------------------------------------------------------------- what comes out of the sandbox, strictly


def _told(sandbox: Sandbox, seconds: float) -> dict[str, Any]:
    return _mapping(decode(sandbox.receive(seconds), MAX_TEXT))


def _number(told: dict[str, Any]) -> int:
    number = told.get("running")
    if not isinstance(number, int):
        raise ValueError("the answer names no cell")
    return number


def _stop(data: Any) -> Stop:
    seen = _mapping(data)
    line, error, newer = seen.get("line"), seen.get("error"), seen.get("newer")
    if not (isinstance(line, int) and isinstance(error, str) and isinstance(newer, str) and re.fullmatch(r"(3\.\d\d)?", newer)):
        raise ValueError("the answer has something else where a cell's failure belongs")
    return Stop(line, error, tuple(map(str, _list(seen.get("sets")))), newer)


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
    if not all(isinstance(array, torch.Tensor) and not array.dtype.is_complex for array in arrays):
        raise ValueError("the answer has something else where numbers belong")
    return seen


def _list(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError("the answer has no list where one belongs")
    return value
