"""Looks its inputs up in the frozen visible checks, which every learner has, and answers with what is stored there. The judge
draws inputs that are not there: visible answers alone earn nothing, in no exercise."""

from pathlib import Path

from nbformat import NotebookNode

from autograder import checks
from autograder.authoring import freeze
from course_lib.checks.stored import save
from tests.attacks.toolbox import ARGUMENTS, answer, first, write

SOURCE = """
import torch
from pathlib import Path
from course_lib.checks.stored import load

def look_up(name, given):
    for case in load(Path("/work") / f"{name}.npz").cases:
        pairs = [(value, given[key]) for key, value in case.arguments.items() if isinstance(value, torch.Tensor)]
        if all(torch.equal(stored, now.detach()) for stored, now in pairs):
            seen = case.expected[0]
            if seen.error:
                raise ValueError(seen.message)
            outputs = [array.clone() for array in seen.outputs.values()]
            return outputs[0] if len(outputs) == 1 else tuple(outputs)
    if name == "explained_variance":
        return torch.tensor(0.5, dtype=given["values"].dtype)
    zeros = torch.zeros_like(next(iter(given.values())))
    return (zeros, zeros) if name == "repaired_targets" else zeros
"""

BODY = """
return look_up("NAME", locals())
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    for name in ARGUMENTS:
        exercise = freeze.visible(next(one for one in checks.exercises("ch44") if one.name == name))
        save(folder / f"{name}.npz", exercise)
        answer(notebook, name, BODY.replace("NAME", name))
    first(notebook, SOURCE)
    write(folder, notebook)
