"""Grading on a Dask cluster of two workers on this machine: the grades of a local run, whatever happens to workers and schedulers.

Each wait of a test ends: an alarm rings in the main thread after LIMIT seconds.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from threading import Thread

import psutil
import pytest
from distributed import Client
from typer.testing import CliRunner

from autograder import cli, grade
from autograder.proving import side_by_side
from tests.attacks import toolbox

ROOT = Path(__file__).parents[2]
STUDENTS = [f"s{number}" for number in range(8)]
LIMIT = 300
SHORT_TTL = {"DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": "15 s"}  # after so long a silence a worker's work is given to another


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
        words = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "60"]
        loaded = ["--preload", "autograder.grade"]  # before it joins: to load torch takes seconds in which it says nothing
        return self._run("dask_worker", self.address, *words, *loaded)

    def _run(self, module: str, *words: str) -> subprocess.Popen:
        command = [sys.executable, "-m", f"distributed.cli.{module}", *words]
        environment = os.environ | SHORT_TTL | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.started.append(subprocess.Popen(command, cwd=ROOT, env=environment, start_new_session=True, **quiet))
        return self.started[-1]

    def stop(self) -> None:
        for process in self.started:
            if process.poll() is None:
                for one in [*psutil.Process(process.pid).children(recursive=True), process]:
                    with suppress(psutil.NoSuchProcess):  # a child may end between the listing and here
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
    if running.scheduler.poll() is not None:
        running.stop()
        running.start()
    running.workers = [running.worker() if one.poll() is not None else one for one in running.workers]
    with Client(running.address, timeout=60) as client:
        client.wait_for_workers(2, timeout=120)
    return running


@pytest.fixture(autouse=True)
def no_wait_is_endless():
    def ring(number, frame):
        raise AssertionError(f"still waiting after {LIMIT} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(LIMIT)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture
def impatient(monkeypatch):
    """Shortens waits, once it is called: on a busy machine those before need their time."""

    def now(**seconds):
        for name, value in seconds.items():
            monkeypatch.setattr(side_by_side, name, value)

    return now


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


def results(out, tables=("grades.csv", "questions.csv", "canvas.csv")):
    """What runs must agree on, and how often each submission stands in the tables."""
    verdicts = {}
    for path in sorted(out.glob("verdicts/*/*.json")):
        verdicts[path.parent.name, path.stem] = json.loads(path.read_text()) | {"seconds": None}
    return verdicts, [(out / name).read_text() for name in tables]


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


def test_two_workers_share_the_work_and_give_the_grades_of_a_local_run(cluster, submitted, local, tmp_path):
    assert graded(submitted, tmp_path / "grades", cluster.address) == local
    with Client(cluster.address) as client:
        shares = client.run(lambda dask_worker: dask_worker.state.executed_count)
    assert sum(shares.values()) == len(STUDENTS) + 1 and min(shares.values()) >= 2


def test_a_worker_that_falls_silent_and_comes_back_delivers_nothing_twice(cluster, submitted, local, tmp_path):
    silent = cluster.workers[0]

    def come_back():
        with Client(cluster.address, set_as_default=False) as client:
            while len(client.nthreads()) == 2:
                time.sleep(0.5)
        silent.send_signal(signal.SIGCONT)  # it was given up, and knows nothing of it

    back = Thread(target=come_back, daemon=True)

    def silence():
        silent.send_signal(signal.SIGSTOP)
        back.start()

    assert graded(submitted, tmp_path / "grades", cluster.address, silence) == local
    back.join()
    silent.wait(60)  # it is told so, and ends


def test_a_killed_worker_costs_nobody_a_grade(cluster, submitted, local, tmp_path):
    assert graded(submitted, tmp_path / "grades", cluster.address, cluster.workers[1].kill) == local
    assert cluster.workers[1].wait(1) == -signal.SIGKILL


def test_a_restarted_scheduler_is_handed_what_the_first_one_took_with_it(cluster, submitted, local, tmp_path):
    def restart():
        cluster.stop()
        cluster.start()

    assert graded(submitted, tmp_path / "grades", cluster.address, restart) == local


@pytest.fixture(scope="module")
def dumb():
    """The address of a program that takes every call and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield f"tcp://127.0.0.1:{listening.getsockname()[1]}"


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense://nowhere", "127.0.0.1:port", "dumb"])
def test_a_scheduler_that_is_not_there_is_one_line(submitted, tmp_path, impatient, dumb, address):
    impatient(PATIENCE=2)
    address = dumb if address == "dumb" else address
    words = ["grade", str(submitted), "--out", str(tmp_path / "grades"), "--scheduler", address]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 3, result.output
    [line] = result.stderr.splitlines()
    assert line.startswith(f"course: no Dask scheduler at {address}: ") and line.endswith("grade again.")


def kept_line(cluster, submitted, local, tmp_path, at_first):
    """What is said of a cluster that gets lost for good; what is graded is kept."""
    out = tmp_path / "grades"
    with pytest.raises(side_by_side.NoScheduler) as failed:
        graded(submitted, out, cluster.address, at_first)
    kept = results(out, tables=())[0]
    assert kept and kept.items() <= local[0].items()
    return str(failed.value)


@pytest.mark.parametrize("loss", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "silent"])
def test_a_scheduler_that_stays_away_leaves_what_is_graded(cluster, submitted, local, tmp_path, impatient, loss):
    def lose():
        impatient(PATIENCE=5, LOOK=1, FETCH=5)
        cluster.scheduler.send_signal(loss)

    try:
        line = kept_line(cluster, submitted, local, tmp_path, lose)
    finally:
        cluster.stop()
    assert line == f"no Dask scheduler at {cluster.address}: none answered within 5 s"


def test_a_scheduler_without_workers_is_not_waited_for_without_end(cluster, submitted, local, tmp_path, impatient):
    def lose():
        impatient(HIRING=5, LOOK=2)
        for worker in cluster.workers:
            worker.kill()

    line = kept_line(cluster, submitted, local, tmp_path, lose)
    assert line == f"no worker has joined {cluster.address} for 5 s: start one with `dask worker {cluster.address}`"


@pytest.mark.parametrize(("changed", "complaint"), [("content", "does not see the files"), ("environment", "another version")])
def test_a_worker_without_the_files_or_with_other_checks_judges_nothing(submitted, changed, complaint):
    folder = submitted / "s2" / "ch44"
    said = {"content": grade._content(folder), "environment": grade.judge.environment()} | {changed: "other"}
    with pytest.raises(grade.OtherWorker, match=complaint):
        grade._judge_elsewhere(("s2", "ch44", folder, said["content"]), said["environment"], 10)
