"""The files of tools/cluster: for SLURM, which two small programs play here (`sbatch` runs a job's script at once, `scancel` ends it), and
for Kubernetes, of which nothing is here: its files are read as data.
"""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import yaml

from tests.faults.runs import ROOT, results

FOLDER = ROOT / "tools" / "cluster"
SBATCH = """#!/bin/bash
cp "$1" "$PLAYED/script-$$"
setsid bash "$PLAYED/script-$$" > "$PLAYED/log-$$" 2>&1 &
echo $! >> "$PLAYED/jobs"
echo "Submitted batch job $!"
"""
SCANCEL = """#!/bin/bash
for job; do kill -- "-$job"; echo "$job" >> "$PLAYED/cancelled"; done
"""


@pytest.fixture
def run(tmp_path):
    """Runs the program in a folder of its own; afterwards no job is left."""
    for name, text in {"sbatch": SBATCH, "scancel": SCANCEL}.items():
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    played = {"PLAYED": str(tmp_path), "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": paths}

    def program(*words):
        command = [sys.executable, str(FOLDER / "slurm.py"), *words]
        return subprocess.run(command, cwd=tmp_path, env=os.environ | played, text=True, capture_output=True, timeout=240)

    yield program
    jobs = (tmp_path / "jobs").read_text().split() if (tmp_path / "jobs").exists() else []
    for job in jobs:
        subprocess.run(["kill", "-9", "--", f"-{job}"], capture_output=True)


def test_the_job_asks_for_what_a_worker_needs_and_starts_one_of_this_environment(run, tmp_path):
    words = ["--show", "--cores", "3", "--partition", "short", "--account", "course", "submitted"]
    done = run(*words)
    assert done.returncode == 0 and not (tmp_path / "jobs").exists(), done.stderr
    lines = done.stdout.splitlines()
    wanted = ["-p short", "-A course", "-n 1", "--cpus-per-task=3", "--mem=6G", "-t 02:00:00"]
    assert {f"#SBATCH {one}" for one in wanted} < set(lines)
    [worker] = [line for line in lines if line.startswith(f"{sys.executable} -m distributed.cli.dask_worker tcp://")]
    for one in ("--nthreads 3 ", "--nanny ", "--lifetime 110m ", "--preload autograder.grade"):
        assert one in worker


def test_jobs_give_the_grades_of_a_local_run_and_are_cancelled(run, submitted, undisturbed, tmp_path):
    done = run("--workers", "2", "--cores", "1", str(submitted), "--out", str(tmp_path / "grades"), "--timeout", "20")
    logs = "".join(path.read_text() for path in tmp_path.glob("log-*"))
    assert done.returncode == 0, done.stderr + logs
    assert results(tmp_path / "grades") == results(undisturbed[0])
    jobs = (tmp_path / "jobs").read_text().split()
    assert len(jobs) >= 2 and set(jobs) == set((tmp_path / "cancelled").read_text().split())


def test_kubernetes_gets_a_scheduler_workers_with_a_sandbox_and_a_grader_that_see_the_same_files():
    cluster, grader = yaml.safe_load_all((FOLDER / "kubernetes.yaml").read_text())
    assert (cluster["apiVersion"], cluster["kind"]) == ("kubernetes.dask.org/v1", "DaskCluster")
    worker, scheduler = cluster["spec"]["worker"]["spec"], cluster["spec"]["scheduler"]["spec"]
    containers = [pod["containers"][0] for pod in (worker, scheduler, grader["spec"])]
    assert len({one["image"] for one in containers}) == 1
    assert [one["args"][0] for one in containers[:2]] == ["dask-worker", "dask-scheduler"]
    assert containers[0]["args"][-2:] == ["--preload", "autograder.grade"]
    for pod in (worker, grader["spec"]):
        [one] = pod["containers"]
        assert one["securityContext"] == {
            "privileged": True
        }  # the operator knows no hostUsers, without which procMount is refused
        assert one["volumeMounts"] == [{"name": "files", "mountPath": "/files"}]
        assert pod["volumes"] == [{"name": "files", "persistentVolumeClaim": {"claimName": "course-files"}}]
    assert cluster["spec"]["scheduler"]["service"]["selector"]["dask.org/cluster-name"] == cluster["metadata"]["name"]


def test_the_image_has_the_pins_and_the_sandbox():
    lines = (FOLDER / "Dockerfile").read_text().splitlines()
    commands = [line for line in lines if not line.startswith("#")]
    assert any("apt-get install" in line and "bubblewrap" in line and "util-linux" in line for line in commands)
    assert commands.index("COPY requirements.txt constraints.txt ./") < commands.index(
        "RUN pip install --no-cache-dir -r requirements.txt"
    )
