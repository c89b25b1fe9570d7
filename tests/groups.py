"""Which tests run in one worker, one after the other, and which are about one chapter."""

from __future__ import annotations

import re

PAGE = re.compile(r"^(?:chapters/)?(ch\d+)(?:_\w+)?$")
ID = re.compile(
    r"\[(?:chapters/)?(ch\d+|how-to/\w+|index|cheat-sheet|notation|kill-matrix|threat-model|practice|atlas|autograd|format)"
)
# The files that take longest, in seconds of one core: they begin first, so that none is left over at the end.
LONGEST = {
    "tests/autograder/proving/test_killmatrix.py": 300,
    "tests/autograder/grading/test_sandbox.py": 120,
    "tests/book/test_how_to.py": 100,
    "tests/e2e/test_every_answer.py": 90,
    "tests/e2e/test_robots.py": 60,
    "tests/e2e/test_stock_nbgrader.py": 60,
    "tests/autograder/publishing/test_run_all.py": 60,
}
A_PAGE = 60


def group_of(nodeid: str) -> str:
    """The page that a test of tests/book is about, as all that look at it share its visits; else its file."""
    file, _, rest = nodeid.partition("::")
    if file.startswith("tests/book/") and (match := ID.search(rest)):
        return f"page {match[1]}"
    return file


def weight(group: str) -> int:
    """About how long a group takes."""
    return LONGEST.get(group, A_PAGE if group.startswith("page ch") else 0)


def is_about(item, chapter: str) -> bool:
    """Whether a test is parametrised with the chapter "ch44", by id, page or object, or lies in a file for it or for any one chapter."""
    name = item.path.stem
    if name == "test_every_answer":
        return True
    found = {_chapter(value) for value in _parameters(item)} - {None}
    return chapter in found if found else bool(re.fullmatch(rf"test_{chapter}(_\w+)?", name))


def _parameters(item) -> list:
    callspec = getattr(item, "callspec", None)
    return list(callspec.params.values()) if callspec else []


def _chapter(value) -> str | None:
    """The chapter that a parameter means, if it means one."""
    text = getattr(value, "assignment", value)
    match = PAGE.match(text) if isinstance(text, str) else None
    return match[1] if match else None
