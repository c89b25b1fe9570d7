"""Chapters that run side by side give what they give one after the other. In a copy of the project with two chapters of a cell each."""

import os
import shutil
import subprocess
import sys

import nbformat
import pytest

from autograder.paths import ROOT

CHAPTER = """---
chapter: {number}
title: T
minutes: 1
prerequisites: []
builds: b
summary: s
---

# Words

```{{code-cell}} ipython3
---
tags: [live]
---
import os

import torch

from course_lib.seeding import seed_everything

seed_everything({number})
print(torch.rand(2), torch.get_num_threads(), os.environ["COURSE_BOOK"])
```

```{{code-cell}} ipython3
---
tags: [live]
---
print({then})
```
"""
RUN = """
import sys
sys.modules["rfc3987_syntax"] = None  # as in autograder.cli
from autograder.authoring import chapter
from autograder.publishing import execution

if __name__ == "__main__":
    try:
        execution.run_all(chapter.all_chapters(), jobs=int(sys.argv[1]))
    except execution.BookError as error:
        print(error)
"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """What was printed and kept, with one and with two jobs."""
    folder = tmp_path_factory.mktemp("project")
    large = shutil.ignore_patterns("__pycache__", "frozen", "runs", "models", "data", "ch[0-9]*.py", "*.safetensors", "records")
    for package in ("autograder", "course_lib", "solutions"):
        shutil.copytree(ROOT / package, folder / package, ignore=large)
    for name in ("requirements.txt", "constraints.txt"):
        shutil.copyfile(ROOT / name, folder / name)
    (folder / "chapters").mkdir()
    for number, then in ((91, "1"), (92, "1 / 0"), (93, "3"), (94, "missing")):
        (folder / "chapters" / f"ch{number}_t.md").write_text(CHAPTER.format(number=number, then=then))
        (folder / "autograder" / "checks" / f"ch{number}.py").write_text("EXERCISES = ()\n")
        (folder / "solutions" / f"ch{number}.py").write_text("")
    (folder / "run.py").write_text(RUN)
    found = []
    for jobs in (1, 2):
        command = [sys.executable, "run.py", str(jobs)]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "2"})
        cache = folder / "book" / "_cache"
        assert cache.is_dir(), done.stdout + done.stderr
        kept = {path.name.partition("-")[0]: nbformat.read(path, as_version=4) for path in cache.glob("*.ipynb")}
        found.append((done.stdout, done.stderr, {name: [cell.outputs for cell in book.cells] for name, book in kept.items()}))
        shutil.rmtree(cache)
    return found


def test_the_outputs_are_those_of_a_serial_run(runs):
    (_, _, serial), (_, _, parallel) = runs
    assert set(serial) == {"ch91", "ch93"} and "1 1\n" in serial["ch91"][0][0].text
    assert serial == parallel


def test_errors_of_one_chapter_hide_neither_anothers_outputs_nor_its_errors(runs):
    for printed, _, _ in runs:
        assert "ch92_t.md:" in printed and "ZeroDivisionError" in printed
        assert "ch94_t.md:" in printed and "NameError" in printed


def test_each_says_when_it_begins_and_ends_and_what_it_took(runs):
    for printed, errors, _ in runs:
        assert errors == ""
        for name in ("ch91", "ch93"):
            assert f"{name}: running 2 code cells\n" in printed and f"{name}: ran in " in printed
        assert printed.count(" s of processor time\n") == 2
