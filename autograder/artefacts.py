"""The trusted side of exercises that are judged by a file: choose the seeds, read the file safely, fly it in a process of its own.

That process runs our code alone and sees the file as data. It costs half a second, and in return flights use all cores, can be
stopped, and no file can hurt the process that grades.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np

import course_lib.flight
from autograder import intake
from autograder.paths import ROOT
from autograder.spec import Artefact, Exercise
from autograder.verdicts import RECEIPT
from course_lib import artefact as frozen
from course_lib.artefact import FrozenArtefact
from course_lib.diagnosis import Finding
from course_lib.flight import RefusedFile

PROGRAM = Path(course_lib.flight.__file__)
THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class FlightFailed(RuntimeError):
    """Our own program did not fly the file: no fault of the learner's."""


def visible(artefact: Artefact) -> FrozenArtefact:
    """What learners get: a few episodes."""
    return _frozen(artefact, "visible", artefact.visible_episodes)


def hidden(artefact: Artefact) -> FrozenArtefact:
    """What the grader flies: other episodes, the same for everybody."""
    return _frozen(artefact, "hidden", artefact.episodes)


def _frozen(artefact: Artefact, purpose: str, episodes: int) -> FrozenArtefact:
    digests = (hashlib.sha256(f"{artefact.name}/{purpose}/{episode}".encode()).digest() for episode in range(episodes))
    seeds = [int.from_bytes(digest[:4], "big") >> 1 for digest in digests]
    low, high = artefact.thresholds
    return FrozenArtefact(artefact.name, artefact.file, artefact.task, artefact.points, low, high, seeds)


def hand_in(exercises: Iterable[Exercise | Artefact], folder: Path) -> None:
    """Put the reference's own files where a notebook's would lie. Raises ValueError if one has not been made."""
    for exercise in exercises:
        if isinstance(exercise, Artefact):
            if not answer(exercise).is_file():
                raise ValueError(f"{answer(exercise)} is missing: the file that the reference of {exercise.name} made")
            shutil.copyfile(answer(exercise), folder / exercise.file)


def answer(artefact: Artefact | FrozenArtefact) -> Path:
    """The file that the reference made."""
    return ROOT / "solutions" / artefact.file


def judge(artefact: FrozenArtefact, folder: Path, timeout: float) -> tuple[Finding, list[str]]:
    """Fly the file that lies in a submission's folder.

    Args:
      artefact: with the hidden seeds.
      folder: the submission's.
      timeout: seconds.

    Returns: the finding, and flags: a receipt for the file that was read, and whether it is the one that the course publishes.
    Raises: FlightFailed if our own program fails.
    """
    try:
        content = intake.read_regular(folder / artefact.file, course_lib.flight.MAX_BYTES)
    except FileNotFoundError:
        return frozen.missing(artefact), []
    except intake.BadFile as problem:
        return frozen.refused(artefact, f"it {problem}"), []
    except OSError as error:
        return frozen.refused(artefact, f"it can't be read ({error.strerror})"), []
    flags = [f"{RECEIPT}{artefact.file} sha256 {hashlib.sha256(content).hexdigest()}"]
    if answer(artefact).is_file() and answer(artefact).read_bytes() == content:
        flags.append(f"the_courses_own_file: {artefact.file}")
    try:
        finding = frozen.landed(artefact, fly(artefact, content, timeout))
    except RefusedFile as refusal:
        finding = frozen.refused(artefact, str(refusal))
    except subprocess.TimeoutExpired:
        message = f"The flights took more than {timeout:g} s."
        finding = Finding(artefact.name, "timeout", 0.0, artefact.points, message=message)
    return finding, flags


def fly(artefact: FrozenArtefact, content: bytes, timeout: float) -> np.ndarray:
    """The returns, (episodes,), of the file with this content, flown in a process of its own.

    Raises: RefusedFile if it is no policy; subprocess.TimeoutExpired; FlightFailed if our own program fails.
    """
    command = [sys.executable, "-I", str(PROGRAM), artefact.task, *map(str, artefact.seeds)]
    ended = subprocess.run(command, input=content, capture_output=True, timeout=timeout, env=THREADS)
    if ended.returncode:
        reason = ended.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise FlightFailed(f"{PROGRAM.name} ended with {ended.returncode}: {reason[:200]}")
    told = json.loads(ended.stdout)
    if "refused" in told:
        raise RefusedFile(told["refused"])
    return np.array(told["returns"])
