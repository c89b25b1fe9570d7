"""What works on this machine, and how to mend what does not: `checks()` looks, `report()` prints a table for `course doctor`."""

import os
import platform
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np
from packaging.requirements import Requirement
from rich.console import Console
from rich.table import Table

from autograder.grading import forking, gvisor, sandbox

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = (3, 11), (3, 13)  # the oldest and the newest that the pins are tried with
NEEDED_DISK = 2 << 30  # bytes: a built book, a gradebook, the reports of a class
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@dataclass(frozen=True)
class Check:
    """One thing looked at. `remedy` is empty when `ok`; a check that is not `required` may fail on a working machine."""

    name: str
    ok: bool
    detail: str
    remedy: str = ""
    required: bool = True


def checks() -> list[Check]:
    """Looks at everything, the quick things first; most of the seconds go into importing torch inside sandboxes."""
    looks: tuple[Callable[[], Check], ...] = (
        _python,
        _packages,
        _torch,
        _mujoco,
        _sandbox,
        _forks,
        _wall,
        _flights,
        _nbgrader,
        _frozen,
        _disk,
        _browser,
    )
    return [look() for look in looks]


def report(console: Console | None = None) -> int:
    """Prints the checks as a table; 0 if everything that is required works, else 1."""
    found = checks()
    table = Table("", "check", "found", "what to do", title="course doctor")
    for check in found:
        mark = "[green]ok" if check.ok else "[red]no" if check.required else "[yellow]no (optional)"
        table.add_row(mark, check.name, check.detail, check.remedy)
    (console or Console()).print(table)
    return 0 if all(check.ok for check in found if check.required) else 1


def _python() -> Check:
    ok = PYTHONS[0] <= sys.version_info[:2] <= PYTHONS[1]
    return Check("Python", ok, platform.python_version(), "" if ok else "Make the environment with Python 3.11, 3.12 or 3.13.")


def _packages() -> Check:
    path = ROOT / "requirements.txt"
    if not path.is_file():
        return Check("packages", False, "requirements.txt not found", "Run from a checkout: pip install --editable .")
    lines = (line.strip() for line in path.read_text().splitlines())
    pins = [Requirement(line) for line in lines if line and not line.startswith(("#", "-"))]
    wrong = [f"{pin.name} {_installed(pin.name)} instead of {pin.specifier}" for pin in pins if not _satisfied(pin)]
    if wrong:
        return Check("packages", False, "; ".join(wrong), "pip install -r requirements.txt")
    return Check("packages", True, f"{len(pins)} as pinned")


def _installed(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "missing"


def _satisfied(pin: Requirement) -> bool:
    version = _installed(pin.name)
    return version != "missing" and pin.specifier.contains(version, prereleases=True)


def _torch() -> Check:
    try:
        import torch  # here, because it takes seconds

        ok = float(torch.ones(3).sum()) == 3.0
    except Exception as error:
        return Check("torch", False, f"{type(error).__name__}: {error}"[:300], "pip install -r requirements.txt")
    return Check("torch", ok, f"{torch.__version__}, {torch.get_num_threads()} threads")


def _mujoco() -> Check:
    """MuJoCo 4 is three packages: pip takes the core's files away again when it upgrades MuJoCo 3, and calls that a success."""
    try:
        import mujoco

        mujoco.MjModel.from_xml_string("<mujoco/>")
    except Exception as error:
        mend = "pip install --force-reinstall --no-deps mujoco mujoco-core mujoco-studio (MuJoCo 3 was upgraded in place)"
        return Check("MuJoCo", False, f"{type(error).__name__}: {error}"[:300], mend)
    return Check("MuJoCo", True, mujoco.__version__)


def _sandbox() -> Check:
    """Tried twice, as grading does; a failure that does not come again is told."""
    first = sandbox.probe(torch=True)
    problems = first and sandbox.probe(torch=True)
    if problems:
        detail = "; ".join(problem.what for problem in problems)
        return Check("sandbox", False, detail, " ".join(problem.remedy for problem in problems))
    user = "root, through a second layer that becomes nobody" if os.geteuid() == 0 else "an ordinary user"
    once = "".join(f"; a first try failed: {problem.what}" for problem in first)
    return Check("sandbox", True, f"bubblewrap works as {user}; torch imports inside{once}")


def _forks() -> Check:
    """Whether one process that has torch loaded can fork those of submissions; without, each loads it anew."""
    server = forking.course.get()
    problems = sandbox.probe(torch=True, server=server) if server else []
    why = forking.course.given_up or "; ".join(problem.what for problem in problems)
    if why:
        return Check(
            "fork server", False, why, "Grading works, but takes some seconds longer for each submission.", required=False
        )
    return Check("fork server", True, "submissions share one process that has torch loaded")


def _wall() -> Check:
    """Which wall stands around a submission, and whether a stronger one could; grading works with either."""
    inside = gvisor.around()
    forked = "namespaces of its own, forked" if forking.course.get() else "bubblewrap, one process each"
    used = f"{forked}{f'; all of it in {inside}' if inside else ''}"
    if problems := sandbox.probe(torch=True, wall="gvisor"):
        remedy = f"Only for code that you trust least: {problems[0].remedy}"
        return Check("wall", False, f"{used}; gVisor, the stronger one: {problems[0].what}", remedy, required=False)
    return Check("wall", True, f"{used}; the stronger one works, too: course grade --wall gvisor")


def _flights() -> Check:
    """Whether a file that is handed in could be flown: one episode of a policy that does nothing."""
    try:
        from course_lib.control import flight  # here, because Gymnasium takes a third of a second

        task = flight.TASKS["lander"]
        idle = {name: np.full(shape, float(name == "obs_std"), np.float32) for name, shape in task.tensors.items()}
        flight.fly(idle, [0], task)
    except Exception as error:
        return Check("flights", False, f"{type(error).__name__}: {error}"[:300], "pip install -r requirements.txt")
    return Check("flights", True, task.environment)


def _nbgrader() -> Check:
    installed = _installed("nbgrader")
    if installed == "missing" or shutil.which("alembic"):
        return Check("nbgrader", installed != "missing", f"{installed}, alembic on PATH")
    # nbgrader's own commands call that program to bring an old gradebook's tables up to date; `course grade` does not
    remedy = f"Put this environment's programs first: export PATH={Path(sys.executable).parent}:$PATH"
    return Check("nbgrader", False, "the program alembic is not on PATH: nbgrader's own commands need it", remedy, required=False)


def _frozen() -> Check:
    count = len(list((ROOT / "course_lib" / "frozen").glob("*.*")))
    remedy = (
        "" if count else "Nothing to do: `course check` and the first build of the book freeze them, and a bundle has its own."
    )
    return Check("frozen checks", count > 0, f"{count} exercises", remedy, required=False)


def _disk() -> Check:
    free = shutil.disk_usage(Path.cwd()).free
    remedy = "" if free >= NEEDED_DISK else f"Free some space: {NEEDED_DISK >> 30} GiB are wanted."
    return Check("disk", free >= NEEDED_DISK, f"{free / 2**30:.1f} GiB free in this folder", remedy)


def _browser() -> Check:
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    remedy = "" if found else "Only the book's browser tests need one: apt install chromium."
    return Check("browser", found is not None, found or "none", remedy, required=False)
