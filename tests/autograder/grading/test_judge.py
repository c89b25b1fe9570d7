"""What a worker says is read strictly: no answer, however odd, does more than fail its own exercise, in time."""

import json
import signal
from types import SimpleNamespace

import nbformat
import pytest
import safetensors.torch
import torch

from autograder.grading import forking, intake, judge
from autograder.grading.attempts import Attempt, Past
from autograder.grading.sandbox import SandboxUnavailable
from course_lib.checks.cases import FrozenCase, FrozenExercise, Observation
from course_lib.checks.stored import encode

EXERCISE = FrozenExercise(
    "f", {"values": 1.0}, {}, [FrozenCase("one", {}, [Observation(kind="tensor", outputs={"": torch.ones(2)})])]
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


def run(*sources, timeout=0.3):
    return judge._Run(intake.Submission("s", "ch99", None, _cells(*({"source": s} for s in sources))), RELEASE, timeout, False)


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
        {"loaded": {"1": "an error"}},
        {"loaded": {"1": {"line": "3", "error": "E", "newer": "", "sets": []}}},
        {"loaded": {"1": {"line": 3, "error": "E", "newer": "the newest", "sets": []}}},
        {"loaded": {"1": {"line": 3, "error": "E", "newer": "", "sets": "a"}}},
        {"loaded": {"2": {"line": 3, "error": "E", "newer": "", "sets": []}}},
        {"loaded": {"x": {"line": 3, "error": "E", "newer": "", "sets": []}}},
    ],
    ids=repr,
)
def test_nonsense_while_loading_loses_a_cell(answer):
    attempt = run("def f(): ...")
    assert not attempt._load(Scripted(encode(answer)), Attempt((0,), ("f",)))
    assert attempt.flags == ["cell_1_ended_the_process"] and attempt._past == Past(lost=(0,))


def test_a_worker_that_never_stops_announcing_cells_is_stopped():
    attempt = run("def f(): ...")
    assert not attempt._load(Scripted(encode({"running": 1})), Attempt((0,), ("f",)))
    assert attempt.flags == ["cell_1_did_not_finish"]


def test_a_cell_that_was_not_sent_is_not_blamed():
    attempt = run("def f(): ...", "g = 1")
    assert not attempt._load(Scripted(encode({"running": 2})), Attempt((0,), ("f",)))
    assert attempt._past == Past(lost=(0,))


