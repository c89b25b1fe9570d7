"""Leaves handlers that write a forged answer when the process ends: atexit, a destructor, a signal handler. The call's process
ends without running any of them."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import CHANNEL, last, write, wrong

SOURCE = """
import atexit, os, signal, threading
def forge(*args):
    channel.send({"observations": [], "score": 2.0, "state": "correct"})
atexit.register(forge)
threading._register_atexit(forge)
os.register_at_fork(after_in_child=lambda: atexit.register(forge))
class Last:
    __del__ = forge
kept = Last()
signal.signal(signal.SIGTERM, forge)
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook)
    last(notebook, CHANNEL + SOURCE)
    write(folder, notebook)
