"""Runs a library's script in an environment of its own, and keeps what it computed as a record.

A script is experiments/atlas/libraries/LIBRARY.py. It needs nothing of the course, and its header (PEP 723) says what to install:

    # /// script
    # requires-python = ">=3.11"
    # dependencies = ["numpy==2.4.6", "torch==2.13.0", "stable-baselines3==2.9.2"]
    #
    # [tool.atlas]
    # libraries = ["stable-baselines3"]    the packages whose numbers these are
    # bare = []                            pins that are installed without what they ask for (needs many gigabytes, or another torch)
    # why = ""                             why something is installed bare, or called in a roundabout way; one sentence
    # seconds = 120                        after which the script is stopped
    # ///

It calls the library's own public code on the input and gives rows to `sheet.row`. Each library is tried by itself: one that can't be
installed, or whose script fails or takes too long, gets one line, and the others go on.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from experiments.atlas import comparing, given, keeping

SCRIPTS = keeping.FOLDER / "libraries"
INSTALL_SECONDS, INSTALL_BYTES = 900, 6 * 2**30
HEADER = re.compile(r"(?m)^# /// script$\s(?P<content>(^#(| .*)$\s)+)^# ///$")
LISTING = """
import json, platform
from importlib import metadata
found = {d.metadata["Name"].lower().replace("_", "-"): d.version for d in metadata.distributions() if d.metadata["Name"]}
print(json.dumps({"python": platform.python_version(), "installed": dict(sorted(found.items()))}))
"""
SETTINGS = {  # one thread, no accelerator, nothing sent or fetched
    "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": "", "JAX_PLATFORMS": "cpu", "HF_HUB_OFFLINE": "1", "WANDB_MODE": "disabled",
    "TOKENIZERS_PARALLELISM": "false", "PYTHONWARNINGS": "ignore", "PYTHONHASHSEED": "0",
}  # fmt: skip


class AtlasError(Exception):
    """What went wrong with one library, in one line."""


@dataclass(frozen=True)
class Script:
    """A library's script, and what its header says."""

    name: str
    path: Path
    libraries: tuple[str, ...]
    dependencies: tuple[str, ...]
    bare: tuple[str, ...] = ()
    why: str = ""
    seconds: float = 120


@dataclass(frozen=True)
class Outcome:
    """How a library fared: its record, or what went wrong; and what differs from the record that there was."""

    name: str
    record: Mapping[str, Any] | None = None
    error: str = ""
    changes: Sequence[str] = field(default=())
    former: Mapping[str, Any] | None = None

    @property
    def unexplained(self) -> list[str]:
        return comparing.unexplained(self.record["rows"]) if self.record else []


def names(folder: Path = SCRIPTS) -> list[str]:
    """The libraries that have a script."""
    return sorted((path.stem for path in folder.glob("*.py")), key=str.lower)


def script(name: str, folder: Path = SCRIPTS) -> Script:
    """Read a library's script. Raises: AtlasError if there is none, or its header is not as it should be."""
    path = folder / f"{name}.py"
    if not path.is_file():
        raise AtlasError(f"no library of this name; there are: {', '.join(names(folder)) or 'none'}")
    header = parsed(path.read_text(encoding="utf-8"))
    own = header.get("tool", {}).get("atlas", {})
    if unknown := set(own) - {"libraries", "bare", "why", "seconds"}:
        raise AtlasError(f"{path.name}: unknown in [tool.atlas]: {', '.join(sorted(unknown))}")
    pins = (*header.get("dependencies", ()), *own.get("bare", ()))
    if loose := [pin for pin in pins if "==" not in pin and " @ " not in pin]:
        raise AtlasError(f"{path.name}: not pinned: {', '.join(loose)}")
    libraries = tuple(own.get("libraries", ()))
    if not libraries or (missing := [one for one in libraries if one not in map(package, pins)]):
        raise AtlasError(
            f"{path.name}: [tool.atlas] must say in libraries which of the pins it is about{_list(missing if libraries else ())}"
        )
    return Script(
        name,
        path,
        libraries,
        tuple(header["dependencies"]),
        tuple(own.get("bare", ())),
        own.get("why", ""),
        own.get("seconds", 120),
    )


def _list(found: Iterable[str]) -> str:
    text = ", ".join(found)
    return f"; {text} is not among them" if text else ""


