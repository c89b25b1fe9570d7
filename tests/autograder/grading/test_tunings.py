"""An exercise that is judged by training: what its function returns, what that teaches, and what learners and the grader are told."""

import json
import math

import numpy as np
import pytest
import torch

from autograder import checks
from autograder.authoring import artefacts, freeze
from autograder.authoring.spec import Tuning
from autograder.grading import judge
from autograder.proving import practice
from autograder.publishing import hub
from course_lib.checks import client, command
from course_lib.checks import tuning as judging
from course_lib.checks.observing import observe
from course_lib.control import tuning
from course_lib.control.policies import policy_for

LOGGED = {"approx_kl": 0.01, "clip_fraction": 0.1, "explained_variance": 0.5, "entropy": 1.0}


def never_learns(envs, settings, seed=0, log=None):
    """A training program that leaves the policy as it is."""
    log(LOGGED)
    return policy_for(envs, settings.hidden, settings.log_std, seed)


EXERCISE = Tuning("settings", lambda: {}, never_learns, 2.0, (0.0, 40.0), episodes=3, visible_episodes=2)
HIDDEN, VISIBLE = artefacts.trained_by_grader(EXERCISE), artefacts.trained_by_learners(EXERCISE)


def settings():
    return {"learning_rate": 1e-3}


def found(function, exercise=HIDDEN):
    return judging.judged(exercise, observe(function, {}), never_learns)


@pytest.mark.parametrize(
    ("mean", "points", "state"),
    [(-1, 0, "wrong"), (0, 0, "wrong"), (20, 1, "partial"), (39.99, 1.99, "partial"), (40, 2, "correct"), (50, 2, "correct")],
)
def test_points_grow_on_a_straight_line_with_the_mean_return(monkeypatch, mean, points, state):
    monkeypatch.setattr(tuning, "trainings", lambda *_: (np.array([mean - 1.0, mean, mean + 1.0]), LOGGED))
    finding = found(settings)
    assert (finding.score, finding.state, finding.max_score) == (points, state, 2)
    assert finding.message.startswith(f"Mean return {mean:.1f} of at most 50 over 3 trainings (standard error 0.6; the worst")
    assert ("Logged, on average" in finding.message) == (state != "correct")


def test_it_is_trained_with_what_was_returned_and_nothing_else(monkeypatch):
    seen = []
    monkeypatch.setattr(tuning, "trainings", lambda *given: seen.append(given) or (np.ones(3), LOGGED))
    for answer in (settings, lambda: tuning.START.but(learning_rate=1e-3), lambda: {"learning_rate": torch.tensor(1e-3)}):
        found(answer)
    assert [chosen.learning_rate for _, chosen, _ in seen] == pytest.approx([1e-3] * 3)
    assert all(chosen.but(learning_rate=tuning.START.learning_rate) == tuning.START for _, chosen, _ in seen)
    assert [seeds for *_, seeds in seen] == [HIDDEN.seeds] * 3


@pytest.mark.parametrize(
    ("answer", "state", "said"),
    [
        ({"learning_rat": 1e-3}, "wrong", "learning_rat is no setting; to be tuned are num_steps"),
        ({"total_steps": 10**6}, "wrong", "total_steps must stay as it is"),
        ({"learning_rate": 3.0}, "wrong", "learning_rate must be a number from 0 to 0.1, got 3.0"),
        ({"num_epochs": 2.5}, "wrong", "num_epochs must be a whole number from 1 to 20, got 2.5"),
        ({"gamma": math.nan}, "wrong", "gamma must be a number from 0 to 1, got nan"),
        ({"clip_range": math.inf}, "wrong", "clip_range must be a number from 0 to 10, got inf"),
        ({"gamma": True}, "wrong", "gamma must be a number from 0 to 1, got True"),
        ({"gamma": torch.zeros(2)}, "wrong", "where a dict of numbers by the settings' names is asked for"),
        (0.3, "wrong", "It returns a float where a dict"),
        (None, "wrong", "It returns a NoneType where a dict"),
    ],
)
def test_what_cannot_be_trained_with_is_refused_by_name(answer, state, said):
    finding = found(lambda: answer)
    assert (finding.state, finding.score) == (state, 0) and said in finding.message


def test_a_stub_and_an_answer_that_stops_are_told_apart():
    def stub():
        raise NotImplementedError

    assert found(stub).state == "not_implemented"
    assert found(lambda: 1 / 0).message.startswith("It raises ZeroDivisionError")


