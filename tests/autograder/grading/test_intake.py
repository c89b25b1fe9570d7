"""Submissions of every kind are read without following, trusting or raising."""

import json
import os
import subprocess

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_notebook

from autograder.grading import files, intake
from autograder.grading.verdicts import plain_name

GOOD = new_notebook(cells=[new_code_cell("a = 1", metadata={"nbgrader": {"grade_id": "f"}})])


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "alice" / "ch44"
    folder.mkdir(parents=True)
    return folder


def put(folder, content):
    data = content if isinstance(content, bytes) else content.encode()
    (folder / "ch44.ipynb").write_bytes(data)
    return intake.read("alice", "ch44", folder)


def test_a_notebook_is_read(folder):
    submission = put(folder, nbformat.writes(GOOD))
    assert submission.problem == "" and submission.notebook.cells[0].source == "a = 1"
    assert intake.grade_ids(submission.notebook) == {"f": 1}


def test_a_byte_order_mark_and_nbformat_3_are_converted(folder):
    assert put(folder, "\ufeff" + nbformat.writes(GOOD)).problem == ""
    old = nbformat.v3.new_notebook(worksheets=[nbformat.v3.new_worksheet(cells=[nbformat.v3.new_code_cell("b = 2")])])
    assert put(folder, json.dumps(old)).notebook.cells[0].source == "b = 2"


@pytest.mark.parametrize(
    "content",
    [
        "", "null", "[]", "3", "{}", '{"cells": 1}', '{"cells": [1]}', '{"cells": [{}]}', '{"cells": [{"cell_type": "code"}]}', "{" * 9,
        "[" * 200_000, b"\xff\xfe\x00", '{"nbformat": 3}', '{"nbformat": "x", "cells": []}', '{"nbformat": 1e999, "cells": 4}',
        '{"cells": [{"cell_type": "code", "source": [1, 2]}]}', "9" * 10_000,
    ],
)  # fmt: skip
def test_a_malformed_notebook_is_a_problem_not_an_exception(folder, content):
    submission = put(folder, content)
    assert submission.notebook is None and submission.problem


@pytest.mark.parametrize("metadata", [None, 3, [], {"nbgrader": 3}, {"nbgrader": {"grade_id": 7}}, {"tags": 5}])
def test_strange_metadata_is_dropped(folder, metadata):
    cell = {"cell_type": "code", "source": "a = 1", "metadata": metadata}
    submission = put(folder, json.dumps({"nbformat": 4, "cells": [cell]}))
    assert submission.problem == "" and intake.grade_ids(submission.notebook) == {}


def test_a_missing_notebook_names_what_was_found(folder):
    (folder / "homework.ipynb").write_text("{}")
    assert "found: homework.ipynb" in intake.read("alice", "ch44", folder).problem


def test_links_folders_and_pipes_are_no_notebooks(folder):
    secret = folder.parent.parent / "secret.ipynb"
    secret.write_text(nbformat.writes(GOOD))
    path = folder / "ch44.ipynb"
    path.symlink_to(secret)
    assert "is a link" in intake.read("alice", "ch44", folder).problem
    path.unlink()
    path.mkdir()
    assert intake.read("alice", "ch44", folder).problem
    path.rmdir()
    os.mkfifo(path)
    assert "not a regular file" in intake.read("alice", "ch44", folder).problem


def test_a_linked_folder_is_refused(tmp_path, folder):
    put(folder, nbformat.writes(GOOD))
    link = tmp_path / "mallory" / "ch44"
    link.parent.mkdir()
    link.symlink_to(folder)
    assert "is a link" in intake.read("mallory", "ch44", link).problem
    assert ("mallory", "ch44", link) in intake.survey(tmp_path, ()).tasks


def test_a_huge_notebook_is_refused_unread(folder):
    with open(folder / "ch44.ipynb", "wb") as file:
        file.truncate(intake.MAX_RAW + 1)
    assert "larger than" in intake.read("alice", "ch44", folder).problem


