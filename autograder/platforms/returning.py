"""`course return`: one platform after the other is a module of its own, and this chooses."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from autograder.grading import judge
from autograder.grading.verdicts import write_atomically
from autograder.platforms import classroom50, give_back_canvas, give_back_moodle, give_back_nbgrader, gradescope_archive
from autograder.platforms.give_back import GiveBackError, Given, Result, collected_in, graded_from, load
from autograder.reporting.machines import gradescope_json

WITH_WORKSHEET = ("canvas", "moodle")


@dataclass(frozen=True)
class Request:
    """What was asked for at the command line."""

    grades: Path
    submitted: Path | None = None
    into: Path | None = None
    worksheet: Path | None = None
    only: tuple[str, ...] = ()
    db_url: str | None = None
    automatic: bool = False
    trusted: bool = False


def give_back(platform: str, request: Request) -> Given:
    """Write the files of `platform`. Raises: GiveBackError if that cannot be; OSError if the disk is full."""
    if request.worksheet is not None and platform not in WITH_WORKSHEET:
        raise GiveBackError(f"{platform} has no worksheet to fill in: leave --worksheet out, or name --to canvas or --to moodle")
    if request.automatic and platform != "moodle":
        raise GiveBackError("--automatic is for Moodle: the other platforms get points by hand separately")
    into = request.into or (request.grades if platform == "nbgrader" else request.grades / "return")
    given = _gradescope(request, into) if platform == "gradescope" else _others(platform, request, into)
    if request.worksheet is None:
        _forget(into, platform, given.files, request.only)
    return given


def _others(platform: str, request: Request, into: Path) -> Given:
    results, given = load(request.grades, request.submitted, request.db_url, request.only)
    if platform == "canvas":
        give_back_canvas.write(results, into, given, request.worksheet)
    elif platform == "moodle":
        give_back_moodle.write(results, into, given, request.worksheet, request.automatic)
    elif platform == "nbgrader":
        give_back_nbgrader.write(results, into, given, graded_from(request.grades, request.submitted))
    else:
        classroom50.write(results, into, given)
    return given


def _forget(into: Path, platform: str, files: list[Path], only: tuple[str, ...]) -> None:
    """Remove what an earlier run wrote and this one did not: it would be a stale score. Nothing else is touched."""
    note = into / f".returned-{platform}"
    now = {path.relative_to(into).as_posix() for path in files}
    before = set(note.read_text(encoding="utf-8").split("\n")) - {""} if note.is_file() else set()
    others = judge.assignments() - {*only} if only else set()
    kept = {name for name in before - now if others & set(re.split("[/ .-]", name))}
    for name in before - now - kept:
        path = into / name
        if path.resolve().is_relative_to(into.resolve()):
            path.unlink(missing_ok=True)
    if now or before:
        write_atomically(note, "".join(f"{name}\n" for name in sorted(now | kept)))


def _gradescope(request: Request, into: Path) -> Given:
    """An archive for Gradescope's container for each assignment, and the results of what was collected from Gradescope."""
    unknown = sorted(set(request.only) - judge.assignments())
    if unknown:
        raise GiveBackError(f"no such assignment: {', '.join(unknown)}; there are {', '.join(sorted(judge.assignments()))}")
    collected = collected_in(graded_from(request.grades, request.submitted))
    ours = {
        key for key, one in collected.items() if one.platform == "gradescope" and (not request.only or key[1] in request.only)
    }
    results: list[Result] = []
    given = Given()
    if ours and (request.grades / "verdicts").is_dir():
        results, given = load(request.grades, request.submitted, request.db_url)
        results = [result for result in results if (result.student, result.assignment) in ours]
        given.left_out = [line for line in given.left_out if line.partition(": ")[0] in {" ".join(key) for key in ours}]
    graded = {path.stem for path in (request.grades / "verdicts").glob("*/*.json")} & judge.assignments()
    assignments = request.only or tuple(sorted(graded))
    if not assignments:
        raise GiveBackError("which assignment is the archive to grade? Say it, as in --only ch44")
    for name in assignments:
        path = into / "gradescope" / f"{name}-autograder.zip"
        given.files.append(write_atomically(path, gradescope_archive.archive(name, request.trusted)))
    for result in results:
        handed = result.handed
        if handed and handed.platform == "gradescope" and (handed.platform_id or "").isdecimal():
            path = into / "gradescope" / result.assignment / f"submission_{handed.platform_id}.json"
            given.files.append(write_atomically(path, gradescope_json(result.verdict, result.marks, result.penalty)))
    given.notes.append(
        "Upload the archive under Configure Autograder, with Ubuntu 24.04. It holds the solutions. It grades only where bubblewrap may "
        "start in Gradescope's container: test it there with a submission of your own."
    )
    return given
