"""`course collect`: what a platform lets teachers download becomes SUBMITTED/STUDENT/ASSIGNMENT/ASSIGNMENT.ipynb.

Beside the students' folders it writes `.collected.json`, which `course return` reads, and `.due.yml`, which `course grade` reads.
Everything that was not understood is a line; what was handed in is never lost: an attempt that no longer counts is kept under `.attempts`.
Collecting the same again changes nothing.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import json
import os
import re
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from autograder.authoring import chapter
from autograder.grading import deadlines
from autograder.grading.deadlines import Deadlines
from autograder.grading.names import label
from autograder.grading.verdicts import clean_text, write_atomically
from autograder.platforms import archives, attempts, downloads, roster
from autograder.platforms.archives import Entry, Refused
from autograder.platforms.attempts import Attempt, Judge, Store
from autograder.platforms.downloads import Handed

COLLECTED = ".collected.json"
SCHEMA = 1
PEOPLES_IDS = ("canvas", "moodle")  # where an id is a person's, and names are what people are called
ARCHIVE = re.compile(r"\.(?:zip|7z|rar|tar|tgz|tbz2?|txz|(?:tar\.)?(?:gz|bz2|xz|zst))$", re.I)
NOTEBOOK = re.compile(r"\.ipynb(?:\.json|\.txt)?$", re.I)
COPIED = re.compile(r"^copy of | ?\(\d+\)$|-\d+$|-copy\d*$|_\d+$", re.I)  # what systems add to a name that is taken


class CollectError(ValueError):
    """Nothing was collected; the message says what to do."""


@dataclass
class Paper:
    """One attempt at one assignment, as it will be laid out: file in the student's folder → file of the download."""

    attempt: Attempt
    files: dict[str, Entry]
    late: bool = False
    kept: list[str] = field(default_factory=list)  # names of other notebooks that came with it, for the same assignment


@dataclass
class Collected:
    """What was done: an entry for each submission that counts, and lines."""

    entries: list[dict[str, Any]] = field(default_factory=list)
    kept: dict[tuple[str, str], list[str]] = field(default_factory=dict)  # (student, assignment) → notebooks that do not count
    problems: list[str] = field(default_factory=list)  # not understood
    notes: list[str] = field(default_factory=list)


def collect(
    sources: Sequence[Path],
    into: Path,
    assignment: str | None = None,
    names: Path | None = None,
    due: Path | None = None,
    force: str | None = None,
    pattern: str | None = None,
    judge: Judge | None = None,
    environment: Callable[[], str] = lambda: "",
    dry_run: bool = False,
) -> Collected:
    """Collect downloads into `into`.

    Args:
      sources: folders or zips.
      into: SUBMITTED, made if it is not there.
      assignment: whose notebooks these are; by default their names, folders or cells say it.
      names: a CSV, see `roster.load`.
      due: due dates, see `deadlines`; those in `into` by default.
      force: a platform of `downloads.PLATFORMS`.
      pattern: a regular expression for names that no platform makes, as nbgrader's zip_collect takes.
      judge: keep of several attempts the best by its verdicts, instead of the last.
      environment: what its verdicts depend on beside the submission.
      dry_run: write nothing.

    Raises: CollectError, roster.RosterError, deadlines.DeadlineError, attempts.BrokenIndex.
    """
    known = frozenset(_grade_ids())
    if assignment is not None and assignment not in known:
        in_order = sorted(known, key=lambda name: (len(name), name))  # ch101 after ch97
        raise CollectError(f"--assignment {assignment}: there is no such assignment; take one of {', '.join(in_order)}")
    if due is None and (into / deadlines.FILE).is_file():
        due = into / deadlines.FILE
    rules = deadlines.load(due, known) if due else Deadlines()
    people = roster.load(names) if names else None
    expression = _compiled(pattern)
    _check_places(sources, into)
    done = Collected()
    with ExitStack() as stack:
        papers = []
        for source in sources:
            try:
                found = downloads.read(source, stack, known, rules.zone, force, expression)
            except Refused as reason:
                raise CollectError(f"{source}: {reason}") from None
            if not found.handed:
                found.problems.append(f"{source}: nothing in it is named as {force or 'a platform'} names submissions")
            done.problems += found.problems
            done.notes += found.notes
            papers += _Sorting(known, assignment, people, rules, _students(into), stack, done).papers(found.handed, str(source))
        if not papers:
            raise CollectError(f"nothing was collected: {'; '.join(done.problems[:3])}")
        if dry_run:
            latest = {(one.attempt.student, one.attempt.assignment): one for one in papers}
            done.kept = {key: one.kept for key, one in latest.items()}
            done.entries = [_entry(one.attempt, 1, rules, done, one.late) for _, one in sorted(latest.items())]
            return done
        into.mkdir(parents=True, exist_ok=True)
        with _one_at_a_time(into):
            _lay_out(papers, into, rules, done, judge, environment)
            if due and due != into / deadlines.FILE:
                write_atomically(into / deadlines.FILE, due.read_text(encoding="utf-8-sig"))
    return done


