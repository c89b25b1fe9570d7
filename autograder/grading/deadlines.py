"""When work was due: a small YAML file of due dates, extensions and a rule for late work, and the time at which a submission came in.

    zone: Europe/London                  # of every time below that has no offset of its own
    grace_minutes: 10                    # so late is not late
    penalty: {per_day: 0.1, at_most: 0.5, nothing_after_days: 7}
    assignments:
      ch44:
        due: 2026-11-20 23:59
        extensions: {jane: 2026-11-24 23:59}

`grace_minutes` and `penalty` may stand in an assignment, too, and count there alone. A penalty is a share of the points that the work
earned: `per_day` for each day begun, up to `at_most`, and all of it after `nothing_after_days`. Days are days of the calendar in the zone
of the due date, so that the night in which clocks change is one of them. Values are checked strictly: a slip in a date costs points.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import yaml

from autograder.grading.intake import BadFile, read_regular

FILE = ".due.yml"  # in SUBMITTED: `course grade` ignores names that begin with a dot, but for this one
TIMESTAMP = "timestamp.txt"  # beside the notebook, as nbgrader's exchange writes it
MAX_BYTES = 1 << 20
_TIME = re.compile(
    r"(\d{4})-(\d\d)-(\d\d)[ T](\d\d):(\d\d)(?::(\d\d)(?:[.,](\d{1,6})\d*)?)?\s*"
    r"(Z|UTC|GMT|[+-]\d\d:?\d\d(?::?\d\d)?|[A-Za-z_]+(?:/[\w+-]+)*)?"
)
_EXAMPLE = "write it as in 2026-11-20 23:59"


class DeadlineError(ValueError):
    """The file can't be used; the message names file, key and cure."""


@dataclass(frozen=True)
class Penalty:
    """What late work loses, as a share of its points."""

    per_day: float = 0.0
    at_most: float = 1.0
    nothing_after_days: int | None = None

    def share(self, days: int) -> float:
        if self.nothing_after_days is not None and days > self.nothing_after_days:
            return 1.0
        return round(min(self.per_day * days, self.at_most), 9)


@dataclass(frozen=True)
class Rule:
    """One assignment's."""

    due: datetime
    extensions: Mapping[str, datetime] = field(default_factory=dict)
    grace: timedelta = timedelta()
    penalty: Penalty = Penalty()

    def due_for(self, student: str) -> datetime:
        return self.extensions.get(student, self.due)

    def extension(self, student: str) -> timedelta | None:
        """How much later than the others' this student's work is due."""
        moved = self.extensions.get(student)
        return moved.astimezone(UTC) - self.due.astimezone(UTC) if moved else None

    def late(self, student: str, at: datetime) -> tuple[int, float]:
        """(whole seconds late, share of the points that this costs)."""
        due = self.due_for(student)
        late = at.astimezone(UTC) - due.astimezone(UTC)
        if late <= timedelta():
            return 0, 0.0
        days = 0 if late <= self.grace else _days(due, at)
        return math.ceil(late.total_seconds()), self.penalty.share(days)


def _days(due: datetime, at: datetime) -> int:
    """Days begun between the two, by the calendar of the due date's zone."""
    local = at.astimezone(due.tzinfo).replace(tzinfo=None)
    days = math.ceil((local - due.replace(tzinfo=None)) / timedelta(days=1))
    return max(days, 1)


@dataclass(frozen=True)
class Deadlines:
    """A whole file. `zone` is also that of times for which a platform tells none."""

    zone: tzinfo | None = None
    rules: Mapping[str, Rule] = field(default_factory=dict)


