"""One function on many things, in processes or on a cluster: results and errors, each with its item."""

import os

import pytest

from autograder.proving import side_by_side


def halved(number):
    if number % 2:
        raise ValueError(f"{number} is odd")
    return number // 2, os.getpid(), os.environ.get("OMP_NUM_THREADS")


def test_alone_it_runs_here_and_an_error_costs_its_own_item_only():
    done = list(side_by_side.run(halved, [4, 3, 2], jobs=1))
    assert [one.item for one in done] == [4, 3, 2]
    assert [one.result and one.result[:2] for one in done] == [(2, os.getpid()), None, (1, os.getpid())]
    assert str(done[1].error) == "3 is odd"


def test_side_by_side_it_runs_in_other_processes_with_one_thread(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    done = {one.item: one for one in side_by_side.run(halved, [4, 3, 2], jobs=2)}
    assert str(done[3].error) == "3 is odd"
    assert [done[item].result[0] for item in (4, 2)] == [2, 1]
    assert all(done[item].result[1] != os.getpid() and done[item].result[2] == "1" for item in (4, 2))


@pytest.fixture(scope="module")
def cluster():
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as running:
        yield running


def test_on_a_cluster_it_gives_the_same(cluster):
    done = {one.item: one for one in side_by_side.run(halved, [4, 3], scheduler=cluster.scheduler_address)}
    assert done[4].result[0] == 2 and str(done[3].error) == "3 is odd"
