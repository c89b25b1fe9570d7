"""A page judges the text of a cell: with no package but its own, in the notebook's words."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys

import pytest

from autograder.authoring import chapter, freeze
from autograder.authoring.spec import Exercise
from autograder.checks import exercises
from autograder.proving import practice
from course_lib import validate
from course_lib.checks.results import examined

OFFERED = ["importance_ratio", "clipped_surrogate_loss"]
PROGRAM = """
import json, sys
sys.path[:] = [sys.argv[1], *(path for path in sys.path if "site-packages" not in path)]
task = json.load(sys.stdin)
import judge
offered = judge.open_page(task["page"])
told = [judge.check(*call) for call in task["calls"]]
modules = sorted({str(getattr(module, "__file__", None) or "").rpartition("/")[0] for module in list(sys.modules.values())})
json.dump({"offered": offered, "told": told, "modules": modules}, sys.stdout)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with what a page gets, and nothing else."""
    folder = tmp_path_factory.mktemp("page")
    for name, path in practice.files().items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, folder / name)
    return folder


@pytest.fixture(scope="module")
def told(folder):
    """Checks cells on the page of chapter 43: told((name, source), …) -> their results, and the folders of all modules that were used."""
    page = practice.page_of(chapter.load("ch43"), OFFERED)

    def told(*calls):
        command = [sys.executable, "-S", "-I", "-c", PROGRAM, str(folder)]
        done = subprocess.run(
            command, input=json.dumps({"page": page, "calls": calls}), capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, done.stderr
        result = json.loads(done.stdout)
        assert result["offered"] == OFFERED
        return result["told"], result["modules"]

    return told


RATIO = (
    "def importance_ratio(new_log_probs, old_log_probs):\n"
    "    validate.same_shape(new_log_probs=new_log_probs, old_log_probs=old_log_probs)\n"
)
EINSUM = "torch.einsum is not in the page's torch; it is in the notebook"


def test_a_page_says_what_the_notebook_says(told, folder):
    answers = practice.answers(chapter.load("ch43"))
    wrong = RATIO + "    return new_log_probs - old_log_probs\n"
    (right, mistaken), modules = told(("importance_ratio", answers["importance_ratio"]), ("importance_ratio", wrong))
    assert (right["state"], right["message"], right["ticks"][0][0]) == ("correct", "", "✓")
    frozen = freeze.visible(
        next(one for one in exercises("ch43") if isinstance(one, Exercise) and one.name == "importance_ratio")
    )
    namespace = {"validate": validate}
    exec(wrong, namespace)
    expected = examined(frozen, namespace["importance_ratio"])
    assert mistaken["message"] == expected.finding.message
    assert mistaken["misconceptions"] == expected.finding.misconceptions
    assert (mistaken["headline"], mistaken["lines"]) == (expected.headline(), expected.lines())
    foreign = [place for place in modules if place and "/python3" not in place and not place.startswith(str(folder))]
    assert foreign == []


@pytest.mark.parametrize(
    ("source", "state", "message"),
    [
        (RATIO + "    raise NotImplementedError", "not_implemented", "Not implemented yet."),
        (RATIO + "    return torch.einsum('i->i', new_log_probs)", "error", EINSUM),
        (RATIO + "    try:\n        return torch.einsum('i->i', new_log_probs)\n    except Exception:\n        return 0", "error",
         EINSUM),
        ("import numpy as np\n" + RATIO + "    return np.exp(new_log_probs - old_log_probs)", "error",
         "numpy is not in the page; it is in the notebook"),
        (RATIO + "    return 1 +", "error", "SyntaxError: invalid syntax in line 3: return 1 +"),
        ("ratio = 1 / 0", "error", "ZeroDivisionError: division by zero in line 1: ratio = 1 / 0"),
        ("x = 1", "error", "The cell defines no function importance_ratio."),
        ("%matplotlib inline\n!ls\n" + RATIO + "    return (new_log_probs - old_log_probs).exp()", "correct", ""),
        (">>> " + RATIO.replace("\n    ", "\n...     ") + "...     return (new_log_probs - old_log_probs).exp()", "correct", ""),
        (RATIO + "    return (new_log_probs - old_log_probs).exp()\ntorch.exp?\n?importance_ratio", "correct", ""),
        (">>> 1 +\n" + RATIO, "error", "SyntaxError: invalid syntax in line 1: 1 +"),
        ("import math, itertools, dataclasses\n" + RATIO + "    return math.e ** (new_log_probs - old_log_probs)", "correct", ""),
        (RATIO + "    return (new_log_probs - old_log_probs).exp()\nassert False, 'my own test'", "correct", ""),
        (RATIO + "    print('seen')\n    return (new_log_probs - old_log_probs).exp()", "correct", ""),
    ],
)  # fmt: skip
def test_cells_of_all_sorts(told, source, state, message):
    ((result,), _) = told(("importance_ratio", source))
    assert (result["state"], result["message"]) == (state, message)
    printed = {"%mat": "left out", "print": "seen", "assert": "my own test"}
    for word, shown in printed.items():
        if word in source:
            assert shown in result["printed"]


@pytest.mark.parametrize(
    ("imported", "used", "what"),
    [
        ("threading", "threading.Thread(target=print).start()", "threading.Thread"),
        ("threading", "threading.Timer(0, print).start()", "threading.Thread"),
        ("concurrent.futures", "concurrent.futures.ThreadPoolExecutor().submit(print)", "threading.Thread"),
        ("_thread", "_thread.start_new_thread(print, ())", "_thread.start_new_thread"),
        ("builtins", "input('how much? ')", "input"),
        ("builtins", "breakpoint()", "breakpoint"),
        ("subprocess", "subprocess.run(['ls'])", "subprocess.Popen"),
        ("os", "os.system('ls')", "os.system"),
        ("multiprocessing", "multiprocessing.get_context('fork').Process(target=print).start()", "os.fork"),
    ],
)
def test_what_a_page_cannot_ask_the_system_for_is_in_the_notebook(told, imported, used, what):
    right = "    return (new_log_probs - old_log_probs).exp()\n"
    inside, caught, before = (
        f"import {imported}\n{RATIO}    {used}\n{right}",
        f"import {imported}\n{RATIO}    try:\n        {used}\n    except Exception:\n        pass\n{right}",
        f"import {imported}\n{used}\n{RATIO}{right}",
    )
    results, _ = told(*(("importance_ratio", source) for source in (inside, caught, before)))
    assert {(result["state"], result["message"]) for result in results} == {
        ("error", f"{what} is not in the page; it is in the notebook")
    }
    named, _ = told(("importance_ratio", f"import {imported}\n{RATIO}{right}"))
    assert named[0]["state"] == "correct"


def test_an_exercise_may_use_the_readers_own_answer_to_another(told):
    loss = (
        "def clipped_surrogate_loss(new_log_probs, old_log_probs, advantages, clip_range=0.2):\n"
        "    print(importance_ratio.__doc__)\n    raise NotImplementedError\n"
    )
    own = "def importance_ratio(new_log_probs, old_log_probs):\n    'mine'\n    return (new_log_probs - old_log_probs).exp()\n"
    (theirs, mine), _ = told(("clipped_surrogate_loss", loss), ("clipped_surrogate_loss", loss, {"importance_ratio": own}))
    assert "mine" in mine["printed"] and "mine" not in theirs["printed"] and theirs["printed"]
