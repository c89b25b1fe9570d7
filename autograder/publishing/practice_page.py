"""The appendix on what pages can judge by themselves: a table from the kept records (autograder.proving.practice)."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

from autograder import checks
from autograder.authoring.chapter import Chapter
from autograder.paths import ROOT
from autograder.proving import kept, practice

INTRODUCTION = ROOT / "book" / "practice.md"
HEADER = "| Exercise | Answers | Same | Elsewhere | Offered |\n|---|---|---|---|---|"


def practice_rows(chapter: Chapter, keys: practice.Keys | None = None) -> list[dict]:
    """A chapter's part of the table, a dict for each exercise, from its kept record; where that does not fit, one that says so."""
    known, reasons = kept.load(chapter.assignment, practice.FOLDER), practice.unproved(chapter.assignment, keys)
    rows = []
    for exercise in checks.exercises(chapter.assignment):
        if exercise.name in reasons:
            missing = f"{reasons[exercise.name]}; `{kept.remedy(chapter.assignment)}`"
            print(f"{chapter.assignment}: {exercise.name}, on its page: {missing}", file=sys.stderr, flush=True)
            rows.append({"exercise": exercise.name, "unproved": missing})
        else:
            rows.append({"exercise": exercise.name} | known[exercise.name].rows)
    return rows


def practice_page(chapters: Mapping[str, Sequence[dict]]) -> str:
    """The appendix, in MyST, from each chapter's heading and rows (`practice_rows`)."""
    every = [row for rows in chapters.values() for row in rows if "unproved" not in row]
    offered, answers, agree, elsewhere = (
        sum(row["offered"] for row in every),
        sum(row["answers"] for row in every),
        sum(row["agree"] for row in every),
        sum(len(row["elsewhere"]) for row in every),
    )
    total = (
        f"Of {sum(map(len, chapters.values()))} exercises {offered} are offered. Of {answers} answers {agree} get the same verdict,"
        f" {elsewhere} are told to use the notebook, and {answers - agree - elsewhere} are judged differently."
    )
    parts = [INTRODUCTION.read_text(encoding="utf-8").rstrip(), total]
    for heading, rows in chapters.items():
        parts += [f"## {heading}", "\n".join([HEADER, *map(_row, rows)])]
        missing = sorted({what for row in rows for what in row.get("elsewhere", {}).values()})
        if missing:
            parts.append("\n".join(f"- {what}" for what in missing))
    return "\n\n".join(parts) + "\n"


def _row(row: dict) -> str:
    if "unproved" in row:
        return f"| `{row['exercise']}` | | | | no: {row['unproved']} |"
    answer = "yes" if row["offered"] else f"no: {row['reason']}"
    counts = f"{row['answers']} | {row['agree']} | {len(row['elsewhere'])}" if row["answers"] else "| |"
    return f"| `{row['exercise']}` | {counts} | {answer} |"
