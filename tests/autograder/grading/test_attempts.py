"""What runs next is a function of what has happened: no exercise is lost to a cell below it, and no time goes below nothing."""

import itertools

import pytest

from autograder.grading.attempts import Attempt, Past, plan, share, suspect

#         cell:  0 helper   1 "a"   2 "b"   3 training   4 "c"   5 more training
DEFINED, CELLS = {"a": 1, "b": 2, "c": 4}, 6


def past(found="", **more):
    return Past(found=frozenset(found), **more)


@pytest.mark.parametrize(
    ("happened", "expected"),
    [
        (past(), Attempt((0, 1, 2, 3, 4, 5), ("a", "b", "c"), loading_spares=3)),
        (past("abc"), None),
        (past("a"), Attempt((0, 1, 2, 3, 4, 5), ("b", "c"), loading_spares=2)),
        # a cell is lost below all answers, between them, above them
        (past(lost=(5,)), Attempt((0, 1, 2, 3, 4), ("a", "b", "c"), loading_spares=2, complete=False)),
        (past(lost=(3,)), Attempt((0, 1, 2), ("a", "b"), loading_spares=1, complete=False)),
        (past(lost=(0,)), Attempt((1, 2, 3, 4, 5), ("a", "b", "c"), (0,), loading_spares=3)),
        # what stood above it is found: the rest goes round it, first with its definitions, then without
        (past("ab", lost=(3,)), Attempt((0, 1, 2, 4, 5), ("c",), (3,), loading_spares=1)),
        (past("ab", lost=(3, 3)), Attempt((0, 1, 2, 4, 5), ("c",), loading_spares=1)),
        (past("ab", lost=(3, 5)), Attempt((0, 1, 2, 4), ("c",), (3,), complete=False)),
        # the cell of an answer is lost itself: what it defines is tried
        (past("a", lost=(2,)), Attempt((0, 1, 3, 4, 5), ("b", "c"), (2,), loading_spares=2)),
        # an error that a helper further down may mend is asked again with it
        (past("a", tried=frozenset("b"), lost=(3,)), Attempt((0, 1, 2, 4, 5), ("b", "c"), (3,), loading_spares=2)),
        # a call ended the process, perhaps by what a later cell left running
        (past(suspicions=1), Attempt((0, 1, 2, 3, 4), ("a", "b", "c"), loading_spares=3)),
        (past("c", suspicions=1), Attempt((0, 1, 2), ("a", "b"), loading_spares=2)),
        (past(suspicions=2), Attempt((0, 1), ("a",), loading_spares=2, spares=2)),
        (past("a", suspicions=2, lost=(0,)), Attempt((1, 2), ("b",), (0,), loading_spares=1, spares=1)),
    ],
)
def test_the_next_attempt(happened, expected):
    assert plan(DEFINED, CELLS, happened) == expected


def test_an_exercise_that_no_cell_seems_to_define_is_asked_with_all_cells():
    assert plan({"a": -1}, 2, past(lost=(1,))) == Attempt((0,), ("a",), (1,), loading_spares=1)
    assert plan({"a": -1}, 2, past(suspicions=2)) == Attempt((0, 1), ("a",))


@pytest.mark.parametrize(
    ("happened", "name", "suspicions"),
    [
        (past(), "a", 1),
        (past(), "c", 1),  # cell 5 stands below all answers: without it first
        (past(suspicions=1), "a", 2),
        (past(suspicions=1), "c", None),  # no cell below it has run
        (past(suspicions=2), "a", None),
    ],
)
def test_a_lost_call_is_a_later_cells_doing_only_if_one_has_run(happened, name, suspicions):
    suspected = suspect(DEFINED, CELLS, happened, plan(DEFINED, CELLS, happened), name)
    assert (suspected and suspected.suspicions) == suspicions


def test_with_no_cell_below_the_answers_each_is_asked_by_itself_at_once():
    assert suspect({"a": 0, "b": 1}, 2, past(), plan({"a": 0, "b": 1}, 2, past()), "a").suspicions == 2
    assert suspect({"a": -1}, 2, past(), plan({"a": -1}, 2, past()), "a") is None


def test_without_cells_nothing_is_run():
    assert plan({"a": -1}, 0, past()) == Attempt((), ("a",), loading_spares=1)
    assert plan({"a": 0}, 1, past(lost=(0, 0))) == Attempt((), ("a",), loading_spares=1)


@pytest.mark.parametrize("endless", [set(cells) for n in range(CELLS + 1) for cells in itertools.combinations(range(CELLS), n)])
def test_whatever_cells_are_endless_the_others_are_asked_for(endless):
    """An endless cell of an answer still defines it; every exercise is asked in a process where no cell hangs."""
    happened = Past()
    for _ in range(20):
        attempt = plan(DEFINED, CELLS, happened)
        if attempt is None:
            break
        if hanging := [cell for cell in attempt.whole if cell in endless]:
            happened = Past(happened.found, lost=(*happened.lost, hanging[0]))
        else:
            assert all(DEFINED[name] in attempt.whole + attempt.definitions for name in attempt.exercises)
            happened = Past(happened.found | set(attempt.exercises), lost=happened.lost)
    assert happened.found == set(DEFINED) and set(happened.lost) == endless and len(happened.lost) == len(endless)


@pytest.mark.parametrize(
    ("left", "spares", "seconds"),
    [
        (220, 6, 30),  # the first load of six exercises at 30 s
        (190, 5, 30),  # the next, for the first of them
        (150, 5, 25),  # too little for all: equal parts
        (0.6, 5, 0.1),
        (1000, 0, 30),
    ],
)
def test_every_step_gets_its_share(left, spares, seconds):
    assert share(left, spares, 30) == pytest.approx(seconds)


def test_shares_never_exceed_what_is_left():
    for spares, timeout in itertools.product(range(12), (0.1, 4, 60)):
        left = (spares + 1) * timeout * 0.7
        for remaining in range(spares, -1, -1):
            step = share(left, remaining, timeout)
            assert 0 < step <= timeout
            left -= step
        assert left >= -1e-9
