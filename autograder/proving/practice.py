"""What the page's own torch can judge: of every exercise, each answer that the checks know is judged by torch and by the page.

An exercise is offered on its page if the reference and every named mistake get the same verdict from both, word for word, and no right
answer another one; an answer that needs what the page lacks is told so, and is counted apart. `course prove` keeps a record of each
exercise (`records/practice/`), which fits as long as what it rests on is the same; the book prints it.
"""

from __future__ import annotations

import functools
import hashlib
import json
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from autograder import checks
from autograder.authoring import chapter as chapters
from autograder.authoring import contract
from autograder.authoring.chapter import Chapter
from autograder.authoring.spec import Artefact, Exercise, Tuning
from autograder.paths import COURSE_LIB, ROOT
from autograder.proving import kept

FOLDER = kept.FOLDER / "practice"
PAGE = ROOT / "book" / "practice"
PROCESS = Path(__file__).with_name("page_process.py")
LIBRARY = (
    "validate.py",
    "checks/__init__.py",
    "checks/cases.py",
    "checks/diagnosis.py",
    "checks/observing.py",
    "checks/results.py",
    "checks/telling.py",
    "control/__init__.py",
    "control/replay.py",
)
RESTS_ON = ("autograder.authoring.freeze:visible", "course_lib.checks.results:examined")  # beside this module and the page's own
ELSEWHERE = ("is not in the page; it is in the notebook", "is not in the page's torch; it is in the notebook")
PATIENCE = 600  # seconds


# ---- what the page gets ------------------------------------------------------------------------------------------------


def files() -> dict[str, Path]:
    """The modules that a page needs beside Python, by their place among each other; `judge` is the one to import."""
    own = {path.relative_to(PAGE).as_posix(): path for path in sorted(PAGE.rglob("*.py"))}
    return own | {f"course_lib/{name}": COURSE_LIB / name for name in LIBRARY}


def has_page(assignment: str) -> bool:
    """Whether there is a chapter to these checks yet."""
    return int(assignment.removeprefix("ch")) in chapters.page_files()


def page_of(chapter: Chapter, offered: Iterable[str] | None = None) -> str:
    """What a chapter's page hands to `judge.open_page`, as text.

    Args:
      chapter: its own cells, the book's answers, and those of earlier chapters come along.
      offered: exercises, with their frozen visible cases; those that the records allow if None.
    """
    import torch

    names = offered_in(chapter.assignment) if offered is None else list(offered)
    sys.path.insert(0, str(PAGE / "torch"))  # the list of names is made by a module that needs nothing of the page's torch
    try:
        import missing
    finally:
        sys.path.remove(str(PAGE / "torch"))
    exercises = {exercise.name: exercise for exercise in checks.exercises(chapter.assignment)}
    known = {f"ch{number}" for number in chapters.page_files()}
    before = [chapters.load(name) for name in sorted(known) if int(name[2:]) < chapter.number]
    page = _cells_and_answers(chapter) | {
        "cases": {name: _text(exercises[name]) for name in names},
        "earlier": {one.assignment: _cells_and_answers(one) for one in before if f"chapter={one.number}" in _code(chapter)},
    }
    return json.dumps({"page": page, "torch": missing.real_names(torch)}, ensure_ascii=False)


def _code(chapter: Chapter) -> str:
    return "\n".join(cell.source for cell in chapter.cells if cell.kind == "code")


def _cells_and_answers(chapter: Chapter) -> dict[str, Any]:
    cells = [cell for cell in chapter.cells if cell.kind == "code" and not cell.exercise and "live" not in cell.tags]
    return {"setup": [cell.source for cell in cells], "answers": answers(chapter)}


def answers(chapter: Chapter) -> dict[str, str]:
    """The book's own answers, as texts of cells."""
    found = contract.references(chapter, contract.sources(chapter))
    return {name: f"{one.signature}\n{one.docstring}\n{one.body}\n" for name, one in found.items()}


def _text(exercise: Exercise | Artefact | Tuning) -> str:
    from autograder.authoring import freeze
    from course_lib.checks import stored

    assert isinstance(exercise, Exercise)  # no other is offered
    return stored.to_text(freeze.visible(exercise))


# ---- the gate ----------------------------------------------------------------------------------------------------------


@dataclass
class Agreement:
    """How the page judges one exercise: of `answers`, how many get the same verdict and how many are told to use the notebook, by
    name and with what is missing. `differ` has the others: what torch's verdict is, and the page's. `reason` says why the exercise is
    not offered; "" if it is."""

    exercise: str
    answers: int = 0
    agree: int = 0
    elsewhere: dict[str, str] = field(default_factory=dict)
    differ: list[dict[str, str]] = field(default_factory=list)
    reason: str = ""

    @property
    def offered(self) -> bool:
        return not self.reason


def out_of_reach(exercise: Exercise | Artefact | Tuning) -> str:
    """Why an exercise is none for the page, whatever its answers; "" if it may be one."""
    if isinstance(exercise, Artefact):
        return "a file is judged, and no function"
    if isinstance(exercise, Tuning):
        return "settings are judged by training with them, for which there is no PyTorch"
    if any(case.view for case in exercise.cases if case.visible):
        return "many answers are right, and what they have in common is looked at with NumPy"
    import torch

    for case in exercise.cases:
        if case.visible and (made := _made(case.inputs(torch.Generator().manual_seed(0)))):
            return f"its arguments are made by course_lib: {made}"
    return ""


