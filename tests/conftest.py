"""What every test may rely on: the programs of this environment (alembic, which nbgrader calls by name) come first on PATH, a seed of
the day, and a browser. A missing browser is a failure: pages nobody has looked at are not tested."""

import os
import shutil
import sys
from datetime import date
from pathlib import Path

import pytest

os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"

os.environ.setdefault("COURSE_SEED", f"{date.today():%Y%m%d}")  # before xdist starts its workers, which inherit it


def pytest_report_header():
    return f"COURSE_SEED={os.environ['COURSE_SEED']} (set it to draw the same samples again)"


@pytest.fixture(scope="module")  # Playwright's event loop runs as long as it does, and other tests have loops of their own
def browser():
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    assert chromium, "no Chromium found: run tools/system-packages, or `apt-get install chromium`, then test again"
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield running
        running.close()
