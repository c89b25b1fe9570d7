"""What learners get: notebooks, the library with its frozen checks, a read-me, a zip of it all. And nbgrader's course folder.

Nothing here holds a solution, a hidden check or the source of any check. The same sources give the same bytes. Every file is
written whole or not at all, and a notebook that is not as some release wrote it belongs to a learner and is never overwritten.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import tempfile
import tomllib
import zipfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import nbformat

from autograder import paths
from autograder.authoring import assemble, freeze
from autograder.authoring import chapter as chapters_
from autograder.authoring.chapter import ANSWER_LINE, Chapter
from autograder.authoring.contract import STUB, Sources
from autograder.authoring.contract import sources as real_sources
from course_lib.checks import packages

LEARNERS_NEED = {  # the oldest versions that will do: a learner's Jupyter, or Colab, brings its own
    "torch": "2.6",
    "numpy": "2.0",
    "matplotlib": "3.10",
    "ipywidgets": "7.7.1",
    "gymnasium": "1.2",
    "safetensors": "0.5",
    "pyarrow": "18",
    "threadpoolctl": "3.5",
    "tqdm": "4.67",
    "transformers": "4.57",
    "vaderSentiment": "3.3.2",
}
# of chapters that fly; Box2D has no wheel for Python 3.14, and none for Linux on ARM
FLIGHT_NEEDS = {"Box2D": "2.3.10", "pygame-ce": "2.5"}
RECORDED = {".parquet", ".mp4", ".webp"}  # not policies: one could be handed in
MANIFEST = ".release.json"

Recorded = Callable[[Chapter], assemble.Outputs | None]


def release(
    out: Path,
    only: Iterable[str] | None = None,
    *,
    recorded: Recorded = lambda chapter: None,
    directory: Path | None = None,
    sources: Callable[[Chapter], Sources] = real_sources,
    say: Callable[[str], None] = print,
) -> Path:
    """Write the bundle of the chapters in `only` (assignment ids; all by default) to the folder `out`, and return that folder.

    `recorded` gives a chapter's outputs in the book, which the notebooks show where only the book can run a cell. A notebook
    in `out` that no release wrote is left alone: the new one goes beside it, and `say` is told. `course.zip` always has
    the fresh notebooks.

    Raises: ValueError for an unknown chapter; ChapterError for a chapter that breaks its contract.
    """
    chosen = _chosen(only, directory)
    notebooks = {_name(c): _bytes(assemble.for_learners(c, recorded(c), sources(c))) for c in chosen}
    support = {"README.md": _readme(chosen).encode(), **_library(chosen, sources)}
    before = _manifest(out)
    ours = before["notebooks"]
    for name, content in notebooks.items():
        ours[name] = sorted({*ours.get(name, ()), _hash(content)})
    # before the notebooks themselves: a release that is interrupted must not take its own file for a learner's later
    _write(out / MANIFEST, json.dumps({"notebooks": ours, "library": sorted(support)}, indent=1).encode())
    for name, content in notebooks.items():
        place = _place(out / name, ours[name])
        if place != out / name:
            say(f"{out / name} has somebody's work in it and was left as it is; the new notebook is {place}")
        _write(place, content)
    for name in before["library"]:
        kept = "/frozen/" in name or "/runs/" in name  # checks and records of chapters released earlier are still needed
        if name not in support and not kept:
            (out / name).unlink(missing_ok=True)
    for name, content in support.items():
        _write(out / name, content)
    _write(out / "course.zip", _zipped({**notebooks, **support}))
    return out


def write_nbgrader_course(
    directory: Path,
    *,
    recorded: Recorded = lambda chapter: None,
    chapters: Path | None = None,
    sources: Callable[[Chapter], Sources] = real_sources,
) -> Path:
    """Lay out an nbgrader course: `source/ch44/ch44.ipynb` for every chapter, and the configuration that makes its releases ours.

    nbgrader's own commands work there. It holds the solutions, and its hidden tests need this project installed.
    """
    for chapter in chapters_.all_chapters(chapters):
        notebook = assemble.for_nbgrader(chapter, recorded(chapter), sources(chapter))
        _write(directory / "source" / _name(chapter), _bytes(notebook))
    _write(directory / "nbgrader_config.py", _NBGRADER_CONFIG.encode())
    return directory


def _chosen(only: Iterable[str] | None, directory: Path | None) -> list[Chapter]:
    if only is None:
        return chapters_.all_chapters(directory)
    return [chapters_.load(name, directory) for name in dict.fromkeys(only)]


def _library(chosen: list[Chapter], sources: Callable[[Chapter], Sources]) -> dict[str, bytes]:
    """An installable copy of course_lib, with the frozen checks and the records of long runs of the chosen chapters."""
    files = {"course_lib/pyproject.toml": _pyproject().encode()}
    for path in sorted(paths.COURSE_LIB.rglob("*")):
        inside = path.relative_to(paths.COURSE_LIB)
        if path.is_file() and inside.parts[0] not in ("frozen", "runs") and "__pycache__" not in inside.parts:
            files[f"course_lib/course_lib/{inside.as_posix()}"] = path.read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        for chapter in chosen:
            freeze.write(sources(chapter).exercises, Path(folder))
            outline = assemble.outline(chapter, sources(chapter))
            if outline.exercises or outline.open_questions:
                freeze.write_cells(outline.id, outline.exercises, outline.open_questions, Path(folder))
        for path in sorted(Path(folder).iterdir()):
            files[f"course_lib/course_lib/frozen/{path.name}"] = path.read_bytes()
    for name in sorted({name for chapter in chosen for name in chapter.experiments}):
        recorded = sorted(path for path in (paths.RUNS / name).glob("[!.]*") if path.suffix in RECORDED)
        if not recorded:
            raise ValueError(
                f"there are no records of the experiment {name!r} in {paths.RUNS}: `course experiment {name}` makes them"
            )
        files |= {f"course_lib/course_lib/runs/{name}/{path.name}": path.read_bytes() for path in recorded}
    return files


def _pyproject() -> str:
    """The library's own project file."""
    project = tomllib.loads((paths.ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed, for_flight = (
        json.dumps([f"{name}>={version}" for name, version in needs.items()]) for needs in (LEARNERS_NEED, FLIGHT_NEEDS)
    )
    python = project["requires-python"].split(",")[0]
    return _PYPROJECT.format(version=project["version"], python=python, dependencies=needed, flight=for_flight)


def _place(path: Path, ours: Iterable[str]) -> Path:
    """`path`, or the first of ch44.new.ipynb, ch44.new2.ipynb, … that is free or holds nothing but a release of ours."""
    candidate, number = path, 1
    while candidate.exists() and _hash(candidate.read_bytes()) not in ours:
        candidate = path.with_name(f"{path.stem}.new{'' if number == 1 else number}{path.suffix}")
        number += 1
    return candidate


def _manifest(out: Path) -> dict[str, Any]:
    """What releases to `out` wrote: the hashes of all versions of every notebook, and the other files of the last one."""
    path = out / MANIFEST
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"notebooks": {}, "library": []}


def _write(path: Path, content: bytes) -> None:
    """Write a file whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".writing-")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def _zipped(files: Mapping[str, bytes]) -> bytes:
    """A zip archive that depends on names and contents only."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(files):
            entry = zipfile.ZipInfo(name)
            entry.external_attr = 0o644 << 16
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, files[name])
    return buffer.getvalue()


