"""Runs of the real command on a class of three, and what they must agree on."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.attacks import toolbox

ROOT = Path(__file__).parents[2]
CLASS = {"ann": 10.0, "bob": 8.0, "eve": 0.0}


def command(submitted, out, *words):
    common = ["grade", str(submitted), "--out", str(out), "--jobs", "2", "--timeout", "20"]
    return [sys.executable, "-m", "autograder", *common, *words]


def start(submitted, out, *words, **options):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(command(submitted, out, *words), cwd=ROOT, env=environment, **pipes, **options)


def grade(submitted, out, *words):
    process = start(submitted, out, *words)
    text = process.communicate(timeout=120)[0]
    assert process.returncode == 0, text


def refused(submitted, out, *words):
    """The one line that a run says which cannot write the grades."""
    process = start(submitted, out, *words)
    text = process.communicate(timeout=120)[0]
    assert process.returncode == 3, text
    [line] = text.splitlines()
    assert line.startswith("course: the grades cannot be written: ") and line.endswith("mend this and grade again."), line
    return line


def verdicts(out):
    """All verdicts without their seconds; whatever is there is whole."""
    found = {}
    for path in sorted(out.glob("verdicts/*/*.json")):
        found[path.parent.name] = {name: value for name, value in json.loads(path.read_text()).items() if name != "seconds"}
    return found


def results(out):
    """What runs must agree on: all verdicts, and the tables that hold no seconds."""
    return verdicts(out), *((out / name).read_text() for name in ("grades.csv", "questions.csv", "canvas.csv"))


def leftovers(out):
    return [path for path in out.rglob("*") if path.name.endswith(".tmp")]


def submit(folder, student):
    target = folder / student / "ch44"
    target.mkdir(parents=True)
    notebook = toolbox.solved()
    if student == "bob":
        toolbox.wrong(notebook)
    if student == "eve":
        (target / "ch44.ipynb").write_text("no notebook")
    else:
        toolbox.write(target, notebook)
