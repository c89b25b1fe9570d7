"""Replaces the worker's `encode`, to add a score and a state to every answer. The judge reads observations and computes scores
itself."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write, wrong

SOURCE = """
import sys
from course_lib.checks.stored import encode as honest
def encode(data):
    return honest(dict(data, score=2.0, state="correct", max_score=1e9, findings=[{"score": 2.0, "state": "correct"}]))
frame = sys._getframe()
while frame:
    if "encode" in frame.f_globals:
        frame.f_globals["encode"] = encode
    frame = frame.f_back
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook)
    last(notebook, SOURCE)
    write(folder, notebook)
