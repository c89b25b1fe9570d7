"""The `course` command."""

from __future__ import annotations

import atexit
import gc
import os
import sys
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, cast

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from autograder.authoring.assemble import Outputs
    from autograder.authoring.chapter import Chapter

# Each command imports what it needs: torch, nbgrader and Sphinx cost seconds, and `course --help` should not.

# jsonschema, which reads notebooks, would make a parser of web addresses, for two seconds; it does without, as do notebooks.
sys.modules.setdefault("rfc3987_syntax", cast(ModuleType, None))

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False, help=__doc__)
OK, LOW_SCORES, BAD_INPUT, BROKEN, LEFT_OVER = 0, 1, 2, 3, 4
err = Console(stderr=True, highlight=False, soft_wrap=True)


def _stop(message: object, status: int = BAD_INPUT) -> None:
    err.print(f"course: {message}", markup=False)
    raise typer.Exit(status)


def _recorded(page: Chapter) -> Outputs | None:
    """A chapter's outputs in the book, if its notebook shows any; they come from the cache, or the chapter is run."""
    from autograder.publishing import execution

    return execution.executed_outputs(page) if any("book-only" in cell.tags for cell in page.cells) else None


@app.command()
def book(
    without_solutions: Annotated[
        bool, typer.Option("--without-solutions", help="Leave the folded reference solutions out.")
    ] = False,
) -> None:
    """Build the HTML book into book/_build/html."""
    from autograder.publishing import book as builder

    try:
        print(f"The book is at {builder.build(with_solutions=not without_solutions) / 'index.html'}")
    except (builder.BookError, ValueError) as error:
        _stop(error, 1)


@app.command()
def page(
    name: Annotated[str, typer.Argument(metavar="CHAPTER", help="As in ch44.")],
    without_solutions: Annotated[
        bool, typer.Option("--without-solutions", help="Leave the folded reference solutions out.")
    ] = False,
) -> None:
    """Build the page of one chapter, into book/_build/page, and say which file to open: for whoever writes it."""
    from autograder.publishing import page as builder
    from autograder.publishing.execution import BookError

    try:
        print(f"The page is at {builder.shown(builder.build(name, with_solutions=not without_solutions))}")
    except (BookError, ValueError) as error:
        _stop(error, 1)


@app.command()
def new(
    number: Annotated[int, typer.Argument(min=1, help="The chapter's number.")],
    title: Annotated[str, typer.Argument(help="Its title.")],
    exercises: Annotated[list[str], typer.Argument(help="The names of its functions.")],
) -> None:
    """Begin a chapter: solutions, checks, page and tests, with TODO wherever something is missing. Nothing is overwritten."""
    from autograder.authoring import skeleton

    try:
        for path in skeleton.write(number, title, exercises):
            print(os.path.relpath(path))
    except (ValueError, OSError) as error:
        _stop(error)


@app.command()
def release(
    out: Annotated[Path, typer.Option(help="Where the bundle goes.")] = Path("release"),
    only: Annotated[list[str] | None, typer.Option(help="Release this chapter only, as in --only ch44; may be repeated.")] = None,
) -> None:
    """Write the student bundle: notebooks, course_lib, and a zip of it all. Never overwrites a learner's work."""
    from autograder.publishing import release as releaser

    try:
        print(f"The bundle is at {releaser.release(out, only, recorded=_recorded)}")
    except (ValueError, LookupError, OSError) as error:
        _stop(error)


@app.command()
def hub(folder: Annotated[Path, typer.Argument(help="A new or existing folder for nbgrader's course.")]) -> None:
    """Lay out a course for plain nbgrader: source notebooks with solutions and hidden tests, and its configuration. For teachers only."""
    from autograder import checks, paths
    from autograder.authoring import freeze
    from autograder.publishing import release as releaser

    try:
        freeze.write(
            checks.all_exercises(), paths.COURSE_LIB / "frozen"
        )  # the check cells need them in the teacher's environment, too
        print(f"nbgrader's course is at {releaser.write_nbgrader_course(folder, recorded=_recorded)}")
    except (ValueError, OSError) as error:
        _stop(error)


