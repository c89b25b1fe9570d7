"""`course return`, platform by platform, on a gradebook made by code: no submission is run here."""

import csv
import io
import json
import re
import zipfile

import pytest
from gradebook_samples import judged, release, submission
from nbgrader.api import Gradebook, Student
from typer.testing import CliRunner

from autograder import cli
from autograder.grading import sources, verdicts
from autograder.platforms import give_back, give_back_sheets
from autograder.reporting.gradebook import GradebookWriter

WORKSHEET = (
    "\ufeffIdentifier,Full name,Email address,Status,Grade,Maximum Grade,Grade can be changed,"
    "Last modified (submission),Last modified (grade),Feedback comments\r\n"
    'Participant 101,"Doe, Jane",jane@uni.edu,Submitted for grading,,7.00,Yes,"Friday, 20 November 2026, 1:00 PM",-,\r\n'
    "Participant 102,=John+1,john@uni.edu,Submitted for grading,,7.00,Yes,-,-,Well argued.\r\n"
    "Participant 103,Li Wei,li@uni.edu,Submitted for grading,3.00,7.00,No,-,-,\r\n"
    "Participant 104,Zoë,zoe@uni.edu,No submission,,7.00,Yes,-,-,\r\n"
)
CANVAS = (
    "Student,ID,SIS Login ID,Section,Essay (77),ch44 (88),ch44 by hand (89),Current Score\n"
    "    Points Possible,,,,10.00,5.00,2.00,(read only)\n"
    '"Doe, Jane",101,jdoe,A,8.00,1.00,,40.00\n'
    '"Doe, John",102,-john,A,9.00,,,90.00\n'
    '"Rev, Iew",103,rev,A,,4.00,1.00,80.00\n'
)


class Class:
    """Students of one assignment, graded into a folder, with what `course collect` wrote about them."""

    def __init__(self, folder, platform):
        self.out, self.submitted, self.platform, self.entries = folder / "grades", folder / "submitted", platform, []
        self.submitted.mkdir()
        self.out.mkdir()
        self.book = GradebookWriter(f"sqlite:///{self.out}/gradebook.db")
        self.book.register("ch44", release())

    def add(self, student, number, scores=None, by_hand=None, status="graded", download="", **changes):
        one = judged(student, scores, status=status)
        self.book.record(one, submission())
        verdicts.write(self.out / "verdicts", one)
        self.entries.append(
            {
                "student": student, "assignment": "ch44", "platform": self.platform, "platform_id": number, "name": student,
                "login": None, "download": download, "attempt": 1, "submitted_at": None, "late_seconds": 0, "penalty": 0.0,
            } | changes
        )  # fmt: skip
        (self.submitted / ".collected.json").write_text(json.dumps({"schema": 1, "entries": self.entries}))
        if by_hand is not None:
            with Gradebook(f"sqlite:///{self.out}/gradebook.db") as book:
                grade = book.find_grade("tradeoff", "ch44", "ch44", student)
                grade.manual_score, grade.needs_manual_grade = by_hand, False
                book.db.commit()

    def give_back(self, *arguments):
        command = [
            "return",
            "--to",
            self.platform,
            "--out",
            str(self.out),
            "--submitted",
            str(self.submitted),
            *map(str, arguments),
        ]
        return CliRunner().invoke(cli.app, command)

    def table(self, name):
        text = (self.out / "return" / self.platform / name).read_bytes().decode("utf-8-sig")
        return list(csv.DictReader(io.StringIO(text, newline="")))


@pytest.fixture
def canvas(tmp_path):
    return Class(tmp_path, "canvas")


@pytest.fixture
def moodle(tmp_path):
    return Class(tmp_path, "moodle")


# --- what holds for all of them ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("status, why", [("needs_review", "course accept rev ch44"), ("infra_error", "grade again")])
@pytest.mark.parametrize("platform", ["canvas", "moodle", "nbgrader", "classroom50"])
def test_what_is_not_final_is_left_out_by_name(tmp_path, platform, status, why):
    folder = Class(tmp_path, platform)
    folder.add("ada", "101", by_hand=2.0)
    folder.add("rev", "103", by_hand=None, status=status)
    done = folder.give_back()
    assert done.exit_code == 4, done.output
    assert "left out: rev ch44: " in done.output and why in done.output and "1 left out" in done.output
    written = [path for path in [*tmp_path.rglob("return/**/*"), *tmp_path.rglob("feedback/**/*")] if path.is_file()]
    assert written and not any("rev" in path.parts or b"rev" in path.read_bytes() for path in written if path.suffix != ".zip")


