"""What every test may rely on: the programs of this environment (alembic, which nbgrader calls by name) come first on PATH, a seed of
the day, and a browser. A missing browser is a failure: pages nobody has looked at are not tested."""

import os
import shutil
import sys
from datetime import date
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))  # wherever pytest is started

from tests.groups import group_of, is_about, weight

os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"

os.environ.setdefault("COURSE_SEED", f"{date.today():%Y%m%d}")  # before xdist starts its workers, which inherit it
# As in the kernels of pages: with as many threads as cores, workers side by side wait for one another at each small tensor.
os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]  # as in autograder.cli


def pytest_addoption(parser):
    parser.addoption(
        "--only", metavar="CHAPTER", help="what is about this chapter alone, as in --only ch44, with its page for the book"
    )


def pytest_configure(config):
    if (only := config.getoption("--only")) is not None:
        from autograder.authoring import chapter

        try:
            chapter.load(only)
        except chapter.ChapterError:
            pass  # for its tests to tell
        except ValueError as error:
            raise pytest.UsageError(f"--only: {error}") from error
        os.environ["COURSE_ONLY"] = only  # for the workers, and for what is parametrised with one chapter


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """For --dist loadgroup. xdist 3.8 writes the marks of groups into ids, where pytest 9.2 does not look: so groups follow from ids."""
    if config.getoption("dist") != "loadgroup":
        return None
    from xdist.scheduler import LoadScopeScheduling

    class ByGroup(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            return group_of(nodeid)

    return ByGroup(config, log)


def pytest_collection_modifyitems(config, items):
    """Keep what is about one chapter, if one is asked for; the longest groups first."""
    if only := config.getoption("--only"):
        others = [item for item in items if not is_about(item, only)]
        config.hook.pytest_deselected(items=others)
        items[:] = [item for item in items if is_about(item, only)]
    items.sort(key=lambda item: -weight(group_of(item.nodeid)))  # the order within a group stays


def pytest_report_header():
    return f"COURSE_SEED={os.environ['COURSE_SEED']} (set it to draw the same samples again)"


@pytest.fixture(autouse=True)
def the_process_is_left_as_found():
    """A folder or a mask that one test leaves changed would fail another, elsewhere in the same worker."""
    folder, mask = os.getcwd(), os.umask(0o022)
    os.umask(mask)
    yield
    found = os.umask(mask)
    assert (os.getcwd(), found) == (folder, mask), "this test has changed the working folder or the umask and not put it back"


@pytest.fixture(scope="module")  # Playwright's event loop runs as long as it does, and other tests have loops of their own
def browser():
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    assert chromium, "no Chromium found: run tools/system-packages, or `apt-get install chromium`, then test again"
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield running
        running.close()
