"""The records of long runs: one run is one small Parquet file, `NAME/VARIANT-SEED.parquet`, with how it was made in its metadata.

`load("lander")` reads all runs of an experiment, wherever this library lies: from `experiments/runs` in a checkout of the course, or
from the records that a release put beside the library. `write` is what `course experiment` uses. A run may have other
files (policies, videos) beside its record: `NAME/VARIANT-SEED.SUFFIX`.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

RELEASED = Path(__file__).parents[1] / "runs"
CHECKOUT = Path(__file__).parents[2] / "experiments" / "runs"
KEY = b"course_run"  # of the provenance in the file's metadata


class RecordsError(LookupError):
    """Records are missing or damaged; the message says which, and the command that makes them."""


@dataclass(frozen=True)
class Run:
    """One run: `columns` are what it logged, name -> (rows,), NaN where a row had no such value; `provenance` is how it was made.

    Provenance: experiment, variant, seed, configuration, summary (final results), versions, commit, command, wall_seconds,
    cpu_seconds, machine (cores, memory_gb, cpu), date.
    """

    variant: str
    seed: int
    columns: dict[str, np.ndarray]
    provenance: dict
    path: Path


def load(experiment: str, folder: str | Path | None = None) -> Records:
    """The records of an experiment.

    Args:
      experiment: its name, such as "lander".
      folder: the folder that holds NAME/VARIANT-SEED.parquet; found by itself if not given.

    Raises: RecordsError if there are none, or if a file is damaged.
    """
    places = [Path(folder)] if folder else [RELEASED, CHECKOUT]
    for place in places:
        files = sorted((place / experiment).glob("*.parquet"))
        if files:
            return Records(experiment, [read(path) for path in files])
    raise RecordsError(
        f"there are no records of the experiment {experiment!r} in {' or '.join(str(place) for place in places)}."
        f" `course experiment {experiment}` makes them, in a checkout of the whole course"
    )


def read(path: str | Path) -> Run:
    """Read one run. Raises: RecordsError if the file is missing, damaged or no record."""
    import pyarrow  # half a second that a notebook without records need not pay
    import pyarrow.parquet

    path = Path(path)
    variant, _, seed = path.stem.rpartition("-")
    remedy = f"delete it and make it again: `course experiment {path.parent.name} --variant {variant}`"
    try:
        table = pyarrow.parquet.read_table(path)
        provenance = json.loads((table.schema.metadata or {})[KEY])
        columns = {name: _values(table[name]) for name in table.column_names}
        run = Run(provenance["variant"], provenance["seed"], columns, provenance, path)
    except FileNotFoundError:
        raise RecordsError(f"{path} is missing; `course experiment {path.parent.name}` makes it") from None
    except (OSError, ValueError, KeyError, TypeError, pyarrow.ArrowException) as error:
        raise RecordsError(f"{path} is damaged ({type(error).__name__}: {error}); {remedy}") from None
    if (run.variant, str(run.seed)) != (variant, seed):
        raise RecordsError(f"{path} holds the run {run.variant}-{run.seed}: a file was renamed; {remedy}")
    return run


def write(path: str | Path, rows: Sequence[Mapping[str, float | int | str | None]], provenance: Mapping) -> None:
    """Write one run, all of it or nothing.

    Args:
      path: NAME/VARIANT-SEED.parquet.
      rows: what the run logged; a value that a row lacks becomes NaN.
      provenance: see Run; goes through JSON.

    Raises: ValueError if there are no rows.
    """
    import pyarrow
    import pyarrow.parquet

    if not rows:
        raise ValueError("a record needs at least one row, got none: the run must return what it logged")
    names = dict.fromkeys(name for row in rows for name in row)
    table = pyarrow.table({name: [row.get(name) for row in rows] for name in names})
    table = table.replace_schema_metadata({KEY: json.dumps(provenance, ensure_ascii=False)})
    with whole(path) as unfinished:
        options = {"compression": "zstd", "write_statistics": False, "use_dictionary": False}
        pyarrow.parquet.write_table(table, unfinished, **options)


class whole:
    """`with whole(path) as unfinished:` what is written to `unfinished` becomes `path` at the end, or nothing does."""

    def __init__(self, path: str | Path):
        self.path = Path(path)

    def __enter__(self) -> Path:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=self.path.parent, prefix=".writing-", suffix=self.path.suffix)
        os.close(handle)
        self.unfinished = Path(name)
        return self.unfinished

    def __exit__(self, kind, error, traceback) -> None:
        if kind is not None:
            self.unfinished.unlink(missing_ok=True)
            return
        with self.unfinished.open("rb") as file:
            os.fsync(file.fileno())
        self.unfinished.chmod(0o644)
        self.unfinished.replace(self.path)


class Records:
    """All runs of an experiment, by variant and seed."""

    def __init__(self, experiment: str, runs: Iterable[Run]):
        self.experiment = experiment
        self.runs = sorted(runs, key=lambda run: (run.variant, run.seed))
        self.variants = tuple(dict.fromkeys(run.variant for run in self.runs))

    def of(self, variant: str) -> list[Run]:
        """The runs of a variant, by seed. Raises: RecordsError if there are none."""
        chosen = [run for run in self.runs if run.variant == variant]
        if not chosen:
            raise RecordsError(
                f"there are no records of the variant {variant!r}, only of {', '.join(self.variants)}."
                f" `{self.command(variant)}` makes them, in a checkout of the whole course"
            )
        return chosen

    def seeds(self, variant: str) -> list[int]:
        """The seeds of a variant's runs, in the order of all that this object returns."""
        return [run.seed for run in self.of(variant)]

    def configuration(self, variant: str) -> dict:
        """The configuration of a variant, as its runs were made."""
        return self.of(variant)[0].provenance["configuration"]

    def curve(self, variant: str, column: str, x: str = "env_steps", points: int = 200) -> tuple[np.ndarray, np.ndarray]:
        """What a variant logged, over its seeds: x (points,) and scores (seeds, points).

        See `curves`, of which this is the case of one variant.
        """
        grid, scores = self.curves(column, {variant: variant}, x, points)
        return grid, scores[variant]

    def curves(
        self, column: str, labels: Mapping[str, str], x: str = "env_steps", points: int = 200
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """What several variants logged, at common positions: for `plotting.curves`.

        Where all runs logged at the same x, the values are as logged. Otherwise they are interpolated linearly on an even grid over
        the range that all runs share, with as many positions as the longest run has rows. Rows without a value are left out.

        Args:
          column: what was logged.
          labels: variant -> its label.
          x: the column of positions.
          points: at most so many positions.

        Returns: x (points,), and label -> scores (seeds, points).
        Raises: RecordsError if a variant or a column is missing, or if the runs share no range.
        """
        pairs = {variant: [_pair(run, x, column) for run in self.of(variant)] for variant in labels}
        everything = [position for runs in pairs.values() for position, _ in runs]
        grid = everything[0]
        if len(grid) > points or not all(np.array_equal(grid, other) for other in everything):
            low, high = max(one[0] for one in everything), min(one[-1] for one in everything)
            if low > high:
                raise RecordsError(f"the runs of {', '.join(labels)} share no range of {x!r}: no curve can be drawn over it")
            grid = np.linspace(low, high, min(points, max(map(len, everything))))
        return grid, {
            labels[variant]: np.stack([np.interp(grid, positions, values) for positions, values in runs])
            for variant, runs in pairs.items()
        }

    def final(self, variant: str, column: str) -> np.ndarray:
        """The last value that each seed logged in a column: (seeds,)."""
        return np.array([_logged(run, column)[1][-1] for run in self.of(variant)])

    def summary(self, variant: str, name: str) -> np.ndarray:
        """A final result of each seed, a number or a list of numbers: (seeds, …). Raises: RecordsError if a run has none."""
        for run in self.of(variant):
            if name not in run.provenance["summary"]:
                known = ", ".join(run.provenance["summary"]) or "nothing"
                raise RecordsError(f"{run.path} has no final result {name!r}, only {known}; {self._again(variant)}")
        return np.array([run.provenance["summary"][name] for run in self.of(variant)])

    def artefact(self, variant: str, seed: int, suffix: str) -> Path:
        """The file `VARIANT-SEED.SUFFIX` beside a record, such as a policy. Raises: RecordsError if it is missing."""
        path = self.runs[0].path.with_name(f"{variant}-{seed}.{suffix}")
        if not path.is_file():
            raise RecordsError(f"{path} is missing. {self._again(variant)}")
        return path

    def command(self, *variants: str) -> str:
        """The command that makes the records of these variants again, or of all."""
        return " ".join([f"course experiment {self.experiment}", *(f"--variant {variant}" for variant in variants)])

    def cost(self, *variants: str) -> str:
        """How long the runs of these variants (of all, by default) took, and on what: part of a sentence, in three lines.

        Such as "20 runs of 2 to 4 minutes each, 1.1 hours in all by the clock and 16 minutes of processor time, on a machine with 2
        cores (AMD EPYC) and 24 GB of memory": the clock of a machine that did other work beside them runs fast.
        """
        runs = [run for run in self.runs if not variants or run.variant in variants]
        wall, cpu = (np.array([run.provenance[f"{kind}_seconds"] for run in runs]) for kind in ("wall", "cpu"))
        shortest, longest = duration(wall.min()), duration(wall.max())
        each = longest if shortest == longest else f"{shortest} to {longest}"
        machines = dict.fromkeys(machine(run.provenance["machine"]) for run in runs)
        what = f"{len(runs)} runs of {each} each, {duration(wall.sum())} in all" if len(runs) > 1 else f"one run of {each}"
        return f"{what} by the clock\nand {duration(cpu.sum())} of processor time,\non {' and '.join(machines)}"

    def _again(self, variant: str) -> str:
        return f"`{self.command(variant)}` makes it again, once its record is deleted"


def machine(described: Mapping) -> str:
    """A machine class in words: "a machine with 2 cores (AMD EPYC) and 24 GB of memory"."""
    cores = described["cores"]
    return f"a machine with {cores} core{'s' * (cores > 1)} ({described['cpu']}) and {described['memory_gb']} GB of memory"


def duration(seconds: float) -> str:
    """A time in words: 35 seconds, 4 minutes, 2.5 hours."""
    for size, name in ((3600, "hour"), (60, "minute")):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.2g} {name}s" if seconds < 10 * size else f"{seconds / size:.0f} {name}s"
    return f"{seconds:.0f} seconds"


def _values(column) -> np.ndarray:
    """A Parquet column as an array: numbers, with NaN for nulls, or text."""
    import pyarrow.types

    if pyarrow.types.is_integer(column.type) and not column.null_count:
        return column.to_numpy()
    if pyarrow.types.is_string(column.type):
        return np.array(column.to_pylist(), dtype=object)
    return np.array([np.nan if value is None else value for value in column.to_pylist()], dtype=float)


def _logged(run: Run, column: str) -> tuple[np.ndarray, np.ndarray]:
    """Which rows of a run have a value in a column, and the values."""
    if column not in run.columns:
        raise RecordsError(f"{run.path} has no column {column!r}, only {', '.join(run.columns)}")
    values = run.columns[column]
    rows = np.flatnonzero(~np.isnan(values))
    if not len(rows):
        raise RecordsError(f"{run.path} has no value at all in the column {column!r}")
    return rows, values[rows]


def _pair(run: Run, x: str, column: str) -> tuple[np.ndarray, np.ndarray]:
    rows, values = _logged(run, column)
    _logged(run, x)
    return run.columns[x][rows].astype(float), values
