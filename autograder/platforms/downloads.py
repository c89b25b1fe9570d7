"""Whose file is whose: the names by which learning platforms hand out what a class has handed in.

Sources of the formats: Canvas's `lib/content_zipper.rb` (`[name_][LATE_]userid_fileid_filename`, all of a name's characters that are no
letters or digits left out, `anon_…` for a userid where students are anonymous); Moodle's `mod/assign/classes/downloader.php`
(`Full name_participantid_assignsubmission_file_` as a folder or before a file's name); Gradescope's exports, whose
`submission_metadata.yml` maps `submission_ID` to `:submitters` (`:name`, `:sid`, `:email`), `:created_at`, `:history`; Blackboard's
`ASSIGNMENT_login_attempt_2026-11-20-12-30-00_filename`, the example in nbgrader's `zip_collect`, too; nbgrader's own folders, and its
exchange's `student+assignment+time+random`. No download of Canvas or Moodle says when a file was handed in.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, tzinfo
from pathlib import Path
from typing import Any

import yaml

from autograder.grading import deadlines
from autograder.platforms import archives
from autograder.platforms.archives import REPOSITORY, Entry, Refused

PLATFORMS = ("canvas", "moodle", "gradescope", "blackboard", "github", "nbgrader")
MAX_METADATA = 64 << 20
MAX_TEXT = 1 << 20
CANVAS = re.compile(r"(?:(?!LATE_)(?P<name>.+?)_)?(?P<late>LATE_)?(?P<id>\d+|anon_[^\W_]+)_(?P<file>\d+)_(?P<rest>.+)", re.S)
CANVAS_TEXT = re.compile(r"(?:(?!LATE_)(?P<name>.+?)_)?(?P<late>LATE_)?(?P<id>\d+|anon_[^\W_]+)_(?P<rest>text|link)\.html", re.S)
MOODLE = re.compile(r"(?P<name>.+?)(?:_(?P<id>\d+))?_assignsubmission_(?P<kind>[a-z]+)_(?P<rest>.*)", re.S)
BLACKBOARD = re.compile(
    r"(?P<title>.*)_(?P<login>[^_]+(?:_[^_]+)*?)_[^\W\d_]+_(?P<at>\d{4}(?:-\d\d){5})(?:_(?P<rest>.+)|\.txt)", re.S
)
GRADESCOPE = re.compile(r"submission_(\d+)")
METADATA = "submission_metadata.yml"
WANTED = (":submitters", ":created_at", ":name", ":sid", ":email")  # of its keys
MAX_NESTING = 50
SUBMISSIONS = re.compile(r"(.+)-submissions(?: ?\(\d+\)| \d+)?(?:\.zip)?", re.I | re.S)
AGAIN = "; if it is somebody's work, rename it so and collect again"
EXCHANGE = re.compile(r"(?P<student>[^+]+)\+(?P<assignment>[^+]+)\+(?P<at>[^+]+(?:\+\d{4})?)(?:\+.*)?")


@dataclass(frozen=True)
class Handed:
    """One person's submission in one download, possibly to several assignments. `order` tells earlier from later where no time does."""

    platform: str
    files: tuple[Entry, ...]
    download: str
    platform_id: str | None = None
    name: str | None = None
    login: str | None = None
    email: str | None = None
    student: str | None = None  # where the platform itself knows the student's folder
    assignment: str | None = None
    at: datetime | None = None
    zoneless: bool = False  # `at` was told without a zone
    order: int = 0
    late: bool = False
    unknown: str = ""  # why nobody can say whose it is
    trusts_timestamp: bool = False  # the platform's own timestamp.txt lies among the files

    @property
    def person(self) -> str:
        """What tells people apart on this platform. Gradescope's ids are those of submissions, and everybody may have several."""
        known = (self.student, self.email, self.login, self.name) if self.platform == "gradescope" else ()
        told = next(filter(None, (*known, self.platform_id, self.login, self.student, self.name)), self.download)
        return f"{self.platform} {told}"


