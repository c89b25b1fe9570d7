"""Run a chapter's code once, with the reference solutions in place of the stubs, and keep what it printed and drew.

Contract: `executed_outputs(chapter)` has one list of outputs for each code cell of the chapter, in order; a stub's are those of
its check. Whatever a reader should not meet on a page (a traceback, a warning, a check that does not pass, a widget that needs a
kernel) ends the build with a BookError that names the chapter's file and line. Results are kept under a hash of what they rest on
(autograder.proving.dependencies): neither prose nor code that a page does not reach can change them, so editing it never runs code again.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import os
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import nbformat
import psutil
from jupyter_client.kernelspec import KernelSpec, KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError, CellTimeoutError, DeadKernelError
from nbclient.util import run_sync
from nbformat import NotebookNode
from nbformat.v4 import new_code_cell, new_notebook

from autograder.authoring.assemble import wordless
from autograder.authoring.chapter import Cell, Chapter
from autograder.paths import COURSE_LIB, ROOT, RUNS
from autograder.proving import side_by_side
from autograder.proving.dependencies import PACKAGES, Code

RUN_BY = (
    "autograder.authoring.freeze:write",
    "autograder.authoring.artefacts:hand_in",
    "autograder.publishing.execution:_environment",
)
STATES = 3  # of each chapter are kept, so that an undo or a change of branch runs nothing
CELL_TIMEOUT = 300  # seconds by the clock, after which a cell hangs
PAGE_BUDGET = 30  # seconds of processor time that the cells of a page should need together; what needs more is an experiment


class BookError(RuntimeError):
    """The book cannot be built; the message says where and what to do."""


@dataclass(frozen=True)
class Inputs:
    """What a chapter's outputs depend on beside its own cells: a fingerprint of code, and files."""

    code: str
    files: tuple[Path, ...]


def executed_outputs(chapter: Chapter) -> list[list[NotebookNode]]:
    """The outputs (nbformat 4) of each code cell of the chapter, run now or taken from the cache.

    Raises: BookError if a cell fails, writes to stderr, shows a kernel-bound widget, or a check does not pass.
    """
    kept = cached(chapter)
    if kept.exists():
        os.utime(kept)  # so that the states that are in use are those that are kept
    else:
        keep_cached(kept, nbformat.writes(_execute(chapter)))
    return [cell.outputs for cell in nbformat.read(kept, as_version=4).cells]


def run_all(chapters: Sequence[Chapter], jobs: int | None = None, first: Callable[[], None] | None = None) -> None:
    """Run the chapters whose outputs are not in the cache, side by side, a thread each; those that took longest begin first.
    If there are any, `first` is called before.

    Raises: BookError with everything that failed, after all others have been run.
    """
    waiting = sorted((chapter for chapter in chapters if not cached(chapter).exists()), key=_last_seconds, reverse=True)
    if waiting and first:
        first()
    failures = []
    for done in side_by_side.run(_run, waiting, jobs or os.cpu_count() or 1):
        if isinstance(done.error, BookError):
            failures.append(str(done.error))
        elif done.error is not None:
            failures.append(f"{done.item.assignment}: {type(done.error).__name__}: {done.error}")
    if failures:
        raise BookError("\n".join(failures))


def _run(chapter: Chapter) -> None:
    executed_outputs(chapter)


def _last_seconds(chapter: Chapter) -> float:
    """The processor time of a chapter when it was last run; one that never was might take long."""
    kept = sorted(cache_folder().glob(f"{chapter.assignment}-*.ipynb"), key=lambda path: path.stat().st_mtime)
    return json.loads(kept[-1].read_text(encoding="utf-8"))["metadata"].get("cpu_seconds", 0.0) if kept else float("inf")


def cached(chapter: Chapter) -> Path:
    """Where the chapter's outputs are kept, once it has run."""
    return cache_folder() / f"{chapter.assignment}-{execution_key(chapter)}.ipynb"


def execution_key(chapter: Chapter) -> str:
    """A hash of all that can change a chapter's outputs: its code, what that reaches, its records, the pins."""
    inputs = code_inputs(chapter)
    return content_hash([*(_source(chapter, cell) for cell in _code_cells(chapter)), inputs.code], inputs.files)


def code_inputs(chapter: Chapter) -> Inputs:
    """What a chapter's outputs depend on outside of it: the code that its cells and its frozen checks reach, the data files
    that this code names, the records of its experiments, the pins."""
    own = f"autograder.checks.{chapter.assignment}"
    cells = [_source(chapter, cell) for cell in _code_cells(chapter)]
    fingerprint, data = _reached(chapter.assignment, [*RUN_BY, own], cells)
    text = "\n".join(cells)
    named = {name for name in _names(RUNS) if name in chapter.experiments or re.search(rf"[\"'/]{re.escape(name)}[\"'/]", text)}
    places = [RUNS / name for name in named]
    recorded = [path for place in places for path in (place.glob("[!.]*") if place.is_dir() else [place])]
    return Inputs(fingerprint, (*data, *recorded, ROOT / "requirements.txt", ROOT / "constraints.txt"))


