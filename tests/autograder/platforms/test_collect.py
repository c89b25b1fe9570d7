"""Whatever a platform hands out is laid out for the grader; what is not understood is told; nothing is lost, however often it is done."""

from __future__ import annotations

import io
import json
import os
import resource
import struct
import zipfile
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from autograder import cli
from autograder.grading import intake
from autograder.platforms import archives, attempts, collect, roster
from tests.autograder.platforms.conftest import folder, notebook, tree, zipped

ONE, TWO, THREE = notebook("1"), notebook("2"), notebook("3")
CANVAS = {
    "doejane_12345_678901_ch44.ipynb": ONE,
    "doejohn_LATE_12346_678902_ch44-1.ipynb": TWO,
    "li_12347_678903_Copy of ch44.ipynb": THREE,
}
DUE = """\
zone: Europe/London
grace_minutes: 10
penalty: {per_day: 0.1, at_most: 0.5, nothing_after_days: 7}
assignments:
  ch44:
    due: 2026-11-20 12:00
    extensions: {jroe: 2026-11-24 12:00}
"""


def papers(into):
    """(student, assignment) → the notebook's bytes, as the grader would find them."""
    found = intake.survey(into, ()).tasks
    return {(s, a): (f / f"{a}.ipynb").read_bytes() if (f / f"{a}.ipynb").exists() else None for s, a, f in found}


def by_student(done):
    return {entry["student"]: entry for entry in done.entries}


# --- every platform ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("made", [zipped, folder])
def test_canvas(tmp_path, into, made):
    done = collect.collect([made(tmp_path / "download", CANVAS)], into)
    assert papers(into) == {("doejane", "ch44"): ONE, ("doejohn", "ch44"): TWO, ("li", "ch44"): THREE}
    assert not done.problems
    jane = by_student(done)["doejane"]
    assert (jane["platform"], jane["platform_id"], jane["name"]) == ("canvas", "12345", "doejane")
    assert jane["download"] == "doejane_12345_678901_ch44.ipynb"


def test_the_second_upload_to_canvas_is_a_later_attempt(tmp_path, into):
    files = {"doejane_12345_9_ch44.ipynb": ONE, "doejane_12345_10_ch44-1.ipynb": TWO, "doejane_12345_8_helpers.py": b"x = 1\n"}
    done = collect.collect([zipped(tmp_path / "a.zip", files)], into)
    assert papers(into) == {("doejane", "ch44"): TWO} and done.entries[0]["attempt"] == 2
    kept = tree(into / ".attempts" / "doejane")
    assert sorted(os.path.basename(name) for name in kept) == ["ch44.ipynb", "helpers.py"] and ONE in kept.values()


@pytest.mark.parametrize("other", ["ch44-old.ipynb", "gae.ipynb", "my ch44 scratch.ipynb"])
def test_in_one_download_of_canvas_the_assignments_own_name_wins_over_another(tmp_path, into, other):
    files = {
        "doejane_1_9_ch44.ipynb": ONE,
        f"doejane_1_10_{other}": notebook("2", ids=("compute_gae",)),
        "li_2_3_ch44.ipynb": TWO,
    }
    zipped(tmp_path / "a.zip", files)
    for more in (["--dry-run"], [], []):
        shown = CliRunner().invoke(
            cli.app, ["collect", str(tmp_path / "a.zip"), "--into", str(into), *more], env={"COLUMNS": "200"}
        )
        jane, li = [line for line in shown.output.splitlines() if "_ch44.ipynb" in line]
        assert f"doejane_1_9_ch44.ipynb; not {other}" in jane and "not" not in li
    assert papers(into) == {("doejane", "ch44"): ONE, ("li", "ch44"): TWO}
    assert (into / "doejane" / "ch44" / other).exists()
    later = {"doejane_1_10_ch44-1.ipynb": THREE, "doejane_1_11_ch44 (2).ipynb": TWO, "doejane_1_12_old ch44.ipynb": ONE}
    done = collect.collect([zipped(tmp_path / "b.zip", later)], into)
    assert papers(into)["doejane", "ch44"] == TWO and done.entries[0]["download"] == "doejane_1_11_ch44 (2).ipynb"
    assert done.kept["doejane", "ch44"] == ["ch44-1.ipynb", "old ch44.ipynb"]


def test_names_with_underscores_anonymous_students_and_text_entries_of_canvas(tmp_path, into):
    files = {
        "o_brien_77_5_ch44.ipynb": ONE,
        "anon_x1Y2z_6_ch44.ipynb": TWO,
        "LATE_anon_q9_7_ch44.ipynb": THREE,
        "poe_78_text.html": b"<p>",
    }
    done = collect.collect([zipped(tmp_path / "a.zip", files)], into)
    assert papers(into) == {
        ("o_brien", "ch44"): ONE, ("anon_x1Y2z", "ch44"): TWO, ("anon_q9", "ch44"): THREE, ("poe", "ch44"): None,
    }  # fmt: skip
    assert len(done.problems) == 1 and "poe handed in no notebook (text.html)" in done.problems[0]


@pytest.mark.parametrize("made", [zipped, folder])
@pytest.mark.parametrize(
    "name",
    [
        "..hidden_121_7023_ch44.ipynb",
        "._121_7023_ch44.ipynb",
        ".._9_assignsubmission_file_/ch44.ipynb",
        ".jo_9_assignsubmission_file_ch44.ipynb",
        ".GAE_jo_attempt_2026-11-20-12-30-00_ch44.ipynb",
        ".jo+ch44+2026-11-20 10:00:00.000000 UTC+x/ch44.ipynb",
    ],
)
def test_a_person_whose_name_begins_with_a_dot_is_not_overlooked(tmp_path, into, made, name):
    collect.collect([made(tmp_path / "download", {name: ONE})], into)
    assert list(papers(into).values()) == [ONE]
    zipped(tmp_path / "inner.zip", {name: ONE})
    collect.collect([made(tmp_path / "all", {"inner.zip": (tmp_path / "inner.zip").read_bytes()})], tmp_path / "more")
    assert list(papers(tmp_path / "more").values()) == [ONE]


@pytest.mark.parametrize("made", [zipped, folder])
def test_what_systems_and_editors_write_beside_is_nobodys(tmp_path, into, made):
    left = ("._doejane_12345_678901_ch44.ipynb", "__MACOSX/._li_1_2_ch44.ipynb", "~$ejane_12345_678901_a.docx", ".DS_Store")
    done = collect.collect([made(tmp_path / "download", CANVAS | dict.fromkeys(left, b"x"))], into)
    assert len(papers(into)) == 3 and not done.problems


