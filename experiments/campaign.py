"""The engine of long runs: makes every record that an experiment lacks, side by side, and loses nothing when it is killed.

An experiment is a module `experiments/NAME.py`. The first line of its docstring says what it measures, and it defines

    VARIANTS: dict[str, dict]        the configuration of every variant, plain values that go through JSON
    SEEDS: int | dict[str, int]      how many seeds by default, for all variants or for each
    run(variant, seed, checkpoint_dir, report) -> list of rows, or a Result

`report(done, total)` moves the run's progress bar. A run that keeps a checkpoint in `checkpoint_dir` finds it there when it is started
again. A record is finished when it can be read and its configuration is the one that the module has now; only others are made.
The imports of the project point one way: course_lib ← solutions ← experiments ← autograder (whose command line calls this).
"""

from __future__ import annotations

import fcntl
import importlib.util
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from multiprocessing import get_context
from pathlib import Path
from threading import Thread
from types import ModuleType
from typing import Any
from uuid import uuid4

import psutil

from course_lib.figures import records
from experiments import pool

FOLDER = Path(__file__).parent
RUNS = FOLDER / "runs"
NOT_EXPERIMENTS = {"__init__", "campaign", "checkpoint", "pool", "snapshots"}
PACKAGES = ("torch", "numpy", "gymnasium", "Box2D", "mujoco", "transformers")  # what decides results, where installed
LOCK, CLOCK = ".lock", ".seconds"

Report = Callable[[int, int], None]
Progress = Callable[[str, int, int, int], None]  # variant, seed, done, total


class ExperimentError(ValueError):
    """The experiment can't be run as asked; the message says what to do."""


@dataclass(frozen=True)
class Result:
    """What a run returns: rows as logged, final results, and files beside the record, suffix -> content.

    Args:
      rows: one dictionary for each logging step, with "env_steps" (or another abscissa) in all.
      summary: name -> a number or a list of numbers, for what is known at the end only, such as 100 returns.
      artefacts: such as {"safetensors": policy}, written to VARIANT-SEED.safetensors.
    """

    rows: list[dict[str, Any]]
    summary: dict[str, Any] = field(default_factory=dict)
    artefacts: dict[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True)
class Task:
    """One run to make: plain values only, as it travels to other processes and machines."""

    file: str
    variant: str
    seed: int
    out: str
    command: str

    @property
    def record(self) -> Path:
        return Path(self.out) / Path(self.file).stem / f"{self.variant}-{self.seed}.parquet"

    @property
    def checkpoints(self) -> Path:
        return Path(self.out) / ".checkpoints" / Path(self.file).stem / f"{self.variant}-{self.seed}"


@dataclass(frozen=True)
class Outcome:
    """How a task ended: "made", "kept" (it was finished), "busy" (another process is at it) or "failed", with the traceback."""

    variant: str
    seed: int
    state: str
    error: str = ""


def names(folder: Path | None = None) -> list[str]:
    """The experiments there are."""
    return sorted(path.stem for path in (folder or FOLDER).glob("*.py") if path.stem not in NOT_EXPERIMENTS)


def definition(name: str, folder: Path | None = None) -> ModuleType:
    """The module of an experiment. Raises: ExperimentError if there is none of this name, or if it lacks a part."""
    known = names(folder)
    if name not in known:
        raise ExperimentError(f"no experiment {name!r}; there are: {', '.join(known) or 'none'}")
    return _module((folder or FOLDER) / f"{name}.py")


def tasks(module: ModuleType, variants: Iterable[str] = (), seeds: int | None = None, out: Path = RUNS) -> list[Task]:
    """The runs of an experiment: of all variants and the default number of seeds, unless chosen otherwise.

    Raises: ExperimentError for an unknown variant or fewer than one seed.
    """
    name = module.__name__.rpartition(".")[2]
    chosen = list(dict.fromkeys(variants)) or list(module.VARIANTS)
    for variant in chosen:
        if variant not in module.VARIANTS:
            raise ExperimentError(f"{name} has no variant {variant!r}; it has: {', '.join(module.VARIANTS)}")
    if seeds is not None and seeds < 1:
        raise ExperimentError(f"seeds must be at least 1, got {seeds}")
    return [
        Task(str(module.__file__), variant, seed, str(Path(out).resolve()), f"course experiment {name} --variant {variant}")
        for variant in chosen
        for seed in range(seeds or (module.SEEDS if isinstance(module.SEEDS, int) else module.SEEDS[variant]))
    ]


