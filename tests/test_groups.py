"""Which tests go to one worker together, and which are about one chapter."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from autograder.paths import ROOT
from tests.groups import LONGEST, group_of, is_about, weight


def item(file, **params):
    return SimpleNamespace(nodeid=f"{file}::test_it[x]@group", path=Path(file), callspec=SimpleNamespace(params=params))


CH44 = SimpleNamespace(assignment="ch44")


@pytest.mark.parametrize(
    ("nodeid", "group"),
    [
        ("tests/book/test_pages.py::test_x[chapters/ch44_gae-dark]", "page ch44"),
        ("tests/book/test_widgets.py::test_x[ch44]", "page ch44"),
        ("tests/book/test_pages.py::test_x[how-to/learners-light]", "page how-to/learners"),
        ("tests/book/test_pages.py::test_x[index-phone]", "page index"),
        ("tests/book/test_pages.py::test_x", "tests/book/test_pages.py"),
        ("tests/book/test_accessibility.py::test_x[light]", "tests/book/test_accessibility.py"),
        ("tests/autograder/test_x.py::test_x[ch44]", "tests/autograder/test_x.py"),
    ],
)
def test_a_page_is_a_group_and_so_is_any_other_file(nodeid, group):
    assert group_of(nodeid) == group


def test_a_group_runs_in_one_worker(tmp_path):
    ours = (ROOT / "tests" / "conftest.py").read_text(encoding="utf-8")
    (tmp_path / "conftest.py").write_text(ours.replace("str(Path(__file__).parents[1])", repr(str(ROOT))))
    for file in ("tests/book/test_one.py", "tests/book/test_two.py", "tests/test_three.py"):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text(WORKER)
    command = [sys.executable, "-m", "pytest", "-n", "2", "--dist", "loadgroup", "--no-loadscope-reorder", "-q", "--rootdir", "."]
    done = subprocess.run([*command, "."], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    ran = [line.split() for line in (tmp_path / "ran").read_text().splitlines()]
    for page in ("ch44", "ch45"):
        assert len({worker for worker, place, chapter in ran if chapter == page and "book" in place}) == 1
    assert len({worker for worker, place, _ in ran if "three" in place}) == 1 and len(ran) == 12


WORKER = """
import os, pytest

@pytest.mark.parametrize("look", ["light", "dark"])
@pytest.mark.parametrize("chapter", ["ch44", "ch45"])
def test_it(chapter, look):
    with open("ran", "a") as ran:
        ran.write(f"{os.environ['PYTEST_XDIST_WORKER']} {__file__} {chapter}\\n")
"""


def test_what_is_about_one_chapter_is_told_by_parameters_or_by_the_files_name():
    assert is_about(item("tests/book/test_pages.py", name="chapters/ch44_gae"), "ch44")
    assert is_about(item("tests/autograder/test_x.py", chapter=CH44), "ch44")
    assert is_about(item("tests/solutions/test_ch44.py", number=3), "ch44")
    assert not is_about(item("tests/solutions/test_ch4.py"), "ch44")
    assert not is_about(item("tests/book/test_pages.py", name="chapters/ch45_coding_ppo"), "ch44")
    assert not is_about(item("tests/book/test_pages.py", name="index"), "ch44")


def test_the_long_files_exist_and_weigh_more_than_others():
    assert all((ROOT / file).is_file() for file in LONGEST)
    assert min(LONGEST.values()) > weight("tests/test_groups.py") < weight("page ch44")


def test_an_unknown_chapter_is_refused_with_those_that_exist():
    command = [sys.executable, "-m", "pytest", "--only", "ch1", "tests/test_groups.py"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 4 and "there is no chapter 'ch1'; there are: ch43, ch44" in done.stderr