def test_two_people_of_one_name_are_two_students_whenever_they_hand_in(tmp_path, into):
    collect.collect([zipped(tmp_path / "a.zip", {"doejane_1_5_ch44.ipynb": ONE})], into)
    collect.collect([zipped(tmp_path / "b.zip", {"doejane_2_6_ch44.ipynb": TWO, "doejane_1_5_ch44.ipynb": ONE})], into)
    assert papers(into) == {("doejane", "ch44"): ONE, ("doejane-2", "ch44"): TWO}


@pytest.mark.parametrize("made", [zipped, folder])
def test_moodle_in_both_forms(tmp_path, into, made):
    files = {
        "Jane Doe_987654_assignsubmission_file_/ch44.ipynb": ONE,
        "John Doe_987655_assignsubmission_onlinetext_/onlinetext.html": b"<p>here</p>",
        "Li Wei_987656_assignsubmission_file_/ch44/ch44.ipynb": THREE,
        "Li Wei_987656_assignsubmission_onlinetext_/onlinetext.html": b"<p>done</p>",
    }
    done = collect.collect([made(tmp_path / "folders", files)], into)
    assert papers(into) == {("Jane Doe", "ch44"): ONE, ("John Doe", "ch44"): None, ("Li Wei", "ch44"): THREE}
    assert (into / "Li Wei" / "ch44" / "onlinetext.html").exists()
    assert len(done.problems) == 1 and "John Doe handed in no notebook (onlinetext.html)" in done.problems[0]
    assert by_student(done)["Li Wei"]["download"] == "Li Wei_987656_assignsubmission_file_"
    flat = {"Zoë Ågren_5_assignsubmission_file_ch44.ipynb": TWO, "Default group_assignsubmission_file_ch44.ipynb": ONE}
    done = collect.collect([made(tmp_path / "flat", flat)], into)
    assert papers(into)[("Zoë Ågren", "ch44")] == TWO and by_student(done)["Default group"]["platform_id"] is None


@pytest.mark.parametrize("made", [zipped, folder])
def test_underscores_in_what_moodle_calls_a_person(tmp_path, into, made):
    files = {
        "Teilnehmer_in 9006_9006_assignsubmission_file_/ch44.ipynb": ONE,
        "Jo_7_8_assignsubmission_file_/a_assignsubmission_file_b.py": b"",
        "Jo_7_8_assignsubmission_file_/ch44.ipynb": TWO,
        "Group_A_assignsubmission_file_/ch44.ipynb": THREE,
    }
    (tmp_path / "names.csv").write_text("Participant,Student\nTeilnehmer/in 9006,jane\n8,jo\n")
    done = collect.collect([made(tmp_path / "moodle", files)], into, names=tmp_path / "names.csv")
    assert papers(into) == {("jane", "ch44"): ONE, ("jo", "ch44"): TWO, ("Group_A", "ch44"): THREE}
    assert by_student(done)["jo"]["name"] == "Jo_7" and by_student(done)["Group_A"]["platform_id"] is None
    assert len(done.problems) == 1 and "Group_A" in done.problems[0]
    flat = {"Ab_c_9_assignsubmission_file_ch44_1_assignsubmission_file_.ipynb": ONE}
    done = collect.collect([made(tmp_path / "flat", flat)], tmp_path / "more")
    assert [(one["name"], one["platform_id"]) for one in done.entries] == [("Ab_c", "9")]


def test_a_file_that_no_platform_names_so_is_told_with_a_cure(tmp_path, into):
    files = {"Jane_1_assignsubmission_file_/ch44.ipynb": ONE, "stray/ch44.ipynb": TWO}
    done = collect.collect([folder(tmp_path / "a", files)], into)
    assert len(done.problems) == 1 and "rename it so and collect again" in done.problems[0]


def test_a_zip_for_each_student_is_opened_and_a_zip_in_that_is_not(tmp_path, into):
    inner = zipped(
        tmp_path / "i.zip", {"ch44/ch44.ipynb": ONE, "ch44/helpers.py": b"", "__MACOSX/ch44/._ch44.ipynb": b"x"}
    ).read_bytes()
    deeper = zipped(tmp_path / "d.zip", {"work.zip": inner}).read_bytes()
    files = {"Jane Doe_1_assignsubmission_file_/work.zip": inner, "John Doe_2_assignsubmission_file_/work.zip": deeper}
    done = collect.collect([zipped(tmp_path / "a.zip", files)], into)
    assert sorted(tree(into / "Jane Doe")) == ["ch44/ch44.ipynb", "ch44/helpers.py"]
    assert list(tree(into / "John Doe")) == ["ch44/work.zip"]
    assert len(done.problems) == 1 and "John Doe handed in no notebook (work.zip)" in done.problems[0]


def test_more_zips_than_a_process_may_keep_open(tmp_path, into):
    inner = zipped(tmp_path / "i.zip", {"ch44.ipynb": ONE}).read_bytes()
    files = {f"S {number}_{number}_assignsubmission_file_/work.zip": inner for number in range(60)}
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) + 20, hard))
    try:
        done = collect.collect([zipped(tmp_path / "a.zip", files)], into)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert len(papers(into)) == 60 and not done.problems


GRADESCOPE = """\
submission_111:
  :submitters:
  - :name: Jane Doe
    :sid: '3012'
    :email: jane@school.example
  :created_at: 2026-11-20 11:59:00.123456000 Z
  :score: 7.0
  :history:
  - :id: 99
    :created_at: 2026-11-19 10:00:00 Z
submission_113:
  :submitters:
  - :name: Li Wei
    :email: li@school.example
  - :name: Ann Poe
    :email: ann@school.example
  :created_at: 2026-11-21 12:30:00 Z
"""


