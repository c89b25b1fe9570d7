"""Honest notebooks of chapter 44 after an editor has been at them: what runs, what is flagged, and what only a person can decide."""

import copy
import re
import sys
import types
from pathlib import Path

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

from autograder.authoring import assemble, chapter
from autograder.authoring.chapter import ANSWER_LINE
from autograder.grading import judge, reading, repair
from autograder.grading.repair import AS_RUN, FIRST

sys.path.insert(0, str(Path(__file__).parents[3]))
from tests.attacks import toolbox
from tests.attacks.toolbox import cell

FORM = repair.form(assemble.for_learners(chapter.load("ch44")))
ANSWERS = tuple(FORM.stubs)
QUESTION, OTHER = FORM.questions


def handed_in(notebook):
    return reading.read(nbformat.writes(notebook).encode()).notebook


def repaired(edit):
    """The repaired notebook of a solved one after `edit`, which changes it or returns another."""
    notebook = toolbox.solved()
    return repair.repair(handed_in(edit(notebook) or notebook), FORM)


def ran(one):
    """The sources that the judge would run, joined."""
    return "\n".join(
        source for _, source in judge.runnable(one.notebook, judge.Released("ch44", (), (), frozenset(), *LIVE, "", FORM))
    )


LIVE = (frozenset(repair.squeezed(source) for source in FORM.live.values()), frozenset(FORM.live))


def defined(one):
    """Exercise → what its definition that counts returns for no arguments, for answers made by `says`."""
    space = {}
    for source in re.findall(r"^def \w+\(\):\n    return '.*'\n", ran(one), re.MULTILINE):
        exec(source, space)
    return {name: value() for name, value in space.items() if isinstance(value, types.FunctionType)}


def says(name, text):
    return f"def {name}():\n    return {text!r}\n"


def place(notebook, name):
    return notebook.cells.index(cell(notebook, name))


def add(notebook, at, source, like=None, **changes):
    """Put a cell into the notebook: a copy of `like`, or a new code cell."""
    new = copy.deepcopy(like) if like else new_code_cell(source)
    new.source, new.id = source, f"own-{len(notebook.cells)}"
    new.update(changes)
    notebook.cells.insert(at, new)
    return new


def marks(one):
    return [name for name in map(repair.grade_id, one.notebook.cells) if name]


def each_once(one):
    found = marks(one)
    return len(found) == len(set(found)) and {*ANSWERS, *FORM.questions} <= set(found)


def kinds(one):
    return [flag.removeprefix("repaired: ").split(" (")[0] for flag in one.flags]


# -------------------------------------------------------------------------------- what needs no repair


def test_an_untouched_and_a_solved_notebook_are_left_alone():
    for edit in (lambda notebook: None, lambda notebook: assemble.for_learners(chapter.load("ch44"))):
        one = repaired(edit)
        assert not one.flags and not one.ambiguous and each_once(one)
        assert not any(AS_RUN in cell.metadata and cell.metadata[AS_RUN] is not None for cell in one.notebook.cells)


def test_what_was_handed_in_is_not_changed():
    notebook = handed_in(toolbox.solved())
    notebook.cells.append(copy.deepcopy(cell(notebook, "compute_gae")))
    before = copy.deepcopy(notebook)
    repair.repair(notebook, FORM)
    assert notebook == before


@pytest.mark.parametrize("edit", ["helper_above", "imports_first", "prose_edited", "cells_moved", "released_cell_deleted"])
def test_ordinary_work_is_not_called_a_repair(edit):
    def change(notebook):
        if edit == "helper_above":
            add(notebook, place(notebook, "td_residuals"), "def helper():\n    return 1\n")
        elif edit == "imports_first":
            cell(notebook, "td_residuals").source = "import math\n\n" + cell(notebook, "td_residuals").source
            setup = next(one for one in notebook.cells if one.cell_type == "code")
            setup.source = "!pip install einops\nimport os\n" + setup.source
        elif edit == "prose_edited":
            notebook.cells[3].source += "\n\nMy note."
        elif edit == "cells_moved":
            one = notebook.cells.pop(place(notebook, "explained_variance"))
            notebook.cells.append(one)
        else:
            notebook.cells = [one for one in notebook.cells if one.id not in ("ch44-003", "ch44-011")]

    one = repaired(change)
    assert not one.flags and not one.ambiguous


# -------------------------------------------------------------------------------- exercises


