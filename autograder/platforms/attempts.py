"""Every attempt that was ever collected: which one counts, and where the others are kept.

The one that counts lies in SUBMITTED/STUDENT/ASSIGNMENT, the others in SUBMITTED/.attempts/STUDENT/HASH/ASSIGNMENT, so that each is a
folder that the grader can judge. `.attempts/index.json` knows them all, by the hash of their files.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from autograder.grading import deadlines
from autograder.grading.verdicts import Verdict, write_atomically
from autograder.platforms import archives
from autograder.platforms.archives import Entry, Refused

ATTEMPTS = ".attempts"
INDEX = "index.json"
SCHEMA = 1
MAX_PAPER = 320 << 20  # bytes of one submission
SHOWN = 16  # characters of a hash that name its folder
Judge = Callable[[str, str, Path], Verdict]


class BrokenIndex(ValueError):
    """The index is no such file; the message says what to do."""


@dataclass
class Attempt:
    """One submission of one student to one assignment."""

    student: str
    assignment: str
    platform: str
    platform_id: str | None
    name: str | None
    login: str | None
    download: str
    submitted_at: str | None
    order: int
    told: bool = False  # `submitted_at` comes from --names, where it may be corrected
    sha256: str = ""
    score: float | None = None  # with `environment`, for --best: judged once
    environment: str | None = None

    @property
    def at(self) -> datetime | None:
        return datetime.fromisoformat(self.submitted_at) if self.submitted_at else None


Key = tuple[str, str]


class Store:
    """SUBMITTED's attempts. Call `save` before `put`: whatever happens between the two, the next run finishes it."""

    def __init__(self, submitted: Path) -> None:
        self.submitted = submitted
        self.folder = submitted / ATTEMPTS
        self.attempts: dict[Key, list[Attempt]] = {}
        self._load()

    def _load(self) -> None:
        path = self.folder / INDEX
        if not path.is_file():
            return
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
            if document["schema"] != SCHEMA:
                raise ValueError(f"schema {document['schema']!r}")
            names = {one.name for one in fields(Attempt)}
            for raw in document["attempts"]:
                attempt = Attempt(**{name: value for name, value in raw.items() if name in names})
                self.attempts.setdefault((attempt.student, attempt.assignment), []).append(attempt)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise BrokenIndex(
                f"{path}: is not as `course collect` writes it ({error}); move it away and collect again: no submission is lost by that"
            ) from None

    def save(self) -> None:
        attempts = [asdict(attempt) for key in sorted(self.attempts) for attempt in self.attempts[key]]
        write_atomically(self.folder / INDEX, dumps({"schema": SCHEMA, "attempts": attempts}))

    def current(self, key: Key) -> Path:
        return self.submitted / key[0] / key[1]

    def kept(self, key: Key, sha256: str) -> Path:
        return self.folder / key[0] / sha256[:SHOWN] / key[1]

    def where(self, attempt: Attempt, have: str | None) -> Path:
        """The folder that holds an attempt; `have` is the hash of what lies in the current one."""
        key = (attempt.student, attempt.assignment)
        return self.current(key) if have == attempt.sha256 else self.kept(key, attempt.sha256)

    def take(self, attempt: Attempt, files: dict[str, Entry], have: str | None) -> tuple[bool, list[str]]:
        """Copy an attempt's files, unless they are here already. Returns whether the index learnt something, and lines about files that
        could not be taken."""
        key = (attempt.student, attempt.assignment)
        self.folder.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=".new-", dir=self.folder))
        try:
            problems = _copy(files, staging)
            attempt.sha256 = tree_hash(staging)
            known = next((one for one in self.attempts.get(key, []) if one.sha256 == attempt.sha256), None)
            target = self.kept(key, attempt.sha256)
            if attempt.sha256 != have and not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                staging.chmod(0o755)
                os.rename(staging, target)
        finally:
            shutil.rmtree(staging, ignore_errors=True)
        if known is None:
            self.attempts.setdefault(key, []).append(attempt)
            return True, problems
        later = attempt.at is not None and not attempt.told and (known.at is None or known.at < attempt.at)
        if later or known.order < attempt.order:  # the same work, handed in once more
            known.submitted_at, known.order, known.download = attempt.submitted_at, attempt.order, attempt.download
            return True, problems
        if attempt.told and attempt.order == known.order:
            known.submitted_at, known.told = attempt.submitted_at, True
        return False, problems

    def put(self, key: Key, winner: Attempt, have: str | None) -> None:
        """Make `winner` the attempt that counts; what lay there is kept."""
        current = self.current(key)
        if have != winner.sha256:
            if have is not None:
                kept = self.kept(key, have)
                if kept.exists():
                    shutil.rmtree(current)  # the same files are there already
                else:
                    kept.parent.mkdir(parents=True, exist_ok=True)
                    os.rename(current, kept)
            current.parent.mkdir(parents=True, exist_ok=True)
            os.rename(self.kept(key, winner.sha256), current)
        self.stamp(key, winner)
        kept = self.kept(key, winner.sha256)
        if kept.exists():  # from a run that was killed
            shutil.rmtree(kept)

    def stamp(self, key: Key, winner: Attempt) -> None:
        """Write down when the attempt that counts was handed in."""
        if winner.at:
            stamp = winner.at.astimezone(UTC)
            write_atomically(self.current(key) / deadlines.TIMESTAMP, f"{stamp:%Y-%m-%d %H:%M:%S.%f} UTC")

    def tidy(self) -> None:
        """Remove folders that have become empty, and what a killed run left half copied."""
        for left in self.folder.glob(".new-*"):
            shutil.rmtree(left, ignore_errors=True)
        for folder in sorted(self.folder.glob("*/*"), reverse=True) + sorted(self.folder.glob("*")):
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()