@app.command()
def check(notebook: Annotated[Path, typer.Argument(help="A student notebook.")]) -> None:
    """Run the visible checks of one notebook, in this process: for your own code."""
    from autograder import checks
    from autograder.authoring import assemble, chapter, freeze
    from course_lib.checks import client, command

    text = notebook.read_bytes().decode(errors="replace") if notebook.is_file() else ""  # what is wrong with it, `main` says
    asked = [exercise for exercise in checks.all_exercises() if f"check({exercise.name})" in text or f'"{exercise.name}"' in text]
    freeze.write(asked, client.FROZEN)
    for page in chapter.all_chapters():
        outline = assemble.outline(page)
        freeze.write_cells(outline.id, outline.exercises, outline.open_questions, client.FROZEN)
    raise typer.Exit(command.main([str(notebook)]))


class Wall(StrEnum):
    """What stands between a learner's code and the machine: grading.sandbox.WALLS."""

    bubblewrap = "bubblewrap"
    gvisor = "gvisor"


@app.command()
def collect(
    downloads: Annotated[
        list[Path], typer.Argument(metavar="DOWNLOAD…", help="Folders or zips, as the platform hands them out.")
    ],
    into: Annotated[Path, typer.Option(metavar="SUBMITTED", help="Where STUDENT/ASSIGNMENT/ASSIGNMENT.ipynb is laid out.")],
    assignment: Annotated[str | None, typer.Option(help="As in ch44; by default the notebooks' names say it.")] = None,
    names: Annotated[
        Path | None, typer.Option(help="A CSV: a column student, and id, login, email or name; or a roster.")
    ] = None,
    due: Annotated[Path | None, typer.Option(help="A YAML file of due dates, extensions and a penalty for late work.")] = None,
    platform: Annotated[
        str | None,
        typer.Option("--from", help="canvas, moodle, gradescope, blackboard, github or nbgrader, if it is not recognised."),
    ] = None,
    pattern: Annotated[
        str | None, typer.Option(help="A regular expression for other names, as nbgrader's named_regexp: student_id, file_id, …")
    ] = None,
    best: Annotated[
        bool, typer.Option("--best", help="Of several attempts keep the best, by grading them, not the last.")
    ] = False,
    timeout: Annotated[float, typer.Option(min=0.1, help="With --best: seconds for each exercise.")] = 60.0,
    wall: Annotated[Wall, typer.Option(help="With --best: as in `course grade`.")] = Wall.bubblewrap,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be collected, and write nothing.")] = False,
) -> None:
    """Lay out what a learning platform lets you download, for `course grade`. Nothing is overwritten: earlier attempts are kept.

    Exit status: 0 all was understood, 2 bad input, 3 the grader failed (--best), 4 collected, but some of it was not understood.
    """
    from autograder.platforms import attempts, collect, roster
    from autograder.platforms import downloads as formats

    if platform and platform not in formats.PLATFORMS:
        _stop(f"--from {platform}: take one of {', '.join(formats.PLATFORMS)}")
    from autograder.grading import deadlines, sandbox

    try:
        judge, environment = collect.grader(timeout, wall.value) if best and not dry_run else (None, str)
        done = collect.collect(downloads, into, assignment, names, due, platform, pattern, judge, environment, dry_run)
    except (
        collect.CollectError, roster.RosterError, deadlines.DeadlineError, attempts.BrokenIndex, sandbox.SandboxUnavailable,
    ) as error:  # fmt: skip
        _stop(error)
    except RuntimeError as error:
        _stop(f"{error}; collect again: what was handed in is kept", BROKEN)
    except OSError as error:
        _stop(f"the submissions cannot be written: {error}. What is written is whole; mend this and collect again.", BROKEN)
    Console(highlight=False).print(collect.table(done))
    for line in done.notes:
        print(line)
    print(collect.summary(done, into, dry_run), flush=True)
    for line in done.problems:
        err.print(f"course: not understood: {line}", markup=False)
    if done.problems:
        raise typer.Exit(LEFT_OVER)