def test_gradescope(tmp_path, into):
    root = "assignment_55_export/"
    files = {f"{root}submission_{number}/ch44.ipynb": content for number, content in ((111, ONE), (112, TWO), (113, THREE))}
    files[f"{root}submission_metadata.yml"] = GRADESCOPE.encode()
    (tmp_path / "due.yml").write_text(DUE)
    done = collect.collect([zipped(tmp_path / "a.zip", files)], into, due=tmp_path / "due.yml")
    assert papers(into) == {  # a group's work is everybody's
        ("3012", "ch44"): ONE, ("submission_112", "ch44"): TWO, ("li", "ch44"): THREE, ("ann", "ch44"): THREE,
    }  # fmt: skip
    assert len(done.problems) == 1 and "does not say whose it is" in done.problems[0]
    entries = by_student(done)
    assert entries["3012"]["late_seconds"] == 0 and entries["3012"]["submitted_at"] == "2026-11-20T11:59:00.123456+00:00"
    assert (entries["li"]["late_seconds"], entries["li"]["penalty"]) == (24 * 3600 + 1800, 0.2)
    assert (into / "li" / "ch44" / "timestamp.txt").read_text() == "2026-11-21 12:30:00.000000 UTC"
    later = GRADESCOPE.replace("submission_111", "submission_200").replace("2026-11-20 11:59", "2026-11-20 13:00")
    files = {"submission_200/ch44.ipynb": TWO, "submission_113/ch44.ipynb": THREE, "submission_metadata.yml": later.encode()}
    done = collect.collect([zipped(tmp_path / "later.zip", files)], into)
    assert papers(into)["3012", "ch44"] == TWO and by_student(done)["3012"]["platform_id"] == "200"
    assert (into / ".due.yml").read_text() == DUE


def test_blackboard(tmp_path, into):
    head = "gradebook_CS101_Chapter 44"
    files = {
        f"{head}_jane_doe_attempt_2026-11-20-12-30-00_ch44.ipynb": ONE,
        f"{head}_jane_doe_attempt_2026-11-20-12-30-00.txt": b"Name: Jane Doe (jane_doe)\r\nAssignment: Chapter 44\r\n",
        f"{head}_jroe_attempt_2026-11-19-09-00-00_ch44.ipynb": TWO,
        f"{head}_jroe_attempt_2026-11-23-09-00-00_ch44 (2).ipynb": THREE,
        f"{head}_poe_attempt_2026-11-20-09-00-00.txt": b"Name: Ann Poe (poe)\nSubmission Field:\nsee my mail\n",
    }
    (tmp_path / "due.yml").write_text(DUE)
    download = zipped(tmp_path / "a.zip", files)
    done = collect.collect([download], into, due=tmp_path / "due.yml")
    assert papers(into) == {("jane_doe", "ch44"): ONE, ("jroe", "ch44"): THREE, ("poe", "ch44"): None}
    assert len(done.problems) == 1 and "poe handed in no notebook (submission.txt)" in done.problems[0]
    jane, roe = by_student(done)["jane_doe"], by_student(done)["jroe"]
    assert (jane["name"], jane["login"], jane["late_seconds"], jane["penalty"]) == ("Jane Doe", "jane_doe", 1800, 0.1)
    assert (roe["attempt"], roe["late_seconds"]) == (2, 0)  # the extension
    without = collect.collect([download], tmp_path / "other")
    assert by_student(without)["jroe"]["submitted_at"] is None and papers(tmp_path / "other") == papers(into)
    assert "have no zone" in without.notes[0]


def test_github(tmp_path, into):
    files = {
        "ch44-janedoe/ch44/ch44.ipynb": ONE,
        "ch44-janedoe/ch44/helpers.py": b"",
        "ch44-janedoe/README.md": b"",
        "ch44-janedoe/.git/HEAD": b"ref: refs/heads/main\n",
        "ch44-john-doe/release/ch44/ch44.ipynb": TWO,
        "ch44-john-doe/release/course_lib/x.py": b"",
        "ch44-li/ch44.ipynb": THREE,
        "ch44-li/course_lib/x.py": b"",
        "ch44-li/mine/more.py": b"",
        "homework-poe/ch44.ipynb": ONE,
        "homework-poe/.git/HEAD": b"",
    }
    done = collect.collect([folder(tmp_path / "clones", files)], into)
    assert not done.problems
    assert papers(into) == {
        ("janedoe", "ch44"): ONE, ("john-doe", "ch44"): TWO, ("li", "ch44"): THREE, ("homework-poe", "ch44"): ONE,
    }  # fmt: skip
    assert sorted(tree(into / "janedoe")) == ["ch44/ch44.ipynb", "ch44/helpers.py"]
    assert sorted(tree(into / "li")) == ["ch44/ch44.ipynb", "ch44/mine/more.py"]


@pytest.mark.parametrize("slug", ["hw-ch44", "my-class-GAE"])
def test_github_classrooms_folder_says_what_repositories_begin_with(tmp_path, into, slug):
    files = {f"{slug}-janedoe/ch44.ipynb": ONE, f"{slug}-john-doe/sub/ch44.ipynb": TWO, f"{slug.lower()}-li/ch44.ipynb": THREE}
    (tmp_path / "names.csv").write_text("login,student\njanedoe,jane\njohn-doe,john\nli,li wei\n")
    inner = zipped(tmp_path / f"{slug}-submissions.zip", files)
    outer = folder(tmp_path / "clones", {f"{slug}-submissions/{name}": content for name, content in files.items()})
    for number, download in enumerate((inner, outer, outer / f"{slug}-submissions")):
        done = collect.collect([download], tmp_path / str(number), names=tmp_path / "names.csv")
        assert papers(tmp_path / str(number)) == {("jane", "ch44"): ONE, ("john", "ch44"): TWO, ("li wei", "ch44"): THREE}
        assert not done.problems
    loose = folder(
        tmp_path / "loose", {f"{name}/.git/HEAD".replace("/sub", ""): b"" for name in map(os.path.dirname, files)} | files
    )
    done = collect.collect([loose], into, names=tmp_path / "names.csv")
    (line,) = [line for line in done.problems if "janedoe" in line]
    assert line.count(f"{slug}-janedoe") == 3 and f"does not have {slug}-janedoe;" in line and "named SLUG-submissions" in line


def test_nbgrader(tmp_path, into):
    files = {
        "jane/ch44/ch44.ipynb": ONE,
        "jane/ch44/timestamp.txt": b"2026-11-20 23:59:59.000000 UTC",
        "jane/ch43/ch43.ipynb": TWO,
        "loose.ipynb": ONE,
        "release/ch44/ch44.ipynb": THREE,
        "release/course_lib/__init__.py": b"",
    }
    done = collect.collect([folder(tmp_path / "submitted_before", files)], into)
    assert papers(into) == {("jane", "ch43"): TWO, ("jane", "ch44"): ONE}
    assert done.entries[1]["submitted_at"] == "2026-11-20T23:59:59+00:00"
    assert len(done.problems) == 2 and "bundle" in done.problems[1] and done.problems[0].startswith("loose.ipynb")
    inbound = {f"jane+ch44+2026-11-2{day} 10:00:00.000000 UTC+x/ch44.ipynb": content for day, content in ((1, TWO), (2, THREE))}
    assert not collect.collect([folder(tmp_path / "inbound", inbound)], into).problems
    assert papers(into)[("jane", "ch44")] == THREE