def test_a_split_cell_runs_whole_and_its_definition_is_the_answer():
    def edit(notebook):
        add(notebook, place(notebook, "td_residuals"), "def my_mask(x):\n    return ~x\n", cell(notebook, "td_residuals"))

    one = repaired(edit)
    assert kinds(one) == ["an answer's cell stands more than once; the last definition counts"] and not one.ambiguous
    assert each_once(one) and "def td_residuals" in cell(one.notebook, "td_residuals").source and "my_mask" in ran(one)


@pytest.mark.parametrize("order", ["first", "last"])
def test_of_two_answers_the_last_counts(order):
    def edit(notebook):
        original = cell(notebook, "compute_gae")
        original.source = says("compute_gae", "original")
        add(notebook, place(notebook, "compute_gae") + (order == "last"), says("compute_gae", "copy"), original)

    one = repaired(edit)
    assert defined(one)["compute_gae"] == ("copy" if order == "last" else "original")
    assert each_once(one) and repair.grade_id(
        next(c for c in one.notebook.cells if c.source == cell(one.notebook, "compute_gae").source)
    )
    assert defined(one)["compute_gae"] in cell(one.notebook, "compute_gae").source and one.flags and not one.ambiguous


def test_a_forged_double_wins_nothing():
    """First right, last wrong: what the learner's functions compute is what the last definition computes."""

    def edit(notebook):
        right = cell(notebook, "repaired_targets")
        add(notebook, len(notebook.cells), says("repaired_targets", "wrong"), right)

    assert defined(repaired(edit))["repaired_targets"] == "wrong"


@pytest.mark.parametrize("below", [True, False])
def test_an_untouched_stub_is_no_answer_where_another_stands(below):
    def edit(notebook):
        stub = cell(notebook, "compute_gae")
        stub.source = FORM.stubs["compute_gae"]
        add(notebook, place(notebook, "compute_gae") + (not below), says("compute_gae", "mine"))

    one = repaired(edit)
    assert defined(one)["compute_gae"] == "mine" and (FORM.stubs["compute_gae"] in ran(one)) is not below
    assert kinds(one) == (["an untouched stub below the answer was left out"] if below else [])


@pytest.mark.parametrize(
    "stub",
    [
        FORM.stubs["compute_gae"] + "\n\n\n", FORM.stubs["compute_gae"].replace("    ", "\t"), "\n" + FORM.stubs["compute_gae"],
        FORM.stubs["compute_gae"].replace("\n", "  \n"), "def compute_gae(rewards):\n    raise NotImplementedError\n",
        'def compute_gae(x):\n    """Other words of an earlier release."""\n    raise NotImplementedError("todo")  # later\n',
        "# my notes\n" + FORM.stubs["compute_gae"] + "  # still to do",
    ],
    ids=["blank_end", "tabs", "blank_start", "trailing", "no_docstring", "other_docstring", "comments"],
)  # fmt: skip
def test_a_stub_is_known_whatever_its_blanks_comments_and_docstring(stub):
    def edit(notebook):
        cell(notebook, "compute_gae").source = stub
        add(notebook, 3, says("compute_gae", "mine"))

    one = repaired(edit)
    assert kinds(one) == ["an untouched stub below the answer was left out"] and "raise NotImplementedError" not in ran(one)


@pytest.mark.parametrize(
    "answer",
    [
        says("compute_gae", "other"), "def compute_gae(x):\n    if x:\n        raise NotImplementedError\n    return 1\n",
        "def compute_gae(x):\n    x = 1\n    raise NotImplementedError\n", "compute_gae = lambda x: 1\n",
        "@cached\ndef compute_gae(x):\n    raise NotImplementedError\n",
    ],
    ids=["answer", "branch", "body", "lambda", "decorated"],
)  # fmt: skip
def test_what_is_no_untouched_stub_counts(answer):
    def edit(notebook):
        cell(notebook, "compute_gae").source = answer
        add(notebook, 3, says("compute_gae", "mine"))

    one = repaired(edit)
    assert not one.flags and answer in ran(one)


def test_what_stands_beside_an_untouched_stub_runs_at_its_line():
    def edit(notebook):
        cell(notebook, "compute_gae").source = "a = 1\n" + FORM.stubs["compute_gae"] + "\n\ndef helper():\n    return 2\n"
        add(notebook, 3, says("compute_gae", "mine"))

    one = repaired(edit)
    source = cell(one.notebook, "compute_gae").metadata[AS_RUN]
    original = cell(one.notebook, "compute_gae").source
    assert source.startswith("a = 1\n") and source.count("\n") == original.count("\n")
    assert source.split("\n").index("def helper():") == original.split("\n").index("def helper():")


