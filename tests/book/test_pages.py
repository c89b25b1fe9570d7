"""The built pages as a reader meets them: opened from disk, with no network. Each page is visited twice: on a phone, and at a desk, in
the dark, where the light is then switched on."""

from __future__ import annotations

import functools

import pytest

from autograder.authoring.chapter import all_chapters
from autograder.authoring.contract import references, sources
from autograder.publishing.book import docname
from tests.book.visit import CHAPTERS, LOOKS, PAGES, Visit, look_at_phone, look_at_wide


@pytest.fixture(scope="module")
def seen(browser, html):
    """What a page shows in a look: seen(name, look)."""
    wide = functools.cache(functools.partial(look_at_wide, browser, html))
    phone = functools.cache(functools.partial(look_at_phone, browser, html))
    return lambda name, look: phone(name) if look == "phone" else wide(name)[look]


@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("name", PAGES)
def test_page_asks_for_nothing_from_elsewhere(seen, name, look):
    abroad = [url for url in seen(name, look).requests if not url.startswith(("file:", "data:", "blob:"))]
    assert abroad == [], "\n" + "\n".join(abroad)


@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("name", PAGES)
def test_page_loads_without_complaint(seen, name, look):
    complaints = seen(name, look).complaints
    assert complaints == [], "\n" + "\n".join(complaints)


@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("name", PAGES)
def test_page_is_no_wider_than_its_window(seen, name, look):
    width = seen(name, look).width
    assert width <= LOOKS[look][1], f"the page is {width} pixels wide: something does not wrap or scroll within itself"


@pytest.mark.parametrize("look", ["light", "dark"])
@pytest.mark.parametrize("name", PAGES)
def test_axe_finds_no_serious_or_critical_violation(seen, name, look):
    violations = seen(name, look).violations
    assert violations == [], "\n" + "\n".join(violations)  # all of them: a comparison is shown in part


@pytest.mark.parametrize("name", CHAPTERS)
def test_equations_are_rendered_and_begin_where_a_phone_can_show_them(seen, name):
    page = seen(name, "phone")
    assert page.equations_on_lines_of_their_own > 0
    assert {
        "cut off on the left": page.equations_that_begin_beyond_the_edge,
        "wrong": page.equations_with_errors,
        "not rendered": page.equations_not_rendered,
    } == {"cut off on the left": [], "wrong": [], "not rendered": []}


@pytest.mark.parametrize("name", CHAPTERS)
def test_no_equation_is_wider_than_its_column(seen, name):
    cut = seen(name, "light").equations_wider_than_their_column
    assert cut == [], "break into lines (aligned), for the number is cut off:\n" + "\n".join(cut)


@pytest.mark.parametrize("chapter", all_chapters(), ids=lambda chapter: chapter.assignment)
def test_no_line_of_code_is_cut_off(seen, chapter):
    source = [line.strip() for line in chapter.path.read_text(encoding="utf-8").splitlines()]
    cut = [
        f"{chapter.path.name}:{source.index(line.strip()) + 1 if line.strip() in source else '?'}: "
        f"{len(line)} columns, of which {block['columns']} are to be seen: {line}"
        for block in seen(docname(chapter), "light").code_cut_off
        for line in block["lines"]
    ]
    assert cut == [], "\n" + "\n".join(cut)


@pytest.mark.parametrize("name", CHAPTERS)
def test_the_printed_page_is_the_article_as_the_reader_left_it(seen, name):
    wanted = {"pixels beyond its edge": 0, "shown": [], "background": "rgb(255, 255, 255)", "open folds": []}
    assert seen(name, "dark").paper == wanted


@pytest.mark.parametrize("name", CHAPTERS)
def test_notebook_can_be_downloaded_from_its_page(seen, html, name):
    assert (html / name).parent.joinpath(seen(name, "light").downloads[0]).resolve().is_file()


@pytest.mark.parametrize("chapter", all_chapters(), ids=lambda chapter: chapter.assignment)
def test_every_reference_is_on_its_page_folded(seen, chapter):
    folds = seen(docname(chapter), "light").references
    assert [text for text, is_open in folds if is_open] == []
    lost = [
        name
        for name, reference in references(chapter, sources(chapter)).items()
        if not any(reference.body.strip() in text for text, _ in folds)
    ]
    assert lost == []


@pytest.mark.parametrize("chapter", all_chapters(), ids=lambda chapter: chapter.assignment)
def test_search_finds_a_word_of_the_chapter_from_disk(browser, html, chapter):
    with Visit(browser, html / "search.html", query=f"?q={chapter.exercises[0].exercise}") as visit:
        visit.page.wait_for_selector("ul.search li")
        assert f"{docname(chapter)}.html" in visit.page.locator("ul.search").inner_html()
        assert visit.complaints == []


def test_published_tree_holds_nothing_of_the_build(html):
    names = {part for path in html.rglob("*") for part in path.relative_to(html).parts}
    assert not names & {"_sources", ".doctrees", ".jupyter_cache", "jupyter_execute", ".buildinfo", "objects.inv"}
