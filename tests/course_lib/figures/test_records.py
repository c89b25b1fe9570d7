"""Run records: what is written is read, runs of different lengths are put on one grid, and errors name the command that helps."""

import math

import numpy as np
import pytest

from course_lib.figures import records
from course_lib.figures.records import RecordsError

MACHINE = {"cores": 2, "memory_gb": 24, "cpu": "AMD EPYC"}


def provenance(variant="a", seed=0, **others):
    return {
        "experiment": "toy", "variant": variant, "seed": seed, "configuration": {"lr": 0.1}, "summary": {}, "wall_seconds": 300.0,
        "cpu_seconds": 60.0,         "machine": MACHINE, **others,
    }  # fmt: skip


def put(folder, variant, seed, rows, **others):
    path = folder / "toy" / f"{variant}-{seed}.parquet"
    records.write(path, rows, provenance(variant, seed, **others))
    return path


def line(slope, steps):
    return [{"env_steps": step, "score": float(slope * step)} for step in steps]


def test_what_is_written_is_read(tmp_path):
    rows = [
        {"env_steps": 1, "score": 0.1, "kind": "x"},
        {"env_steps": 2, "score": None, "kind": "y"},
        {"env_steps": 3, "kind": "z"},
    ]
    run = records.read(put(tmp_path, "a", 4, rows, summary={"returns": [1.0, 2.5]}))
    assert (run.variant, run.seed, run.provenance["summary"]) == ("a", 4, {"returns": [1.0, 2.5]})
    assert run.columns["env_steps"].tolist() == [1, 2, 3] and run.columns["env_steps"].dtype.kind == "i"
    np.testing.assert_array_equal(run.columns["score"], [0.1, math.nan, math.nan])
    assert run.columns["kind"].tolist() == ["x", "y", "z"]


def test_a_record_is_small(tmp_path):
    rows = [{"env_steps": 2048 * i, **{f"metric{j}": math.sin(i * j) for j in range(8)}} for i in range(200)]
    assert put(tmp_path, "a", 0, rows).stat().st_size < 20_000


def test_a_record_needs_a_row(tmp_path):
    with pytest.raises(ValueError, match="at least one row"):
        put(tmp_path, "a", 0, [])
    assert not list(tmp_path.rglob("*.parquet"))


def test_runs_that_logged_at_the_same_steps_come_as_logged(tmp_path):
    for seed in range(3):
        put(tmp_path, "a", seed, line(seed, [0, 5, 6]))
    loaded = records.load("toy", tmp_path)
    x, scores = loaded.curve("a", "score")
    assert x.tolist() == [0, 5, 6] and scores.tolist() == [[0, 0, 0], [0, 5, 6], [0, 10, 12]]
    assert loaded.final("a", "score").tolist() == [0, 6, 12] and loaded.seeds("a") == [0, 1, 2]


def test_runs_that_logged_elsewhere_are_interpolated_on_what_they_share(tmp_path):
    put(tmp_path, "a", 0, line(1, [0, 10, 20, 30]))
    put(tmp_path, "a", 1, line(2, [5, 15, 25]))
    put(tmp_path, "b", 0, [{"env_steps": 5}, *line(3, [10, 35])])  # no score in the first row
    x, curves = records.load("toy", tmp_path).curves("score", {"a": "first", "b": "second"})
    assert x.tolist() == [10, 15, 20, 25] and list(curves) == ["first", "second"]
    np.testing.assert_allclose(curves["first"], [x, 2 * x])
    np.testing.assert_allclose(curves["second"], [3 * x])


def test_long_curves_are_thinned(tmp_path):
    put(tmp_path, "a", 0, line(1, range(1000)))
    x, scores = records.load("toy", tmp_path).curve("a", "score", points=50)
    assert len(x) == 50 and scores.shape == (1, 50) and x[-1] == 999


def test_final_results_come_by_seed_with_the_configuration_and_the_command(tmp_path):
    for seed in (0, 1):
        put(tmp_path, "a", seed, line(1, [1]), summary={"returns": [seed, 2.0]})
    loaded = records.load("toy", tmp_path)
    assert loaded.summary("a", "returns").tolist() == [[0, 2], [1, 2]]
    assert loaded.configuration("a") == {"lr": 0.1}
    assert loaded.command() == "course experiment toy" and loaded.command("a") == "course experiment toy --variant a"
    with pytest.raises(RecordsError, match=r"no final result 'kl', only returns; `course experiment toy --variant a`"):
        loaded.summary("a", "kl")


def test_the_cost_is_a_part_of_a_sentence(tmp_path):
    put(tmp_path, "a", 0, line(1, [1]), wall_seconds=240.0)
    put(tmp_path, "b", 0, line(1, [1]), wall_seconds=7200.0)
    on = "on a machine with 2 cores (AMD EPYC) and 24 GB of memory"
    loaded = records.load("toy", tmp_path)
    assert loaded.cost() == (
        f"2 runs of 4 minutes to 2 hours each, 2.1 hours in all by the clock\nand 2 minutes of processor time,\n{on}"
    )
    assert loaded.cost("a") == f"one run of 4 minutes by the clock\nand 60 seconds of processor time,\n{on}"


def test_missing_records_name_the_command_that_makes_them(tmp_path):
    with pytest.raises(RecordsError, match=r"no records of the experiment 'toy' in .* `course experiment toy` makes them"):
        records.load("toy", tmp_path)
    put(tmp_path, "a", 0, line(1, [1]))
    loaded = records.load("toy", tmp_path)
    with pytest.raises(RecordsError, match=r"variant 'b', only of a. `course experiment toy --variant b`"):
        loaded.curve("b", "score")
    with pytest.raises(RecordsError, match="no column 'kl', only env_steps, score"):
        loaded.curve("a", "kl")
    with pytest.raises(RecordsError, match=r"a-0.safetensors is missing. `course experiment toy --variant a`"):
        loaded.artefact("a", 0, "safetensors")


def test_an_artefact_is_found_beside_its_record(tmp_path):
    path = put(tmp_path, "a", 0, line(1, [1])).with_name("a-0.middle.safetensors")
    path.write_bytes(b"weights")
    assert records.load("toy", tmp_path).artefact("a", 0, "middle.safetensors") == path


@pytest.mark.parametrize("damage", [b"", b"PAR1 no parquet", None])
def test_a_damaged_file_is_named_with_the_remedy(tmp_path, damage):
    path = put(tmp_path, "a", 0, line(1, range(100)))
    path.write_bytes(path.read_bytes()[:-20] if damage is None else damage)
    with pytest.raises(RecordsError, match=r"a-0.parquet is damaged .* delete it .* `course experiment toy --variant a`"):
        records.load("toy", tmp_path)


def test_a_foreign_parquet_file_and_a_renamed_record_are_refused(tmp_path):
    import pyarrow
    import pyarrow.parquet

    path = put(tmp_path, "a", 0, line(1, [1]))
    path.rename(path.with_name("b-0.parquet"))
    with pytest.raises(RecordsError, match="holds the run a-0: a file was renamed"):
        records.load("toy", tmp_path)
    pyarrow.parquet.write_table(pyarrow.table({"env_steps": [1]}), path.with_name("b-0.parquet"))
    with pytest.raises(RecordsError, match="damaged"):
        records.load("toy", tmp_path)


def test_a_file_is_whole_or_not_there(tmp_path):
    path = tmp_path / "kept.txt"
    path.write_text("before")
    with pytest.raises(RuntimeError), records.whole(path) as unfinished:
        unfinished.write_text("half")
        raise RuntimeError
    assert path.read_text() == "before" and list(tmp_path.iterdir()) == [path]