def parsed(text: str) -> dict[str, Any]:
    """The header of a script (PEP 723). Raises: AtlasError if there is none, or it is no TOML."""
    found = HEADER.search(text)
    if found is None:
        raise AtlasError("the script has no header: # /// script … # ///")
    lines = [line[2:] if line.startswith("# ") else line[1:] for line in found["content"].splitlines()]
    try:
        return tomllib.loads("\n".join(lines))
    except tomllib.TOMLDecodeError as error:
        raise AtlasError(f"the script's header can't be read: {error}") from None


def package(pin: str) -> str:
    """The package that a pin names, in its usual spelling."""
    return re.sub(r"[-_.]+", "-", re.split(r"[\[=<>!~; @]", pin, maxsplit=1)[0]).lower()


def relaxed(pins: Sequence[str], fixed: Iterable[str] = ("torch",)) -> list[str]:
    """Pins without their versions, except of what is known to be large in other versions."""
    return [pin if package(pin) in fixed or " @ " in pin else re.split(r"[=<>!~; ]", pin, maxsplit=1)[0] for pin in pins]


def run(
    name: str,
    newer: bool = False,
    environments: Path | None = None,
    scripts: Path = SCRIPTS,
    records: Path = keeping.RECORDS,
) -> Outcome:
    """Install a library's pins, or with `newer` the newest versions, run its script, compare, and write the record unless `newer`.

    Args:
      environments: a folder in which environments stay, and are used again; by default each goes when it has served.
    """
    former = keeping.load(name, records)
    try:
        todo = script(name, scripts)
        with tempfile.TemporaryDirectory(prefix="course-atlas-") as temporary:
            folder = (
                (environments / (f"{name}-newer" if newer else name)).resolve()
                if environments
                else Path(temporary) / "environment"
            )
            python = _installed(todo, folder, newer, former)
            rows = _rows(todo, python, Path(temporary))
            found = json.loads(_output([python, "-c", LISTING], Path(temporary), 60, {}))
        record = _record(todo, rows, found)
        if not newer:
            keeping.save(name, record, records)
        return Outcome(name, record, "", comparing.changes(former, record) if former else (), former)
    except AtlasError as error:
        return Outcome(name, None, str(error), (), former)


def told(outcome: Outcome) -> list[str]:
    """An outcome in lines: what went wrong, or how many rows are equal, and what differs from the record that there was."""
    if outcome.record is None:
        return [f"{outcome.name}: {outcome.error}"]
    rows, versions = outcome.record["rows"], _versions(outcome.record)
    former = _versions(outcome.former) if outcome.former else versions
    now = versions if versions == former else f"{former} → {versions}"
    lines = [f"{outcome.name} {now}: {sum(row['equal'] for row in rows)} of {len(rows)} rows equal the course's"]
    if outcome.former and not outcome.changes:
        lines[0] += ", as recorded"
    return [
        *lines,
        *(f"  {line}" for line in outcome.changes),
        *(f"  by no known rule: {line}" for line in outcome.unexplained),
    ]


def _versions(record: Mapping[str, Any]) -> str:
    return ", ".join(record["versions"].values())


def _record(todo: Script, rows: list[dict[str, Any]], found: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "library": todo.name,
        "versions": {one: found["installed"].get(package(one), "?") for one in todo.libraries},
        "date": datetime.now(UTC).date().isoformat(),
        "python": found["python"],
        "pins": [*todo.dependencies],
        "bare": [*todo.bare],
        "why": todo.why,
        "installed": found["installed"],
        "rows": rows,
    }


def _installed(todo: Script, folder: Path, newer: bool, former: Mapping[str, Any] | None) -> str:
    """Python of an environment that has what the script needs."""
    python, seal = str(folder / "bin" / "python"), folder / "atlas.json"
    wanted = json.dumps([todo.dependencies, todo.bare])
    if not newer and seal.exists() and seal.read_text(encoding="utf-8") == wanted:
        return python
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "pyvenv.cfg").exists():
        _output([sys.executable, "-m", "venv", str(folder)], folder, 300, {})
    pip = [python, "-m", "pip", "install", "--quiet", "--no-input", "--no-compile", "--disable-pip-version-check"]
    again: list[str] = []
    if former and not newer and (former["pins"], former["bare"]) == ([*todo.dependencies], [*todo.bare]):
        again = ["--constraint", str(_constraints(former, folder))]  # with what the record was made
    dependencies, bare = (relaxed(todo.dependencies), relaxed(todo.bare)) if newer else (todo.dependencies, todo.bare)
    if dependencies:
        _install([*pip, *again, *(["--upgrade"] if newer else []), *dependencies], folder)
    if bare:
        _install([*pip, "--no-deps", "--ignore-requires-python", *bare], folder)
    if not newer:
        seal.write_text(wanted, encoding="utf-8")
    return python


