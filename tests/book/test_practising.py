"""Practice in the page, as a reader does it: from disk, without a network, in both browsers."""

from __future__ import annotations

import json
from pathlib import Path

import nbformat
import pytest

from autograder import checks
from autograder.authoring import chapter as chapters
from autograder.authoring import freeze
from autograder.proving import practice
from course_lib.checks.results import examined
from tests.book import axe
from tests.book.firefox import Firefox
from tests.book.visit import Visit

PAGE = "chapters/ch44_gae"
MORE_BEFORE_THE_FIRST_CLICK = 150_000  # bytes that practice may add to a page
ANSWERS = practice.answers(chapters.load("ch44"))
RIGHT = ANSWERS["compute_gae"]
WRONG = RIGHT.replace("ended = terminated | truncated", "ended = terminated")
ENDLESS = "def compute_gae(*args, **kwargs):\n    while True:\n        pass\n"
CHECK = "const [name, source] = arguments; return await coursePractice.check(name, source);"
pytestmark = pytest.mark.parametrize("name", [PAGE])


@pytest.fixture(scope="module")
def visit(browser, html):
    with Visit(browser, html / f"{PAGE}.html") as visit:
        yield visit


def the_exercise():
    return next(one for one in checks.exercises("ch44") if one.name == "compute_gae")


def the_notebook_says(source: str):
    """The notebook's CheckResult for the text of a cell, from real torch."""
    import torch

    from course_lib import validate

    space = {"torch": torch, "validate": validate}
    for text in (*ANSWERS.values(), source):
        exec(text, space)
    return examined(freeze.visible(the_exercise()), space["compute_gae"])


def write(page, text: str) -> None:
    """Replace what stands in the editor of compute_gae, which is opened if need be."""
    opener = page.get_by_role("button", name="Write your answer: compute_gae")
    if opener.count():
        opener.click()
    editor = page.get_by_role("textbox", name="Your answer to compute_gae")
    editor.focus()
    page.keyboard.press("ControlOrMeta+a")
    page.keyboard.insert_text(text)


def verdict(page) -> str:
    """Press Check, and read the box that comes."""
    page.get_by_role("button", name="Check compute_gae").click()
    return told(page)


def told(page) -> str:
    box = page.locator(".tag_exercise-compute_gae .practice-result:not([aria-busy]) .course-check")
    box.wait_for()
    return box.inner_text()


def test_two_tabs_of_a_page_show_one_text(browser, html, name):
    """Neither writes over what the other has not shown; what came from the other tab is one step to undo."""
    with Visit(browser, html / f"{PAGE}.html") as visit:
        one, two = visit.page, visit.context.new_page()
        two.goto(one.url)
        two.wait_for_function("window.coursePractice?.exercises.length")
        shown = "text => document.querySelector('.tag_exercise-compute_gae .cm-content')?.innerText.trim() === text"
        for page, other, text in ((one, two, "a = 1"), (two, one, "a = 12"), (one, two, "a = 123")):
            write(page, text)
            other.wait_for_function(shown, arg=text)
        two.get_by_role("textbox", name="Your answer to compute_gae").focus()
        two.keyboard.press("ControlOrMeta+z")
        two.wait_for_function(shown, arg="a = 12")
        one.wait_for_function(shown, arg="a = 12")


def test_before_the_first_click_a_page_loads_little_more(visit, html, name):
    own = {Path(url.removeprefix("file://").partition("?")[0]) for url in visit.requests if "practice" in url}
    assert {path.name for path in own} == {"practice.js", "practice.css"}
    assert sum(path.stat().st_size for path in own) <= MORE_BEFORE_THE_FIRST_CLICK


def test_every_exercise_that_is_offered_has_an_editor(visit, name):
    offered = visit.page.evaluate("coursePractice.exercises")
    assert offered == practice.offered_in("ch44") and offered
    assert visit.page.get_by_role("button", name="Check ").count() == len(offered)
    assert "points come from the grader" in visit.page.get_by_role("group", name="Practice").inner_text()


def test_a_mistake_is_named_in_the_notebooks_words(visit, name):
    assert WRONG != RIGHT
    write(visit.page, WRONG)
    seen, right = verdict(visit.page), the_notebook_says(WRONG)
    assert right.finding.misconceptions
    for words in (right.headline(), *right.lines(), *(" ".join(tick) for tick in right.ticks())):
        assert " ".join(words.split()) in " ".join(seen.split())
    answer = visit.page.evaluate("source => coursePractice.check('compute_gae', source)", WRONG)
    found = right.finding
    assert answer == {"state": found.state, "misconceptions": found.misconceptions, "message": found.message}


