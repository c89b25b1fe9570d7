from pathlib import Path

import pytest

from autograder.authoring.bibliography import Bibliography

BIBLIOGRAPHY = Bibliography(Path(__file__).parents[1] / "fixtures" / "references.bib")


def test_one_two_and_many_authors_are_named_as_readers_expect():
    assert BIBLIOGRAPHY.cite(["schulman2016"], False) == "Schulman et al. (2016)"
    assert BIBLIOGRAPHY.cite(["schulman2016", "sutton2018"], False) == "Schulman et al. (2016) and Sutton and Bärto (2018)"
    assert BIBLIOGRAPHY.cite(["sutton2018", "schulman2016"], True) == "(Sutton and Bärto, 2018; Schulman et al., 2016)"


def test_the_list_has_each_work_on_one_line_without_escapes_that_nobody_needs():
    listed = BIBLIOGRAPHY.listing(["sutton2018", "schulman2016"]).splitlines()
    assert [line.split()[1] for line in listed] == ["John", "Richard"]
    assert listed[1] == "- Richard S. Sutton and Andrew G. Bärto. *Reinforcement Learning: An Introduction*. MIT Press, 2018."


def test_an_unknown_key_is_an_error():
    with pytest.raises(KeyError, match="nobody1900"):
        BIBLIOGRAPHY.cite(["nobody1900"], parenthesised=False)
