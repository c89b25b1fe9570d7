"""Figures that draw with the reader's own code, from disk, without a network, in both browsers."""

from __future__ import annotations

import pytest

from autograder.authoring import chapter as chapters
from autograder.proving import practice
from tests.book import axe
from tests.book.firefox import Firefox
from tests.book.visit import Visit

PAGE, CREDIT = "chapters/ch44_gae", "How λ and γ spread two surprises over the steps before them"
RIGHT = practice.answers(chapters.load("ch44"))["compute_gae"]
WRONG = RIGHT.replace("ended = terminated | truncated", "ended = terminated | True")
HEAD = RIGHT.partition("\n    '''")[0].partition('\n    """')[0]
RAISES, ENDLESS = f"{HEAD}\n    raise ValueError('no')\n", f"{HEAD}\n    while True:\n        pass\n"
SHORT, HUGE = f"{HEAD}\n    return torch.ones(15, 1)\n", f"{HEAD}\n    return torch.full((16, 1), 50.0)\n"
SAID = ".practice-mine [role=status]"
pytestmark = pytest.mark.parametrize("name", [PAGE])

KEEP = """([name, text]) => {
  const {version} = coursePractice.index;
  localStorage.setItem(`course-practice/${version}/draft/${name}`, text);
  dispatchEvent(new Event("storage"));
}"""
# Of a figure: by series, its values in the table; the book's curves and the reader's, as drawn; the numbers on the axes.
SEEN = """figure => ({
  rows: Object.fromEntries([...figure.querySelectorAll("tbody tr")].map((row) => [...row.cells].map((cell) => cell.textContent))
    .map(([name, ...values]) => [name, values])),
  mine: figure.querySelectorAll("svg .mine").length,
  pale: figure.querySelectorAll("svg .book").length,
  axis: [...figure.querySelector("svg").querySelectorAll("text[text-anchor=end]")].map((one) => Number(one.textContent)),
  cut: [...figure.querySelectorAll("svg .mine")].filter((one) => {
    const shape = one.getBBox();
    return shape.y < 0 || shape.y + shape.height > one.ownerSVGElement.viewBox.baseVal.height;
  }).length,
  words: figure.querySelector("svg").getAttribute("aria-label"),
})"""


@pytest.fixture(scope="module")
def visit(browser, html):
    with Visit(browser, html / f"{PAGE}.html") as visit:
        yield visit


def the_figure(page):
    return page.locator("figure.explorer", has_text=CREDIT)


def drawn_with(page, text: str) -> tuple[dict, str]:
    """What the figure shows and says with `text` as the draft of compute_gae."""
    figure = the_figure(page)
    switch, said = figure.get_by_label("Draw with mine"), figure.locator(SAID)
    if switch.is_checked():
        switch.uncheck()
    page.evaluate(KEEP, ["compute_gae", text])
    switch.check()
    page.wait_for_function("said => said.textContent && !/^(Drawing|Starting)/.test(said.textContent)", arg=said.element_handle())
    return figure.evaluate(SEEN), said.inner_text()


def test_the_switch_waits_for_something_to_draw_with(visit, name):
    figure = the_figure(visit.page)
    switch = figure.get_by_label("Draw with mine")
    assert switch.is_disabled()
    assert figure.locator(SAID).inner_text() == "First write td_residuals or compute_gae on this page."
    visit.page.get_by_role("button", name="Write your answer: compute_gae").click()
    visit.page.get_by_role("textbox", name="Your answer to compute_gae").focus()
    visit.page.keyboard.press("ControlOrMeta+a")
    visit.page.keyboard.insert_text(RIGHT)
    assert switch.is_enabled() and figure.locator(SAID).inner_text() == ""
    assert not any("/practice/wasm.js" in url for url in visit.requests)


def test_only_what_the_readers_code_draws_is_dashed(visit, name):
    seen, _ = drawn_with(visit.page, RIGHT)
    assert [row for row in seen["rows"] if row.endswith(", yours")] == ["advantage, yours"]
    assert (seen["mine"], seen["pale"]) == (1, 1)


def test_the_books_answer_draws_the_books_curve(visit, name):
    if the_figure(visit.page).get_by_label("Draw with mine").is_checked():
        the_figure(visit.page).get_by_label("Draw with mine").uncheck()
    book = the_figure(visit.page).evaluate(SEEN)
    seen, said = drawn_with(visit.page, RIGHT)
    assert said == "Yours is dashed, the book's is pale. Here they are the same."
    assert seen["rows"]["advantage, yours"] == seen["rows"]["advantage"] == book["rows"]["advantage"]
    assert seen["mine"] and seen["pale"] and not book["mine"] and seen["axis"] == book["axis"]


def test_a_wrong_answer_draws_another_curve(visit, name):
    assert WRONG != RIGHT
    seen, said = drawn_with(visit.page, WRONG)
    assert said == "Yours is dashed, the book's is pale. They differ here: advantage."
    assert seen["rows"]["advantage, yours"] == seen["rows"]["residual"] != seen["rows"]["advantage"]
    assert "advantage, yours: from " in seen["words"]


def test_the_curve_follows_the_sliders_by_keyboard(visit, name):
    figure = the_figure(visit.page)
    before, _ = drawn_with(visit.page, WRONG)
    visit.page.keyboard.press("Shift+Tab")  # back to the sliders
    visit.page.keyboard.press("Shift+Tab")
    visit.page.keyboard.press("Home")
    figure.get_by_text("Here they are the same.").wait_for()  # as nothing is spread at λ = 0
    after = figure.evaluate(SEEN)
    assert after["rows"]["advantage, yours"] == after["rows"]["advantage"] != before["rows"]["advantage"]
    for _ in range(5):
        visit.page.keyboard.press("ArrowRight")
    figure.get_by_text("They differ here: advantage.").wait_for()
    assert figure.evaluate(SEEN) == before