@pytest.mark.parametrize("platform", ["canvas", "moodle", "nbgrader", "classroom50"])
def test_no_score_of_an_earlier_run_is_left_lying(tmp_path, platform):
    folder = Class(tmp_path, platform)
    folder.add("ada", "101", by_hand=2.0)
    assert folder.give_back("--into", tmp_path / "back").exit_code == 0
    (tmp_path / "back" / "mine.txt").write_text("of the teacher's")
    verdicts.write(folder.out / "verdicts", judged("ada", status="needs_review"))
    assert folder.give_back("--into", tmp_path / "back", "--only", "ch44").exit_code == 4
    left = {path.name for path in (tmp_path / "back").rglob("*") if path.is_file()}
    assert left == {"mine.txt", f".returned-{platform}"}


def test_another_assignments_files_are_kept_by_only(canvas, tmp_path):
    canvas.book.register("ch45", release())
    canvas.add("ada", "101", by_hand=2.0)
    other = judged("ada", assignment="ch45")
    canvas.book.record(other, submission())
    verdicts.write(canvas.out / "verdicts", other)
    canvas.give_back()
    canvas.give_back("--only", "ch44")
    assert {path.name for path in (canvas.out / "return" / "canvas").iterdir()} > {"ch44.csv", "ch45.csv", "ch45 questions.csv"}


def test_collected_but_not_graded_is_named(canvas):
    canvas.add("ada", "101", by_hand=2.0)
    canvas.entries.append({**canvas.entries[0], "student": "bob"})
    (canvas.submitted / ".collected.json").write_text(json.dumps({"schema": 1, "entries": canvas.entries}))
    done = canvas.give_back()
    assert done.exit_code == 4 and "bob ch44: collected, but not graded yet" in done.output


def test_who_is_who_is_read_from_the_folders_that_were_graded(canvas, tmp_path):
    canvas.add("ada", "101", by_hand=2.0)
    sources.remember(canvas.out, tmp_path / "gone")
    sources.remember(canvas.out, canvas.submitted)
    results, _ = give_back.load(canvas.out, None)
    assert [result.person.identity for result in results] == ["101"]
    (canvas.out / sources.FILE).unlink()
    results, _ = give_back.load(canvas.out, None)  # a folder that happens to be called submitted says nothing of these grades
    assert [result.person.identity for result in results] == [None]


@pytest.mark.parametrize(
    "content, says",
    [
        ("{", "cannot be read"),
        ('{"schema": 2, "entries": []}', '"schema": 1'),
        ('{"schema": 1, "entries": [3]}', "entry 1: not an object"),
        ('{"schema": 1, "entries": [{"student": "../x", "assignment": "a", "platform": "p", "download": "d"}]}', "entry 1: not a plain"),
        ('{"schema": 1, "entries": [{"student": "x", "assignment": "a", "platform": "p"}]}', "entry 1: 'download' must be text"),
        ('{"schema": 1, "entries": [], "x": NaN}', "NaN is not JSON"),
    ],
)  # fmt: skip
def test_a_damaged_list_of_who_is_who_is_refused(canvas, content, says):
    canvas.add("ada", "101")
    (canvas.submitted / ".collected.json").write_text(content)
    done = canvas.give_back()
    assert done.exit_code == 2 and says in done.output and ".collected.json" in done.output and "course collect" in done.output


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["--out", "nowhere"], "nowhere: nothing was graded"),
        (["--submitted", "nowhere"], "nowhere: no such folder"),
        (["--only", "ch99"], "nothing of ch99 was graded"),
        (["--to", "nbgrader", "--worksheet", "x.csv"], "nbgrader has no worksheet"),
        (["--db-url", "sqlite:///nowhere.db"], "there is no gradebook nowhere.db"),
        (["--automatic"], "--automatic is for Moodle"),
        (["--worksheet", "nowhere.csv"], "nowhere.csv: cannot be read"),
    ],
)
def test_unusable_arguments_are_one_line_with_a_cure(canvas, arguments, says):
    canvas.add("ada", "101")
    done = canvas.give_back(*arguments)
    assert done.exit_code == 2 and says in done.output and done.output.count("\n") == 1