@dataclass
class Found:
    """What a download holds; `problems` has a line for everything that was not understood."""

    handed: list[Handed] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, other: Found, prefix: str) -> None:
        self.handed += [replace(one, download=prefix + one.download) for one in other.handed]
        self.problems += [prefix + line for line in other.problems]
        self.notes += other.notes


Level = dict[str, list[Entry]]  # name at the top of a folder → the files under it (a file: itself)


def read(
    download: Path,
    stack: ExitStack,
    known: frozenset[str],
    zone: tzinfo | None = None,
    force: str | None = None,
    pattern: re.Pattern[str] | None = None,
) -> Found:
    """Recognise everything in a folder or zip.

    Args:
      download: the folder or zip.
      stack: keeps archives open for as long as files are read.
      known: the names of the assignments.
      zone: of times that a platform tells without one.
      force: the platform, where it is not to be recognised.
      pattern: as nbgrader's `named_regexp`: `student_id` and `file_id`, perhaps `timestamp`, `first_name`, `last_name`, `email`.

    Raises: archives.Refused, going on from the download's name.
    """
    found = Found()
    files = archives.entries(download, stack, found.problems, _is_named)
    if pattern:
        found.add(_by_pattern(files, pattern), "")
    else:
        _recognise(files, "", found, stack, _Reading(known, zone, force, download.resolve().name))
    return found


def _is_named(name: str) -> bool:
    """Whether a platform gives such a name to what somebody has handed in, which a person's name may begin with a dot."""
    return any(naming.fullmatch(name) for naming in (CANVAS, CANVAS_TEXT, MOODLE, BLACKBOARD, EXCHANGE))


@dataclass(frozen=True)
class _Reading:
    known: frozenset[str]
    zone: tzinfo | None
    force: str | None
    folder: str  # the name of the folder or zip that is looked at

    def of(self, folder: str) -> _Reading:
        return replace(self, folder=folder)

    @property
    def slug(self) -> str | None:
        """What the repositories in this folder begin with, before a dash and the login: GitHub Classroom clones into SLUG-submissions."""
        match = SUBMISSIONS.fullmatch(self.folder)
        return match[1].casefold() if match else None


def _recognise(files: list[Entry], prefix: str, found: Found, stack: ExitStack, reading: _Reading, depth: int = 0) -> None:
    """Try every platform on this folder; if none fits, what lies in it may be downloads."""
    level = _level(files)
    for platform in (reading.force,) if reading.force else _MOST_TELLING_FIRST:
        if _FITS[platform](level, reading):
            found.add(_READERS[platform](level, reading), prefix)
            return
    for name, inside in level.items():
        if inside[0].path != name and depth < 4:
            files = [entry.under(f"{name}/") for entry in inside]
            _recognise(files, f"{prefix}{name}/", found, stack, reading.of(name), depth + 1)
        elif inside[0].path == name and name.lower().endswith(".zip") and depth < 4 and not prefix.endswith(".zip/"):
            try:
                files = archives.nested(inside[0], stack, found.problems, _is_named)
                _recognise(files, f"{prefix}{name}/", found, stack, reading.of(name), depth + 1)
            except Refused as reason:
                found.problems.append(f"{prefix}{name}: {reason}")
        elif name != REPOSITORY:
            found.problems.append(f"{prefix}{name}: no platform names a file like this; --from or --pattern says what it is")


def _level(files: Iterable[Entry]) -> Level:
    level: Level = defaultdict(list)
    for entry in files:
        level[entry.parts[0]].append(entry)
    return dict(level)


def _is_file(name: str, inside: list[Entry]) -> bool:
    return inside[0].path == name


def _is_repository(inside: list[Entry]) -> bool:
    return any(REPOSITORY in entry.parts for entry in inside)


# --- Canvas --------------------------------------------------------------------------------------------------------------