def test_answers_on_top_of_everything_count_and_the_imports_come_first():
    def edit(notebook):
        released = assemble.for_learners(chapter.load("ch44"))
        released.cells.insert(0, new_code_cell("\n\n".join(says(name, f"my {name}") for name in ANSWERS)))
        return released

    one = repaired(edit)
    assert defined(one) == {name: f"my {name}" for name in ANSWERS} and not one.ambiguous
    assert set(kinds(one)) == {"an untouched stub below the answer was left out", "cells that stood below the answers ran first"}
    assert "import torch" in one.notebook.metadata[FIRST]


def test_only_stubs_are_no_answer():
    def edit(notebook):
        cell(notebook, "compute_gae").source = FORM.stubs["compute_gae"]
        add(notebook, len(notebook.cells), FORM.stubs["compute_gae"], cell(notebook, "compute_gae"))

    assert "raise NotImplementedError" in ran(repaired(edit))


@pytest.mark.parametrize("kind", ["markdown", "raw"])
@pytest.mark.parametrize("marked", [True, False])
@pytest.mark.parametrize("fence", ["{}", "```python\n{}\n```", "``` py\n{}```\n"])
def test_an_answer_in_a_text_cell_is_code_again(kind, marked, fence):
    def edit(notebook):
        position = place(notebook, "lambda_returns")
        answer = notebook.cells[position]
        new = new_markdown_cell(
            fence.format("import math\n\n" + says("lambda_returns", "mine")), metadata=answer.metadata if marked else {}
        )
        new.cell_type = kind
        notebook.cells[position] = new

    one = repaired(edit)
    assert defined(one)["lambda_returns"] == "mine" and "an answer in a text cell was made code again" in kinds(one)
    assert each_once(one) and not one.ambiguous


@pytest.mark.parametrize(
    "prose", ["I would write\n\ndef lambda_returns(a):\n    return a\n", "See `def lambda_returns(a)` above.", "# lambda_returns"]
)
def test_prose_is_no_code(prose):
    def edit(notebook):
        position = place(notebook, "lambda_returns")
        notebook.cells[position] = new_markdown_cell(prose, metadata=notebook.cells[position].metadata)

    assert prose not in ran(repaired(edit))


def test_a_sketch_in_a_text_cell_is_left_where_the_answer_stands_in_code():
    one = repaired(lambda notebook: notebook.cells.insert(0, new_markdown_cell(says("lambda_returns", "sketch"))))
    assert not one.flags and "sketch" not in ran(one)


def test_a_missing_stub_is_put_back_unanswered():
    one = repaired(lambda notebook: notebook.cells.remove(cell(notebook, "compute_gae")))
    assert kinds(one) == ["cells were put back as released, without an answer"] and not one.ambiguous


def test_an_answer_cut_and_pasted_without_its_mark_is_found():
    def edit(notebook):
        answer = notebook.cells.pop(place(notebook, "compute_gae"))
        add(notebook, len(notebook.cells), answer.source)

    one = repaired(edit)
    assert kinds(one) == ["answers were found by name"] and each_once(one)


def test_a_notebook_without_any_exercise_is_for_a_person():
    one = repaired(lambda notebook: new_notebook(cells=[new_code_cell("print(1)")]))
    assert one.ambiguous[0] == "no_exercise_found"
    assert repaired(lambda notebook: new_notebook()).ambiguous[0] == "no_exercise_found"


# -------------------------------------------------------------------------------- checks and released cells


def test_an_answer_merged_with_the_check_below_it():
    def edit(notebook):
        test = cell(notebook, "test_lambda_returns")
        cell(notebook, "lambda_returns").source = says("lambda_returns", "mine") + "\n" + test.source
        notebook.cells.remove(test)

    one = repaired(edit)
    assert (
        kinds(one) == ["checks were put back"]
        and defined(one)["lambda_returns"] == "mine"
        and "check(lambda_returns)" not in ran(one)
    )


def test_an_answer_merged_into_its_check_still_runs():
    def edit(notebook):
        test = cell(notebook, "test_lambda_returns")
        test.source = says("lambda_returns", "mine") + "\n" + test.source
        notebook.cells.remove(cell(notebook, "lambda_returns"))

    one = repaired(edit)
    assert defined(one)["lambda_returns"] == "mine" and each_once(one) and not one.ambiguous


def test_two_answers_merged_into_one_cell():
    def edit(notebook):
        below = notebook.cells.pop(place(notebook, "lambda_returns"))
        cell(notebook, "compute_gae").source += "\n" + below.source

    one = repaired(edit)
    assert (
        not one.ambiguous and all(f"def {name}" in ran(one) for name in ANSWERS) and kinds(one) == ["answers were found by name"]
    )


