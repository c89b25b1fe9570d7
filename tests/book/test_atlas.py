"""The appendix on other libraries answers: its rows are filtered and sorted, by keyboard, and all are there without a script."""

import re

import pytest

from experiments.atlas import keeping
from tests.book.visit import Visit

ROWS = sum(len(record["rows"]) for record in keeping.load_all().values())
SHOWN = ".atlas-rows tbody tr:visible"


@pytest.fixture
def page(browser, html):
    with Visit(browser, html / "atlas.html") as visit:
        yield visit.page


def test_rows_are_filtered_by_words_and_by_verdict(page):
    status = page.locator(".atlas-filter").get_by_role("status")
    assert status.inner_text() == f"{ROWS} of {ROWS} rows"
    page.get_by_label("Show rows with").fill("TRL")
    for row in page.locator(SHOWN).all():
        assert re.search(r"\btrl", row.inner_text())  # and not torchrl
    assert 0 < page.locator(SHOWN).count() < ROWS
    page.get_by_label("that are").select_option("not equal")
    verdicts = page.locator(f"{SHOWN} td:nth-child(3)").all_inner_texts()
    assert verdicts and not any(text.startswith("equal") for text in verdicts)
    assert status.inner_text() == f"{len(verdicts)} of {ROWS} rows"
    headings = page.locator("section:has(.atlas-rows) > h3:visible").count()
    assert headings == page.locator(".atlas-rows:has(tbody tr:visible)").count()


def test_a_click_sorts_and_another_turns_round(page):
    table = page.locator(".atlas-rows table").nth(1)
    table.locator("th").first.get_by_role("button").focus()
    page.keyboard.press("Enter")
    names = table.locator("td:first-child").all_inner_texts()
    assert table.locator("th").first.get_attribute("aria-sort") == "ascending"
    page.keyboard.press("Enter")
    assert table.locator("td:first-child").all_inner_texts() == names[::-1] and len(set(names)) > 3
    assert table.locator("th").first.get_attribute("aria-sort") == "descending"


def test_all_rows_are_there_without_a_script_and_the_csv_is_beside(browser, html):
    context = browser.new_context(java_script_enabled=False, offline=True)
    page = context.new_page()
    page.goto((html / "atlas.html").as_uri())
    assert page.locator(SHOWN).count() == ROWS
    link = page.locator("a.download").get_attribute("href")
    assert (html / link).read_text(encoding="utf-8").count("\n") == ROWS + 1
    assert (html / "atlas.html").stat().st_size < 1e6
    context.close()