def test_each_exercise_is_timed(monkeypatch):
    now = [100.0]

    def asked(*_):
        now[0] += 2.5
        return judge._failed(EXERCISE, "wrong", "")

    attempt = run("def f(): ...")
    monkeypatch.setattr(judge, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(attempt, "_left", lambda: 1.0)
    monkeypatch.setattr(attempt, "_ask", asked)
    attempt._ask_all(Scripted(b""), Attempt((0,), ("f",)))
    assert attempt.timings == {"f": 2.5}


@pytest.mark.parametrize("sources", [(), ("def f(): ...",)], ids=["no cells", "all of them lost"])
def test_with_nothing_to_run_no_sandbox_starts_and_nothing_of_ours_fails(monkeypatch, sources):
    monkeypatch.setattr(judge, "Sandbox", None)  # it would raise
    attempt = run(*sources, timeout=30)
    for _ in sources * 2:
        attempt._load(Scripted(b""), Attempt((0,), ("f",)))
    [finding] = attempt.findings().values()
    assert finding.state == ("error" if sources else "not_implemented")
    assert finding.message == (
        "Code cell 1, which defines it, ended its process." if sources else "The notebook defines no function f."
    )


@pytest.mark.parametrize("timeout", [0.0, -20.0])
def test_spent_time_is_no_failure_of_ours(monkeypatch, timeout):
    monkeypatch.setattr(judge, "Sandbox", None)
    attempt = run("def f(): ...", timeout=timeout)
    attempt._deadline = 0
    assert attempt.findings()["f"].state == "timeout"


def test_an_exercise_whose_cell_never_ends_is_told_so():
    attempt = run("def f():\n    ...\nwhile True: pass")
    assert not attempt._load(Scripted(encode({"running": 1})), Attempt((0,), ("f",)))
    finding = attempt._missing(EXERCISE)
    assert (finding.state, finding.message) == ("timeout", "Code cell 1, which defines it, did not finish in time.")


@pytest.mark.parametrize("error", [ZeroDivisionError, MemoryError, IndexError, RecursionError, OverflowError])
def test_an_answer_that_our_comparison_does_not_survive_is_for_a_person(monkeypatch, error):
    def diagnose(*_):
        raise error

    monkeypatch.setattr(judge, "diagnose", diagnose)
    attempt = run("def f(): ...")
    finding = attempt._compared(EXERCISE, [Observation()])
    assert finding.state == "error" and attempt.flags == [f"could_not_compare: f ({error.__name__})"]


def _starting(*outcomes):
    """A Sandbox class that fails to start with these errors, one after the other, and then starts."""
    left = list(outcomes)

    class Box:
        def __init__(self, script, modules, files=None, trusted=False, wall="bubblewrap"):
            self.files = dict(files or {})

        def __enter__(self):
            if left and (error := left.pop(0)):
                raise error
            return self

        def __exit__(self, *_):
            pass

    return Box


@pytest.fixture
def without_server(monkeypatch):
    def refuses():
        raise forking.Refused("not here")

    monkeypatch.setattr(forking, "course", forking.Shared(refuses))


@pytest.mark.parametrize(
    ("outcomes", "files", "flags"),
    [
        ([], {"a"}, 0),
        ([SandboxUnavailable("once")], {"a"}, 0),
        ([SandboxUnavailable("it"), SandboxUnavailable("them")], set(), 1),
        ([ValueError("changed")], set(), 1),
    ],
)
def test_files_with_which_no_sandbox_starts_are_left_out(monkeypatch, without_server, outcomes, files, flags):
    attempt = run("def f(): ...")
    attempt._submission.files["a"] = None
    monkeypatch.setattr(judge, "Sandbox", _starting(*outcomes))
    with attempt._sandbox() as box:
        assert set(box.files) == files and len(attempt.flags) == flags


def test_a_sandbox_that_never_starts_is_ours(without_server):
    attempt = run("def f(): ...")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(judge, "Sandbox", _starting(*[SandboxUnavailable("no")] * 3))
        with pytest.raises(SandboxUnavailable), attempt._sandbox():
            pass


@pytest.mark.parametrize(
    "seen",
    [
        {"kind": "tensor", "outputs": {"": [1.0, 1.0]}},
        {"kind": "tensor", "outputs": {"": torch.ones(2, dtype=torch.complex64)}},
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
        {"kind": "tuple of 2", "outputs": {"": torch.ones(2)}},
        {"kind": "tensor", "outputs": {"0": torch.ones(2)}},
        {"kind": "tensor", "outputs": {"": torch.ones(2), "0": torch.ones(2)}},
    ],
    ids=repr,
)
def test_what_is_no_tensor_or_contradicts_itself_is_only_wrong(seen):
    finding = judge.diagnose(EXERCISE, [judge._observation(seen)])
    assert finding.state == "wrong" and finding.score == 0


def test_an_answer_of_brackets_is_not_parsed(monkeypatch):
    text = torch.frombuffer(bytearray(b"[" + b"[]," * (judge.MAX_TEXT // 3) + b"[]]"), dtype=torch.uint8)
    directory = json.dumps({f"a{i}": {"dtype": "U8", "shape": [0], "data_offsets": [0, 0]} for i in range(1 << 17)}).encode()
    parsed = []
    monkeypatch.setattr(json, "loads", lambda *_args, **_kwargs: parsed.append(1))
    for frame in (safetensors.torch.save({"json": text}), len(directory).to_bytes(8, "little") + directory):
        with pytest.raises(ValueError):
            judge._told(Scripted(frame), 1)
    assert not parsed


@pytest.fixture
def _limited():
    """Fails a test after half a minute, a hundred times what it needs; the matching of patterns can be interrupted, too."""

    def out_of_time(*_):
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, out_of_time)
    signal.alarm(30)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("_limited")
@pytest.mark.parametrize("unit", ["\n", " ", "async\n", "f ", "import ", "from f", "f:"], ids=repr)
def test_looking_for_a_definition_takes_no_longer_for_a_hostile_cell(unit):
    assert judge._last_definition("f", [(1, unit * (1_000_000 // len(unit)))]) == -1


@pytest.mark.parametrize(
    "source",
    [
        "def f(x):",
        "if x:\n\tdef  f (x):",
        "async def f():",
        "class f:",
        "f = g",
        "f: int = 3",
        ">>> def f(x):",
        "In [1]: f = g",
        "from a import e, f",
        "import f",
    ],
)
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


OURS = judge.Released("ch44", (EXERCISE,), (), frozenset({"f", "test_f"}), frozenset(), frozenset(), "")


def _marked(name, source=""):
    return {"metadata": {"nbgrader": {"grade_id": name, "solution": True}}, "source": source}


@pytest.mark.parametrize(
    ("cells", "other"),
    [
        ([_marked("clipped_surrogate_loss"), _marked("approx_kl")], "ch43"),
        ([_marked("clipped_surrogate_loss"), {"source": "def f(): pass"}], ""),
        ([_marked("clipped_surrogate_loss"), _marked("f")], ""),
        ([_marked("of another course")], ""),
        ([{"source": "import torch"}], ""),
        ([], ""),
    ],
)
def test_a_notebook_of_another_chapter_is_recognised(cells, other):
    assert judge.other_chapter(_cells(*cells), OURS) == other


def test_a_notebook_of_another_chapter_is_named_and_nothing_of_it_runs(monkeypatch):
    monkeypatch.setattr(judge, "Sandbox", None)
    handed_in = intake.Submission("s", "ch44", None, _cells(_marked("clipped_surrogate_loss", "while True: pass")))
    verdict = judge.judge(handed_in, OURS)
    assert (verdict.status, verdict.score, verdict.flags) == ("needs_review", 0, ("other_chapter: ch43",))
    assert "This is chapter 43's notebook (ch43), handed in as ch44" in verdict.items[0].message


@pytest.mark.parametrize("key", ["missing", "ended"])
def test_numbers_where_a_word_belongs_cost_their_own_exercise_only(key):
    attempt = run("def f(): ...")
    finding = attempt._ask(Scripted(encode({key: torch.ones(2)})), EXERCISE, 0.3)
    assert (finding.state, finding.message) == ("error", "The call ended its process.")