@app.command()
def similar(
    submitted: Annotated[Path, typer.Argument(help="The folder that holds STUDENT/ASSIGNMENT/ASSIGNMENT.ipynb.")],
    assignment: Annotated[str | None, typer.Option(help="Of this assignment only, as in ch44.")] = None,
    out: Annotated[Path | None, typer.Option(help="Also write the list as a CSV, with the shared passages.")] = None,
    at_least: Annotated[float, typer.Option(min=0.05, max=1.0, help="List pairs that are so much alike.")] = 0.6,
) -> None:
    """List pairs of submissions that are alike beyond the release and the known right answers: a list to look at, not a verdict."""
    from autograder.platforms import similar

    try:
        pairs, problems = similar.find(submitted, assignment, at_least)
        if out:
            similar.write(out, pairs)
    except similar.SimilarError as error:
        _stop(error)
    except OSError as error:
        _stop(f"--out {out}: {error.strerror}")
    print(similar.NOT_A_VERDICT)
    if pairs:
        Console(highlight=False).print(similar.table(pairs))
    print(similar.summary(pairs, at_least), flush=True)
    for line in problems:
        err.print(f"course: {line}", markup=False)
    if problems:
        raise typer.Exit(LEFT_OVER)


@app.command()
def grade(
    submitted: Annotated[Path, typer.Argument(help="The folder that holds STUDENT/ASSIGNMENT/ASSIGNMENT.ipynb.")],
    out: Annotated[Path, typer.Option(help="Where verdicts, tables, reports and the gradebook go.")] = Path("grades"),
    jobs: Annotated[int, typer.Option(min=1, help="Submissions judged at a time.")] = os.cpu_count() or 1,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler, tcp://…, instead of --jobs.")] = None,
    timeout: Annotated[float, typer.Option(min=0.1, help="Seconds for each exercise, and for loading a notebook.")] = 60.0,
    db_url: Annotated[
        str | None,
        typer.Option(help="nbgrader's gradebook, such as postgresql://me@host/course; sqlite:///OUT/gradebook.db by default."),
    ] = None,
    fail_under: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, help="Exit with 1 if a submission scores less than this share.")
    ] = None,
    due: Annotated[
        Path | None, typer.Option(help="A YAML file of due dates, extensions and a penalty; SUBMITTED/.due.yml by default.")
    ] = None,
    wall: Annotated[
        Wall, typer.Option(help="What the sandbox is made of; `course doctor` says which this machine has.")
    ] = Wall.bubblewrap,
    trust_submissions: Annotated[
        bool,
        typer.Option("--trust-submissions", help="Run WITHOUT a sandbox. For your own code only: it can do all that you can."),
    ] = False,
) -> None:
    """Grade all submissions in a folder. Exit status: 0 all have a verdict, 1 below --fail-under, 2 bad input, 3 the grader
    failed, 4 something in the folder was not understood; what was seen stands on standard error."""
    from autograder.grading import forking

    if trust_submissions and wall is not Wall.bubblewrap:
        _stop(f"--trust-submissions puts up no wall, so there is no {wall} to be had with it: leave one of them out")
    if submitted.is_dir() and wall is Wall.bubblewrap and not (trust_submissions or scheduler):
        forking.course.begin()  # before anything here loads torch: the two take seconds, on a processor each

    from sqlalchemy.exc import SQLAlchemyError

    from autograder import grade
    from autograder.grading import sandbox
    from autograder.proving.side_by_side import NoScheduler
    from autograder.reporting import database

    left: list[str] = []
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    # away from a terminal it would leave an empty line
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task("grading", total=None)
        try:
            results = grade.grade(
                submitted, out, jobs, scheduler, timeout, db_url, trust_submissions,
                lambda done, total, name: bar.update(task, completed=done, total=total), due, left.append, wall=wall.value,
            )  # fmt: skip
        except (grade.GradingError, sandbox.SandboxUnavailable) as error:
            bar.stop()
            _stop(error)
        except (NoScheduler, grade.OtherWorker) as error:
            bar.stop()
            _stop(f"{error}. What is graded is kept; mend this and grade again.", BROKEN)
        except (OSError, SQLAlchemyError) as error:  # a full disk, most likely; Python's own exit status would mean low scores
            bar.stop()
            _stop(
                f"the grades cannot be written: {database.why(error)}. What is written is whole; mend this and grade again.",
                BROKEN,
            )
    from autograder.grading import verdicts
    from autograder.reporting import exports

    Console(highlight=False).print(exports.table(results))
    for line in exports.same_files(verdicts.read_all(out / "verdicts")):  # also of students who are absent this time
        print(line)
    print(f"Grades are in {out}")
    for line in left:
        err.print(f"course: not understood: {line}", markup=False)
    if any(verdict.status == "infra_error" for verdict in results):
        _stop("some submissions could not be graded (infra_error): grade again; `course doctor` looks for the cause", BROKEN)
    low = [v for v in results if fail_under and (v.score < fail_under * v.max_score or not v.max_score)]
    if low:
        _stop(f"{len(low)} of {len(results)} submissions score under {fail_under:.0%}", LOW_SCORES)
    if left:
        _stop(f"the grades are written, but something in {submitted} was not understood (above)", LEFT_OVER)


