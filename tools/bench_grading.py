"""Grade the same honest submissions with `course grade` and with stock `nbgrader autograde`, and print both times.

    python tools/bench_grading.py [SUBMISSIONS]

The submissions are solved notebooks of chapter 44. Their live cells (training, plots) are emptied for both: `course grade`
never runs them, and nbgrader would, for half a minute each. Both have the same two processors; nbgrader has no parallel mode.
"""

from __future__ import annotations

import copy
import inspect
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import nbformat

from autograder import checks
from autograder.authoring import assemble, chapter
from autograder.paths import ROOT
from autograder.publishing import release


def solved(released: nbformat.NotebookNode, number: int) -> nbformat.NotebookNode:
    """A full solution; a comment and a renamed helper make each one a different file."""
    notebook = copy.deepcopy(released)
    references = {exercise.name: inspect.getsource(exercise.reference) for exercise in checks.exercises("ch44")}
    for cell in notebook.cells:
        name = cell.metadata.get("nbgrader", {}).get("grade_id")
        if name in references:
            cell.source = references[name] + f"\n\nhandled_by_{number} = {name}  # learner {number}"
        if "live" in cell.metadata.get("tags", []):
            cell.source = ""
    return notebook


def timed(command: list[str], folder: Path, log: Path) -> float:
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    start = time.perf_counter()
    with open(log, "w") as output:
        subprocess.run(command, cwd=folder, check=True, stdout=output, stderr=subprocess.STDOUT, env=environment)
    return time.perf_counter() - start


def main(count: int) -> None:
    """Build one class, grade it both ways, print seconds and their ratio."""
    with tempfile.TemporaryDirectory() as name:
        base = Path(name)
        course = release.write_nbgrader_course(base / "nbgrader")
        released = assemble.for_learners(chapter.load("ch44"))
        for number in range(count):
            folder = course / "submitted" / f"s{number:03}" / "ch44"
            folder.mkdir(parents=True)
            nbformat.write(solved(released, number), folder / "ch44.ipynb")
        timed(
            [sys.executable, "-m", "nbgrader", "generate_assignment", "ch44", "--create", "--force"],
            course,
            base / "generate.log",
        )
        ours = timed(
            [sys.executable, "-m", "autograder", "grade", str(course / "submitted"), "--jobs", "2"], base, base / "ours.log"
        )
        stock = timed([sys.executable, "-m", "nbgrader", "autograde", "ch44", "--create"], course, base / "stock.log")
        graded = len(list((course / "autograded").glob("*/ch44/ch44.ipynb")))
        print(f"{count} submissions; course grade --jobs 2: {ours:.1f} s; nbgrader autograde: {stock:.1f} s ({graded} graded)")
        print(f"{ours / count:.2f} s and {stock / count:.2f} s a submission: {stock / ours:.1f} times the throughput")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20)
