"""A tiny course of two chapters, chapter 99 with two exercises and one open question, whose checks and references are fakes."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from nbformat.v4 import new_output

from autograder.authoring import chapter, contract
from autograder.authoring.spec import Case, Exercise

FIXTURES = Path(__file__).parent / "fixtures"
PIXEL = "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="


def _solutions():
    spec = importlib.util.spec_from_file_location("tiny_solutions", FIXTURES / "tiny_solutions.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def _exercise(name, reference, criteria):
    case = Case("a number", lambda generator: {"x": torch.rand((), generator=generator, dtype=torch.float64)}, visible=True)
    return Exercise(name, reference, criteria, cases=(case,), misconceptions=(), variants={})


@pytest.fixture(scope="session")
def tiny():
    """The parsed chapters, `sources(chapter)`, and the outputs of chapter 99 as the book builder would have recorded them."""
    solutions = _solutions()
    exercises = {
        98: (),
        99: (
            _exercise("double", solutions.double, {"values": 1.0}),
            _exercise("quadruple", solutions.quadruple, {"values": 2.5, "errors": 0.5}),
        ),
    }

    def sources(chapter):
        pages = {98: "ch98_before", 99: "ch99_tiny"}
        return contract.Sources(exercises[chapter.number], solutions, FIXTURES / "references.bib", pages)

    picture = {"image/png": PIXEL, "text/plain": "<Figure size 640x480 with 1 Axes>"}
    outputs = [
        [],
        [new_output("stream", text="double: all checks pass\n")],
        [new_output("stream", text="quadruple: all checks pass\n")],
        [new_output("stream", text="2.0\n")],
        [new_output("stream", text="\x1b[1mrecorded\x1b[0m\n"), new_output("display_data", picture)],
    ]
    course = SimpleNamespace(directory=FIXTURES / "chapters", sources=sources, outputs=outputs)
    course.before = chapter.load(98, course.directory)
    course.chapter = chapter.load(99, course.directory)
    return course
