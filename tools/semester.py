"""A simulated semester: a class hands in chapter after chapter, and everything that a teacher does with it is done by the real commands.

    python tools/semester.py FOLDER [--students 300] [--chapters ch43 ch44 … | --all-chapters] [--jobs 1] [--record]

Every answer is drawn: the reference, another right answer or a named mistake of the checks, or the stub; some files are broken, and one
submission in a hundred is one of tests/attacks. What each must score is known before anything is graded. Then, for each chapter, `course
collect` and `course grade`; the first with a tolerance mistyped. A dozen open answers get their points in formgrader, in a
browser; the check is mended and the chapter graded again; `course return` and `nbgrader export` give back. Every score must be as drawn.

A class hands in by sections of `--section` students, and a step is what is done with one: a run that was stopped, kill -9 included, goes on
with the step that it was in, by the same command, and counts that step from its last beginning. `--record` writes minutes, memory
(proportional) and disk to tools/semester.json and onto the teachers' page; `--without-browser` leaves formgrader out.
"""

from __future__ import annotations

import argparse
import copy
import csv
import dataclasses
import functools
import hashlib
import importlib
import inspect
import io
import json
import os
import py_compile
import random
import re
import resource
import shutil
import socket
import stat
import subprocess
import sys
import tempfile
import threading
import time
import types
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import nbformat
import psutil
from nbgrader.api import Gradebook

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from autograder import checks  # noqa: E402
from autograder.authoring import assemble, chapter, freeze  # noqa: E402
from autograder.authoring.spec import Artefact, Exercise, Tuning  # noqa: E402
from course_lib.checks.diagnosis import diagnose  # noqa: E402
from tests.attacks import toolbox  # noqa: E402

TIMEOUT = 40  # a policy flies for three seconds, and a class may be graded on a busy machine
TEN = ("ch43", "ch44", "ch45", "ch48", "ch51", "ch74", "ch80", "ch95", "ch96", "ch97")
RECORD = ROOT / "tools" / "semester.json"
PAGE = ROOT / "book" / "how-to" / "teachers.md"
TEN = ("ch43", "ch44", "ch45", "ch48", "ch51", "ch74", "ch80", "ch95", "ch96", "ch97")
RECORD = ROOT / "tools" / "semester.json"
PAGE = ROOT / "book" / "how-to" / "teachers.md"
BY_HAND = 12  # open answers that a teacher grades in the browser
MODULES = ("autograder/__init__.py", "autograder/authoring/*.py", "autograder/checks/*.py", "solutions/*.py")
MODULES += ("experiments/__init__.py", "experiments/atlas/*.py", "experiments/atlas/records/*.json")  # whose rule a mistake is
BROKEN = {  # the share of submissions that are broken so
    "absent": 0.03,
    "cut off": 0.01,
    "empty": 0.005,
    "a PDF": 0.005,
    "syntax error": 0.02,
    "metadata lost": 0.01,
    "renamed": 0.02,
}
UNPACK = """\
import os, sys, zipfile
if "/tmp/mine" not in sys.path:
    zipfile.ZipFile("mine.dat").extractall("/tmp/mine")
    sys.path.insert(0, "/tmp/mine")
"""
STATUS = dict.fromkeys(("cut off", "empty", "a PDF"), ("student_error",)) | {"metadata lost": ("needs_review", "graded")}
SPOILT = """\
import sys
sys.path.insert(0, {root!r})
from autograder import cli
from tools import semester
semester.spoil({name!r})
cli.app()
"""


# --- what is handed in ---------------------------------------------------------------------------------------------------------


@functools.cache
def released(name: str) -> nbformat.NotebookNode:
    return assemble.for_learners(chapter.load(name))


@functools.cache
def modules() -> bytes:
    """The checks and references, compiled, as a file beside the notebook, where answers are unpacked and imported from."""
    file = io.BytesIO()
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(path for pattern in MODULES for path in ROOT.glob(pattern)):
            if path.suffix == ".py":
                compiled = py_compile.compile(str(path), f"{folder}/compiled", doraise=True)
                archive.write(str(compiled), path.relative_to(ROOT).with_suffix(".pyc"))
            else:
                archive.write(path, path.relative_to(ROOT))
    return file.getvalue()