@app.command()
def accept(
    student: Annotated[str, typer.Argument(help="Whose submission, as `course grade` names it.")],
    assignment: Annotated[str, typer.Argument(help="Which, as in ch44.")],
    out: Annotated[Path, typer.Option(help="The folder that `course grade` wrote.")] = Path("grades"),
    by: Annotated[str, typer.Option(help="Who says so; your login by default.")] = "",
    because: Annotated[str, typer.Option(help="Why.")] = "",
    db_url: Annotated[str | None, typer.Option(help="nbgrader's gradebook, as given to `course grade`.")] = None,
    due: Annotated[Path | None, typer.Option(help="Due dates, as given to `course grade`.")] = None,
) -> None:
    """Make the provisional score of a submission that needs review final. It holds until another one is handed in."""
    import getpass

    from sqlalchemy.exc import SQLAlchemyError

    from autograder import grade
    from autograder.reporting import database

    if not by:
        try:
            by = getpass.getuser()
        except (KeyError, OSError):  # a container without names
            by = "somebody"
    try:
        verdict = grade.accept(student, assignment, out, by, because, db_url, due)
    except (grade.GradingError, ValueError) as error:
        _stop(error)
    except (OSError, SQLAlchemyError) as error:
        _stop(
            f"the grades cannot be written: {database.why(error)}. What is written is whole; mend this and accept again.", BROKEN
        )
    print(f"{verdict.student}/{verdict.assignment}: {verdict.score:g} of {verdict.max_score:g} is final, accepted by {by}")


class Platform(StrEnum):
    """Where `course return` gives back to."""

    canvas = "canvas"
    moodle = "moodle"
    gradescope = "gradescope"
    classroom50 = "classroom50"
    nbgrader = "nbgrader"


@app.command("return")
def give_back(
    to: Annotated[Platform, typer.Option(help="The learning platform.")] = Platform.canvas,
    out: Annotated[Path, typer.Option(help="The folder that `course grade` wrote.")] = Path("grades"),
    submitted: Annotated[
        Path | None,
        typer.Option(help="The folder that was graded, where `course collect` says who is who; by default what OUT was made of."),
    ] = None,
    worksheet: Annotated[
        Path | None, typer.Option(help="Moodle's grading worksheet, or the gradebook as Canvas exports it: is filled in.")
    ] = None,
    into: Annotated[
        Path | None, typer.Option(help="Where the files go: OUT/return; for nbgrader OUT, its course folder.")
    ] = None,
    only: Annotated[list[str] | None, typer.Option(help="Of this assignment only, as in --only ch44; may be repeated.")] = None,
    automatic: Annotated[
        bool, typer.Option("--automatic", help="Moodle: automatic points alone, without those by hand.")
    ] = False,
    db_url: Annotated[
        str | None,
        typer.Option(help="nbgrader's gradebook, such as postgresql://me@host/course; sqlite:///OUT/gradebook.db by default."),
    ] = None,
    trust_submissions: Annotated[
        bool,
        typer.Option("--trust-submissions", help="Gradescope: an archive that grades WITHOUT a sandbox. For your own code only."),
    ] = False,
) -> None:
    """Write what a learning platform takes: grades and feedback. Exit status: 0 all, 2 bad input, 3 cannot be written, 4 some left out."""
    from sqlalchemy.exc import SQLAlchemyError

    from autograder.platforms import give_back, returning
    from autograder.reporting import database

    request = returning.Request(out, submitted, into, worksheet, tuple(only or ()), db_url, automatic, trust_submissions)
    try:
        given = returning.give_back(to.value, request)
    except (give_back.GiveBackError, FileNotFoundError) as error:
        _stop(error)
    except (OSError, SQLAlchemyError) as error:
        _stop(
            f"the files cannot be written: {database.why(error)}. What is written is whole; mend this and return again.", BROKEN
        )
    for path in given.files[:50]:
        print(path)
    if len(given.files) > 50:
        print(f"… and {len(given.files) - 50} more files")
    for note in given.notes:
        print(note)
    for line in given.left_out:
        err.print(f"left out: {line}", markup=False)
    if given.left_out:
        _stop(f"{len(given.left_out)} left out; everything else is written", LEFT_OVER)


