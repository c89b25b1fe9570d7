"""Replaces every function that could compare the answer with the right one. A grader that compares in the learner's process
believes it; the judge compares in its own."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import last, write, wrong

SOURCE = """
import numpy, torch, course_lib.checks.diagnosis
for module, names in (torch, "allclose equal isclose"), (numpy, "allclose isclose array_equal"):
    for name in names.split():
        setattr(module, name, lambda *args, **kwargs: True)
torch.testing.assert_close = numpy.testing.assert_allclose = lambda *args, **kwargs: None
for name in ("_values_agree", "_gradients_agree", "_close"):
    setattr(course_lib.checks.diagnosis, name, lambda *args, **kwargs: True)
course_lib.checks.diagnosis.differing_facets = lambda *args: set()
course_lib.checks.diagnosis.diagnose = lambda exercise, seen: course_lib.checks.diagnosis.Finding(exercise.name, "correct", 2.0, 2.0)
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook)
    last(notebook, SOURCE)
    write(folder, notebook)
