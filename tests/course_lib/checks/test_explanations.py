"""Which misconceptions are named: one row for each rule, on observations written by hand. Whoever changes a rule breaks a row."""

import doctest

import pytest
import torch

from course_lib.checks import diagnosis
from course_lib.checks.cases import FrozenCase, FrozenExercise, Observation
from course_lib.checks.diagnosis import diagnose, differing_facets, signature


def did(value=1.0, gradient=5.0, dtype="float64", changed=(), graph=("",), kind="tensor"):
    """What a call did; by default what is right."""
    gradients = {"x": None if gradient is None else torch.tensor(gradient)}
    return Observation(
        "", "", kind, {"": torch.tensor(value, dtype=getattr(torch, dtype))}, list(graph), gradients, list(changed)
    )


def raised(error="IndexError", message="out of range"):
    return Observation(error=error, message=message)


def judged(wrong, seen, cases=1, expected=(), **options):
    """The finding for observations of `cases` equal cases; `wrong` has for each misconception what it does, in each case or in all."""
    observed = {name: list(shows) if isinstance(shows, tuple) else [shows] * cases for name, shows in wrong.items()}
    options = {"differentiate": ["x"]} | options
    frozen = [
        FrozenCase(str(i), {}, list(expected) or [did()], {name: shows[i] for name, shows in observed.items()}, **options)
        for i in range(cases)
    ]
    signatures = {name: signature(name, frozen) for name in wrong}
    criteria = {"values": 1.0, "gradient": 0.5, "dtype": 0.25, "inputs": 0.125, "errors": 0.125}
    exercise = FrozenExercise("f", criteria, dict.fromkeys(wrong, "…"), frozen, signatures)
    return diagnose(exercise, list(seen) if isinstance(seen, tuple) else [seen] * cases)


NEARLY, FURTHER = 1 + 1.5e-5, 1 + 3e-5  # the first is near enough to 1, the second to the first, but not to 1

NAMED = {
    "the mistake that was made, and no other": ({"two": did(2.0), "three": did(3.0)}, did(2.0), ["two"]),
    "nothing, where no mistake fits": ({"two": did(2.0)}, did(4.0), []),
    "all that explain the same": ({"one way": did(2.0), "another": did(2.0)}, did(2.0), ["one way", "another"]),
    "the one that explains strictly more, of two that fit": (
        {"cut": did(gradient=None), "cut and rounded": did(gradient=None, dtype="float32")},
        did(gradient=None, dtype="float32"),
        ["cut and rounded"],
    ),
    "each of two that explain different things, of right values": (
        {"cut": did(gradient=None), "changing": did(changed=["x"])},
        did(gradient=None, changed=["x"]),
        ["cut", "changing"],
    ),
    "one that explains a part, of right values": ({"cut": did(gradient=None)}, did(gradient=None, changed=["x"]), ["cut"]),
    "not one that is wrong where the function is right": ({"cut, two": did(2.0, gradient=None)}, did(gradient=None), []),
    "not one that is wrong where the function is right, be it nearly": (
        {"far and changing": did(FURTHER, changed=["x"])},
        did(NEARLY, changed=["x"]),
        [],
    ),
    "not one that goes wrong nowhere": ({"right after all": did()}, did(changed=["x"]), []),
    "not one that goes wrong nowhere, beside wrong values": ({"right after all": did()}, did(2.0), []),
    "with wrong values, not a lesser mistake": ({"cut": did(gradient=None)}, did(2.0, gradient=None), []),
    "with wrong values, not a lesser mistake beside the one that explains them": (
        {"two": did(2.0), "changing": did(changed=["x"])},
        did(2.0, changed=["x"]),
        ["two"],
    ),
    "with wrong values, first what explains everything": (
        {"two": did(2.0), "two and cut": did(2.0, gradient=None)},
        did(2.0, gradient=None),
        ["two and cut"],
    ),
    "what explains the values, where the rest has no explanation": ({"two": did(2.0)}, did(2.0, gradient=7.0), ["two"]),
    "what explains the values, be it wrong elsewhere in another way": (
        {"two and cut": did(2.0, gradient=None)},
        did(2.0, gradient=7.0),
        ["two and cut"],
    ),
    "all that explain the values alike, whatever else they do": (
        {"two": did(2.0, dtype="float32"), "two and cut": did(2.0, gradient=None)},
        did(2.0, gradient=7.0),
        ["two", "two and cut"],
    ),
    "all that explain the values alike, be one wrong in more": (
        {"two and cut": did(2.0, gradient=None), "two, cut and rounded": did(2.0, gradient=None, dtype="float32")},
        did(2.0, gradient=7.0),
        ["two and cut", "two, cut and rounded"],
    ),
    "what raises the same": ({"raising": raised(), "raising another": raised("KeyError")}, raised(), ["raising"]),
    "not what returns, of a function that raises": ({"two": did(2.0)}, raised(), []),
}