@pytest.mark.parametrize(
    "data, says",
    [
        (b"", "empty"),
        (b"PK\x03\x04", "this is a workbook"),
        (b"Identifier,Grade\nParticipant 1,M\xfcller\n", "row 2: not UTF-8"),
        (b"Identifier,Grade\nParticipant 1\n", "row 2: 1 cells under 2 columns"),
        (b'Identifier,Grade\n"Participant 1,3\n', "not CSV"),
        (b"a\0b", "no text file"),
        (b"Kennung,Bewertung\n1,2\n", "row 1: no column 'Identifier'"),
        (b"Identifier,Grade,Grade\nParticipant 1,,\n", "row 1: 2 columns are called 'Grade'"),
        (b"Identifier,Grade,Last modified (grade)\nJane,,\n", "row 2: 'Jane' is no participant"),
        (b"Identifier,Grade,Maximum Grade,Last modified (grade)\nParticipant 101,,Good,\n", "row 2: the maximum grade 'Good'"),
    ],
)
def test_a_damaged_worksheet_is_refused_by_row_with_a_cure(moodle, tmp_path, data, says):
    moodle.add("ada", "101", by_hand=2.0)
    (tmp_path / "sheet.csv").write_bytes(data)
    done = moodle.give_back("--worksheet", tmp_path / "sheet.csv")
    assert done.exit_code == 2 and f"{tmp_path}/sheet.csv: {says}" in done.output, done.output
    assert not (moodle.out / "return").exists()


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("delimiter, quoted", [(",", False), (";", False), ("\t", False), (",", True)])
def test_a_sheet_is_written_back_as_it_came(tmp_path, newline, mark, delimiter, quoted):
    rows = [["a", "b"], ["=1+1", " x "], ["two words", ""]]
    cells = [[f'"{cell}"' if quoted else cell for cell in row] for row in rows]
    data = (mark + "".join(delimiter.join(row) + newline for row in cells)).encode()
    (tmp_path / "sheet.csv").write_bytes(data)
    sheet = give_back_sheets.read(tmp_path / "sheet.csv")
    assert sheet.rows == rows and sheet.to_bytes() == data
    with pytest.raises(give_back.GiveBackError, match="would be overwritten"):
        sheet.target(tmp_path)


# --- Moodle ------------------------------------------------------------------------------------------------------------------


def test_moodles_worksheet_is_filled_and_otherwise_kept(moodle, tmp_path):
    moodle.add("jane", "101", {"compute_gae": 1.0}, by_hand=1.5)
    moodle.add("john", "102", by_hand=2.0)
    moodle.add("li", "103", by_hand=2.0)
    (tmp_path / "sheet.csv").write_bytes(WORKSHEET.encode())
    done = moodle.give_back("--worksheet", tmp_path / "sheet.csv")
    assert done.exit_code == 4 and "li ch44: Moodle has locked its grade (row 4)" in done.output
    data = (moodle.out / "return" / "moodle" / "sheet.csv").read_bytes()
    assert data.startswith(b"\xef\xbb\xbf") and data.count(b"\r\n") == 5
    before = list(csv.DictReader(io.StringIO(WORKSHEET.removeprefix("\ufeff"), newline="")))
    after = moodle.table("sheet.csv")
    assert [row["Grade"] for row in after] == ["4.50", "7.00", "3.00", ""]
    for old, new in zip(before, after, strict=True):
        assert {**new, "Grade": 0, "Feedback comments": 0} == {**old, "Grade": 0, "Feedback comments": 0}
    assert after[0]["Feedback comments"].startswith("Automatic grading: 4.5 of 7 points; compute_gae: partly correct (1 of 3)")
    assert after[1]["Feedback comments"] == "Well argued.Automatic grading: 7 of 7 points; tradeoff: graded by hand (2 of 2)."
    (tmp_path / "sheet.csv").write_bytes(data)  # filling it in again changes nothing
    moodle.give_back("--worksheet", tmp_path / "sheet.csv")
    assert (moodle.out / "return" / "moodle" / "sheet.csv").read_bytes() == data


