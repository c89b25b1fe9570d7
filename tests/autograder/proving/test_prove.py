"""`course prove`: what it proves, what it says, what it keeps, and how it ends."""

import pytest
import torch
from typer.testing import CliRunner

from autograder import checks, cli
from autograder.authoring.spec import Case, Exercise, Misconception
from autograder.proving import kept, prove


def double(x):
    return 2 * x


def exercise(name, misconceptions, variants):
    case = Case("a batch", lambda generator: {"x": 1 + torch.rand(3, generator=generator, dtype=torch.float64)}, visible=True)
    wrong = [Misconception(wrong, function, f"It is {wrong}.") for wrong, function in misconceptions.items()]
    return Exercise(name, double, {"values": 1.0}, [case], wrong, variants)


GOOD = exercise("good", {"tripled": lambda x: 3 * x}, {"added": lambda x: x + x})
BAD = exercise("bad", {"tripled": lambda x: 3 * x, "twin": lambda x: x * 3}, {"sloppy": lambda x: 2.1 * x})


@pytest.fixture
def course(monkeypatch, tmp_path):
    """A course of one chapter, 99, that has checks and no page; its keys are made up."""
    monkeypatch.setattr(checks, "assignments", lambda: ["ch99"])
    monkeypatch.setattr(checks, "exercises", lambda assignment: {"ch99": (GOOD, BAD)}[assignment])
    monkeypatch.setattr(kept, "FOLDER", tmp_path)
    keys = {"good": "1", "bad": "1"}
    monkeypatch.setattr(kept.Keys, "key", lambda self, assignment, one: keys[one.name])
    return keys


def run(*arguments):
    return CliRunner().invoke(cli.app, ["prove", *arguments, "--jobs", "1"])


def test_findings_are_all_told_and_nothing_is_kept_of_their_exercise(course):
    result = run()
    assert result.exit_code == 1
    assert "bad: misconception 'tripled' is misnamed: 'tripled', 'twin' is named, in 50 of 50 draws" in result.output
    assert "bad: misconception 'twin' is misnamed" in result.output
    assert "bad: variant 'sloppy' is refused in case 'a batch' (values), in 50 of 50 draws" in result.output
    assert list(kept.load("ch99")) == ["good"]
    rows = kept.load("ch99")["good"].rows
    assert rows["misconceptions"] == [{"name": "tripled", "message": "It is tripled.", "rejected": 50, "named": 50}]
    assert rows["seeds"] == 50 and rows["variants"] == [{"name": "added", "accepted": 50}]


def test_only_what_has_no_fitting_record_is_proved(course):
    assert [target.exercise for target in prove.targets()] == ["good", "bad"]
    run()
    assert [target.exercise for target in prove.targets()] == ["bad"]
    assert [target.exercise for target in prove.targets(every=True)] == ["good", "bad"]
    course["good"] = "2"
    assert [target.exercise for target in prove.targets(["ch99"])] == ["good", "bad"]
    assert "not proved since" in kept.unproved("ch99")["good"]


def test_when_all_records_fit_nothing_is_done(course, monkeypatch):
    monkeypatch.setattr(checks, "exercises", lambda assignment: (GOOD,))
    assert run().exit_code == 0
    result = run()
    assert result.exit_code == 0 and "every record fits" in result.output


def test_a_quick_look_prints_a_table_and_writes_nothing(course, tmp_path):
    result = run("--only", "ch99", "--exercise", "good", "--seeds", "3")
    assert result.exit_code == 0
    assert "good: of 3 draws\n  tripled  rejected   3  named   3\n  added    accepted   3\n" in result.output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("arguments", "named"), [(["--only", "ch98"], "ch99"), (["--exercise", "goood"], "good, bad")])
def test_an_unknown_name_ends_with_those_there_are(course, arguments, named):
    result = run(*arguments)
    assert result.exit_code == 2 and named in result.output


def test_an_exercise_that_cannot_be_drawn_is_our_failure_and_not_a_finding(course, monkeypatch):
    def fails(part):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(prove, "draw", fails)
    result = run()
    assert result.exit_code == 3 and "good: RuntimeError: out of memory" in result.output
    assert kept.load("ch99") == {}


def test_nothing_is_kept_of_what_was_edited_while_it_was_proved(course, monkeypatch):
    monkeypatch.setattr(checks, "exercises", lambda assignment: (GOOD,))
    monkeypatch.setattr("autograder.proving.dependencies.Code.is_current", lambda self: False)
    result = run()
    assert result.exit_code == 3 and "good: not kept, since the code was edited" in result.output
    assert kept.load("ch99") == {}


def test_a_scheduler_that_is_not_there_is_said(course, monkeypatch):
    def unreachable(*_):
        raise OSError("timed out trying to connect to tcp://127.0.0.1:1")
        yield

    monkeypatch.setattr("autograder.proving.side_by_side._on_dask", unreachable)
    result = run("--scheduler", "tcp://127.0.0.1:1")
    assert result.exit_code == 3 and "timed out" in result.output


def test_parts_drawn_in_processes_are_those_drawn_in_one():
    [target] = prove.targets(["ch43"], ["approx_kl"])
    [alone] = prove.prove([target], range(11), jobs=1)
    [together] = prove.prove([target], range(11), jobs=2)
    assert alone == together and alone.rows["seeds"] == 11 and not alone.findings
