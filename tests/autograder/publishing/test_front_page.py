"""The front page as it is staged: what needs what, the figure's values, links to chapters; and llms.txt."""

from __future__ import annotations

import dataclasses
import itertools
import json
import re

import pytest

from autograder.authoring.chapter import all_chapters
from autograder.publishing import book, front_page


def course(tiny, needs: dict[int, tuple[int, ...]]):
    """Chapters of these numbers with these prerequisites."""
    return [dataclasses.replace(tiny.before, number=number, prerequisites=before) for number, before in needs.items()]


def test_arrows_are_the_needs_that_no_other_implies(tiny):
    chapters = course(tiny, {1: (), 2: (1,), 3: (1, 2), 4: (1,), 5: (1, 3, 4), 6: ()})
    assert front_page.needed(chapters) == {1: [], 2: [1], 3: [2], 4: [1], 5: [3, 4], 6: []}


@pytest.mark.parametrize(
    "needs",
    [
        {chapter.number: chapter.prerequisites for chapter in all_chapters()},
        {1: (), 2: (), 3: (), 4: (1, 3), 5: (2,), 6: (4, 5), 7: (2,)},
        {1: ()},
    ],
    ids=["this course", "many beginnings", "one chapter"],
)
def test_no_two_chapters_share_a_place_on_the_map_and_arrows_go_to_the_right(tiny, needs):
    chapters = course(tiny, needs)
    arrows = front_page.needed(chapters)
    at = front_page._positions(arrows)
    assert at.keys() == needs.keys()
    for number, before in arrows.items():
        assert all(at[one][0] < at[number][0] for one in before)
    places = sorted(at.values())
    assert all(column != following or high + 1 <= low + 1e-9 for (column, high), (following, low) in itertools.pairwise(places))
    drawn = front_page._map(chapters)
    assert drawn.count('class="arrow"') == sum(map(len, arrows.values())) and drawn.count("<a ") == len(chapters)


def test_a_chapter_in_the_list_says_what_it_takes(tiny):
    entry = front_page._entry(tiny.chapter)
    assert "[**99. A tiny chapter: twice**](chapters/ch99_tiny.ipynb)" in entry and tiny.chapter.summary in entry
    assert "2 exercises · about 1 hour 30 minutes · needs 98, doubling &amp; more<" in entry
    assert "needs" not in front_page._entry(tiny.before)


def test_links_to_chapters_are_written_out_and_an_unknown_one_leaves_its_words(tiny):
    text = "See [there](chapter:99#doubling), [before](chapter:98), [nowhere](chapter:12#x). <!-- clip --> <!-- size -->"
    page = front_page.front_page(text, [tiny.before, tiny.chapter], "FIGURE")
    assert page.startswith(
        "See [there](chapters/ch99_tiny.ipynb#doubling), [before](chapters/ch98_before.ipynb), nowhere. FIGURE 2 chap"
    )


def test_every_mark_of_the_page_is_replaced():
    text = (book.BOOK / "index.md").read_text(encoding="utf-8")
    assert len(re.findall(r"<!-- \w+ -->", text)) == 6
    with_solutions, without = (front_page.front_page(text, all_chapters(), "", solved) for solved in (True, False))
    assert "<!-- " not in with_solutions + without
    assert front_page.READING in with_solutions and "each exercise a folded solution" not in without


def test_the_figure_shows_the_clip_on_the_side_where_it_acts():
    data = json.loads(re.search(r'"application/json">(.*?)</script>', front_page.clip_figure(), re.S)[1])
    assert [one["name"] for one in data["series"]] == ["without the clip", "with the clip", "its gradient"]
    advantages, widths = (slider["values"] for slider in data["sliders"])
    settings = [(float(advantage), float(width)) for advantage in advantages for width in widths]
    for (advantage, width), shown in zip(settings, data["values"], strict=True):
        for ratio, plain, clipped, gradient in zip(data["series"][0]["x"], *shown, strict=True):
            silent = ratio > 1 + width if advantage > 0 else ratio < 1 - width
            bound = 1 + width if advantage > 0 else 1 - width
            assert plain == pytest.approx(advantage * ratio, rel=1e-3)
            assert clipped == pytest.approx(advantage * (bound if silent else ratio), rel=1e-3)
            assert gradient == (0 if silent else advantage)


def test_llms_txt_has_a_title_a_summary_and_a_line_for_each_page(tiny):
    pages = {name: f"---\nx: y\n---\n\n# The {name}\n\nText.\n" for name in (*book.HOW_TO, *book.APPENDICES)}
    text = front_page.llms_txt([tiny.before, tiny.chapter], pages)
    assert text.startswith("# Policy Optimisation\n\n> An interactive book")
    links = re.findall(r"^- \[(.+)\]\((.+)\.html\): .+$", text, re.M)
    assert [page for _, page in links] == ["chapters/ch98_before", "chapters/ch99_tiny", *book.HOW_TO, *book.APPENDICES]
    assert ("99. A tiny chapter: twice", "chapters/ch99_tiny") in links and ("The notation", "notation") in links
    assert re.findall(r"^## (.+)$", text, re.M) == ["Chapters", "How to use this book", "Appendices"]
