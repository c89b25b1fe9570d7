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

from tests.faults.runs import grade, leftovers, refused, results, start, verdicts

AS_ROOT = () if os.geteuid() == 0 else ("sudo", "-n")


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
    """Makes a folder a file system of its own, with so much room; needs root, or a sudo that asks for no password."""
    mounted = []

    def mount(folder, size):
        folder.mkdir(parents=True)
        words = ["mount", "-t", "tmpfs", "-o", f"size={size},uid={os.geteuid()}", "tmpfs", str(folder)]
        if shutil.which([*AS_ROOT, *words][0]) is None or subprocess.run([*AS_ROOT, *words], capture_output=True).returncode:
            give_up = pytest.fail if os.environ.get("CI") else pytest.skip
            give_up("a small file system cannot be mounted: that needs root, or a sudo that asks for no password")
        mounted.append(folder)
        return folder

    yield mount
    for folder in mounted:
        subprocess.run([*AS_ROOT, "umount", "-l", str(folder)], check=True)


def enlarge(disk):
    subprocess.run([*AS_ROOT, "mount", "-o", "remount,size=64m", str(disk)], check=True)


def test_on_a_full_disk_it_fails_aloud_and_with_room_it_converges(submitted, undisturbed, small_disk, tmp_path):
    disk = small_disk(tmp_path / "disk", "600k")  # for the gradebook, and not for the rest
    line = refused(submitted, disk / "grades")
    assert "space" in line or "full" in line
    verdicts(disk / "grades")
    enlarge(disk)
    grade(submitted, disk / "grades")
    assert results(disk / "grades") == results(undisturbed[0])
    assert not leftovers(disk / "grades")


def test_without_room_for_verdicts_those_that_are_written_are_kept(submitted, undisturbed, small_disk, tmp_path):
    disk = small_disk(tmp_path / "grades" / "verdicts", "8k")
    assert "No space left on device" in refused(submitted, tmp_path / "grades")
    kept = verdicts(tmp_path / "grades")
    assert 0 < len(kept) < 3 and kept.items() <= verdicts(undisturbed[0]).items()
    enlarge(disk)
    grade(submitted, tmp_path / "grades")
    assert results(tmp_path / "grades") == results(undisturbed[0])
    assert not leftovers(tmp_path / "grades")


@pytest.mark.parametrize("size", ["64k", "300k"])
def test_without_room_for_the_gradebook_earlier_verdicts_are_kept(submitted, undisturbed, small_disk, tmp_path, size):
    out, disk = tmp_path / "grades", small_disk(tmp_path / "disk", size)
    shutil.copytree(undisturbed[0], out)
    line = refused(submitted, out, "--db-url", f"sqlite:///{disk}/gradebook.db")
    assert "full" in line or "disk I/O error" in line
    assert verdicts(out) == verdicts(undisturbed[0])
    enlarge(disk)
    grade(submitted, out, "--db-url", f"sqlite:///{disk}/gradebook.db")
    assert results(out) == results(undisturbed[0])


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
    found, grades, questions, _ = results(out)
    assert {name: found[name] for name in ("bob", "eve")} == {name: before[0][name] for name in ("bob", "eve")}
    assert found["ann"]["manual_score"] == 2.5 and found["ann"]["score"] == 10
    assert [row for row in grades.splitlines() if ",ann," not in row] == [
        row for row in before[1].splitlines() if ",ann," not in row
    ]
    assert any(",ann," in row and ",12.5," in row for row in grades.splitlines()) and questions == before[2]
