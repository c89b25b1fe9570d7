"""The records of the atlas: experiments/atlas/records/LIBRARY.json, written whole or not at all, a line for each row."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
RECORDS = FOLDER / "records"


def path(library: str, folder: Path = RECORDS) -> Path:
    return folder / f"{library}.json"


def load(library: str, folder: Path = RECORDS) -> dict[str, Any] | None:
    """A library's record, if it has one."""
    file = path(library, folder)
    return json.loads(file.read_text(encoding="utf-8")) if file.exists() else None


def load_all(folder: Path = RECORDS) -> dict[str, dict[str, Any]]:
    """All records, by library."""
    found = sorted(folder.glob("*.json"), key=lambda file: file.stem.lower())
    return {file.stem: json.loads(file.read_text(encoding="utf-8")) for file in found}


def save(library: str, record: dict[str, Any], folder: Path = RECORDS) -> Path:
    """Write a record, a line for each of its parts and of its rows."""
    parts = [f" {json.dumps(key)}: {json.dumps(value, ensure_ascii=False)}" for key, value in record.items() if key != "rows"]
    rows = ",\n".join(f"  {json.dumps(row, ensure_ascii=False)}" for row in record["rows"])
    text = "{\n" + ",\n".join([*parts, f' "rows": [\n{rows}\n ]']) + "\n}\n"
    folder.mkdir(parents=True, exist_ok=True)
    fresh = path(library, folder).with_suffix(".new")
    fresh.write_text(text, encoding="utf-8")
    fresh.replace(path(library, folder))
    return path(library, folder)
