import shutil

import pytest

from autograder.authoring import chapter
from autograder.authoring.chapter import ChapterError


def _edited(tiny, tmp_path, old, new, name="ch99_tiny.md"):
    text = tiny.chapter.path.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / name
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


def test_front_matter_and_options_are_read(tiny):
    read = tiny.chapter
    assert (read.number, read.assignment, read.page, read.title) == (99, "ch99", "ch99_tiny", "A tiny chapter: twice")
    assert (read.minutes, read.prerequisites, read.summary) == (90, (98,), "A chapter for tests.")
    assert [(cell.exercise, cell.difficulty, cell.minutes) for cell in read.exercises] == [("double", 1, 5), ("quadruple", 3, 70)]
    assert [(cell.open_question, cell.points) for cell in read.open_questions] == [("why_double", 2)]
    assert [sorted(cell.tags) for cell in read.cells if cell.tags] == [["hide-input", "live"], ["book-only", "live"]]
    assert read.cells[-3].source.startswith(":::{dropdown} How") and read.cells[-2].source.endswith(chapter.ANSWER_LINE)


def test_lines_point_into_the_file(tiny):
    lines = tiny.chapter.path.read_text(encoding="utf-8").splitlines()
    for cell in tiny.chapter.cells:
        expected = cell.source.splitlines()[0] if cell.kind == "markdown" else "```{code-cell} ipython3"
        assert lines[cell.line - 1] == expected


def test_chapters_are_found_by_number_and_by_name_and_listed_in_order(tiny):
    assert chapter.load("ch98", tiny.directory) == chapter.load(98, tiny.directory) == tiny.before
    assert [found.number for found in chapter.all_chapters(tiny.directory)] == [98, 99]


@pytest.mark.parametrize("number", ["1", "99", "100", "'98'"])
def test_a_prerequisite_is_a_chapter_that_comes_before(tiny, tmp_path, number):
    shutil.copy(tiny.before.path, tmp_path)
    _edited(tiny, tmp_path, "prerequisites: [98]", f"prerequisites: [98, {number}]")
    with pytest.raises(ChapterError, match=rf"ch99_tiny\.md:1: prerequisites: {number} is no chapter before .* those are: 98$"):
        chapter.all_chapters(tmp_path)


def test_an_unknown_chapter_is_answered_with_those_that_exist(tiny):
    with pytest.raises(ValueError, match="no chapter 'ch12'; there are: ch98, ch99"):
        chapter.load("ch12", tiny.directory)


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("minutes: 90", "minuets: 90", r":1: unknown option 'minuets' in a front matter"),
        ("summary: A chapter for tests.\n", "", r":1: front matter lacks summary"),
        ("minutes: 90", "minutes: long", r":1: minutes: 'long' .* wrong type"),
        ("difficulty: 1\n", "difficulty: 4\n", r":\d+: an exercise needs difficulty"),
        ("difficulty: 1\n", "dificulty: 1\n", r":\d+: unknown option 'dificulty' in a code cell"),
        ("[live, hide-input]", "[live, hide-inptu]", r":\d+: unknown tag 'hide-inptu'"),
        ("[live, book-only]", "[book-only]", r":\d+: a book-only cell .* tag it live"),
        ('"points": 2', '"points": 0', r":\d+: an open question needs points above 0"),
        (', "points": 2', "", r":\d+: markdown cell lacks points"),
        ("*Write your answer here.*\n", "*Here.*\n", r":\d+: an open question ends with the line"),
        ("chapter: 99", "chapter: 98", r":1: chapter 98 must lie in a file called ch98_"),
        ("exercise: double", "tags: [live]\nexercise: double", r":\d+: an exercise's cell takes no tags"),
        ("tags: [live, hide-input]", "minutes: 3", r":\d+: difficulty and minutes belong to"),
    ],
)
def test_what_the_format_does_not_allow_is_refused_by_file_and_line(tiny, tmp_path, old, new, message):
    path = _edited(tiny, tmp_path, old, new)
    with pytest.raises(ChapterError, match=f"ch99_tiny.md{message}"):
        chapter.parse(path)


def test_two_files_of_one_number_are_refused(tiny, tmp_path):
    for name in ("ch99_a.md", "ch99_b.md"):
        (tmp_path / name).write_bytes(tiny.chapter.path.read_bytes())
    with pytest.raises(ChapterError, match=r"ch99_a\.md is chapter 99, too"):
        chapter.all_chapters(tmp_path)
