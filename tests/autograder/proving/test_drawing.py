"""Figures that answer to the reader's own code: which they are, and that a page draws what the book shows."""

from __future__ import annotations

import functools
from unittest.mock import patch

import pytest

from autograder import checks
from autograder.authoring import chapter as chapters
from autograder.authoring.spec import Exercise
from autograder.proving import drawing, practice
from course_lib.chapters import REFERENCES
from course_lib.figures import interactive

CLIP, CREDIT = (
    "One sample: objectives and gradients against the ratio",
    "How λ and γ spread two surprises over the steps before them",
)
DRAWN = {
    "ch43": {CLIP: ("surrogate_loss", "clipped_surrogate_loss")},
    "ch44": {
        CREDIT: ("td_residuals", "compute_gae"),
        "What an end of the episode does to credit": ("td_residuals", "compute_gae"),
    },
    "ch45": {"What one action with advantage 1 asks of a Gaussian policy": ("gaussian_log_prob",)},
    "ch47": {"A Gaussian, squashed, and the correction of its log-density": ("squashed_gaussian_log_prob",)},
    "ch48": {"What each run weighs, and what one odd run does to three means": ("interquartile_mean",)},
    "ch51": {"What the first λ-return is made of": ("dreamer_lambda_returns",)},
    "ch80": {"A choice, its loss, and how hard it pulls": ("preference_probability", "bradley_terry_loss")},
    "ch97": {"What one pair asks for": ("dpo_loss", "ipo_loss")},
    "ch102": {"Where a single 1 comes out, by each rule": ("gae_as",)},
}
ELSEWHERE = {
    "ch45": {"Eight epochs on one batch": "course_lib.control.envs.HoverVectorEnv"},
    "ch47": {"The temperature finds the price at which the policy has the entropy asked for": "torch.optim"},
    "ch51": {"What an ensemble knows, and what it knows of that": "torch.Generator"},
    "ch95": {"Rewards and advantages of one text": "course_lib.language.lm"},
    "ch96": {"Best-of-n by a proxy: what it promises and what it gives": "torch.Generator"},
}


@functools.cache
def figures(assignment: str) -> list[drawing.Figure]:
    return drawing.figures(chapters.load(assignment), practice.offered_in(assignment))


def by_torch(figure: drawing.Figure, assignment: str, **answers) -> str:
    """The figure's HTML for the book, from real torch and the references, where there is no other answer."""
    shown = []

    def explore(series, *, title, x_label, start=None, **sliders):
        initial = {name: (start or {}).get(name, values[0]) for name, values in sliders.items()}
        shown.append(interactive.to_html(series, title, x_label, initial, sliders))

    one = {exercise.name: exercise.reference for exercise in checks.exercises(assignment) if isinstance(exercise, Exercise)}
    with patch("course_lib.figures.interactive.explore", explore):
        exec(figure.source, one | answers)
    return shown[0]


def output(html: str) -> list[list[dict]]:
    return [[{"data": {"text/html": html}}]]


@pytest.mark.parametrize("assignment", DRAWN)
def test_with_the_books_answers_a_page_draws_what_the_book_shows(assignment, monkeypatch):
    monkeypatch.setenv(REFERENCES, "solutions")
    found = [one for one in figures(assignment) if one.title in DRAWN[assignment]]
    assert {one.title: one.uses for one in found} == DRAWN[assignment]
    outputs = [cell for one in found for cell in output(by_torch(one, assignment))]
    names = [series["name"] for of in drawing.recorded(outputs).values() for series in of["series"]]
    assert not any("yours" in name for name in names)  # which the page says of what it draws over them
    assert drawing.reasons(chapters.load(assignment), found, outputs) == dict.fromkeys(DRAWN[assignment], "")


@functools.cache
def drawn_by(assignment: str, factor: float) -> dict[str, list[list[str]]]:
    found = [one for one in figures(assignment) if one.title in DRAWN[assignment]]
    return drawing.drawn_by(chapters.load(assignment), found, factor)


@pytest.mark.parametrize("factor", [-1.0, 0.5])
@pytest.mark.parametrize("assignment", DRAWN)
def test_no_figure_draws_an_answer_of_the_wrong_sign_or_scale_on_the_books_curves(assignment, factor):
    moved = {title: {name for names in series for name in names} for title, series in drawn_by(assignment, factor).items()}
    assert moved == {title: set(uses) for title, uses in DRAWN[assignment].items()}


def test_a_pair_shows_a_forgotten_reference():
    (figure,) = figures("ch97")
    text = practice.answers(chapters.load("ch97"))["ipo_loss"]
    wrong = text.replace("ref_chosen_logps.detach()", "0").replace("ref_rejected_logps.detach()", "0")
    assert wrong != text
    calls = [(figure.title, [2, 0], answers) for answers in ({}, {"ipo_loss": wrong})]
    book, mine = drawing.draw(chapters.load("ch97"), [figure], calls)
    assert [drawing.same(a, b) for a, b in zip(mine["values"], book["values"], strict=True)] == [True, False, True, False, True]


