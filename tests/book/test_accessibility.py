"""axe.violations looks at colours once for each kind of text, and finds what axe finds on each of them."""

from __future__ import annotations

import re

import pytest

from autograder.authoring.chapter import all_chapters
from autograder.publishing.book import docname
from tests.book import axe
from tests.book.visit import OPEN, Visit

LONGEST = sorted(all_chapters(), key=lambda chapter: len(chapter.path.read_text(encoding="utf-8")))[-2:]
BROKEN = """
  .highlight .k { color: #8a8a8a !important; }
  .highlight .s2 { color: #777 !important; background: #666 !important; }
  .bd-article li { opacity: .4; }
  .bd-article aside, .bd-article details p { color: #9a9a9a !important; }
  .bd-article a { color: inherit !important; text-decoration: none !important; }
  .bd-article table { background: linear-gradient(white, black); color: #999 !important; }
"""
WRONG = {  # what is put into a page, and the rule that it breaks
    "a word in code": ("color-contrast", "div.highlight pre", '<span id="ID" class="n" style="color: #8a8a8a">faint</span>'),
    "small where large would do": ("color-contrast", "article", '<p id="ID" style="background: #fff; color: #8a8a8a">small</p>'),
    "behind a clear layer": (
        "color-contrast",
        "article",
        '<div style="background: #777"><div style="background: transparent"><p id="ID" style="color: #666">grey on grey</p></div></div>',
    ),
    "through an opacity": ("color-contrast", "article", '<p style="opacity: .3"><b id="ID">hardly there</b></p>'),
    "over something that is no ancestor": (
        "color-contrast",
        "article",
        '<div style="position: relative"><div style="position: absolute; inset: 0; background: #333"></div>'
        '<p id="ID" style="position: relative; color: #222">in front of it</p></div>',
    ),
    "over a gradient": (
        "color-contrast",
        "article",
        '<p id="ID" style="background: linear-gradient(#fff, #000); color: #888">somewhere in it</p>',
    ),
    "in a fold": ("color-contrast", "article details", '<p id="ID" style="background: #fff; color: #8b8b8b">faint</p>'),
    "an input without a label": ("label", "article", '<input id="ID" type="text">'),
    "an image without words": ("image-alt", "article", '<img id="ID" src="data:image/gif;base64,R0lGODlhAQABAAAAACw=">'),
    "a link without words": ("link-name", "article", '<a id="ID" href="#"></a>'),
}  # fmt: skip


@pytest.mark.parametrize("look", ["light", "dark"])
def test_each_kind_of_violation_is_found_where_it_is(browser, html, look):
    with Visit(browser, html / f"{docname(LONGEST[0])}.html", look) as visit:
        visit.page.evaluate(OPEN)
        for at, (_, place, what) in enumerate(WRONG.values()):
            visit.page.evaluate(
                "([place, what]) => document.querySelector(place).insertAdjacentHTML('beforeend', what)",
                [place, what.replace("ID", f"wrong-{at}")],
            )
        found = axe.grave(axe.violations(visit.page))
        colours = axe.grave(axe.violations(visit.page, colours_only=True))
    for at, (kind, (rule, _, _)) in enumerate(WRONG.items()):
        assert any(line.startswith(f"{rule}: ") and f"#wrong-{at}'" in line for line in found), f"{kind}: not among {found}"
    assert colours == [line for line in found if line.startswith(tuple(f"{rule}: " for rule in axe.COLOURS))] != found


@pytest.mark.parametrize(("chapter", "look"), list(zip(LONGEST, ["light", "dark"], strict=True)), ids=["light", "dark"])
def test_no_rule_and_no_pair_of_colours_is_lost_where_a_style_sheet_is_broken(browser, html, chapter, look):
    with Visit(browser, html / f"{docname(chapter)}.html", look) as visit:
        visit.page.evaluate(OPEN)
        visit.page.add_style_tag(content=BROKEN)
        found, everywhere = axe.violations(visit.page), axe.violations_everywhere(visit.page)
    assert {(one["id"], one["impact"]) for one in found} == {(one["id"], one["impact"]) for one in everywhere}
    assert _pairs(found) == _pairs(everywhere)
    assert len(_pairs(found)) >= 3


def _pairs(found: list[dict]) -> set[str]:
    """The colours, sizes and weights of which axe complains."""
    return set(re.findall(r"contrast of .*? \((.*?)\)", str(found)))
