import csv
import io
import json
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest
from gradebook_samples import HOSTILE, judged, release, submission, verdict
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from autograder.grading import verdicts
from autograder.grading.verdicts import Verdict, clean_text
from autograder.reporting import exports
from autograder.reporting.gradebook import GradebookWriter
from autograder.reporting.report import report_html

ODD_STUDENTS = ("=1+1", "a,b", '"quoted"', "<b>&amp;", "[red]x", "s 001", "|", "ü")


@pytest.fixture
def writer(tmp_path):
    with GradebookWriter(f"sqlite:///{tmp_path}/gradebook.db") as opened:
        opened.register("ch44", release())
        yield opened


def rows(path):
    return list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))


def every_state(**changes):
    items = [
        {"exercise": f"e_{state}", "score": 0.5 if state == "partial" else 0.0, "max_score": 1.0, "state": state}
        | {"misconceptions": ["mask-ignored", "off-by-one"] if state == "wrong" else [], "message": HOSTILE}
        for state in verdicts.STATES
    ]
    return Verdict.of(verdict(items=items, score=0.5, flags=[HOSTILE]) | changes)


def test_everything_is_written_for_odd_names_and_texts(writer, tmp_path):
    for student in ODD_STUDENTS:
        result = judged(student, {"compute_gae": 1.5}, message=HOSTILE)
        writer.record(result, submission())
        verdicts.write(tmp_path / "verdicts", result)
    written = exports.write_all(tmp_path, writer)
    shown = sorted(("'" if student.startswith("=") else "") + student for student in ODD_STUDENTS)
    assert sorted(verdict.student for verdict in written) == sorted(ODD_STUDENTS)
    assert sorted(row["student_id"] for row in rows(tmp_path / "grades.csv")) == shown
    assert {row["score"] for row in rows(tmp_path / "grades.csv")} == {"3.5"}
    assert [row["student"] for row in rows(tmp_path / "questions.csv")][::3] == [
        row["student_id"] for row in rows(tmp_path / "grades.csv")
    ]
    for student in ODD_STUDENTS:
        assert json.loads((tmp_path / "gradescope" / student / "ch44.json").read_text())["score"] == 3.5
        assert (tmp_path / "report" / student / "ch44.html").is_file()
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file() and "gradebook" not in path.name}
    exports.write_all(tmp_path, writer)
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize("status", ["needs_review", "infra_error"])
@pytest.mark.parametrize("graded_before", [True, False])
def test_a_submission_without_a_final_verdict_has_neither_a_zero_nor_an_old_score(writer, tmp_path, status, graded_before):
    writer.register("ch45", release())
    writer.record(judged(assignment="ch45"))
    if graded_before:
        writer.record(judged())
    verdicts.write(tmp_path / "verdicts", judged(status=status))
    exports.write_all(tmp_path, writer)
    assert [(row["assignment"], row["score"]) for row in rows(tmp_path / "grades.csv")] == [("ch45", "5.0")]
    assert "ch44" not in rows(tmp_path / "canvas.csv")[1]
    assert {row["score"] for row in rows(tmp_path / "questions.csv")} == {""}
    assert "score" not in json.loads((tmp_path / "gradescope" / "s001" / "ch44.json").read_text())


def test_questions_csv_has_a_row_for_each_item():
    table = list(csv.DictReader(io.StringIO(exports.questions_csv([every_state()]))))
    assert [row["state"] for row in table] == list(verdicts.STATES)
    wrong = table[verdicts.STATES.index("wrong")]
    assert wrong == {
        "student": "s001",
        "assignment": "ch44",
        "exercise": "e_wrong",
        "state": "wrong",
        "score": "0.0",
        "max_score": "1.0",
        "misconceptions": "mask-ignored;off-by-one",
    }
    assert table[-1]["score"] == ""  # an open question's is in the gradebook


@given(st.text(st.characters(exclude_categories=())), st.sampled_from(("", "=", " +", "\n-", "@", "\t", "\r", "＝")))
def test_no_csv_cell_is_a_formula(text, start):
    cell, number, blank = next(csv.reader(io.StringIO(exports._csv((start + text, -1.5, None), []), newline="")))
    assert cell in (clean_text(start + text), "'" + clean_text(start + text))
    assert not cell.startswith(("\t", "\r")) and not cell.lstrip().startswith(tuple("=+-@＝＋－＠"))
    assert (number, blank) == ("-1.5", "")