def _reached(assignment: str, definitions: list[str], cells: list[str]) -> tuple[str, list[Path]]:
    """The fingerprint of the code that a chapter reaches, and the data files that it names.

    To follow the code takes some tenths of a second, so the answer is kept as long as no line of code has changed anywhere.
    """
    data = {path.relative_to(ROOT).as_posix(): path for folder in (COURSE_LIB, ROOT / "solutions") for path in _data(folder)}
    code = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    states = tuple((path, path.stat().st_mtime_ns, path.stat().st_size) for path in sorted(code))
    question = content_hash([*definitions, *cells, *sorted(data), _hash_of(states)], ())
    answers = cache_folder() / f"{assignment}-reached.json"
    known = json.loads(answers.read_text(encoding="utf-8")) if answers.exists() else {}
    if known.get("question") != question:
        reached = Code(ROOT).reach(definitions, cells)
        named = [name for name, path in data.items() if reached.mentions(Path(*Path(name).parts[1:]))]
        known = {"question": question, "fingerprint": reached.fingerprint, "data": named}
        unfinished = answers.with_suffix(f".{os.getpid()}-unfinished")
        unfinished.write_text(json.dumps(known), encoding="utf-8")
        unfinished.replace(answers)
    return known["fingerprint"], [data[name] for name in known["data"]]


@functools.lru_cache(maxsize=4)
def _hash_of(states: tuple[tuple[Path, int, int], ...]) -> str:
    """A hash of files as they are now, by path, time and size: once for all chapters of a build."""
    return content_hash((), (path for path, _, _ in states))


def _names(folder: Path) -> list[str]:
    return [path.name for path in folder.glob("[!.]*")]


def _data(folder: Path) -> list[Path]:
    """The files below a folder that are not code, generated ones left out."""
    generated = {"frozen", "runs", "__pycache__"}
    files = (path for path in folder.rglob("*") if path.is_file() and path.suffix != ".py")
    return [path for path in files if not generated & set(path.relative_to(folder).parts)]


def content_hash(texts: Iterable[str], files: Iterable[Path]) -> str:
    """A short hash of texts, in order, and of files by relative name and content."""
    digest = hashlib.sha256(sys.version.encode())
    for text in texts:
        digest.update(hashlib.sha256(text.encode()).digest())
    for path in sorted(set(files)):
        digest.update(os.path.relpath(path, ROOT).encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """book/_cache, made if need be."""
    folder = ROOT / "book" / "_cache"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def keep_cached(path: Path, text: str) -> None:
    """Keep a result under `NAME-HASH.SUFFIX`, all of it or nothing, beside the last of those with another hash."""
    unfinished = path.with_suffix(f".{os.getpid()}-unfinished")
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(path)
    states = path.parent.glob(f"{path.name.rpartition('-')[0]}-*{path.suffix}")
    for stale in sorted(states, key=lambda state: state.stat().st_mtime_ns, reverse=True)[STATES:]:
        stale.unlink(missing_ok=True)


def _code_cells(chapter: Chapter) -> list[Cell]:
    return [cell for cell in chapter.cells if cell.kind == "code"]


def _source(chapter: Chapter, cell: Cell) -> str:
    """What is run for a cell: a stub becomes its reference, followed by its check."""
    if cell.exercise is None:
        return cell.source
    return f"from solutions.{chapter.assignment} import {cell.exercise}\n\ncheck({cell.exercise})"


def _execute(chapter: Chapter) -> NotebookNode:
    from autograder import checks
    from autograder.authoring import (
        artefacts,  # they load torch, which a build from the cache can do without
        freeze,
    )

    exercises = checks.exercises(chapter.assignment)
    freeze.write(exercises, COURSE_LIB / "frozen")
    cells = _code_cells(chapter)
    notebook = new_notebook(cells=[new_code_cell(_source(chapter, cell), metadata={"tags": sorted(cell.tags)}) for cell in cells])
    _say(f"{chapter.assignment}: running {len(cells)} code cells")
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="course-book-") as folder:
        artefacts.hand_in(exercises, Path(folder))
        sockets = str(Path(folder) / "kernel.json")  # a short path, as addresses of local sockets must be
        kernels = AsyncKernelManager(kernel_spec_manager=_ThisPython(), transport="ipc", connection_file=sockets)
        place = {"metadata": {"path": folder}}
        client = NotebookClient(notebook, km=kernels, timeout=CELL_TIMEOUT, resources=place, store_widget_state=False)
        try:
            with client.setup_kernel(env=_environment(folder)):
                kernel = psutil.Process(kernels.provisioner.pid)  # type: ignore[union-attr]  # of this chapter alone: others run beside it
                spent = [0.0]
                for index, cell in enumerate(cells):
                    _run_cell(client, index, chapter, cell)
                    spent.append(_processor_seconds(kernel))
        finally:
            run_sync(kernels.shutdown_kernel)(now=True)  # nbclient leaves a manager that it was given running
    notebook.metadata["cpu_seconds"] = round(spent[-1], 1)
    each = [after - before for before, after in itertools.pairwise(spent)]
    _say(f"{chapter.assignment}: ran in {time.monotonic() - started:.0f} s, {_cost(chapter, each)}")
    return notebook