def test_a_right_answer_passes_and_is_counted(visit, name):
    write(visit.page, RIGHT)
    assert verdict(visit.page).startswith("✓ Passed: compute_gae")
    assert "1 of " in visit.page.get_by_role("group", name="Practice").inner_text()
    assert "✓ 1/" in visit.page.locator("nav.bd-links li.current.active").first.inner_text()
    visit.page.goto((Path(visit.page.url.removeprefix("file://")).parents[1] / "index.html").as_uri())
    assert "✓ 1/" in visit.page.locator("nav.bd-links").first.inner_text()
    visit.page.go_back()
    visit.page.wait_for_function("window.coursePractice?.exercises.length")


def test_an_endless_loop_is_stopped_and_the_page_lives_on(visit, name):
    write(visit.page, ENDLESS)
    visit.page.get_by_role("button", name="Check compute_gae").click()
    visit.page.get_by_text("Running …").wait_for()
    visit.page.get_by_role("button", name="Stop compute_gae").focus()
    visit.page.keyboard.press("Enter")
    assert "You stopped it." in told(visit.page)
    assert visit.page.evaluate("document.activeElement.getAttribute('aria-label')") == "Stop compute_gae"
    write(visit.page, RIGHT)
    assert verdict(visit.page).startswith("✓ Passed: compute_gae")


def test_what_ends_python_is_told_and_the_page_lives_on(visit, name):
    deep = "def compute_gae(*args, **kwargs):\n    return compute_gae(*args, **kwargs)\n"
    for source in (deep, "import os\nos._exit(1)\n", "raise KeyboardInterrupt\n"):
        answer = visit.page.evaluate("source => coursePractice.check('compute_gae', source)", source)
        assert answer["state"] == "error" and answer["message"], source
    assert visit.page.evaluate("source => coursePractice.check('compute_gae', source)", RIGHT)["state"] == "correct"


def test_what_is_stopped_while_it_starts_can_be_checked_again(browser, html, name):
    with Visit(browser, html / f"{PAGE}.html") as visit:
        write(visit.page, RIGHT)
        click = "document.querySelector('[aria-label=\"%s compute_gae\"]').click()"
        visit.page.evaluate(f"{click % 'Check'}, requestAnimationFrame(() => {click % 'Stop'})")
        assert "You stopped it." in told(visit.page)
        assert verdict(visit.page).startswith("✓ Passed: compute_gae")


def test_what_is_written_survives_a_reload(visit, name):
    write(visit.page, WRONG + "# mine")
    visit.page.reload()
    editor = visit.page.get_by_role("textbox", name="Your answer to compute_gae")
    editor.get_by_text("# mine").wait_for()
    visit.page.get_by_role("button", name="Reset compute_gae").click()
    editor.get_by_text("NotImplementedError").wait_for()
    visit.page.reload()
    visit.page.get_by_role("button", name="Write your answer: compute_gae").wait_for()


def test_the_keyboard_is_enough(visit, name):
    page = visit.page
    page.reload()
    page.get_by_role("button", name="Write your answer: compute_gae").focus()
    page.keyboard.press("Enter")
    editor = page.get_by_role("textbox", name="Your answer to compute_gae")
    page.wait_for_function("document.activeElement.classList.contains('cm-content')")
    page.keyboard.press("ControlOrMeta+End")
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    page.keyboard.type("pass")
    editor.get_by_text("pass", exact=True).wait_for()  # Tab did not leave
    page.keyboard.press("ControlOrMeta+z")
    page.keyboard.press("ControlOrMeta+a")
    page.keyboard.insert_text(RIGHT)
    page.keyboard.press("Control+Enter")
    assert told(page).startswith("✓ Passed: compute_gae")
    page.keyboard.press("Escape")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.getAttribute('aria-label')") == "Check compute_gae"
    page.keyboard.press("Enter")
    assert told(page).startswith("✓ Passed: compute_gae")
    assert page.evaluate("document.activeElement.getAttribute('aria-label')") == "Check compute_gae"


def test_answers_are_taken_along_in_the_chapters_notebook(visit, html, tmp_path, name):
    write(visit.page, RIGHT)
    with visit.page.expect_download() as download:
        visit.page.get_by_role("button", name="Take my answers along").click()
    download.value.save_as(tmp_path / "ch44.ipynb")
    taken = nbformat.read(tmp_path / "ch44.ipynb", as_version=4)
    nbformat.validate(taken)
    released = nbformat.read(next(html.glob("_downloads/*/ch44.ipynb")), as_version=4)
    for mine, given in zip(taken.cells, released.cells, strict=True):
        if given.metadata.get("nbgrader", {}).get("grade_id") == "compute_gae":
            assert mine.source.strip() == RIGHT.strip()
            given.source = mine.source
        assert mine == given