def _compiled(pattern: str | None) -> re.Pattern[str] | None:
    if pattern is None:
        return None
    try:
        expression = re.compile(pattern)
    except re.error as error:
        raise CollectError(f"--pattern: is no regular expression ({error})") from None
    missing = {"student_id", "file_id"} - set(expression.groupindex)
    if missing:
        raise CollectError(
            f"--pattern: has no group (?P<{sorted(missing)[0]}>…); nbgrader's named_regexp, which this is, wants student_id and file_id"
        )
    return expression


def _check_places(sources: Sequence[Path], into: Path) -> None:
    if into.exists() and not into.is_dir():
        raise CollectError(f"--into {into}: is a file; name a folder")
    for source in sources:
        if not source.exists():
            raise CollectError(f"{source}: there is no such folder or zip")
        one, other = source.resolve(), into.resolve()
        if one == other or (one in other.parents and source.is_dir()) or other in one.parents:
            raise CollectError(f"--into {into}: lies in what is collected, or holds it; take a folder beside {source}")


def _students(into: Path) -> dict[str, tuple[str, str | None]]:
    """Student → (platform, id) of those that were collected before."""
    return {entry["student"]: (entry["platform"], entry["platform_id"]) for entry in read_collected(into)}


def read_collected(submitted: Path) -> list[dict[str, Any]]:
    """The entries of `.collected.json`; none if there is no such file. Raises: CollectError."""
    path = submitted / COLLECTED
    if not path.is_file():
        return []
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["schema"] != SCHEMA or not all(
            {"student", "assignment", "platform", "platform_id"} <= set(one) for one in document["entries"]
        ):
            raise ValueError("unknown schema")
        return document["entries"]
    except (ValueError, KeyError, TypeError) as error:
        raise CollectError(f"{path}: is not as `course collect` writes it ({error}); move it away and collect again") from None


# --- what belongs to whom, and to which assignment ---------------------------------------------------------------------------