def test_a_curve_far_off_is_not_cut_off(visit, name):
    book, _ = drawn_with(visit.page, RIGHT)
    seen, _ = drawn_with(visit.page, HUGE)
    assert max(seen["axis"]) > 10 * max(book["axis"]) and seen["mine"] and not seen["cut"]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (RAISES, "There is no curve of yours, as compute_gae stops: ValueError: no. Its check says more."),
        (SHORT, "There is no curve of yours: “advantage” has 15 values, and the figure draws 16."),
    ],
)
def test_what_draws_nothing_says_so_and_the_books_curve_stays(visit, name, text, sentence):
    seen, said = drawn_with(visit.page, text)
    assert said == sentence
    assert not seen["mine"] and not seen["pale"] and set(seen["rows"]) >= {"residual", "advantage"}
    assert "advantage, yours" not in seen["rows"]


def test_an_edit_is_told_until_a_check_draws_again(visit, name):
    _, said = drawn_with(visit.page, WRONG)
    visit.page.evaluate(KEEP, ["compute_gae", RIGHT])
    assert the_figure(visit.page).locator(SAID).inner_text() == f"From before your last edit; a check draws anew. {said}"
    the_figure(visit.page).get_by_label("gae_lambda").press("ArrowRight")  # draws the old answer, and says so
    the_figure(visit.page).get_by_text("From before your last edit").wait_for()
    the_figure(visit.page).get_by_label("gae_lambda").press("ArrowLeft")
    visit.page.get_by_role("button", name="Check compute_gae").click()
    the_figure(visit.page).get_by_text("Here they are the same.").wait_for()
    assert "edit" not in the_figure(visit.page).locator(SAID).inner_text()


def test_switched_off_in_the_middle_it_says_nothing(browser, html, name):
    with Visit(browser, html / f"{PAGE}.html") as visit:
        figure = the_figure(visit.page)
        visit.page.evaluate(KEEP, ["compute_gae", ENDLESS])
        figure.get_by_label("Draw with mine").check()
        figure.get_by_text("Starting Python, once for this visit").wait_for()
        figure.get_by_text("Drawing …").wait_for()
        figure.get_by_label("Draw with mine").uncheck()
        visit.page.wait_for_timeout(1000)  # in which it would have said again that it draws
        assert figure.locator(SAID).inner_text() == "" and not figure.get_by_role("button", name="Stop drawing").is_visible()
        figure.get_by_label("Draw with mine").check()
        figure.get_by_role("button", name="Stop drawing").click()
        figure.get_by_text("You stopped it.").wait_for()
        figure.get_by_label("Draw with mine").check()
        assert figure.locator(SAID).inner_text() != "You stopped it."
        assert "once for this visit" not in figure.locator(SAID).inner_text()


def test_an_endless_loop_is_stopped_and_the_figure_lives_on(visit, name):
    figure = the_figure(visit.page)
    figure.get_by_label("Draw with mine").uncheck()
    visit.page.evaluate(KEEP, ["compute_gae", ENDLESS])
    figure.get_by_label("Draw with mine").check()
    stop = figure.get_by_role("button", name="Stop drawing")
    stop.focus()
    visit.page.keyboard.press("Enter")
    figure.get_by_text("You stopped it.").wait_for()
    assert not figure.get_by_label("Draw with mine").is_checked() and not stop.is_visible()
    _, said = drawn_with(visit.page, ENDLESS)
    assert said == "It did not finish within 10 seconds. Is there a loop that never ends?"
    assert not figure.get_by_label("Draw with mine").is_checked()
    assert drawn_with(visit.page, RIGHT)[1].endswith("Here they are the same.")


def test_no_rule_of_accessibility_is_broken_and_nothing_leaves_the_machine(visit, name):
    drawn_with(visit.page, WRONG)
    assert [url for url in visit.requests if not url.startswith(("file:", "blob:", "data:"))] == []
    assert visit.complaints == []
    the_figure(visit.page).locator("details").evaluate("fold => { fold.open = true; }")
    assert axe.grave(axe.violations(visit.page)) == []


def test_a_tap_is_enough_on_a_phone(browser, html, name):
    with Visit(browser, html / f"{PAGE}.html", "phone") as visit:
        visit.page.evaluate(KEEP, ["compute_gae", WRONG])
        the_figure(visit.page).get_by_text("Draw with mine").tap()
        the_figure(visit.page).get_by_text("They differ here: advantage.").wait_for()
        assert visit.page.evaluate("document.documentElement.scrollWidth") <= 390


def test_firefox_draws_it_too(html, tmp_path, name):
    with Firefox(tmp_path) as firefox:
        firefox.open(html / f"{PAGE}.html")
        firefox.run(f"({KEEP})(arguments)", "compute_gae", WRONG)
        said = firefox.run(
            """const figure = [...document.querySelectorAll("figure.explorer")].find((one) => one.textContent.includes(arguments[0]));
            figure.querySelector("[type=checkbox]").click();
            while (!figure.querySelector("svg .mine")) await new Promise(requestAnimationFrame);
            return figure.querySelector("[role=status]").textContent;""",
            CREDIT,
        )
        assert said == "Yours is dashed, the book's is pale. They differ here: advantage."
        asked = firefox.run("return performance.getEntriesByType('resource').map((one) => one.name)")
        assert [url for url in asked if not url.startswith(("file:", "blob:", "data:"))] == []