def test_canvas_has_points_possible_names_and_blanks(writer):
    writer.register("ch45", release())
    writer.record(judged("s001", {"compute_gae": 1.0}))
    writer.record(judged("s002", assignment="ch45"))
    with writer._transaction() as db:
        from nbgrader.api import Student

        student = db.get(Student, "s001")
        student.last_name, student.first_name, student.lms_user_id = "Noether", "Emmy", "4711"
    assert list(csv.reader(io.StringIO(exports.canvas_csv(writer.grades())))) == [
        ["Student", "ID", "SIS User ID", "SIS Login ID", "Section", "ch44", "ch45"],
        ["    Points Possible", "", "", "", "", "7.0", "7.0"],
        ["Noether, Emmy", "4711", "", "s001", "", "3.0", ""],
        ["s002", "", "", "s002", "", "", "5.0"],
    ]


@given(st.text(st.characters(exclude_categories=())))
def test_junit_is_valid_for_any_text(text):
    item = {"exercise": text, "score": 0.0, "max_score": 1.0, "state": "wrong", "misconceptions": [text], "message": text}
    one = Verdict.of(verdict(items=[item], score=0.0, flags=[text], status="needs_review"))
    ElementTree.fromstring(exports.junit_xml([one]))


def test_junit_counts_and_kinds():
    root = ElementTree.fromstring(
        exports.junit_xml([every_state(), every_state(student="s002", status="student_error", score=0.0)])
    )
    first, second = root.findall("testsuite")
    assert {key: first.get(key) for key in ("name", "tests", "failures", "errors", "skipped")} == {
        "name": "s001/ch44",
        "tests": "7",
        "failures": "4",
        "errors": "1",
        "skipped": "1",
    }
    assert {case.get("name"): [child.tag for child in case] for case in first} == {
        "e_correct": [],
        "e_partial": ["failure"],
        "e_wrong": ["failure"],
        "e_not_implemented": ["failure"],
        "e_error": ["error"],
        "e_timeout": ["failure"],
        "e_manual": ["skipped"],
    }
    assert (second.get("tests"), second.get("errors"), second[0].get("name")) == ("8", "2", "submission")


def test_gradescope_results():
    result = json.loads(exports.gradescope_json(every_state()))
    assert result["score"] == 0.5
    assert [(test["name"], test["score"], test["max_score"], test["status"]) for test in result["tests"]][:3] == [
        ("e_correct", 0.0, 1.0, "passed"),
        ("e_partial", 0.5, 1.0, "failed"),
        ("e_wrong", 0.0, 1.0, "failed"),
    ]
    assert all(test["visibility"] == "visible" for test in result["tests"])
    assert "graded by hand" in result["output"]


class _Page(HTMLParser):
    """The tags and attributes of a page, and its text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.text = set(), set(), ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data):
        self.text += data


@given(st.text(st.characters(exclude_categories=())))
def test_no_text_adds_markup_to_a_report(text):
    item = {"exercise": text, "score": 0.0, "max_score": 1.0, "state": "wrong", "misconceptions": [text], "message": text}
    page = _Page(report_html(Verdict.of(verdict(items=[item], score=0.0, flags=[text]))))
    assert page.tags <= _Page(report_html(every_state())).tags
    assert page.attributes <= {"lang", "charset", "http-equiv", "content", "name", "class", "scope", "href", "id"}


def test_a_report_says_every_state_in_words():
    page = _Page(report_html(every_state()))
    for words in exports.STATE_WORDS.values():
        assert words in page.text
    assert "0.5 of 5 points" in page.text
    assert "not graded yet, 2 points possible" in page.text
    assert "mask-ignored, off-by-one" in " ".join(page.text.split())
    assert "1.5 of 2 points" in report_html(every_state(manual_score=1.5))
    assert "provisional" in report_html(every_state(status="needs_review"))
    assert "of 5 points" not in report_html(every_state(status="infra_error"))


def test_terminal_table_shows_names_as_they_are():
    console = Console(file=io.StringIO(), width=200)
    console.print(exports.table([judged("[red]x"), judged("s2", status="infra_error")]))
    text = console.file.getvalue()
    assert "[red]x" in text and "5 / 5" in text and "2 correct" in text and "infra error" in text


def test_terminal_table_says_why_a_submission_could_not_be_graded():
    console = Console(file=io.StringIO(), width=200)
    item = {"score": 0.0, "max_score": 1.0, "state": "error", "message": "There is no notebook."}
    items = [item | {"exercise": name} for name in ("first", "second")]
    console.print(exports.table([judged(status="student_error", score=0.0, items=items)]))
    assert console.file.getvalue().count("There is no notebook.") == 1


def test_summary_is_a_markdown_table_of_bounded_length():
    text = exports.summary_markdown([judged("a|b <img> _x_", flags=["`@all`\n| x"])])
    assert text.startswith("**Submissions: 1** (1 graded)")
    assert text.splitlines()[-1].count("|") == 6
    assert not set(text.splitlines()[-1]) & set("<>`@_[]*")
    assert len(exports.summary_markdown([judged(f"s{n}") for n in range(5)], rows=2).splitlines()) == 8
