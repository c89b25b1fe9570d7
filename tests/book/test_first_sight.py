"""The front page as a reader meets it, and what it says after some exercises are passed; and llms.txt, which machines read."""

from __future__ import annotations

import json
import re

import pytest

from autograder.authoring.chapter import all_chapters
from autograder.proving import practice
from autograder.publishing.book import docname
from tests.book import axe
from tests.book.visit import OPEN, PAGES, STILL, Visit

MORE_BEFORE_THE_FIRST_CLICK = 150_000  # bytes that the front page may add to a page of text
FIRST, SECOND = all_chapters()[:2]
DONE = '.course-map a[href$="{page}.html"]'


@pytest.fixture(scope="module")
def visit(browser, html):
    with Visit(browser, html / "index.html") as visit:
        yield visit


@pytest.fixture(scope="module")
def practised(browser, html, tmp_path_factory):
    """A visit of one who has passed all of the first chapter, one exercise of the second, and has begun another there."""
    first, second = (practice.offered_in(chapter.assignment) for chapter in (FIRST, SECOND))
    file = tmp_path_factory.mktemp("drafts") / "drafts.json"
    known = {"kind": "course-practice", "drafts": {second[1]: "def"}, "passed": [*first, second[0]]}
    file.write_text(json.dumps(known), encoding="utf-8")
    with Visit(browser, html / f"{docname(FIRST)}.html") as visit:
        with visit.page.expect_file_chooser() as chooser:
            visit.page.get_by_role("button", name="Load drafts from a file").click()
        chooser.value.set_files(file)
        visit.page.get_by_text("Loaded 1 drafts.").wait_for()
        visit.page.goto((html / "index.html").as_uri())
        yield visit.page, len(first), len(second)


def test_what_the_book_is_fits_into_the_first_view(visit):
    visit.page.set_viewport_size({"width": 1280, "height": 800})
    boxes = [visit.page.locator(what).bounding_box() for what in ("article h1", ".course-start", ".course-opening")]
    assert [box for box in boxes if box["y"] < 0 or box["y"] + box["height"] > 800] == []


def test_before_the_first_click_it_loads_little_and_no_film(visit, html):
    loaded = [url for url in visit.requests if "landing" in url]
    assert [url.rpartition("/")[2] for url in loaded] == ["landing.webp"]
    own = (html / "index.html").stat().st_size + (html / "_static" / "landing.webp").stat().st_size
    assert own < MORE_BEFORE_THE_FIRST_CLICK


def test_the_film_is_there_to_be_played(visit):
    video = visit.page.locator(".course-opening video")
    assert video.get_attribute("aria-label") and video.evaluate("video => video.controls && !video.autoplay")
    played = "video => video.play().then(() => { video.pause(); return [video.duration, video.videoWidth]; })"
    duration, width = video.evaluate(played)
    assert duration > 1 and width == 400


def test_the_clip_moves_by_keyboard(visit):
    figure = visit.page.locator("figure.explorer")
    for slider in figure.get_by_role("slider").all():
        slider.focus()
        pictures = set()
        for key in ("Home", "End"):
            visit.page.keyboard.press(key)
            pictures.add(figure.locator("svg").inner_html())
        assert len(pictures) == 2


def test_nobody_who_has_passed_nothing_is_told_to_go_on(visit):
    count = sum(len(practice.offered_in(chapter.assignment)) for chapter in all_chapters())
    assert visit.page.locator(".course-progress").inner_text().strip() == f"0 of {count} exercises on these pages passed."
    assert visit.page.locator('.course-map a:not([data-done="none"])').count() == 0


def test_what_is_passed_shows_on_the_map_in_the_list_and_in_all(practised):
    page, first, second = practised
    count = sum(len(practice.offered_in(chapter.assignment)) for chapter in all_chapters())
    assert f"{first + 1} of {count} exercises on these pages passed" in page.locator(".course-progress").inner_text()
    marks = {chapter: page.locator(DONE.format(page=chapter.page)) for chapter in all_chapters()}
    assert [mark.get_attribute("data-done") for mark in marks.values()] == ["all", "some"] + ["none"] * (len(marks) - 2)
    assert marks[SECOND].get_attribute("aria-label") == f"{SECOND.number}. {SECOND.title}: 1 of {second} exercises passed"
    listed = page.locator(f'article li a[href$="{SECOND.page}.html"] .practice-done')
    assert f"✓ 1/{second}" in listed.inner_text()


def test_the_reader_goes_on_where_something_is_begun_and_not_complete(practised):
    link = practised[0].locator(".course-progress a")
    assert link.inner_text() == f"Continue with {SECOND.number}. {SECOND.title}"
    assert link.get_attribute("href") == f"{docname(SECOND)}.html"


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_with_progress_shown_no_rule_of_accessibility_is_broken(practised, theme):
    page = practised[0]
    page.emulate_media(color_scheme=theme)
    page.evaluate(STILL, theme)  # colours change over some frames
    page.evaluate(OPEN)
    assert axe.grave(axe.violations(page)) == []


def test_on_a_phone_with_progress_shown_nothing_sticks_out(practised):
    page = practised[0]
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    for number in page.locator(".course-map a").all():
        assert number.bounding_box()["height"] >= 24  # for a thumb: WCAG 2.5.8


def test_without_scripts_the_chapters_what_they_need_and_the_figures_values_can_be_read(browser, html):
    context = browser.new_context(java_script_enabled=False, offline=True)
    page = context.new_page()
    page.goto((html / "index.html").as_uri())
    text = page.locator("article").inner_text().replace("’", "'")
    for chapter in all_chapters():
        assert f"{chapter.number}. {chapter.title}" in text
        needs = ", ".join(map(str, chapter.prerequisites))
        assert not needs or f"needs {needs}" in text
        assert page.locator(DONE.format(page=chapter.page)).count() == 1
    assert "the table has its values" in text and page.locator("figure.explorer tbody td").count() > 0
    context.close()


def test_every_link_of_llms_txt_leads_to_a_page_and_every_page_has_one(html):
    links = re.findall(r"\]\(([^)]+)\)", (html / "llms.txt").read_text(encoding="utf-8"))
    assert [link for link in links if not (html / link).is_file()] == []
    assert sorted(links) == sorted(f"{page}.html" for page in PAGES if page != "index")


def test_the_prompt_for_a_tutor_is_short_and_has_a_button_that_copies_it(browser, html):
    with Visit(browser, html / "how-to" / "learners.html") as visit:
        prompt = visit.page.locator(".highlight", has_text="Be my tutor")
        text = prompt.locator("pre").inner_text()
        assert len(text.split()) < 200
        assert all(
            part in text for part in ("My attempt:", "What the check says:", "one hint", "Never write the exercise's code")
        )
        assert prompt.locator("button.copybtn").count() == 1


def test_on_a_phone_no_name_in_a_table_is_broken(browser, html):
    with Visit(browser, html / "notation.html", "phone") as visit:
        names = "[...document.querySelectorAll('table.table td code .pre')]"
        assert visit.page.evaluate(f"{names}.length")
        assert (
            visit.page.evaluate(f"{names}.filter((one) => one.getClientRects().length > 1).map((one) => one.textContent)") == []
        )
        assert visit.page.evaluate("document.documentElement.scrollWidth") <= 390


@pytest.mark.parametrize("look", ["light", "phone"])
def test_the_tutors_prompt_fits_its_box(browser, html, look):
    with Visit(browser, html / "how-to/learners.html", look) as visit:
        box = visit.page.locator("#a-tutor-that-does-not-give-it-away pre")
        assert box.evaluate("pre => pre.scrollWidth <= pre.clientWidth")
