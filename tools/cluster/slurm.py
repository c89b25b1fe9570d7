#!/usr/bin/env python
"""Grade on SLURM: workers are jobs, the scheduler lives as long as this program, and `course grade` is told where it is.

    pip install dask-jobqueue==0.9.0
    python slurm.py --show                                  the job that each worker would be
    python slurm.py --workers 8 submitted --out grades      all that follows the options goes to `course grade`

Run it on a login node that jobs can reach, in a folder that they see, with the project's environment active. The exit status is that of
`course grade`; run again, it goes on with what is missing.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from dask_jobqueue import SLURMCluster

QUEUE_SECONDS = 24 * 3600  # the first job may wait so long in SLURM's queue


def cluster(asked: argparse.Namespace) -> SLURMCluster:
    """What is different at your site stands here, or in ~/.config/dask/jobqueue.yaml."""
    return SLURMCluster(
        queue=asked.partition,
        account=asked.account,
        interface=asked.interface,  # such as ib0, if the nodes have several
        cores=asked.cores,  # so many submissions are judged at a time
        processes=1,
        memory=f"{2 * asked.cores}GiB",  # the sandbox holds a submission to 2 GiB
        walltime="02:00:00",
        # A worker hands back what it has and leaves before SLURM would kill it; the next job takes over.
        worker_extra_args=["--lifetime", "110m", "--lifetime-stagger", "5m", "--preload", "autograder.grade"],
        job_script_prologue=["export OMP_NUM_THREADS=1"],
        python=sys.executable,  # of the same environment, on a file system that the nodes share
        log_directory="slurm-logs",
        scheduler_options={"dashboard_address": ":0"},  # others use the login node, too
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=2, help="jobs (2)")
    parser.add_argument("--cores", type=int, default=4, help="of each job (4)")
    parser.add_argument("--partition")
    parser.add_argument("--account")
    parser.add_argument("--interface", help="the network that nodes share, such as ib0")
    parser.add_argument("--show", action="store_true", help="print the job's script and do nothing")
    asked, words = parser.parse_known_args()
    with cluster(asked) as workers:
        if asked.show:
            print(workers.job_script())
            return 0
        Path("slurm-logs").mkdir(exist_ok=True)
        workers.adapt(minimum_jobs=asked.workers, maximum_jobs=asked.workers)  # a job that ends is replaced
        workers.wait_for_workers(1, timeout=QUEUE_SECONDS)
        command = [sys.executable, "-m", "autograder", "grade", *words, "--scheduler", workers.scheduler_address]
        return subprocess.run(command).returncode


if __name__ == "__main__":
    sys.exit(main())
