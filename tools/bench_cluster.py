"""How much sooner two Dask workers are done than one, on this machine: submissions that compute, and submissions that wait.

    python tools/bench_cluster.py [--submissions 30] [--wait 1.5]

Right answers to chapter 44, first as they are, then with a cell that sleeps. Where they compute, two cores bound the gain: scheduler,
client and the writing of verdicts have their share of these, so that one worker does not leave a whole core idle. Where they wait, what
is measured is whether the scheduler keeps both workers busy. One round first, to warm up; both ways must give the same grades.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import nbformat
import psutil
from distributed import Client
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from autograder import grade
from tests.attacks import toolbox
from tests.faults.test_cluster import Cluster


def hand_in(folder: Path, count: int, wait: float) -> None:
    """The same right answers from `count` students, with a cell that sleeps if there is something to wait for."""
    notebook = toolbox.solved()
    if wait:
        notebook.cells.insert(2, nbformat.v4.new_code_cell(f"import time\ntime.sleep({wait})"))
    for number in range(count):
        (folder / f"s{number:03}" / "ch44").mkdir(parents=True)
        toolbox.write(folder / f"s{number:03}" / "ch44", notebook)


def timed(submitted: Path, out: Path, address: str) -> tuple[float, float, dict[str, float]]:
    """Seconds by the clock, the share of the machine that was busy, and student → score."""
    psutil.cpu_percent()
    begun = time.monotonic()
    grade.grade(submitted, out, scheduler=address)
    took, busy = time.monotonic() - begun, psutil.cpu_percent() / 100
    return took, busy, {path.parent.name: json.loads(path.read_text())["score"] for path in out.glob("verdicts/*/*.json")}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--submissions", type=int, default=30)
    parser.add_argument("--wait", type=float, default=1.5, help="seconds that a submission of the second kind sleeps")
    given = parser.parse_args()
    table = Table("submissions that", "two workers", "busy", "one", "busy", "times as fast")
    with tempfile.TemporaryDirectory() as folder:
        for kind, wait in (("compute", 0.0), ("wait", given.wait)):
            place, cluster = Path(folder) / kind, Cluster()
            hand_in(place / "submitted", given.submissions, wait)
            try:
                with Client(cluster.address) as client:
                    client.wait_for_workers(2, timeout=120)
                timed(place / "submitted", place / "warm", cluster.address)
                two = timed(place / "submitted", place / "two", cluster.address)
                cluster.workers[1].kill()
                cluster.workers[1].wait()
                one = timed(place / "submitted", place / "one", cluster.address)
            finally:
                cluster.stop()
            if one[2] != two[2] or len(one[2]) != given.submissions:
                raise SystemExit("one worker and two do not give the same grades")
            table.add_row(kind, f"{two[0]:.1f} s", f"{two[1]:.0%}", f"{one[0]:.1f} s", f"{one[1]:.0%}", f"{one[0] / two[0]:.2f}")
    Console(width=100).print(table)
    print(f"{given.submissions} submissions each, {os.cpu_count()} cores")


if __name__ == "__main__":
    main()