def _fits_canvas(level: Level, reading: _Reading) -> bool:
    return any(
        _is_file(name, inside) and (CANVAS.fullmatch(name) or CANVAS_TEXT.fullmatch(name)) for name, inside in level.items()
    )


def _canvas(level: Level, reading: _Reading) -> Found:
    found = Found()
    units: dict[str, list[tuple[re.Match[str], Entry]]] = defaultdict(list)
    for name, inside in level.items():
        match = CANVAS.fullmatch(name) or CANVAS_TEXT.fullmatch(name) if _is_file(name, inside) else None
        if match:
            units[match["id"]].append((match, inside[0]))
        else:
            found.problems.append(f"{name}: is not named as Canvas names files (name_userid_fileid_filename){AGAIN}")
    for number, parts in units.items():
        parts.sort(key=lambda part: int(part[0].groupdict().get("file") or 0))
        match, first = parts[-1]
        files, order = [], 0
        for one, entry in parts:
            rest = one["rest"] if "file" in one.groupdict() else f"{one['rest']}.html"
            order = max(order, int(one.groupdict().get("file") or 0))
            files.append(entry.renamed(f"{one.groupdict().get('file') or '0'}/{rest}"))
        late = any(one["late"] for one, _ in parts)
        found.handed.append(Handed("canvas", tuple(files), first.path, number, match["name"], late=late, order=order))
    return found


# --- Moodle --------------------------------------------------------------------------------------------------------------


def _fits_moodle(level: Level, reading: _Reading) -> bool:
    return any(MOODLE.fullmatch(name) for name in level)


def _moodle(level: Level, reading: _Reading) -> Found:
    found = Found()
    units: dict[tuple[str, str | None], list[tuple[str, Entry]]] = defaultdict(list)
    folders: dict[tuple[str, str | None], str] = {}
    for name, inside in level.items():
        match = MOODLE.fullmatch(name)
        if not match:
            found.problems.append(f"{name}: is not named as Moodle names submissions (Name_id_assignsubmission_file_){AGAIN}")
            continue
        key = (match["name"], match["id"])
        if match["kind"] == "file" or key not in folders:
            folders[key] = name
        for entry in inside:
            units[key].append((match["rest"] if _is_file(name, inside) else entry.path.removeprefix(f"{name}/"), entry))
    for (who, number), parts in units.items():
        files = tuple(entry.renamed(path) for path, entry in parts)
        found.handed.append(Handed("moodle", files, folders[who, number], number, who))
    return found


# --- Gradescope ----------------------------------------------------------------------------------------------------------


def _fits_gradescope(level: Level, reading: _Reading) -> bool:
    return METADATA in level or any(GRADESCOPE.fullmatch(name) and not _is_file(name, level[name]) for name in level)


def _gradescope(level: Level, reading: _Reading) -> Found:
    found = Found()
    metadata = _metadata(level[METADATA][0], found) if METADATA in level else {}
    for name, inside in level.items():
        if name == METADATA:
            continue
        match = GRADESCOPE.fullmatch(name.partition(".")[0])
        if not match and name not in metadata:
            found.problems.append(f"{name}: is not named as Gradescope names submissions (submission_ID){AGAIN}")
            continue
        files = tuple(inside if _is_file(name, inside) else (entry.under(f"{name}/") for entry in inside))
        one = _mapping(metadata.get(name))
        at = _time(one.get(":created_at"))
        base = Handed("gradescope", files, name, match[1] if match else None, at=at, order=int(match[1]) if match else 0)
        people = [_mapping(person) for person in _list(one.get(":submitters"))]
        people = [person for person in people if any(_text(person.get(key)) for key in (":sid", ":email", ":name"))]
        for person in people:  # a group's work is each member's
            sid, email = _text(person.get(":sid")), _text(person.get(":email"))
            found.handed.append(
                replace(base, name=_text(person.get(":name")), login=sid or (email or "").partition("@")[0] or None, email=email)
            )
        if not people:
            unknown = f"{METADATA} does not say whose it is"
            found.handed.append(replace(base, unknown=unknown))
    return found


