"""The archive for Gradescope's container, run as Gradescope runs it, in a folder that stands for `/autograder`."""

import io
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import nbformat
import pytest

from autograder import grade
from autograder.grading import sandbox
from autograder.grading.verdicts import Verdict
from autograder.platforms import gradescope_archive, gradescope_container, returning
from autograder.platforms.give_back import GiveBackError
from tests.attacks import toolbox
from tests.autograder.platforms.test_give_back import Class


def unpacked(folder: Path, **options: bool) -> Path:
    """A folder laid out as Gradescope lays it out: the archive in source/, run_autograder beside it, no submission yet."""
    root = folder / "autograder"
    with zipfile.ZipFile(io.BytesIO(gradescope_archive.archive("ch44", **options))) as archive:
        archive.extractall(root / "source")
        modes = {info.filename: info.external_attr >> 16 & 0o777 for info in archive.infolist()}
    assert modes["run_autograder"] == modes["setup.sh"] == 0o755
    (root / "run_autograder").write_bytes((root / "source" / "run_autograder").read_bytes())
    (root / "run_autograder").chmod(0o755)
    for name in ("submission", "results"):
        (root / name).mkdir()
    subprocess.run(["bash", "-n", str(root / "source" / "setup.sh")], check=True)
    return root


def test_a_submission_is_graded_in_the_container(tmp_path):
    root = unpacked(tmp_path)
    notebook = toolbox.solved()
    toolbox.answer(notebook, "compute_gae", "return rewards")
    secret = f"open({str(root / 'source' / 'solutions' / 'ch44.py')!r}).read()"
    toolbox.answer(notebook, "td_residuals", f"return {secret}")
    nbformat.write(notebook, root / "submission" / "ch44.ipynb")
    environment = {"PATH": os.environ["PATH"], "AUTOGRADER_ROOT": str(root), "AUTOGRADER_PYTHON": sys.executable}
    command = [str(root / "run_autograder")]
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    result = json.loads((root / "results" / "results.json").read_text())
    tests = {test["name"]: test for test in result["tests"]}
    assert tests["compute_gae"]["score"] < tests["compute_gae"]["max_score"] and tests["lambda_returns"]["status"] == "passed"
    assert "FileNotFoundError" in tests["td_residuals"]["output"]
    assert result["score"] == sum(test["score"] for test in result["tests"]) and "graded by hand" in result["output"]


@pytest.fixture
def root(tmp_path):
    for name in ("submission", "results"):
        (tmp_path / name).mkdir()
    (tmp_path / "results" / "results.json").write_text("of another submission")
    return tmp_path


def test_without_a_sandbox_the_container_refuses(root, monkeypatch, capsys):
    def unavailable():
        raise sandbox.SandboxUnavailable("bwrap: no permission")

    monkeypatch.setattr(sandbox, "require", unavailable)
    monkeypatch.setattr(grade, "judge_folder", lambda *arguments: pytest.fail("it has been run"))
    assert gradescope_container.main(["ch44", str(root)]) == 3
    assert "could read the solutions: bwrap: no permission" in capsys.readouterr().err
    assert not list((root / "results").iterdir())  # Gradescope says that the autograder failed; nobody has a zero


@pytest.mark.parametrize("status, exit_status", [("graded", 0), ("needs_review", 0), ("student_error", 0), ("infra_error", 3)])
def test_only_our_own_failure_leaves_no_result(root, monkeypatch, status, exit_status):
    monkeypatch.setattr(sandbox, "require", lambda: None)
    verdict = Verdict("submission", "ch44", status, 0.0, 10.0)
    monkeypatch.setattr(grade, "judge_folder", lambda *arguments: (verdict, None))
    assert gradescope_container.main(["ch44", str(root)]) == exit_status
    written = root / "results" / "results.json"
    assert written.is_file() == (exit_status == 0)
    if status == "graded":
        assert json.loads(written.read_text())["score"] == 0.0


@pytest.mark.parametrize(
    "arguments, says", [(["ch44"], "usage"), (["ch99", "."], "usage"), (["ch99", "ROOT"], "no such assignment: ch99")]
)
def test_unusable_arguments_of_the_container(root, capsys, arguments, says):
    places = [str(root) if argument == "ROOT" else argument for argument in arguments]
    assert gradescope_container.main(places) == 2 and says in capsys.readouterr().err


def test_the_flag_for_ones_own_code_is_in_the_archive_only_where_it_was_given():
    for trusted in (False, True):
        with zipfile.ZipFile(io.BytesIO(gradescope_archive.archive("ch44", trusted))) as archive:
            assert (b"--trust-submissions" in archive.read("run_autograder")) == trusted
            names = archive.namelist()
    assert {"setup.sh", "requirements.txt", "solutions/ch44.py", "autograder/checks/ch44.py", "course_lib/__init__.py"} <= set(
        names
    )
    assert not [name for name in names if "__pycache__" in name or name.startswith(("tests", ".")) or "/frozen/" in name]


def test_the_archive_is_made_before_anybody_has_handed_in(tmp_path):
    given = returning.give_back("gradescope", returning.Request(tmp_path / "grades", only=("ch44",)))
    assert given.files == [tmp_path / "grades" / "return" / "gradescope" / "ch44-autograder.zip"] and given.files[0].is_file()
    with pytest.raises(GiveBackError, match="no such assignment: ch99"):
        returning.give_back("gradescope", returning.Request(tmp_path / "grades", only=("ch99",)))
    with pytest.raises(GiveBackError, match="as in --only ch44"):
        returning.give_back("gradescope", returning.Request(tmp_path / "grades"))


@pytest.mark.parametrize("platform, left_out", [("gradescope", ["rev ch44"]), ("canvas", [])])
def test_what_came_from_gradescope_gets_its_results_by_number(tmp_path, platform, left_out):
    folder = Class(tmp_path, platform)
    folder.add("ada", "111", by_hand=1.5)
    folder.add("rev", "112", status="needs_review")
    given = returning.give_back("gradescope", returning.Request(folder.out, folder.submitted))
    names = ["ch44-autograder.zip", "submission_111.json"] if left_out else ["ch44-autograder.zip"]
    assert [path.name for path in given.files] == names and [line.split(":")[0] for line in given.left_out] == left_out
    if left_out:
        assert json.loads(given.files[1].read_text())["score"] == 6.5
