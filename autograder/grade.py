"""Grade a folder of submissions: judge them side by side, and let one writer put down verdicts, gradebook and reports.

Running again over the same or other submissions converges: every file is replaced atomically, scores given by hand stay, students who
are not in the folder keep what they have, and what a killed run left undone is done by the next.
"""

from __future__ import annotations

import difflib
import fcntl
import functools
import hashlib
import json
import os
import socket
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import nbformat
from nbformat import NotebookNode

from autograder.authoring import assemble, chapter
from autograder.grading import deadlines, forking, intake, judge, names, sandbox, sources, verdicts
from autograder.grading.deadlines import UNKNOWN, Deadlines, HandedIn, Rule
from autograder.grading.verdicts import Verdict
from autograder.proving import side_by_side

if TYPE_CHECKING:
    from autograder.reporting.gradebook import Acceptance, GradebookWriter

Task = tuple[str, str, Path]
Judged = tuple[Verdict, NotebookNode | None]
FINGERPRINT = "submission"  # key of a judged notebook's metadata
ATTEMPTS = 2  # a submission whose sandbox failed on our side is tried once more


class GradingError(ValueError):
    """Nothing can be graded; the message says what to do."""


def grade(
    submitted: Path,
    out: Path,
    jobs: int = 1,
    scheduler: str | None = None,
    timeout: float = 60.0,
    db_url: str | None = None,
    trusted: bool = False,
    progress: Callable[[int, int, str], None] = lambda done, total, name: None,
    due: Path | None = None,
    left_over: Callable[[str], None] = lambda line: None,
    wall: str = "bubblewrap",
) -> list[Verdict]:
    """Grade `submitted/{student}/{assignment}/{assignment}.ipynb` into `out`.

    Args:
      submitted: the folder of submissions.
      out: where everything is written; also nbgrader's course folder.
      jobs: submissions judged at a time on this machine.
      scheduler: address of a Dask scheduler whose workers share this file system; replaces `jobs`.
      timeout: seconds for each exercise, and for loading a notebook.
      db_url: nbgrader's gradebook, `sqlite:///out/gradebook.db` by default.
      trusted: no sandbox. For one's own code only.
      progress: called with (done, total, "student/assignment") after each submission.
      due: due dates, see `grading.deadlines`; by default those in `submitted`, which `course collect` puts there.
      wall: what the sandbox is made of, one of sandbox.WALLS.
      left_over: called with a line for each thing in `submitted` that was not understood: what was seen, and what it would take.

    Returns: the verdicts of this run, sorted by student and assignment.
    Raises: GradingError if there is nothing to grade, or `db_url` is none; sandbox.SandboxUnavailable if no sandbox can be had;
      side_by_side.NoScheduler if there is no scheduler, or none any more; OtherWorker if a worker lacks the files or has other checks;
      OSError or SQLAlchemyError if a disk or a database refuses.
    """
    tasks = _tasks(submitted, left_over)
    rules = _deadlines(submitted, due)
    wanted = {assignment for _, assignment, _ in tasks} & judge.assignments()
    with ThreadPoolExecutor(1) as early:  # freezing the checks takes a second or two, in which the sandbox is tried
        for name in wanted:
            early.submit(judge.released, name)
        if not trusted:
            if not scheduler and wall == "bubblewrap":
                forking.course.begin()
            sandbox.require(wall)
    out.mkdir(parents=True, exist_ok=True)
    _try_database(db_url)
    judging = _on_dask(tasks, scheduler, timeout, wall) if scheduler else _here(tasks, jobs, timeout, trusted, wall)
    with _one_run_at_a_time(out), judging as judged:
        sources.remember(out, submitted)
        return _write_all(tasks, judged, out, db_url, progress, rules)


def _try_database(db_url: str | None) -> None:
    """One that a teacher has named may refuse, which is better told before anything is judged."""
    if not db_url:
        return
    from autograder.reporting import database

    try:
        database.try_it(db_url)
    except database.UnusableURL as error:
        raise GradingError(str(error)) from None


def _deadlines(submitted: Path, due: Path | None) -> Deadlines:
    default = submitted / deadlines.FILE
    path = due or (default if default.is_file() else None)
    try:
        return deadlines.load(path, judge.assignments()) if path else Deadlines()
    except deadlines.DeadlineError as error:
        raise GradingError(str(error)) from None


