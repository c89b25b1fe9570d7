"""Reads the environment and the arguments of every process it can see, the sandbox's own among them, for the grader's secrets."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
import glob, os
texts = [repr(os.environ).encode()]
for path in glob.glob("/proc/[0-9]*/environ") + glob.glob("/proc/[0-9]*/cmdline") + glob.glob("/proc/[0-9]*/task/*/environ"):
    try:
        texts.append(open(path, "rb").read())
    except OSError:
        pass
for text in texts:
    if b"canary-7d1f" in text:
        raise AssertionError(text[:1000])
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    write(folder, notebook)
