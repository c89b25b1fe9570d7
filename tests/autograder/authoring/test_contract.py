import re
from dataclasses import replace
from types import SimpleNamespace

import pytest

from autograder.authoring import assemble, chapter, contract
from autograder.authoring.chapter import ChapterError


def _broken(tiny, tmp_path, old, new):
    text = tiny.chapter.path.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "ch99_tiny.md"
    path.write_text(text.replace(old, new), encoding="utf-8")
    return chapter.parse(path)


def test_references_come_apart_into_signature_docstring_and_body(tiny):
    found = contract.references(tiny.chapter, tiny.sources(tiny.chapter))
    assert list(found) == ["double", "quadruple"]
    assert found["double"].signature == "def double(x):"
    assert found["double"].body == "    # adding needs no multiplication\n    total = x + x\n    return total"


def test_the_tiny_chapter_keeps_its_contract(tiny):
    for one in (tiny.chapter, tiny.before):
        assemble.verify(one, tiny.sources(one))


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("times=2):", "times=3):", r"the stub of quadruple: takes \(x, times=3\), its reference \(x, times=2\)"),
        ('"""Twice x.', '"""Two x.', "the stub of double: has another docstring"),
        ("raise NotImplementedError", "raise NotImplementedError()", "its body must be the one line"),
        ('"""\n    raise NotImpl', '"""\n    x = 1\n    raise NotImpl', "its body must be the one line"),
        ("\ndef double(x):", "\nimport math\ndef double(x):", "must be one function and nothing else"),
        ("\ndef double(x):", "\ndef double(x:", "the stub of double"),
        ("\ndef double(x):", "\ndef twice(x):", "the stub of double: defines twice"),
        ("exercise: quadruple", "exercise: double", "the id .*double' is taken by line"),
        ("exercise: quadruple", "exercise: eightfold", "the checks of ch99 lack eightfold"),
        ('"open_question": "why_double"', '"open_question": "test_double"', "the id 'test_double' is taken"),
        ("import check, validate", "import check", "the reference of quadruple uses validate, which no set-up"),
        ("from course_lib import check, validate", "from (", "not Python"),
        ("{eq}`third`", "{eq}`fourth`", r"ch99_tiny.md:42: no equation of this chapter is labelled 'fourth'"),
        ("(quadruple)", "(double)", "a second equation is labelled 'double'"),
    ],
)
def test_a_broken_contract_is_named_with_file_and_line(tiny, tmp_path, old, new, message):
    broken = _broken(tiny, tmp_path, old, new)
    with pytest.raises(ChapterError, match=message) as caught:
        assemble.verify(broken, tiny.sources(tiny.chapter))
    assert "ch99_tiny.md:" in str(caught.value)


def test_names_from_live_cells_do_not_count_as_known_because_the_judge_runs_none(tiny, tmp_path):
    setup = "```{code-cell} ipython3\nfrom course_lib"
    broken = _broken(tiny, tmp_path, setup, setup.replace("\n", "\n---\ntags: [live]\n---\n"))
    with pytest.raises(ChapterError, match="uses validate"):
        assemble.verify(broken, tiny.sources(tiny.chapter))


def test_set_up_cells_may_hold_magics(tiny, tmp_path):
    magic = _broken(tiny, tmp_path, "from course_lib import", "%matplotlib inline\nfrom course_lib import")
    assemble.verify(magic, tiny.sources(tiny.chapter))


def test_checks_without_a_stub_and_criteria_that_do_not_add_up_are_refused(tiny):
    sources = tiny.sources(tiny.chapter)
    for extra, message in [
        (SimpleNamespace(name="triple", points=1.0, criteria={"values": 1.0}), "no stub for triple"),
        (SimpleNamespace(name="double", points=1.0, criteria={"values": 1.0}), "name double twice"),
    ]:
        with pytest.raises(ChapterError, match=message):
            assemble.verify(tiny.chapter, replace(sources, exercises=(*sources.exercises, extra)))
    uneven = SimpleNamespace(name="double", points=1.0, criteria={"values": 0.5})
    with pytest.raises(ChapterError, match="do not add up"):
        assemble.verify(tiny.chapter, replace(sources, exercises=(uneven, sources.exercises[1])))


@pytest.mark.parametrize("assignment", [f"ch{number}" for number in chapter.page_files()])
def test_every_chapter_of_the_book_keeps_its_contract(assignment):
    assemble.verify(chapter.load(assignment))


def test_every_chapter_names_the_experiments_whose_records_it_loads_because_only_those_are_released():
    for real in chapter.all_chapters():
        loaded = {name for cell in real.cells for name in re.findall(r'records\.load\("(\w+)"', cell.source)}
        assert loaded <= set(real.experiments), real.assignment
