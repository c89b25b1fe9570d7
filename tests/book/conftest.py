"""The built book."""

from __future__ import annotations

from pathlib import Path

import pytest

from autograder.publishing import book


@pytest.fixture(scope="session")
def html() -> Path:
    """The published book, built now unless it is up to date."""
    return book.build()