def test_moodles_maximum_scales_and_the_scale_is_said(moodle, tmp_path):
    moodle.add("jane", "101", {"compute_gae": 0.0}, by_hand=1.5)
    (tmp_path / "sheet.csv").write_text(WORKSHEET.replace("7.00", "100.00"))
    done = moodle.give_back("--worksheet", tmp_path / "sheet.csv")
    assert done.exit_code == 0 and "Moodle's maximum is 100, the assignment's 7: grades are scaled" in done.output
    assert moodle.table("sheet.csv")[0]["Grade"] == "50.00"


def test_a_grade_that_waits_for_points_by_hand_is_not_given_to_moodle_unless_asked(moodle):
    moodle.add("jane", "101")
    done = moodle.give_back()
    assert done.exit_code == 4 and "jane ch44: waits for points by hand" in done.output
    assert not (moodle.out / "return").exists()
    assert moodle.give_back("--automatic").exit_code == 0
    (row,) = moodle.table("ch44.csv")
    assert (row["Identifier"], row["Grade"], row["Maximum grade"]) == ("Participant 101", "5.00", "5.00")


def test_moodles_feedback_lies_under_the_downloads_names(moodle):
    """As Moodle's own importer reads them: the second part of the first name with four parts is the participant's number."""
    downloads = {
        "101": "Jane Doe_101_assignsubmission_file_/ch44.ipynb",
        "102": "export/Zoë X_102_assignsubmission_file/sub/ch44.ipynb",
        "103": "Li Wei_103_assignsubmission_file_ch44.ipynb",
        "104": "somewhere else_9_assignsubmission_file_/ch44.ipynb",
    }
    for number, download in downloads.items():
        moodle.add(f"s_{number}/x".replace("/", "-"), number, by_hand=1.0, download=download)
    assert moodle.give_back().exit_code == 0
    with zipfile.ZipFile(moodle.out / "return" / "moodle" / "ch44-feedback.zip") as archive:
        names = archive.namelist()
        assert "1 / 2" in archive.read(names[0]).decode()
    assert names == [
        "Jane Doe_101_assignsubmission_file_/report-ch44.html",
        "Zoë X_102_assignsubmission_file/report-ch44.html",
        "Li Wei_103_assignsubmission_file_report-ch44.html",
        "s 104-x_104_assignsubmission_file_/report-ch44.html",
    ]
    for name, number in zip(names, downloads, strict=True):
        assert name.split("/")[0].split("_", 4)[1:4] == [number, "assignsubmission", "file"]


def test_without_collecting_moodles_rows_are_found_by_address(moodle, tmp_path):
    for student in ("jane", "john@uni.edu", "nobody"):
        moodle.add(student, None, by_hand=2.0)
    (moodle.submitted / ".collected.json").unlink()
    assert "nobody ch44: Moodle's number of this participant is unknown" in moodle.give_back().output
    (tmp_path / "sheet.csv").write_text(WORKSHEET)
    done = moodle.give_back("--worksheet", tmp_path / "sheet.csv")
    assert done.exit_code == 4 and "nobody ch44: no row of the worksheet is this one's" in done.output
    assert [row["Grade"] for row in moodle.table("sheet.csv")] == ["7.00", "7.00", "3.00", ""]
    with zipfile.ZipFile(moodle.out / "return" / "moodle" / "ch44-feedback.zip") as archive:
        assert archive.namelist() == [
            "Doe, Jane_101_assignsubmission_file_/report-ch44.html",
            "=John+1_102_assignsubmission_file_/report-ch44.html",
        ]


# --- Canvas ------------------------------------------------------------------------------------------------------------------


