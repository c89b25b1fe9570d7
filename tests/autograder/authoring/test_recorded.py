"""Numbers that checks take from the atlas are those of its records, of the library and the rule that are named."""

import pytest
import torch

from autograder.authoring import recorded
from experiments.atlas.given import GIVEN, formulas


def row(number, rule, formula="gae"):
    return {"formula": formula, "numbers": [number], "equal": not rule, "rule": rule}


@pytest.fixture
def records(monkeypatch):
    rows = [row(1.0, "leaks"), row(2.0, "stops"), row(3.0, "leaks", "other")]
    known = {"a-old": {"versions": {"b": "0.1"}, "rows": [row(4.0, "")]}, "a": {"versions": {"a": "1.0"}, "rows": rows}}
    monkeypatch.setattr(recorded, "_records", lambda: known)


@pytest.mark.usefixtures("records")
def test_numbers_are_of_the_library_the_formula_and_the_rule():
    assert recorded.numbers("a", "gae", "leaks").tolist() == [1.0] and recorded.numbers("a", "gae", "stops").tolist() == [2.0]
    assert recorded.numbers("a", "other", "leaks").tolist() == [3.0] and recorded.numbers("b", "gae").tolist() == [4.0]


@pytest.mark.usefixtures("records")
@pytest.mark.parametrize(("library", "rule"), [("c", "leaks"), ("b", "leaks"), ("a", "")])
def test_numbers_that_no_library_gave_are_an_error(library, rule):
    with pytest.raises(LookupError, match=library):
        recorded.numbers(library, "gae", rule)


def test_the_course_computes_from_the_given_input_what_libraries_that_agree_with_it_recorded():
    assert recorded.given("logp").tolist() == GIVEN["logp"] and recorded.given("truncated").dtype == torch.bool
    ours = torch.tensor(formulas()["gae"].ours, dtype=torch.float64)
    torch.testing.assert_close(recorded.numbers("stable-baselines3", "gae"), ours, rtol=1e-5, atol=1e-5)
