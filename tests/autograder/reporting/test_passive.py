"""Nothing that a learner wrote is active in the page in which a teacher reads it, and nothing that can be read is lost."""

import nbformat
import pytest
from nbconvert.filters import markdown2html
from nbformat import NotebookNode
from nbformat.v4 import new_code_cell, new_markdown_cell, new_output, new_raw_cell

from autograder.reporting import passive

ACTIVE = {
    "a tag": ("<img src=x onerror=alert(1)>", "< img src=x onerror=alert(1)>"),
    "an end tag": ("</textarea>", "< /textarea>"),
    "a comment": ("<!-- x", "< !-- x"),
    "a processing instruction": ("<?xml", "< ?xml"),
    "a link": ("[x](javascript:alert(1))", "[x] (javascript:alert(1))"),
    "a picture": ("![x](attachment:a.png)", "![x] (attachment:a.png)"),
    "a link by reference": ("[x][y]", "[x] [y]"),
    "what a reference leads to": ("[y]: javascript:alert(1)", "[y] : javascript:alert(1)"),
    "a TeX link": (r"$\href{javascript:alert(1)}{x}$", r"$\ href{javascript:alert(1)}{x}$"),
    "a TeX package": (r"$\require{html}$", r"$\ require{html}$"),
    "a TeX style": (r"$\style{x}{y} \class{x}{y} \cssId{x}{y}$", r"$\ style{x}{y} \ class{x}{y} \ cssId{x}{y}$"),
    "a lone surrogate": ("\ud800", "?"),
}
PASSIVE = [
    "a < b, a <= b and 3 <4",
    "x[0] (the first)",
    r"$\hat A_t = \sum_l (\gamma\lambda)^l \delta_{t+l}$",
    "`x` **bold** | 1 |",
    "λ — ü",
]


@pytest.mark.parametrize(("written", "shown"), ACTIVE.values(), ids=ACTIVE)
def test_text_gets_a_space_where_something_active_would_begin(written, shown):
    assert passive.text(written) == shown
    assert passive.text(shown) == shown


@pytest.mark.parametrize("written", PASSIVE)
def test_other_text_stays_as_it_is(written):
    assert passive.text(written) == written


@pytest.mark.parametrize("written", [written for written, _ in ACTIVE.values() if "alert" in written and "$" not in written])
def test_what_nbconvert_makes_of_it_has_no_element_of_the_learners(written):
    page = markdown2html(passive.text(written))
    assert "<img" not in page and "href" not in page and "alert(1)" in page


def test_cells_keep_kind_source_and_metadata_and_lose_attachments():
    theirs = new_markdown_cell("<b>x</b>", metadata={"nbgrader": {"grade_id": "q"}}, attachments={"a.png": {"image/png": "AA=="}})
    shown = passive.cell(theirs, {})
    assert (shown.cell_type, shown.source, shown.metadata.nbgrader.grade_id) == ("markdown", "< b>x< /b>", "q")
    assert "attachments" not in shown
    assert passive.cell(new_raw_cell("<b>"), {}) | {"id": ""} == new_raw_cell("< b>") | {"id": ""}
    assert passive.cell(new_code_cell("a <b> c"), {}).source == "a <b> c"  # code is shown as text anyway


def test_what_was_handed_out_stays_with_its_links_and_its_own_pictures():
    ours = new_markdown_cell("[x](https://example.org)", attachments={"a.png": {"image/png": "AA=="}})
    theirs = new_markdown_cell(ours.source, attachments={"a.png": {"text/html": "<script>"}})
    shown = passive.cell(theirs, {ours.source: ours})
    assert shown.source == ours.source and shown.attachments == ours.attachments


OUTPUTS = {
    "HTML": (new_output("display_data", data={"text/html": "<script>"}), None),
    "SVG": (new_output("display_data", data={"image/svg+xml": "<svg>"}), None),
    "JavaScript beside text": (
        new_output("execute_result", data={"application/javascript": "alert(1)", "text/plain": "3"}),
        {"text/plain": "3"},
    ),
    "a picture": (new_output("display_data", data={"image/png": "iVBORw0KGgo=\n"}), {"image/png": "iVBORw0KGgo=\n"}),
    "a picture that is none": (new_output("display_data", data={"image/png": 'x" onerror="alert(1)'}), None),
    "long text": (new_output("display_data", data={"text/plain": "x" * 20_000}), {"text/plain": "x" * 10_000}),
}


@pytest.mark.parametrize(("output", "kept"), OUTPUTS.values(), ids=OUTPUTS)
def test_of_outputs_text_and_pictures_are_left(output, kept):
    shown = passive.cell(new_code_cell("", outputs=[output]), {}).outputs
    assert [dict(one.data) for one in shown] == ([] if kept is None else [kept])


def test_streams_and_tracebacks_are_text_of_bounded_length():
    stream = new_output("stream", name="stderr", text="<script>" * 10_000)
    error = new_output("error", ename="E", evalue="v", traceback=["<b>" * 5_000, "y"])
    printed, failed = passive.cell(new_code_cell("", outputs=[stream, error]), {}).outputs
    assert (printed.name, len(printed.text)) == ("stderr", 10_000)
    assert (failed.ename, failed.evalue, len(failed.traceback), len(failed.traceback[0])) == ("E", "v", 1, 10_000)
    nbformat.validate(
        NotebookNode(nbformat=4, nbformat_minor=5, metadata={}, cells=[new_code_cell("", outputs=[printed, failed])])
    )