def test_regular_files_beside_it_are_kept_and_links_are_flagged(folder):
    put(folder, nbformat.writes(GOOD))
    (folder / "data").mkdir()
    (folder / "data" / "x.csv").write_text("1")
    (folder / "helper.py").write_text("")
    (folder / "passwd").symlink_to("/etc/passwd")
    (folder / "loop").symlink_to(folder)
    submission = intake.read("alice", "ch44", folder)
    assert sorted(submission.files) == ["data/x.csv", "helper.py"]
    assert len(submission.flags) == 2 and all("ignored_file" in flag for flag in submission.flags)


def test_too_many_files_are_left_out_and_flagged(folder):
    put(folder, nbformat.writes(GOOD))
    for number in range(intake.MAX_SIDE_FILES + 5):
        (folder / f"{number}.txt").write_text("")
    submission = intake.read("alice", "ch44", folder)
    assert len(submission.files) == intake.MAX_SIDE_FILES and "ignored_files" in submission.flags[0]


def test_a_tree_without_end_is_left(folder):
    put(folder, nbformat.writes(GOOD))
    (folder / "z.txt").write_text("")
    here = os.open(folder, os.O_RDONLY)
    for _ in range(3000):  # deeper than Python recurses and than a path can be long
        os.mkdir("d", dir_fd=here)
        here, above = os.open("d", os.O_RDONLY, dir_fd=here), here
        os.close(above)
    os.close(here)
    submission = intake.read("alice", "ch44", folder)
    assert list(submission.files) == ["z.txt"] and "too deep" in submission.flags[0]
    subprocess.run(["rm", "-r", folder / "d"], check=True)  # shutil, and with it pytest, would recurse


def test_a_long_name_in_a_deep_folder_is_ignored_and_flagged(folder):
    put(folder, nbformat.writes(GOOD))
    deep = folder.joinpath(*["d" * 200] * 5)
    deep.mkdir(parents=True)
    (deep / "x").write_text("")
    submission = intake.read("alice", "ch44", folder)
    assert not submission.files and "too deep" in submission.flags[0]


def test_more_entries_than_anybody_needs_are_not_counted(folder, monkeypatch):
    monkeypatch.setattr(files, "MAX_ENTRIES", 10)
    put(folder, nbformat.writes(GOOD))
    for number in range(20):
        (folder / f"folder{number}").mkdir()
    assert "entries" in intake.read("alice", "ch44", folder).flags[0]


def test_an_unreadable_file_is_ignored_and_flagged(folder, monkeypatch):
    put(folder, nbformat.writes(GOOD))
    (folder / "x").touch()
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # for root, no mode of the file would do
    assert "unreadable" in intake.read("alice", "ch44", folder).flags[0]


def test_too_many_cells_are_refused(folder):
    cells = [{"cell_type": "raw", "source": ""}] * (intake.MAX_CELLS + 1)
    assert "cells" in put(folder, json.dumps({"nbformat": 4, "cells": cells})).problem


@pytest.mark.parametrize("name", ["two\nlines", "tab\t", b"latin-\xe9".decode(errors="surrogateescape"), "x" * 255])
def test_a_name_that_no_file_of_ours_can_have_is_replaced(tmp_path, name):
    (tmp_path / name / name).mkdir(parents=True)
    [(student, assignment, folder)] = intake.survey(tmp_path, ()).tasks
    assert plain_name(student) == student == assignment and folder == tmp_path / name / name


def test_discovery_ignores_dots_and_files(tmp_path, folder):
    (tmp_path / ".git" / "ch44").mkdir(parents=True)
    (tmp_path / "alice" / ".ipynb_checkpoints").mkdir()
    (tmp_path / "notes.txt").write_text("")
    assert intake.survey(tmp_path, ()).tasks == [("alice", "ch44", folder)]
