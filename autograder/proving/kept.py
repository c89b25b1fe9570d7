"""Kept records: what was proved of each exercise, in one small file a chapter, and whether it still holds.

A record fits as long as its key is that of the code as it stands: the exercise's checks and references, the comparing code and all of
the library that they reach, the pins of the packages that they use, and the number of seeds (autograder.proving.dependencies says what is
reached). Whoever changes one of these proves the exercise anew; whoever changes none reads the record, as the book does.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from autograder import checks
from autograder.authoring.spec import Artefact, Exercise, Tuning
from autograder.paths import ROOT, RUNS
from autograder.proving.dependencies import Code, definition_of
from autograder.proving.killmatrix import SEEDS
from autograder.proving.locks import one_at_a_time
from course_lib.figures.records import whole

FOLDER = Path(__file__).with_name("records")
LOCK = ROOT / "book" / "_cache" / "records.lock"
MATRIX = ("autograder.proving.killmatrix:exercise_rows",)
CALIBRATION = ("autograder.proving.calibration:printed",)
ALWAYS_PINNED = {"torch", "numpy"}


@dataclass(frozen=True)
class Proved:
    """What is kept of one exercise: its key, the day, and its rows as the book prints them."""

    exercise: str
    key: str
    day: str
    rows: dict[str, Any]


class Keys:
    """The keys of the checkout's exercises as the code stands now."""

    def __init__(self, root: Path = ROOT) -> None:
        self.root, self.code = root, Code(root)
        self._pins = pins(root)

    def key(self, assignment: str, exercise: Exercise | Artefact | Tuning) -> str:
        """A hash of all that an exercise's proof rests on."""
        module, kind = f"autograder.checks.{assignment}", type(exercise).__name__
        source = (self.root / "autograder" / "checks" / f"{assignment}.py").read_text(encoding="utf-8")
        reached = self.code.reach(
            [*(MATRIX if kind == "Exercise" else CALIBRATION), definition_of(module, source, kind, exercise.name)]
        )
        used = {package for package in reached.packages | ALWAYS_PINNED if package in self._pins}
        digest = hashlib.sha256(f"{reached.fingerprint} {SEEDS}".encode())
        for package in sorted(used):
            digest.update(f"{package}=={self._pins[package]}\n".encode())
        if isinstance(exercise, Artefact | Tuning):  # its proof are the flights of recorded agents
            for path in sorted((RUNS / exercise.experiment).glob("*.parquet")):
                digest.update(path.name.encode() + hashlib.sha256(path.read_bytes()).digest())
        return digest.hexdigest()[:16]


def pins(root: Path = ROOT) -> dict[str, str]:
    """The version of each package that requirements.txt and constraints.txt pin (both, should they differ), by its name in lower case."""
    found: dict[str, set[str]] = {}
    for name in ("requirements.txt", "constraints.txt"):
        for line in (root / name).read_text(encoding="utf-8").splitlines():
            if match := re.match(r"([A-Za-z0-9_.-]+)(?:\[.*\])?==([^\s;]+)", line):
                found.setdefault(match[1].lower().replace("-", "_"), set()).add(match[2])
    return {name: " ".join(sorted(versions)) for name, versions in found.items()}


def load(assignment: str, folder: Path | None = None) -> dict[str, Proved]:
    """The records of a chapter, by exercise; none if it was never proved."""
    path = (folder or FOLDER) / f"{assignment}.json"
    if not path.is_file():
        return {}
    kept = json.loads(path.read_text(encoding="utf-8"))
    return {name: Proved(name, entry.pop("key"), entry.pop("proved"), entry) for name, entry in kept.items()}


def unproved(assignment: str, keys: Keys | None = None, folder: Path | None = None) -> dict[str, str]:
    """The exercises of a chapter that have no fitting record, and why."""
    keys, known = keys or Keys(), load(assignment, folder)
    reasons = {}
    for exercise in checks.exercises(assignment):
        record = known.get(exercise.name)
        if record is None:
            reasons[exercise.name] = "never proved"
        elif record.key != keys.key(assignment, exercise):
            reasons[exercise.name] = f"not proved since {record.day}, after which something that it rests on has changed"
    return reasons


def remedy(assignment: str) -> str:
    """The command that makes the records that a chapter lacks."""
    return f"course prove --only {assignment}"


def keep(assignment: str, proved: Iterable[Proved], folder: Path | None = None) -> None:
    """Put records in the place of those of the same exercises, the whole file or nothing; those of exercises that have gone go, too."""
    folder = folder or FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{assignment}.json"
    with one_at_a_time(LOCK):  # not beside the records, where it would be committed
        known = load(assignment, folder) | {one.exercise: one for one in proved}
        names = [exercise.name for exercise in checks.exercises(assignment)]
        text = _readable([known[name] for name in names if name in known])
        with whole(path) as unfinished:
            unfinished.write_text(text, encoding="utf-8")


def today() -> str:
    """The day, as records have it."""
    return datetime.now(UTC).date().isoformat()


def _readable(records: list[Proved]) -> str:
    """JSON with a row a line, so that a difference shows what has changed."""
    parts = []
    for one in records:
        lines = [f'  "key": {json.dumps(one.key)}', f'  "proved": {json.dumps(one.day)}']
        for name, value in one.rows.items():
            if isinstance(value, list) and value and isinstance(value[0], dict):
                rows = ",\n".join(f"   {json.dumps(row, ensure_ascii=False)}" for row in value)
                lines.append(f"  {json.dumps(name)}: [\n{rows}\n  ]")
            else:
                lines.append(f"  {json.dumps(name)}: {json.dumps(value, ensure_ascii=False)}")
        parts.append(f" {json.dumps(one.exercise)}: {{\n" + ",\n".join(lines) + "\n }")
    return "{\n" + ",\n".join(parts) + "\n}\n"