def test_other_names_by_the_expression_of_nbgraders_zip_collect(tmp_path, into):
    files = {"ps1_bitdiddle_attempt_2016-01-30-15-30-10_ch44.ipynb": ONE, "else.ipynb": TWO}
    pattern = r".*_(?P<student_id>\w+)_attempt_(?P<timestamp>[0-9\-]+)_(?P<file_id>\w+)"
    done = collect.collect([folder(tmp_path / "archive", files)], into, pattern=pattern)
    assert papers(into) == {("bitdiddle", "ch44"): ONE} and done.problems == ["else.ipynb: --pattern does not match it"]
    assert done.entries[0]["submitted_at"] == "2016-01-30T15:30:10+00:00"
    for wrong, said in (("(", "no regular expression"), ("x", r"no group (?P<file_id>…)")):
        with pytest.raises(collect.CollectError) as error:
            collect.collect([tmp_path / "archive"], into, pattern=wrong)
        assert said in str(error.value)


def test_several_downloads_in_one_folder_and_zips_among_them(tmp_path, into):
    zipped(tmp_path / "canvas.zip", CANVAS)
    files = {
        "moodle/Jane Doe_1_assignsubmission_file_/ch44.ipynb": ONE,
        "canvas.zip": (tmp_path / "canvas.zip").read_bytes(),
        "notes.txt": b"",
    }
    done = collect.collect([folder(tmp_path / "all", files)], into)
    assert len(papers(into)) == 4 and len(done.problems) == 1 and done.problems[0].startswith("notes.txt")
    assert by_student(done)["li"]["download"] == "canvas.zip/li_12347_678903_Copy of ch44.ipynb"


# --- which assignment, which notebook ----------------------------------------------------------------------------------------


def test_the_cells_tell_the_chapter_where_the_name_does_not(tmp_path, into):
    files = {
        "a_1_5_homework.ipynb": notebook("x", ids=("compute_gae",)),
        "b_2_6_homework.ipynb": ONE,
        "c_3_7_[ch43] mine.ipynb": TWO,
    }
    done = collect.collect([zipped(tmp_path / "a.zip", files)], into)
    assert sorted(papers(into)) == [("a", "ch44"), ("c", "ch43")]
    assert len(done.problems) == 1 and "--assignment says for which chapter" in done.problems[0]
    done = collect.collect([tmp_path / "a.zip"], tmp_path / "forced", assignment="ch44")
    assert sorted(papers(tmp_path / "forced")) == [("a", "ch44"), ("b", "ch44"), ("c", "ch44")] and not done.problems


def test_of_several_notebooks_the_right_name_counts_and_otherwise_nobody_guesses(tmp_path, into):
    folders = {who: f"{who}_1{number}_assignsubmission_file_/" for number, who in enumerate(("A", "B", "C"))}
    files = {
        folders["A"] + "ch44.ipynb": ONE, folders["A"] + "old ch44.ipynb": TWO,
        folders["B"] + "ch44 (1).ipynb": ONE, folders["B"] + "Copy of ch44.ipynb": TWO,
        folders["C"] + "ch44 (1).ipynb": ONE, folders["C"] + "Copy of ch44.ipynb": ONE,
    }  # fmt: skip
    done = collect.collect([zipped(tmp_path / "a.zip", files)], into)
    assert papers(into) == {("A", "ch44"): ONE, ("B", "ch44"): None, ("C", "ch44"): ONE}
    assert sorted(tree(into / "B")) == ["ch44/Copy of ch44.ipynb", "ch44/ch44 (1).ipynb"]
    assert len(done.problems) == 1 and "B handed in several notebooks" in done.problems[0]


def test_side_files_keep_their_names_or_get_the_ones_that_the_chapter_asks_for(tmp_path, into):
    files = {
        "doe_1_5_ch45-2.ipynb": ONE, "doe_1_6_lander_policy-1.safetensors": b"w", "doe_1_7_data-1.csv": b"d", "doe_1_8_timestamp.txt": b"t",
    }  # fmt: skip
    collect.collect([zipped(tmp_path / "a.zip", files)], into)
    assert sorted(tree(into / "doe" / "ch45")) == [
        "ch45.ipynb",
        "data-1.csv",
        "lander_policy.safetensors",
        "timestamp (handed in).txt",
    ]


# --- who is who --------------------------------------------------------------------------------------------------------------


def test_two_people_whom_names_calls_one_are_told(tmp_path, into):
    (tmp_path / "names.csv").write_text("id;student\n12345;jane\n12346;jane\n12347;li\n")
    done = collect.collect([zipped(tmp_path / "a.zip", CANVAS)], into, names=tmp_path / "names.csv")
    (note,) = [note for note in done.notes if "--names" in note]
    assert "--names has jane for 12345 and for 12346" in note and "give each a student" in note


def test_names(tmp_path, into):
    (tmp_path / "names.csv").write_text("id;student\n12345;jane\n12346;john\n")
    done = collect.collect([zipped(tmp_path / "a.zip", CANVAS)], into, names=tmp_path / "names.csv")
    assert sorted(papers(into)) == [("jane", "ch44"), ("john", "ch44"), ("li", "ch44")]
    assert len(done.problems) == 1 and "--names does not have 12347, li; collected as li" in done.problems[0]


def test_whoever_is_unknown_and_not_collected_is_not_said_to_be(tmp_path, into):
    (tmp_path / "names.csv").write_text("id;student\n1;jane\n")
    files = {"jane_1_5_ch44.ipynb": ONE, "jane_1_6_ch43.ipynb": ONE, "pdfonly_2_7_a.pdf": b"%PDF", "li_3_8_ch44.ipynb": TWO}
    done = collect.collect([zipped(tmp_path / "a.zip", files)], into, names=tmp_path / "names.csv")
    about = [line for line in done.problems if "pdfonly" in line]
    assert sum("not collected" in line for line in about) == 1 and not any("collected as" in line for line in about)
    assert any("--names does not have 3, li; collected as li" in line for line in done.problems)
    metadata = "submission_1:\n  :submitters: []\nsubmission_2:\n  :submitters: []\n"
    files = {"submission_metadata.yml": metadata.encode(), "submission_1/a.pdf": b"", "submission_2/ch44.ipynb": ONE}
    files |= {"submission_2/ch43.ipynb": ONE}
    done = collect.collect([zipped(tmp_path / "b.zip", files)], tmp_path / "other")
    assert [("collected as" in line, line.partition(":")[0]) for line in done.problems if "does not say" in line] == [
        (False, "submission_1"), (True, "submission_2"),
    ]  # fmt: skip