def _write_all(
    tasks: list[Task],
    judged: Iterator[Judged],
    out: Path,
    db_url: str | None,
    progress: Callable[[int, int, str], None],
    rules: Deadlines,
) -> list[Verdict]:
    """Write everything down, as the verdicts come in."""
    from autograder.reporting import (  # nbgrader takes seconds to import, in which the first submissions are judged
        exports,
        gradebook,
    )

    graded = {assignment for _, assignment, _ in tasks} & judge.assignments()
    releases = {name: judge.released(name).notebook for name in sorted(graded)}
    gradebook.write_course(out, releases, db_url)
    folders = {(student, assignment): folder for student, assignment, folder in tasks}
    results = []
    with gradebook.GradebookWriter(db_url or _default_database(out)) as book:
        for name, release in releases.items():
            _register(book, name, release, rules.rules.get(name))
        for verdict, notebook in judged:
            handed_in, verdict = _handed_in(verdict, folders, rules)
            results.append(_write(verdict, notebook, out, book, releases, handed_in))
            progress(len(results), len(tasks), f"{verdict.student}/{verdict.assignment}")
        try:
            exports.write_all(out, book, results)
        except ValueError as error:  # a verdict file that somebody has damaged
            raise GradingError(str(error)) from None
    return sorted(results, key=lambda verdict: (verdict.student, verdict.assignment))


def judge_folder(
    student: str, assignment: str, folder: Path, timeout: float, trusted: bool = False, wall: str = "bubblewrap"
) -> Judged:
    """Judge one submission, wherever this runs; our own failures become infra_error after a second attempt.

    Any exception is ours, and must not cost the others their grades.
    """
    if assignment not in judge.assignments():
        return judge.unknown_assignment(intake.Submission(student, assignment, folder)), None
    submission = intake.Submission(student, assignment, folder)
    release = judge.released(assignment)
    failure: Exception | None = None
    for _ in range(ATTEMPTS):
        try:
            submission = intake.read(student, assignment, folder)
            verdict = judge.judge(submission, release, timeout, trusted, wall)
            if submission.notebook is not None:
                submission.notebook.metadata[FINGERPRINT] = submission.fingerprint
            return verdict, submission.notebook
        except Exception as error:
            failure = error
    return _infra_error(submission, release, failure), submission.notebook


def _infra_error(submission: intake.Submission, release: judge.Released, failure: BaseException | None) -> Verdict:
    total = round(sum(exercise.points for exercise in release.exercises), 4)
    manual = sum(points for _, points in release.open_questions)
    flags = (*submission.flags, f"grader_failed: {type(failure).__name__}: {failure}")
    return Verdict.of(
        Verdict(
            submission.student,
            submission.assignment,
            "infra_error",
            0.0,
            total,
            None,
            manual,
            flags=flags,
            environment=release.environment,
        )
    )


def _tasks(submitted: Path, left_over: Callable[[str], None]) -> list[Task]:
    if not submitted.is_dir():
        raise GradingError(f"{submitted}: no such folder. Give the folder that holds STUDENT/ASSIGNMENT/ASSIGNMENT.ipynb.")
    survey = intake.survey(submitted, judge.assignments())
    if survey.wrong_level or not survey.tasks:
        seen = "".join(f"\n  {line}" for line in _few(survey.left_over))
        raise GradingError(
            f"{submitted}: no submissions in it. Expected STUDENT/ASSIGNMENT/ASSIGNMENT.ipynb, nbgrader's layout.{seen}"
        )
    for line in _few(survey.left_over):
        left_over(line)
    return survey.tasks


def _few(lines: list[str]) -> list[str]:
    lines = [" ".join(verdicts.clean_text(line, 500).split("\n")) for line in lines]  # file names, which may hold anything
    more = len(lines) - intake.SHOWN
    return lines if more <= 0 else [*lines[: intake.SHOWN], f"… and {more} more"]


def _handed_in(verdict: Verdict, folders: dict[tuple[str, str], Path], rules: Deadlines) -> tuple[HandedIn, Verdict]:
    """When a submission came in; where nobody can tell, the verdict gets a flag."""
    folder = folders.get((verdict.student, verdict.assignment))
    if folder is None:
        return UNKNOWN, verdict
    try:
        return deadlines.handed_in(folder, verdict.student, verdict.assignment, rules), verdict
    except ValueError as error:
        return UNKNOWN, replace(verdict, flags=(f"no_time: {error}", *verdict.flags))


def _register(book: GradebookWriter, assignment: str, released: NotebookNode, rule: Rule | None = None) -> None:
    try:
        book.register(assignment, released, rule.due if rule else None)
    except ValueError as error:  # a cell that was withdrawn holds a score given by hand
        raise GradingError(f"{assignment}: {error}") from None