def _metadata(entry: Entry, found: Found) -> dict[str, Any]:
    """The export's list of who is who; everything in it stays text."""
    try:
        text = archives.read(entry, MAX_METADATA).decode(errors="replace")
        return _mapping(_plain(yaml.parse(text, Loader=getattr(yaml, "CBaseLoader", yaml.BaseLoader))))
    except (Refused, yaml.YAMLError, ValueError) as error:
        found.problems.append(f"{METADATA}: {str(error).splitlines()[0]}")
        return {}


def _plain(events: Iterable[yaml.Event]) -> Any:
    """The document in a stream of YAML's events, without what this module has no use for (the results of tests, which may be long).

    A stack of our own: YAML's own constructors recurse, in C, and a deep enough document ends the process.
    """
    stack: list[list[Any]] = [[]]  # of each open collection what it holds; a mapping's keys and values take turns
    anchors: dict[str, Any] = {}
    for event in events:
        if isinstance(event, yaml.CollectionStartEvent):
            stack.append([event])
            if len(stack) > MAX_NESTING:
                raise ValueError("is nested too deeply")
            continue
        if isinstance(event, yaml.CollectionEndEvent):
            start, *inside = stack.pop()
            value: Any = inside
            if isinstance(start, yaml.MappingStartEvent):
                pairs = zip(inside[::2], inside[1::2], strict=False)
                value = {key: one for key, one in pairs if isinstance(key, str) and (not key.startswith(":") or key in WANTED)}
            anchor = start.anchor
        elif isinstance(event, yaml.ScalarEvent):
            value, anchor = event.value, event.anchor
        elif isinstance(event, yaml.AliasEvent):
            value, anchor = anchors.get(event.anchor), None
        else:
            continue
        if anchor:
            anchors[anchor] = value
        stack[-1].append(value)
    return stack[0][0] if stack[0] else None


def _mapping(value: Any) -> dict[str, Any]:
    return {key: inside for key, inside in value.items() if isinstance(key, str)} if isinstance(value, dict) else {}


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _text(value: Any) -> str | None:
    return value.strip() or None if isinstance(value, str) and value not in ("null", "~") else None


def _time(value: Any) -> datetime | None:
    try:
        return deadlines.timestamp(value) if isinstance(value, str) else None
    except ValueError:
        return None


# --- Blackboard ----------------------------------------------------------------------------------------------------------


def _fits_blackboard(level: Level, reading: _Reading) -> bool:
    return any(_is_file(name, inside) and BLACKBOARD.fullmatch(name) for name, inside in level.items())


def _blackboard(level: Level, reading: _Reading) -> Found:
    found = Found()
    units: dict[tuple[str, str], list[tuple[re.Match[str], Entry]]] = defaultdict(list)
    logins = _blackboard_logins(level)
    for name, inside in level.items():
        match = BLACKBOARD.fullmatch(name) if _is_file(name, inside) else None
        if match:
            units[logins[name], match["at"]].append((match, inside[0]))
        else:
            found.problems.append(
                f"{name}: is not named as Blackboard names files (Assignment_login_attempt_time_filename){AGAIN}"
            )
    for (login, at), parts in units.items():
        files = tuple(entry.renamed(match["rest"]) for match, entry in parts if match["rest"])
        told = next((entry for match, entry in parts if not match["rest"]), None)
        if told and not files:  # what was typed into Blackboard is all that there is
            files = (told.renamed("submission.txt"),)
        moment = datetime.strptime(at, "%Y-%m-%d-%H-%M-%S") if _is_date(at) else None
        aware = moment.replace(tzinfo=reading.zone) if moment and reading.zone else None
        shown = next((entry.path for match, entry in parts if match["rest"]), parts[0][1].path)
        one = Handed(
            "blackboard", files, shown, None, _blackboard_name(told, login), login, at=aware, order=int(at.replace("-", ""))
        )
        zoneless = moment is not None and aware is None
        found.handed.append(replace(one, zoneless=zoneless, assignment=in_name(parts[0][0]["title"], reading.known)))
    return found


