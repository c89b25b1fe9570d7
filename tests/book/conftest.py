"""The built book."""

from __future__ import annotations

from pathlib import Path

import pytest

from autograder.publishing import book, page


@pytest.fixture(scope="session")
def html(request) -> Path:
    """The published book, built now unless it is up to date: a worker that finds another at it waits. With --only, that page alone."""
    if only := request.config.getoption("--only"):
        return page.build(only).parents[1]
    return book.build()