@app.command()
def experiment(
    name: Annotated[str | None, typer.Argument(help="The experiment; without it, all are listed with their state.")] = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, help="Seeds 0 to N - 1 of each variant; the experiment's own number by default.")
    ] = None,
    variant: Annotated[list[str] | None, typer.Option(help="Make this variant only; may be repeated.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Runs at a time, one core each.")] = os.cpu_count() or 1,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler, tcp://…, instead of --jobs.")] = None,
    out: Annotated[Path | None, typer.Option(help="Where the records go: experiments/runs by default.")] = None,
) -> None:
    """Make the records of long runs that are missing. Killed, it loses nothing: run it again. Exit status 3 if a run failed."""
    from collections import Counter

    from experiments import campaign

    folder = out or campaign.RUNS
    if name is None:
        print("\n".join(_state(one, folder) for one in campaign.names()))
        return
    try:
        todo = campaign.tasks(campaign.definition(name), variant or (), seeds, folder)
    except campaign.ExperimentError as error:
        _stop(error)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    outcomes = []
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        whole = bar.add_task(name, total=len(todo))
        bars: dict[tuple[str, int], TaskID] = {}

        def show(variant: str, seed: int, done: int, total: int) -> None:
            if (variant, seed) not in bars:
                bars[variant, seed] = bar.add_task(f"{variant}-{seed}")
            bar.update(bars[variant, seed], completed=done, total=total)

        try:
            for outcome in campaign.make(todo, jobs, scheduler, show):
                outcomes.append(outcome)
                bar.advance(whole)
                if (outcome.variant, outcome.seed) in bars:
                    bar.update(bars[outcome.variant, outcome.seed], visible=False)
                if outcome.state == "failed":
                    err.print(f"{outcome.variant}-{outcome.seed}: {outcome.error}", markup=False)
        except OSError as error:  # no scheduler there, or a full disk
            bar.stop()
            _stop(error, BROKEN)
    ends = Counter(outcome.state for outcome in outcomes)
    print(f"{name}: {', '.join(f'{count} {end}' for end, count in sorted(ends.items()))}. The records are in {folder / name}")
    if ends["failed"]:
        _stop("some runs failed: run again when that is mended; what is finished is kept", BROKEN)


def _state(name: str, folder: Path) -> str:
    """One experiment in a few lines: what it measures, and how many of its runs have a record."""
    from collections import Counter

    from experiments import campaign

    module = campaign.definition(name)
    found = Counter(campaign.state(task) for task in campaign.tasks(module, out=folder))
    counts = ", ".join(f"{count} {kind}" for kind, count in sorted(found.items()))
    return f"{name}: {(module.__doc__ or '').strip().splitlines()[0]}\n    {counts}"


@app.command()
def atlas(
    libraries: Annotated[
        list[str] | None, typer.Argument(metavar="[LIBRARY]…", help="As in stable-baselines3; without any, all of them.")
    ] = None,
    newer: Annotated[
        bool,
        typer.Option("--newer", help="Try the newest versions, and say what has changed since the record; nothing is written."),
    ] = False,
    environments: Annotated[
        Path | None,
        typer.Option(help="Keep the environments in this folder, and use them again; by default each goes when it has served."),
    ] = None,
) -> None:
    """Compute what other libraries make of the atlas's input, each in an environment of its own, and write their records.

    Exit status: 0 all computed, 1 some numbers follow no known rule, 2 bad input, 3 a library can't be installed or run.
    """
    from experiments.atlas import runner

    known = runner.names()
    if unknown := [name for name in libraries or () if name not in known]:
        _stop(f"no library {unknown[0]!r} in the atlas; there are: {', '.join(known)}")
    failed = unexplained = 0
    for name in dict.fromkeys(libraries or known):
        outcome = runner.run(name, newer, environments)
        failed += bool(outcome.error)
        unexplained += bool(outcome.unexplained)
        for line in runner.told(outcome):
            (err if outcome.error else Console(highlight=False, soft_wrap=True)).print(line, markup=False)
    if failed:
        _stop(f"{failed} of the libraries could not be run; their records are as they were", BROKEN)
    if unexplained:
        _stop("some numbers are neither the course's nor made by a rule of experiments/atlas/given.py", LOW_SCORES)


