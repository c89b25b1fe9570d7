"""The engine of long runs: makes what is missing, keeps what is finished, and converges after any kill."""

import os
import signal
import subprocess
import sys
import time

import pytest

from course_lib.figures import records
from experiments import campaign
from experiments.campaign import ExperimentError


def todo(folder, *variants, seeds=None):
    return campaign.tasks(campaign.definition("toy", folder), variants, seeds, folder / "runs")


def ends(outcomes):
    return sorted((outcome.variant, outcome.seed, outcome.state) for outcome in outcomes)


def steps(folder):
    return (folder / "steps.txt").read_text().split()


def test_records_are_made_with_their_provenance_and_then_kept(folder):
    seen = []
    outcomes = campaign.make(todo(folder, "fast"), jobs=2, progress=lambda *message: seen.append(message))
    assert ends(outcomes) == [("fast", 0, "made"), ("fast", 1, "made")]
    assert {message[:2] for message in seen} == {("fast", 0), ("fast", 1)} and ("fast", 1, 3, 3) in seen
    loaded = records.load("toy", folder / "runs")
    assert loaded.curve("fast", "score")[1].tolist() == [[0, 1, 2], [1, 2, 3]]
    assert loaded.summary("fast", "last").tolist() == [2, 3]
    assert loaded.artefact("fast", 0, "txt").read_bytes() == b"artefact"
    made = loaded.of("fast")[0].provenance
    assert made["configuration"] == {"steps": 3} and made["command"] == "course experiment toy --variant fast"
    assert made["wall_seconds"] < 60 and made["versions"].keys() >= {"python", "torch"} and len(made["commit"]) >= 40
    assert made["machine"].keys() == {"cores", "memory_gb", "cpu"}
    assert not list((folder / "runs" / ".checkpoints").rglob("*.*")), "checkpoints of finished runs are gone"
    assert ends(campaign.make(todo(folder, "fast"))) == [("fast", 0, "kept"), ("fast", 1, "kept")]
    assert len(steps(folder)) == 6


def test_a_changed_configuration_and_a_damaged_file_are_made_again(folder):
    list(campaign.make(todo(folder, "fast")))
    records_of = [task.record for task in todo(folder, "fast")]
    records_of[0].write_bytes(b"damaged")
    assert [campaign.state(task) for task in todo(folder)] == ["damaged", "finished", "missing"]
    sys.modules.pop("experiments.toy")
    (folder / "toy.py").write_text((folder / "toy.py").read_text().replace('"steps": 3', '"steps": 2'))
    assert [campaign.state(task) for task in todo(folder, "fast")] == ["damaged", "outdated"]
    assert ends(campaign.make(todo(folder, "fast"))) == [("fast", 0, "made"), ("fast", 1, "made")]
    assert [len(records.read(path).columns["env_steps"]) for path in records_of] == [2, 2]


def test_a_run_that_fails_tells_why_and_costs_the_others_nothing(folder):
    (folder / "fail").touch()
    outcomes = list(campaign.make(todo(folder, "fast", seeds=3)))
    assert ends(outcomes) == [("fast", 0, "made"), ("fast", 1, "failed"), ("fast", 2, "made")]
    assert "RuntimeError: told to fail" in next(outcome.error for outcome in outcomes if outcome.state == "failed")
    (folder / "fail").unlink()
    assert ends(campaign.make(todo(folder, "fast"))) == [("fast", 0, "kept"), ("fast", 1, "made")]


def test_a_run_that_another_process_makes_is_left_to_it(folder):
    (task,) = todo(folder, "fast", seeds=1)
    task.checkpoints.mkdir(parents=True)
    with campaign._lock(task.checkpoints / campaign.LOCK):
        assert campaign.make_one(task, lambda *message: None).state == "busy"
    assert campaign.make_one(task, lambda *message: None).state == "made"


def test_after_kill_nine_the_next_command_goes_on_where_the_run_was(folder):
    program = (
        "from pathlib import Path\nfrom experiments import campaign\n"
        "if __name__ == '__main__':\n"
        f"    folder = Path({str(folder)!r})\n"
        "    list(campaign.make(campaign.tasks(campaign.definition('toy', folder), ['slow'], None, folder / 'runs')))\n"
    )
    (folder / "main.py").write_text(program)
    environment = os.environ | {"PYTHONPATH": str(campaign.FOLDER.parent)}
    running = subprocess.Popen([sys.executable, folder / "main.py"], env=environment)
    try:
        _until(lambda: (folder / "steps.txt").exists() and len(steps(folder)) >= 5)
    finally:
        running.send_signal(signal.SIGKILL)
        running.wait()
    (task,) = todo(folder, "slow")
    assert not task.record.exists()
    _until(lambda: _free(task))  # the pool's process ends with its parent
    before = len(steps(folder))
    assert 5 <= before < 40
    assert ends(campaign.make([task])) == [("slow", 0, "made")]
    assert len(records.read(task.record).columns["env_steps"]) == 40
    assert len(steps(folder)) <= 41, "one step at most was taken twice"


def _free(task):
    with campaign._lock(task.checkpoints / campaign.LOCK) as ours:
        return ours


def _until(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_dask_workers_make_the_same_records(folder):
    from distributed import LocalCluster

    seen = []
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        outcomes = list(
            campaign.make(todo(folder, "fast"), scheduler=cluster.scheduler_address, progress=lambda *m: seen.append(m))
        )
    assert ends(outcomes) == [("fast", 0, "made"), ("fast", 1, "made")]
    assert ("fast", 0, 3, 3) in seen
    assert records.load("toy", folder / "runs").summary("fast", "last").tolist() == [2, 3]


def test_bad_requests_are_refused(folder):
    with pytest.raises(ExperimentError, match="no experiment 'tow'; there are: toy"):
        campaign.definition("tow", folder)
    with pytest.raises(ExperimentError, match="toy has no variant 'quick'; it has: fast, slow"):
        todo(folder, "quick")
    with pytest.raises(ExperimentError, match="at least 1, got 0"):
        todo(folder, seeds=0)
    (folder / "half.py").write_text("VARIANTS = {}\nSEEDS = 1\n")
    with pytest.raises(ExperimentError, match=r"half.py must define run"):
        campaign.definition("half", folder)
    (folder / "named.py").write_text("VARIANTS = {'a-b': {}}\nSEEDS = 1\ndef run(*args): ...\n")
    with pytest.raises(ExperimentError, match="got 'a-b'"):
        campaign.definition("named", folder)


def test_every_experiment_of_the_course_keeps_the_contract():
    for name in campaign.names():
        assert campaign.tasks(campaign.definition(name))
