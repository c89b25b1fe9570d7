"""Who is who on the platform that submissions came from: `SUBMITTED/.collected.json`, as `course collect` writes it."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from autograder.grading.verdicts import plain_name

FILE = ".collected.json"
_TEXTS = ("student", "assignment", "platform", "download")
_OPTIONAL_TEXTS = ("platform_id", "name", "login", "submitted_at")


@dataclass(frozen=True)
class Handed:
    """How a submission came in: what `course collect` wrote down about it."""

    student: str
    assignment: str
    platform: str
    download: str
    platform_id: str | None = None
    name: str | None = None
    login: str | None = None
    submitted_at: str | None = None


def read(folders: Iterable[Path]) -> dict[tuple[str, str], Handed]:
    """(student, assignment) → how it came in, from each folder's `.collected.json`, where there is one; the last counts.

    Raises: ValueError that names file, entry and cure.
    """
    handed: dict[tuple[str, str], Handed] = {}
    for folder in folders:
        handed |= _read(folder / FILE)
    return handed


def _read(path: Path) -> dict[tuple[str, str], Handed]:
    if not path.exists():
        return {}
    cure = "collect again (`course collect`), or delete the file to give back without it"
    try:
        content = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read ({error}): {cure}") from None
    if not isinstance(content, dict) or content.get("schema") != 1 or not isinstance(content.get("entries"), list):
        raise ValueError(f'{path}: expected "schema": 1 and a list of "entries": {cure}')
    handed: dict[tuple[str, str], Handed] = {}
    for number, entry in enumerate(content["entries"], 1):
        try:
            one = _handed(entry)
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(f"{path}: entry {number}: {error}: {cure}") from None
        if (one.student, one.assignment) in handed:
            raise ValueError(f"{path}: entry {number}: a second one of {one.student} {one.assignment}: {cure}")
        handed[one.student, one.assignment] = one
    return handed


def _refuse(name: str) -> float:
    raise ValueError(f"{name} is not JSON")


def _handed(entry: Any) -> Handed:
    if not isinstance(entry, dict):
        raise ValueError("not an object")
    for key in _TEXTS:
        if not isinstance(entry.get(key), str):
            raise ValueError(f"{key!r} must be text")
    for key in _OPTIONAL_TEXTS:
        if not isinstance(entry.get(key), str | None):
            raise ValueError(f"{key!r} must be text or null")
    plain_name(entry["student"])
    plain_name(entry["assignment"])
    fields: dict[str, Any] = {key: entry.get(key) for key in (*_TEXTS, *_OPTIONAL_TEXTS)}
    return Handed(**fields)
