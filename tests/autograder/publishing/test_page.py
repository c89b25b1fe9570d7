"""A page by itself, and warnings that name the source: a course of two chapters, of which one is built."""

from __future__ import annotations

import dataclasses
import re

import pytest
from nbformat.v4 import new_notebook

from autograder import paths
from autograder.authoring import assemble, chapter, contract
from autograder.publishing import book, in_page, located, page


@pytest.fixture(scope="module")
def workshop(tiny, tmp_path_factory):
    """Builds the tiny chapter 99 from this text of it, in folders of its own: build(old, new) -> the page's file."""
    folder = tmp_path_factory.mktemp("workshop")
    ran = []
    with pytest.MonkeyPatch.context() as patch:

        def build(old="", new=""):
            text = tiny.chapter.path.read_text(encoding="utf-8")
            assert old in text
            path = folder / tiny.chapter.path.name
            path.write_text(text.replace(old, new, 1), encoding="utf-8")
            patch.setattr(chapter, "load", lambda name: chapter.parse(path))
            return page.build("ch99")

        def outputs(own):
            ran.append(own.number)
            return tiny.outputs

        (folder / "book").mkdir()
        for name in ("references.bib", "kill-matrix.md"):
            (folder / "book" / name).write_bytes((book.BOOK / name).read_bytes())
        (folder / "book" / "static").symlink_to(book.BOOK / "static")
        (folder / "book" / "references.bib").write_bytes((tiny.directory.parent / "references.bib").read_bytes())
        patch.setattr(chapter, "all_chapters", lambda: [tiny.before, tiny.chapter])
        patch.setattr(page, "executed_outputs", outputs)
        patch.setattr(page, "cache_folder", lambda: folder)
        patch.setattr(book, "BOOK", folder / "book")
        patch.setattr(book, "STAGE", folder / "stage")
        patch.setattr(book, "kill_rows", lambda own: [{"exercise": "double", "unproved": "Never proved."}])
        patch.setattr(in_page, "fetched", lambda: None)
        patch.setattr(assemble, "real_sources", tiny.sources)
        build.folder, build.ran = folder, ran
        yield build


def test_one_page_is_built_and_the_others_are_names(workshop, tiny):
    built = workshop()
    assert built == workshop.folder / "book" / "_build" / "page" / "ch99" / "chapters" / "ch99_tiny.html"
    text = built.read_text(encoding="utf-8")
    assert "ch98_before.html" in text and "Reference solution" in text
    assert "not built here" in (built.parent / "ch98_before.html").read_text(encoding="utf-8")
    assert "Never proved." in (built.parents[1] / "kill-matrix.html").read_text(encoding="utf-8")
    assert workshop.ran == [99]
    assert not (workshop.folder / "book" / "_build" / "html").exists()


def test_a_warning_names_the_chapters_own_file_and_line_without_colours(workshop, tiny):
    with pytest.raises(book.BookError) as caught:
        workshop("\n## ", "\nSee [nowhere](no-such-page.md).\n\n## ")
    source = workshop.folder / tiny.chapter.path.name
    line = source.read_text(encoding="utf-8").split("\n").index("See [nowhere](no-such-page.md).") + 1
    assert f"{tiny.chapter.path.name}:{line}: WARNING: " in str(caught.value)
    assert "\x1b" not in str(caught.value) and "ipynb" not in str(caught.value)


def test_every_line_of_prose_that_is_rendered_is_found_again(tiny):
    own = chapter.parse(paths.CHAPTERS / "ch44_gae.md")
    rendered = assemble.for_book(own, [[] for cell in own.cells if cell.kind == "code"], sources=contract.sources(own))
    text = own.path.read_text(encoding="utf-8").split("\n")
    places = {line: at for at, line in enumerate(text, 1) if len(line) > 40 and text.count(line) == 1}
    seen = 0
    for number, cell in enumerate(rendered.cells, 1):
        for line, words in enumerate(cell.source.split("\n"), 1):
            if re.fullmatch(r"ch44-\d+", cell.id) and cell.cell_type == "markdown" and words in places:
                assert located.source_line(own, rendered, number * 10000 + line, "") == places[words]
                seen += 1
    assert seen > 50


def test_a_line_that_was_rewritten_is_found_by_its_likeness(tiny):
    own = dataclasses.replace(
        tiny.chapter,
        cells=(chapter.Cell("markdown", "One line.\n\n## A heading\n\nAs {cite:t}`somebody` said of two.\n\nThe end.", 10),),
    )
    text = "One line.\n\n## Exercise 1: A heading\n\nfacts\n\nAs Somebody (1999) said of two.\n\nThe end."
    made = new_notebook(cells=[assemble._markdown("ch99-000", text)])
    found = {line: located.source_line(own, made, 10000 + line, "") for line in (1, 3, 7, 9)}
    assert found == {1: 10, 3: 12, 7: 14, 9: 16}
    assert located.source_line(own, made, 10001, "not found: 'ch99-somebody'") == 14  # the words that are quoted say more
