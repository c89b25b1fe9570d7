"""Says over the judge's socket that loading is done, and sends a made-up answer for each exercise in advance. What was written
before the inputs were known can't be right, and the wrong exercise earns nothing by the confusion."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import CHANNEL, last, write, wrong

SOURCE = """
channel.send({"loaded": {}})
for _ in range(6):
    channel.send({"score": 2.0, "state": "correct", "passed": True})
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook)
    last(notebook, CHANNEL + SOURCE)
    write(folder, notebook)
