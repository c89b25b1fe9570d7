"""axe-core's rules, on every page, with every fold open and every quiz answered."""

from __future__ import annotations

import pytest
from axe_playwright_python.sync_playwright import Axe

from tests.book.visit import PAGES, Visit


@pytest.mark.parametrize("look", ["light", "dark"])
@pytest.mark.parametrize("name", PAGES)
def test_axe_finds_no_serious_or_critical_violation(browser, html, name, look):
    with Visit(browser, html / f"{name}.html", look) as visit:
        visit.page.evaluate("document.querySelectorAll('details').forEach(fold => { fold.open = true; })")
        for answer in visit.page.locator("div.quiz label:last-of-type input").all():
            answer.check()
        found = Axe().run(visit.page).response["violations"]
    grave = [violation for violation in found if violation["impact"] in ("serious", "critical")]
    places = [f"{one['id']}: {node['target']} {node['failureSummary']}" for one in grave for node in one["nodes"]]
    assert places == []
