"""Notebooks and workers' answers that hypothesis makes up: each is read or refused in words, and no exercise loses its item.

tools/fuzz.py, which goes by what code a sample reaches, asks the same of its own.
"""

import json
import os
from pathlib import Path

import torch
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from autograder.grading import intake, judge, reading, repair
from autograder.grading.attempts import Attempt
from course_lib.checks.cases import FrozenCase, FrozenExercise, Observation
from course_lib.checks.stored import encode

BOUNDED = settings(
    max_examples=int(os.environ.get("COURSE_FUZZ", "150")), deadline=None, database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)  # fmt: skip
DRAWN = seed(int(os.environ["COURSE_SEED"]))
WORDS = st.sampled_from(
    [
        "cells",
        "cell_type",
        "code",
        "markdown",
        "source",
        "metadata",
        "nbgrader",
        "grade_id",
        "solution",
        "tags",
        "live",
        "id",
        "f",
        "test_f",
        "nbformat",
        "worksheets",
        "input",
        "outputs",
        "language_info",
        "version",
        "def f(): return 1",
        "\ud800",
        "\0",
        "(" * 300,
    ]
)
ODD = st.none() | st.booleans() | st.sampled_from([0, -1, 3, 4, 5, 10**400, float("nan"), float("inf")]) | WORDS
JSON = st.recursive(ODD, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(WORDS, inner, max_size=4), max_leaves=8)
VALID = {
    "nbformat": 4,
    "nbformat_minor": 5,
    "metadata": {"language_info": {"version": "3.11.4"}},
    "cells": [
        {"cell_type": "code", "id": "a", "metadata": {"tags": ["live"]}, "source": ["train()"], "outputs": []},
        {
            "cell_type": "code",
            "id": "b",
            "metadata": {"nbgrader": {"grade_id": "f", "solution": True}},
            "source": "def f():\n    return 1",
        },
        {"cell_type": "markdown", "id": "c", "metadata": {"nbgrader": {"grade_id": "why", "grade": True}}, "source": "words"},
    ],
}
EXERCISES = tuple(
    FrozenExercise(name, {"values": 1.0}, {}, [FrozenCase("one", {}, [Observation(kind="tensor", outputs={"": torch.ones(2)})])])
    for name in ("f", "g")
)
RELEASE = judge.Released(
    "ch99", EXERCISES, (("why", 1.0),), frozenset({"f", "test_f", "why"}), frozenset({"train()"}), frozenset({"a"}), ""
)


@st.composite
def notebooks(draw):
    """A valid notebook with some of its parts in another's place, as bytes, the last of which may be missing."""
    document = json.loads(json.dumps(VALID))
    for _ in range(draw(st.integers(1, 4))):
        where = document
        while True:
            keys = list(where) if isinstance(where, dict) else list(range(len(where)))
            key = draw(st.sampled_from(keys))
            if isinstance(where[key], dict | list) and where[key] and draw(st.booleans()):
                where = where[key]
                continue
            break
        if draw(st.booleans()):
            where[key] = draw(JSON)
        elif isinstance(where, dict):
            where[draw(WORDS)] = where.pop(key)
        else:
            where.insert(key, where[key])  # the same twice
        if not document:
            break
    content = json.dumps(document).encode("utf-8")
    return content[: draw(st.integers(0, len(content)))] if draw(st.integers(0, 9)) == 0 else content


@DRAWN
@BOUNDED
@given(notebooks())
def test_a_notebook_is_judged_or_refused_in_words(content):
    judge_notebook(content)


def judge_notebook(content):
    try:
        one = reading.read(content)
    except reading.BadNotebook as refusal:
        assert str(refusal)
        return
    submission = intake.Submission("s", "ch99", Path("nowhere"), one.notebook, flags=one.flags)
    intake._fingerprint(submission)
    repaired = repair.repair(one.notebook, RELEASE.form)
    cells, _ = judge.with_live(repaired.notebook, RELEASE)
    assert all(isinstance(source, str) for _, source in cells)
    encode({"cells": [[number, source, "whole"] for number, source in cells]})


TENSORS = st.sampled_from([torch.ones(2), torch.full((2,), float("nan")), torch.ones(0), torch.zeros(2, dtype=torch.complex64)])
TOLD = st.sampled_from(["observations", "uses", "missing", "ended", "loaded", "running", "1", "line", "error", "newer", "sets"])
SEEN = st.sampled_from(["outputs", "gradients", "graph", "mutated", "error", "message", "kind", ""])
SAID = st.recursive(
    ODD | TENSORS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TOLD | SEEN, inner, max_size=4), max_leaves=10
)


def _frame(said):
    try:
        return encode(said)
    except (ValueError, TypeError, RuntimeError, UnicodeEncodeError):
        return repr(said).encode(errors="replace")


FRAMES = (
    SAID.map(_frame)
    | st.fixed_dictionaries({"observations": st.lists(st.dictionaries(SEEN, SAID, max_size=5), max_size=2)}).map(_frame)
    | st.fixed_dictionaries({"loaded": st.dictionaries(st.sampled_from(["1", "x", "2"]), SAID)}).map(_frame)
    | st.binary(max_size=64)
    | st.builds(lambda data, end: _frame(data)[:end], SAID, st.integers(0, 64))
)


class Talking:
    """A sandbox whose worker says these frames, one after the other, and then the last for ever."""

    def __init__(self, frames):
        self.frames = list(frames)

    def send(self, payload, timeout=0.0):
        pass

    def receive(self, timeout):
        return self.frames.pop(0) if len(self.frames) > 1 else self.frames[0]


@DRAWN
@BOUNDED
@given(st.lists(FRAMES, min_size=1, max_size=4))
def test_whatever_a_worker_says_each_exercise_has_a_finding_and_what_was_right_stays(frames):
    judge_worker(frames)


def judge_worker(frames):
    cells = reading.read(json.dumps(VALID).encode()).notebook
    run = judge._Run(intake.Submission("s", "ch99", Path("nowhere"), cells), RELEASE, 0.05, False)
    right = encode({"observations": [{"kind": "tensor", "outputs": {"": torch.ones(2)}}], "uses": []})
    everything = Attempt(tuple(range(len(run._cells))), ("f", "g"))
    run._load(Talking(frames), everything)
    run._ask_all(Talking([right, *frames]), everything)
    assert run._found["f"].state == "correct"
    for finding in run._found.values():
        assert run._with_causes(finding).state in ("correct", "partial", "wrong", "not_implemented", "error", "timeout")
        assert 0 <= finding.score <= finding.max_score
