"""What on a page answers to its reader: sliders, folds and quizzes, by keyboard and by touch."""

from __future__ import annotations

from unittest.mock import patch

import pytest

from autograder.authoring.chapter import all_chapters
from autograder.publishing.book import docname
from course_lib.chapters import REFERENCES
from tests.book.visit import CHAPTERS, Visit


@pytest.mark.parametrize("chapter", all_chapters(), ids=lambda chapter: chapter.assignment)
def test_sliders_moved_by_keyboard_show_the_librarys_own_values(browser, html, chapter, monkeypatch):
    monkeypatch.setenv(REFERENCES, "solutions")  # for functions that a chapter takes over from an earlier one
    with Visit(browser, html / f"{docname(chapter)}.html") as visit:
        figures = visit.page.locator("figure.explorer").all()
        assert figures
        for figure, (series, choices) in zip(figures, _explorers(chapter), strict=True):
            sliders = figure.get_by_role("slider").all()
            for slider in sliders:
                pictures = set()
                slider.focus()
                for key in ("Home", "ArrowRight", "End"):
                    visit.page.keyboard.press(key)
                    pictures.add(figure.evaluate("node => [...node.querySelectorAll('svg')].map(svg => svg.innerHTML).join()"))
                    positions = [int(one.input_value()) for one in sliders]
                    setting = {name: values[at] for (name, values), at in zip(choices.items(), positions, strict=True)}
                    assert figure.locator("output").all_text_contents() == [
                        value if isinstance(value, str) else f"{value:g}" for value in setting.values()
                    ]
                    assert _shown(figure) == _computed(series(**setting)), setting
                assert len(pictures) > 1


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


def _shown(figure):
    """The figure's table, series by series, read while it is folded."""
    rows = figure.evaluate(
        "node => [...node.querySelectorAll('tbody tr')].map(row => [...row.cells].map(cell => cell.textContent))"
    )
    return {name: [float(value or "nan") for value in values] for name, *values in rows}


def _computed(series):
    """What the table must hold: three significant digits are shown."""
    return {name: pytest.approx(list(map(float, one.y)), rel=6e-3, abs=1e-6, nan_ok=True) for name, one in series.items()}


@pytest.mark.parametrize("name", CHAPTERS)
def test_a_fold_opens_by_keyboard(browser, html, name):
    with Visit(browser, html / f"{name}.html") as visit:
        fold = visit.page.locator("article details", has_text="Hint 1").first
        body = fold.locator("p").last
        assert not body.is_visible()
        fold.locator("summary").focus()
        visit.page.keyboard.press("Enter")
        assert body.is_visible()


@pytest.mark.parametrize("chapter", all_chapters(), ids=lambda chapter: chapter.assignment)
def test_quizzes_explain_every_answer_by_keyboard(browser, html, chapter):
    with Visit(browser, html / f"{docname(chapter)}.html") as visit:
        quizzes = visit.page.locator("div.quiz").all()
        assert len(quizzes) == chapter.path.read_text(encoding="utf-8").count(":::{quiz}") > 0
        for quiz in quizzes:
            form, verdict = quiz.get_by_role("group"), quiz.get_by_role("status")
            assert form.evaluate("node => node.querySelector('legend').textContent.trim()")
            assert verdict.text_content() == "" and quiz.locator("details").count() == 0
            answers, heard = form.get_by_role("radio").all(), []
            answers[0].focus()
            for answer, key in zip(answers, ["Space", *["ArrowDown"] * len(answers)], strict=False):
                visit.page.keyboard.press(key)
                assert answer.is_checked() and verdict.is_visible()
                heard.append(verdict.inner_text())
            assert len(set(heard)) == len(answers)
            assert sorted(text.split()[0] for text in heard) == ["Right."] + ["Wrong."] * (len(answers) - 1)


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
