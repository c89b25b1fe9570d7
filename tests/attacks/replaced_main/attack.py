"""Puts another module in the place of __main__, with `repaired_targets` and every name of the worker redefined."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write, wrong

SOURCE = """
import sys, types
fake = types.ModuleType("__main__")
fake.__dict__.update(globals(), passed=True, score=2.0, observe=lambda *args: None, diagnose=lambda *args: None)
sys.modules["__main__"] = sys.modules["builtins"].__main__ = fake
for name in [name for name in sys.modules if name.startswith("course_lib")]:
    sys.modules[name] = fake
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook)
    last(notebook, SOURCE)
    write(folder, notebook)
