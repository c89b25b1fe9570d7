"""Run a chapter's code once, with the reference solutions in place of the stubs, and keep what it printed and drew.

Contract: `executed_outputs(chapter)` has one list of outputs for each code cell of the chapter, in order; a stub's are those of
its check. Whatever a reader should not meet on a page (a traceback, a warning, a check that does not pass, a widget that needs a
kernel) ends the build with a BookError that names the chapter's file and line. Results are kept under a hash of
everything that can change them; prose cannot, so editing it never runs code again.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

import nbformat
from jupyter_client.kernelspec import KernelSpec, KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError, CellTimeoutError, DeadKernelError
from nbclient.util import run_sync
from nbformat import NotebookNode
from nbformat.v4 import new_code_cell, new_notebook

from autograder.authoring.chapter import Cell, Chapter
from autograder.paths import COURSE_LIB, ROOT, RUNS
from course_lib.chapters import REFERENCES

CELL_TIMEOUT = 300  # seconds; a page's cells together should need at most 60


class BookError(RuntimeError):
    """The book cannot be built; the message says where and what to do."""


def executed_outputs(chapter: Chapter) -> list[list[NotebookNode]]:
    """The outputs (nbformat 4) of each code cell of the chapter, run now or taken from the cache.

    Raises: BookError if a cell fails, writes to stderr, shows a kernel-bound widget, or a check does not pass.
    """
    cached = cache_folder() / f"{chapter.assignment}-{execution_key(chapter)}.ipynb"
    if not cached.exists():
        replace_cached(cached, nbformat.writes(_execute(chapter)))
    return [cell.outputs for cell in nbformat.read(cached, as_version=4).cells]


def execution_key(chapter: Chapter) -> str:
    """A hash of all that can change a chapter's outputs: its code, the library, the references, its checks, its records, the pins."""
    return content_hash([_source(chapter, cell) for cell in _code_cells(chapter)], code_inputs(chapter))


def code_inputs(chapter: Chapter) -> list[Path]:
    """The files outside the chapter that its outputs depend on."""
    library = [
        path for path in COURSE_LIB.rglob("*") if path.is_file() and not {"frozen", "runs", "__pycache__"} & set(path.parts)
    ]
    checks = [ROOT / "autograder" / name for name in ("spec.py", "freeze.py", f"checks/{chapter.assignment}.py")]
    recorded = [path for name in chapter.experiments for path in (RUNS / name).glob("[!.]*")]
    answers = [path for suffix in ("py", "safetensors") for path in (ROOT / "solutions").glob(f"*.{suffix}")]
    return [*library, *recorded, *answers, *checks, ROOT / "requirements.txt", ROOT / "constraints.txt"]


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


def replace_cached(path: Path, text: str) -> None:
    """Keep a result under `NAME-HASH.SUFFIX`, all of it or nothing, in place of those with another hash."""
    for stale in path.parent.glob(f"{path.name.rpartition('-')[0]}-*{path.suffix}"):
        stale.unlink()
    unfinished = path.with_suffix(f".{os.getpid()}-unfinished")
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(path)


def _code_cells(chapter: Chapter) -> list[Cell]:
    return [cell for cell in chapter.cells if cell.kind == "code"]


def _source(chapter: Chapter, cell: Cell) -> str:
    """What is run for a cell: a stub becomes its reference, followed by its check."""
    if cell.exercise is None:
        return cell.source
    return f"from solutions.{chapter.assignment} import {cell.exercise}\n\ncheck({cell.exercise})"


def _execute(chapter: Chapter) -> NotebookNode:
    from autograder import checks
    from autograder.authoring import artefacts, freeze  # they load torch, which a build from the cache can do without

    exercises = checks.exercises(chapter.assignment)
    freeze.write(exercises, COURSE_LIB / "frozen")
    cells = _code_cells(chapter)
    notebook = new_notebook(cells=[new_code_cell(_source(chapter, cell), metadata={"tags": sorted(cell.tags)}) for cell in cells])
    print(f"{chapter.assignment}: running {len(cells)} code cells", flush=True)
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="course-book-") as folder:
        artefacts.hand_in(exercises, Path(folder))
        sockets = str(Path(folder) / "kernel.json")  # a short path, as addresses of local sockets must be
        kernels = AsyncKernelManager(kernel_spec_manager=_ThisPython(), transport="ipc", connection_file=sockets)
        place = {"metadata": {"path": folder}}
        client = NotebookClient(notebook, km=kernels, timeout=CELL_TIMEOUT, resources=place, store_widget_state=False)
        try:
            with client.setup_kernel(env=_environment(folder)):
                for index, cell in enumerate(cells):
                    _run_cell(client, index, chapter, cell)
        finally:
            run_sync(kernels.shutdown_kernel)(now=True)  # nbclient leaves a manager that it was given running
    print(f"{chapter.assignment}: ran in {time.monotonic() - started:.0f} s", flush=True)
    return notebook


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