def _blackboard_logins(level: Level) -> dict[str, str]:
    """File → login. A login may hold an underscore, and so may the assignment's title: what all files begin with is the title."""
    heads = {name: match["title"] + "_" + match["login"] for name in level if (match := BLACKBOARD.fullmatch(name))}
    split = {head: head.rpartition("_") for head in heads.values()}
    titles = {title for title, _, _ in split.values()}
    title = min(titles, key=len, default="")  # a login with an underscore makes its title longer
    whole = all(head.startswith(f"{title}_") for head in heads.values()) and len(heads) > 1
    return {name: head.removeprefix(f"{title}_") if whole else split[head][2] for name, head in heads.items()}


def _is_date(text: str) -> bool:
    try:
        datetime.strptime(text, "%Y-%m-%d-%H-%M-%S")
    except ValueError:
        return False
    return True


def _blackboard_name(told: Entry | None, login: str) -> str | None:
    """The person's name, from the text beside the files: its first line is `Name: Jane Doe (login)`."""
    if told is None:
        return None
    try:
        text = archives.read(told, MAX_TEXT).decode(errors="replace")
    except Refused:
        return None
    match = re.search(r"^\ufeff?[^:\n]{1,40}:[ \t]*(\S[^\n]*?)[ \t]*\(([^()\n]*)\)[ \t]*\r?$", text, re.M)
    return match[1] if match and match[2] == login else None


# --- GitHub --------------------------------------------------------------------------------------------------------------


def _fits_github(level: Level, reading: _Reading) -> bool:
    folders = [name for name, inside in level.items() if not _is_file(name, inside)]
    if any(_is_repository(level[name]) and REPOSITORY in {entry.parts[1] for entry in level[name]} for name in folders):
        return True
    told = [_repository_login(name, reading)[1] for name in folders]
    return any(told) if reading.slug else bool(told) and all(told)


def _repository_login(name: str, reading: _Reading) -> tuple[str | None, str | None]:
    """(assignment, login) of a repository that is named `ch44-janedoe`, or as the folder around it says."""
    if reading.slug and name.casefold().startswith(f"{reading.slug}-"):
        return in_name(reading.slug, reading.known), name[len(reading.slug) + 1 :] or None
    head, _, login = name.partition("-")
    return (head.lower(), login) if head.lower() in reading.known and login else (None, None)


def _github(level: Level, reading: _Reading) -> Found:
    found = Found()
    for name, inside in level.items():
        if _is_file(name, inside):
            found.problems.append(f"{name}: lies beside the clones, in none of them")
            continue
        assignment, login = _repository_login(name, reading)
        files = tuple(entry.under(f"{name}/") for entry in inside if REPOSITORY not in entry.parts)
        found.handed.append(Handed("github", files, name, name, None, login or name, assignment=assignment))
    return found


# --- nbgrader ------------------------------------------------------------------------------------------------------------


def _fits_nbgrader(level: Level, reading: _Reading) -> bool:
    return any(
        EXCHANGE.fullmatch(name)
        or any(len(entry.parts) > 2 and entry.parts[1].strip().lower() in reading.known for entry in inside)
        for name, inside in level.items()
        if not _is_file(name, inside) and not _is_repository(inside)
    )


