"""The pages on how to use the book tell the truth: whatever they show a reader typing is typed here, and must give what they show.

The blocks of a page run in their order, in a temporary working folder and a Python namespace of the page's own:

  ```console                     lines that begin with "$ " are given to bash, the lines after them are what it must print (both streams);
                                 "..." stands for anything, and $? is the exit status of the command before;
  ```pycon                       doctest's notation, with the functions of the code blocks before it;
  ```{code-block} python         with a caption is a file: FILE is written; NOTEBOOK, cell NAME replaces the source of that cell;
                                 "from FILE" is a quotation, which must stand in that file of the project, word for word;
  % solve NOTEBOOK, cell NAME    (a comment, which no reader sees) puts the reference there: no page gives away an answer.

Blocks in other languages (```shell) are not run: installing is tested with the bundle, and servers do not end.
"""

from __future__ import annotations

import doctest
import importlib
import inspect
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from autograder import checks
from autograder.authoring import freeze
from autograder.paths import ROOT
from autograder.publishing import release
from autograder.publishing.book import BOOK, HOW_TO
from course_lib.checks import client, packages

BLOCK = re.compile(
    r"^(?P<fence>`{3,})(?P<kind>console|pycon|\{code-block\}[^\n]*)\n(?P<body>.*?)^(?P=fence)$|^% solve (?P<solve>[^\n]*)$",
    re.M | re.S,
)
GENERATED = ("_build", "_stage", "_cache", "frozen", "__pycache__")
SOURCES = (
    "autograder",
    "book",
    "chapters",
    "course_lib",
    "experiments",
    "solutions",
    "tests",
    "pyproject.toml",
    "requirements.txt",
    "constraints.txt",
)


class Page:
    """One page and the folder in which its reader works."""

    def __init__(self, path: Path, folder: Path, environment: dict[str, str]) -> None:
        self.path, self.folder, self.environment = path, folder, environment
        self.text = path.read_text(encoding="utf-8")
        self.namespace: dict = {}
        self.status = 0

    def run(self) -> None:
        for block in BLOCK.finditer(self.text):
            line = self.text.count("\n", 0, block.start()) + 1
            if block["solve"]:
                self.solve(block["solve"])
            elif block["kind"] == "console":
                self.console(block["body"], line)
            elif block["kind"] == "pycon":
                self.pycon(block["body"], line)
            else:
                _, caption, code = re.split(r":caption: (.*)\n+", block["body"], maxsplit=1)
                self.write(caption, code, line)

    def console(self, body: str, line: int) -> None:
        for command, expected in re.findall(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", body, re.M):
            shell = ["bash", "-c", f"(exit {self.status}); {command}"]
            done = subprocess.run(
                shell, cwd=self.folder, env=self.environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
            )
            self.status = done.returncode
            printed = re.sub(r"[ \t]+$", "", done.stdout, flags=re.M)
            agree = doctest.OutputChecker().check_output(expected, printed, doctest.ELLIPSIS)
            assert agree, f"{self.path}:{line}: $ {command}\nprints\n{printed}\nand not\n{expected}"

    def pycon(self, body: str, line: int) -> None:
        session = doctest.DocTestParser().get_doctest(body, self.namespace, self.path.name, str(self.path), line)
        differences: list[str] = []
        runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS, verbose=False)
        runner.run(session, out=differences.append, clear_globs=False)
        assert not differences, "".join(differences)
        self.namespace |= session.globs

    def write(self, caption: str, code: str, line: int) -> None:
        if caption.startswith("from "):
            source = (ROOT / caption.removeprefix("from ")).read_text(encoding="utf-8")
            assert code in source, f"{self.path}:{line}: {caption} no longer has these lines"
        elif ", cell " in caption:
            self.fill(caption, code)
            exec(code, self.namespace)
        else:
            (self.folder / caption).parent.mkdir(parents=True, exist_ok=True)
            (self.folder / caption).write_text(code, encoding="utf-8")

    def solve(self, caption: str) -> None:
        name = caption.rpartition(" ")[2]
        solutions = importlib.import_module(f"solutions.{Path(caption.partition(',')[0]).stem}")
        self.fill(caption, inspect.getsource(getattr(solutions, name)))
        self.namespace[name] = getattr(solutions, name)

    def fill(self, caption: str, code: str) -> None:
        notebook, _, name = caption.partition(", cell ")
        content = nbformat.read(self.folder / notebook, as_version=4)
        [cell] = (cell for cell in content.cells if cell.metadata.get("nbgrader", {}).get("grade_id") == name)
        cell.source = code.rstrip()
        nbformat.write(content, self.folder / notebook)


@pytest.fixture
def reader(tmp_path, monkeypatch):
    """Makes a page of how-to/NAME.md, with `course` on the PATH: the project as it is here, or the working folder's copy of it."""
    programs, folder = tmp_path / "bin", tmp_path / "work"
    programs.mkdir()
    folder.mkdir()
    for name, module in {"course": "autograder", "dask": "dask"}.items():
        (programs / name).write_text(f'#!/bin/sh\nPYTHONPATH="{ROOT}" exec "{sys.executable}" -m {module} "$@"\n')
        (programs / name).chmod(0o755)
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "FORCE_COLOR")}
    path = os.pathsep.join([str(programs), str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = kept | {"PATH": path, "COLUMNS": "90", "LC_ALL": "C.UTF-8", "PYTHONPATH": str(folder / "course_lib")}
    freeze.write(checks.exercises("ch44"), tmp_path / "frozen")
    monkeypatch.setattr(client, "FROZEN", tmp_path / "frozen")
    return lambda name: Page(BOOK / "how-to" / f"{name}.md", folder, environment)


def test_the_learners_page(reader, tmp_path):
    page = reader("learners")
    bundle = release.release(tmp_path / "bundle", ["ch44"])
    shutil.copy(bundle / "course.zip", page.folder)
    page.run()


def test_the_teachers_page(reader, html):  # the built book, since a first release would run the chapter
    reader("teachers").run()


def test_the_platforms_page(reader):
    page = reader("platforms")
    release.release(page.folder / "release", ["ch44"])
    page.run()


def test_the_cluster_page(reader):
    page = reader("cluster")
    release.release(page.folder / "release", ["ch44"])
    shutil.copy(ROOT / "tools" / "cluster" / "slurm.py", page.folder)
    page.run()


def test_the_contributors_page(reader):
    page = reader("contributors")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name,
                page.folder / name,
                ignore=shutil.ignore_patterns(*GENERATED),
            )
        else:
            shutil.copy(ROOT / name, page.folder)
    page.run()


@pytest.mark.parametrize("name", ["learners", "teachers"])
def test_the_packages_that_are_there_when_graded_are_listed(name):
    assert packages.listed() in (BOOK / "how-to" / f"{name}.md").read_text(encoding="utf-8")


def test_there_is_a_test_for_every_page():
    assert {f"test_the_{Path(page).name}_page" for page in HOW_TO} <= set(globals())


def test_a_difference_is_found(tmp_path):
    page = Page(BOOK / "index.md", tmp_path, dict(os.environ))
    page.console("$ echo one; exit 3\no...\n$ echo $?\n3\n", 1)
    with pytest.raises(AssertionError, match=r"prints\s+two"):
        page.console("$ echo two\none\n", 1)
    with pytest.raises(AssertionError, match="Expected"):
        page.pycon(">>> 1 + 1\n3\n", 1)
    with pytest.raises(AssertionError, match="no longer has"):
        page.write("from README.md", "These words are not in it.\n", 1)
