"""Replaces the worker's `observe` by one that claims a perfect outcome. The claim is only numbers, and the numbers must be
right."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write, wrong

SOURCE = """
import sys
from course_lib.checks.cases import Observation
from course_lib.checks.observing import observe as honest
def observe(function, arguments, **others):
    if function.__name__ != "repaired_targets":
        return honest(function, arguments, **others)
    shape = arguments["rewards"].shape
    import torch
    return Observation(kind="tuple of 2", outputs={"0": torch.ones(shape), "1": torch.ones(shape)})
frame = sys._getframe()
while frame:
    if "observe" in frame.f_globals:
        frame.f_globals["observe"] = observe
    frame = frame.f_back
import course_lib.checks.observing
course_lib.checks.observing.observe = observe
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook)
    last(notebook, SOURCE)
    write(folder, notebook)