@contextmanager
def _here(tasks: list[Task], jobs: int, timeout: float, trusted: bool, wall: str) -> Iterator[Iterator[Judged]]:
    """Judge on this machine, from the moment of entering, in threads: a verdict is made mostly by waiting."""
    pool = ThreadPoolExecutor(jobs)  # bubblewrap dies with the thread that started it, and these live to the end
    futures = [pool.submit(judge_folder, *task, timeout, trusted, wall) for task in tasks]
    try:
        yield (future.result() for future in as_completed(futures))
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _on_dask(tasks: list[Task], scheduler: str, timeout: float, wall: str) -> Iterator[Iterator[Judged]]:
    """Judge on the workers of a Dask scheduler, which must see the same files and have the same course."""
    handed = [(student, assignment, folder.resolve(), _content(folder)) for student, assignment, folder in tasks]
    function = functools.partial(_judge_elsewhere, environment=judge.environment(), timeout=timeout, wall=wall)

    def judged() -> Generator[Judged]:
        for one in side_by_side.run(function, handed, scheduler=scheduler):
            if one.result:
                yield one.result
            elif isinstance(one.error, OtherWorker):
                raise one.error
            else:  # workers died of it
                student, assignment, folder, _ = one.item
                yield _not_judged(student, assignment, folder, one.error)

    with closing(judged()) as verdicts_of_workers:
        yield verdicts_of_workers


class OtherWorker(RuntimeError):
    """What a worker would say of this submission is worth nothing."""


def _judge_elsewhere(task: tuple[str, str, Path, str], environment: str, timeout: float, wall: str = "bubblewrap") -> Judged:
    """Judge, on a worker. One with another file system would find nothing handed in, one with other checks would pay other points."""
    student, assignment, folder, content = task
    worker = f"the Dask worker on {socket.gethostname()}"
    if judge.environment() != environment:
        raise OtherWorker(f"{worker} has another version of the course: install the same everywhere")
    if _content(folder) != content:
        raise OtherWorker(f"{worker} does not see the files in {folder}: it must share this folder")
    return judge_folder(student, assignment, folder, timeout, wall=wall)


def _content(folder: Path) -> str:
    """The names in a submission's folder, in short; "" if there is none."""
    try:
        return hashlib.sha256("\0".join(sorted(os.listdir(folder))).encode(errors="surrogateescape")).hexdigest()
    except OSError:
        return ""


def _not_judged(student: str, assignment: str, folder: Path, failure: BaseException | None) -> Judged:
    submission = intake.Submission(student, assignment, folder)
    if assignment not in judge.assignments():
        return judge.unknown_assignment(submission), None
    return _infra_error(submission, judge.released(assignment), failure), None


def _write(
    verdict: Verdict,
    notebook: NotebookNode | None,
    out: Path,
    book: GradebookWriter,
    releases: dict[str, NotebookNode],
    handed_in: HandedIn = UNKNOWN,
) -> Verdict:
    """Gradebook first, then the notebook that formgrader shows, then the verdict, which says that the rest is done."""
    from autograder.reporting import gradebook

    pending = _pending(out, verdict.student, verdict.assignment)
    if verdict.assignment in releases:
        verdict = _with_acceptance(verdict, notebook, book.accepted(verdict.student, verdict.assignment))
        if verdict.status == "needs_review" and notebook is not None:
            verdicts.write_atomically(pending, json.dumps(notebook, indent=1) + "\n")
        previous = gradebook.read_autograded(out, verdict.student, verdict.assignment)
        book.record(verdict, notebook, previous, handed_in)
        gradebook.write_autograded(out, releases[verdict.assignment], notebook, verdict)
        given, maximum = book.manual_scores(verdict.student, verdict.assignment)
        verdict = replace(verdict, manual_score=given, manual_max_score=maximum)
    verdicts.write(out / "verdicts", verdict)
    if verdict.status != "needs_review":
        pending.unlink(missing_ok=True)
    return verdict


# -------------------------------------------------------------------------------- provisional scores made final