def test_archives_that_stay_closed_are_named_with_what_to_do(tmp_path, into):
    inner = zipped(tmp_path / "i.zip", {"ch44.ipynb": ONE}).read_bytes()
    deeper = zipped(tmp_path / "d.zip", {"inner.zip": inner}).read_bytes()
    files = {
        "a_1_5_ch44.ipynb": ONE,
        "b_2_6_work.zip": deeper,
        "c_3_7_work.tar.gz": b"",
        "d_4_8_work.rar": b"",
        "e_5_9_a.pdf": b"",
    }
    done = collect.collect([zipped(tmp_path / "a.zip", files)], into)
    said = {line.partition("_")[0]: line for line in done.problems}
    for who, name in (("b", "inner.zip"), ("c", "work.tar.gz"), ("d", "work.rar")):
        assert f"unpack {name}" in said[who] and "collect again" in said[who]
    assert "unpack" not in said["e"]


@pytest.mark.parametrize(
    "text",
    [
        'Student,ID,SIS User ID,SIS Login ID,Section\n    Points Possible,,,,\n"Doe, Jane",12345,,jane,A\n"Student, Test",99,,,A\n',
        "Identifier,Full name,Email address,Status,Grade\nParticipant 12345,Jane Doe,jane,Submitted,\n",
        "identifier,github_username,github_id,name\njane,12345,1,Jane\n",
        "\ufeffStudent,Login\njane,doejane\njane,12345\n",
    ],
    ids=["canvas", "moodle", "classroom", "logins"],
)
def test_platforms_own_lists_are_names_too(tmp_path, into, text):
    (tmp_path / "names.csv").write_text(text)
    files = {"ch44-12345/ch44.ipynb": ONE} if "github" in text or "Login\n" in text else {"doejane_12345_5_ch44.ipynb": ONE}
    done = collect.collect([zipped(tmp_path / "a.zip", files)], into, names=tmp_path / "names.csv")
    assert papers(into) == {("jane", "ch44"): ONE} and not done.problems


@pytest.mark.parametrize("coding", ["utf-16", "utf-16-le", "utf-16-be", "utf-8", "utf-8-sig"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("first", ["", "sep=;\n", '"sep=;"\n', "SEP=\t\n"])
def test_names_as_spreadsheets_write_them(tmp_path, into, coding, end, first):
    between = "\t" if (coding.startswith("utf-16") and not first) or "\t" in first else ";"
    text = first + between.join(("id", "student")) + "\n" + between.join(("12345", "Zoë, Ågren")) + "\n"
    mark = "\ufeff" if coding[-3:] in ("-le", "-be") else ""
    (tmp_path / "names.csv").write_bytes((mark + text.replace("\n", end)).encode(coding))
    assert roster.load(tmp_path / "names.csv").student(id="12345") == "Zoë, Ågren"


@pytest.mark.parametrize(
    "content", ["id;student\n1;Zoë\n".encode("cp1252"), "id\tstudent\n1\tjo\n".encode("utf-16-le"), b"\xff\xfei"]
)
def test_names_in_another_coding_are_refused_with_how_to_save_them(tmp_path, into, content):
    (tmp_path / "names.csv").write_bytes(content)
    with pytest.raises(roster.RosterError, match="in Excel, save it as 'CSV UTF-8'"):
        roster.load(tmp_path / "names.csv")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("sep=;\nid;student\n1;jane\n1;li\n", "line 4: the id 1 is li's here and jane's in line 3"),
        ("sep=,\nid,who\n1,jane\n", "line 2: the columns are id, who"),
        ("id,student\n1," + "x" * 200_000 + "\n", "is no CSV that can be read (field larger"),
        ("id,student\n1,jane\n2,john\n1,li\n", "line 4: the id 1 is li's here and jane's in line 2; delete one of the two"),
        ("id,student\n1,\n", "line 2: no student in it"),
        ("id,who\n1,jane\n", "line 1: the columns are id, who; wanted are student and one of id, login, email, name"),
        ("", "is empty"),
    ],
)
def test_names_that_cannot_be_used_are_one_clear_line(tmp_path, into, text, said):
    (tmp_path / "names.csv").write_text(text)
    result = CliRunner().invoke(
        cli.app, ["collect", str(folder(tmp_path / "a", CANVAS)), "--into", str(into), "--names", str(tmp_path / "names.csv")]
    )
    assert result.exit_code == 2 and said in result.output and len(result.output.splitlines()) == 1 and not into.exists()


# --- again, and later --------------------------------------------------------------------------------------------------------


def test_twice_changes_nothing(tmp_path, into):
    (tmp_path / "due.yml").write_text(DUE)
    download = zipped(tmp_path / "a.zip", CANVAS | {"doejane_12345_678900_ch44-1.ipynb": TWO})
    collect.collect([download], into, due=tmp_path / "due.yml")
    before = tree(into)
    collect.collect([download], into)
    assert tree(into) == before and any(name.startswith(".attempts/doejane/") for name in before)


def test_a_later_upload_counts_and_the_earlier_is_kept(tmp_path, into):
    first, second = (
        zipped(tmp_path / "1.zip", {"doe_1_5_ch44.ipynb": ONE}),
        zipped(tmp_path / "2.zip", {"doe_1_6_ch44-1.ipynb": TWO}),
    )
    collect.collect([first], into)
    assert collect.collect([second], into).entries[0]["attempt"] == 2
    assert papers(into) == {("doe", "ch44"): TWO} and ONE in tree(into / ".attempts").values()
    before = tree(into)
    collect.collect([first], into)  # an old download, found again
    assert tree(into) == before
    collect.collect([zipped(tmp_path / "3.zip", {"doe_1_7_ch44-2.ipynb": ONE})], into)  # the first work, handed in once more
    assert papers(into) == {("doe", "ch44"): ONE} and TWO in tree(into / ".attempts").values()


