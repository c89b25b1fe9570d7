"""No file is handed in; a cell writes one where it runs, and replaces what flies and what scores there."""

from pathlib import Path

from tests.attacks.handed_in.toolbox import FILE, policy, put

ASSIGNMENT = "ch97"
CELL = f"""
import course_lib.checks.artefact, course_lib.control.flight
open({FILE!r}, "wb").write({policy()!r})
course_lib.control.flight.fly = course_lib.checks.artefact.fly = lambda weights, seeds, task: [300.0] * len(seeds)
course_lib.checks.artefact.score = lambda artefact, mean_return: artefact.points
"""


def make(folder: Path) -> None:
    put(folder, None, CELL)
