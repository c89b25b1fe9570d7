"""The built pages as a reader meets them: opened from disk, with no network."""

from __future__ import annotations

from pathlib import Path

import pytest

from autograder.book import HOW_TO, docname
from autograder.chapter import all_chapters
from autograder.contract import references, sources

SCREENSHOTS = Path(__file__).resolve().parents[2] / "test-artefacts"
LOOKS = {  # colour scheme, width in CSS pixels
    "light": ("light", 1280),
    "dark": ("dark", 1280),
    "phone": ("light", 390),
}
PAGES = ["index", *HOW_TO, "notation", "kill-matrix", *(docname(chapter) for chapter in all_chapters())]
CHAPTERS = [page for page in PAGES if page.startswith("chapters/")]


class Visit:
    """A page opened from disk, with what it asked for elsewhere and what it complained of."""

    def __init__(self, browser, path: Path, look: str = "light"):
        scheme, width = LOOKS[look]
        self.context = browser.new_context(color_scheme=scheme, viewport={"width": width, "height": 900}, offline=True)
        self.page = self.context.new_page()
        self.requests: list[str] = []
        self.complaints: list[str] = []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("requestfailed", lambda request: self.complaints.append(f"failed: {request.url}"))
        self.page.on("console", lambda message: message.type == "error" and self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.goto(path.as_uri())
        self.page.wait_for_function("!window.MathJax || (MathJax.startup.promise && MathJax.startup.promise.then(() => true))")

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.context.close()


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
def test_sliders_change_what_is_shown(browser, html, name):
    with Visit(browser, html / f"{name}.html") as visit:
        sliders = visit.page.locator(".cell_output input[type=range]")
        assert sliders.count() > 0
        for slider in sliders.all():
            shown = slider.locator("xpath=ancestor::div[contains(@class, 'cell_output')]")
            slider.scroll_into_view_if_needed()
            before = shown.evaluate("node => node.innerHTML")
            slider.focus()
            visit.page.keyboard.press("Home")
            low = shown.evaluate("node => node.innerHTML")
            visit.page.keyboard.press("End")
            high = shown.evaluate("node => node.innerHTML")
            assert low != high or before != low


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


def test_search_works_from_disk(browser, html):
    with Visit(browser, html / "search.html") as visit:
        visit.page.goto((html / "search.html").as_uri() + "?q=advantages")
        visit.page.wait_for_selector("ul.search li")
        assert "notation.html" in visit.page.locator("ul.search").inner_html()
        assert visit.complaints == []


def test_published_tree_holds_nothing_of_the_build(html):
    names = {part for path in html.rglob("*") for part in path.relative_to(html).parts}
    assert not names & {"_sources", ".doctrees", ".jupyter_cache", "jupyter_execute", ".buildinfo", "objects.inv"}
