"""The built pages as a reader meets them: opened from disk, with no network."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import patch

import pytest
from axe_playwright_python.sync_playwright import Axe

from autograder.book import HOW_TO, docname
from autograder.chapter import all_chapters
from autograder.contract import references, sources
from course_lib.chapters import REFERENCES

SCREENSHOTS = Path(__file__).resolve().parents[2] / "test-artefacts"
LOOKS = {  # colour scheme, width in CSS pixels
    "light": ("light", 1280),
    "dark": ("dark", 1280),
    "phone": ("light", 390),
}
PAGES = ["index", *HOW_TO, "notation", "kill-matrix", *(docname(chapter) for chapter in all_chapters())]
CHAPTERS = [page for page in PAGES if page.startswith("chapters/")]


def _id(chapter):
    return chapter.assignment


class Visit:
    """A page opened from disk, with what it asked for elsewhere and what it complained of."""

    def __init__(self, browser, path: Path, look: str = "light"):
        scheme, width = LOOKS[look]
        self.context = browser.new_context(
            color_scheme=scheme, viewport={"width": width, "height": 900}, has_touch=look == "phone", offline=True
        )
        self.page = self.context.new_page()
        self.page.set_default_timeout(120_000)  # a busy machine is slow, not wrong
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
def test_no_equation_is_wider_than_its_column(browser, html, name):
    with Visit(browser, html / f"{name}.html") as visit:
        cut = "all => all.filter(one => one.scrollWidth > one.clientWidth).map(one => one.id || one.innerText)"
        assert visit.page.locator("div.math").evaluate_all(cut) == [], "break it into lines (aligned): its number is cut off"


@pytest.mark.parametrize("chapter", all_chapters(), ids=_id)
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
    with patch("course_lib.interactive.explore", explore), silent[0], silent[1]:
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


@pytest.mark.parametrize("chapter", all_chapters(), ids=_id)
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


@pytest.mark.parametrize("name", CHAPTERS)
def test_the_printed_page_is_the_article_as_the_reader_left_it(browser, html, name):
    with Visit(browser, html / f"{name}.html", "dark") as visit:
        visit.page.emulate_media(media="print")
        visit.page.pdf(path=SCREENSHOTS / f"{Path(name).name}.pdf", format="A4")
        visit.page.set_viewport_size({"width": 720, "height": 1000})  # about what A4 leaves between its margins
        visit.page.screenshot(path=SCREENSHOTS / f"{Path(name).name}-print.png", full_page=True)
        assert visit.page.evaluate("document.documentElement.scrollWidth") <= 720
        for gone in (".bd-sidebar-primary", ".bd-sidebar-secondary", ".bd-header-article", ".prev-next-footer"):
            assert not visit.page.locator(gone).first.is_visible()
        assert visit.page.evaluate("getComputedStyle(document.body).backgroundColor") in (
            "rgb(255, 255, 255)",
            "rgba(0, 0, 0, 0)",
        )
        assert visit.page.locator("article details[open]").count() == 0


@pytest.mark.parametrize("name", CHAPTERS)
def test_notebook_can_be_downloaded_from_its_page(browser, html, name):
    with Visit(browser, html / f"{name}.html") as visit:
        target = visit.page.locator("article a[href$='.ipynb']").first.get_attribute("href")
        assert (html / name).parent.joinpath(target).resolve().is_file()


@pytest.mark.parametrize("chapter", all_chapters(), ids=_id)
def test_every_reference_is_on_its_page_folded(browser, html, chapter):
    with Visit(browser, html / f"{docname(chapter)}.html") as visit:
        folded = visit.page.locator("details", has_text="Reference solution")
        shown = folded.all_text_contents()
        assert folded.evaluate_all("nodes => nodes.filter(node => node.open).length") == 0
    for reference in references(chapter, sources(chapter)).values():
        assert any(reference.body.strip() in text for text in shown)


@pytest.mark.parametrize("chapter", all_chapters(), ids=_id)
def test_search_finds_a_word_of_the_chapter_from_disk(browser, html, chapter):
    with Visit(browser, html / "search.html") as visit:
        visit.page.goto(f"{(html / 'search.html').as_uri()}?q={chapter.exercises[0].exercise}")
        visit.page.wait_for_selector("ul.search li")
        assert f"{docname(chapter)}.html" in visit.page.locator("ul.search").inner_html()
        assert visit.complaints == []


def test_published_tree_holds_nothing_of_the_build(html):
    names = {part for path in html.rglob("*") for part in path.relative_to(html).parts}
    assert not names & {"_sources", ".doctrees", ".jupyter_cache", "jupyter_execute", ".buildinfo", "objects.inv"}