def test_every_other_figure_that_calls_an_exercise_needs_what_a_page_lacks():
    found = {name: figures(name) for name in checks.assignments() if practice.has_page(name)}
    others = {name: [one for one in of if one.title not in DRAWN.get(name, {})] for name, of in found.items()}
    assert {name: {one.title for one in of} for name, of in others.items() if of} == {
        name: set(of) for name, of in ELSEWHERE.items()
    }
    for name, of in ELSEWHERE.items():
        told = drawing.draw(chapters.load(name), others[name], [(title, [0, 0]) for title in of])
        for lacks, one in zip(of.values(), told, strict=True):
            assert f"{lacks} is not in " in one["sentence"]


def test_a_figure_that_the_page_draws_otherwise_is_refused():
    (figure,) = figures("ch43")
    html = by_torch(
        figure, "ch43", clipped_surrogate_loss=lambda new, old, advantages, clip_range: -advantages.mean() * 2 * new.mean()
    )
    reasons = drawing.reasons(chapters.load("ch43"), [figure], output(html))
    assert reasons == {CLIP: "objective clipped is another curve on the page at -1, 0"}


@pytest.mark.parametrize(
    ("mine", "right", "alike"),
    [
        ([1.0, None], [1.0, None], True),
        ([1.0, 2.001], [1.0, 2.0], True),
        ([1.0, 2.004], [1.0, 2.0], False),
        ([1.0, 1e-9], [1.0, 0], True),
        ([1.0, 1e-3], [1.0, 0], False),
        ([1.0, None], [1.0, 0], False),
        ([1.0], [1.0, 0], False),
    ],
)
def test_curves_are_the_same_to_four_digits(mine, right, alike):
    assert drawing.same(mine, right) == alike


def test_a_figure_takes_along_what_it_rests_on_and_no_answer():
    by_title = {one.title: one for one in figures("ch44")}
    lines = by_title[CREDIT].source.splitlines()
    for line in ("import torch", "rewards[12] = 1.0", "hopes[9:13] = 0.9"):
        assert line in lines
    for name in ("ch43", "ch44", "ch45", "ch97"):
        assert not any("solutions" in one.source for one in figures(name))


# ---- what a reader's answer draws -----------------------------------------------------------------------------------------

GAE = practice.answers(chapters.load("ch44"))["compute_gae"]
HEAD = "def compute_gae(rewards, values, next_values, terminated, truncated, gamma=0.99, gae_lambda=0.95):\n"


def drawn(*texts: str, with_solutions: bool = True) -> list[dict]:
    """What the page of chapter 44 draws at λ = 0.9 and γ = 0.99 with each of these texts for compute_gae."""
    calls = [(CREDIT, [5, 3], {"compute_gae": text} if text else {}) for text in texts]
    return drawing.draw(chapters.load("ch44"), figures("ch44"), calls, with_solutions)


def test_a_wrong_answer_draws_another_curve():
    wrong = GAE.replace("ended = terminated | truncated", "ended = terminated | True")
    assert wrong != GAE
    right, mine, other = drawn("", GAE, wrong)
    assert right == mine and right["sentence"] == other["sentence"] == ""
    assert [a == b for a, b in zip(right["values"], other["values"], strict=True)] == [True, False, True]


STOPS = "There is no curve of yours, as compute_gae stops: "
CELL = "There is no curve of yours, as the cell of compute_gae stops: "
UNWRITTEN = "compute_gae returns, which is not written yet: write it, then draw again."


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (HEAD + "    raise NotImplementedError", f"This figure shows what {UNWRITTEN}"),
        (HEAD + "    raise ValueError('no')", f"{STOPS}ValueError: no. Its check says more."),
        (HEAD + "    raise SystemExit('no')", f"{STOPS}SystemExit: no. Its check says more."),
        (HEAD + "    return 1 +", f"{CELL}SyntaxError: invalid syntax in line 2: return 1 +"),
        ("x = 1", f"{CELL}The cell defines no function compute_gae."),
        (
            "import numpy as np\n" + HEAD + "    return np.zeros(16)",
            "There is no curve of yours: numpy is not in the page; it is in the notebook.",
        ),
        (
            HEAD + "    return None",
            "There is no curve of yours, as the figure can't use what compute_gae returns: None.",
        ),
        (
            HEAD + "    return (rewards, None)",
            "There is no curve of yours, as the figure can't use what compute_gae returns: a tuple (a tensor of shape (16, 1), None).",
        ),
    ],
)
def test_what_draws_nothing_says_one_sentence(text, sentence):
    (told,) = drawn(text)
    assert told["values"] == [] and told["sentence"].startswith(sentence)


def test_without_solutions_a_figure_asks_for_what_it_calls():
    (told,) = drawn(GAE, with_solutions=False)
    assert told["sentence"] == "This figure needs td_residuals, which is not written yet: write it, then draw again."


def test_what_no_axis_can_hold_is_a_gap():
    (told,) = drawn(HEAD + "    return torch.full((16, 1), float('inf'))")
    assert told["values"][1] == [None] * 16
