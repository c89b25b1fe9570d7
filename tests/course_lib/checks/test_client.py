"""The learner's check: what it says, how fast, and how it fails on bad input."""

import inspect
import json
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from autograder import checks
from autograder.authoring import freeze
from autograder.checks import ch44
from course_lib import check
from course_lib.checks import client
from solutions import ch44 as solutions


@pytest.fixture(scope="module", autouse=True)
def frozen(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frozen")
    freeze.write(checks.exercises("ch44"), folder)
    before, client.FROZEN = client.FROZEN, folder
    client.visible_cases.cache_clear()
    yield folder
    client.FROZEN = before
    client.visible_cases.cache_clear()


def named(name, function):
    def wrapper(*args, **kwargs):
        return function(*args, **kwargs)

    wrapper.__name__ = name
    return wrapper


@pytest.mark.parametrize("exercise", ch44.EXERCISES, ids=lambda exercise: exercise.name)
def test_the_reference_passes_and_every_misconception_is_named(exercise):
    assert check(exercise.reference).passed
    for mistake in exercise.misconceptions:
        result = check(named(exercise.name, mistake.function))
        assert not result.passed and mistake.name in result.finding.misconceptions, mistake.name
        assert mistake.message in repr(result)


def test_a_stub_is_not_implemented_yet():
    def compute_gae(*args, **kwargs):
        raise NotImplementedError

    assert repr(check(compute_gae)) == "✗ Not implemented yet: compute_gae"


def test_a_wrong_step_is_placed_and_described():
    def compute_gae(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):
        right = solutions.compute_gae(rewards, values, next_values, terminated, truncated, gamma, gae_lambda)
        return right * (1 - 0.5 * truncated.to(right.dtype))

    text = repr(check(compute_gae))
    assert "is where env" in text and "was truncated" in text and "is right at t=" in text


def test_a_learners_exception_comes_without_our_traceback():
    def compute_gae(*args, **kwargs):
        return undefined_name  # noqa: F821

    assert "NameError: name 'undefined_name' is not defined" in repr(check(compute_gae))


@pytest.mark.parametrize(
    ("earlier", "headline"),
    [("rewards - values", "Not yet"), ("unheard_of", "It stops with an error"), ("not_yet()", "Not implemented yet")],
)
def test_what_fails_by_another_exercise_says_where_to_begin(earlier, headline):
    def not_yet():
        raise NotImplementedError

    notebook = dict(vars(solutions), not_yet=not_yet)
    exec(inspect.getsource(solutions.compute_gae), notebook)
    exec(f"def td_residuals(rewards, values, next_values, terminated, gamma=0.99):\n    return {earlier}", notebook)
    result = check(notebook["compute_gae"])
    assert result.headline() == f"{headline}: compute_gae"
    assert result.lines()[0] == "It calls td_residuals, which does not pass its own check: begin there."


def test_what_calls_a_right_one_has_its_own_fault():
    notebook = {"td_residuals": solutions.td_residuals}
    exec("def compute_gae(*given):\n    return -td_residuals(*given[:4])", notebook)
    assert "td_residuals" not in repr(check(notebook["compute_gae"]))


def test_a_list_is_not_called_a_tuple():
    def compute_gae(*args, **kwargs):
        return [1.0, 2.0]

    assert "It returns a list or tuple of 2 (float, float) where a tensor is asked for." in repr(check(compute_gae))


def test_html_escapes_what_a_learner_raises():
    def compute_gae(*args, **kwargs):
        raise RuntimeError("<script>alert(1)</script>")

    assert "<script>" not in check(compute_gae)._repr_html_()


@pytest.mark.parametrize("thing", [3, "compute_gae", None, [1]])
def test_what_is_no_function_is_refused(thing):
    with pytest.raises(TypeError, match="check takes a function"):
        check(thing)


def test_an_unknown_name_gets_the_nearest_one():
    with pytest.raises(LookupError, match="Did you mean compute_gae"):
        check(named("compute_gea", lambda: None))


def test_without_frozen_checks_it_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(client, "FROZEN", tmp_path)
    client.visible_cases.cache_clear()
    with pytest.raises(LookupError, match="install the course_lib folder"):
        check(solutions.compute_gae)


def test_a_further_check_calls_the_function_once_a_case_and_reads_nothing(monkeypatch):
    """So that it costs what the learner's function costs: the answer is there within a blink."""
    calls = []

    def compute_gae(*args, **kwargs):
        calls.append(args)
        return solutions.compute_gae(*args, **kwargs)

    check(solutions.compute_gae)
    monkeypatch.setattr(client, "load", None)
    monkeypatch.setattr("builtins.open", None)
    modules = set(sys.modules)
    assert check(compute_gae).passed
    assert set(sys.modules) == modules
    assert len(calls) == sum(case.repeat for case in client.visible_cases("compute_gae").cases)


def test_a_first_call_imports_little_beside_torch(frozen):
    """What takes long to import, and no check needs: IPython, matplotlib, Gymnasium, pandas."""
    code = (
        "import sys, torch, pathlib\nbefore = set(sys.modules)\nfrom course_lib import check\nfrom course_lib.checks import client\n"
        f"client.FROZEN = pathlib.Path({str(frozen)!r})\nfrom solutions.ch44 import compute_gae\ncheck(compute_gae)\n"
        "print(*{name.partition('.')[0] for name in set(sys.modules) - before} - set(sys.stdlib_module_names))"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert set(told.split()) <= {"course_lib", "solutions", "numpy", "torch", "safetensors"}, told


def test_nbgraders_validate_button_sees_a_failure(monkeypatch):
    monkeypatch.setenv("NBGRADER_EXECUTION", "validate")
    (residuals,) = (mistake.function for mistake in ch44.COMPUTE_GAE.misconceptions if mistake.name == "residuals-only")
    with pytest.raises(AssertionError, match="residuals-only"):
        check(named("compute_gae", residuals))


def notebook(tmp_path, *sources):
    path = tmp_path / "nb.ipynb"
    path.write_text(
        json.dumps({"cells": [{"cell_type": "code", "source": source, "metadata": {}} for source in sources], "nbformat": 4})
    )
    return path


def command(path, frozen, **environment):
    code = (
        "import sys, pathlib\nfrom course_lib.checks import client\nfrom course_lib.checks.command import main\n"
        f"client.FROZEN = pathlib.Path({str(frozen)!r})\nsys.exit(main(sys.argv[1:]))"
    )
    environment = {**os.environ, **environment}
    return subprocess.run(
        [sys.executable, "-c", code, *path], capture_output=True, text=True, env=environment, encoding="utf-8", errors="replace"
    )


def test_the_command_passes_fails_and_refuses(tmp_path, frozen):
    right = (
        "from course_lib import validate\ndef lambda_returns(advantages, values):\n"
        "    validate.same_shape(advantages=advantages, values=values)\n    return (advantages + values).detach()"
    )
    wrong = "def lambda_returns(advantages, values):\n    return advantages"
    passing = command([str(notebook(tmp_path, right, "check(lambda_returns)"))], frozen)
    assert passing.returncode == 0 and "1 of 1 pass" in passing.stdout
    failing = command([str(notebook(tmp_path, wrong, "check(lambda_returns)", "1/0"))], frozen)
    assert failing.returncode == 1 and "✗ Not yet: lambda_returns" in failing.stdout and "code cell 3 stopped" in failing.stdout
    assert command([str(tmp_path / "none.ipynb")], frozen).returncode == 2
    assert command([str(notebook(tmp_path, "a = 1"))], frozen).returncode == 2
    assert command([], frozen).returncode == 2


def test_the_command_names_what_stopped_and_what_will_be_missing(tmp_path, frozen):
    right = (
        "import seaborn as sns\nfrom course_lib import validate\ndef lambda_returns(advantages, values):\n    sns\n"
        "    return (advantages + values + trained + np.zeros(1).item() + shift()).detach()\nimport sys\nsys.exit()"
    )
    live = "import numpy as np\ntrained = sum([0.0])\ndef shift():\n    return 0.0"
    path = notebook(tmp_path, right, live, "check(lambda_returns)")
    document = json.loads(path.read_text())
    document["cells"][1]["metadata"] = {"tags": ["live"]}
    path.write_text(json.dumps(document))
    told = command([str(path)], frozen)
    stopped = "code cell 1 stopped at line 1: ModuleNotFoundError: No module named 'seaborn'"
    assert told.returncode == 1 and f"! {stopped}" in told.stdout
    assert f"NameError: name 'sns' is not defined; {stopped}\n" in told.stdout
    assert "! lambda_returns uses trained, which is not there when it is graded: only code cell 2 sets it" in told.stdout
    assert "shift" not in told.stdout and "uses np" not in told.stdout
    path.write_text(json.dumps(document).replace(" as sns", "").replace("sns", "np"))
    assert "name 'trained' is not defined" in command([str(path)], frozen).stdout


@pytest.mark.parametrize(("encoding", "passed"), [("ascii", "ok Passed"), ("cp1252", "ok Passed"), ("utf-8", "✓ Passed")])
def test_the_command_prints_in_any_encoding(tmp_path, frozen, encoding, passed):
    right = (
        "from course_lib import validate\ndef lambda_returns(advantages, values):\n"
        "    validate.same_shape(advantages=advantages, values=values)\n    return (advantages + values).detach()"
    )
    path = notebook(tmp_path, right, "check(lambda_returns)", "raise ValueError('λ…\\udc80')")
    told = command([str(path)], frozen, PYTHONIOENCODING=encoding, PYTHONUTF8="0", LC_ALL="C")
    assert told.returncode == 0 and passed in told.stdout and "1 of 1 pass" in told.stdout and not told.stderr


@pytest.mark.parametrize(
    ("message", "told"),
    [
        ("It raises NameError: name 'sns' is not defined", ["In[2] was to set sns: run it again, and look where it stops"]),
        ("It raises NameError: name 'other' is not defined", []),
        ("It raises NameError: name 'torch' is not defined", []),
    ],
)
def test_in_jupyter_the_cell_that_was_to_set_a_missing_name_is_named(monkeypatch, message, told):
    shell = SimpleNamespace(
        kernel=1, user_ns={"In": ["", "sns = 1", "import nothing\nimport seaborn as sns\nimport torch"], "torch": 1}
    )
    monkeypatch.setitem(sys.modules, "IPython.core.getipython", SimpleNamespace(get_ipython=lambda: shell))
    assert client._cells_to_run(message) == told
