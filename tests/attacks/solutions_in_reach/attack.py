"""Imports the reference or the checks, or finds their files, and answers with them."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
import importlib, os
for name in ("solutions", "solutions.ch44", "autograder", "autograder.checks.ch44", "nbgrader"):
    try:
        return importlib.import_module(name).repaired_targets(rewards, values, next_values, terminated, truncated, gamma, gae_lambda)
    except ImportError:
        pass
for parent, folders, files in os.walk("/"):
    folders[:] = [one for one in folders if os.path.join(parent, one) not in ("/proc", "/site", "/python", "/usr/lib", "/sys")]
    if {"ch44.py", "judge.py", "gradebook.db", "ch44_gae.md"} & set(files):
        raise AssertionError(parent)
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY)
    write(folder, notebook)
