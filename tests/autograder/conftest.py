"""A tiny course of two chapters, chapter 99 with two exercises and one open question, whose checks and references are fakes."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from nbformat.v4 import new_output

from autograder import assemble, chapter, contract

FIXTURES = Path(__file__).parent / "fixtures"


def _solutions():
    spec = importlib.util.spec_from_file_location("tiny_solutions", FIXTURES / "tiny_solutions.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def tiny():
    """The parsed chapters, `sources(chapter)`, and a notebook as the book builder would have executed it."""
    solutions = _solutions()
    exercises = {
        98: (),
        99: (
            SimpleNamespace(name="double", points=1.0, criteria={"values": 1.0}),
            SimpleNamespace(name="quadruple", points=3.0, criteria={"values": 2.5, "errors": 0.5}),
        ),
    }

    def sources(chapter):
        pages = {98: "ch98_before", 99: "ch99_tiny"}
        return contract.Sources(exercises[chapter.number], solutions, FIXTURES / "references.bib", pages)

    course = SimpleNamespace(directory=FIXTURES / "chapters", sources=sources)
    course.before = chapter.load(98, course.directory)
    course.chapter = chapter.load(99, course.directory)
    course.executed = assemble.executable_view(course.chapter, sources(course.chapter))
    outputs = {"check(double)": "double: all checks pass", "print(quadruple(0.5))": "2.0"}
    for cell in course.executed.cells:
        if cell.source in outputs:
            cell.outputs = [new_output("stream", name="stdout", text=outputs[cell.source] + "\n")]
        if cell.source == 'print("recorded")':
            data = {"image/png": "iVBORw0KGgo=", "text/plain": "<Figure size 640x480 with 1 Axes>"}
            cell.outputs = [new_output("stream", text="\x1b[1mrecorded\x1b[0m\n"), new_output("display_data", data)]
    return course