def _nbgrader(level: Level, reading: _Reading) -> Found:
    found = Found()
    for name, inside in level.items():
        if _is_file(name, inside):
            found.problems.append(f"{name}: lies beside the students' folders, in none of them")
        elif any(entry.parts[1] == "course_lib" for entry in inside):
            found.problems.append(f"{name}: is a bundle as it was released, nobody's submission")
        elif match := EXCHANGE.fullmatch(name):
            files = tuple(entry.under(f"{name}/") for entry in inside)
            found.handed.append(_of_nbgrader(files, name, match["student"], _known(match["assignment"], reading), match["at"]))
        else:
            for assignment, files_of in _level(entry.under(f"{name}/") for entry in inside).items():
                if _is_file(assignment, files_of):
                    found.problems.append(f"{name}/{assignment}: lies in the student's folder, in no assignment's")
                    continue
                files = tuple(entry.under(f"{assignment}/") for entry in files_of)
                found.handed.append(_of_nbgrader(files, f"{name}/{assignment}", name, _known(assignment, reading), ""))
    return found


def _known(name: str, reading: _Reading) -> str | None:
    name = name.strip().lower()
    return name if name in reading.known else None


def _of_nbgrader(files: tuple[Entry, ...], download: str, student: str, assignment: str | None, at: str) -> Handed:
    told = next((entry for entry in files if entry.path == deadlines.TIMESTAMP), None)
    moment = _time(at)
    if told:
        with suppress(Refused):
            moment = _time(archives.read(told, 1000).decode(errors="replace")) or moment
    files = tuple(entry for entry in files if entry.path != "submission_secret.txt")  # nbgrader's key to feedback, nobody's work
    return Handed(
        "nbgrader", files, download, None, None, student, student=student, assignment=assignment, at=moment, trusts_timestamp=True
    )


def _by_pattern(files: list[Entry], pattern: re.Pattern[str]) -> Found:
    found = Found()
    units: dict[tuple[str, str], list[tuple[dict[str, str], Entry]]] = defaultdict(list)
    for entry in files:
        match = pattern.match(entry.name)
        if match:
            parts = {name: value for name, value in match.groupdict().items() if value}
            units[parts["student_id"], parts.get("timestamp", "")].append((parts, entry))
        else:
            found.problems.append(f"{entry.path}: --pattern does not match it")
    for (student, stamp), members in units.items():
        parts = members[-1][0]
        name = " ".join(filter(None, (parts.get("first_name"), parts.get("last_name")))) or None
        renamed = tuple(entry.renamed(_named(one["file_id"], entry.name)) for one, entry in members)
        written = re.sub(r"(\d{4}-\d\d-\d\d)-(\d\d)-(\d\d)-(\d\d)", r"\1 \2:\3:\4", stamp)
        at = _time(written)
        order = int(re.sub(r"\D", "", stamp) or 0)
        found.handed.append(
            Handed("pattern", renamed, members[-1][1].path, None, name, student, parts.get("email"), student, at=at, order=order)
        )
    return found


def _named(file_id: str, original: str) -> str:
    """`file_id` with the ending of the file, as nbgrader makes a name of it."""
    stem, dot, _ = file_id.rpartition(".")
    end = re.search(r"\.[^./]+$", original)
    return (stem if dot else file_id).replace("\\", "/").rpartition("/")[2] + (end[0] if end else "")


def in_name(text: str, known: frozenset[str]) -> str | None:
    """The one assignment that a name speaks of, if it does of one."""
    spoken = {match.lower() for match in re.findall(r"(?<![A-Za-z0-9])[A-Za-z]+\d+(?![0-9])", text)} & known
    return spoken.pop() if len(spoken) == 1 else None


_MOST_TELLING_FIRST = ("moodle", "gradescope", "blackboard", "github", "nbgrader", "canvas")
_FITS: dict[str, Callable[[Level, _Reading], bool]] = {
    "canvas": _fits_canvas,
    "moodle": _fits_moodle,
    "gradescope": _fits_gradescope,
    "blackboard": _fits_blackboard,
    "github": _fits_github,
    "nbgrader": _fits_nbgrader,
}
_READERS: dict[str, Callable[[Level, _Reading], Found]] = {
    "canvas": _canvas,
    "moodle": _moodle,
    "gradescope": _gradescope,
    "blackboard": _blackboard,
    "github": _github,
    "nbgrader": _nbgrader,
}