def test_drafts_are_saved_to_a_file_and_loaded_again(visit, tmp_path, name):
    page = visit.page
    write(page, WRONG)
    with page.expect_download() as download:
        page.get_by_role("button", name="Save drafts to a file").click()
    download.value.save_as(tmp_path / "drafts.json")
    assert json.loads((tmp_path / "drafts.json").read_text(encoding="utf-8"))["drafts"]["compute_gae"].strip() == WRONG.strip()
    page.get_by_role("button", name="Reset compute_gae").click()
    page.get_by_label("A file with drafts").set_input_files(tmp_path / "drafts.json")
    page.get_by_text("Loaded ").wait_for()
    assert page.evaluate("coursePractice.drafts().compute_gae").strip() == WRONG.strip()
    (tmp_path / "other.json").write_text("[]", encoding="utf-8")
    page.get_by_label("A file with drafts").set_input_files(tmp_path / "other.json")
    page.get_by_text("holds no drafts of this book").wait_for()


def test_a_browser_that_keeps_nothing_says_so_and_practice_works(browser, html, name):
    with Visit(browser, html / f"{PAGE}.html") as visit:
        visit.context.add_init_script(
            "Object.defineProperty(window, 'localStorage', {get() { throw new DOMException('', 'SecurityError'); }})"
        )
        visit.page.reload()
        assert "keeps nothing" in visit.page.get_by_role("group", name="Practice").inner_text()
        write(visit.page, RIGHT)
        assert verdict(visit.page).startswith("✓ Passed: compute_gae")


@pytest.mark.parametrize("look", ["light", "dark", "phone"])
def test_no_rule_of_accessibility_is_broken_and_nothing_sticks_out(browser, html, name, look):
    with Visit(browser, html / f"{PAGE}.html", look) as visit:
        write(visit.page, f"import math\n{WRONG}\nprint('seen', True and 1.5)  # a comment\n" + "long = " + "1 + " * 60 + "1\n")
        assert verdict(visit.page)
        assert visit.page.evaluate("document.documentElement.scrollWidth") == visit.page.viewport_size["width"]
        assert axe.grave(axe.violations(visit.page)) == []


def test_nothing_was_asked_of_another_machine(visit, name):
    assert [url for url in visit.requests if not url.startswith(("file:", "blob:", "data:"))] == []
    assert visit.complaints == []


def test_firefox_does_the_same(html, tmp_path, name):
    with Firefox(tmp_path) as firefox:
        firefox.open(html / f"{PAGE}.html")
        refused = firefox.run("return fetch('../index.html').then(() => false, () => true)")
        assert refused, "pages from disk may read each other here, as no reader's Firefox lets them"
        right, found = firefox.run(CHECK, "compute_gae", RIGHT), the_notebook_says(WRONG).finding
        assert right["state"] == "correct"
        wrong = firefox.run(CHECK, "compute_gae", WRONG)
        assert wrong == {"state": found.state, "misconceptions": found.misconceptions, "message": found.message}
        assert firefox.run(CHECK, "compute_gae", ENDLESS)["state"] == "timeout"  # after the ten seconds that an answer has
        assert firefox.run(CHECK, "compute_gae", RIGHT)["state"] == "correct"

        firefox.run("document.querySelector('[aria-label=\"Write your answer: compute_gae\"]').focus()")
        firefox.press("Enter")
        firefox.run("while (!document.activeElement.classList.contains('cm-content')) await new Promise(requestAnimationFrame)")
        firefox.press("Control+End", "Enter", "Tab", *"# mine")
        firefox.press("Control+Enter")
        firefox.run(
            "while (!document.querySelector('.tag_exercise-compute_gae .course-check')) await new Promise(requestAnimationFrame)"
        )
        assert "Not implemented yet: compute_gae" in firefox.run(
            "return document.querySelector('.tag_exercise-compute_gae').innerText"
        )
        firefox.press("Escape", "Tab")
        assert firefox.run("return document.activeElement.getAttribute('aria-label')") == "Check compute_gae"
        firefox.open(html / f"{PAGE}.html")
        firefox.run(
            "while (!document.querySelector('.tag_exercise-compute_gae .cm-content')) await new Promise(requestAnimationFrame)"
        )
        assert "    # mine" in firefox.run("return coursePractice.drafts().compute_gae")
        asked = firefox.run("return performance.getEntriesByType('resource').map((one) => one.name)")
        assert [url for url in asked if not url.startswith(("file:", "blob:", "data:"))] == []
