"""The built book and a browser to read it with. A missing browser is a failure: pages nobody has looked at are not tested."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from playwright.sync_api import Browser, sync_playwright

from autograder import book


@pytest.fixture(scope="session")
def html() -> Path:
    """The published book, built now unless it is up to date."""
    return book.build()


@pytest.fixture(scope="session")
def browser():
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    assert chromium, "no Chromium found: run tools/system-packages, or `apt-get install chromium`, then test again"
    with sync_playwright() as playwright:
        running: Browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield running
        running.close()