def _constraints(former: Mapping[str, Any], folder: Path) -> Path:
    """The versions of a record, without what names a build of them; the tools that install are left as they are."""
    known = {
        name: version.partition("+")[0]
        for name, version in former["installed"].items()
        if name not in ("pip", "setuptools", "wheel")
    }
    path = folder / "constraints.txt"
    path.write_text("".join(f"{name}=={version}\n" for name, version in known.items()), encoding="utf-8")
    return path


def _install(command: Sequence[str], folder: Path) -> None:
    """Raises: AtlasError if pip fails, takes too long, or fills more of the disk than is meant."""
    temporary = folder / "tmp"
    temporary.mkdir(exist_ok=True)
    try:
        _output(
            command,
            folder,
            INSTALL_SECONDS,
            {"TMPDIR": str(temporary)},
            "can't be installed",
            lambda: _size(folder) > INSTALL_BYTES,
        )
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _size(folder: Path) -> int:
    """Of all files, those that come and go meanwhile left out."""
    total = 0
    for place, _, files in os.walk(folder):
        for file in files:
            try:
                total += os.lstat(os.path.join(place, file)).st_size
            except OSError:
                continue
    return total


def _rows(todo: Script, python: str, temporary: Path) -> list[dict[str, Any]]:
    """Run the script beside its helper, alone, and judge what it prints."""
    place = temporary / "run"
    place.mkdir()
    shutil.copyfile(todo.path, place / "rows_of_a_library.py")
    shutil.copyfile(keeping.FOLDER / "sheet.py", place / "sheet.py")
    (place / "home").mkdir()
    own = SETTINGS | {"ATLAS_GIVEN": json.dumps(given.GIVEN), "HOME": str(place / "home"), "TMPDIR": str(place)}
    text = _output([python, "rows_of_a_library.py"], place, todo.seconds, own, "the script fails")
    formulas = given.formulas()
    try:
        rows = [comparing.judged(json.loads(line), formulas) for line in text.splitlines()]
    except ValueError as error:
        raise AtlasError(f"the script printed something else than rows: {error}") from None
    if not rows:
        raise AtlasError("the script printed no row")
    if doubled := {(row["formula"], row["setting"]) for row in rows if sum(_key(row) == _key(other) for other in rows) > 1}:
        raise AtlasError(f"two rows are on the same: {' '.join(sorted(doubled)[0])}")
    return rows


def _key(row: Mapping[str, Any]) -> tuple[str, str]:
    return row["formula"], row["setting"]


def _output(
    command: Sequence[str],
    folder: Path,
    seconds: float,
    settings: Mapping[str, str],
    failing: str = "failed",
    too_large: Any = None,
) -> str:
    """Standard output of a command. Raises: AtlasError with the last thing it said if it fails, and if it takes too long or too much."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))} | dict(
        settings
    )
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=out, stderr=err, stdin=subprocess.DEVNULL, start_new_session=True
        )
        try:
            status = _waited(process, seconds, too_large)
        finally:
            _end(process)
        out.seek(0)
        err.seek(0)
        if status:
            raise AtlasError(f"{failing}: {last_words(err.read())}")
        return out.read()


def _waited(process: subprocess.Popen, seconds: float, too_large: Any) -> int:
    started = time.monotonic()
    while True:
        left = seconds - (time.monotonic() - started)
        if left <= 0:
            raise AtlasError(f"took more than {seconds:g} seconds")
        try:
            return process.wait(min(left, 10))
        except subprocess.TimeoutExpired:
            if too_large is not None and too_large():
                raise AtlasError(f"takes more than {INSTALL_BYTES / 2**30:g} GB of disk") from None


def _end(process: subprocess.Popen) -> None:
    """A process and those that it started."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def last_words(text: str) -> str:
    """The line that says what is wrong: the last error of pip, else the last line."""
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("[notice]")]
    errors = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR: ")]
    return (errors or lines or ["without a word"])[-1][:300]
