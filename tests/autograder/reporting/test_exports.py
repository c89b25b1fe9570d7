import csv
import io
import json
import zipfile
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest
from gradebook_samples import HOSTILE, judged, release, submission, verdict
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from autograder.grading import sources, verdicts
from autograder.grading.verdicts import Verdict, clean_text
from autograder.reporting import exports, tables
from autograder.reporting.gradebook import GradebookWriter
from autograder.reporting.report import STATE_WORDS, report_html
from autograder.reporting.workbook import workbook

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
    cell, number, blank = next(csv.reader(io.StringIO(tables.csv_text((start + text, -1.5, None), []), newline="")))
    assert cell in (clean_text(start + text), "'" + clean_text(start + text))
    assert not cell.startswith(("\t", "\r")) and not cell.lstrip().startswith(tuple("=+-@＝＋－＠"))
    assert (number, blank) == ("-1.5", "")


def table_of(text):
    return list(csv.reader(io.StringIO(text)))


def name_of(writer, student, **columns):
    with writer._transaction() as db:
        from nbgrader.api import Student

        for column, value in columns.items():
            setattr(db.get(Student, student), column, value)


def by_hand(writer, student, points, cell="tradeoff", assignment="ch44"):
    """A teacher's points in formgrader."""
    from nbgrader.api import Gradebook

    with Gradebook(str(writer._engine.url)) as book:
        grade = book.find_grade(cell, assignment, assignment, student)
        grade.manual_score, grade.needs_manual_grade = points, False
        book.db.commit()


def test_canvas_shows_automatic_points_and_those_by_hand_in_two_columns(writer):
    writer.record(judged("s001", {"compute_gae": 1.0}), submission())
    writer.record(judged("s002"), submission())
    name_of(writer, "s001", last_name="Noether", first_name="Emmy", lms_user_id="4711")
    waiting = [
        ["Student", "ID", "SIS User ID", "SIS Login ID", "Section", "ch44"],
        ["    Points Possible", "", "", "", "", "5.0"],
        ["Noether, Emmy", "4711", "", "s001", "", "3.0"],
        ["s002", "", "", "s002", "", "5.0"],
    ]
    assert table_of(exports.canvas_csv(writer.grades())) == waiting
    by_hand(writer, "s001", 1.5)
    assert table_of(exports.canvas_csv(writer.grades())) == waiting
    assert table_of(tables.canvas_files(writer.grades())["canvas/ch44 by hand.csv"])[2:] == [
        ["Noether, Emmy", "4711", "", "s001", "", "1.5"]
    ]
    by_hand(writer, "s002", 2.0)
    assert [row[5:] for row in table_of(exports.canvas_csv(writer.grades()))] == [
        ["ch44", "ch44 by hand"],
        ["5.0", "2.0"],
        ["3.0", "1.5"],
        ["5.0", "2.0"],
    ]


@pytest.mark.parametrize("automatic, given, penalty, expected", [(5, 2, 1, (4, 2)), (1, 2, 2.5, (0, 0.5)), (1, 2, 4, (0, 0))])
def test_a_late_submission_loses_automatic_points_first(automatic, given, penalty, expected):
    row = {
        "student_id": "s", "assignment": "ch44", "submitted": True, "late_submission_penalty": penalty,
        "automatic": automatic, "automatic_max": 5, "by_hand": given, "by_hand_max": 2,
    }  # fmt: skip
    columns = tables.canvas_columns([row])
    assert (columns["ch44"][1]["s"], columns["ch44 by hand"][1]["s"]) == expected


def test_an_import_into_canvas_clears_no_grade(writer, tmp_path):
    writer.register("ch45", release())
    for student in ("s001", "s002", "s003"):
        writer.record(judged(student), submission())
    writer.record(judged("s003", assignment="ch45"), submission())
    writer.record(judged("s004", assignment="ch45"), submission())
    exports.write_all(tmp_path, writer)
    (tmp_path / "canvas" / "ch43.csv").write_text("of a chapter that is graded no longer")
    exports.write_all(tmp_path, writer)
    files = {path.name: table_of(path.read_text()) for path in [tmp_path / "canvas.csv", *(tmp_path / "canvas").iterdir()]}
    assert all(row[5:] and all(row[5:]) for rows in files.values() for row in rows)
    assert {name: [row[3] for row in rows[2:]] for name, rows in files.items()} == {
        "canvas.csv": ["s001", "s002", "s003"],  # with ch45 only one student would be left
        "ch44.csv": ["s001", "s002", "s003"],
        "ch45.csv": ["s003", "s004"],
    }


def test_canvas_finds_odd_logins_and_no_cell_is_a_formula(writer):
    odd = ("-dash", "+plus", "@handle", "a.b-c@uni.edu", "+4915112345", "=cmd", "-2+3", "=cmd|' -C calc'!A0", "1.234.567", "12,5")
    for student in odd:
        writer.record(judged(student))
    rows = table_of(exports.canvas_csv(writer.grades()))[2:]
    logins = [row[3] for row in rows]
    assert {student for student in odd if student in logins} == {*odd} - {"=cmd", "-2+3", "=cmd|' -C calc'!A0"}
    assert [s for s in odd if not tables.canvas_finds(tables.Person("", s))] == [
        "=cmd",
        "-2+3",
        "=cmd|' -C calc'!A0",
        "1.234.567",
        "12,5",
    ]
    assert all(tables.canvas_finds(tables.Person("", student, "4711")) for student in odd)
    name_of(writer, "=cmd", lms_user_id="4711")
    assert [
        row[0].removeprefix("'") if column == 0 else row[column]
        for row in table_of(exports.canvas_csv(writer.grades()))
        if row[1] == "4711"
        for column in range(6)
    ] == ["=cmd", "4711", "", "", "", "5.0"]