def test_what_was_changed_by_hand_stays_until_something_new_comes_and_is_kept_then(tmp_path, into):
    download = zipped(tmp_path / "a.zip", {"doe_1_5_ch44.ipynb": ONE})
    collect.collect([download], into)
    (into / "doe" / "ch44" / "ch44.ipynb").write_bytes(THREE)
    assert "changed by hand" in collect.collect([download], into).notes[0]
    assert papers(into) == {("doe", "ch44"): THREE}
    done = collect.collect([zipped(tmp_path / "b.zip", {"doe_1_6_ch44.ipynb": TWO})], into)
    assert papers(into) == {("doe", "ch44"): TWO} and "is kept in" in done.notes[0]
    assert {ONE, THREE} <= set(tree(into / ".attempts").values())


def test_a_time_that_was_told_wrongly_can_be_told_again(tmp_path, into):
    (tmp_path / "due.yml").write_text(DUE)
    download = zipped(tmp_path / "a.zip", {"doe_1_5_ch44.ipynb": ONE})
    for day, late in ((22, 172_800), (19, 0), (21, 86_400)):
        (tmp_path / "names.csv").write_text(f"id,student,submitted_at\n1,jane,2026-11-{day} 12:00\n")
        done = collect.collect([download], into, names=tmp_path / "names.csv", due=tmp_path / "due.yml")
        assert done.entries[0]["late_seconds"] == late
        assert (into / "jane" / "ch44" / "timestamp.txt").read_text() == f"2026-11-{day} 12:00:00.000000 UTC"
    assert done.notes == ["ch44: nothing was handed in by jroe, whose extension the due dates name"]


def test_folders_that_were_there_before_are_kept(tmp_path, into):
    folder(into, {"doejane/ch44/ch44.ipynb": THREE, "doejane/ch43/ch43.ipynb": TWO, "other/ch44/ch44.ipynb": TWO})
    collect.collect([zipped(tmp_path / "a.zip", CANVAS)], into)
    assert (
        papers(into)[("doejane", "ch44")] == ONE and papers(into)[("doejane", "ch43")] == papers(into)[("other", "ch44")] == TWO
    )
    assert THREE in tree(into / ".attempts").values()


@pytest.mark.parametrize("at", ["save", "put"])
def test_a_killed_run_is_finished_by_the_next(tmp_path, into, monkeypatch, at):
    first, second = (
        zipped(tmp_path / "1.zip", {"doe_1_5_ch44.ipynb": ONE}),
        zipped(tmp_path / "2.zip", {"doe_1_6_ch44.ipynb": TWO}),
    )
    collect.collect([first], into)
    with monkeypatch.context() as patch:
        real, killed = os.rename, SimpleNamespace(count=0)

        def rename(source, target):
            killed.count += 1
            if killed.count == (2 if at == "save" else 3):
                raise KeyboardInterrupt
            real(source, target)

        patch.setattr(os, "rename", rename)
        with pytest.raises(KeyboardInterrupt):
            collect.collect([second], into)
    collect.collect([second], into)
    assert papers(into) == {("doe", "ch44"): TWO} and ONE in tree(into / ".attempts").values()
    assert [name for name in tree(into) if "/.new-" in name] == []


def test_a_dry_run_says_the_same_and_writes_nothing(tmp_path, into):
    download = zipped(tmp_path / "a.zip", CANVAS)
    dry = collect.collect([download], into, dry_run=True)
    assert not into.exists()
    assert [(e["student"], e["download"]) for e in dry.entries] == [
        (e["student"], e["download"]) for e in collect.collect([download], into).entries
    ]


# --- the best attempt --------------------------------------------------------------------------------------------------------


def test_best_keeps_the_attempt_with_most_points_after_the_penalty_and_judges_each_once(tmp_path, into):
    scores, judged = {ONE: 6.0, TWO: 6.5, THREE: 2.0}, []

    def judge(student, assignment, path):
        content = (path / f"{path.name}.ipynb").read_bytes()
        judged.append(content)
        return SimpleNamespace(status="graded", score=scores[content], flags=())

    files = {
        f"jane+ch44+2026-11-{day} 10:00:00.0 UTC/ch44.ipynb": content for day, content in ((20, ONE), (22, TWO), (23, THREE))
    }
    download = folder(tmp_path / "inbound", files)
    done = collect.collect([download], into, judge=judge, environment=lambda: "e")
    assert papers(into) == {("jane", "ch44"): TWO} and done.entries[0]["attempt"] == 2 and len(judged) == 3
    (tmp_path / "due.yml").write_text(DUE)
    done = collect.collect([download], into, due=tmp_path / "due.yml", judge=judge, environment=lambda: "e")
    assert papers(into) == {("jane", "ch44"): ONE} and done.entries[0]["attempt"] == 1 and len(judged) == 3
    collect.collect([download], into)
    assert papers(into) == {("jane", "ch44"): THREE}
    collect.collect([download], into, judge=judge, environment=lambda: "another")
    assert len(judged) == 6


def test_a_grader_that_fails_chooses_nothing(tmp_path, into):
    files = {f"jane+ch44+2026-11-{day} 10:00:00.0 UTC/ch44.ipynb": content for day, content in ((20, ONE), (22, TWO))}
    download = folder(tmp_path / "inbound", files)
    with pytest.raises(RuntimeError, match="jane/ch44: the grader failed"):
        collect.collect([download], into, judge=lambda *task: SimpleNamespace(status="infra_error", score=0.0, flags=("x",)))
    collect.collect([download], into)
    assert papers(into) == {("jane", "ch44"): TWO} and ONE in tree(into / ".attempts").values()


# --- lateness that nobody can tell -------------------------------------------------------------------------------------------


def test_a_late_mark_without_a_time_is_told_and_names_may_tell_the_time(tmp_path, into):
    (tmp_path / "due.yml").write_text(DUE)
    download = zipped(tmp_path / "a.zip", CANVAS)
    done = collect.collect([download], into, due=tmp_path / "due.yml")
    assert [problem.partition(":")[0] for problem in done.problems] == ["doejohn_LATE_12346_678902_ch44-1.ipynb"]
    (tmp_path / "names.csv").write_text(
        "id,student,submitted_at\n12345,jane,2026-11-20 11:00\n12346,john,2026-11-22T13:00:00Z\n12347,li,soon\n"
    )
    done = collect.collect([download], tmp_path / "timed", names=tmp_path / "names.csv", due=tmp_path / "due.yml")
    entries = by_student(done)
    assert entries["john"]["penalty"] == 0.3 and entries["jane"]["submitted_at"] == "2026-11-20T11:00:00+00:00"
    assert len(done.problems) == 1 and "submitted_at of li: 'soon' is not understood" in done.problems[0]


# --- hostile input -----------------------------------------------------------------------------------------------------------


