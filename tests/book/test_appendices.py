"""The appendices that are made from code: the cheat sheet's links lead to exercises, it fits on paper, the lesson's examples are true."""

from __future__ import annotations

import doctest
import re
import sys

import pytest

from autograder.authoring.chapter import all_chapters
from autograder.paths import ROOT
from autograder.publishing import cheat_sheet
from autograder.publishing.book import docname
from tests.book.visit import Visit


def test_each_entry_leads_to_its_exercise(html):
    text = (html / "cheat-sheet.html").read_text(encoding="utf-8")
    links = re.findall(
        r'<h3><a class="[^"]*" href="([^"#]+)#([^"]+)"><span class="[^"]*"><code[^>]*><span class="pre">(\w+)<', text
    )
    wanted = [
        (f"{docname(chapter)}.html", str(cell.exercise))
        for chapter in all_chapters()
        for cell in chapter.exercises
        if cheat_sheet.computes(cell)
    ]
    assert [(page, name) for page, _, name in links] == wanted
    for page, anchor, name in links:
        section = (html / page).read_text(encoding="utf-8").partition(f'<section id="{anchor}">')[2].partition("</section>")[0]
        assert f'<span class="pre">{name}</span>' in section, (page, anchor)


def test_the_cheat_sheet_is_a_leaflet_on_paper(browser, html, tmp_path):
    with Visit(browser, html / "cheat-sheet.html") as visit:
        pdf = visit.page.pdf(format="A4")
    assert len(re.findall(rb"/Type\s*/Page\b", pdf)) <= 4


@pytest.mark.parametrize("whose", ["page", "real"])
def test_the_lessons_examples_are_what_either_torch_prints(whose, monkeypatch):
    if whose == "page":
        monkeypatch.syspath_prepend(str(ROOT / "tests" / "book" / "practice"))
        from both_torches import page

        monkeypatch.setitem(sys.modules, "torch", page)
    blocks = re.findall(r"```pycon\n(.*?)```", (ROOT / "book" / "autograd.md").read_text(encoding="utf-8"), re.DOTALL)
    example = doctest.DocTestParser().get_doctest("\n".join(blocks), {}, "autograd.md", None, 0)
    assert len(example.examples) >= 8 and doctest.DocTestRunner().run(example).failed == 0
