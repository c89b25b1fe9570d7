"""One page of the book by itself, for whoever writes it: only its cells are run, and of every other page there is the name alone.

It is rendered as in the book, warnings are errors here, too, and what is published (book/_build/html) is left alone.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import nbformat
import yaml
from nbformat.v4 import new_markdown_cell, new_notebook

from autograder.authoring import assemble, chapter, markdown
from autograder.authoring.chapter import Chapter
from autograder.paths import ROOT
from autograder.proving.locks import one_at_a_time
from autograder.publishing import book
from autograder.publishing.execution import cache_folder, executed_outputs
from experiments.atlas import keeping


def build(name: int | str, with_solutions: bool = True) -> Path:
    """Build the page of one chapter, 44 or "ch44", and return its file, book/_build/page/ch44/chapters/ch44_gae.html.

    Raises: ValueError if there is no such chapter or it breaks its contract; BookError if a cell fails, or Sphinx warns.
    """
    own = chapter.load(name)
    variant = f"{own.assignment}-{'solved' if with_solutions else 'unsolved'}"
    out = book.BOOK / "_build" / "page" / own.assignment
    stage, work = book.STAGE / f"page-{variant}", cache_folder() / f"sphinx-page-{variant}"
    with one_at_a_time(cache_folder() / f"page-{own.assignment}.lock"), book.Renderer() as renderer:
        assemble.verify(own)
        if book.sync(staged_files(own, with_solutions), stage):
            shutil.rmtree(work, ignore_errors=True)
        renderer.render(stage, work, [own])
        out.parent.mkdir(parents=True, exist_ok=True)
        book.publish(work / "_build" / "html", out)
    return out / f"{book.docname(own)}.html"


def staged_files(own: Chapter, with_solutions: bool) -> dict[str, bytes]:
    """What Sphinx reads, by path relative to the staging folder: the page, and stubs in the places of all others."""
    chapters = chapter.all_chapters()
    files = {"index.md": b"# Policy Optimisation\n\nOne page of the book: {doc}`" + book.docname(own).encode() + b"`.\n"}
    files |= {f"{name}.md": _stub(name.rpartition("/")[2]) for name in (*book.HOW_TO, *book.APPENDICES) if name != "kill-matrix"}
    files["atlas.md"] = _atlas_stub()
    for other in chapters:
        if other.number != own.number:
            text = f"# {other.number}. {other.title}\n\nThis chapter is not built here."
            files[f"{book.docname(other)}.ipynb"] = _notebook(text)
    files["kill-matrix.md"] = book.kill_matrix_page({f"{own.number}. {own.title}": book.kill_rows(own)}).encode()
    files["_toc.yml"] = yaml.safe_dump(book.table_of_contents(chapters), sort_keys=False, allow_unicode=True).encode()
    files["references.bib"] = (book.BOOK / "references.bib").read_bytes()
    files |= book.staged_chapter(own, executed_outputs(own), with_solutions) | book.assets()
    return files | book.practice_files([own], files, with_solutions)


def _stub(title: str) -> bytes:
    return f"# {title.replace('-', ' ').capitalize()}\n\nThis page is not built here.\n".encode()


def _atlas_stub() -> bytes:
    """With the places to which chapters link."""
    formulas = {row["formula"] for record in keeping.load_all().values() for row in record["rows"]}
    targets = "\n\n".join(f"({markdown.atlas_label(one)})=\n{one}" for one in sorted(formulas | {"not_run"}))
    return _stub("atlas") + f"\n{targets}\n".encode()


def _notebook(text: str) -> bytes:
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return nbformat.writes(new_notebook(cells=[new_markdown_cell(text, id="stub")], metadata={"kernelspec": kernel})).encode()


def shown(path: Path) -> str:
    """The file as one types it from the project's folder."""
    return os.path.relpath(path, ROOT)
