"""The built pages as a reader meets them: opened from disk, with no network."""

from __future__ import annotations

from pathlib import Path

import pytest

from autograder.authoring.chapter import all_chapters
from autograder.authoring.contract import references, sources
from autograder.publishing.book import docname
from tests.book.visit import CHAPTERS, LOOKS, PAGES, Visit

SCREENSHOTS = Path(__file__).resolve().parents[2] / "test-artefacts"


@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("name", PAGES)
def test_page_loads_from_disk_without_network_or_complaint(browser, html, name, look):
    with Visit(browser, html / f"{name}.html", look) as visit:
        visit.page.wait_for_timeout(200)  # whatever scripts load late
        SCREENSHOTS.mkdir(exist_ok=True)
        visit.page.screenshot(path=SCREENSHOTS / f"{Path(name).name}-{look}.png", full_page=True)
        abroad = [url for url in visit.requests if not url.startswith(("file:", "data:", "blob:"))]
        assert abroad == []
        assert visit.complaints == []
        width = visit.page.evaluate("document.documentElement.scrollWidth")
        assert width <= LOOKS[look][1], f"the page is {width} pixels wide: something does not wrap or scroll within itself"


@pytest.mark.parametrize("name", CHAPTERS)
def test_equations_are_rendered_and_begin_where_a_phone_can_show_them(browser, html, name):
    with Visit(browser, html / f"{name}.html", "phone") as visit:
        left = visit.page.locator("div.math mjx-container").evaluate_all(
            "all => all.map(one => one.getBoundingClientRect().left)"
        )
        assert min(left) >= 0
        assert visit.page.locator("mjx-container").count() > 0
        assert visit.page.locator("mjx-merror").count() == 0
        assert visit.page.locator("span.math:not(:has(mjx-container)), div.math:not(:has(mjx-container))").count() == 0


@pytest.mark.parametrize("name", CHAPTERS)
def test_no_equation_is_wider_than_its_column(browser, html, name):
    with Visit(browser, html / f"{name}.html") as visit:
        cut = "all => all.filter(one => one.scrollWidth > one.clientWidth).map(one => one.id || one.innerText)"
        assert visit.page.locator("div.math").evaluate_all(cut) == [], "break it into lines (aligned): its number is cut off"


@pytest.mark.parametrize("name", CHAPTERS)
def test_the_printed_page_is_the_article_as_the_reader_left_it(browser, html, name):
    with Visit(browser, html / f"{name}.html", "dark") as visit:
        visit.page.emulate_media(media="print")
        visit.page.pdf(path=SCREENSHOTS / f"{Path(name).name}.pdf", format="A4")
        visit.page.set_viewport_size({"width": 720, "height": 1000})  # about what A4 leaves between its margins
        visit.page.screenshot(path=SCREENSHOTS / f"{Path(name).name}-print.png", full_page=True)
        assert visit.page.evaluate("document.documentElement.scrollWidth") <= 720
        for gone in (".bd-sidebar-primary", ".bd-sidebar-secondary", ".bd-header-article", ".prev-next-footer"):
            assert not visit.page.locator(gone).first.is_visible()
        assert visit.page.evaluate("getComputedStyle(document.body).backgroundColor") in (
            "rgb(255, 255, 255)",
            "rgba(0, 0, 0, 0)",
        )
        assert visit.page.locator("article details[open]").count() == 0


@pytest.mark.parametrize("name", CHAPTERS)
def test_notebook_can_be_downloaded_from_its_page(browser, html, name):
    with Visit(browser, html / f"{name}.html") as visit:
        target = visit.page.locator("article a[href$='.ipynb']").first.get_attribute("href")
        assert (html / name).parent.joinpath(target).resolve().is_file()


@pytest.mark.parametrize("chapter", all_chapters(), ids=lambda chapter: chapter.assignment)
def test_every_reference_is_on_its_page_folded(browser, html, chapter):
    with Visit(browser, html / f"{docname(chapter)}.html") as visit:
        folded = visit.page.locator("details", has_text="Reference solution")
        shown = folded.all_text_contents()
        assert folded.evaluate_all("nodes => nodes.filter(node => node.open).length") == 0
    for reference in references(chapter, sources(chapter)).values():
        assert any(reference.body.strip() in text for text in shown)


@pytest.mark.parametrize("chapter", all_chapters(), ids=lambda chapter: chapter.assignment)
def test_search_finds_a_word_of_the_chapter_from_disk(browser, html, chapter):
    with Visit(browser, html / "search.html") as visit:
        visit.page.goto(f"{(html / 'search.html').as_uri()}?q={chapter.exercises[0].exercise}")
        visit.page.wait_for_selector("ul.search li")
        assert f"{docname(chapter)}.html" in visit.page.locator("ul.search").inner_html()
        assert visit.complaints == []


def test_published_tree_holds_nothing_of_the_build(html):
    names = {part for path in html.rglob("*") for part in path.relative_to(html).parts}
    assert not names & {"_sources", ".doctrees", ".jupyter_cache", "jupyter_execute", ".buildinfo", "objects.inv"}
