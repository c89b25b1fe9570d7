"""Which pages there are, and a visit to one of them in a browser without a network."""

from __future__ import annotations

from pathlib import Path

from autograder.authoring.chapter import all_chapters
from autograder.publishing.book import HOW_TO, docname

LOOKS = {  # colour scheme, width in CSS pixels
    "light": ("light", 1280),
    "dark": ("dark", 1280),
    "phone": ("light", 390),
}
PAGES = ["index", *HOW_TO, "notation", "kill-matrix", *(docname(chapter) for chapter in all_chapters())]
CHAPTERS = [page for page in PAGES if page.startswith("chapters/")]


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
