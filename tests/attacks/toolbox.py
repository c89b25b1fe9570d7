"""What attacks are made of: the perfect notebook, wrong answers, and ways to put cells into it."""

from __future__ import annotations

import copy
import functools
import inspect
from pathlib import Path

import nbformat
from nbformat import NotebookNode
from nbformat.v4 import new_code_cell

from autograder import checks
from autograder.authoring import assemble, chapter

CANARY = "canary-7d1f"  # what no submission may learn; the suite puts it where graders keep secrets

ARGUMENTS = {
    "td_residuals": "rewards, values, next_values, terminated, gamma=0.99",
    "compute_gae": "rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95",
    "lambda_returns": "advantages, values",
    "normalize_advantages": "advantages, eps=1e-8",
    "explained_variance": "values, returns",
    "repaired_targets": "rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95",
}

# Finds the worker's end of the conversation, as any object of its process can be found.
CHANNEL = """
import gc
channel = next(thing for thing in gc.get_objects() if type(thing).__name__ == "Channel")
worker = type(channel).send.__globals__
"""


@functools.cache
def _solved() -> NotebookNode:
    notebook = assemble.for_learners(chapter.load("ch44"))
    for one in checks.exercises("ch44"):
        cell(notebook, one.name).source = inspect.getsource(one.reference)
    return notebook


def solved() -> NotebookNode:
    """The student notebook of chapter 44 with every exercise solved: ten points of ten."""
    return copy.deepcopy(_solved())


def graded(one: NotebookNode) -> str | None:
    return one.metadata.get("nbgrader", {}).get("grade_id")


def cell(notebook: NotebookNode, grade_id: str) -> NotebookNode:
    return next(one for one in notebook.cells if graded(one) == grade_id)


def answer(notebook: NotebookNode, name: str, body: str, above: str = "") -> None:
    """Replace the solution of `name` by a function with this body; `above` stands before its `def`, in the same cell."""
    lines = "\n".join("    " + line for line in body.strip("\n").split("\n"))
    cell(notebook, name).source = f"{above.strip()}\n\ndef {name}({ARGUMENTS[name]}):\n{lines}\n"


def wrong(notebook: NotebookNode, body: str = "", above: str = "") -> None:
    """Make the last exercise, two points on which no other depends, return zeros after running `body`."""
    answer(notebook, "repaired_targets", body + "\nreturn torch.zeros_like(rewards), torch.zeros_like(rewards)", above)


def first(notebook: NotebookNode, source: str) -> None:
    notebook.cells.insert(0, new_code_cell(source))


def last(notebook: NotebookNode, source: str) -> None:
    notebook.cells.append(new_code_cell(source))


def write(folder: Path, notebook: NotebookNode) -> None:
    (folder / "ch44.ipynb").write_text(nbformat.writes(notebook), encoding="utf-8")
