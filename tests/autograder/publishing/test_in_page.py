"""Practice in the page, as it is built: what lies beside the pages, with and without solutions, and without npm."""

from __future__ import annotations

import base64
import gzip
import json
import re

import pytest

from autograder.authoring import chapter as chapters
from autograder.proving import drawing, practice
from autograder.publishing import in_page

CHAPTER = chapters.load("ch43")
NAMES = ["clipped_surrogate_loss"]
TITLE = "One sample: objectives and gradients against the ratio"
NOTEBOOKS = {"ch43": b'{"cells": []}'}


@pytest.fixture
def ready(tmp_path, monkeypatch):
    """Bundles and a Pyodide that need no npm, and one exercise that is offered."""
    for name in ("page", "editor", *in_page.RUNTIME):
        (tmp_path / f"{name}.js").write_text(f"// {name}\n", encoding="utf-8")
    monkeypatch.setattr(in_page, "fetched", lambda: tmp_path)
    monkeypatch.setattr(practice, "offered_in", lambda assignment: NAMES)
    monkeypatch.setattr(drawing, "reasons", lambda chapter, found, outputs: dict.fromkeys((one.title for one in found), ""))


def staged(with_solutions: bool = True) -> dict[str, bytes]:
    return in_page.staged([(CHAPTER, in_page.handed_to(CHAPTER, [], with_solutions))], NOTEBOOKS)


def unpacked(content: bytes) -> bytes:
    """What a script of data hands to the page."""
    return gzip.decompress(base64.b64decode(re.fullmatch(r'coursePractice\.data\("[\w-]+", "(.*)"\);\n', content.decode())[1]))


def body_lines() -> list[str]:
    """The lines of the chapter's answers that stand in none of its stubs."""
    stubs = "\n".join(cell.source for cell in CHAPTER.exercises)
    lines = {line.strip() for answer in practice.answers(CHAPTER).values() for line in answer.splitlines()}
    return sorted(line for line in lines if len(line) > 20 and line not in stubs)


def test_each_page_is_given_its_cases_and_its_notebook(ready):
    files = staged()
    told = files["vendor/practice.js"].decode()
    index = json.loads(re.match(r"window\.coursePractice = \{index: (.*)\};\n", told)[1])
    drawn = [[], NAMES, [], NAMES]  # objective and gradient, unclipped and clipped
    assert index["chapters"] == {
        "ch43": {"page": CHAPTER.page, "exercises": NAMES, "figures": {TITLE: {"uses": NAMES, "drawn": drawn}}}
    }
    assert list(json.loads(unpacked(files["vendor/practice/ch43.js"]))["page"]["cases"]) == NAMES
    assert unpacked(files["vendor/practice/ch43-notebook.js"]) == NOTEBOOKS["ch43"]
    assert files == staged()


def test_a_figure_that_the_page_cannot_draw_is_not_offered_and_a_line_says_so(ready, monkeypatch, capsys):
    def figures() -> tuple[list, list]:
        handed = in_page.handed_to(CHAPTER, [], True)
        return list(handed["figures"]), list(json.loads(handed["text"])["page"]["figures"])

    assert figures() == ([TITLE], [TITLE])
    monkeypatch.setattr(drawing, "reasons", lambda chapter, found, outputs: {TITLE: "it needs NumPy"})
    assert figures() == ([], [])
    assert capsys.readouterr().out == f"ch43: {TITLE!r} is not drawn with the reader's code: it needs NumPy\n"


def test_without_solutions_no_answer_is_in_any_file(ready):
    def lines_shown(with_solutions: bool) -> list[str]:
        files = staged(with_solutions)
        whole = b"\n".join(
            unpacked(content) if content.startswith(b"coursePractice.data") else content for content in files.values()
        )
        text = whole.decode(errors="replace")
        return [line for line in body_lines() if line in text or json.dumps(line, ensure_ascii=False)[1:-1] in text]

    assert lines_shown(with_solutions=True) == body_lines() != []
    assert lines_shown(with_solutions=False) == []


def test_where_npm_fetches_nothing_pages_have_no_practice_and_a_line_says_so(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(in_page, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(in_page, "_node", lambda: (["false"], ["false"]))
    in_page.fetched.cache_clear()
    files = in_page.staged([], NOTEBOOKS)
    in_page.fetched.cache_clear()
    assert files["vendor/practice.js"] == in_page.WITHOUT.encode()
    assert set(files) == {"vendor/practice.js", "vendor/practice.css"}
    assert "The pages will have no practice: " in capsys.readouterr().out


def test_every_package_has_a_checksum():
    lock = json.loads((in_page.SOURCES / "package-lock.json").read_text(encoding="utf-8"))
    packages = {name: one for name, one in lock["packages"].items() if name}
    assert "node_modules/pyodide" in packages
    assert all(one["integrity"].startswith("sha512-") for one in packages.values())
