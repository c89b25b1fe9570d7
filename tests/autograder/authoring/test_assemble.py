import dataclasses
import re

import nbformat
import pytest
from nbformat.v4 import new_output

from autograder.authoring import assemble
from autograder.authoring.chapter import ChapterError


@pytest.fixture(scope="module")
def rendered(tiny):
    sources = tiny.sources(tiny.chapter)
    return {
        "book": assemble.for_book(tiny.chapter, tiny.outputs, sources=sources),
        "unsolved": assemble.for_book(tiny.chapter, tiny.outputs, with_solutions=False, sources=sources),
        "student": assemble.for_learners(tiny.chapter, tiny.outputs, sources),
        "unrecorded": assemble.for_learners(tiny.chapter, sources=sources),
        "nbgrader": assemble.for_nbgrader(tiny.chapter, tiny.outputs, sources),
    }


def _sources(notebook):
    return {cell.id: cell.source for cell in notebook.cells}


def test_the_assignment_lists_points_in_the_chapters_order(tiny):
    found = assemble.outline(tiny.chapter, tiny.sources(tiny.chapter))
    assert found == assemble.Outline("ch99", (("double", 1.0), ("quadruple", 3.0)), (("why_double", 2.0),))


@pytest.mark.parametrize("name", ["book", "unsolved", "student", "unrecorded", "nbgrader"])
def test_every_rendering_is_a_valid_notebook_for_python3(rendered, name):
    nbformat.validate(rendered[name])
    assert rendered[name].metadata.kernelspec.name == "python3"


def test_assembling_twice_gives_the_same_bytes(tiny, rendered):
    again = assemble.for_learners(tiny.chapter, tiny.outputs, tiny.sources(tiny.chapter))
    assert nbformat.writes(again) == nbformat.writes(rendered["student"])


def test_pages_open_with_the_facts(rendered):
    assert rendered["student"].cells[0].source.splitlines() == [
        "# 99. A tiny chapter: twice",
        "",
        "- **Time:** about 1 hour 30 minutes",
        "- **Before this:** [chapter 98](../ch98/ch98.ipynb)",
        "- **You will have built:** a function that doubles, and one that uses it.",
        "- **Graded:** 2 exercises (4 points), open questions for a teacher (2 points)",
    ]
    assert "[chapter 98](ch98_before.ipynb)" in rendered["book"].cells[0].source


def test_exercises_are_announced_with_number_difficulty_minutes_and_criteria(rendered):
    for name in ("book", "student"):
        heading, facts = _sources(rendered[name])["ch99-004"].split("\n\n")[:2]
        assert heading == "### Exercise 99.2: Twice twice"
        assert facts == "`quadruple` · difficulty ●●● (3 of 3) · about 1 hour 10 minutes"
        assert "**3 points:** 2.5 if it returns the right values" in _sources(rendered[name])["ch99-005-points"]


def test_the_book_shows_stub_then_check_with_output_then_folded_reference(rendered):
    cells = {cell.id: cell for cell in rendered["book"].cells}
    order = list(cells)
    stub = order.index("ch99-003")
    assert order[stub - 1 : stub + 3] == ["ch99-003-points", "ch99-003", "ch99-test_double", "ch99-003-reference"]
    assert cells["ch99-003"].source.endswith("raise NotImplementedError") and not cells["ch99-003"].outputs
    assert cells["ch99-test_double"].source == "check(double)"
    assert cells["ch99-test_double"].outputs[0].text == "double: all checks pass\n"
    folded = cells["ch99-003-reference"].source
    assert folded.startswith("::::{dropdown} Reference solution\n") and "total = x + x" in folded


def test_live_and_book_only_cells_keep_their_outputs_in_the_book_with_words_for_pictures(rendered):
    cells = {cell.id: cell for cell in rendered["book"].cells}
    assert cells["ch99-006"].outputs[0].text == "2.0\n" and cells["ch99-006"].metadata.tags == ["hide-input"]
    assert "image/png" in cells["ch99-007"].outputs[1].data
    assert cells["ch99-007"].metadata.mystnb.image.alt == "A rising line."


def test_a_picture_without_words_is_refused_by_line(tiny):
    cells = [dataclasses.replace(cell, alt="") for cell in tiny.chapter.cells]
    wordless = next(cell for cell in cells if "book-only" in cell.tags)
    with pytest.raises(ChapterError, match=rf"ch99_tiny.md:{wordless.line}: this cell shows a picture: say .* `alt: …`"):
        assemble.for_book(dataclasses.replace(tiny.chapter, cells=tuple(cells)), tiny.outputs, sources=tiny.sources(tiny.chapter))