@pytest.mark.parametrize(
    ("changed", "logged", "said"),
    [
        ({}, {"approx_kl": 1e-5}, "hardly moves the policy"),
        ({"num_steps": 16}, {"approx_kl": 0.3}, "moves the policy very far"),
        ({"num_steps": 128}, {}, "There are few updates in all"),
        ({"num_steps": 16}, {}, "look 1000 steps ahead"),
        ({"log_std": -2.0, "gamma": 0.9, "num_steps": 16}, {}, "next to no noise"),
        ({"ent_coef": 1.0, "gamma": 0.9, "num_steps": 16}, {}, "bonus for noise"),
        ({"gamma": 0.9, "num_steps": 16}, {"entropy": math.nan}, "have overflowed"),
        ({"gamma": 0.9, "num_steps": 16}, {}, "Nothing here is out of the ordinary"),
    ],
)
def test_what_was_logged_says_where_to_look(changed, logged, said):
    first, *pointers = judging.pointers(tuning.tuned(changed), LOGGED | logged)
    assert "updates of" in first and said in " ".join(pointers)


def test_learners_and_grader_train_from_other_seeds():
    assert len(VISIBLE.seeds) == 2 and len(set(HIDDEN.seeds)) == 3 and not set(VISIBLE.seeds) & set(HIDDEN.seeds)
    assert VISIBLE.train is None and HIDDEN.train is never_learns


def test_the_same_settings_earn_the_same_again_and_wild_ones_end():
    [exercise] = [one for one in checks.exercises("ch45") if isinstance(one, Tuning)]
    wild = {"learning_rate": 0.1, "clip_range": 10, "num_epochs": 20, "num_steps": 8, "minibatch_size": 32, "log_std": -3}
    for chosen in (exercise.reference(), wild):
        first, second = (tuning.trainings(exercise.train, tuning.tuned(chosen), [5]) for _ in range(2))
        assert first[0] == second[0] and 0 <= first[0][0] <= 50


# ---- the notebook, the sandbox's judge, plain nbgrader


@pytest.fixture
def folder(tmp_path, monkeypatch):
    freeze.write([EXERCISE], tmp_path / "frozen")
    monkeypatch.setattr(client, "FROZEN", tmp_path / "frozen")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_what_learners_get_holds_no_hidden_seed(folder):
    path = folder / "frozen" / "settings.tuning"
    assert judging.load(path) == VISIBLE and not any(str(seed) in path.read_text() for seed in HIDDEN.seeds)


def notebook(folder, *sources):
    cells = [{"cell_type": "code", "source": source, "metadata": {}} for source in (*sources, "check(settings)")]
    (folder / "ch97.ipynb").write_text(json.dumps({"cells": cells, "nbformat": 4}))
    return str(folder / "ch97.ipynb")


ANSWER = "def settings():\n    return {'learning_rate': 1e-3}\n"
PROGRAM = "def train_ppo(envs, settings, seed=0, log=None):\n    "


def test_a_learner_is_judged_by_their_own_program(folder, capsys):
    mine = (
        PROGRAM
        + f"log({LOGGED})\n    from course_lib.control.policies import policy_for\n    return policy_for(envs, 64, 0.0, seed)\n"
    )
    assert command.main([notebook(folder, mine, ANSWER)]) == 1
    said = capsys.readouterr().out
    assert "✗ Nearly there: settings" in said and "over 2 trainings" in said
    assert "of 2 points. The grader trains more often, from other seeds, with the course's own program." in said


@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("", "with your train_ppo, which is not defined here: run its cell"),
        (PROGRAM + "raise NotImplementedError", "with your train_ppo, which raises NotImplementedError"),
        (PROGRAM + "return None", "with your train_ppo, which raises AttributeError"),
    ],
)
def test_a_program_that_does_not_train_yet_is_named(folder, capsys, program, said):
    assert command.main([notebook(folder, program, ANSWER)]) == 1
    assert said in capsys.readouterr().out


def test_the_judge_trains_with_the_courses_program(monkeypatch):
    run = object.__new__(judge._Run)
    run.flags = []
    seen = observe(settings, {})
    assert run._compared(HIDDEN, [seen]) == judging.judged(HIDDEN, seen, never_learns)
    assert run._compared(HIDDEN, [seen]).state == "partial" and run.flags == []


def test_nbgraders_hidden_line_pays_the_same(monkeypatch):
    monkeypatch.setattr(hub.checks, "all_exercises", lambda: [EXERCISE])
    hub._frozen.cache_clear()
    assert hub.score("settings", settings) == found(settings).score
    hub._frozen.cache_clear()


def test_no_page_offers_it_for_practice():
    assert "training" in practice.out_of_reach(EXERCISE)