def _say(line: str) -> None:
    """A line and its end in one write: chapters that run side by side share the output, and `print` may write the end apart."""
    print(f"{line}\n", end="", flush=True)


def _processor_seconds(process: psutil.Process) -> float:
    """What a process and those of its children that have ended have used so far."""
    times = process.cpu_times()
    return times.user + times.system + times.children_user + times.children_system


def _cost(chapter: Chapter, seconds: Sequence[float]) -> str:
    """What the cells took together, and if that is above the budget, where the longest of them are."""
    told = f"{sum(seconds):.0f} s of processor time"
    if sum(seconds) <= PAGE_BUDGET:
        return told
    longest = sorted(zip(seconds, _code_cells(chapter), strict=True), key=lambda pair: -pair[0])[:3]
    places = "; ".join(f"{took:.0f} s at {os.path.relpath(chapter.path, ROOT)}:{cell.line}" for took, cell in longest)
    return f"{told}: above a page's budget of {PAGE_BUDGET}, see CONTRIBUTING.md, Long runs. The longest cells: {places}"


def _run_cell(client: NotebookClient, index: int, chapter: Chapter, cell: Cell) -> None:
    try:
        outputs = client.execute_cell(client.nb.cells[index], index).outputs
    except (CellExecutionError, CellTimeoutError, DeadKernelError) as error:
        reason = f"{getattr(error, 'ename', '')}: {getattr(error, 'evalue', '')}".strip(": ") or type(error).__name__
        raise _failure(chapter, cell, reason, str(error)) from error
    for output in outputs:
        if output.output_type == "stream" and output.name == "stderr":
            raise _failure(chapter, cell, "a cell of the book must not write to stderr", output.text)
        if "application/vnd.jupyter.widget-view+json" in output.get("data", {}):
            raise _failure(chapter, cell, "a page has no kernel for ipywidgets: show plain HTML instead", str(output.data))
    if complaint := wordless(cell, outputs):
        raise _failure(chapter, cell, complaint, str(outputs))
    if cell.exercise and "passed" not in str(outputs).lower():
        raise _failure(chapter, cell, "the reference does not pass its check", str(outputs))


def _failure(chapter: Chapter, cell: Cell, reason: str, details: str) -> BookError:
    """The error for a cell, with the details kept in a report file."""
    place = f"{os.path.relpath(chapter.path, ROOT)}:{cell.line}"
    name = f"exercise {cell.exercise}" if cell.exercise else f"cell `{cell.source.strip().partition(chr(10))[0]}`"
    report = ROOT / "book" / "_build" / "reports" / f"{chapter.assignment}.txt"
    report.parent.mkdir(parents=True, exist_ok=True)
    report.write_text(f"{place}\n\n{_source(chapter, cell)}\n\n{details}\n", encoding="utf-8")
    return BookError(f"{place}: {name}: {reason} (the whole report: {os.path.relpath(report, ROOT)})")


def _environment(folder: str) -> dict[str, str]:
    """The kernel's environment: this project importable, one thread, nobody's IPython or Matplotlib settings."""
    from course_lib.chapters import REFERENCES  # loads torch

    inherited = {name: value for name, value in os.environ.items() if name not in {"MPLBACKEND", "PYTHONSTARTUP"}}
    return inherited | {
        "COURSE_BOOK": "1",
        REFERENCES: "solutions",
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": str(ROOT),
        "PYTHONHASHSEED": "0",
        "IPYTHONDIR": str(Path(folder) / ".ipython"),
        "PYDEVD_DISABLE_FILE_VALIDATION": "1",
    }


class _ThisPython(KernelSpecManager):
    """Offers the running interpreter as the only kernel: a user's own kernel called python3 would miss the pinned packages."""

    def get_kernel_spec(self, kernel_name: str) -> KernelSpec:
        command = [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"]
        return KernelSpec(argv=command, display_name="Python 3", language="python")