def state(task: Task) -> str:
    """Of a task's record: "finished", "missing", "damaged", or "outdated" where the configuration is another one now."""
    if not task.record.exists():
        return "missing"
    try:
        run = records.read(task.record)
    except records.RecordsError:
        return "damaged"
    now = json.loads(json.dumps(_module(Path(task.file)).VARIANTS[task.variant]))
    return "finished" if run.provenance["configuration"] == now else "outdated"


def make(
    todo: list[Task], jobs: int = 1, scheduler: str | None = None, progress: Progress = lambda variant, seed, done, total: None
) -> Iterator[Outcome]:
    """Make all records that are not finished, and tell how each task ended, in the order of ending.

    Args:
      todo: from `tasks`.
      jobs: runs at a time, each in a process of its own with one thread.
      scheduler: address of a Dask scheduler whose workers share this file system; replaces `jobs`.
      progress: called as runs go on, from another thread.
    """
    waiting = []
    for task in todo:
        if state(task) == "finished":
            yield Outcome(task.variant, task.seed, "kept")
        else:
            waiting.append(task)
    if waiting:
        yield from (_on_dask(waiting, scheduler, progress) if scheduler else _here(waiting, jobs, progress))


def make_one(task: Task, progress: Progress) -> Outcome:
    """Make one record, in this process; whatever fails is told in the outcome, so that the other runs go on."""
    import torch

    torch.set_num_threads(1)  # right for small networks, and runs share the machine
    task.checkpoints.mkdir(parents=True, exist_ok=True)
    with _lock(task.checkpoints / LOCK) as ours:
        if not ours:
            return Outcome(task.variant, task.seed, "busy")
        try:
            if state(task) == "finished":  # another process was faster
                return Outcome(task.variant, task.seed, "kept")
            _make(task, progress)
        except Exception:
            return Outcome(task.variant, task.seed, "failed", traceback.format_exc())
        shutil.rmtree(task.checkpoints)
    return Outcome(task.variant, task.seed, "made")


def _make(task: Task, progress: Progress) -> None:
    module = _module(Path(task.file))
    clock, code = _Clock(task.checkpoints), commit()

    def report(done: int, total: int) -> None:
        clock.tick()
        progress(task.variant, task.seed, done, total)

    returned = module.run(task.variant, task.seed, task.checkpoints, report)
    result = returned if isinstance(returned, Result) else Result(returned)
    for suffix, content in result.artefacts.items():
        with records.whole(task.record.with_name(f"{task.variant}-{task.seed}.{suffix}")) as unfinished:
            unfinished.write_bytes(content)
    wall, cpu = clock.seconds()
    provenance = {
        "experiment": task.record.parent.name,
        "variant": task.variant,
        "seed": task.seed,
        "configuration": module.VARIANTS[task.variant],
        "summary": result.summary,
        "versions": versions(),
        "commit": code,
        "command": task.command,
        "wall_seconds": round(wall, 1),
        "cpu_seconds": round(cpu, 1),
        "machine": machine(),
        "date": datetime.now(UTC).date().isoformat(),
    }
    records.write(task.record, result.rows, provenance)  # last, as it says that the run is finished


class _Clock:
    """Time that a run took: if it goes on from a checkpoint, with that of the processes that were killed."""

    def __init__(self, folder: Path):
        self.file = folder / CLOCK
        resumes = any(path.name not in (LOCK, CLOCK) for path in folder.iterdir())
        before = json.loads(self.file.read_text()) if resumes and self.file.exists() else (0.0, 0.0)
        self.start = time.monotonic() - before[0], time.process_time() - before[1]
        self.written = time.monotonic()

    def seconds(self) -> tuple[float, float]:
        """Wall time and processor time."""
        return time.monotonic() - self.start[0], time.process_time() - self.start[1]

    def tick(self) -> None:
        if time.monotonic() - self.written > 2:
            with records.whole(self.file) as unfinished:
                unfinished.write_text(json.dumps(self.seconds()))
            self.written = time.monotonic()


