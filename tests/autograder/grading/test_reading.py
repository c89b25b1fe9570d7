"""Notebooks of every encoding and version are read without their outputs; everything else gets a sentence of its own, soon."""

import json
import time

import nbformat
import pytest
from nbformat import v2, v3

from autograder.grading import reading

VIDEO = {
    "output_type": "display_data",
    "metadata": {},
    "data": {"text/html": "<video src='data:video/mp4;base64," + "A" * (21 << 20) + "'>"},
}


def document(**cell):
    whole = {"cell_type": "code", "source": ["é = 1\n", "b = '😀'"], "metadata": {}, "outputs": [], "execution_count": None}
    return {"nbformat": 4, "nbformat_minor": 5, "metadata": {}, "cells": [whole | cell]}


def sources(content):
    return [cell.source for cell in reading.read(content).notebook.cells]


def refusal(content):
    with pytest.raises(reading.BadNotebook) as caught:
        reading.read(content)
    return str(caught.value)


@pytest.mark.parametrize(
    "encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-le", "utf-32-be"]
)
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_every_encoding_of_unicode_is_read(encoding, newline):
    text = json.dumps(document(), ensure_ascii=False, indent=1).replace("\n", newline)
    assert sources(text.encode(encoding)) == ["é = 1\nb = '😀'"]


@pytest.mark.parametrize("encoding", ["latin-1", "cp1252"])
def test_other_encodings_are_named_with_the_place(encoding):
    text = json.dumps(document(source="# größer"), ensure_ascii=False, indent=1)
    assert "not UTF-8 text (byte 0xF6 in line 8, as in Latin-1" in refusal(text.encode(encoding))


@pytest.mark.parametrize("indent", [None, 1])
@pytest.mark.parametrize("where", [{"outputs": [VIDEO]}, {"attachments": {"a.png": {"image/png": "A" * (21 << 20)}}}])
def test_a_video_in_the_outputs_costs_nothing(indent, where):
    assert sources(json.dumps(document(**where), indent=indent).encode()) == ["é = 1\nb = '😀'"]


def test_outputs_of_many_lines_quotes_and_brackets_are_passed():
    outputs = [{"text": ["a\n"] * 200_000}, {"data": {"x": [[1.5, {"y": []}]] * 20_000}}, {"text": '\\"]}{[\\' * 100_000}]
    assert sources(json.dumps(document(outputs=outputs)).encode()) == ["é = 1\nb = '😀'"]


def test_a_source_that_speaks_of_outputs_is_kept():
    text = 'x = {"outputs": [1, 2], "attachments": {}}\n# \\"outputs\\": ['
    assert sources(json.dumps(document(source=text)).encode()) == [text]


def test_the_limit_holds_for_what_is_left():
    assert "without its outputs" in refusal(json.dumps(document(source="#" * (21 << 20))).encode())


@pytest.mark.parametrize(
    "content",
    [
        b'{"cells":[' + b"[]," * 2_000_000 + b"1]}",
        b'{"cells":[' + b"1," * 2_000_000 + b"1]}",
        b'{"cells":[' + b'"outputs":[' * 500_000,
        b'{"cells":[{"outputs":' + b"[" * 4_000_000,
        b'{"cells":[{"outputs":[' + b"[]," * 4_000_000 + b"1]}]}",
        b'{"cells":' + b"[" * 200_000 + b"]" * 200_000 + b"}",
        b'{"cells":["' + b"\\" * 5_000_000,
        b"{" + b'"' * 5_000_000,
        b"{" + b'"a":1,' * 1_500_000 + b'"b":1}',
        b'{"cells": 1e999999, "nbformat": ' + b"9" * 100_000 + b"}",
    ],
    ids=["lists", "numbers", "outputs", "deep_outputs", "wide_outputs", "deep", "backslashes", "quotes", "keys", "huge_number"],
)
def test_a_hostile_document_is_refused_soon(content):
    start = time.process_time()
    assert refusal(content)
    assert time.process_time() - start < 10


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is empty (0 bytes)"),
        (b" \n\n ", "nothing but blanks"),
        (b"\0" * 5000, "nothing but zero bytes"),
        (b"<!DOCTYPE html>\n<html><head></head></html>", "is a web page (HTML)"),
        (b"\xef\xbb\xbf\n<html>", "is a web page (HTML)"),
        ("<html>".encode("utf-16"), "is a web page (HTML)"),
        (b"%PDF-1.7\n", "is a PDF"),
        (b"\x89PNG\r\n\x1a\n", "is a picture"),
        (b"PK\x03\x04 word/document.xml", "is a Word file"),
        (b"PK\x03\x04 x", "is a zip archive"),
        (b"\x1f\x8b", "compressed archive (gzip)"),
        (b"\0\5\x16\7\0\2", "what macOS keeps beside a file"),
        (b"import torch\n\ndef f(x):\n    return x\n", "is a Python script"),
        (b"# %%\nx = 1\n", "is a Python script"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "is a pointer of Git LFS"),
        (b"Dear teacher,\n", "is not a notebook"),
        (b'{"error": {"code": 404}}', "has no list of cells"),
        (b"[1, 2]", "JSON but no notebook"),
        (b'{"nbformat": 5, "cells": []}', "nbformat 5"),
        (json.dumps(document(), indent=1).encode()[:-30], "ends in the middle"),
        (json.dumps(document(outputs=[VIDEO])).encode()[: 20 << 20], "ends in the middle"),
        (json.dumps(document(), indent=1).replace('"source"', '<<<<<<< HEAD\n"source"').encode(), "merge conflict (line 8)"),
        (json.dumps(document()).replace("],", "] ", 1).encode(), "is not valid JSON (line 1)"),
    ],
)  # fmt: skip
def test_what_is_no_notebook_is_told_what_it_is(content, says):
    assert says in refusal(content)


