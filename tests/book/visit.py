"""Which pages there are, a visit to one of them in a browser without a network, and what a visit sees."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from autograder.authoring.chapter import all_chapters
from autograder.publishing.book import HOW_TO, docname
from tests.book import axe

SCREENSHOTS = Path(__file__).resolve().parents[2] / "test-artefacts"

LOOKS = {  # colour scheme, width in CSS pixels
    "light": ("light", 1280),
    "dark": ("dark", 1280),
    "phone": ("light", 390),
}
PAGES = [
    "index",
    *HOW_TO,
    "notation",
    "kill-matrix",
    "practice",
    "atlas",
    "format",
    *(docname(chapter) for chapter in all_chapters()),
]
CHAPTERS = [page for page in PAGES if page.startswith("chapters/")]


class Visit:
    """A page opened from disk, with what it asked for elsewhere and what it complained of."""

    def __init__(self, browser, path: Path, look: str = "light", query: str = ""):
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
        self.page.goto(path.as_uri() + query)
        self.page.wait_for_function("!window.MathJax || (MathJax.startup.promise && MathJax.startup.promise.then(() => true))")

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.context.close()


@dataclass(frozen=True)
class Seen:
    """A page in one look, written down as it was visited; lists name places."""

    requests: list[str]
    complaints: list[str]
    width: int  # of all that is on it, in CSS pixels
    equations_on_lines_of_their_own: int
    equations_that_begin_beyond_the_edge: list[str]
    equations_wider_than_their_column: list[str]
    equations_with_errors: list[str]
    equations_not_rendered: list[str]
    downloads: list[str]  # where the links to notebooks lead
    references: list[tuple[str, bool]]  # the folds with reference solutions: text, open?
    code_cut_off: list[dict] = field(default_factory=list)
    """Of input cells, folded or not, blocks that are wider than their column: {lines, columns that fit}. Not on phones."""
    paper: dict | None = None  # what the page shows in print; of chapters, in the dark
    violations: list[str] = field(default_factory=list)
    """Of axe's rules, serious or critical, with every fold open and every quiz answered. Not on phones."""


EQUATIONS = """() => {
  const all = (what) => [...document.querySelectorAll(what)];
  const name = (node) => node.closest("div.math[id]")?.id || node.innerText || node.outerHTML.slice(0, 120);
  const blocks = all("div.math");
  return {
    equations_on_lines_of_their_own: all("div.math mjx-container").length,
    equations_that_begin_beyond_the_edge:
      all("div.math mjx-container").filter((one) => one.getBoundingClientRect().left < 0).map(name),
    equations_wider_than_their_column: blocks.filter((one) => one.scrollWidth > one.clientWidth).map(name),
    equations_with_errors: all("mjx-merror").map((one) => one.textContent),
    equations_not_rendered: all("span.math:not(:has(mjx-container)), div.math:not(:has(mjx-container))").map(name),
  };
}"""
CODE = """() => [...document.querySelectorAll("div.cell_input pre")].flatMap((pre) => {
  if (pre.scrollWidth <= pre.clientWidth) return [];
  const style = getComputedStyle(pre), lines = pre.textContent.split("\\n"), ruler = document.createElement("span");
  ruler.textContent = "0".repeat(100);
  const one = pre.appendChild(ruler).getBoundingClientRect().width / 100;
  ruler.remove();
  const columns = Math.floor((pre.clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight) + 0.01) / one);
  const long = lines.filter((line) => line.length > columns), longest = Math.max(...lines.map((line) => line.length));
  return [{lines: long.length ? long : lines.filter((line) => line.length === longest), columns}];
})"""
WIDTH = "document.documentElement.scrollWidth"
OPEN = "document.querySelectorAll('details').forEach(fold => { fold.open = true; })"


