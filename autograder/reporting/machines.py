"""Files for continuous integration and for Gradescope."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from autograder.grading.verdicts import FINAL, Item, Verdict
from autograder.reporting.report import STATE_WORDS, STATUS_WORDS, points

if TYPE_CHECKING:
    from autograder.reporting.gradebook import Mark

# --- JUnit -------------------------------------------------------------------------------------------------------------------


def junit_xml(verdicts: Iterable[Verdict]) -> str:
    """A suite for each submission and a case for each exercise; one more case says that a submission could not be graded.

    A case's time is what asking for the exercise took (nothing for one that was never asked for), a suite's that of the whole
    submission. Where it was not measured there is none: see `exports.with_times`.
    """
    root = ElementTree.Element("testsuites")
    for verdict in verdicts:
        name = f"{verdict.student}/{verdict.assignment}"
        suite = ElementTree.SubElement(root, "testsuite", name=name, time=f"{verdict.seconds:.3f}")
        measured = bool(verdict.timings) or verdict.status != "graded"
        if verdict.status != "graded":
            rest = max(0.0, verdict.seconds - sum(verdict.timings.values()))
            case = ElementTree.SubElement(suite, "testcase", classname=name, name="submission", time=f"{rest:.3f}")
            problem = ElementTree.SubElement(case, "error", type=verdict.status, message=", ".join(verdict.flags))
            problem.text = STATUS_WORDS[verdict.status]
        for item in verdict.items:
            case = ElementTree.SubElement(suite, "testcase", classname=name, name=item.exercise)
            if measured or item.state == "manual":
                case.set("time", f"{verdict.timings.get(item.exercise, 0.0):.3f}")
            if item.state == "manual":
                ElementTree.SubElement(case, "skipped", message=STATE_WORDS["manual"])
            elif item.state != "correct":
                kind = "error" if item.state == "error" else "failure"
                summary = f"{STATE_WORDS[item.state]}: {points(item.score)} of {points(item.max_score)} points"
                ElementTree.SubElement(case, kind, type=item.state, message=summary).text = explanation(item)
        for key, tag in (("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
            suite.set(key, str(len(suite.findall(f"testcase/{tag}"))))
        suite.set("tests", str(len(suite)))
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def measured_times(path: Path) -> dict[tuple[str, str], dict[str, float]]:
    """(suite, its seconds) → case → seconds, from the `junit.xml` of an earlier run; nothing if there is none, or it is damaged."""
    try:
        suites = ElementTree.parse(path).getroot().findall("testsuite")
        return {
            (suite.get("name", ""), suite.get("time", "")): {
                case.get("name", ""): float(case.get("time", "0")) for case in suite if case.get("name") != "submission"
            }
            for suite in suites
            if all(case.get("time") for case in suite)
        }
    except (OSError, ElementTree.ParseError, ValueError):
        return {}


def explanation(item: Item) -> str:
    """An item's message and the mistakes that were recognised."""
    named = f"Recognised: {', '.join(item.misconceptions)}" if item.misconceptions else ""
    return "\n".join(filter(None, (item.message, named)))


# --- Gradescope --------------------------------------------------------------------------------------------------------------


def gradescope_json(verdict: Verdict, marks: Sequence[Mark] = (), penalty: float = 0.0) -> str:
    """Gradescope's results.json.

    Args:
      verdict: of the submission.
      marks: the gradebook's, if it has any: points given by hand count before automatic ones, and answers wait without a test.
      penalty: points that a late submission loses.

    The format wants a score, or tests with scores. What has no final verdict gets no score of the whole: under review the tests
    hold the provisional points, which learners see when a teacher publishes them; when grading failed, one test of 0 points says so.
    """
    final = verdict.status in FINAL
    output = [STATUS_WORDS[verdict.status], *verdict.flags]
    questions = _questions(verdict, marks)
    waiting = sum(most for score, most in questions.values() if score is None)
    if waiting:
        output.append(f"Open questions, {points(waiting)} points, are graded by hand.")
    if final and penalty:
        output.append(f"Handed in late: {points(penalty)} points are taken off.")
    result: dict[str, Any] = {
        "output": "\n".join(filter(None, output)),
        "output_format": "text",
        "visibility": "visible" if final else "after_published",
        "execution_time": verdict.seconds,
        "tests": [] if final else [_test("submission", 0.0, 0.0, False, STATUS_WORDS[verdict.status])],
    }
    by_cell = {mark.cell: mark.score for mark in marks if final and not mark.question}
    if verdict.status != "infra_error":
        visible = "visible" if final else "after_published"
        for item in verdict.automatic:
            score = by_cell.get(f"test_{item.exercise}")
            score = item.score if score is None else score
            text = "\n".join(filter(None, (STATE_WORDS[item.state], explanation(item))))
            result["tests"].append(_test(item.exercise, score, item.max_score, item.state == "correct", text, visible))
    if final:
        for name, (given, most) in questions.items():
            if given is not None:
                result["tests"].append(_test(name, given, most, given >= most, STATE_WORDS["manual"]))
        result["score"] = max(0.0, round(sum(test["score"] for test in result["tests"]) - penalty, 4))
    return json.dumps(result, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"


def _questions(verdict: Verdict, marks: Sequence[Mark]) -> Mapping[str, tuple[float | None, float]]:
    """Open question → points given, None while it waits, and its maximum; without a gradebook, all of them as one."""
    if any(mark.question for mark in marks):
        return {mark.cell: (mark.score, mark.max_score) for mark in marks if mark.question}
    return {"open questions": (verdict.manual_score, verdict.manual_max_score)} if verdict.manual_max_score else {}


def _test(name: str, score: float, most: float, passed: bool, output: str, visibility: str = "visible") -> dict[str, Any]:
    return {
        "name": name,
        "score": score,
        "max_score": most,
        "status": "passed" if passed else "failed",
        "output": output,
        "output_format": "text",
        "visibility": visibility,
    }
