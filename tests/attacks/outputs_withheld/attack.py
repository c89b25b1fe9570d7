"""Claims to return a tuple of two tensors and sends none: whatever looks them up fails in the judge's process, not in the
learner's."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import CHANNEL, last, write, wrong

BODY = """
import os, sys
frame = sys._getframe()
while "request" not in frame.f_locals:
    frame = frame.f_back
channel.send({"observations": [{"kind": "tuple of 2"}] * len(frame.f_locals["request"]["cases"])})
os._exit(0)
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    last(notebook, CHANNEL)
    write(folder, notebook)
