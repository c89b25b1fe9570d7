"""Diagnosis on a toy exercise: what is paid, what is named, what is said, and that nobody is accused falsely."""

import dataclasses

import numpy as np
import pytest
import torch

from autograder.authoring import freeze
from autograder.authoring.spec import Case, Exercise, Misconception
from course_lib import validate
from course_lib.checks import views
from course_lib.checks.cases import built
from course_lib.checks.diagnosis import diagnose, examine


def double(x, ended, gamma=0.5):
    """Twice x, 0 where ended."""
    if not 0 <= gamma <= 1:
        raise ValueError(f"gamma must lie in [0, 1], got {gamma}")
    return 2 * x * ~ended


def _table(generator):
    ended = torch.zeros(3, 2, dtype=torch.bool)
    ended[1, 1] = True
    return {"x": torch.randn(3, 2, generator=generator, dtype=torch.float64), "ended": ended}


def _bad(generator):
    return _table(generator) | {"gamma": 2.0}


TOY = Exercise(
    name="double",
    reference=double,
    criteria={"values": 1.0, "gradient": 0.5, "dtype": 0.25, "inputs": 0.125, "errors": 0.125},
    axes=("t", "env"),
    cases=(
        Case("table", _table, visible=True),
        Case("gradient", _table, differentiate=["x"], visible=True),
        Case("single", _table, dtype=torch.float32, visible=True),
        Case("gamma = 2", _bad, raises=["gamma"], visible=True),
    ),
    misconceptions=(
        Misconception("end-ignored", lambda x, ended, gamma=0.5: 2 * x, "Look at ended."),
        Misconception("end-ignored-again", lambda x, ended, gamma=0.5: x + x, "Look at ended, said otherwise."),
        Misconception("detached", lambda x, ended, gamma=0.5: double(x, ended, gamma).detach(), "Do not detach."),
        Misconception("unchecked", lambda x, ended, gamma=0.5: 2 * x * ~ended, "Check gamma."),
    ),
    variants={"sum": lambda x, ended, gamma=0.5: double(x, ended, gamma)},
)
VISIBLE = freeze.visible(TOY)


def finding(function, frozen=VISIBLE):
    return examine(frozen, function)


def test_the_reference_gets_everything_and_the_stub_nothing():
    def stub(x, ended, gamma=0.5):
        raise NotImplementedError

    assert (finding(double).state, finding(double).score) == ("correct", 2.0)
    assert (finding(stub).state, finding(stub).score) == ("not_implemented", 0.0)


def test_points_are_paid_by_facet():
    def mutating(x, ended, gamma=0.5):
        result = double(x, ended, gamma)
        with torch.no_grad():
            x += 1
        return result

    assert finding(lambda x, ended, gamma=0.5: double(x, ended, gamma).detach()).score == 1.5
    assert finding(lambda x, ended, gamma=0.5: double(x, ended, gamma).float()).failed == ["dtype"]
    assert finding(mutating).failed == ["inputs"]


def test_nothing_is_paid_without_right_values():
    wrong = finding(lambda x, ended, gamma=0.5: double(x, ended, gamma) + 1)
    assert (wrong.state, wrong.score) == ("wrong", 0.0)


def test_all_misconceptions_that_explain_are_named():
    assert finding(lambda x, ended, gamma=0.5: x * 2).misconceptions == ["end-ignored", "end-ignored-again"]


def test_wrong_values_are_named_even_if_the_gradient_is_wrong_in_a_way_of_its_own():
    assert finding(lambda x, ended, gamma=0.5: 2 * x.detach()).misconceptions == ["end-ignored", "end-ignored-again"]


def test_nobody_is_accused_falsely():
    assert finding(lambda x, ended, gamma=0.5: double(x, ended, gamma) * 1.01).misconceptions == []
    assert finding(lambda x, ended, gamma=0.5: None).misconceptions == []


def test_the_message_says_where_and_what_the_step_was():
    message = finding(lambda x, ended, gamma=0.5: torch.where(ended, x, 2 * x)).message
    assert "t=1, env=1" in message and "0 is right" in message and "t=1 is where env 1 was ended" in message


def test_a_hidden_case_shows_no_expected_number():
    complete = freeze.complete(TOY)
    hidden = [case for case in complete.cases if not case.visible]
    complete.cases = hidden
    message = finding(lambda x, ended, gamma=0.5: 3 * x * ~ended, complete).message
    assert "is not right" in message and "is right at" not in message


def test_wrong_shapes_kinds_and_exceptions_are_described():
    def crash(x, ended, gamma=0.5):
        raise IndexError("t out of range")

    assert "(6,)" in finding(lambda x, ended, gamma=0.5: double(x, ended, gamma).flatten()).message
    assert "a float" in finding(lambda x, ended, gamma=0.5: 1.0).message
    assert finding(crash).state == "error" and "IndexError: t out of range" in finding(crash).message


