"""The cheat sheet: who is on it, what it says, and that nothing is missing without a word."""

from __future__ import annotations

import dataclasses

import nbformat
import pytest

from autograder.authoring import assemble
from autograder.authoring.chapter import Cell, all_chapters
from autograder.publishing import cheat_sheet


def staged(chapter, sources=None):
    """The chapter's page as it is staged, without outputs."""
    outputs = [[] for cell in chapter.cells if cell.kind == "code"]
    return {f"chapters/{chapter.page}.ipynb": nbformat.writes(assemble.for_book(chapter, outputs, sources=sources)).encode()}


@pytest.fixture(scope="module", params=all_chapters(), ids=lambda chapter: chapter.assignment)
def chapter(request):
    return request.param


def test_every_exercise_that_computes_something_has_sentence_formula_and_shapes(chapter, capsys):
    text = cheat_sheet.page([chapter], staged(chapter))
    assert capsys.readouterr().err == "" and " lacks " not in text
    found = [
        name for cell in chapter.exercises if f"### [`{(name := cell.exercise)}`](chapters/{chapter.page}.ipynb#exercise-" in text
    ]
    left_out = [cell.exercise for cell in chapter.exercises if cell.exercise not in found]
    assert len(found) >= 2 and text.count("### ") == text.count(":::{div} sheet-formula") == len(found)
    [repair] = [name for name in left_out if name.startswith("repaired_")]
    procedures = text.partition("Procedures: ")[2]
    assert repair not in text and all(f"[`{name}`](chapters/" in procedures for name in left_out if name != repair)


def test_of_all_chapters_each_has_its_part():
    chapters = all_chapters()
    pages = {path: content for chapter in chapters for path, content in staged(chapter).items()}
    text = cheat_sheet.page(chapters, pages)
    assert [line for line in text.splitlines() if line.startswith("## ")] == [f"## {one.number}. {one.title}" for one in chapters]


def test_what_a_docstring_lacks_is_told_on_the_page_and_by_the_build(tiny, capsys):
    text = cheat_sheet.page([tiny.chapter], staged(tiny.chapter, tiny.sources(tiny.chapter)))
    told = capsys.readouterr().err
    line = tiny.chapter.exercises[0].line
    assert f"{tiny.chapter.path}:{line}: the docstring of double lacks a formula (a paragraph that is indented further)" in told
    assert text.count("*Its docstring lacks a formula") == 2 and "exercise-991-twice" in text


STUB = Cell(
    "code",
    '''def loss(x, mask, targets=None, scale=1e-8):
    """How far, in all.

    Not a formula.

        L = Σ_i w_i s_{(i)} - log_probs_t,   ŝ_0 = π_old,
        w = σ_i²

        second = not shown

    Args:
      x, mask: one and the other; (B, L) bool
        or int64.
      targets: (B,), or (B, A); or None.
      scale: ε in [0, 1].

    Returns: (loss (), rows (B,)), without a graph; at most 1. Not this.
    Raises: ValueError.
    """
    raise NotImplementedError''',
    1,
    exercise="loss",
)


def test_an_entry_is_read_from_a_stub():
    found = cheat_sheet.entry(STUB)
    assert found.arguments == "x: (B, L) bool or int64, mask: (B, L) bool or int64, targets: (B,) or (B, A) = None, scale=1e-8"
    assert (found.says, found.returns) == ("How far, in all.", "(loss (), rows (B,)), without a graph")
    assert found.formula == "L = Σ_i w_i s_{(i)} - log_probs_t,   ŝ_0 = π_old, w = σ_i²" and found.lacks == ""
    without = dataclasses.replace(STUB, source='def loss(x):\n    """Sum."""\n    raise NotImplementedError')
    assert cheat_sheet.entry(without).lacks == "a formula (a paragraph that is indented further), a paragraph `Returns: …`"


@pytest.mark.parametrize(
    "formula, typeset",
    [
        ("s_{t+1}", "s{sub}`t+1`"),
        ("π_old(a|s)", "π{sub}`old`\\(a\\|s\\)"),
        ("terminated_t", "terminated{sub}`t`"),
        ("input_ids_{t+1}", "input\\_ids{sub}`t+1`"),
        ("log_probs ρ_i²", "log\\_probs ρ{sub}`i`²"),
        ("ŝ_0", "ŝ{sub}`0`"),
    ],
)
def test_indices_are_lowered_and_names_are_left_whole(formula, typeset):
    assert cheat_sheet._typeset(formula) == typeset


@pytest.mark.parametrize(
    "name, arguments, is_on_it", [("kl", "x", True), ("repaired_kl", "x", False), ("train", "envs, x", False)]
)
def test_repairs_and_procedures_are_left_out(name, arguments, is_on_it):
    assert cheat_sheet.computes(dataclasses.replace(STUB, exercise=name, source=f"def {name}({arguments}): pass")) == is_on_it