VISIBLE = (
    "[...document.querySelectorAll('body *')].map((one) => Number(one.checkVisibility({visibilityProperty: true}))).join('')"
)
STILL = """theme => new Promise((done) => {
  const ends = (one) => Number.isFinite(one.effect?.getComputedTiming().endTime);
  const look = () => document.documentElement.dataset.theme === theme
    ? Promise.allSettled(document.getAnimations().filter(ends).map((one) => one.finished)).then(() => done())
    : requestAnimationFrame(look);
  look();
})"""


def look_at_wide(browser, html: Path, name: str) -> dict[str, Seen]:
    """A page loaded in the dark, and looked at in the dark and in the light: untouched, and then, with every fold open and every quiz
    answered, by axe. Its rules on anything but colours see the same page twice, so they run twice only if what is visible differs."""
    with Visit(browser, html / f"{name}.html", "dark") as visit:
        page = visit.page
        seen = {"dark": _untouched(visit, name, "dark")}
        paper = _on_paper(page, name) if name in CHAPTERS else None
        _turn(page, "light")
        seen["light"] = _untouched(visit, name, "light")
        page.evaluate(OPEN)
        code_cut_off = page.evaluate(CODE)
        for answer in page.locator("div.quiz label:last-of-type input").all():
            answer.check()
        visible = page.evaluate(VISIBLE)
        in_the_light = axe.grave(axe.violations(page))
        _turn(page, "dark")
        in_the_dark = axe.grave(axe.violations(page, colours_only=page.evaluate(VISIBLE) == visible))
    return {
        "dark": replace(seen["dark"], code_cut_off=code_cut_off, paper=paper, violations=in_the_dark),
        "light": replace(seen["light"], code_cut_off=code_cut_off, violations=in_the_light),
    }


def look_at_phone(browser, html: Path, name: str) -> Seen:
    """A page as a phone shows it, untouched, in the light."""
    with Visit(browser, html / f"{name}.html", "phone") as visit:
        return _untouched(visit, name, "phone")


def _untouched(visit: Visit, name: str, look: str) -> Seen:
    """All that is to be seen on a page without touching it."""
    SCREENSHOTS.mkdir(exist_ok=True)
    page = visit.page
    page.wait_for_timeout(200)  # whatever scripts load late
    page.screenshot(path=SCREENSHOTS / f"{Path(name).name}-{look}.png", full_page=True)
    folds = page.locator("details", has_text="Reference solution")
    return Seen(
        width=page.evaluate(WIDTH),
        **page.evaluate(EQUATIONS),
        downloads=page.locator("article a[href$='.ipynb']").evaluate_all("all => all.map(one => one.getAttribute('href'))"),
        references=folds.evaluate_all("all => all.map(one => [one.textContent, one.open])"),
        requests=list(visit.requests),  # before axe reads style sheets
        complaints=list(visit.complaints),
    )


def _turn(page, theme: str) -> None:
    """Follow the reader's system from the dark into the light, or back, and wait until nothing moves."""
    page.emulate_media(color_scheme=theme)
    page.evaluate(STILL, theme)


def _on_paper(page, name: str) -> dict:
    """The page in print, as its reader has left it; the screen is as before afterwards."""
    page.emulate_media(media="print")
    page.pdf(path=SCREENSHOTS / f"{Path(name).name}.pdf", format="A4")
    before = page.viewport_size
    page.set_viewport_size({"width": 720, "height": 1000})  # about what A4 leaves between its margins
    page.screenshot(path=SCREENSHOTS / f"{Path(name).name}-print.png", full_page=True)
    gone = (".bd-sidebar-primary", ".bd-sidebar-secondary", ".bd-header-article", ".prev-next-footer")
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    paper = {
        "pixels beyond its edge": max(0, page.evaluate(WIDTH) - 720),
        "shown": [part for part in gone if page.locator(part).first.is_visible()],
        "background": background.replace("rgba(0, 0, 0, 0)", "rgb(255, 255, 255)"),  # what is not painted stays white
        "open folds": page.locator("article details[open] > summary").all_text_contents(),
    }
    page.set_viewport_size(before)
    page.emulate_media(media="screen")
    page.evaluate(STILL, "dark")
    return paper