@app.command()
def prove(
    only: Annotated[list[str] | None, typer.Option(help="Of this chapter only, as in --only ch44; may be repeated.")] = None,
    exercise: Annotated[list[str] | None, typer.Option(help="This exercise, kept or not; may be repeated.")] = None,
    every: Annotated[bool, typer.Option("--all", help="Also what has a fitting record.")] = False,
    seeds: Annotated[
        int | None, typer.Option(min=1, help="Seeds 0 to N - 1; other than the full 50, a table is printed and nothing written.")
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes at a time, one core each.")] = os.cpu_count() or 1,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler, tcp://…, instead of --jobs.")] = None,
) -> None:
    """Prove that the checks reject and name every misconception and accept every variant, and keep the record that the book prints;
    and so with what the book's pages can judge themselves.

    Only what has no fitting record is proved. Exit status: 0 all proved, 1 something found, 2 bad input, 3 the machinery failed.
    """
    from autograder.proving import killmatrix
    from autograder.proving import prove as prover

    draws = range(seeds or killmatrix.SEEDS)
    writes = len(draws) == killmatrix.SEEDS
    try:
        wanted = prover.targets(only or (), exercise or (), every or not writes)
    except prover.UnknownName as error:
        _stop(error)
    on_pages = _judged_on_pages(only or (), every) if writes and not exercise else 0
    if not wanted:
        if not on_pages:
            print("Nothing to prove: every record fits (--all proves anew)")
        return
    keeper = prover.Keeper(wanted) if writes else None
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    outcomes = []
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task("proving", total=None)
        try:
            for outcome in prover.prove(
                wanted, draws, jobs, scheduler,
                lambda name, done, total: bar.update(task, description=name, completed=done, total=total),
            ):  # fmt: skip
                outcomes.append(outcome)
                if keeper:
                    keeper.keep(outcome)
                    found = len(outcome.findings) + len(outcome.broken)
                    state = f"{found} finding{'s' * (found > 1)}" if found else "proved"
                    err.print(f"{outcome.target.assignment} {outcome.target.exercise}: {state}", markup=False)
        except OSError as error:  # no scheduler there, or a full disk
            bar.stop()
            _stop(error, BROKEN)
    if not writes:
        outcomes.sort(key=lambda outcome: wanted.index(outcome.target))
        print("\n".join(prover.table([outcome.rows for outcome in outcomes if outcome.rows])))
    for line in [line for outcome in outcomes for line in outcome.findings + outcome.broken]:
        print(line)
    if any(outcome.broken for outcome in outcomes):
        _stop("some exercises could not be proved: run again; what is proved is kept", BROKEN)
    if any(outcome.findings for outcome in outcomes):
        _stop("some checks do not tell wrong from right; nothing is kept of these exercises", 1)


def _judged_on_pages(only: Sequence[str], every: bool) -> int:
    """Prove what pages can judge, and say what has changed. Returns how many exercises were proved."""
    from autograder import checks
    from autograder.proving import practice

    keys, proved = practice.Keys(), 0
    for assignment in [name for name in only or checks.assignments() if practice.has_page(name)]:
        for one in practice.prove(assignment, every, keys):
            err.print(f"{assignment} {one.exercise}, on its page: {one.reason or 'offered'}", markup=False)
            proved += 1
    return proved


@app.command()
def doctor() -> None:
    """Say what works on this machine, and how to mend what does not."""
    from autograder import doctor

    raise typer.Exit(doctor.report())


def main() -> None:
    """Entry point of the console script."""
    if (sys.stdout.encoding or "").lower() not in ("utf-8", "utf8"):
        from course_lib.checks.terminal import print_anything

        print_anything()
    atexit.register(gc.freeze)  # or Python ends with a search for cycles in all that torch has loaded, nearly a second
    app()


if __name__ == "__main__":
    sys.exit(app())
