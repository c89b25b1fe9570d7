"""What on a page answers to its reader: sliders, folds and quizzes, by keyboard and by touch."""

from __future__ import annotations

import functools
from unittest.mock import patch

import pytest

from autograder.authoring.chapter import all_chapters
from autograder.publishing.book import docname
from course_lib.chapters import REFERENCES
from tests.book.visit import CHAPTERS, Visit


@pytest.fixture(scope="module", params=all_chapters(), ids=lambda chapter: chapter.assignment)
def chapter(request):
    return request.param


@pytest.fixture(scope="module")
def page(browser, html, chapter):
    """The chapter's page, opened once for all that answers to the keyboard: a fold, a quiz and a slider do not touch one another."""
    with Visit(browser, html / f"{docname(chapter)}.html") as visit:
        yield visit.page


def test_a_fold_opens_by_keyboard(page):
    fold = page.locator("article details", has_text="Hint 1").first
    body = fold.locator("p").last
    assert not body.is_visible()
    fold.locator("summary").focus()
    page.keyboard.press("Enter")
    assert body.is_visible()


def test_quizzes_explain_every_answer_by_keyboard(page, chapter):
    quizzes = page.locator("div.quiz").all()
    assert len(quizzes) == chapter.path.read_text(encoding="utf-8").count(":::{quiz}") > 0
    for quiz in quizzes:
        form, verdict = quiz.get_by_role("group"), quiz.get_by_role("status")
        assert form.evaluate("node => node.querySelector('legend').textContent.trim()")
        assert verdict.text_content() == "" and quiz.locator("details").count() == 0
        answers, heard = form.get_by_role("radio").all(), []
        answers[0].focus()
        for answer, key in zip(answers, ["Space", *["ArrowDown"] * len(answers)], strict=False):
            page.keyboard.press(key)
            assert answer.is_checked() and verdict.is_visible()
            heard.append(verdict.inner_text())
        assert len(set(heard)) == len(answers)
        assert sorted(text.split()[0] for text in heard) == ["Right."] + ["Wrong."] * (len(answers) - 1)


def test_sliders_moved_by_keyboard_show_the_librarys_own_values(page, chapter, monkeypatch):
    monkeypatch.setenv(REFERENCES, "solutions")  # for functions that a chapter takes over from an earlier one
    figures = page.locator("figure.explorer").all()
    assert figures
    for figure, (series, choices) in zip(figures, _explorers(chapter), strict=True):
        computed = functools.cache(lambda series=series, **setting: _computed(series(**setting)))
        for slider in figure.get_by_role("slider").all():
            pictures = set()
            slider.focus()
            for key in ("Home", "ArrowRight", "End"):
                page.keyboard.press(key)
                shown = figure.evaluate(SHOWN)
                pictures.add(shown["picture"])
                setting = {name: values[at] for (name, values), at in zip(choices.items(), shown["positions"], strict=True)}
                assert shown["outputs"] == [value if isinstance(value, str) else f"{value:g}" for value in setting.values()]
                table = {name: [float(value or "nan") for value in values] for name, *values in shown["rows"]}
                assert table == computed(**setting), setting
            assert len(pictures) > 1


# What a figure shows: where its sliders stand, what is written beside them, its pictures, and its table, read while it is folded.
SHOWN = """figure => ({
  positions: [...figure.querySelectorAll("input[type=range]")].map((slider) => Number(slider.value)),
  outputs: [...figure.querySelectorAll("output")].map((output) => output.textContent),
  picture: [...figure.querySelectorAll("svg")].map((svg) => svg.innerHTML).join(),
  rows: [...figure.querySelectorAll("tbody tr")].map((row) => [...row.cells].map((cell) => cell.textContent)),
})"""


def _explorers(chapter):
    """What the chapter gives to `explore`: functions of the sliders, and the sliders' choices; stubs are the references."""
    given, namespace = [], {}
    own = {"title", "x_label", "start"}

    def explore(series, **options):
        given.append((series, {name: values for name, values in options.items() if name not in own}))

    code = [cell for cell in chapter.cells if cell.kind == "code"]
    last = max(at for at, cell in enumerate(code) if "explore(" in cell.source)
    silent = patch("matplotlib.pyplot.show"), patch("IPython.display.display")
    with patch("course_lib.figures.interactive.explore", explore), silent[0], silent[1]:
        for cell in code[: last + 1]:
            source = f"from solutions.{chapter.assignment} import {cell.exercise}" if cell.exercise else cell.source
            exec(source, namespace)
    return given


def _computed(series):
    """What the table must hold: three significant digits are shown."""
    return {name: pytest.approx(list(map(float, one.y)), rel=6e-3, abs=1e-6, nan_ok=True) for name, one in series.items()}


@pytest.mark.parametrize("name", CHAPTERS)
def test_quizzes_answer_to_a_tap_on_the_words(browser, html, name):
    with Visit(browser, html / f"{name}.html", "phone") as visit:
        quiz = visit.page.locator("div.quiz").first
        quiz.locator("label > span").last.tap()
        assert quiz.get_by_role("radio").last.is_checked()
        assert quiz.get_by_role("status").is_visible()


@pytest.mark.parametrize("name", CHAPTERS)
def test_quizzes_without_scripts_are_lists_with_a_fold(browser, html, name):
    context = browser.new_context(java_script_enabled=False, offline=True)
    page = context.new_page()
    page.goto((html / f"{name}.html").as_uri())
    quiz = page.locator("div.quiz").first
    explanations = quiz.locator("details li")
    assert quiz.locator(":scope > ol > li").count() == explanations.count() > 1
    assert not explanations.first.is_visible()
    quiz.locator("summary").click()
    assert explanations.first.is_visible()
    context.close()
