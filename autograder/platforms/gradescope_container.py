"""What runs inside Gradescope's container: grade `ROOT/submission`, and write `ROOT/results/results.json`.

    python -m autograder.platforms.gradescope_container ch44 /autograder

Without a sandbox, or when the grader itself fails, no result is written and the exit status is not 0: Gradescope then says that the
autograder has failed, and nobody gets a zero.
"""

from __future__ import annotations

import os
import shutil
import stat
import sys
import tempfile
from pathlib import Path

from autograder import grade
from autograder.grading import judge, sandbox
from autograder.grading.verdicts import write_atomically
from autograder.reporting.machines import gradescope_json

TIMEOUT = 60.0  # seconds for each exercise; Gradescope stops a container after ten minutes unless its settings say otherwise


def main(arguments: list[str]) -> int:
    """Exit status: 0 a result is written, 2 unusable arguments, 3 there is no result."""
    trusted = "--trust-submissions" in arguments
    places = [argument for argument in arguments if not argument.startswith("--")]
    if len(places) != 2 or not Path(places[1], "submission").is_dir():
        print("usage: gradescope_container ASSIGNMENT ROOT, with a folder ROOT/submission", file=sys.stderr)
        return 2
    assignment, root = places[0], Path(places[1])
    if assignment not in judge.assignments():
        print(f"no such assignment: {assignment}; there are {', '.join(sorted(judge.assignments()))}", file=sys.stderr)
        return 2
    results = root / "results" / "results.json"
    results.unlink(missing_ok=True)  # no earlier result may stand for this submission
    if not trusted:
        try:
            sandbox.require()
        except sandbox.SandboxUnavailable as error:
            print(f"Not graded, because the submission could read the solutions: {error}", file=sys.stderr)
            return 3
    with tempfile.TemporaryDirectory() as folder:  # for its owner only; the grader's layout: the folder has the assignment's name
        handed_in = Path(folder, "submission", assignment)
        shutil.copytree(root / "submission", handed_in, symlinks=True, ignore=_neither_files_nor_folders)
        verdict, _ = grade.judge_folder("submission", assignment, handed_in, TIMEOUT, trusted)
    if verdict.status == "infra_error":
        print(f"Not graded: {', '.join(verdict.flags)}", file=sys.stderr)
        return 3
    write_atomically(results, gradescope_json(verdict))
    return 0


def _neither_files_nor_folders(folder: str, names: list[str]) -> list[str]:
    """Pipes and devices, which a copy would wait for."""
    paths = ((name, os.lstat(os.path.join(folder, name)).st_mode) for name in names)
    return [name for name, mode in paths if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode) or stat.S_ISLNK(mode))]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