def test_canvas_gets_a_file_for_each_column_and_one_by_question(canvas):
    canvas.add("jane", "101", {"compute_gae": 1.0}, by_hand=1.5)
    canvas.add("=cmd()", "102")
    done = canvas.give_back()
    assert done.exit_code == 0, done.output
    assert [(row["ID"], row["SIS Login ID"], row["ch44"]) for row in canvas.table("ch44.csv")[1:]] == [
        ("102", "", "5.0"),
        ("101", "", "3.0"),
    ]
    assert [(row["ID"], row["ch44 by hand"]) for row in canvas.table("ch44 by hand.csv")] == [("", "2.0"), ("101", "1.5")]
    assert [list(row.values())[5:] for row in canvas.table("ch44 questions.csv")] == [
        ["3.0", "2.0"],
        ["3.0", "2.0"],
        ["1.0", "2.0"],
    ]
    assert list(canvas.table("ch44 questions.csv")[0])[5:] == ["ch44 compute_gae", "ch44 td_residuals"]
    assert list(canvas.table("ch44 questions by hand.csv")[0])[5:] == ["ch44 tradeoff"]


def test_a_login_that_canvas_cannot_find_is_left_out_by_name(canvas):
    canvas.add("=cmd()", None)
    canvas.add("anonymous", "anon_x7")
    done = canvas.give_back()
    assert done.exit_code == 4 and "=cmd() ch44: Canvas cannot find the login '=cmd()'" in done.output
    assert [row["Student"] for row in canvas.table("canvas.csv")[1:]] == ["anonymous"]


def test_the_gradebook_that_canvas_exported_is_filled_in_its_own_columns(canvas, tmp_path):
    canvas.add("jane", "101", {"compute_gae": 1.0}, by_hand=1.5)
    canvas.add("-john", None)  # by login
    canvas.add("rev", "103", status="needs_review")
    (tmp_path / "export.csv").write_text(CANVAS)
    done = canvas.give_back("--worksheet", tmp_path / "export.csv")
    assert done.exit_code == 4 and "rev ch44: needs review" in done.output
    expected = CANVAS.replace("8.00,1.00,,40", "8.00,3.00,1.50,40").replace("9.00,,,90", "9.00,5.00,,90")
    assert (canvas.out / "return" / "canvas" / "export.csv").read_text() == expected


@pytest.mark.parametrize(
    "possible, by_hand, expected", [("5.00", None, "5.00"), ("7.00", 1.0, "6.00"), ("7.00", None, "1.00"), ("100", 1.0, None)]
)
def test_a_single_column_of_canvas_takes_what_its_points_say(canvas, tmp_path, possible, by_hand, expected):
    canvas.add("jane", "101", by_hand=by_hand)
    text = re.sub(",ch44 by hand [^,]*", "", CANVAS).replace("5.00,2.00,(r", f"{possible},(r")
    text = text.replace("1.00,,40", "1.00,40").replace("9.00,,,", "9.00,,").replace("4.00,1.00,80", "4.00,80")
    (tmp_path / "export.csv").write_text(text)
    done = canvas.give_back("--worksheet", tmp_path / "export.csv")
    if expected is None:
        assert done.exit_code == 2 and "has 100 points in Canvas; expected 5, the automatic ones, or 7" in done.output
    else:
        assert canvas.table("export.csv")[1]["ch44 (88)"] == expected
        assert done.exit_code == (4 if expected == "1.00" else 0)


def test_what_a_late_submission_loses_has_a_column_beside_the_questions(canvas):
    canvas.add("jane", "101")
    with Gradebook(f"sqlite:///{canvas.out}/gradebook.db") as book:
        book.find_submission_notebook("ch44", "ch44", "jane").late_submission_penalty = 1.5
        book.db.commit()
    canvas.give_back()
    assert canvas.table("ch44.csv")[1]["ch44"] == "3.5"
    row = canvas.table("ch44 questions.csv")[1]
    assert sum(float(row[name]) for name in row if name.startswith("ch44 ")) == 3.5 and row["ch44 late"] == "-1.5"


def test_names_come_from_the_gradebook(canvas):
    canvas.add("jane", None)
    with canvas.book._transaction() as db:
        student = db.get(Student, "jane")
        student.last_name, student.first_name, student.lms_user_id = "Doe", "Jane", "4711"
    canvas.give_back()
    row = canvas.table("canvas.csv")[1]
    assert (row["Student"], row["ID"], row["SIS Login ID"]) == ("Doe, Jane", "4711", "jane")


