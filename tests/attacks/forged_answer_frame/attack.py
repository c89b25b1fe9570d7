"""Sends a made-up answer from inside the call and ends the process with status 0 before the true one can be sent. The judge
takes it for the answer: numbers that are compared, and differ."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import CHANNEL, last, write, wrong

SOURCE = """
import os, sys
"""

BODY = """
frame = sys._getframe()
while "request" not in frame.f_locals:
    frame = frame.f_back
given = [case["arguments"]["rewards"] for case in frame.f_locals["request"]["cases"]]
seen = [{"kind": "tuple of 2", "outputs": {"0": one, "1": one}, "error": "", "score": 2.0, "state": "correct"} for one in given]
channel.send({"observations": seen, "score": 2.0, "state": "correct"})
os._exit(0)
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    last(notebook, CHANNEL + SOURCE)
    write(folder, notebook)
