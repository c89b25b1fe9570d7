"""What a worker says is read strictly: no answer, however odd, does more than fail its own exercise, in time."""

import json
import time

import nbformat
import numpy as np
import pytest
import safetensors.numpy

from autograder.grading import judge
from autograder.grading.sandbox import SandboxTimeout
from course_lib.checks.cases import FrozenCase, FrozenExercise, Observation, encode

EXERCISE = FrozenExercise(
    "f", {"values": 1.0}, {}, [FrozenCase("one", {}, [Observation(kind="tensor", outputs={"": np.ones(2)})])]
)
RELEASE = judge.Released("ch99", (EXERCISE,), (), frozenset(), frozenset({"train()"}), frozenset({"ch99-001"}), "")


class Scripted:
    """A sandbox whose worker always answers the same; while it lasts, at once."""

    def __init__(self, frame):
        self.frame = frame

    def send(self, payload, timeout=0.0):
        pass

    def receive(self, timeout):
        return self.frame


def run(cells=((1, "def f(): ..."),), timeout=0.3):
    run = judge._Run(None, RELEASE, timeout, False)
    run._cells, run._loading_failures, run._reserved, run._apart = list(cells), {}, 0, False
    run._deadline = time.monotonic() + 2 * timeout
    return run


@pytest.mark.parametrize(
    "answer",
    [
        {"running": float("inf")},
        {"running": float("nan")},
        {"running": "1"},
        {"running": [1]},
        {"running": None},
        {},
        [],
        {"loaded": []},
    ],
    ids=repr,
)
def test_nonsense_while_loading_drops_a_cell(answer):
    attempt = run()
    assert not attempt._load(Scripted(encode(answer)), [EXERCISE])
    assert attempt.flags == ["cell_1_ended_the_process"]


def test_a_worker_that_never_stops_announcing_cells_is_stopped():
    attempt = run()
    start = time.monotonic()
    assert not attempt._load(Scripted(encode({"running": 1})), [EXERCISE])
    assert attempt.flags == ["cell_1_did_not_finish"] and time.monotonic() - start < 3


def test_spent_time_is_no_failure_of_ours():
    attempt = run(cells=())
    attempt._deadline = time.monotonic() - 1
    attempt._drop(None, SandboxTimeout(), [])
    with pytest.raises(judge.WorkerFailed):
        run(cells=())._drop(None, SandboxTimeout(), [])


@pytest.mark.parametrize(
    "seen",
    [
        {"kind": "tensor", "outputs": {"": [1.0, 1.0]}},
        {"kind": "tensor", "outputs": {"": np.array(["a"])}},
        {"kind": 1},
        {"kind": "NoneType", "error": None},
        {"kind": "NoneType", "mutated": [1]},
        {"kind": "NoneType", "gradients": []},
    ],
    ids=repr,
)
def test_an_answer_of_other_things_than_text_and_numbers_is_refused(seen):
    with pytest.raises(ValueError):
        judge._observation(seen)


@pytest.mark.parametrize(
    "seen",
    [
        *({"kind": kind} for kind in ("NoneType", "float", "tuple of 0", "dict of ", "PatternOfNames", "tensor", "tuple of 2")),
        {"kind": "tuple of 2", "outputs": {"": np.ones(2)}},
        {"kind": "tensor", "outputs": {"0": np.ones(2)}},
        {"kind": "tensor", "outputs": {"": np.ones(2), "0": np.ones(2)}},
    ],
    ids=repr,
)
def test_what_is_no_tensor_or_contradicts_itself_is_only_wrong(seen):
    finding = judge.diagnose(EXERCISE, [judge._observation(seen)])
    assert finding.state == "wrong" and finding.score == 0


def test_an_answer_of_brackets_is_not_parsed():
    text = np.frombuffer(b"[" + b"[]," * (judge.MAX_TEXT // 3) + b"[]]", np.uint8)
    directory = json.dumps({f"a{i}": {"dtype": "U8", "shape": [0], "data_offsets": [0, 0]} for i in range(1 << 17)}).encode()
    for frame in (safetensors.numpy.save({"json": text}), len(directory).to_bytes(8, "little") + directory):
        start = time.monotonic()
        with pytest.raises(ValueError):
            judge._told(Scripted(frame), 1)
        assert time.monotonic() - start < 0.5


@pytest.mark.parametrize(
    "source", ["\n" * 1_000_000, " " * 1_000_000, "async\n" * 200_000, "f " * 500_000], ids=["lines", "blanks", "async", "f"]
)
def test_looking_for_a_definition_takes_no_longer_for_a_hostile_cell(source):
    start = time.monotonic()
    assert judge._last_definition("f", [(1, source)]) == -1
    assert time.monotonic() - start < 2


@pytest.mark.parametrize("source", ["def f(x):", "if x:\n\tdef  f (x):", "async def f():", "class f:", "f = g", "f: int = 3"])
def test_definitions_are_found(source):
    assert judge._last_definition("f", [(1, source), (2, "f == 1")]) == 0


def _cells(*cells):
    return nbformat.from_dict({"cells": [{"cell_type": "code", "metadata": {}, "source": "", **cell} for cell in cells]})


def test_released_live_cells_do_not_run_even_if_edited_or_stripped_of_their_tags():
    live = {"metadata": {"tags": ["live"]}}
    edited, stripped, without_ids = (
        {"id": "ch99-001", "source": "train(5)"},
        {"source": "train( )"},
        {**live, "source": "train(6)"},
    )
    assert judge.runnable(_cells(edited, stripped, without_ids), RELEASE) == []


def test_added_cells_and_answers_run_though_a_copy_has_kept_a_tag():
    live = {"tags": ["live"]}
    copied = {"id": "new", "metadata": live, "source": "def helper(): pass"}
    answer = {"id": "ch99-002", "metadata": live | {"nbgrader": {"solution": True}}, "source": "def f(): pass"}
    assert [source for _, source in judge.runnable(_cells(copied, answer), RELEASE)] == ["def helper(): pass", "def f(): pass"]