def test_an_answer_that_stops_is_shown_where_it_stops():
    """And not where its values are wrong, in an earlier case: the verdict above the evidence says that it stops."""

    def crashing(x, ended, gamma=0.5):
        return [3 * x * ~ended][int(gamma)]

    whole = Case("gamma = 1", lambda generator: _table(generator) | {"gamma": 1.0}, visible=True)
    named = Misconception("crashing", crashing, "Mind the size.")
    unknown = dataclasses.replace(TOY, cases=(*TOY.cases, whole))
    known = dataclasses.replace(unknown, misconceptions=(*TOY.misconceptions, named))
    stopped, explained = (finding(crashing, freeze.visible(one)) for one in (unknown, known))
    assert stopped.state == "error" and stopped.message.startswith(
        "Case “gamma = 1”: It raises IndexError: list index out of range"
    )
    assert (explained.state, explained.misconceptions) == ("wrong", ["crashing"]) and "Case “table”" in explained.message


def test_an_error_must_be_a_value_error_that_names_the_argument():
    def silent(x, ended, gamma=0.5):
        if gamma > 1:
            raise ValueError("bad")
        return double(x, ended, gamma)

    assert finding(silent).failed == ["errors"]
    assert finding(silent).misconceptions == []


def test_one_observation_per_case_is_demanded():
    with pytest.raises(ValueError):
        diagnose(VISIBLE, [])


def test_either_of_two_right_answers_counts():
    choice = Exercise(
        "std", lambda x: x.std(), {"values": 1.0}, (Case("c", lambda g: {"x": torch.randn(5, generator=g, dtype=torch.float64)}),), (), {},
        also_right=(lambda x: x.std(correction=0),),
    )  # fmt: skip
    frozen = freeze.complete(choice)
    assert finding(lambda x: x.std(correction=0), frozen).state == "correct"
    assert finding(lambda x: x.var(), frozen).state == "wrong"


def test_visible_and_hidden_draws_differ():
    cases = freeze.complete(TOY).cases
    assert not torch.equal(cases[0].arguments["x"], cases[4].arguments["x"])


def test_a_closed_form_that_disagrees_is_refused():
    broken = Exercise("double", double, {"values": 1.0}, (Case("c", _table, closed_form=lambda x, ended: x),), (), {})
    with pytest.raises(freeze.FreezeError, match="closed form"):
        freeze.complete(broken)


def test_a_reference_that_accepts_what_it_must_refuse_is_refused():
    broken = Exercise("double", double, {"values": 1.0}, (Case("c", _table, raises=["gamma"]),), (), {})
    with pytest.raises(freeze.FreezeError, match="must raise a ValueError that names gamma; it returns a tensor"):
        freeze.complete(broken)


def _order(count, generator):
    return torch.randperm(count, generator=generator)


SHUFFLE = Exercise(
    name="order",
    reference=_order,
    criteria={"values": 1.0},
    cases=(
        Case(
            "ten",
            lambda draws: {
                "count": 10,
                "generator": built("seeding.generator", seed=int(torch.randint(99, (), generator=draws))),
            },
            view="sorted_indices",
            visible=True,
        ),
    ),
    misconceptions=(Misconception("one-short", lambda count, generator: _order(count - 1, generator), "One is missing."),),
    variants={},
)


@pytest.fixture
def shuffle(monkeypatch):
    def sorted_indices(arguments, outputs):
        if outputs[""].dtype != np.int64:
            raise ValueError("indices must be int64")
        return {"sorted": np.sort(outputs[""])}

    monkeypatch.setattr(views, "sorted_indices", sorted_indices, raising=False)
    return freeze.complete(SHUFFLE)


def test_a_view_lets_every_right_answer_pass_and_names_the_wrong_ones(shuffle):
    assert examine(shuffle, lambda count, generator: torch.arange(count).flip(0)).state == "correct"
    assert examine(shuffle, lambda count, generator: torch.arange(count - 1)).misconceptions == ["one-short"]


def test_what_a_view_cannot_read_is_wrong_and_says_why(shuffle):
    for unreadable in (torch.arange(10.0), (torch.arange(10),), None):
        assert examine(shuffle, lambda count, generator, answer=unreadable: answer).state == "wrong"
    assert "indices must be int64" in examine(shuffle, lambda count, generator: torch.arange(10.0)).message


@pytest.mark.parametrize(
    ("message", "named"), [("math domain error", False), ("expected n >= 1", True), ("n=0", True), ("number", False)]
)
def test_an_argument_of_one_letter_is_named_by_a_word_of_its_own(message, named):
    def refuses(n):
        raise ValueError(message)

    case = Case("n = 0", lambda generator: {"n": 0}, raises=["n"], visible=True)
    exercise = Exercise("log", lambda n: validate.at_least_one(n=n), {"errors": 1.0}, (case,), (), {})
    assert (examine(freeze.visible(exercise), refuses).state == "correct") == named