def test_nbformat_3_with_a_heading_is_converted_as_it_stands_in_the_file():
    cells = [v3.new_heading_cell("Head"), v3.new_code_cell("a = 1\nb = 2"), v3.new_text_cell("markdown", "one\ntwo")]
    cells[1].metadata = {"nbgrader": {"grade_id": "f", "solution": True}}
    content = v3.nbjson.writes(v3.new_notebook(worksheets=[v3.new_worksheet(cells=cells)])).encode()
    assert b'"a = 1\\n",' in content  # a list of lines
    notebook = reading.read(content).notebook
    assert [cell.source for cell in notebook.cells] == ["# Head", "a = 1\nb = 2", "one\ntwo"]
    assert notebook.cells[1].metadata.nbgrader.grade_id == "f" and "id" not in notebook.cells[1]


def test_nbformat_2_is_converted():
    cells = [v2.new_code_cell("a = 1\nb = 2"), v2.new_text_cell("markdown", "one")]
    content = v2.nbjson.writes(v2.new_notebook(worksheets=[v2.new_worksheet(cells=cells)])).encode()
    assert sources(content) == ["a = 1\nb = 2", "one"]


@pytest.mark.parametrize("broken", [{"source": None}, {"source": 3}, {"source": [1]}, {"cell_type": None}, {"cell_type": 4}])
def test_a_broken_cell_costs_itself_alone(broken):
    whole = document()
    whole["cells"].append(whole["cells"][0] | broken)
    one = reading.read(json.dumps(whole).encode())
    assert len(one.notebook.cells) == 1 and one.flags == ["ignored_cells: 1 of 2 have no type or source"]


@pytest.mark.parametrize("odd", [
    {"metadata": []}, {"metadata": None}, {"metadata": {"nbgrader": []}}, {"metadata": {"nbgrader": {"grade_id": ["f"]}, "tags": {}}},
    {"cell_type": "heading"}, {"id": 5}, {"outputs": None}, {"outputs": {"a": 1}}, {"attachments": []}, {"execution_count": "x"},
])  # fmt: skip
def test_an_odd_cell_is_read(odd):
    assert sources(json.dumps(document(**odd)).encode()) == ["é = 1\nb = '😀'"]


@pytest.mark.parametrize(("metadata", "named"), [
    ({"kernelspec": {"language": "R", "name": "ir"}}, "R"), ({"language_info": {"name": "julia"}}, "julia"),
    ({"kernelspec": {"name": "python3"}}, ""),
    ({"kernelspec": 3}, ""), ([], ""), (None, ""), ({"kernelspec": {"language": "; rm"}}, ""),
])  # fmt: skip
def test_a_kernel_of_another_language_is_named(metadata, named):
    flags = reading.read(json.dumps(document() | {"metadata": metadata}).encode()).flags
    assert flags == ([f"other_kernel: {named}; its cells were run as Python"] if named else [])


def test_no_notes_of_repair_can_be_handed_in():
    notebook = reading.read(
        json.dumps(document(metadata={"as_run": "evil()"}) | {"metadata": {"first": "evil()"}}).encode()
    ).notebook
    assert "as_run" not in notebook.cells[0].metadata and "first" not in notebook.metadata


def test_the_version_that_saved_the_notebook_is_kept_if_it_looks_like_one():
    for version, kept in (("3.13.1", True), ("3.13.1\n::error", False), (3, False)):
        content = json.dumps(document() | {"metadata": {"language_info": {"version": version}}}).encode()
        assert ("language_info" in reading.read(content).notebook.metadata) is kept


def test_two_thousand_cells_are_read_and_more_are_named():
    cell = {"cell_type": "raw", "source": "", "metadata": {}}
    assert len(reading.read(json.dumps({"cells": [cell] * 2000}).encode()).notebook.cells) == 2000
    assert "2001 cells" in refusal(json.dumps({"cells": [cell] * 2001}).encode())


def test_a_notebook_of_the_library_is_read_as_nbformat_reads_it():
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("a = 1", id="x", metadata={"tags": ["live"]})])
    [cell] = reading.read(nbformat.writes(notebook).encode()).notebook.cells
    assert (cell.id, cell.source, cell.metadata.tags) == ("x", "a = 1", ["live"])
