"""A lock that waits says for whom."""

import subprocess
import sys

from autograder.proving.locks import one_at_a_time

HOLD = """
import sys
from pathlib import Path
from autograder.proving.locks import one_at_a_time
with one_at_a_time(Path(sys.argv[1])):
    print("mine", flush=True)
    sys.stdin.readline()
"""


def test_whoever_waits_reads_for_whom(tmp_path):
    path = tmp_path / "build.lock"
    first = subprocess.Popen([sys.executable, "-c", HOLD, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert first.stdout.readline() == "mine\n"
    second = subprocess.Popen(
        [sys.executable, "-c", HOLD, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    told = second.stderr.readline()
    assert told.startswith(f"waiting for build: process {first.pid} has it since ") and "build.lock`" in told
    first.communicate("done\n")
    assert second.stdout.readline() == "mine\n"
    second.communicate("done\n")


def test_whoever_need_not_wait_reads_nothing(tmp_path, capsys):
    for _ in range(2):
        with one_at_a_time(tmp_path / "new" / "build.lock"):
            pass
    assert capsys.readouterr() == ("", "")
