"""The notebook of a submission is found under the names that systems and people give it, if only one file can be meant."""

import io
import json
import os
import stat
import struct
import unicodedata
import zipfile

import pytest

from autograder.grading import archives, files, intake

KNOWN = ("ch43", "ch44")


def notebook(source="a = 1"):
    return json.dumps({"nbformat": 4, "cells": [{"cell_type": "code", "source": source, "metadata": {}}]}).encode()


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "ada" / "ch44"
    folder.mkdir(parents=True)
    return folder


def put(path, content=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(notebook() if content is None else content)


def zipped(entries):
    """An archive with these (name or ZipInfo, content)."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries:
            archive.writestr(name, content)
    return buffer.getvalue()


def read(folder):
    return intake.read("ada", "ch44", folder)


# -------------------------------------------------------------------------------- one file


@pytest.mark.parametrize(
    "name",
    [
        "Copy of ch44.ipynb", "Kopie von ch44.ipynb", "Copie de ch44.ipynb", "Copia de ch44.ipynb", "Cópia de ch44.ipynb",
        "ch44 - Copy.ipynb",
        "ch44-Copy1.ipynb", "ch44 (1).ipynb", "ch44(2).ipynb", "ch44 2.ipynb", "ch44_final.ipynb", "Ada_ch44.ipynb", "ch44-ada-v2.ipynb",
        "ch44.ipynb.json", "ch44.ipynb.txt", "ch44.json", "ch44 (1).json", "ch44.ipynb.ipynb", "ch44.ipynb (1).json", "ch44.IPYNB",
        "CH44.ipynb",
        " ch44.ipynb", "ch44 .ipynb", "ch44/ch44.ipynb", "ch44/Copy of ch44.ipynb", "a/b/ch44.ipynb",
    ],
)  # fmt: skip
def test_the_only_candidate_counts_and_is_named(folder, name):
    put(folder / name)
    submission = read(folder)
    assert (submission.problem, submission.flags) == ("", [f"found_as: {name}"])
    assert submission.notebook.cells[0].source == "a = 1" and submission.folder == (folder / name).parent
    assert not submission.files  # the notebook is none


@pytest.mark.parametrize("name", ["ch440.ipynb", "xch44.ipynb", "homework.ipynb"])
def test_a_name_without_the_assignment_gives_way_to_one_with_it(folder, name):
    put(folder / name, notebook("b = 2"))
    put(folder / "my ch44.ipynb")
    assert read(folder).flags == ["found_as: my ch44.ipynb"]


@pytest.mark.parametrize("name", ["homework.ipynb", "Untitled1.ipynb", "ch440.ipynb", "ch43.ipynb"])
def test_a_name_that_says_nothing_of_the_assignment_is_named_and_not_taken(folder, name):
    put(folder / name)
    submission = read(folder)
    assert (
        submission.notebook is None
        and submission.problem == f"There is no notebook ch44.ipynb in the submission (found: {name})."
    )


def test_two_candidates_are_both_named(folder):
    put(folder / "ch44 (1).ipynb")
    put(folder / "ch44 (2).ipynb", notebook("b = 2"))
    submission = read(folder)
    assert submission.notebook is None and "ch44 (1).ipynb, ch44 (2).ipynb" in submission.problem


def test_candidates_of_the_same_bytes_are_one(folder):
    put(folder / "ch44 (1).ipynb")
    put(folder / "ch44 (2).ipynb")
    assert read(folder).flags == ["found_as: ch44 (1).ipynb"]


def test_the_right_name_counts_and_others_are_said(folder):
    put(folder / "ch44.ipynb")
    put(folder / "ch44 (1).ipynb", notebook("b = 2"))
    put(folder / "ch44 (2).ipynb")  # the same bytes
    put(folder / "ch44.new.ipynb", notebook("b = 3"))  # a later release
    submission = read(folder)
    assert submission.notebook.cells[0].source == "a = 1" and submission.flags == ["also_there: ch44 (1).ipynb (not graded)"]


def test_the_right_name_in_a_deeper_folder_counts_before_others(folder):
    put(folder / "ch44" / "ch44.ipynb")
    put(folder / "old ch44.ipynb", notebook("b = 2"))
    assert read(folder).flags == ["found_as: ch44/ch44.ipynb"]


@pytest.mark.parametrize(
    "junk",
    [".ipynb_checkpoints/ch44-checkpoint.ipynb", "__MACOSX/._ch44.ipynb", "._ch44.ipynb", ".git/ch44.ipynb", "venv/ch44.ipynb"],
)
def test_what_systems_leave_is_no_candidate(folder, junk):
    if junk.startswith("venv"):
        put(folder / "venv" / "pyvenv.cfg", b"")
    put(folder / junk, b"\0\5\x16\7")
    assert "There is no notebook ch44.ipynb" in read(folder).problem


def test_a_linked_candidate_is_none(tmp_path, folder):
    put(tmp_path / "secret.ipynb")
    (folder / "ch44 (1).ipynb").symlink_to(tmp_path / "secret.ipynb")
    assert read(folder).notebook is None


def test_what_is_found_and_no_notebook_is_named(folder):
    put(folder / "ch44 (1).ipynb", b"<html>")
    assert read(folder).problem.startswith("ch44 (1).ipynb: The file is a web page")


# -------------------------------------------------------------------------------- archives


@pytest.mark.parametrize("name", ["ch44/ch44.ipynb", "ch44.ipynb", "deep/er/Copy of ch44.ipynb", "ch44\\ch44.ipynb"])
def test_a_notebook_in_an_archive_is_found(folder, name):
    put(folder / "ch44.zip", zipped([(name, notebook()), ("__MACOSX/ch44/._ch44.ipynb", b"\0\5\x16\7")]))
    submission = read(folder)
    assert submission.problem == "" and submission.flags[0].startswith("found_as: ch44.zip/")
    assert submission.notebook.cells[0].source == "a = 1"


def test_files_beside_it_in_the_archive_are_files_beside_it(folder):
    entries = [("ch44/ch44.ipynb", notebook()), ("ch44/helpers.py", b"h"), ("ch44/data/x.csv", b"1"), ("other.py", b"")]
    put(folder / "ch44.zip", zipped(entries))
    submission = read(folder)
    assert {name: path.read_bytes() for name, path in submission.files.items()} == {"helpers.py": b"h", "data/x.csv": b"1"}


def test_what_was_unpacked_goes_with_the_submission(folder):
    put(folder / "ch44.zip", zipped([("ch44.ipynb", notebook()), ("a.py", b"")]))
    submission = read(folder)
    [path] = submission.files.values()
    assert path.is_file()
    del submission
    assert not path.exists()


def test_a_file_outside_counts_before_an_archive(folder):
    put(folder / "Copy of ch44.ipynb")
    put(folder / "ch44.zip", zipped([("ch44.ipynb", notebook("b = 2"))]))
    submission = read(folder)
    assert submission.flags == ["found_as: Copy of ch44.ipynb"] and list(submission.files) == ["ch44.zip"]


def test_two_notebooks_in_archives_are_named(folder):
    put(folder / "a.zip", zipped([("ch44 one.ipynb", notebook()), ("ch44 two.ipynb", notebook("b = 2"))]))
    assert "a.zip/ch44 one.ipynb, a.zip/ch44 two.ipynb" in read(folder).problem


def _link(name, target):
    info = zipfile.ZipInfo(name)
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return info, target


@pytest.mark.parametrize(
    "evil",
    [("../evil.py", b"x"), ("/tmp/evil.py", b"x"), ("a/../../evil.py", b"x"), ("C:/evil.py", b"x"), ("..\\evil.py", b"x"),
     _link("evil.py", b"/etc/passwd")],
    ids=["parent", "absolute", "inside", "drive", "backslash", "link"],
)  # fmt: skip
def test_names_and_links_that_lead_out_of_an_archive_are_left_in_it(tmp_path, folder, evil):
    put(folder / "ch44.zip", zipped([("ch44.ipynb", notebook()), evil]))
    submission = read(folder)
    assert submission.notebook is not None and not submission.files
    assert submission.flags[1] == "ignored_files: 1 in the archive (links, odd names, or too large)"
    assert not list(tmp_path.rglob("evil.py"))


def test_a_linked_notebook_in_an_archive_is_none(folder):
    put(folder / "ch44.zip", zipped([_link("ch44.ipynb", b"/etc/passwd")]))
    assert "ch44.zip holds none either" in read(folder).problem


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_entries_of_one_name_are_none(folder):
    put(folder / "ch44.zip", zipped([("ch44.ipynb", notebook()), ("ch44.ipynb", notebook("b = 2"))]))
    assert read(folder).notebook is None


def test_a_file_and_a_folder_of_one_name_harm_nothing(folder):
    put(folder / "ch44.zip", zipped([("ch44.ipynb", notebook()), ("a", b"1"), ("a/b", b"2")]))
    submission = read(folder)
    assert submission.notebook is not None and list(submission.files) == ["a"]


def test_a_bomb_is_refused_at_its_limit(folder, monkeypatch):
    monkeypatch.setattr("autograder.grading.reading.MAX_RAW", 1 << 20)
    put(folder / "ch44.zip", zipped([("ch44.ipynb", b"0" * (3 << 20))]))
    assert "holds a file of more than 1 MB" in read(folder).problem


def test_a_bomb_that_lies_about_its_size_is_refused_at_its_limit():
    content = zipped([("ch44.ipynb", b"0" * (3 << 20))]).replace(struct.pack("<L", 3 << 20), struct.pack("<L", 10))
    archive = archives.Archive(content)
    with pytest.raises(archives.BadArchive):
        archive.read(archive.entries["ch44.ipynb"], 1 << 20)


def test_files_of_an_archive_share_one_limit(folder, monkeypatch):
    monkeypatch.setattr("autograder.grading.found.MAX_SIDE_BYTES", 1000)
    put(folder / "ch44.zip", zipped([("ch44.ipynb", notebook()), *((f"{i}.txt", b"0" * 400) for i in range(5))]))
    submission = read(folder)
    assert len(submission.files) == 2 and "ignored_files: 3 in the archive" in submission.flags[1]


def test_an_archive_of_too_many_entries_is_not_listed(folder, monkeypatch):
    monkeypatch.setattr(archives, "MAX_ENTRIES", 50)
    put(folder / "ch44.zip", zipped([("ch44.ipynb", notebook()), *((str(i), b"") for i in range(60))]))
    assert "more than 50 entries" in read(folder).problem


@pytest.mark.parametrize(
    "content",
    [b"", b"PK\x03\x04", b"PK\x05\x06" + b"\0" * 18, b"PK\x06\x07" + b"\0" * 16 + b"PK\x05\x06" + b"\xff" * 16 + b"\0\0", b"x" * 100,
     zipped([("ch44.ipynb", notebook())])[:-10], zipped([("ch44.ipynb", notebook())]).replace(b"PK\x01\x02", b"PK\x01\x03")],
    ids=["empty", "head", "nothing", "zip64", "text", "truncated", "directory"],
)  # fmt: skip
def test_a_damaged_archive_is_a_problem_not_an_exception(folder, content):
    put(folder / "ch44.zip", content)
    assert "There is no notebook ch44.ipynb in the submission (ch44.zip " in read(folder).problem


def test_an_encrypted_archive_is_named(folder):
    content = bytearray(zipped([("ch44.ipynb", notebook())]))
    content[6] |= 1
    content[content.find(b"PK\x01\x02") + 8] |= 1
    put(folder / "ch44.zip", bytes(content))
    assert "is encrypted" in read(folder).problem


def test_a_wrong_checksum_is_named(folder):
    content = zipped([("ch44.ipynb", notebook())])
    at = content.find(b"PK\x01\x02") + 16
    put(folder / "ch44.zip", content[:at] + b"\0\0\0\0" + content[at + 4 :])
    assert "damaged zip archive" in read(folder).problem


# -------------------------------------------------------------------------------- files beside it


@pytest.mark.parametrize(
    "name", [".venv", ".git", "node_modules", "__pycache__", ".ipynb_checkpoints", "wandb", "env", "datasets", "a"]
)
def test_a_helper_is_there_whatever_lies_before_it(folder, name):
    put(folder / "ch44.ipynb")
    put(folder / "zz_helpers.py", b"")
    if name == "env":
        put(folder / name / "pyvenv.cfg", b"")
    for number in range(300):
        put(folder / name / "lib" / f"m{number}.py", b"")
    submission = read(folder)
    assert "zz_helpers.py" in submission.files
    assert bool(submission.flags) == (name in ("datasets", "a"))  # what may be meant is counted, and said


def test_modules_come_before_data(folder):
    put(folder / "ch44.ipynb")
    put(folder / "zz_helpers.py", b"")
    for number in range(files.MAX_SIDE_FILES + 5):
        put(folder / f"{number}.png", b"")
    assert "zz_helpers.py" in read(folder).files


# -------------------------------------------------------------------------------- a class


def survey(tmp_path):
    return intake.survey(tmp_path, KNOWN)


@pytest.mark.parametrize("name", ["CH44", "Ch44", "ch44 ", "ch44.", "ch44 (1)", "ch44 - Copy", "Copy of ch44", "ch44_1"])
def test_a_folder_that_can_only_mean_an_assignment_is_that(tmp_path, name):
    put(tmp_path / "ada" / name / "ch44.ipynb")
    [(student, assignment, folder)] = survey(tmp_path).tasks
    assert (student, assignment) == ("ada", "ch44") and not survey(tmp_path).left_over
    submission = intake.read(student, assignment, folder)
    assert submission.problem == "" and submission.flags == [f"found_as: {name}/ch44.ipynb"]


@pytest.mark.parametrize("name", ["ch4", "ch440", "ch443", "homework", "ch44ch43"])
def test_a_folder_that_means_no_assignment_keeps_its_name(tmp_path, name):
    put(tmp_path / "ada" / name / "x.ipynb")
    assert survey(tmp_path).tasks == [("ada", name, tmp_path / "ada" / name)]


def test_a_second_folder_for_one_assignment_is_named(tmp_path):
    put(tmp_path / "ada" / "ch44" / "ch44.ipynb")
    put(tmp_path / "ada" / "CH44" / "ch44.ipynb", notebook("b = 2"))
    seen = survey(tmp_path)
    assert [task[:2] for task in seen.tasks] == [("ada", "CH44"), ("ada", "ch44")]  # each gets a verdict
    assert len(seen.left_over) == 1 and "ada/CH44: may be meant as ch44, but so is ada/ch44" in seen.left_over[0]


def _two_forms(tmp_path, second):
    composed, decomposed = (unicodedata.normalize(form, "zoë") for form in ("NFC", "NFD"))
    put(tmp_path / composed / "ch44" / "ch44.ipynb")
    put(tmp_path / decomposed / "ch44" / "ch44.ipynb", second)
    return composed


def test_two_forms_of_one_name_are_one_student(tmp_path):
    composed = _two_forms(tmp_path, notebook())
    seen = survey(tmp_path)
    assert seen.tasks == [(composed, "ch44", tmp_path / composed / "ch44")] and not seen.left_over


def test_two_submissions_under_two_forms_of_one_name_are_said(tmp_path):
    composed = _two_forms(tmp_path, notebook("b = 2"))
    seen = survey(tmp_path)
    assert [task[:2] for task in seen.tasks] == [(composed, "ch44")]
    assert len(seen.left_over) == 1 and "a second ch44 of the same student" in seen.left_over[0]


def test_two_forms_of_one_name_may_hold_two_assignments(tmp_path):
    composed, decomposed = (unicodedata.normalize(form, "zoë") for form in ("NFC", "NFD"))
    put(tmp_path / composed / "ch44" / "ch44.ipynb")
    put(tmp_path / decomposed / "ch43" / "ch43.ipynb")
    seen = survey(tmp_path)
    assert [task[:2] for task in seen.tasks] == [(composed, "ch43"), (composed, "ch44")] and not seen.left_over


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("bob/ch44.ipynb", "bob/ch44.ipynb: a notebook outside an assignment's folder; expected bob/ch44/ch44.ipynb"),
        ("bob/Copy of ch43.ipynb", "expected bob/ch43/ch43.ipynb"),
        ("bob_ch44.ipynb", "bob_ch44.ipynb: a notebook outside an assignment's folder; expected STUDENT/ch44/ch44.ipynb"),
        ("bob.zip", "bob.zip: an archive outside an assignment's folder; unpack it"),
        ("bob/ch44.zip", "bob/ch44.zip: an archive outside"),
        ("ada/utils.py", "ada/utils.py: outside an assignment's folder, where no notebook finds it"),
        ("roster.csv", "roster.csv: a file beside the students' folders"),
        ("ch44/ch44.ipynb", "ch44/ch44.ipynb: an assignment's folder where a student's is expected"),
        ("release/.release.json", "release: an empty folder"),
        ("bob/homework/ch44/ch44.ipynb", "bob/homework: no assignment, but it holds ch44; expected bob/ch44/ch44.ipynb"),
    ],
)  # fmt: skip
def test_nothing_is_skipped_without_a_line(tmp_path, path, says):
    put(tmp_path / "ada" / "ch44" / "ch44.ipynb")
    put(tmp_path / path)
    seen = survey(tmp_path)
    assert len(seen.left_over) == 1 and says in seen.left_over[0] and not seen.wrong_level
    assert ("ada", "ch44", tmp_path / "ada" / "ch44") in seen.tasks


def test_an_empty_student_and_a_broken_link_are_said(tmp_path):
    put(tmp_path / "ada" / "ch44" / "ch44.ipynb")
    (tmp_path / "bob").mkdir()
    (tmp_path / "eve").symlink_to(tmp_path / "nowhere")
    assert [line.split(":")[0] for line in survey(tmp_path).left_over] == ["bob", "eve"]


@pytest.mark.parametrize(
    "junk", ["__MACOSX/ada/._ch44.ipynb", "ada/__MACOSX/._x", ".DS_Store", "ada/.DS_Store", "Thumbs.db", ".git/x/y", "._ada"]
)
def test_what_systems_leave_is_no_submission_and_no_line(tmp_path, junk):
    put(tmp_path / "ada" / "ch44" / "ch44.ipynb")
    put(tmp_path / junk, b"")
    seen = survey(tmp_path)
    assert [task[:2] for task in seen.tasks] == [("ada", "ch44")] and not seen.left_over


def _bundle(folder, content=b"{}"):
    import hashlib

    put(folder / "ch44" / "ch44.ipynb", content)
    put(folder / "course_lib" / "course_lib" / "__init__.py", b"")
    hashes = {"ch44/ch44.ipynb": [hashlib.sha256(b"{}").hexdigest()]}
    put(folder / ".release.json", json.dumps({"notebooks": hashes}).encode())


def test_a_bundle_is_no_student_unless_somebody_has_worked_in_it(tmp_path):
    put(tmp_path / "ada" / "ch44" / "ch44.ipynb")
    _bundle(tmp_path / "release")
    _bundle(tmp_path / "bob", notebook())
    seen = survey(tmp_path)
    assert {student for student, _, _ in seen.tasks} == {"ada", "bob"} and "release: the bundle" in seen.left_over[0]


def test_what_the_grader_wrote_is_no_student(tmp_path):
    put(tmp_path / "ada" / "ch44" / "ch44.ipynb")
    put(tmp_path / "grades" / "gradebook.db", b"")
    put(tmp_path / "grades" / "verdicts" / "x" / "ch44.json", b"")
    seen = survey(tmp_path)
    assert [student for student, _, _ in seen.tasks] == ["ada"] and "grades: what `course grade` wrote" in seen.left_over[0]


@pytest.mark.parametrize("level", ["bundle", "student", "above", "project"])
def test_the_wrong_level_is_said_and_nothing_graded(tmp_path, level):
    put(tmp_path / "submitted" / "ada" / "ch44" / "ch44.ipynb")
    if level == "project":
        _bundle(tmp_path / "release")
    _bundle(tmp_path / "alone" / "release")
    where = {"bundle": "alone/release", "student": "submitted/ada", "above": ".", "project": "."}[level]
    seen = survey(tmp_path / where)
    assert seen.wrong_level or not seen.tasks
    assert seen.left_over and any("bundle" in line or "grade" in line for line in seen.left_over)


def test_names_of_files_are_shown_on_one_line_and_in_number(tmp_path, monkeypatch):
    from autograder import grade

    put(tmp_path / "ada" / "ch44" / "ch44.ipynb")
    for number in range(intake.SHOWN + 5):
        put(tmp_path / f"two\nlines {number}")
    lines = []
    monkeypatch.setattr(grade.judge, "assignments", lambda: frozenset(KNOWN))
    grade._tasks(tmp_path, lines.append)
    assert len(lines) == intake.SHOWN + 1 and "\n" not in "".join(lines) and lines[-1] == "… and 5 more"


def test_an_unreadable_folder_is_no_exception(tmp_path, monkeypatch):
    put(tmp_path / "ada" / "ch44" / "ch44.ipynb")
    real = os.scandir

    def scandir(path):
        if str(path).endswith("ada"):
            raise PermissionError(13, "Permission denied")
        return real(path)

    monkeypatch.setattr(os, "scandir", scandir)
    assert survey(tmp_path).left_over