@dataclass
class _Sorting:
    known: frozenset[str]
    assignment: str | None
    people: roster.Roster | None
    rules: Deadlines
    before: dict[str, tuple[str, str | None]]
    stack: ExitStack
    done: Collected
    strangers: dict[str, Handed] = field(default_factory=dict)  # person → what they handed in, where nothing says whose it is

    def papers(self, handed: Sequence[Handed], source: str) -> list[Paper]:
        labels = self._labels(handed)
        opened = [(one, self._opened(one)) for one in handed]
        papers, without = [], []
        for one, files in opened:
            student = labels[one.person]
            found = self._of_one(one, student, files)
            papers += found
            if not found:
                without.append((one, student, files))
        common = {paper.attempt.assignment for paper in papers}
        for one, student, files in without:  # handed in, but no notebook: the grader has a verdict for that, too
            named = self.assignment or one.assignment or (next(iter(common)) if len(common) == 1 else None)
            seen = ", ".join(entry.name for entry in files[:3]) or "nothing at all"
            notebook = any(NOTEBOOK.search(entry.name) for entry in files)
            packed = ", ".join(entry.name for entry in files if ARCHIVE.search(entry.name))
            if named and files:
                where = f"collected as it is, for {named}"
            else:
                where = "not collected" if packed or not files else "not collected; --assignment says for which chapter"
            if packed:
                where += f"; unpack {packed}, name the notebook as the download names its files, and collect again"
            what = "no notebook that one can tell to be of a chapter" if notebook else "no notebook"
            self.done.problems.append(f"{one.download}: {student} handed in {what} ({seen}); {where}")
            if named and files:
                papers.append(self._paper(one, student, named, self._beside(one, files, "", named, None)))
        self._tell_strangers(labels, {paper.attempt.student for paper in papers})
        if any(one.zoneless for one in handed):
            self.done.notes.append(
                f"{source}: its times have no zone and are not used; a file with `zone: Europe/London`, given by --due, tells it"
            )
        return papers

    def _labels(self, handed: Sequence[Handed]) -> dict[str, str]:
        """Each person's folder: what --names says; else what the platform shows, with the id where two are called the same."""
        labels: dict[str, str] = {}
        same: dict[tuple[str, str], str] = {}
        owners = {student: (platform, number) for student, (platform, number) in self.before.items() if platform in PEOPLES_IDS}
        for one in handed:
            if one.person in labels:
                continue
            mapped = (
                self.people.student(id=one.platform_id, login=one.login, email=one.email, name=one.name) if self.people else None
            )
            shown = one.student or one.login or one.name or one.platform_id or one.download
            if one.unknown:
                shown = one.download.rpartition("/")[2]
            default = label(shown.strip())
            if one.platform_id and one.platform in PEOPLES_IDS and not mapped:
                platform, number = owners.setdefault(default, (one.platform, one.platform_id))
                if platform == one.platform and number != one.platform_id:
                    default = label(f"{shown}-{one.platform_id}".strip())
            labels[one.person] = mapped or default
            if mapped and one.platform_id and one.platform in PEOPLES_IDS:
                first = same.setdefault((one.platform, mapped), one.platform_id)
                if first != one.platform_id:
                    self.done.notes.append(
                        f"{one.download}: --names has {mapped} for {first} and for {one.platform_id}, whose work is taken for attempts of"
                        " one person; if they are two, give each a student"
                    )
            if not mapped:
                self.strangers[one.person] = one
        return labels

    def _tell_strangers(self, labels: dict[str, str], collected: Collection[str]) -> None:
        """Name whoever is in neither the download nor --names, and as whom their work was collected, if it was."""
        for person, one in self.strangers.items():
            under = f"; collected as {labels[person]}" if labels[person] in collected else ""
            if one.unknown:
                cure = f", until --names maps {one.platform_id or 'it'} to a student" if under else ""
                self.done.problems.append(f"{one.download}: {one.unknown}{under}{cure}")
            elif self.people:
                told = ", ".join(dict.fromkeys(filter(None, (one.platform_id, one.login, one.email, one.name))))
                cure = ""
                if one.platform == "github" and one.login == one.platform_id:
                    cure = (
                        "; a folder around the clones that is named SLUG-submissions tells where in SLUG-LOGIN the login begins"
                    )
                self.done.problems.append(f"{one.download}: --names does not have {told}{under}{cure}")
        self.strangers.clear()

    def _opened(self, one: Handed) -> list[Entry]:
        """A submission's files; of one without a notebook, those in its zips."""
        files = list(one.files)
        if any(NOTEBOOK.search(entry.name) for entry in files):
            return files
        result = []
        for entry in files:
            if not entry.name.lower().endswith(".zip"):
                result.append(entry)
                continue
            try:
                inside = archives.nested(entry, self.stack, self.done.problems)
                folder = f"{entry.path.rpartition('/')[0]}/".lstrip("/") if one.platform == "canvas" else ""
                result += [file.renamed(folder + file.path) for file in inside if _is_work(file)]
            except Refused as reason:
                self.done.problems.append(f"{entry.shown}: {reason}")
                result.append(entry)
        return result

    def _of_one(self, one: Handed, student: str, files: list[Entry]) -> list[Paper]:
        notebooks = [entry for entry in files if NOTEBOOK.search(entry.name)]
        groups: dict[str, list[Entry]] = defaultdict(list)
        for entry in notebooks:
            if name := self._assignment_of(one, entry, alone=len(notebooks) == 1):
                groups[name].append(entry)
        papers = []
        for name, candidates in groups.items():
            every = candidates
            if one.platform == "canvas":  # a second upload of the same name is a later attempt, and the files' numbers grow
                own = [entry for entry in every if COPIED.sub("", NOTEBOOK.sub("", entry.name)).casefold() == name]
                candidates = sorted(own or every, key=lambda entry: int(entry.parts[0]))
            else:
                candidates = self._one_of(one, student, name, candidates)
            if not candidates:
                papers.append(self._paper(one, student, name, self._beside(one, files, "", name, None)))
            for entry in candidates:
                others = [file for file in files if file not in candidates]
                parent = entry.path.rpartition("/")[0]
                paper = self._paper(one, student, name, self._beside(one, others, parent, name, entry))
                paper.kept = [other.name for other in every if other is not entry]
                if one.platform == "canvas":
                    paper.attempt.order, paper.attempt.download = int(entry.parts[0]), entry.shown
                papers.append(paper)
        return papers

    def _assignment_of(self, one: Handed, entry: Entry, alone: bool) -> str | None:
        spoken = downloads.in_name(NOTEBOOK.sub("", entry.name), self.known)
        if self.assignment:
            return self.assignment if alone or spoken in (None, self.assignment) else None
        folders = [downloads.in_name(part, self.known) for part in reversed(entry.parts[:-1])]
        return spoken or next(filter(None, folders), None) or one.assignment or self._by_cells(entry)

    def _by_cells(self, entry: Entry) -> str | None:
        """The assignment most of whose cells a notebook has."""
        try:
            document = json.loads(archives.read(entry, 64 << 20))
            ids = {
                cell["metadata"]["nbgrader"]["grade_id"] for cell in document["cells"] if "nbgrader" in cell.get("metadata", {})
            }
        except (Refused, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return None
        found = {name: len(ids & names) for name, names in _grade_ids().items()}
        name = max(found, key=lambda name: found[name])
        return name if found[name] else None

    def _one_of(self, one: Handed, student: str, name: str, candidates: list[Entry]) -> list[Entry]:
        """The notebook that counts: the only one, or the one with the right name, or any of equal ones; none if nobody can tell."""
        if len(candidates) == 1:
            return candidates
        for exact in (lambda entry: entry.name == f"{name}.ipynb", lambda entry: entry.name.lower() == f"{name}.ipynb"):
            named = [entry for entry in candidates if exact(entry)]
            if len(named) == 1:
                return named
        if len({_digest(entry) for entry in candidates}) == 1:
            return candidates[:1]
        shown = ", ".join(entry.path for entry in candidates[:3])
        self.done.problems.append(
            f"{one.download}: {student} handed in several notebooks for {name} ({shown}); collected under their own names"
        )
        return []

    def _beside(self, one: Handed, files: list[Entry], parent: str, name: str, notebook: Entry | None) -> dict[str, Entry]:
        """Where each file goes: the notebook under its right name, the others beside it as they lay."""
        result: dict[str, Entry] = {}
        if notebook:
            result[f"{name}.ipynb"] = notebook
        if one.platform == "github":
            files = _of_repository(files, parent)
        taken = {path.casefold() for path in result}
        for entry in files:
            path = entry.path.partition("/")[2] if one.platform == "canvas" else entry.path
            root = parent.partition("/")[2] if one.platform == "canvas" else parent
            path = path.removeprefix(f"{root}/") if root else path
            if path == deadlines.TIMESTAMP:
                if one.trusts_timestamp and one.at:
                    continue  # written anew
                path = "timestamp (handed in).txt"  # a time is what the platform says
            path = "/".join(label(part.strip()) for part in path.split("/"))
            stem, dot, end = path.rpartition(".") if "." in path.rpartition("/")[2] else (path, "", "")
            number = 2
            while path.casefold() in taken:
                path = f"{stem} ({number}){dot}{end}"
                number += 1
            taken.add(path.casefold())
            result[path] = entry
        return _artefacts_named(result, name)

    def _paper(self, one: Handed, student: str, name: str, files: dict[str, Entry]) -> Paper:
        at, told = one.at, self.people.times.get(student) if self.people else None
        if at is None and told:
            at = self._told(student, told)
        stamp, by_names = at.isoformat() if at else None, at is not None and one.at is None
        attempt = Attempt(
            student, name, one.platform, one.platform_id, one.name, one.login, one.download, stamp, one.order, by_names
        )
        return Paper(attempt, files, one.late)

    def _told(self, student: str, text: str) -> datetime | None:
        try:
            moment = deadlines.parse(text)
            if moment.tzinfo is None and self.rules.zone is None:
                raise ValueError("it has no zone, and there is no `zone` in a file given by --due")
            return moment if moment.tzinfo else moment.replace(tzinfo=self.rules.zone)
        except ValueError as error:
            self.done.problems.append(f"--names: submitted_at of {student}: {text!r} is not understood ({error})")
            return None


def _is_work(entry: Entry) -> bool:
    return archives.REPOSITORY not in entry.parts


@functools.cache
def _grade_ids() -> dict[str, set[str]]:
    """Assignment → the ids of the cells that answer its exercises and open questions."""
    return {
        page.assignment: {str(cell.exercise or cell.open_question) for cell in (*page.exercises, *page.open_questions)}
        for page in chapter.all_chapters()
    }


def _digest(entry: Entry) -> str:
    digest = hashlib.sha256()
    try:
        for piece in archives.chunks(entry):
            digest.update(piece)
    except Refused:
        return entry.path
    return digest.hexdigest()


def _of_repository(files: list[Entry], parent: str) -> list[Entry]:
    """Of a whole repository: what lies in the notebook's folder; of the top folder neither the library nor other assignments'."""
    if parent:
        return [entry for entry in files if entry.path.startswith(f"{parent}/")]
    others = {entry.parts[0] for entry in files if len(entry.parts) > 1 and NOTEBOOK.search(entry.name)} | {
        "course_lib",
        "release",
    }
    return [entry for entry in files if len(entry.parts) == 1 or entry.parts[0] not in others]


def _artefacts_named(files: dict[str, Entry], name: str) -> dict[str, Entry]:
    """A file that the assignment asks for under its name, if the only one like it was renamed on its way (`policy-1.safetensors`)."""
    copies = {path: _original(path) for path in files if "/" not in path and _original(path) != path}
    if not copies or not any(path.endswith(".safetensors") for path in copies):
        return files
    from autograder import checks  # with all that the checks import, and only where it may matter
    from autograder.authoring.spec import Artefact

    for wanted in [exercise.file for exercise in checks.exercises(name) if isinstance(exercise, Artefact)]:
        like = [path for path, original in copies.items() if original == wanted]
        if len(like) == 1 and wanted not in files:
            files = {wanted if path == like[0] else path: entry for path, entry in files.items()}
    return files


def _original(path: str) -> str:
    stem, dot, end = path.rpartition(".")
    return COPIED.sub("", stem) + dot + end


# --- laying out --------------------------------------------------------------------------------------------------------------


@contextmanager
def _one_at_a_time(into: Path) -> Iterator[None]:
    descriptor = os.open(into, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _lay_out(
    papers: Sequence[Paper], into: Path, rules: Deadlines, done: Collected, judge: Judge | None, environment: Callable[[], str]
) -> None:
    store = Store(into)
    groups: dict[tuple[str, str], list[Paper]] = defaultdict(list)
    for paper in papers:
        groups[paper.attempt.student, paper.attempt.assignment].append(paper)
    present: dict[tuple[str, str], str | None] = {}
    news: set[tuple[str, str]] = set()
    for key, group in sorted(groups.items()):
        current = store.current(key)
        if current.is_symlink() or current.parent.is_symlink() or (current.exists() and not current.is_dir()):
            raise CollectError(f"{current}: is a link or a file; move it away and collect again")
        present[key] = have = attempts.tree_hash(current) if current.is_dir() else None
        for paper in group:
            new, problems = store.take(paper.attempt, paper.files, have)
            done.problems += [f"{paper.attempt.download}: {line}" for line in problems]
            if new:
                news.add(key)
    store.save()
    late = {key for key, group in groups.items() if group[-1].late}
    entries = {(entry["student"], entry["assignment"]): entry for entry in read_collected(into)}
    for key in sorted(groups):
        have, every = present[key], attempts.ordered(store.attempts[key])
        by_hand = have is not None and have not in {attempt.sha256 for attempt in every}
        if by_hand and key not in news:
            done.notes.append(f"{'/'.join(key)}: was changed by hand since it was collected, and is left so")
            number = min(entries[key]["attempt"], len(every)) if key in entries else len(every)
            store.stamp(key, every[number - 1])
            entries[key] = _entry(every[number - 1], number, rules, done, key in late)
            continue
        winner = _winner(every, store, have, rules, judge, environment)
        if by_hand:
            done.notes.append(f"{'/'.join(key)}: what lay there is kept in {store.kept(key, have or '')}")
        store.put(key, winner, have)
        done.kept[key] = next((paper.kept for paper in groups[key] if paper.attempt.sha256 == winner.sha256), [])
        entries[key] = _entry(winner, every.index(winner) + 1, rules, done, key in late)
    store.save()  # with the scores of --best
    done.entries = [entry for key, entry in sorted(entries.items()) if key in groups]
    for name, rule in rules.rules.items():  # a slip in a name would cost somebody points
        absent = [student for student in rule.extensions if (student, name) not in entries]
        if absent and any(key[1] == name for key in groups):
            done.notes.append(f"{name}: nothing was handed in by {', '.join(sorted(absent))}, whose extension the due dates name")
    document = {"schema": SCHEMA, "entries": [entries[key] for key in sorted(entries)]}
    write_atomically(into / COLLECTED, attempts.dumps(document))
    store.tidy()


def _winner(
    every: list[Attempt], store: Store, have: str | None, rules: Deadlines, judge: Judge | None, environment: Callable[[], str]
) -> Attempt:
    if judge is None or len(every) == 1:
        return every[-1]
    shares = [_late(attempt, rules)[1] for attempt in every]
    folders = [store.where(attempt, have) for attempt in every]
    return attempts.best(every, shares, folders, judge, environment())


def _late(attempt: Attempt, rules: Deadlines) -> tuple[int, float]:
    rule = rules.rules.get(attempt.assignment)
    return rule.late(attempt.student, attempt.at) if rule and attempt.at else (0, 0.0)


def _entry(attempt: Attempt, number: int, rules: Deadlines, done: Collected, marked_late: bool) -> dict[str, Any]:
    seconds, share = _late(attempt, rules)
    if marked_late and attempt.at is None and attempt.assignment in rules.rules:
        done.problems.append(
            f"{attempt.download}: is marked as late, but not how late: no penalty; a column submitted_at in --names tells it"
        )
    return {
        "student": attempt.student,
        "assignment": attempt.assignment,
        "platform": attempt.platform,
        "platform_id": attempt.platform_id,
        "name": attempt.name,
        "login": attempt.login,
        "download": attempt.download,
        "attempt": number,
        "submitted_at": attempt.submitted_at,
        "late_seconds": seconds,
        "penalty": share,
    }


def grader(timeout: float, wall: str = "bubblewrap") -> tuple[Judge, Callable[[], str]]:
    """What --best judges with: the sandboxed judge of `course grade`. Raises: sandbox.SandboxUnavailable."""
    from autograder import grade
    from autograder.grading import judge, sandbox

    sandbox.require(wall)
    judged = functools.partial(grade.judge_folder, timeout=timeout, wall=wall)
    return (lambda student, assignment, folder: judged(student, assignment, folder)[0]), judge.environment


# --- for people --------------------------------------------------------------------------------------------------------------


def table(done: Collected) -> Table:
    """Whose file was recognised as what, and which were kept beside it."""
    result = Table("Student", "Assignment", "From", "In the download", "Attempt", "Late")
    result.columns[3].overflow = "fold"  # whole names, for finding them
    for entry in done.entries:
        kept = done.kept.get((entry["student"], entry["assignment"]))
        download = f"{entry['download']}; not {', '.join(kept)}" if kept else entry["download"]
        attempt = str(entry["attempt"]) + (f", {entry['submitted_at'][:16].replace('T', ' ')}" if entry["submitted_at"] else "")
        cells = (entry["student"], entry["assignment"], entry["platform"], download, attempt, lateness(entry))
        result.add_row(*(Text(clean_text(unicodedata.normalize("NFC", cell), 200)) for cell in cells))
    return result


def lateness(entry: dict[str, Any]) -> str:
    seconds, share = entry["late_seconds"], entry["penalty"]
    if not seconds:
        return ""
    days, rest = divmod(seconds, 86_400)
    hours, minutes = divmod(rest // 60, 60)
    shown = f"{days} d {hours} h" if days else f"{hours} h {minutes} min" if hours else f"{max(minutes, 1)} min"
    return f"{shown}, −{share:.0%}" if share else shown


def summary(done: Collected, into: Path, dry_run: bool) -> str:
    """The last line."""
    students = len({entry["student"] for entry in done.entries})
    what = f"{len(done.entries)} submission{'s' * (len(done.entries) != 1)} of {students} student{'s' * (students != 1)}"
    where = f"would be collected into {into}" if dry_run else f"collected into {into}"
    return f"{what} {where}"