def test_ids_of_canvas_come_from_its_download(writer, tmp_path):
    writer.record(judged("doejane"))
    writer.record(judged("bob"))
    entry = {"student": "doejane", "assignment": "ch44", "platform": "canvas", "download": "doejane_101_7_ch44.ipynb"}
    entry |= {"platform_id": "101", "name": "doejane"}
    for folder, entries in (("old", [entry | {"platform_id": "1"}]), ("new", [entry])):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / ".collected.json").write_text(json.dumps({"schema": 1, "entries": entries}))
        sources.remember(tmp_path, tmp_path / folder)
    for path in ("canvas.csv", "canvas/ch44.csv"):
        exports.write_all(tmp_path, writer)
        assert [row[1:4:2] for row in table_of((tmp_path / path).read_text())[2:]] == [["", "bob"], ["101", ""]]
    (tmp_path / "new" / ".collected.json").write_text("{")
    exports.write_all(tmp_path, writer)
    assert [row[3] for row in table_of((tmp_path / "canvas.csv").read_text())[2:]] == ["bob", "doejane"]


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


def test_junit_has_a_time_for_each_case_also_of_students_who_are_absent(writer, tmp_path):
    result = Verdict.of(verdict(seconds=2.5, timings={"compute_gae": 1.25, "td_residuals": 0.5}))
    writer.record(result)
    verdicts.write(tmp_path / "verdicts", result)
    times = {"compute_gae": "1.250", "td_residuals": "0.500", "tradeoff": "0.000"}
    for judged_now in ([result], []):
        exports.write_all(tmp_path, writer, judged_now)
        (suite,) = ElementTree.parse(tmp_path / "junit.xml").getroot()
        assert suite.get("time") == "2.500" and {case.get("name"): case.get("time") for case in suite} == times
    verdicts.write(tmp_path / "verdicts", Verdict.of(verdict(seconds=3.0)))  # judged elsewhere: no time is invented for it
    exports.write_all(tmp_path, writer)
    (suite,) = ElementTree.parse(tmp_path / "junit.xml").getroot()
    assert [case.get("time") for case in suite] == [None, None, "0.000"]


def test_no_timing_is_in_a_verdict_file():
    text = verdicts.to_json(Verdict.of(verdict(timings={"compute_gae": 1.25})))
    assert "timings" not in json.loads(text) and verdicts.from_json(text).timings == {}


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


def test_gradescope_gets_points_given_by_hand(writer):
    one = judged()
    writer.record(one, submission())
    marks = writer.marks()["s001", "ch44"]
    assert "2 points, are graded by hand" in exports.gradescope_json(one, marks)
    assert json.loads(exports.gradescope_json(one, marks))["score"] == 5
    by_hand(writer, "s001", 1.5)
    by_hand(writer, "s001", 2.5, "test_compute_gae")  # a teacher has overruled the judge
    result = json.loads(exports.gradescope_json(one, writer.marks()["s001", "ch44"], penalty=1.0))
    scores = {test["name"]: (test["score"], test["max_score"]) for test in result["tests"]}
    assert scores == {"compute_gae": (2.5, 3.0), "td_residuals": (2.0, 2.0), "tradeoff": (1.5, 2.0)}
    assert result["score"] == 5.0 and "1 points are taken off" in result["output"]
    assert "1.5 / 2" in report_html(one, writer.marks()["s001", "ch44"])


@pytest.mark.parametrize("status, provisional", [("needs_review", 4.0), ("infra_error", 0.0)])
def test_gradescope_accepts_what_has_no_final_verdict(status, provisional):
    """The format asks for a score, or for tests with scores; and points that are not final are not shown before they are published."""
    result = json.loads(exports.gradescope_json(judged(scores={"compute_gae": 2.0}, status=status)))
    assert "score" not in result and result["visibility"] == "after_published"
    assert result["tests"] and all(isinstance(test["score"], float) for test in result["tests"])
    assert sum(test["score"] for test in result["tests"]) == provisional
    first = result["tests"][0]
    assert (first["name"], first["max_score"], first["visibility"]) == ("submission", 0.0, "visible") and first["output"]


def test_the_workbook_keeps_numbers_and_text_apart():
    data = workbook({"grades": (("student", "score"), [("=1+1 <&>\x00", 7.5), ("ü", None)])})
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        sheet = ElementTree.fromstring(archive.read("xl/worksheets/sheet1.xml"))
        names = {part.get("PartName") for part in ElementTree.fromstring(archive.read("[Content_Types].xml"))} - {None}
        assert names == {"/xl/workbook.xml", "/xl/worksheets/sheet1.xml"} and archive.testzip() is None
    ns = "{http://schemas.openxmlformats.org/spreadsheetml/2006/main}"
    cells = {cell.get("r"): (cell.get("t"), "".join(cell.itertext())) for cell in sheet.iter(f"{ns}c")}
    assert cells == {
        "A1": ("inlineStr", "student"),
        "B1": ("inlineStr", "score"),
        "A2": ("inlineStr", "=1+1 <&>\ufffd"),
        "B2": (None, "7.5"),
        "A3": ("inlineStr", "ü"),
    }
    assert not list(sheet.iter(f"{ns}f"))
    assert workbook({"grades": ((), [])}) == workbook({"grades": ((), [])})


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
    for words in STATE_WORDS.values():
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
