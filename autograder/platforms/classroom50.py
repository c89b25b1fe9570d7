"""`result.json` for Classroom 50, schema `classroom50/result/v1`.

Its scores are integers: points are given in hundredths, for everyone and every assignment, so that 7 of 10 points are 700 of 1000. The
schema's other fields (classroom, submission, commit, …) are known to the runner alone, which passes them in its environment.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from autograder.grading.verdicts import write_atomically
from autograder.platforms.give_back import Given, Result
from autograder.reporting.report import STATE_WORDS

SCHEMA = "classroom50/result/v1"
SCALE = 100
_FIELDS = {
    "classroom": "CLASSROOM",
    "submission": "SUBMISSION_TAG",
    "commit": "COMMIT_URL",
    "release": "RELEASE_URL",
    "review": "REVIEW_URL",
}


def result_json(result: Result, environment: Mapping[str, str], now: datetime) -> str:
    """The file of one submission. Open questions are in it once a teacher has given points for all of them."""
    tests: list[dict[str, Any]] = [
        {
            "test-name": one.name,
            "passed": one.state == "correct" or (one.by_hand and (one.score or 0.0) >= one.max_score),
            "score": round(SCALE * (one.score or 0.0)),
            "max-score": round(SCALE * one.max_score),
            "output": "\n".join(filter(None, (STATE_WORDS[one.state], one.message))),
        }
        for one in result.questions
        if not (one.by_hand and result.waits)
    ]
    fields: dict[str, Any] = {key: environment[name] for key, name in _FIELDS.items() if environment.get(name)}
    if "commit" in fields:
        fields.setdefault("review", fields["commit"])
    content = {
        "schema": SCHEMA,
        "assignment": environment.get("ASSIGNMENT") or result.assignment,
        **fields,
        "datetime": now.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "score": max(0, sum(test["score"] for test in tests) - round(SCALE * result.penalty)),
        "max-score": sum(test["max-score"] for test in tests),
        "tests": tests,
    }
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def write(results: list[Result], into: Path, given: Given) -> None:
    """Write `into/result.json` for a single submission on Classroom 50's runner, else `into/classroom50/STUDENT/ASSIGNMENT/result.json`."""
    now = datetime.now(UTC)
    if runner := bool(os.environ.get("SUBMISSION_TAG")):
        (into / "result.json").unlink(
            missing_ok=True
        )  # one that was handed in, or is of an earlier run, says nothing of this one
    if runner and len(results) == 1:
        given.files.append(write_atomically(into / "result.json", result_json(results[0], os.environ, now)))
        return
    for result in results:
        path = into / "classroom50" / result.student / result.assignment / "result.json"
        given.files.append(write_atomically(path, result_json(result, {}, now)))
    if results:
        given.notes.append(f"Points are in hundredths: {SCALE} for each point.")
        given.notes.append(
            "Outside Classroom 50's runner, classroom, submission, commit, release and review are unknown: the files lack them."
        )