def _name(chapter: Chapter) -> str:
    return f"{chapter.assignment}/{chapter.assignment}.ipynb"


def _bytes(notebook: nbformat.NotebookNode) -> bytes:
    return (nbformat.writes(notebook) + "\n").encode()


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _readme(chosen: list[Chapter]) -> str:
    rows = "\n".join(f"- `{_name(c)}`: {c.title} ({c.minutes} minutes). {c.summary}" for c in chosen)
    return _README.format(rows=rows, packages=packages.listed(), example=_name(chosen[0]) if chosen else "ch44/ch44.ipynb")


_README = """\
# Notebooks of the course

{rows}

## Begin

In this folder, with Python 3.11 or newer:

    python -m venv .venv
    . .venv/bin/activate            # on Windows: .venv\\Scripts\\activate
    pip install "./course_lib[flight]" jupyterlab
    jupyter lab {example}

`[flight]` brings Box2D, in which chapters 45 and 74 fly. Box2D has no wheel for Python 3.14, and none for Linux on ARM: leave `[flight]`
out there, and every other chapter works. PyTorch no longer builds for Macs with an Intel processor: there, Colab is the way.

In Google Colab: upload `course.zip`, open the notebook, and run this in a first cell:

    !unzip -oq course.zip && pip install -q "./course_lib[flight]"

## Work

Each exercise is a function that raises `NotImplementedError`. Replace that line, run the cell, and run the check below it: it
says what is wrong. You may add cells, imports and functions anywhere. The cells with the checks are locked; the grader uses its
own anyway, on inputs that you have not seen. Where it runs there are Python's standard library, {packages}; no GPU, no network, and
nobody to answer `input()`. Another package that you import is not there, and what uses it fails.

To check a whole notebook at a shell: `python -m course_lib.check {example}`. Hand in the notebook under the name that it has.
"""

_PYPROJECT = """\
[build-system]
requires = ["setuptools>=70"]
build-backend = "setuptools.build_meta"

[project]
name = "course_lib"
version = "{version}"
description = "What the notebooks of the policy optimisation course import"
requires-python = "{python}"
dependencies = {dependencies}

[project.optional-dependencies]
flight = {flight}

[tool.setuptools.packages.find]
include = ["course_lib*"]

[tool.setuptools.package-data]
"*" = ["**/*"]
"""

_NBGRADER_CONFIG = f"""\
# Written by `course`: with these stubs, nbgrader's releases are the notebooks of the course's own bundle.
c = get_config()  # noqa: F821
c.CourseDirectory.course_id = "policy-optimisation"
c.ClearSolutions.code_stub = {{"python": "{STUB}"}}
c.ClearSolutions.text_stub = "{ANSWER_LINE}"
"""