@pytest.mark.parametrize(("wrong", "seen", "named"), NAMED.values(), ids=NAMED)
def test_named_is(wrong, seen, named):
    assert judged(wrong, seen).misconceptions == named


def test_a_misconception_must_fit_in_every_case_not_in_one():
    wrong = {"always two": did(2.0), "two at first": (did(2.0), did())}
    assert judged(wrong, (did(2.0), did()), cases=2).misconceptions == ["two at first"]
    assert judged(wrong, (did(), did(2.0)), cases=2).misconceptions == []


def test_a_misconception_is_compared_in_all_its_facets_in_cases_that_show_one_only():
    wrong = {"two, then cut": (did(2.0), did(gradient=None))}
    assert judged(wrong, (did(2.0), did(gradient=None)), cases=2).misconceptions == ["two, then cut"]
    assert judged(wrong, (did(2.0, gradient=None), did(gradient=None)), cases=2).misconceptions == ["two, then cut"]
    assert judged(wrong, (did(3.0), did(gradient=None)), cases=2).misconceptions == []


def test_of_several_right_answers_the_nearest_counts():
    expected = [did(1.0), did(2.0, gradient=7.0)]
    assert judged({}, did(2.0, gradient=7.0), expected=expected).state == "correct"
    assert judged({"cut": did(2.0, gradient=None)}, did(2.0, gradient=None), expected=expected).failed == ["gradient"]


FACETS_OF = {
    "nothing": (did(), set()),
    "another value": (did(2.0), {"values"}),
    "another shape": (did([1.0]), {"values"}),
    "another kind": (did(kind="float"), {"values"}),
    "another kind hides the dtype": (did(kind="float", dtype="float32"), {"values"}),
    "another dtype": (did(dtype="float32"), {"dtype"}),
    "another gradient": (did(gradient=7.0), {"gradient"}),
    "no gradient": (did(gradient=None), {"gradient"}),
    "no graph": (did(graph=()), {"gradient"}),
    "a changed input": (did(changed=["x"]), {"inputs"}),
    "everything": (did(2.0, None, "float32", ["x"]), {"values", "gradient", "dtype", "inputs"}),
    "an exception costs the case's facet": (raised(), {"dtype"}),
}


@pytest.mark.parametrize(("seen", "facets"), FACETS_OF.values(), ids=FACETS_OF)
def test_differs_in(seen, facets):
    case = FrozenCase("c", {}, [did()], differentiate=["x"], facet="dtype")
    assert differing_facets(seen, did(), case) == facets == differing_facets(did(), seen, case)


REFUSALS = {
    "rightly": (raised("ValueError", "gamma = 2"), set()),
    "with another exception": (raised("TypeError", "gamma = 2"), {"errors"}),
    "without the argument's name": (raised("ValueError", "bad"), {"errors"}),
    "not at all": (did(), {"errors"}),
}


@pytest.mark.parametrize(("seen", "facets"), REFUSALS.values(), ids=REFUSALS)
def test_refuses(seen, facets):
    case = FrozenCase("c", {}, [], raises=["gamma", "lam"], facet="errors")
    assert differing_facets(seen, raised("ValueError", "lam = 3"), case) == facets


def test_two_that_fail_to_refuse_alike_do_not_differ():
    case = FrozenCase("c", {}, [], raises=["gamma"], facet="errors")
    assert differing_facets(did(1.0), did(2.0), case) == set()
    assert differing_facets(raised("ValueError", "bad"), raised("ValueError", "worse"), case) == set()
    assert differing_facets(raised("ValueError", "bad"), did(), case) == {"errors"}


STATES = {
    "all right": (did(), "correct", 2.0),
    "wrong values pay nothing": (did(2.0), "wrong", 0.0),
    "a lost facet costs its points": (did(gradient=None), "partial", 1.5),
    "two cost both": (did(gradient=None, changed=["x"]), "partial", 1.375),
    "an exception that nothing explains": (raised("KeyError"), "error", 0.0),
    "an exception that a misconception explains": (raised(), "wrong", 0.0),
    "a stub": (raised("NotImplementedError"), "not_implemented", 0.0),
}


@pytest.mark.parametrize(("seen", "state", "score"), STATES.values(), ids=STATES)
def test_state_and_points(seen, state, score):
    finding = judged({"raising": raised()}, seen)
    assert (finding.state, finding.score) == (state, score)


def test_the_examples_in_the_docstrings_hold():
    examples = [example for example in doctest.DocTestFinder().find(diagnosis) if example.examples]
    assert [example.name.rpartition(".")[2] for example in examples] == ["_explanations", "begin_with"]
    for example in examples:
        assert doctest.DocTestRunner().run(example).failed == 0
