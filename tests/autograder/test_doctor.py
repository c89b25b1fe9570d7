"""The doctor is quiet on a working machine, names what is broken on another, and its exit status tells the two apart."""

import io
import sys

import pytest
from rich.console import Console

from autograder import doctor
from autograder.doctor import Check
from autograder.grading import forking, gvisor, sandbox


def test_this_machine_works():
    found = {check.name: check for check in doctor.checks()}
    assert [check for check in found.values() if check.required and not check.ok] == []
    assert list(found) == [
        "Python",
        "packages",
        "torch",
        "MuJoCo",
        "sandbox",
        "fork server",
        "wall",
        "flights",
        "nbgrader",
        "frozen checks",
        "disk",
        "browser",
    ]
    assert all(check.ok or check.remedy for check in found.values())


def report(monkeypatch, *found):
    monkeypatch.setattr(doctor, "checks", lambda: list(found))
    output = io.StringIO()
    return doctor.report(Console(file=output, width=200)), output.getvalue()


def test_only_what_is_required_counts(monkeypatch):
    works, missing = Check("a", True, "fine"), Check("b", False, "not there", "apt install b", required=False)
    status, text = report(monkeypatch, works, missing)
    assert status == 0 and "apt install b" in text and "optional" in text
    status, text = report(monkeypatch, works, Check("c", False, "broken", "mend it"))
    assert status == 1 and "mend it" in text


def test_a_missing_or_different_package_is_named(monkeypatch, tmp_path):
    (tmp_path / "requirements.txt").write_text("# a comment\n-c constraints.txt\nnumpy==1.0\nno-such-package[x]==2\nrich>=1\n")
    monkeypatch.setattr(doctor, "ROOT", tmp_path)
    check = doctor._packages()
    assert not check.ok and "numpy" in check.detail and "no-such-package missing" in check.detail and "rich" not in check.detail


def test_a_build_label_does_not_make_another_version():
    assert doctor._satisfied(doctor.Requirement("torch==2.13.0"))  # installed as 2.13.0+cpu on machines without a GPU


def test_a_fork_server_that_does_not_work_is_told_and_not_required(monkeypatch):
    def refuses():
        raise forking.Refused("user namespaces are switched off")

    monkeypatch.setattr(forking, "course", forking.Shared(refuses))
    check = doctor._forks()
    assert (check.ok, check.required, check.detail) == (
        False,
        False,
        "user namespaces are switched off",
    ) and "longer" in check.remedy


@pytest.mark.parametrize("server", [object(), None])
def test_the_wall_in_use_is_told_and_why_it_is_not_the_stronger_one(monkeypatch, server):
    monkeypatch.setattr(forking, "course", type("Shared", (), {"get": staticmethod(lambda: server)}))
    monkeypatch.setattr(gvisor, "around", lambda: "")
    used = "namespaces of its own, forked" if server else "bubblewrap, one process each"
    monkeypatch.setattr(sandbox, "probe", lambda torch, wall: [])
    assert doctor._wall() == Check("wall", True, f"{used}; the stronger one works, too: course grade --wall gvisor")
    monkeypatch.setattr(sandbox, "probe", lambda torch, wall: [sandbox.Problem("runsc is missing", "apt install runsc")])
    check = doctor._wall()
    assert (check.ok, check.required) == (False, False)
    assert check.detail == f"{used}; gVisor, the stronger one: runsc is missing" and "apt install runsc" in check.remedy


def test_a_container_around_everything_is_told(monkeypatch, tmp_path):
    monkeypatch.setattr(sandbox, "probe", lambda torch, wall: [])
    monkeypatch.setattr(gvisor, "around", lambda: "a podman container")
    assert "all of it in a podman container" in doctor._wall().detail
    (tmp_path / "cmdline").write_text("BOOT_IMAGE=/vmlinuz-4.4.0-gvisor quiet\n")  # as gVisor's /proc has it
    monkeypatch.undo()
    assert gvisor.around(tmp_path / "cmdline") == "gVisor"
    (tmp_path / ".dockerenv").touch()
    assert gvisor.around(tmp_path / "none", tmp_path) == "a docker container"
    assert gvisor.around(tmp_path / "none", tmp_path / "none") == ""


def test_a_broken_sandbox_is_reported_with_its_remedy(monkeypatch):
    monkeypatch.setattr(sandbox, "probe", lambda torch: [sandbox.Problem("no sandbox", "apt install bubblewrap")])
    assert doctor._sandbox() == Check("sandbox", False, "no sandbox", "apt install bubblewrap")


def test_a_sandbox_that_fails_once_works_and_the_failure_is_told(monkeypatch):
    left = [[sandbox.Problem("import torch fails inside the sandbox: OSError", "")], []]
    monkeypatch.setattr(sandbox, "probe", lambda torch: left.pop(0))
    check = doctor._sandbox()
    assert check.ok and "a first try failed: import torch fails inside the sandbox: OSError" in check.detail


def test_a_missing_engine_is_reported(monkeypatch):
    monkeypatch.setattr("gymnasium.make", lambda *_, **__: 1 / 0)
    check = doctor._flights()
    assert not check.ok and "ZeroDivisionError" in check.detail and check.remedy


def test_a_mujoco_that_lost_its_core_in_an_upgrade_comes_with_the_mend(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)  # importing it raises ImportError, as it does then
    check = doctor._mujoco()
    assert (
        not check.ok
        and "ModuleNotFoundError" in check.detail
        and "--force-reinstall --no-deps mujoco mujoco-core" in check.remedy
    )


@pytest.mark.parametrize(("version", "ok"), [((3, 10), False), ((3, 11), True), ((3, 13), True), ((3, 14), False)])
def test_three_versions_of_python_will_do(monkeypatch, version, ok):
    monkeypatch.setattr(sys, "version_info", version)
    check = doctor._python()
    assert check.ok is ok and ("3.12" in check.remedy) is not ok


@pytest.mark.parametrize("look", [doctor._nbgrader, doctor._browser])
def test_missing_programs_come_with_a_remedy(monkeypatch, look):
    monkeypatch.setenv("PATH", "/nowhere")
    check = look()
    assert not check.ok and check.remedy