# --- Classroom 50 and nbgrader -----------------------------------------------------------------------------------------------


def test_classroom50_reads_integers_on_one_scale(tmp_path):
    folder = Class(tmp_path, "classroom50")
    folder.add("ada", None, {"compute_gae": 1.0 / 3})
    folder.add("bob", None, by_hand=1.5)
    assert folder.give_back().exit_code == 0
    results = {
        name: json.loads((folder.out / f"return/classroom50/{name}/ch44/result.json").read_text()) for name in ("ada", "bob")
    }
    ada, bob = results["ada"], results["bob"]
    assert ada["schema"] == "classroom50/result/v1" and (ada["score"], ada["max-score"]) == (233, 500)
    assert (bob["score"], bob["max-score"]) == (650, 700)
    assert [(t["test-name"], t["passed"], t["score"], t["max-score"]) for t in ada["tests"]] == [
        ("compute_gae", False, 33, 300),
        ("td_residuals", True, 200, 200),
    ]
    assert not any(isinstance(value, float) for one in results.values() for test in one["tests"] for value in test.values())


def test_on_classroom50s_runner_the_file_is_whole(tmp_path, monkeypatch):
    variables = {
        "CLASSROOM": "rl", "ASSIGNMENT": "gae", "SUBMISSION_TAG": "submit/2026-06-01T14-32-05Z-a1b2c3d",
        "COMMIT_URL": "https://example.org/c", "RELEASE_URL": "https://example.org/r",
    }  # fmt: skip
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    folder = Class(tmp_path, "classroom50")
    folder.add("ada", None, status="needs_review")
    (tmp_path / "result.json").write_text("handed in")
    assert folder.give_back("--into", tmp_path).exit_code == 4 and not (tmp_path / "result.json").exists()
    folder.add("ada", None, status="graded")
    folder.submitted.joinpath(".collected.json").unlink()
    assert folder.give_back("--into", tmp_path).exit_code == 0
    content = json.loads((tmp_path / "result.json").read_text())
    assert set(content) == {
        "schema", "classroom", "assignment", "submission", "commit", "release", "review", "datetime", "score", "max-score", "tests",
    }  # fmt: skip
    assert content["assignment"] == "gae" and content["review"] == content["commit"]
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", content["datetime"])


def test_nbgrader_releases_the_feedback(tmp_path):
    """By nbgrader's own command, which names a page by the secret of the submission."""
    from nbgrader.exchange.default import ExchangeReleaseFeedback
    from nbgrader.utils import notebook_hash
    from traitlets.config import Config

    folder = Class(tmp_path, "nbgrader")
    folder.add("ada", None, by_hand=1.0)
    folder.add("bob", None)
    for student in ("ada", "bob"):
        place = folder.submitted / student / "ch44"
        place.mkdir(parents=True)
        (place / "timestamp.txt").write_text("2026-11-20 23:59:59.000000 UTC")
        if student == "ada":
            (place / "submission_secret.txt").write_text("secret")
    done = folder.give_back()
    assert done.exit_code == 0 and "missing for bob ch44" in done.output
    feedback = folder.out / "feedback"
    assert (feedback / "bob/ch44/ch44.html").is_file() and not (feedback / "bob/ch44/submission_secret.txt").exists()
    config = Config()
    config.CourseDirectory.root, config.CourseDirectory.course_id = str(folder.out), "rl"
    config.CourseDirectory.assignment_id, config.CourseDirectory.student_id = "ch44", "ada"
    config.Exchange.root = str(tmp_path / "exchange")
    (tmp_path / "exchange").mkdir(mode=0o777)
    (tmp_path / "exchange").chmod(0o777)
    from nbgrader.coursedir import CourseDirectory

    ExchangeReleaseFeedback(coursedir=CourseDirectory(config=config), config=config).start()
    page = tmp_path / "exchange" / "rl" / "feedback" / f"{notebook_hash(secret='secret', notebook_id='ch44')}.html"
    assert "1 / 2" in page.read_text()
