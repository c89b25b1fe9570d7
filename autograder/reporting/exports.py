"""What teachers, learning platforms and CI read: derived from `DIR/verdicts` and the gradebook, and from nothing else.

Every run writes everything anew and replaces it atomically, rows sorted by student and assignment. Verdicts contain text that
learners chose: each format escapes it in its own way, and no CSV cell can be a formula.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from rich.table import Table
from rich.text import Text

from autograder.grading.verdicts import RECEIPT, Item, Verdict, clean_text, read_all, write_atomically
from autograder.reporting.report import STATE_WORDS, STATUS_WORDS, points, report_html

if TYPE_CHECKING:
    from autograder.reporting.gradebook import GradebookWriter

FINAL = ("graded", "student_error")  # the statuses whose scores count


def write_all(directory: Path, gradebook: GradebookWriter) -> list[Verdict]:
    """Write every export of the verdicts in `directory/verdicts`, also of students who are absent this time, and return them.

    Raises: ValueError if a file there is no verdict.
    """
    directory = Path(directory)
    verdicts = read_all(directory / "verdicts")
    grades = countable(gradebook.grades(), verdicts)
    write_atomically(directory / "grades.csv", grades_csv(grades))
    write_atomically(directory / "questions.csv", questions_csv(verdicts))
    write_atomically(directory / "junit.xml", junit_xml(verdicts))
    write_atomically(directory / "canvas.csv", canvas_csv(grades))
    for verdict in verdicts:
        name = Path(verdict.student) / verdict.assignment
        write_atomically(directory / "gradescope" / f"{name}.json", gradescope_json(verdict))
        write_atomically(directory / "report" / f"{name}.html", report_html(verdict))
    return verdicts


def countable(grades: Iterable[Mapping[str, Any]], verdicts: Iterable[Verdict]) -> list[Mapping[str, Any]]:
    """The rows of the gradebook without those whose latest submission has no final verdict: neither a zero nor an older score
    may stand for it."""
    pending = {(verdict.student, verdict.assignment) for verdict in verdicts if verdict.status not in FINAL}
    return [row for row in grades if (row["student_id"], row["assignment"]) not in pending]


# --- tables ------------------------------------------------------------------------------------------------------------------


_FORMULA = tuple("=+-@＝＋－＠")  # some spreadsheets take the full-width characters, too


def _cell(value: Any) -> Any:
    """A CSV cell that no spreadsheet takes for a formula, nor a carriage return for a new row; numbers stay numbers."""
    if not isinstance(value, str):
        return "" if value is None else value
    text = clean_text(value)
    return "'" + text if text.startswith("\t") or text.lstrip()[:1] in _FORMULA else text


def _csv(header: Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([_cell(name) for name in header])
    writer.writerows([_cell(value) for value in row] for row in rows)
    return stream.getvalue()


def grades_csv(grades: Iterable[Mapping[str, Any]]) -> str:
    """nbgrader's own export (`GradebookWriter.grades`), with proper quoting."""
    from autograder.reporting.gradebook import GRADE_COLUMNS

    return _csv(GRADE_COLUMNS, ([row[column] for column in GRADE_COLUMNS] for row in grades))


def questions_csv(verdicts: Iterable[Verdict]) -> str:
    """A row for each exercise of each submission; the score is blank where none is final, as that of an open question is here."""
    rows = []
    for verdict in verdicts:
        for item in verdict.items:
            score = item.score if verdict.status in FINAL and item.state != "manual" else None
            misconceptions = ";".join(item.misconceptions)
            rows.append((verdict.student, verdict.assignment, item.exercise, item.state, score, item.max_score, misconceptions))
    return _csv(("student", "assignment", "exercise", "state", "score", "max_score", "misconceptions"), rows)


def canvas_csv(grades: Sequence[Mapping[str, Any]]) -> str:
    """Canvas's gradebook import: a column for each assignment, blank where nothing has been submitted or graded.

    Canvas finds a student by ID (nbgrader's `lms_user_id`, if the gradebook has it) or by login (the submission's folder).
    """
    maxima = {row["assignment"]: row["max_score"] for row in grades}
    assignments = sorted(maxima)
    students: dict[str, list[Mapping[str, Any]]] = {}
    for row in grades:
        if row["submitted"]:
            students.setdefault(row["student_id"], []).append(row)
    lines = [["    Points Possible", "", "", "", "", *(maxima[name] for name in assignments)]]
    for student, rows in sorted(students.items()):
        scores = {row["assignment"]: row["score"] for row in rows}
        name = ", ".join(filter(None, (rows[0]["last_name"], rows[0]["first_name"]))) or student
        lines.append([name, rows[0]["lms_user_id"], "", student, "", *(scores.get(name) for name in assignments)])
    return _csv(("Student", "ID", "SIS User ID", "SIS Login ID", "Section", *assignments), lines)


# --- machines ----------------------------------------------------------------------------------------------------------------


def junit_xml(verdicts: Iterable[Verdict]) -> str:
    """A suite for each submission and a case for each exercise; one more case says that a submission could not be graded."""
    root = ElementTree.Element("testsuites")
    for verdict in verdicts:
        name = f"{verdict.student}/{verdict.assignment}"
        suite = ElementTree.SubElement(root, "testsuite", name=name, time=f"{verdict.seconds:.3f}")
        if verdict.status != "graded":
            case = ElementTree.SubElement(suite, "testcase", classname=name, name="submission")
            problem = ElementTree.SubElement(case, "error", type=verdict.status, message=", ".join(verdict.flags))
            problem.text = STATUS_WORDS[verdict.status]
        for item in verdict.items:
            case = ElementTree.SubElement(suite, "testcase", classname=name, name=item.exercise)
            if item.state == "manual":
                ElementTree.SubElement(case, "skipped", message=STATE_WORDS["manual"])
            elif item.state != "correct":
                kind = "error" if item.state == "error" else "failure"
                summary = f"{STATE_WORDS[item.state]}: {points(item.score)} of {points(item.max_score)} points"
                ElementTree.SubElement(case, kind, type=item.state, message=summary).text = _explanation(item)
        for key, tag in (("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
            suite.set(key, str(len(suite.findall(f"testcase/{tag}"))))
        suite.set("tests", str(len(suite)))
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _explanation(item: Item) -> str:
    named = f"Recognised: {', '.join(item.misconceptions)}" if item.misconceptions else ""
    return "\n".join(filter(None, (item.message, named)))


def gradescope_json(verdict: Verdict) -> str:
    """Gradescope's results.json. Without a final verdict it holds no score, which Gradescope shows as not graded."""
    output = [STATUS_WORDS[verdict.status], *verdict.flags]
    if verdict.manual_max_score:
        output.append(f"Open questions, {points(verdict.manual_max_score)} points, are graded by hand.")
    result: dict[str, Any] = {
        "output": "\n".join(filter(None, output)),
        "output_format": "text",
        "visibility": "visible",
        "execution_time": verdict.seconds,
        "tests": [],
    }
    if verdict.status in FINAL:
        result["score"] = verdict.score
        result["tests"] = [
            {
                "name": item.exercise,
                "score": item.score,
                "max_score": item.max_score,
                "status": "passed" if item.state == "correct" else "failed",
                "output": "\n".join(filter(None, (STATE_WORDS[item.state], _explanation(item)))),
                "output_format": "text",
                "visibility": "visible",
            }
            for item in verdict.automatic
        ]
    return json.dumps(result, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"


# --- people ------------------------------------------------------------------------------------------------------------------


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
