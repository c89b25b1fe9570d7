"""Searches the stack and every object of the process for arrays that might be the expected values. There are none in this
process."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import write, wrong

BODY = """
import gc, sys
import numpy as np
if searched:
    return searched[0], searched[0]
searched.append(torch.zeros_like(rewards))
given = [value.detach().numpy() for value in (rewards, values, next_values)]
found, frame = [], sys._getframe()
while frame:
    found += [thing for thing in frame.f_locals.values()]
    frame = frame.f_back
for thing in [*found, *gc.get_objects()]:
    if isinstance(thing, dict):
        found += list(thing.values())
    if type(thing).__name__ in ("FrozenCase", "FrozenExercise"):
        raise AssertionError("expected values in reach")
arrays = [thing.detach().numpy() if isinstance(thing, torch.Tensor) else thing for thing in found if isinstance(thing, (np.ndarray, torch.Tensor))]
arrays = [a for a in arrays if a.shape == tuple(rewards.shape) and a.dtype == given[0].dtype and not any(np.array_equal(a, g) for g in given)]
if len(arrays) > 1:
    return torch.from_numpy(arrays[-1].copy()), torch.from_numpy(arrays[-2].copy())
"""

ABOVE = """
searched = []
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    wrong(notebook, BODY, ABOVE)
    write(folder, notebook)