def load(path: Path, known: Collection[str] = ()) -> Deadlines:
    """Read and check a file; `known` are the assignments that there are. Raises: DeadlineError, one line."""
    try:
        content = path.read_bytes()[:MAX_BYTES]
        document = yaml.load(content.decode("utf-8-sig"), Loader=_Strings)
    except OSError as error:
        raise DeadlineError(f"{path}: {error.strerror}; give a file of due dates") from None
    except UnicodeDecodeError:
        raise DeadlineError(f"{path}: is not UTF-8 text; save it as that") from None
    except (yaml.YAMLError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        raise DeadlineError(f"{path}{line}: {getattr(error, 'problem', None) or 'is not YAML'}; mend this line") from None
    found = _Reader(path).deadlines(document)
    for name in found.rules:
        if known and name not in known:
            raise DeadlineError(
                f"{path}: assignments.{name}: is no assignment of the course; take one of {', '.join(sorted(known))}"
            )
    return found


class _Strings(yaml.BaseLoader):
    """YAML whose values stay text (no date loses its zone, no number its digits), and that refuses a key that is given twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for number, key in enumerate(keys):
            if key in keys[:number]:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key} is given twice", node.value[number][0].start_mark
                )
        return super().construct_mapping(node, deep)


_Strings.add_constructor("tag:yaml.org,2002:map", lambda loader, node: loader.construct_mapping(node, deep=True))


class _Reader:
    def __init__(self, path: Path) -> None:
        self.path = path

    def wrong(self, key: str, problem: str, cure: str) -> DeadlineError:
        return DeadlineError(f"{self.path}: {key}: {problem}; {cure}")

    def mapping(self, key: str, value: Any, known: set[str] | None = None) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise self.wrong(key, "is no table of keys and values", "indent its lines as in `due: 2026-11-20 23:59`")
        for name in value:
            if known is not None and name not in known:
                raise self.wrong(
                    f"{key}.{name}" if key != "the file" else name, "is no key here", f"take one of {', '.join(sorted(known))}"
                )
        return value

    def deadlines(self, document: Any) -> Deadlines:
        whole = self.mapping("the file", document, {"zone", "assignments", "grace_minutes", "penalty"})
        zone = self.zone(whole.get("zone"))
        grace, penalty = self.grace("", whole, timedelta()), self.penalty("", whole, Penalty())
        rules = {}
        for name, value in self.mapping("assignments", whole.get("assignments", {})).items():
            key = f"assignments.{name}"
            one = self.mapping(key, value, {"due", "extensions", "grace_minutes", "penalty"})
            if "due" not in one:
                raise self.wrong(key, "has no due date", "add `due: 2026-11-20 23:59`")
            due = self.time(f"{key}.due", one["due"], zone)
            extensions = {
                student: self.time(f"{key}.extensions.{student}", text, zone)
                for student, text in self.mapping(f"{key}.extensions", one.get("extensions", {})).items()
            }
            for student, moved in extensions.items():
                if moved.astimezone(UTC) < due.astimezone(UTC):
                    raise self.wrong(f"{key}.extensions.{student}", "is before the due date", "an extension is a later time")
            rules[name] = Rule(due, extensions, self.grace(key, one, grace), self.penalty(key, one, penalty))
        return Deadlines(zone, rules)

    def zone(self, text: Any) -> tzinfo | None:
        if text is None:
            return None
        try:
            return ZoneInfo(text)
        except (ZoneInfoNotFoundError, ValueError, TypeError, OSError):
            raise self.wrong("zone", f"{text} is no time zone", "take a name as in Europe/London or UTC") from None

    def time(self, key: str, text: Any, zone: tzinfo | None) -> datetime:
        match = _TIME.fullmatch(text.strip()) if isinstance(text, str) else None
        if not match:
            hint = (
                "has no time of day"
                if isinstance(text, str) and re.fullmatch(r"\d{4}-\d\d-\d\d", text.strip())
                else f"{text!r} is no time"
            )
            raise self.wrong(key, hint, _EXAMPLE)
        try:
            moment = parse(match[0])
        except ValueError as error:
            raise self.wrong(key, f"{text!r} is no time ({error})", _EXAMPLE) from None
        if moment.tzinfo is not None:
            return moment
        if zone is None:
            raise self.wrong(
                key, "has no time zone", "add `zone: Europe/London` at the top of the file, or an offset as in 23:59+01:00"
            )
        first, second = moment.replace(tzinfo=zone), moment.replace(tzinfo=zone, fold=1)
        if first.utcoffset() != second.utcoffset():
            if first.astimezone(UTC).astimezone(zone).replace(tzinfo=None) != moment:
                raise self.wrong(key, f"{text} does not exist in {zone}, where clocks skip it", "take a time an hour later")
            raise self.wrong(key, f"{text} comes twice in {zone}, where clocks go back", "add an offset as in 01:30+01:00")
        return first

    def number(self, key: str, value: Any, most: float) -> float:
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = math.nan
        if not 0 <= number <= most:
            raise self.wrong(key, f"{value!r} is no number from 0 to {most:g}", "correct it")
        return number

    def grace(self, key: str, table: dict[str, Any], default: timedelta) -> timedelta:
        if "grace_minutes" not in table:
            return default
        return timedelta(minutes=self.number(f"{key}.grace_minutes".lstrip("."), table["grace_minutes"], 100_000))

    def penalty(self, key: str, table: dict[str, Any], default: Penalty) -> Penalty:
        if "penalty" not in table:
            return default
        key = f"{key}.penalty".lstrip(".")
        one = self.mapping(key, table["penalty"], {"per_day", "at_most", "nothing_after_days"})
        days = (
            self.number(f"{key}.nothing_after_days", one["nothing_after_days"], 10_000) if "nothing_after_days" in one else None
        )
        if days is not None and days != int(days):
            raise self.wrong(f"{key}.nothing_after_days", "is no whole number of days", "correct it")
        return Penalty(
            self.number(f"{key}.per_day", one.get("per_day", 0), 1),
            self.number(f"{key}.at_most", one.get("at_most", 1), 1),
            None if days is None else int(days),
        )


def parse(text: str) -> datetime:
    """A time as platforms and nbgrader write it, with its zone if it has one. Raises: ValueError."""
    match = _TIME.fullmatch(text.strip())
    if not match:
        raise ValueError("not a time")
    *parts, fraction, zone = match.groups()
    moment = datetime(*(int(part or 0) for part in parts), int((fraction or "0").ljust(6, "0")))  # type: ignore[arg-type, misc]
    return moment if zone is None else moment.replace(tzinfo=_zone(zone))


def _zone(name: str) -> tzinfo:
    if name[0] in "+-":
        return datetime.strptime(name.replace(":", "")[:5], "%z").tzinfo  # type: ignore[return-value]
    try:
        return UTC if name in ("Z", "UTC", "GMT") else ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise ValueError(f"{name} is no time zone") from None


def timestamp(text: str) -> datetime:
    """What a `timestamp.txt` says, in UTC; without a zone it is UTC, as nbgrader takes it. Raises: ValueError."""
    moment = parse(text)
    return moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)


@dataclass(frozen=True)
class HandedIn:
    """What nbgrader's gradebook says of a submission beside its points. `ruled`: a due date is known, so that `extension` and `share`, the
    part of the points that being late costs, are facts; otherwise whatever the gradebook holds stays."""

    at: datetime | None = None
    ruled: bool = False
    extension: timedelta | None = None
    share: float = 0.0


UNKNOWN = HandedIn()


def handed_in(folder: Path, student: str, assignment: str, deadlines: Deadlines) -> HandedIn:
    """Of one submission, by the `timestamp.txt` in its folder. Raises: ValueError if there is one that says no time."""
    rule = deadlines.rules.get(assignment)
    ruled, extension = rule is not None, rule.extension(student) if rule else None
    try:
        content = read_regular(folder / TIMESTAMP, 1000)
    except FileNotFoundError:
        return HandedIn(None, ruled, extension)
    except (BadFile, OSError) as error:
        raise ValueError(f"{TIMESTAMP} {error}") from None
    try:
        at = timestamp(content.decode())
    except ValueError:
        raise ValueError(f"{TIMESTAMP} says no time as nbgrader writes it (2026-11-20 23:59:00.000000 UTC)") from None
    return HandedIn(at, ruled, extension, rule.late(student, at)[1] if rule else 0.0)