@pytest.mark.parametrize("copies", [1, 2])
def test_copies_of_checks_are_left_out(copies):
    def edit(notebook):
        for _ in range(copies):
            test = cell(notebook, "test_compute_gae")
            add(notebook, len(notebook.cells), test.source, test)

    one = repaired(edit)
    assert kinds(one) == ["copies of checks were left out"] and each_once(one) and "check(" not in ran(one)


def test_missing_checks_are_put_back():
    def edit(notebook):
        notebook.cells = [one for one in notebook.cells if not (toolbox.graded(one) or "").startswith("test_")]

    one = repaired(edit)
    assert kinds(one) == ["checks were put back"] and not one.ambiguous


def test_the_imports_are_put_back_if_they_are_gone():
    one = repaired(lambda notebook: notebook.cells.remove(notebook.cells[2]))
    assert one.flags == ["repaired: released cells were put back (ch44-001)"] and ran(one).startswith("import torch")


# -------------------------------------------------------------------------------- lost metadata


@pytest.mark.parametrize("lost", ["nbgrader", "tags_and_ids", "everything"])
def test_a_notebook_that_lost_its_marks_is_put_right(lost):
    def edit(notebook):
        for one in notebook.cells:
            if lost != "tags_and_ids":
                one.metadata.pop("nbgrader", None)
            if lost != "nbgrader":
                one.metadata.pop("tags", None)
                one.pop("id")
        if lost == "everything":
            for one in notebook.cells:
                one.metadata = {"cell_id": "abc", "deepnote_cell_type": "code"}
        notebook.nbformat_minor = 4 if lost != "nbgrader" else 5

    one = repaired(edit)
    assert one.flags == (
        [] if lost == "tags_and_ids" else ["repaired: the cells had lost their metadata; answers were found by name"]
    )
    assert each_once(one) and not one.ambiguous
    assert not any(source in ran(one) for source in FORM.live.values()) and "check(" not in ran(one).replace("import check", "")


def _without_ids(*cells):
    notebook = toolbox.solved()
    notebook.nbformat_minor = 4
    for one in notebook.cells:
        one.pop("id")
    for one in cells:
        one.pop("id", None)
    notebook.cells += cells
    return repair.repair(handed_in(notebook), FORM)


def test_a_copy_of_a_live_cell_keeps_its_tag_and_runs_where_ids_are_lost():
    source = next(source for source in FORM.live.values() if source.count("\n") > 5)
    live = {"tags": ["live"]}
    one = _without_ids(
        new_code_cell("def helper():\n    return 1\n", metadata=live), new_code_cell(source + "\nmine = 2\n", metadata=live)
    )
    assert "def helper" in ran(one) and "mine = 2" in ran(one)


def test_an_edited_live_cell_does_not_run_where_ids_are_lost():
    notebook = toolbox.solved()
    notebook.nbformat_minor = 4
    for one in notebook.cells:
        one.pop("id")
        one.metadata.pop("tags", None)
        if repair.squeezed(one.source) in LIVE[0] and one.source.count("\n") > 3:
            one.source = "# my note\n" + one.source + "\nmine = 2\n"
    assert "mine = 2" not in ran(repair.repair(handed_in(notebook), FORM))


# -------------------------------------------------------------------------------- open answers


def answered(notebook, name=QUESTION, text="Mine."):
    one = cell(notebook, name)
    one.source = one.source.replace(ANSWER_LINE, text)
    assert text in one.source
    return one


def answer_in(one, name=QUESTION):
    return cell(one.notebook, name).source


def test_an_open_answer_that_is_missing_is_for_a_person():
    one = repaired(lambda notebook: notebook.cells.remove(cell(notebook, QUESTION)))
    assert one.ambiguous == [f"missing_cell: {QUESTION}"]


@pytest.mark.parametrize("texts", [("One.", "Two."), ("One.", "One. And two.")])
@pytest.mark.parametrize("whole", [True, False])
def test_two_open_answers_are_for_a_person_who_sees_both(texts, whole):
    def edit(notebook):
        first = answered(notebook, text=texts[0]) if whole else cell(notebook, QUESTION)
        second = first.source.replace(texts[0], texts[1]) if whole else texts[1]
        if not whole:
            first.source = texts[0]
        add(notebook, place(notebook, QUESTION) + 1, second, first)

    one = repaired(edit)
    assert one.ambiguous == [f"duplicate_cell: {QUESTION}"]
    assert all(text in answer_in(one) for text in texts) and each_once(one)


