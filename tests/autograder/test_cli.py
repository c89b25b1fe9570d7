"""The command line: bad input gets one clear line and the right exit status, and nothing is written."""

import pytest
from nbformat.v4 import new_notebook
from typer.testing import CliRunner

from autograder import cli, grade
from autograder.grading import gvisor, sandbox
from autograder.grading.verdicts import Verdict
from autograder.reporting import exports


def run(*arguments):
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


@pytest.mark.parametrize(
    "arguments", [["grade"], ["grade", "x", "--jobs", "0"], ["grade", "x", "--timeout", "0"], ["nonsense"], ["check"]]
)
def test_missing_and_wrong_arguments_are_refused(arguments):
    assert run(*arguments).exit_code == 2


def test_a_missing_folder_says_what_to_give(tmp_path):
    result = run("grade", tmp_path / "none", "--out", tmp_path / "out")
    assert result.exit_code == 2 and "no such folder" in result.output and "STUDENT/ASSIGNMENT" in result.output
    assert not (tmp_path / "out").exists()


def test_a_folder_without_submissions_says_what_it_looked_for(tmp_path):
    (tmp_path / "submitted" / ".hidden").mkdir(parents=True)
    result = run("grade", tmp_path / "submitted", "--out", tmp_path / "out")
    assert result.exit_code == 2 and "no submissions" in result.output
    assert not (tmp_path / "out").exists()


def test_without_a_sandbox_nothing_is_graded(tmp_path, monkeypatch):
    (tmp_path / "submitted" / "s1" / "ch44").mkdir(parents=True)

    def unavailable(wall):
        raise sandbox.SandboxUnavailable("bubblewrap is missing: apt install bubblewrap")

    monkeypatch.setattr(sandbox, "require", unavailable)
    result = run("grade", tmp_path / "submitted", "--out", tmp_path / "out")
    assert result.exit_code == 2 and "apt install bubblewrap" in result.output and not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", [["grade"], ["collect", "--best", "--into", "somewhere"]])
def test_a_wall_that_this_machine_lacks_is_named_and_no_other_is_used(tmp_path, monkeypatch, command):
    (tmp_path / "submitted" / "s1" / "ch44").mkdir(parents=True)
    monkeypatch.setattr(gvisor, "missing", lambda: "runsc is missing: install gVisor")
    result = run(*command, tmp_path / "submitted", "--wall", "gvisor")
    assert result.exit_code == 2 and "runsc is missing" in result.output
    assert tuple(cli.Wall) == sandbox.WALLS
    assert run("grade", tmp_path / "submitted", "--wall", "paper").exit_code == 2
    both = run("grade", tmp_path / "submitted", "--wall", "gvisor", "--trust-submissions")
    assert both.exit_code == 2 and "leave one of them out" in both.output


@pytest.mark.parametrize(
    ("verdicts", "arguments", "status"),
    [
        ([("graded", 5.0)], [], 0),
        ([("graded", 5.0), ("student_error", 0.0)], [], 0),
        ([("needs_review", 0.0)], [], 0),
        ([("graded", 5.0)], ["--fail-under", "0.5"], 0),
        ([("graded", 4.9)], ["--fail-under", "0.5"], 1),
        ([("graded", 5.0), ("infra_error", 0.0)], [], 3),
        ([("graded", 4.0), ("infra_error", 0.0)], ["--fail-under", "0.5"], 3),
    ],
)
def test_the_exit_status_tells_wrong_work_from_broken_machinery(tmp_path, monkeypatch, verdicts, arguments, status):
    results = [Verdict(f"s{i}", "ch44", kind, score, 10.0) for i, (kind, score) in enumerate(verdicts)]
    monkeypatch.setattr(grade, "grade", lambda *_args, **_kwargs: results)
    monkeypatch.setattr(exports, "table", lambda _results: "")
    assert run("grade", tmp_path, *arguments).exit_code == status


def test_an_unknown_assignment_under_fail_under_is_wrong_work(tmp_path, monkeypatch):
    monkeypatch.setattr(grade, "grade", lambda *_args, **_kwargs: [Verdict("s", "ch4", "student_error", 0.0, 0.0)])
    monkeypatch.setattr(exports, "table", lambda _results: "")
    assert run("grade", tmp_path, "--fail-under", "0.1").exit_code == 1


def test_an_unknown_chapter_cannot_be_released(tmp_path):
    result = run("release", "--only", "ch9999", "--out", tmp_path / "bundle")
    assert result.exit_code == 2 and "ch9999" in result.output and not (tmp_path / "bundle").exists()


