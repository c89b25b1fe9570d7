"""Verdicts: one JSON file per submission, `DIR/verdicts/{student}/{assignment}.json`; every other output is derived from them.

A verdict that exists here is valid: finite scores within their maxima, known states, text without control characters. Files are
strict JSON in UTF-8 under 1 MB and are replaced atomically, so that a killed run leaves either the old verdict or the new one.
"""

from __future__ import annotations

import json
import math
import os
import re
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

SCHEMA = 1
STATES = ("correct", "partial", "wrong", "not_implemented", "error", "timeout", "manual")
FINAL = ("graded", "student_error")  # the statuses whose scores count
STATUSES = ("graded", "student_error", "needs_review", "infra_error")
MAX_BYTES = 1_000_000
MAX_FLAGS = 50
MESSAGE_BYTES = 2048
LABEL_BYTES = 256
RECEIPT = "handed_in: "  # begins the flag that says which file was judged: `handed_in: NAME sha256 HEX`
TOLERANCE = 1e-9  # points: what summing a few floats may lose

# Control characters except \n and \t, surrogates, and the two code points that XML cannot carry.
_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")


def clean_text(text: str, limit: int = MESSAGE_BYTES) -> str:
    """`text` fit for JSON, XML, HTML and a terminal: unprintable characters become U+FFFD, and "…" takes the place of what
    exceeds `limit` bytes of UTF-8 (at least 3). Cleaning twice changes nothing."""
    head = _UNPRINTABLE.sub("\ufffd", text[: limit + 1])  # a character is at least one byte: no need to look further
    encoded = head.encode()
    if len(encoded) <= limit:
        return head
    return encoded[: limit - 3].decode(errors="ignore") + "…"


def plain_name(name: str) -> str:
    """`name`, if it can name a file of its own in any folder of ours.

    Raises: ValueError for an empty, hidden or overlong name, for separators, control characters and undecodable bytes.
    """
    if not isinstance(name, str) or not name or name.startswith(".") or _UNPRINTABLE.search(name) or set(name) & set("/\n\t"):
        raise ValueError(f"not a plain file name: {name!a}")
    if len(name.encode()) > 249:  # 255 is the usual limit of a file system; .ipynb is appended
        raise ValueError(f"name longer than 249 bytes: {name[:40]!a}…")
    return name


def _points(what: str, value: Any, least: float = 0.0) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value < least:
        raise ValueError(f"{what} must be a finite number of at least {least}, got {value!r}")
    return float(value)


def _check_score(what: str, score: float, max_score: float) -> None:
    if score > max_score + TOLERANCE:
        raise ValueError(f"{what}: score {score} exceeds max_score {max_score}")


@dataclass(frozen=True)
class Item:
    """The outcome of one exercise (or, with state `manual`, of one open question)."""

    exercise: str
    score: float
    max_score: float
    state: str
    misconceptions: tuple[str, ...] = ()
    message: str = ""

    @classmethod
    def of(cls, value: Item | Mapping[str, Any]) -> Item:
        """A valid, cleaned item. Raises: ValueError, TypeError for missing or unknown keys."""
        item = value if isinstance(value, Item) else cls(**value)
        if item.state not in STATES:
            raise ValueError(f"{item.exercise}: unknown state {item.state!r}, expected one of {STATES}")
        score, max_score = _points("score", item.score), _points("max_score", item.max_score)
        _check_score(item.exercise, score, max_score)
        misconceptions = tuple(clean_text(name, LABEL_BYTES) for name in item.misconceptions)
        return cls(clean_text(item.exercise, LABEL_BYTES), score, max_score, item.state, misconceptions, clean_text(item.message))


