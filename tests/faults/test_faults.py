"""Kills, full disks, concurrent and partial runs of the real command: running again converges to the same grades."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import time

import pytest
from nbgrader.api import Gradebook

from tests.faults.runs import grade, leftovers, results, start


def test_killed_at_any_moment_the_next_run_converges(submitted, undisturbed, tmp_path):
    expected, seconds = undisturbed
    draw = random.Random(44)
    for moment in (0.5, 0.9):
        process = start(submitted, tmp_path / "grades", start_new_session=True)
        time.sleep(seconds * (moment + draw.uniform(-0.1, 0.1)))
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        for path in tmp_path.glob("grades/verdicts/*/*.json"):
            json.loads(path.read_text())  # whatever is there is whole
    grade(submitted, tmp_path / "grades")
    assert results(tmp_path / "grades") == results(expected)


def test_two_runs_on_one_folder_converge(submitted, undisturbed, tmp_path):
    both = [start(submitted, tmp_path / "grades") for _ in range(2)]
    for process in both:
        text = process.communicate(timeout=180)[0]
        assert process.returncode == 0, text
    assert results(tmp_path / "grades") == results(undisturbed[0])
    assert not leftovers(tmp_path / "grades")


@pytest.fixture
def small_disk(tmp_path):
    """A file system of its own with room for the gradebook and not for the rest; needs root."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", str(disk)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("mounting a small file system needs root")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_on_a_full_disk_it_fails_aloud_and_with_room_it_converges(submitted, undisturbed, small_disk):
    process = start(submitted, small_disk / "grades")
    text = process.communicate(timeout=120)[0]
    assert process.returncode == 3 and "Traceback" not in text, text
    assert "space" in text or "full" in text
    for path in small_disk.glob("grades/verdicts/*/*.json"):
        json.loads(path.read_text())
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    grade(submitted, small_disk / "grades")
    assert results(small_disk / "grades") == results(undisturbed[0])
    assert not leftovers(small_disk / "grades")


def test_absent_students_and_scores_by_hand_are_kept(submitted, undisturbed, tmp_path):
    out = tmp_path / "grades"
    shutil.copytree(undisturbed[0], out)
    before = results(out)
    with Gradebook(f"sqlite:///{out / 'gradebook.db'}") as book:
        for question, points in (("gae_tradeoff", 1.5), ("gae_time_limit", 1.0)):
            book.find_grade(question, "ch44", "ch44", "ann").manual_score = points
        book.db.commit()
    shutil.copytree(submitted / "ann", tmp_path / "later" / "ann")
    grade(tmp_path / "later", out)
    verdicts, grades, questions, _ = results(out)
    assert {name: verdicts[name] for name in ("bob", "eve")} == {name: before[0][name] for name in ("bob", "eve")}
    assert verdicts["ann"]["manual_score"] == 2.5 and verdicts["ann"]["score"] == 10
    assert [row for row in grades.splitlines() if ",ann," not in row] == [
        row for row in before[1].splitlines() if ",ann," not in row
    ]
    assert any(",ann," in row and ",12.5," in row for row in grades.splitlines()) and questions == before[2]