def test_what_is_no_notebook_cannot_be_checked(tmp_path):
    (tmp_path / "x.ipynb").write_text("not json")
    assert run("check", tmp_path / "x.ipynb").exit_code == 2
    assert run("check", tmp_path / "none.ipynb").exit_code == 2
    (tmp_path / "empty.ipynb").write_text(str(new_notebook()).replace("'", '"'))
    assert run("check", tmp_path / "empty.ipynb").exit_code == 2


TOY = '''"""A toy: one step."""
VARIANTS = {"a": {}, "b": {}}
SEEDS = 2


def run(variant, seed, checkpoint_dir, report):
    if variant == "b":
        raise RuntimeError("b fails")
    return [{"env_steps": 0, "score": 1.0}]
'''


def test_long_runs_are_made_listed_and_kept(tmp_path, monkeypatch):
    from experiments import campaign

    (tmp_path / "toy.py").write_text(TOY)
    monkeypatch.setattr(campaign, "FOLDER", tmp_path)
    out = tmp_path / "runs"
    made = run("experiment", "toy", "--variant", "a", "--seeds", "1", "--out", out)
    assert made.exit_code == 0 and "toy: 1 made. The records are in" in made.output
    assert (out / "toy" / "a-0.parquet").is_file()
    listed = run("experiment", "--out", out)
    assert listed.exit_code == 0 and "toy: A toy: one step.\n    1 finished, 3 missing" in listed.output
    failing = run("experiment", "toy", "--out", out)
    assert failing.exit_code == 3 and "toy: 2 failed, 1 kept, 1 made." in failing.output and "b fails" in failing.output
    assert run("experiment", "tow").exit_code == 2 and "there are: toy" in run("experiment", "tow").output
    assert run("experiment", "toy", "--variant", "c").exit_code == 2


@pytest.mark.parametrize(
    ("score", "state", "arguments", "status"),
    [
        (5.0, "graded", [], 4),
        (5.0, "infra_error", [], 3),
        (4.0, "graded", ["--fail-under", "0.5"], 1),
        (5.0, "graded", ["--fail-under", "0.5"], 4),
    ],
)
def test_what_was_not_understood_is_named_and_has_an_exit_status_of_its_own(
    tmp_path, monkeypatch, score, state, arguments, status
):
    def graded(*words, **_options):
        words[-1]("ada/ch44.ipynb: a notebook outside an assignment's folder")
        return [Verdict("s", "ch44", state, score * (state == "graded"), 10.0)]

    monkeypatch.setattr(grade, "grade", graded)
    monkeypatch.setattr(exports, "table", lambda _results: "")
    result = run("grade", tmp_path, *arguments)
    assert result.exit_code == status and "course: not understood: ada/ch44.ipynb: a notebook outside" in result.output


def outcome(name, error="", rule="half"):
    from experiments.atlas.runner import Outcome

    row = {"formula": "value_loss", "setting": "", "equal": False, "rule": rule}
    return Outcome(name, None if error else {"versions": {name: "1.0"}, "rows": [row]}, error)


@pytest.mark.parametrize(
    ("arguments", "failing", "rule", "status", "said"),
    [
        (["trl", "verl", "trl"], (), "half", 0, ["trl 1.0: 0 of 1 rows", "verl 1.0: 0 of 1 rows"]),
        (["trl", "verl"], ("trl",), "half", 3, ["trl: yanked", "verl 1.0", "1 of the libraries could not be run"]),
        (["trl"], (), "", 1, ["by no known rule: value_loss", "neither the course's nor made by a rule"]),
        (["nonsense"], (), "half", 2, ["no library 'nonsense' in the atlas; there are: agilerl, "]),
    ],
)
def test_the_atlas_goes_on_where_a_library_fails_and_its_status_tells(monkeypatch, arguments, failing, rule, status, said):
    from experiments.atlas import runner

    ran = []

    def run(name, newer, environments):
        ran.append(name)
        return outcome(name, "yanked" if name in failing else "", rule)

    monkeypatch.setattr(runner, "run", run)
    monkeypatch.setattr(cli, "err", cli.Console(highlight=False, soft_wrap=True, width=500))
    result = CliRunner().invoke(cli.app, ["atlas", *arguments])
    assert result.exit_code == status and all(line in result.output for line in said)
    assert ran == ([] if status == 2 else list(dict.fromkeys(arguments)))
