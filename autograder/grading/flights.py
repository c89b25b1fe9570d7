"""The judge of exercises whose answer is a file: read it safely, and fly it in a process of its own.

That process runs our code alone and sees the file as data. It costs half a second, and in return flights use all cores, can be
stopped, and no file can hurt the process that grades.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

import course_lib.control.flight
from autograder.authoring.artefacts import answer
from autograder.grading import intake
from autograder.grading.verdicts import RECEIPT
from course_lib.checks import artefact as frozen
from course_lib.checks.artefact import FrozenArtefact
from course_lib.checks.diagnosis import Finding
from course_lib.control.flight import RefusedFile

PROGRAM = Path(course_lib.control.flight.__file__)
THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class FlightFailed(RuntimeError):
    """Our own program did not fly the file: no fault of the learner's."""


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
        content = intake.read_regular(folder / artefact.file, course_lib.control.flight.MAX_BYTES)
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