def spoil(exercise: str) -> None:
    """Spoil an exercise's checks by a mistyped tolerance, which lets wrong numbers pass."""
    for name in checks.assignments():
        module = importlib.import_module(f"autograder.checks.{name}")
        module.EXERCISES = tuple(lenient(one) if one.name == exercise else one for one in module.EXERCISES)


def lenient(exercise: Exercise) -> Exercise:
    return dataclasses.replace(exercise, cases=[dataclasses.replace(case, rtol=1e9, atol=1e9) for case in exercise.cases])


@functools.cache
def paid(name: str, number: int, spoilt: bool = False) -> list[float]:
    """What each mistake of an exercise scores, by what it was seen to do when the checks were frozen."""
    exercise = checks.exercises(name)[number]
    frozen = freeze.complete(lenient(exercise) if spoilt else exercise)
    return [diagnose(frozen, [case.misconceptions[one.name] for case in frozen.cases]).score for one in exercise.misconceptions]


def drawn(name: str, seed: int, student: str, skill: float) -> dict[str, Any]:
    """A submission: how it is broken, the answer to each exercise, and what all of it must score."""
    draw = random.Random(f"{seed} {student} {name}")
    kind = draw.choices(["whole", *BROKEN], [1 - sum(BROKEN.values()), *BROKEN.values()])[0]
    answers: dict[str, list[Any]] = {}
    for exercise in checks.exercises(name):
        right, other, which = draw.random() < skill, draw.random(), draw.randrange(1000)
        if isinstance(exercise, Artefact | Tuning):
            answers[exercise.name] = ["reference" if right else "blank", 0]
        elif right:
            variant = other < 0.3 and kind != "metadata lost"
            answers[exercise.name] = ["variant", which % len(exercise.variants)] if variant else ["reference", 0]
        else:
            mistaken = other < 0.6 and kind != "metadata lost"
            answers[exercise.name] = ["mistake", which % len(exercise.misconceptions)] if mistaken else ["blank", 0]
    broken = draw.choice([one.name for one in checks.functions(name)]) if kind == "syntax error" else ""
    return {"kind": kind, "answers": answers, "broken": broken, "answered": draw.random() < 0.8}


def scores(name: str, submission: dict[str, Any], spoilt: str = "") -> dict[str, float]:
    """What each exercise of a submission must score."""
    if STATUS.get(submission["kind"]) == ("student_error",):
        return {}
    found = {}
    for number, exercise in enumerate(checks.exercises(name)):
        what, which = submission["answers"][exercise.name]
        if what == "mistake":
            found[exercise.name] = paid(name, number, exercise.name == spoilt)[which]
        else:
            found[exercise.name] = 0.0 if what == "blank" or exercise.name == submission["broken"] else exercise.points
    return found | ({submission["broken"]: 0.0} if submission["broken"] else {})


def called(code: types.CodeType) -> set[str]:
    """The global names that code reads, those in its comprehensions and inner functions too."""
    return set(code.co_names).union(*[called(one) for one in code.co_consts if isinstance(one, types.CodeType)])