def test_two_open_answers_far_apart_are_no_split():
    def edit(notebook):
        add(notebook, len(notebook.cells), "Another answer.", answered(notebook))

    assert repaired(edit).ambiguous == [f"duplicate_cell: {QUESTION}"]


@pytest.mark.parametrize("other", ["alike", "untouched", "blank"])
def test_a_copy_that_says_nothing_new_is_left_out(other):
    def edit(notebook):
        one = answered(notebook)
        text = {"alike": one.source + "\n", "untouched": FORM.questions[QUESTION], "blank": " \n"}[other]
        add(notebook, place(notebook, QUESTION), text, one)

    one = repaired(edit)
    assert kinds(one) == ["copies of an open answer were left out"] and not one.ambiguous
    assert "Mine." in answer_in(one) and each_once(one)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.95])
def test_a_split_open_answer_is_joined(share):
    def edit(notebook):
        one = answered(notebook, text="Mine, in a long sentence that goes on.")
        at = one.source.index(" ", int(share * len(one.source)))
        add(notebook, place(notebook, QUESTION) + 1, one.source[at:], one)
        one.source = one.source[:at]

    one = repaired(edit)
    assert kinds(one) == ["the parts of a split open answer were joined"] and not one.ambiguous
    assert repair.squeezed("Mine, in a long sentence that goes on.") in repair.squeezed(answer_in(one)) and each_once(one)


def test_an_open_answer_merged_into_the_text_above_is_found():
    def edit(notebook):
        one = answered(notebook)
        position = place(notebook, QUESTION)
        notebook.cells[position - 1].source += "\n\n" + one.source
        notebook.cells.remove(one)

    one = repaired(edit)
    assert kinds(one) == ["open answers were found by their question"] and "Mine." in answer_in(one) and not one.ambiguous


def test_two_open_answers_merged_into_one_cell_are_taken_apart():
    def edit(notebook):
        first, second = answered(notebook), answered(notebook, OTHER, "Yours.")
        first.source += "\n\n" + second.source
        notebook.cells.remove(second)

    one = repaired(edit)
    assert kinds(one) == ["an open answer was taken out of a merged cell"] and not one.ambiguous
    assert "Mine." in answer_in(one) and "Yours." not in answer_in(one) and "Yours." in answer_in(one, OTHER)


def test_an_answer_in_a_cell_of_its_own_below_the_question_belongs_to_it():
    one = repaired(lambda notebook: notebook.cells.insert(place(notebook, QUESTION) + 1, new_markdown_cell("Mine.")))
    assert kinds(one) == ["an open answer was found in the cell below its question"] and "Mine." in answer_in(one)


def test_no_released_text_is_taken_for_an_answer():
    def edit(notebook):
        for one in notebook.cells:
            one.id = f"other-{one.id}"

    def old(notebook):
        edit(notebook)
        for one in notebook.cells:
            if one.cell_type == "markdown" and not toolbox.graded(one):
                one.source = "old text"

    for change in (edit, old):
        assert answer_in(repaired(change)).strip() == FORM.questions[QUESTION]


def test_an_open_answer_that_became_code_does_not_run():
    def edit(notebook):
        position = place(notebook, QUESTION)
        notebook.cells[position] = new_code_cell("Mine, no code at all", metadata=notebook.cells[position].metadata)

    one = repaired(edit)
    assert kinds(one) == ["an open answer in a code cell was made text again"] and "Mine" not in ran(one) and not one.ambiguous


def test_open_answers_of_a_notebook_without_marks_are_found_by_most_of_their_lines():
    def edit(notebook):
        for one in notebook.cells:
            one.metadata.pop("nbgrader", None)
            if one.source.startswith("**Open question**"):
                one.source = one.source.replace("**Open question**", "**My answer to**").replace(ANSWER_LINE, "Mine.")

    one = repaired(edit)
    assert not one.ambiguous and "Mine." in answer_in(one) and "Mine." in answer_in(one, OTHER)


def test_hostile_metadata_and_texts_are_no_exception():
    def edit(notebook):
        add(notebook, 0, "def compute_gae(" * 20_000)
        add(notebook, 0, "def compute_gae():\n" + '"""' * 3_000 + "\n    raise NotImplementedError")
        add(notebook, 0, "```\n" * 50_000, cell_type="markdown")
        for number, one in enumerate(notebook.cells):
            if number % 7 == 0:
                one.metadata["nbgrader"] = {"grade_id": QUESTION if number % 2 else "compute_gae", "solution": "yes", "grade": []}

    repaired(edit)
