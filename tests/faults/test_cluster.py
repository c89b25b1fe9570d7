"""Grading on a Dask cluster of two workers on this machine: the grades of a local run; what is wrong with a cluster is one line."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from typer.testing import CliRunner

from autograder import cli, grade
from autograder.proving import side_by_side
from tests.attacks import toolbox

ROOT = Path(__file__).parents[2]
STUDENTS = [f"s{number}" for number in range(8)]


class Cluster:
    """A scheduler and two workers, each a process that can be killed alone."""

    def __init__(self) -> None:
        with socket.socket() as any_port:
            any_port.bind(("127.0.0.1", 0))
            self.port = any_port.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.started: list[subprocess.Popen] = []
        self.start()

    def start(self) -> None:
        self.scheduler = self._run("dask_scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard")
        self.workers = [self.worker() for _ in range(2)]

    def worker(self) -> subprocess.Popen:
        return self._run("dask_worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "60")

    def _run(self, module: str, *words: str) -> subprocess.Popen:
        command = [sys.executable, "-m", f"distributed.cli.{module}", *words]
        environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.started.append(subprocess.Popen(command, cwd=ROOT, env=environment, start_new_session=True, **quiet))
        return self.started[-1]

    def stop(self) -> None:
        for process in self.started:
            if process.poll() is None:
                for one in [*psutil.Process(process.pid).children(recursive=True), process]:
                    one.kill()
                process.wait()


@pytest.fixture(scope="module")
def running():
    cluster = Cluster()
    yield cluster
    cluster.stop()


@pytest.fixture
def cluster(running):
    """The cluster, with two workers, whatever an earlier test has done to them."""
    running.workers = [running.worker() if one.poll() is not None else one for one in running.workers]
    return running


@pytest.fixture(scope="module")
def submitted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("class") / "submitted"
    for number, student in enumerate(STUDENTS):
        target = folder / student / "ch44"
        target.mkdir(parents=True)
        notebook = toolbox.solved()
        if number % 2:
            toolbox.wrong(notebook)
        toolbox.write(target, notebook)
    (folder / "s0" / "ch44" / "ch44.ipynb").write_text("no notebook")
    (folder / "s1" / "ch00").mkdir()
    return folder


def results(out):
    """What runs must agree on, and how often each submission stands in the tables."""
    verdicts = {}
    for path in sorted(out.glob("verdicts/*/*.json")):
        verdicts[path.parent.name, path.stem] = json.loads(path.read_text()) | {"seconds": None}
    return verdicts, [(out / name).read_text() for name in ("grades.csv", "questions.csv", "canvas.csv")]


@pytest.fixture(scope="module")
def local(submitted, tmp_path_factory):
    out = tmp_path_factory.mktemp("local") / "grades"
    grade.grade(submitted, out)
    found = results(out)
    scores = [one["score"] for (_, name), one in found[0].items() if name == "ch44"]
    assert scores == [0.0, 8.0, 10.0, 8.0, 10.0, 8.0, 10.0, 8.0]
    return found


def graded(submitted, out, scheduler, at_first=lambda: None):
    """A run on the cluster; something happens as the first verdict comes in. The verdicts, in the order of coming in."""
    seen = []

    def progress(done, total, name):
        seen.append(name)
        if done == 1:
            at_first()

    grade.grade(submitted, out, scheduler=scheduler, progress=progress)
    assert sorted(seen) == sorted([*(f"{student}/ch44" for student in STUDENTS), "s1/ch00"])  # each once
    return results(out)


def test_two_workers_give_the_grades_of_a_local_run(cluster, submitted, local, tmp_path):
    assert graded(submitted, tmp_path / "grades", cluster.address) == local


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense://nowhere", "127.0.0.1:port"])
def test_a_scheduler_that_is_not_there_is_one_line(submitted, tmp_path, monkeypatch, address):
    monkeypatch.setattr(side_by_side, "PATIENCE", 1)
    begun = time.monotonic()
    words = ["grade", str(submitted), "--out", str(tmp_path / "grades"), "--scheduler", address]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 3 and time.monotonic() - begun < 30, result.output
    [line] = result.stderr.splitlines()
    assert line.startswith(f"course: no Dask scheduler at {address}: ") and line.endswith("grade again.")


@pytest.mark.parametrize(("changed", "complaint"), [("content", "does not see the files"), ("environment", "another version")])
def test_a_worker_without_the_files_or_with_other_checks_judges_nothing(submitted, changed, complaint):
    folder = submitted / "s2" / "ch44"
    said = {"content": grade._content(folder), "environment": grade.judge.environment()} | {changed: "other"}
    with pytest.raises(grade.OtherWorker, match=complaint):
        grade._judge_elsewhere(("s2", "ch44", folder, said["content"]), said["environment"], 10)
