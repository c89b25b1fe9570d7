"""What people read at a terminal and on a CI page."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable

from rich.table import Table
from rich.text import Text

from autograder.grading.verdicts import RECEIPT, Verdict, clean_text
from autograder.reporting.report import STATE_WORDS, points


def _overview(verdict: Verdict) -> tuple[str, str, str, str, str]:
    score = "–" if verdict.status == "infra_error" else f"{points(verdict.score)} / {points(verdict.max_score)}"
    states = Counter(STATE_WORDS[item.state] for item in verdict.items)
    outcome = [f"{count} {state}" for state, count in states.items()]
    if verdict.status == "student_error":  # nothing ran, and one reason holds for all: a teacher can act on that, not on counts
        outcome = list(dict.fromkeys(item.message for item in verdict.automatic if item.message))
    notes = "; ".join([*outcome, *(flag for flag in verdict.flags if not flag.startswith(RECEIPT))])
    return verdict.student, verdict.assignment, verdict.status.replace("_", " "), score, clean_text(notes.replace("\n", " "), 300)


_OVERVIEW = ("Student", "Assignment", "Status", "Points", "Outcome")
_STATUS_STYLES = {"graded": "green", "student_error": "red", "needs_review": "yellow", "infra_error": "bold red"}


def table(verdicts: Iterable[Verdict]) -> Table:
    """The verdicts for a terminal, one line each."""
    result = Table(*_OVERVIEW)
    result.columns[3].justify = "right"
    for verdict in map(Verdict.of, verdicts):
        cells = [Text(value) for value in _overview(verdict)]  # Text: brackets in names are no markup
        cells[2].stylize(_STATUS_STYLES[verdict.status])
        result.add_row(*cells)
    return result


def same_files(verdicts: Iterable[Verdict]) -> list[str]:
    """A line for each file that several students have handed in byte for byte: worth a word with them, and no more than that."""
    owners: dict[tuple[str, str], list[str]] = defaultdict(list)
    for verdict in verdicts:
        for flag in verdict.flags:
            if flag.startswith(RECEIPT):
                owners[verdict.assignment, flag.removeprefix(RECEIPT)].append(verdict.student)
    return [
        f"{assignment}: the same {receipt.partition(' ')[0]} was handed in by {', '.join(students)}"
        for (assignment, receipt), students in sorted(owners.items())
        if len(students) > 1
    ]


def summary_markdown(verdicts: Iterable[Verdict], rows: int = 1000) -> str:
    """The same for a CI step summary, at most `rows` lines, in GitHub's Markdown."""
    valid = [Verdict.of(verdict) for verdict in verdicts]
    counts = Counter(verdict.status.replace("_", " ") for verdict in valid)
    lines = [
        f"**Submissions: {len(valid)}** (" + ", ".join(f"{count} {status}" for status, count in sorted(counts.items())) + ")",
        "",
    ]
    lines += ["| " + " | ".join(_OVERVIEW) + " |", "|---|---|---|---:|---|"]
    lines += ["| " + " | ".join(map(_markdown, _overview(verdict))) + " |" for verdict in valid[:rows]]
    if len(valid) > rows:
        lines += ["", f"… and {len(valid) - rows} more"]
    return "\n".join(lines) + "\n"


def _markdown(text: str) -> str:
    """Text that Markdown shows as it is: whatever could be syntax becomes an HTML entity."""
    return re.sub(r"[^\w .,;/–-]|_", lambda match: f"&#{ord(match[0])};", text)