@dataclass(frozen=True)
class Verdict:
    """What one submission earned. `score` and `max_score` count automatic exercises; open questions count in the `manual_` pair,
    whose score is None until a teacher has given one."""

    student: str
    assignment: str
    status: str
    score: float
    max_score: float
    manual_score: float | None = None
    manual_max_score: float = 0.0
    items: tuple[Item, ...] = ()
    flags: tuple[str, ...] = ()
    seconds: float = 0.0
    environment: str = ""
    schema: int = SCHEMA
    timings: Mapping[str, float] = field(default_factory=dict, compare=False)  # exercise → seconds; never written to the file

    @classmethod
    def of(cls, value: Verdict | Mapping[str, Any]) -> Verdict:
        """A valid, cleaned verdict from a mapping with the contract's keys.

        Raises: ValueError for impossible values, TypeError for missing or unknown keys.
        """
        raw = value if isinstance(value, Verdict) else cls(**value)
        if raw.schema != SCHEMA:
            raise ValueError(f"verdict schema {raw.schema!r} is not {SCHEMA}")
        if raw.status not in STATUSES:
            raise ValueError(f"unknown status {raw.status!r}, expected one of {STATUSES}")
        flags = [clean_text(flag, LABEL_BYTES) for flag in raw.flags[: MAX_FLAGS + 1]]
        if len(flags) > MAX_FLAGS:  # a submission can cause any number of flags (one per link), never a verdict of any size
            flags[-1] = f"… and {len(raw.flags) - MAX_FLAGS} more"
        verdict = cls(
            student=plain_name(raw.student),
            assignment=plain_name(raw.assignment),
            status=raw.status,
            score=_points("score", raw.score),
            max_score=_points("max_score", raw.max_score),
            manual_score=None if raw.manual_score is None else _points("manual_score", raw.manual_score, -math.inf),  # as typed
            manual_max_score=_points("manual_max_score", raw.manual_max_score),
            items=tuple(Item.of(item) for item in raw.items),
            flags=tuple(flags),
            seconds=_points("seconds", raw.seconds),
            environment=clean_text(raw.environment, LABEL_BYTES),
            timings={name: _points("timings", seconds) for name, seconds in raw.timings.items()},
        )
        _check_score(verdict.assignment, verdict.score, verdict.max_score)
        return verdict

    @property
    def automatic(self) -> tuple[Item, ...]:
        """The items that the judge scored."""
        return tuple(item for item in self.items if item.state != "manual")


def to_json(verdict: Verdict) -> str:
    """Strict JSON, the same text for the same verdict. Raises: ValueError past 1 MB."""
    content = asdict(Verdict.of(verdict))
    del content["timings"]
    text = json.dumps(content, sort_keys=True, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    if len(text.encode()) >= MAX_BYTES:
        raise ValueError(f"verdict of {len(text)} characters: too many items")
    return text


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")


def from_json(text: str) -> Verdict:
    """The inverse of `to_json`. Raises: ValueError for anything but a valid verdict."""
    raw = json.loads(text, parse_constant=_refuse_constant)
    keys = {one.name for one in fields(Verdict)} - {"timings"}
    if not isinstance(raw, dict) or not keys >= set(raw):
        raise ValueError(f"not a verdict: expected the keys {sorted(keys)}")
    try:
        return Verdict.of(raw)
    except TypeError as problem:
        raise ValueError(f"not a verdict: {problem}") from None


def write_atomically(path: Path, content: str | bytes) -> Path:
    """Replace `path` by `content` (text as UTF-8) in one step, durably; folders are made, an unchanged file is left alone."""
    data = content.encode() if isinstance(content, str) else content
    if path.is_file() and path.read_bytes() == data:
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".tmp")
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fchmod(stream.fileno(), 0o644)
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return path


def write(directory: Path, verdict: Verdict) -> Path:
    """Write the verdict to `directory/{student}/{assignment}.json`; `directory` is `DIR/verdicts`."""
    verdict = Verdict.of(verdict)
    return write_atomically(Path(directory) / verdict.student / f"{verdict.assignment}.json", to_json(verdict))


def read_all(directory: Path) -> list[Verdict]:
    """Every verdict below `directory`, sorted by student and assignment; what a killed run left half-written is ignored.

    Raises: ValueError that names the file, if one is no verdict or lies under another's name.
    """
    found = []
    for path in Path(directory).glob("*/*.json"):
        if path.name.startswith("."):
            continue
        try:
            verdict = from_json(path.read_text(encoding="utf-8"))
            if (verdict.student, verdict.assignment) != (path.parent.name, path.stem):
                raise ValueError(f"it is the verdict of {verdict.student}/{verdict.assignment}")
        except ValueError as problem:
            raise ValueError(f"{path}: {problem}; delete it and grade again") from None
        found.append(verdict)
    return sorted(found, key=lambda verdict: (verdict.student, verdict.assignment))