def _made(value: Any) -> str:
    if isinstance(value, dict):
        return value["@built"] if "@built" in value else next(filter(None, map(_made, value.values())), "")
    return next(filter(None, map(_made, value)), "") if isinstance(value, list | tuple) else ""


def rows(assignment: str, names: Iterable[str]) -> tuple[list[Agreement], list[float]]:
    """Judge all answers of some exercises of a chapter by torch and by the page, and compare. Beside it, the seconds that the page took
    for each answer."""
    from autograder.authoring import freeze
    from course_lib.checks.diagnosis import examine

    chapter, wanted = chapters.load(assignment), set(names)
    exercises = [one for one in checks.exercises(assignment) if one.name in wanted]
    reasons = {one.name: out_of_reach(one) for one in exercises}
    inside = [one for one in exercises if isinstance(one, Exercise) and not reasons[one.name]]
    told = _on_the_page(chapter, inside)
    found, seconds = [], []
    for one in exercises:
        result = Agreement(one.name, reason=reasons[one.name])
        found.append(result)
        if result.reason or not isinstance(one, Exercise):
            continue
        frozen = freeze.visible(one)
        functions = {("reference", ""): one.reference, ("text", ""): one.reference}
        functions |= {("variant", name): function for name, function in one.variants.items()}
        functions |= {("misconception", wrong.name): wrong.function for wrong in one.misconceptions}
        for kind, name, state, named, message, took in told[one.name]:
            seconds.append(took)
            right = examine(frozen, functions[kind, name])
            _count(result, kind, name, (right.state, right.misconceptions, right.message), (state, named, message))
    return found, seconds


def _count(result: Agreement, kind: str, name: str, right: tuple, here: tuple) -> None:
    answer = {"reference": "the book's answer", "text": "the book's answer, as text"}.get(kind, name)
    result.answers += 1
    if right == here:
        result.agree += 1
        return
    if here[2].endswith(ELSEWHERE):
        result.elsewhere[answer] = here[2]
        if kind == "variant":
            return
    else:
        result.differ.append({"answer": answer, "notebook": f"{right[0]}: {right[2]}", "page": f"{here[0]}: {here[2]}"})
    result.reason = result.reason or f"the page judges differently: {answer}"


def _on_the_page(chapter: Chapter, exercises: list[Exercise]) -> dict[str, list]:
    if not exercises:
        return {}
    text = page_of(chapter, [one.name for one in exercises])
    cases = json.loads(text)["page"]["cases"]
    task = {"assignment": chapter.assignment, "page": text, "cases": cases, "references": answers(chapter), "library": LIBRARY}
    command = [sys.executable, "-S", "-E", "-B", str(PROCESS)]
    done = subprocess.run(command, input=json.dumps(task), capture_output=True, text=True, timeout=PATIENCE, check=False)
    if done.returncode:
        raise RuntimeError(f"{chapter.assignment}: the page's process failed\n{done.stderr[-2000:]}")
    return json.loads(done.stdout)


# ---- kept records ------------------------------------------------------------------------------------------------------


class Keys(kept.Keys):
    """The keys of what the page can judge."""

    def key(self, assignment: str, exercise: Exercise | Artefact | Tuning) -> str:
        """A hash of all that it rests on: the exercise and its checks, the comparing code, the page's modules, the chapter's cells."""
        own = super().key(assignment, exercise)
        return hashlib.sha256(f"{own} {self._page} {self._chapter(assignment)}".encode()).hexdigest()[:16]

    @functools.cached_property
    def _page(self) -> str:
        digest = hashlib.sha256(
            self.code.reach(RESTS_ON).fingerprint.encode() + PROCESS.read_bytes() + Path(__file__).read_bytes()
        )
        for name, path in files().items():
            digest.update(name.encode() + path.read_bytes())
        return digest.hexdigest()

    @functools.cache  # noqa: B019  # as short-lived as the keys
    def _chapter(self, assignment: str) -> str:
        return json.dumps(_cells_and_answers(chapters.load(assignment)), sort_keys=True)


def unproved(assignment: str, keys: Keys | None = None) -> dict[str, str]:
    """The exercises of a chapter that have no fitting record, and why."""
    return kept.unproved(assignment, keys or Keys(), FOLDER)


def prove(assignment: str, every: bool = False, keys: Keys | None = None) -> Iterator[Agreement]:
    """Judge and keep what has no fitting record, or everything."""
    keys = keys or Keys()
    names = [one.name for one in checks.exercises(assignment)] if every else list(unproved(assignment, keys))
    if not names:
        return
    found, _ = rows(assignment, names)
    exercises = {one.name: one for one in checks.exercises(assignment)}
    records = []
    for one in found:
        plain = {name: value for name, value in asdict(one).items() if name != "exercise"} | {"offered": one.offered}
        records.append(kept.Proved(one.exercise, keys.key(assignment, exercises[one.exercise]), kept.today(), plain))
    kept.keep(assignment, records, FOLDER)
    yield from found


def offered_in(assignment: str, keys: Keys | None = None) -> list[str]:
    """The exercises that a chapter's page offers: those of which a fitting record says so."""
    missing = unproved(assignment, keys)
    return [name for name, record in kept.load(assignment, FOLDER).items() if name not in missing and record.rows["offered"]]