def machine() -> dict[str, Any]:
    """The machine class: cores that may be used, memory in GB, and the kind of processor; nothing that names the machine."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"cores": cores, "memory_gb": round(psutil.virtual_memory().total / 1e9), "cpu": _processor()}


def _processor() -> str:
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return found[1].strip() if found else platform.processor() or platform.machine()


def versions() -> dict[str, str]:
    """Of Python and the packages that decide results."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def commit() -> str | None:
    """The commit of this checkout, with "+" where files have changed since; None away from git."""

    def git(*arguments: str) -> str:
        return subprocess.run(["git", "-C", str(FOLDER), *arguments], capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no", "--", "..", ":(exclude)runs")
        return git("rev-parse", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def _module(file: Path) -> ModuleType:
    """Load an experiment from its file, once: by the same route here, in a pool's processes and on other machines."""
    name = f"experiments.{file.stem}"
    loaded = sys.modules.get(name)
    if loaded is not None and loaded.__file__ == str(file):
        return loaded
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    _validate(module, file)
    return module


def _validate(module: ModuleType, file: Path) -> None:
    for part, kind in (("VARIANTS", Mapping), ("SEEDS", (int, Mapping)), ("run", Callable)):
        if not isinstance(getattr(module, part, None), kind):  # type: ignore[arg-type]
            raise ExperimentError(f"{file} must define {part}: see experiments/campaign.py for the parts of an experiment")
    for variant in module.VARIANTS:
        if not re.fullmatch(r"[A-Za-z0-9_.]+", variant):
            raise ExperimentError(f"{file}: a variant's name has letters, digits, '_' and '.', got {variant!r}")


@contextmanager
def _lock(path: Path) -> Iterator[bool]:
    """Whether this process has the file to itself; the kernel gives it back when a process is killed."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True
    finally:
        os.close(descriptor)


def _throttled(send: Callable[[tuple], None], seconds: float = 0.5) -> Progress:
    """Progress that travels: now and then, and always the last."""
    last = 0.0

    def progress(variant: str, seed: int, done: int, total: int) -> None:
        nonlocal last
        if time.monotonic() - last > seconds or done >= total:
            send((variant, seed, done, total))
            last = time.monotonic()

    return progress


_queue: Any = None


def _begin(queue: Any) -> None:
    """In a new process of the pool, before torch is loaded."""
    global _queue
    _queue = queue
    pool.begin()  # after a kill, the next `course experiment` takes over at once


def _in_pool(task: Task) -> Outcome:
    return make_one(task, _throttled(_queue.put))


def _here(waiting: list[Task], jobs: int, progress: Progress) -> Iterator[Outcome]:
    context = get_context("spawn")  # a forked child would share torch's and Box2D's state
    queue = context.Queue()

    def listen() -> None:
        while (message := queue.get()) is not None:
            progress(*message)

    listener = Thread(target=listen, daemon=True)
    listener.start()
    executor = ProcessPoolExecutor(min(jobs, len(waiting)), context, _begin, (queue,))
    futures = {executor.submit(_in_pool, task): task for task in waiting}
    try:
        for future in as_completed(futures):
            yield _outcome(futures[future], future)
    finally:
        executor.shutdown(cancel_futures=True)
        queue.put(None)
        listener.join()


def _on_worker(task: Task, topic: str) -> Outcome:
    from distributed import get_worker

    return make_one(task, _throttled(lambda message: get_worker().log_event(topic, message)))


def _on_dask(waiting: list[Task], scheduler: str, progress: Progress) -> Iterator[Outcome]:
    """On the workers of a Dask scheduler, which must see the same files."""
    from distributed import Client
    from distributed import as_completed as as_they_end

    topic = f"course-{uuid4().hex}"
    with Client(scheduler, timeout="30s") as client:
        client.subscribe_topic(topic, lambda event: progress(*event[1]))
        futures = {client.submit(_on_worker, task, topic, pure=False, retries=1): task for task in waiting}
        for future in as_they_end(futures):
            yield _outcome(futures[future], future)
        client.unsubscribe_topic(topic)


def _outcome(task: Task, future: Any) -> Outcome:
    error = future.exception()
    if error is None:
        return future.result()
    lost = f"its process ended ({type(error).__name__}: {error}), most often for want of memory; run again with fewer jobs"
    return Outcome(task.variant, task.seed, "failed", lost)