def accept(
    student: str,
    assignment: str,
    out: Path,
    by: str,
    because: str = "",
    db_url: str | None = None,
    due: Path | None = None,
) -> Verdict:
    """Make the provisional score of a submission that needs review final, and keep who did so, when and why.

    It holds for this very submission: graded again unchanged it stays accepted, and another one of the same student is reviewed anew.

    Args:
      student, assignment: whose, and which.
      out: the folder that `grade` wrote.
      by, because: who says so, and why.
      db_url, due: the gradebook and the due dates, as given to `grade`.

    Returns: the final verdict.
    Raises: GradingError, with what to do, if there is no provisional score.
    """
    from autograder.reporting import exports, gradebook

    student = names.label(student)
    if not (out / "verdicts").is_dir():
        raise GradingError(f"{out}: no verdicts there. Give the folder that `course grade` wrote, by --out.")
    with _one_run_at_a_time(out):
        verdict, notebook = _provisional(out, student, assignment)
        release = assemble.for_learners(chapter.load(assignment))
        said = gradebook.Acceptance(
            student,
            assignment,
            str(notebook.metadata.get(FINGERPRINT, "")),
            verdicts.clean_text(by) or "somebody",
            datetime.now(UTC).strftime("%Y-%m-%d"),
            verdicts.clean_text(because),
        )
        with gradebook.GradebookWriter(db_url or _default_database(out)) as book:
            _register(book, assignment, release)
            book.accept(said)
            verdict = _write(verdict, notebook, out, book, {assignment: release}, _in_time(verdict, out, due))
            exports.write_all(out, book)
    return verdict


def _in_time(verdict: Verdict, out: Path, due: Path | None) -> HandedIn:
    """When it came in, if what was graded into `out` is still there."""
    for submitted in reversed(sources.read(out)):
        folder = submitted / verdict.student / verdict.assignment
        if folder.is_dir():
            return _handed_in(verdict, {(verdict.student, verdict.assignment): folder}, _deadlines(submitted, due))[0]
    return UNKNOWN


def _provisional(out: Path, student: str, assignment: str) -> tuple[Verdict, NotebookNode]:
    """The verdict that waits for a person, and the notebook that it is about."""
    path = out / "verdicts" / student / f"{assignment}.json"
    if not path.parent.is_dir():
        known = sorted(one.name for one in (out / "verdicts").iterdir() if one.is_dir())
        close = difflib.get_close_matches(student, known, 1)
        raise GradingError(f"{out} has no verdict on a student {student!r}" + (f"; did you mean {close[0]!r}?" if close else "."))
    if not path.is_file():
        known = sorted(one.stem for one in path.parent.glob("[!.]*.json"))
        raise GradingError(
            f"{out} has no verdict on {student}'s {assignment!r}; there is one on {', '.join(known) or 'nothing'}."
        )
    verdict = verdicts.from_json(path.read_text(encoding="utf-8"))
    where = f"{student}/{assignment}"
    if verdict.status == "infra_error":
        raise GradingError(f"{where} was not graded (infra_error): grade it again.")
    if verdict.status != "needs_review":
        raise GradingError(f"{where} is final already: {verdict.status}, {verdict.score:g} of {verdict.max_score:g}.")
    pending = _pending(out, student, assignment)
    if not pending.is_file():
        raise GradingError(f"{where}: the notebook that waits for review is not in {pending.parent}: grade it again first.")
    return verdict, nbformat.from_dict(json.loads(pending.read_text(encoding="utf-8")))


def _pending(out: Path, student: str, assignment: str) -> Path:
    """Where a notebook waits for a person's word."""
    return out / "review" / student / f"{assignment}.ipynb"


def _with_acceptance(verdict: Verdict, notebook: NotebookNode | None, said: Acceptance | None) -> Verdict:
    """The verdict, final if a person has accepted this submission; flagged, if it was another one."""
    if said is None or verdict.status == "infra_error":
        return verdict
    verdict = replace(verdict, flags=tuple(flag for flag in verdict.flags if not flag.startswith("acceptance_dropped: ")))
    if notebook is None or notebook.metadata.get(FINGERPRINT) != said.submission:
        dropped = f"acceptance_dropped: {said.accepted_by} accepted another submission on {said.accepted_on}"
        return replace(verdict, flags=(dropped, *verdict.flags))
    if verdict.status != "needs_review":
        return verdict
    because = f", because {said.reason}" if said.reason else ""
    note = f"accepted: by {said.accepted_by} on {said.accepted_on}{because}"
    return replace(verdict, status="graded", flags=(note, *verdict.flags))


def _default_database(out: Path) -> str:
    return f"sqlite:///{(out / 'gradebook.db').resolve()}"


@contextmanager
def _one_run_at_a_time(out: Path) -> Iterator[None]:
    """Wait for another run on the same folder; the kernel gives the lock back when a run is killed."""
    descriptor = os.open(out / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