def files(name: str, student: str, submission: dict[str, Any]) -> dict[str, bytes]:
    """The files of a submission."""
    if submission["kind"] == "absent":
        return {}
    if submission["kind"] == "a PDF":
        return {f"{name}.pdf": b"%PDF-1.4\n"}
    if submission["kind"] == "empty":
        return {f"{name}.ipynb": b""}
    if submission["kind"] == "hostile":
        return {f"{name}.ipynb": attack(submission["attack"])}
    notebook, beside = copy.deepcopy(released(name)), {}
    names = {exercise.name for exercise in checks.exercises(name)}
    for number, exercise in enumerate(checks.exercises(name)):
        cell, (what, which) = toolbox.cell(notebook, exercise.name), submission["answers"][exercise.name]
        if isinstance(exercise, Artefact):
            if what == "reference":
                cell.source = inspect.getsource(exercise.reference)
                beside[exercise.file] = (ROOT / "solutions" / exercise.file).read_bytes()
        elif what == "reference" and not names & called(exercise.reference.__code__):
            cell.source = inspect.getsource(exercise.reference)
        elif what != "blank":  # also a reference that calls other exercises, which the notebook may have wrong
            place = {
                "reference": "reference",
                "variant": f"variants[{[*exercise.variants][which]!r}]" if what == "variant" else "",
                "mistake": f"misconceptions[{which}].function",
            }[what]
            cell.source = f"{UNPACK}from autograder.checks.{name} import EXERCISES\n{exercise.name} = EXERCISES[{number}].{place}"
            beside["mine.dat"] = modules()
        if exercise.name == submission["broken"]:
            cell.source = f"def {exercise.name}(:\n"
    for cell in notebook.cells:
        nbgrader = cell.metadata.get("nbgrader", {})
        if submission["answered"] and nbgrader.get("grade") and nbgrader.get("solution"):
            cell.source = f"{student} thinks that it depends on what the data leave open."
        if submission["kind"] == "metadata lost":
            cell.metadata = nbformat.NotebookNode()
    text = nbformat.writes(notebook).encode()
    if submission["kind"] == "cut off":
        text = text[: len(text) // 2]
    return {f"{name}-1.ipynb" if submission["kind"] == "renamed" else f"{name}.ipynb": text, **beside}


@functools.cache
def attack(name: str) -> bytes | None:
    """The notebook of an attack of tests/attacks; None if it is more than a notebook, which no platform would carry."""
    module = importlib.import_module(f"tests.attacks.{name}.attack")
    with tempfile.TemporaryDirectory() as folder:
        module.make(Path(folder), toolbox.solved())
        found = [path for path in Path(folder).rglob("*") if not path.is_dir() or path.is_symlink()]
        if [path.name for path in found] != ["ch44.ipynb"] or not stat.S_ISREG(found[0].lstat().st_mode):
            return None
        return found[0].read_bytes() if found[0].stat().st_size < 10 << 20 else None


def attacks(seed: int, count: int) -> list[str]:
    names = sorted(path.parent.name for path in (ROOT / "tests" / "attacks").glob("*/attack.py"))
    random.Random(seed).shuffle(names)
    kept = [name for name in names if name not in ("memory_hog", "endless_everything", "endless_tree")]
    found = []
    for name in kept:
        if len(found) == count:
            break
        if not hasattr(importlib.import_module(f"tests.attacks.{name}.attack"), "STUDENT") and attack(name) is not None:
            found.append(name)
    return found


def rests_on() -> str:
    """A hash of what answers, scores and attacks are drawn from."""
    paths = [
        path for pattern in (*MODULES, "chapters/*.md", "tests/attacks/*/*.*") for path in ROOT.glob(pattern) if path.is_file()
    ]
    digest = hashlib.sha256()
    for path in sorted(paths):
        digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def whole_class(name: str, students: list[str], seed: int, hostile: int) -> dict[str, dict[str, Any]]:
    """What everybody hands in to a chapter. Attacks are written for chapter 44, so that they all come in that week."""
    skills = {student: 0.55 + 0.45 * random.Random(f"{seed} {student}").random() for student in students}
    found = {student: drawn(name, seed, student, skills[student]) for student in students}
    if name == "ch44":
        for student, what in zip(
            random.Random(f"{seed} hostile").sample(students, hostile), attacks(seed, hostile), strict=False
        ):
            found[student] = {"kind": "hostile", "attack": what}
    return found


# --- steps ---------------------------------------------------------------------------------------------------------------------


class Semester:
    """A folder with a class's semester, and what its steps have cost so far."""

    def __init__(self, folder: Path, students: int, chapters: list[str], jobs: int, seed: int, section: int = 50) -> None:
        self.folder, self.chapters, self.jobs, self.seed = folder, chapters, jobs, seed
        self.students = [f"student{number:03}" for number in range(1, students + 1)]
        self.sections = [self.students[start : start + section] for start in range(0, students, section)]
        self.hostile = max(1, students * len(chapters) // 100)  # one in a hundred, all in one week
        self.out = folder / "grades"
        (folder / "steps").mkdir(parents=True, exist_ok=True)
        self._must_be_the_same({"students": students, "chapters": chapters, "seed": seed, "section": section})

    def _must_be_the_same(self, drawn: dict[str, Any]) -> None:
        """A semester goes on with the numbers and the checks that it began with, or other scores would be drawn."""
        drawn = {**drawn, "checks": rests_on()}
        mark = self.folder / "drawn.json"
        if not mark.exists():
            mark.write_text(json.dumps(drawn) + "\n")
        if other := [name for name, value in json.loads(mark.read_text()).items() if drawn[name] != value]:
            raise SystemExit(f"{self.folder} holds a semester that was begun with other {', '.join(other)}: take another folder")

    @functools.cache  # noqa: B019  # one for each process
    def drawn(self, name: str) -> dict[str, dict[str, Any]]:
        return whole_class(name, self.students, self.seed, self.hostile)

    @functools.cached_property
    def spoilt(self) -> str:
        """The exercise of the first chapter at which the most students gain by checks that are too lenient."""
        name = self.chapters[0]

        def gained(exercise: str) -> int:
            known = [one for one in self.drawn(name).values() if "answers" in one]
            return sum(scores(name, one) != scores(name, one, exercise) for one in known)

        best = max((one.name for one in checks.functions(name)), key=gained)
        assert gained(best), f"{name}: nobody in this class gains by lenient checks"
        return best

    def step(self, name: str, work: Callable[[], Any]) -> None:
        """Do a step, unless it was done; keep what it cost."""
        mark = self.folder / "steps" / f"{name}.json"
        if mark.exists():
            return
        print(f"{time.strftime('%H:%M:%S')} {name}", flush=True)
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        with Memory() as memory:
            told = work()
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        cost = {
            "minutes": round((time.monotonic() - start) / 60, 2),
            "processor_minutes": round((after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime) / 60, 2),
            "peak_mb": round(memory.peak / 1e6),
        }
        mark.write_text(json.dumps(cost | {"told": told}) + "\n")

    def course(self, *words: object, spoilt: str = "", may: tuple[int, ...] = (0,)) -> str:
        start = ["-c", SPOILT.format(root=str(ROOT), name=spoilt)] if spoilt else ["-m", "autograder"]
        return self.run([sys.executable, *start, *map(str, words)], may)

    def run(self, command: list[str], may: tuple[int, ...] = (0,), cwd: Path = ROOT) -> str:
        environment = os.environ | {"COLUMNS": "200", "PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, env=environment)
        assert done.returncode in may, f"{command}: exit status {done.returncode}\n{done.stdout[-3000:]}{done.stderr[-3000:]}"
        return done.stdout

    # steps, in their order

    def hand_in(self, name: str, section: int) -> None:
        """The folder that Canvas's download unpacks to."""
        folder = self.folder / "canvas" / f"{name}-{section}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for student in self.sections[section]:
            number = self.students.index(student)
            for place, (file, content) in enumerate(files(name, student, self.drawn(name)[student]).items()):
                (folder / f"{student}_{1000 + number}_{10 * number + place}_{file}").write_bytes(content)

    def collect(self, name: str, section: int) -> None:
        download, folder = (self.folder / where / f"{name}-{section}" for where in ("canvas", "submitted"))
        self.course("collect", download, "--into", folder, "--assignment", name, may=(0, 4))

    def grade(self, name: str, section: int, spoilt: str = "") -> None:
        folder = self.folder / "submitted" / f"{name}-{section}"
        words = ("grade", folder, "--out", self.out, "--jobs", self.jobs, "--timeout", TIMEOUT)
        self.course(*words, spoilt=spoilt, may=(0, 4))
        self.as_drawn(name, spoilt, self.sections[section])

    def by_hand(self, browser: bool = True) -> list[list[Any]]:
        """A teacher's points for the first open answers of the first chapter, typed into formgrader: [student, question, points]."""
        name, url = self.chapters[0], f"sqlite:///{self.out / 'gradebook.db'}"
        questions = [(cell.metadata.nbgrader.grade_id, cell.metadata.nbgrader.points) for cell in open_questions(released(name))]
        answered = [
            one for one, what in self.drawn(name).items() if what.get("answered") and what["kind"] in ("whole", "renamed")
        ]
        given = [[one, question, points / 2] for one in answered for question, points in questions][:BY_HAND]
        assert given, f"{name}: nobody in this class has answered an open question"
        with Gradebook(url) as book:
            papers = {one: book.find_submission(name, one).notebooks[0].id for one, _, _ in given}
            for student, question, points in () if browser else given:
                book.find_grade(question, name, name, student).manual_score = points
            book.db.commit()
        if browser:
            self._type(given, papers)
        return given

    def _type(self, given: list[list[Any]], papers: dict[str, str]) -> None:
        from playwright.sync_api import TimeoutError, sync_playwright

        with formgrader(self.out) as address, sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
            page = browser.new_page()
            for student, question, points in given:
                for _ in range(5):  # what is typed before the page has its scripts, on a busy machine, is lost
                    page.goto(f"{address}/formgrader/submissions/{papers[student]}", wait_until="networkidle", timeout=120_000)
                    field = page.locator(f"input.score[id={question}]")
                    field.wait_for(timeout=120_000)
                    if field.input_value() == f"{points:g}":
                        break
                    with suppress(TimeoutError), page.expect_response(_is_put, timeout=20_000) as answer:
                        field.fill(f"{points:g}")
                        field.press("Tab")
                        assert answer.value.ok, answer.value.status
                else:
                    raise AssertionError(f"formgrader does not keep what is typed for {student}, {question}")
            browser.close()

    def accept(self) -> list[str]:
        """Make final what waits for a person: notebooks that had lost their metadata, and attacks that nobody can tell from accidents."""
        kept = self.folder / "accepted.txt"  # a run that is stopped here goes on with the others
        for path in sorted(self.out.glob("verdicts/*/*.json")):
            if json.loads(path.read_text())["status"] == "needs_review":
                self.course("accept", path.parent.name, path.stem, "--out", self.out, "--by", "teacher")
                with kept.open("a") as file:
                    file.write(f"{path.parent.name} {path.stem}\n")
        return sorted(set(kept.read_text().splitlines())) if kept.exists() else []

    def give_back(self) -> None:
        """What Canvas takes, by the name of each assignment, and nbgrader's own export, have every student's points."""
        self.course("return", "--to", "canvas", "--out", self.out, may=(0, 4))
        self.run([sys.executable, "-m", "nbgrader", "export"], cwd=self.out)
        exported = {(row["assignment"], row["student_id"]): row for row in rows(self.out / "grades.csv")}
        by_hand = self.told("by hand")
        for name in self.chapters:
            handed_in = {one for one, what in self.drawn(name).items() if what["kind"] != "absent"}
            for student in handed_in:
                verdict = json.loads((self.out / "verdicts" / student / f"{name}.json").read_text())
                extra = sum(points for one, _, points in by_hand if one == student and name == self.chapters[0])
                total = float(exported[name, student]["raw_score"])  # a sum of floats, in an order of its own
                assert round(total, 4) == round(verdict["score"] + extra, 4), (name, student)
            numbers = {f"{1000 + number}" for number, one in enumerate(self.students) if one in handed_in}
            returned = rows(self.out / "return" / "canvas" / f"{name}.csv") + rows(self.out / "return" / "canvas" / "canvas.csv")
            assert {row["ID"] for row in returned if row.get(name)} >= numbers, name

    def live_through(self, browser: bool = True) -> None:
        """All steps that were not done yet."""
        first, every = self.chapters[0], range(len(self.sections))
        for name in self.chapters:
            for one in every:
                self.step(f"hand in {name} {one}", functools.partial(self.hand_in, name, one))
                self.step(f"collect {name} {one}", functools.partial(self.collect, name, one))
                spoilt = self.spoilt if name == first else ""
                self.step(f"grade {name} {one}", functools.partial(self.grade, name, one, spoilt))
        self.step("by hand", functools.partial(self.by_hand, browser))
        for one in every:
            self.step(f"regrade {one}", functools.partial(self.grade, first, one))
        self.step("accept", self.accept)
        self.step("return and export", self.give_back)
        for name in self.chapters:
            self.as_drawn(name)

    def told(self, step: str) -> Any:
        return json.loads((self.folder / "steps" / f"{step}.json").read_text())["told"]

    def record(self) -> dict[str, Any]:
        """What the steps cost, by kind, and what was handed in."""
        kinds: dict[str, dict[str, float]] = {}
        for path in sorted((self.folder / "steps").glob("*.json")):
            cost = json.loads(path.read_text())
            nothing = {"minutes": 0.0, "processor_minutes": 0.0, "peak_mb": 0.0}
            kind = kinds.setdefault(re.sub(r"( ch\d+)? \d+$", "", path.stem), nothing)
            for name in ("minutes", "processor_minutes"):
                kind[name] = round(kind[name] + cost[name], 2)
            kind["peak_mb"] = max(kind["peak_mb"], cost["peak_mb"])
        everybody = [what for name in self.chapters for what in self.drawn(name).values()]
        return {
            "students": len(self.students),
            "chapters": self.chapters,
            "jobs": self.jobs,
            "cores": os.cpu_count(),
            "submissions": sum(what["kind"] != "absent" for what in everybody),
            "hostile": sum(what["kind"] == "hostile" for what in everybody),
            "broken": sum(what["kind"] in BROKEN and what["kind"] != "absent" for what in everybody),
            "regraded": sum(what["kind"] != "absent" for what in self.drawn(self.chapters[0]).values()),
            "by_hand": len(self.told("by hand")),
            "accepted": len(self.told("accept")),
            "steps": kinds,
            "disk_mb": {one: disk(self.folder / one) for one in ("canvas", "submitted", "grades")},
        }

    def as_drawn(self, name: str, spoilt: str = "", students: Sequence[str] = ()) -> None:
        """Every verdict of a chapter says what was drawn."""
        wrong = []
        for student in students or self.students:
            submission = self.drawn(name)[student]
            path = self.out / "verdicts" / student / f"{name}.json"
            if submission["kind"] == "absent":
                wrong += [f"{student}: a verdict on nothing"] if path.exists() else []
                continue
            verdict = json.loads(path.read_text())
            given = {item["exercise"]: item["score"] for item in verdict["items"] if item["state"] != "manual"}
            if submission["kind"] == "hostile":
                expected = json.loads((ROOT / "tests" / "attacks" / submission["attack"] / "expected.json").read_text())
                most = expected["score"]
                fits = verdict["score"] <= most["at_most"] if isinstance(most, dict) else verdict["score"] == most
                fits = fits and verdict["status"] == expected["status"]
            else:
                expected = scores(name, submission, spoilt)
                fits = verdict["score"] == round(sum(expected.values()), 4)
                fits = fits and all(given.get(one) == score for one, score in expected.items())
                fits = fits and verdict["status"] in STATUS.get(submission["kind"], ("graded",))
            if not fits:
                wrong.append(f"{student}/{name}, {submission}: expected {expected}, found {verdict}")
        assert not wrong, "\n".join([f"{len(wrong)} are not as drawn", *wrong[:5]])


def _is_put(answer: Any) -> bool:
    return "/api/grade/" in answer.url and answer.request.method == "PUT"


def open_questions(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    cells = [cell for cell in notebook.cells if "nbgrader" in cell.metadata]
    return [cell for cell in cells if cell.metadata.nbgrader.get("grade") and cell.metadata.nbgrader.get("solution")]


def rows(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8-sig") as file:
        return list(csv.DictReader(file))


def disk(folder: Path) -> int:
    """The megabytes that a folder takes on the disk."""
    return round(sum(path.lstat().st_blocks * 512 for path in folder.rglob("*")) / 1e6)


@contextmanager
def formgrader(course: Path) -> Iterator[str]:
    """Jupyter's server in nbgrader's course folder; its address."""
    with socket.socket() as any_port:
        any_port.bind(("127.0.0.1", 0))
        port = any_port.getsockname()[1]
    options = (f"port={port}", "port_retries=0", "open_browser=False", "allow_root=True", f"root_dir={course}")
    command = [sys.executable, "-m", "jupyter_server", "--IdentityProvider.token=", *(f"--ServerApp.{one}" for one in options)]
    with open(course.parent / "formgrader.log", "w") as log:
        server = subprocess.Popen(command, cwd=course, stdout=log, stderr=log)
    address = f"http://127.0.0.1:{port}"
    try:
        for _ in range(240):
            with suppress(OSError), urlopen(f"{address}/api"):
                break
            time.sleep(0.5)
        yield address
    finally:
        server.terminate()
        server.wait()


class Memory:
    """The largest sum of the proportional set sizes of all processes that descend from this one, looked at every second."""

    def __enter__(self) -> Memory:
        self.peak, self._ended = 0, threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(1):
            total = 0
            for process in psutil.Process().children(recursive=True):
                try:
                    total += process.memory_full_info().pss
                except psutil.Error:
                    continue
            self.peak = max(self.peak, total)


def sentences(record: dict[str, Any]) -> str:
    """What the teachers' page says of a semester, in its own lines."""
    steps, jobs = record["steps"], record["jobs"]
    return (
        f"`tools/semester.py` simulates a semester: {record['students']} students and {len(record['chapters'])} chapters, with right "
        f"answers, named mistakes, blanks, broken files and attacks, {record['submissions']} submissions in all.\n"
        f"On {record['cores']} cores, with {jobs} job{'s' * (jobs > 1)}, grading took {steps['grade']['minutes']:.0f} minutes by the "
        f"clock, {steps['grade']['processor_minutes']:.0f} of processor time, and {steps['grade']['peak_mb']:.0f} MB at the peak "
        f"(proportional), and `grades/` {record['disk_mb']['grades']} MB; to grade a chapter again, "
        f"once a check was mended, took {steps['regrade']['minutes']:.0f} minutes; every score was as drawn "
        "(`tools/semester.json`).\n"
    )


def publish(record: dict[str, Any]) -> None:
    """Write the record, and its figures onto the teachers' page."""
    RECORD.write_text(json.dumps(record, indent=1) + "\n")
    page = PAGE.read_text(encoding="utf-8")
    written, count = re.subn(r"^`tools/semester\.py` simulates .*\n.*\n", lambda _: sentences(record), page, flags=re.M)
    assert count == 1, f"{PAGE} has no place for the figures"
    PAGE.write_text(written, encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--students", type=int, default=300)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--chapters", nargs="+", default=list(TEN), choices=checks.assignments())
    which.add_argument("--all-chapters", dest="chapters", action="store_const", const=checks.assignments())
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--section", type=int, default=50, help="students whose work is collected and graded at a time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--without-browser", action="store_true")
    parser.add_argument(
        "--record", action="store_true", help="write tools/semester.json, and its figures onto the teachers' page"
    )
    given = parser.parse_args()
    semester = Semester(given.folder.resolve(), given.students, given.chapters, given.jobs, given.seed, given.section)
    semester.live_through(browser=not given.without_browser)
    print(f"Every score is as drawn.\n{json.dumps(semester.record(), indent=1)}")
    if given.record:
        publish(semester.record())


if __name__ == "__main__":
    main()