def hostile(tmp_path, name, content=ONE, mode=None):
    path = zipped(tmp_path / "a.zip", {"good_1_5_ch44.ipynb": ONE})
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        info = zipfile.ZipInfo(name)
        info.compress_type = zipfile.ZIP_DEFLATED
        if mode:
            info.external_attr = mode << 16
        archive.writestr(info, content)
    return path


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("../evil_2_6_ch44.ipynb", "outside its folder"),
        ("/etc/evil_2_6_ch44.ipynb", "outside its folder"),
        ("x\\..\\..\\evil_2_6_ch44.ipynb", "outside its folder"),
        ("C:\\evil_2_6_ch44.ipynb", "outside its folder"),
        ("a/" * 30 + "ch44.ipynb", "folders deep"),
        ("e\x1b[31mvil_2_6_ch44.ipynb", "name that can't be written down"),
    ],
)
def test_names_that_lead_elsewhere_are_refused(tmp_path, into, name, said):
    done = collect.collect([hostile(tmp_path, name)], into)
    assert papers(into) == {("good", "ch44"): ONE} and len(done.problems) == 1 and said in done.problems[0]
    assert "\x1b" not in done.problems[0] and {path.name for path in tmp_path.iterdir()} == {"a.zip", "submitted"}


def test_lines_name_files_as_the_download_does(tmp_path, into):
    inner = hostile(tmp_path, "../../evil.ipynb").read_bytes()
    files = {"canvas.zip/doe_7_7016_x.zip": inner, "canvas.zip/roe_8_7017_y.zip": b"PK no zip", "canvas.zip/what.txt": b""}
    files |= {"moodle/Jo Poe_9_assignsubmission_file_/z.zip": inner, "moodle/Jo Roe_8_assignsubmission_file_z.zip": inner}
    done = collect.collect([folder(tmp_path / "all", files)], into)
    said = sorted(line.partition(": ")[0] for line in done.problems if "no notebook" not in line)
    assert said == [
        "canvas.zip/doe_7_7016_x.zip", "canvas.zip/roe_8_7017_y.zip", "canvas.zip/what.txt",
        "moodle/Jo Poe_9_assignsubmission_file_/z.zip", "moodle/Jo Roe_8_assignsubmission_file_z.zip",
    ]  # fmt: skip


def test_links_in_zips_and_folders_are_not_followed(tmp_path, into):
    done = collect.collect([hostile(tmp_path, "evil_2_6_ch44.ipynb", b"/etc/passwd", 0o120777)], into)
    assert papers(into) == {("good", "ch44"): ONE} and "is a link" in done.problems[0]
    download = folder(tmp_path / "folder", {"good_1_5_ch44.ipynb": ONE})
    (download / "evil_2_6_ch44.ipynb").symlink_to("/etc/passwd")
    (download / "more").symlink_to("/etc")
    os.mkfifo(download / "pipe_3_6_ch44.ipynb")
    done = collect.collect([download], tmp_path / "other")
    assert papers(tmp_path / "other") == {("good", "ch44"): ONE} and len(done.problems) == 3


def test_bombs_are_refused_before_and_while_they_unpack(tmp_path, into, monkeypatch):
    monkeypatch.setattr(archives, "BOMB_BYTES", 1 << 16)
    done = collect.collect([hostile(tmp_path, "evil_2_6_ch44.ipynb", bytes(1 << 20))], into)
    assert papers(into) == {("good", "ch44"): ONE} and "two hundred times" in done.problems[0]
    monkeypatch.setattr(attempts, "MAX_PAPER", 1000)
    done = collect.collect([zipped(tmp_path / "b.zip", {"a_1_5_ch44.ipynb": TWO, "a_1_6_big.bin": os.urandom(5000)})], into)
    assert papers(into)[("a", "ch44")] == TWO and "larger than" in done.problems[0]


def test_a_thousand_bad_names_are_a_few_lines(tmp_path, into):
    files = {"good_1_5_ch44.ipynb": ONE} | {f"../evil{number}": b"" for number in range(1000)}
    done = collect.collect([zipped(tmp_path / "a.zip", files)], into)
    assert papers(into) == {("good", "ch44"): ONE} and len(done.problems) == archives.MAX_TOLD + 1
    assert done.problems[-1] == "a.zip: 980 more of its files are refused"


def test_a_size_that_lies_is_counted(tmp_path):
    entry = archives.Entry("x", 10, lambda: io.BytesIO(bytes(5000)))
    with pytest.raises(archives.Refused, match="larger"):
        archives.read(entry, 1000)


def test_a_table_of_contents_that_would_not_fit_is_refused_unread(tmp_path, into):
    path = zipped(tmp_path / "a.zip", CANVAS)
    content = path.read_bytes()
    at = content.rfind(b"PK\x05\x06")
    path.write_bytes(content[: at + 12] + struct.pack("<I", 1 << 30) + content[at + 16 :])
    with pytest.raises(collect.CollectError, match="more than 100000 entries"):
        collect.collect([path], into)


def test_damaged_zips_and_other_files_are_one_line(tmp_path, into):
    path = zipped(tmp_path / "a.zip", CANVAS)
    content = bytearray(path.read_bytes())
    content[60] ^= 0xFF  # the first member's data
    path.write_bytes(content)
    done = collect.collect([path], into)
    assert len(done.problems) == 1 and ("CRC" in done.problems[0] or "unpack" in done.problems[0] or "read" in done.problems[0])
    (tmp_path / "b.zip").write_bytes(b"Rar!\x1a\x07")
    with pytest.raises(collect.CollectError, match="is no zip"):
        collect.collect([tmp_path / "b.zip"], into)
    files = {"Jane_1_assignsubmission_file_/ch44.zip": b"PK no zip", "John_2_assignsubmission_file_/ch44.ipynb": ONE}
    done = collect.collect([zipped(tmp_path / "c.zip", files)], tmp_path / "other")
    assert papers(tmp_path / "other") == {("John", "ch44"): ONE, ("Jane", "ch44"): None} and len(done.problems) == 2
    assert tree(tmp_path / "other" / "Jane") == {"ch44/ch44.zip": b"PK no zip"}