def test_a_book_without_solutions_holds_no_line_of_them(rendered):
    text = nbformat.writes(rendered["unsolved"])
    for line in ("total = x + x", "adding needs no", "validate.unit_interval", "for _ in range", "Reference solution"):
        assert line in nbformat.writes(rendered["book"]) and line not in text


def test_student_notebooks_hold_no_solution_and_no_hidden_test(rendered):
    text = nbformat.writes(rendered["student"])
    for line in ("total = x + x", "adding needs no", "for _ in range", "SOLUTION", "HIDDEN", "autograder", "solutions"):
        assert line not in text


def test_student_markdown_has_no_directive_role_or_code_cell_left(rendered):
    for name in ("student", "unrecorded", "nbgrader"):
        for cell in rendered[name].cells:
            if cell.cell_type == "markdown":
                prose = re.sub(r"```.*?```|`[^`\n]*`(?!`)", "", cell.source, flags=re.DOTALL)
                assert not re.search(r":::|\{[a-z:-]+\}`|\{code-cell\}|^\([\w-]+\)=|chapter:\d", prose, re.MULTILINE), cell.source


def test_stubs_are_open_checks_locked_and_open_questions_graded_by_hand(rendered):
    cells = {cell.metadata.nbgrader.grade_id: cell for cell in rendered["student"].cells if "nbgrader" in cell.metadata}
    assert list(cells) == ["double", "test_double", "quadruple", "test_quadruple", "why_double"]

    def facts(name):
        mark = cells[name].metadata.nbgrader
        return mark.solution, mark.grade, mark.locked, mark.get("points"), cells[name].metadata.get("editable", True)

    assert facts("double") == (True, False, False, None, True)
    assert facts("test_quadruple") == (False, True, True, 3.0, False)
    assert facts("why_double") == (True, True, False, 2.0, True)
    assert all(cell.metadata.deletable is False for cell in cells.values())
    assert cells["test_double"].source == "check(double)"


def test_live_cells_stay_marked_and_hidden_input_is_collapsed(rendered):
    cell = next(cell for cell in rendered["student"].cells if cell.id == "ch99-006")
    assert cell.metadata.tags == ["hide-input", "live"] and cell.metadata.jupyter.source_hidden and not cell.outputs


def test_book_only_cells_become_what_was_recorded_or_say_where_to_look(tiny, rendered):
    recorded = next(cell for cell in rendered["student"].cells if cell.id == "ch99-007")
    assert recorded.source == "````text\nrecorded\n````\n\n![A rising line.](attachment:ch99-007-1.png)"
    assert recorded.attachments["ch99-007-1.png"] == {"image/png": tiny.outputs[4][1].data["image/png"]}
    assert _sources(rendered["unrecorded"])["ch99-007"] == "*See it live on the book's page of chapter 99.*"


def test_what_is_recorded_of_an_interactive_figure_is_its_text_and_where_to_find_it(tiny):
    outputs = [*tiny.outputs[:-1], [new_output("display_data", {"text/html": "<script></script>", "text/plain": "Two sliders"})]]
    notebook = assemble.for_learners(tiny.chapter, outputs, tiny.sources(tiny.chapter))
    expected = "````text\nTwo sliders\n````\n\n*See it live on the book's page of chapter 99.*"
    assert _sources(notebook)["ch99-007"] == expected


def test_references_close_the_page(rendered):
    assert rendered["book"].cells[-1].source.startswith("## References\n\n```{bibliography}")
    assert rendered["student"].cells[-1].source.count("\n- ") == 2


def test_outputs_of_another_version_of_the_chapter_are_refused(tiny):
    with pytest.raises(ChapterError, match="outputs of 4 code cells, but 5 code cells"):
        assemble.for_book(tiny.chapter, tiny.outputs[:-1], sources=tiny.sources(tiny.chapter))


def test_a_book_without_solutions_keeps_what_book_only_cells_show_and_not_how(tiny):
    page = assemble.for_book(tiny.chapter, tiny.outputs, with_solutions=False, sources=tiny.sources(tiny.chapter))
    cell = next(cell for cell in page.cells if cell.id == "ch99-007")
    assert "recorded" not in cell.source and cell.outputs


def test_a_stub_without_a_heading_before_it_is_refused(tiny):
    cells = tuple(cell for cell in tiny.chapter.cells if "Twice twice" not in cell.source)
    with pytest.raises(ChapterError, match="before the stub of quadruple there must be a text with a heading"):
        assemble.for_learners(dataclasses.replace(tiny.chapter, cells=cells), sources=tiny.sources(tiny.chapter))
