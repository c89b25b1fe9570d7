"""The appendix on the format tells of everything that a chapter may hold, and its example is such a chapter."""

import re

import pytest

from autograder.authoring import chapter, markdown
from autograder.publishing.format_page import PATTERN, format_page, functions

TABLES = {
    "front matter": chapter.FRONT_MATTER | chapter.OPTIONAL,
    "options": chapter.OPTIONS,
    "questions": chapter.QUESTION,
    "tags": chapter.TAGS,
    "directives": markdown.DIRECTIVES,
    "options of directives": markdown.OPTIONS,
    "roles": markdown.ROLES,
}
MODULES = ("autograder.authoring.parts", "course_lib.validate", "course_lib.checks.views")


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_everything_that_is_accepted_is_described_in_one_line_and_on_the_page(table):
    page = format_page()
    for name, option in table.items():
        says = getattr(option, "says", option)
        assert len(says) > 12 and says.rstrip("`").endswith((".", "`")) and "\n" not in says, name
        assert re.search(rf"^\| `{re.escape(name)}` \|.*{re.escape(says)} \|$", page, re.MULTILINE), name


@pytest.mark.parametrize("module", MODULES)
def test_every_function_that_authors_call_is_described(module):
    found = functions(module)
    assert found and all(f"| `{name}` | " in format_page() for name, _ in found)
    assert [name for name, says in found if len(says) < 12] == []


def test_admonitions_are_directives():
    assert markdown.ADMONITIONS.keys() < markdown.DIRECTIVES.keys()


def test_the_example_is_a_chapter_and_has_everything_that_chapters_are_made_of(tmp_path):
    body = PATTERN.removeprefix("````markdown\n").removesuffix("\n````")
    front = "chapter: 1\ntitle: T\nminutes: 1\nprerequisites: []\nbuilds: b\nsummary: s"
    path = tmp_path / "ch1_example.md"
    path.write_text(f"---\n{front}\n---\n\n{body}\n", encoding="utf-8")
    page = chapter.parse(path)
    assert [cell.exercise for cell in page.exercises] == ["td_residuals"]
    assert [cell.open_question for cell in page.open_questions] == ["why_residuals"]
    assert [bool(cell.alt) for cell in page.cells if "live" in cell.tags] == [True]
    prose = "\n".join(cell.source for cell in page.cells if cell.kind == "markdown")
    assert {block.kind for block in markdown.parse(prose)} == {"text", "math", "dropdown", "margin", "quiz"}
    assert all(f"{{{role}}}" in prose for role in ("cite:p", "eq"))


def test_the_tables_on_the_page_are_whole():
    for table in re.findall(r"(?:^\|.*\n)+", format_page(), re.MULTILINE):
        assert len({len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines()}) == 1, table
