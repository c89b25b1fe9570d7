"""Downloads as platforms make them, from dictionaries of names and contents."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest


def notebook(*sources: str, ids: tuple[str, ...] = ()) -> bytes:
    """A notebook of these code cells, whose first ones have nbgrader's ids."""
    cells = [
        {"cell_type": "code", "source": source, "metadata": {"nbgrader": {"grade_id": ids[number]}} if number < len(ids) else {}}
        for number, source in enumerate(sources)
    ]
    return json.dumps({"nbformat": 4, "nbformat_minor": 5, "metadata": {}, "cells": cells}).encode()


def zipped(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def folder(path: Path, files: dict[str, bytes]) -> Path:
    for name, content in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)
    return path


def tree(path: Path) -> dict[str, bytes]:
    """Every file under a folder, hidden ones included."""
    return {str(one.relative_to(path)): one.read_bytes() for one in sorted(path.rglob("*")) if one.is_file()}


@pytest.fixture
def into(tmp_path):
    return tmp_path / "submitted"