def ordered(attempts: Sequence[Attempt]) -> list[Attempt]:
    """From the first to the last: by the time of handing in, by the platform's own numbers, or else as they were collected."""
    if all(attempt.submitted_at for attempt in attempts):
        return sorted(attempts, key=lambda attempt: (attempt.at or datetime.now(UTC), attempt.order))
    if len({attempt.platform for attempt in attempts}) == 1 and all(attempt.order for attempt in attempts):
        return sorted(attempts, key=lambda attempt: attempt.order)
    return list(attempts)


def best(
    attempts: Sequence[Attempt], shares: Sequence[float], folders: Sequence[Path], judge: Judge, environment: str
) -> Attempt:
    """The attempt with the most automatic points after its share for lateness is taken off; of equals the last.

    Raises: RuntimeError if the grader itself failed on one.
    """
    worth = []
    for attempt, share, folder in zip(attempts, shares, folders, strict=True):
        if attempt.score is None or attempt.environment != environment:
            verdict = judge(attempt.student, attempt.assignment, folder)
            if verdict.status == "infra_error":
                raise RuntimeError(
                    f"{attempt.student}/{attempt.assignment}: the grader failed on an attempt ({', '.join(verdict.flags)})"
                )
            attempt.score, attempt.environment = verdict.score, environment
        worth.append(attempt.score * (1 - share))
    return max(zip(worth, range(len(worth)), attempts, strict=True), key=lambda one: one[:2])[2]


def tree_hash(folder: Path) -> str:
    """sha256 of a submission's files and their names; when it was handed in is not part of it."""
    digest = hashlib.sha256()
    for path in sorted(_files(folder)):
        relative = path.relative_to(folder).as_posix()
        if relative == deadlines.TIMESTAMP:
            continue
        content = hashlib.sha256()
        with open(path, "rb") as stream:
            while piece := stream.read(archives.CHUNK):
                content.update(piece)
        digest.update(os.fsencode(relative) + b"\0" + content.digest())
    return digest.hexdigest()


def _files(folder: Path) -> Iterable[Path]:
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not os.path.islink(os.path.join(parent, name))]
        for name in names:
            path = Path(parent, name)
            if stat.S_ISREG(path.lstat().st_mode):
                yield path


def _copy(files: dict[str, Entry], folder: Path) -> list[str]:
    problems, total = [], 0
    for relative, entry in files.items():
        target = folder / relative
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with open(target, "xb") as stream:
                for piece in archives.chunks(entry):
                    total += len(piece)
                    if total > MAX_PAPER:
                        raise Refused(f"makes the submission larger than {MAX_PAPER >> 20} MB")
                    stream.write(piece)
        except Refused as reason:
            target.unlink(missing_ok=True)
            problems.append(f"{relative}: {reason}")
        except OSError as error:
            if error.errno not in (errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.EINVAL, errno.EILSEQ):
                raise
            problems.append(f"{relative[:200]}: can't be laid out ({error.strerror})")
    return problems


def dumps(document: dict[str, Any]) -> str:
    return json.dumps(document, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"