def test_students_names_from_a_platform_cannot_leave_the_folder(tmp_path, into):
    metadata = 'submission_1:\n  :submitters:\n  - :sid: "../../evil"\n'
    metadata += 'submission_2:\n  :submitters:\n  - :name: ".hidden"\nsubmission_3: [x]\n'
    files = {f"submission_{number}/ch44.ipynb": ONE for number in (1, 2, 3)} | {"submission_metadata.yml": metadata.encode()}
    collect.collect([zipped(tmp_path / "a.zip", files)], into)
    students = [student for student, _ in papers(into)]
    assert len(students) == 3 and all("/" not in student and not student.startswith(".") for student in students)
    assert {path.name for path in tmp_path.iterdir()} == {"a.zip", "submitted"}


def test_assignments_are_those_of_the_course_and_no_paths(tmp_path, into):
    files = {
        "jane+..+2026-11-20 10:00:00 UTC/x.ipynb": ONE,
        "john+ps1+2026-11-20 10:00:00 UTC/ps1.ipynb": TWO,
        "li+CH44+2026-11-20 10:00:00 UTC/CH44.ipynb": THREE,
    }
    done = collect.collect([zipped(tmp_path / "a.zip", files)], into)
    assert papers(into) == {("li", "ch44"): THREE, ("jane", "ch44"): None, ("john", "ch44"): None} and len(done.problems) == 2
    assert {path.name for path in tmp_path.iterdir()} == {"a.zip", "submitted"}


def test_files_in_each_others_way_cost_nobody_else_anything(tmp_path, into):
    work = {"ch44.ipynb": ONE, "a": b"file", "a/b": b"in a folder of its name", "x" * 120 + "/" + "y" * 120: b"long"}
    files = {
        "Jane_1_assignsubmission_file_/w.zip": zipped(tmp_path / "w", work).read_bytes(),
        "John_2_assignsubmission_file_/ch44.ipynb": TWO,
    }
    done = collect.collect([zipped(tmp_path / "a.zip", files)], into)
    assert papers(into) == {("Jane", "ch44"): ONE, ("John", "ch44"): TWO}
    assert len(done.problems) == 1 and "a/b: can't be laid out" in done.problems[0]


def test_a_list_of_who_is_who_that_is_nested_a_million_deep(tmp_path, into):
    files = {"submission_1/ch44.ipynb": ONE, "submission_metadata.yml": b"submission_1: " + b"[" * 1_000_000}
    done = collect.collect([zipped(tmp_path / "a.zip", files)], into)
    assert papers(into) == {("submission_1", "ch44"): ONE} and done.problems[0].endswith("is nested too deeply")
    files["submission_metadata.yml"] = (
        b"submission_1:\n  :submitters:\n  - &1\n    :name: Jane\n  :results: {':name': [{}]}\nsubmission_2:\n  :submitters: [*1]\n"
    )
    done = collect.collect([zipped(tmp_path / "b.zip", files | {"submission_2/ch44.ipynb": TWO})], tmp_path / "other")
    assert not done.problems and papers(tmp_path / "other") == {("Jane", "ch44"): TWO} and done.entries[0]["attempt"] == 2


@pytest.mark.parametrize(
    "name", ["CH44.ipynb", "ch44 (1).ipynb", "Copy of ch44.ipynb", "ch44.ipynb.json", "ch44.ipynb.txt", "CH44.IPYNB"]
)
def test_what_systems_make_of_a_name(tmp_path, into, name):
    assert not collect.collect([zipped(tmp_path / "a.zip", {f"doe_1_5_{name}": ONE})], into).problems
    assert papers(into) == {("doe", "ch44"): ONE} and list(tree(into / "doe")) == ["ch44/ch44.ipynb"]


def test_a_folder_of_submitted_that_is_a_link_is_not_written_through(tmp_path, into):
    into.mkdir()
    (tmp_path / "elsewhere").mkdir()
    (into / "doejane").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(collect.CollectError, match="is a link"):
        collect.collect([zipped(tmp_path / "a.zip", CANVAS)], into)
    assert list((tmp_path / "elsewhere").iterdir()) == []


# --- the command -------------------------------------------------------------------------------------------------------------


def test_the_command_prints_a_table_and_its_exit_status_tells_what_was_not_understood(tmp_path, into):
    run = lambda *arguments: CliRunner().invoke(cli.app, ["collect", *map(str, arguments), "--into", str(into)])  # noqa: E731
    done = run(zipped(tmp_path / "a.zip", CANVAS))
    assert done.exit_code == 0 and "doejohn" in done.output and "3 submissions of 3 students collected into" in done.output
    done = run(zipped(tmp_path / "b.zip", CANVAS | {"what.txt": b""}))
    assert done.exit_code == 4 and "what.txt: is not named as Canvas names files" in done.output
    for arguments, said in (
        (["nowhere"], "there is no such folder or zip"),
        ([tmp_path / "a.zip", "--from", "myplatform"], "take one of canvas"),
        ([tmp_path / "a.zip", "--assignment", "ch4"], "there is no such assignment; take one of ch43"),
        ([into], "lies in what is collected"),
        ([tmp_path / "a.zip", "--due", tmp_path / "no.yml"], "No such file"),
    ):
        wrong = run(*arguments)
        assert wrong.exit_code == 2 and said in wrong.output and len(wrong.output.splitlines()) == 1, wrong.output


def test_a_platform_can_be_named(tmp_path, into):
    download = folder(tmp_path / "a", {"x_1_5_ch44.ipynb": ONE})
    assert collect.collect([download], into, force="canvas").entries[0]["student"] == "x"
    with pytest.raises(collect.CollectError, match=r"nothing was collected: x_1_5_ch44\.ipynb: no platform"):
        collect.collect([download], tmp_path / "other", force="moodle")
    assert not (tmp_path / "other").exists()


def test_damaged_records_are_named_with_a_cure(tmp_path, into):
    download = zipped(tmp_path / "a.zip", CANVAS)
    collect.collect([download], into)
    for path, error in (
        (into / ".collected.json", collect.CollectError),
        (into / ".attempts" / "index.json", attempts.BrokenIndex),
    ):
        content = path.read_text()
        path.write_text(json.dumps({"schema": 9}))
        with pytest.raises(error, match="move it away and collect again"):
            collect.collect([download], into)
        path.write_text(content)


def test_the_record_is_strict_and_complete(tmp_path, into):
    collect.collect([zipped(tmp_path / "a.zip", CANVAS)], into)
    document = json.loads((into / ".collected.json").read_text(), parse_constant=pytest.fail)
    keys = {"student", "assignment", "platform", "platform_id", "name", "login", "download"}
    keys |= {"attempt", "submitted_at", "late_seconds", "penalty"}
    assert document["schema"] == 1 and all(set(entry) == keys for entry in document["entries"])
