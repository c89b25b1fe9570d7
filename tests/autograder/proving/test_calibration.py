"""The statistics behind thresholds, and the bar that every artefact's must pass."""

import numpy as np
import pytest

from autograder import checks
from autograder.authoring import artefacts
from autograder.authoring.spec import Artefact, Tuning
from autograder.grading import flights
from autograder.proving import calibration
from course_lib.control import tuning
from course_lib.figures import records

ARTEFACTS = [exercise for exercise in checks.all_exercises() if isinstance(exercise, Artefact)]
TUNINGS = [exercise for exercise in checks.all_exercises() if isinstance(exercise, Tuning)]


def agents(centre, between, within, count=20, seed=0):
    generator = np.random.default_rng(seed)
    return generator.normal(centre, between, (count, 1)) + generator.normal(0, within, (count, 100))


def test_the_chance_follows_what_differs_between_agents():
    # normal agents, two deviations above the mark: a fortieth, and somewhat more as their deviation is estimated
    chances = [calibration.chance_below(agents(220, 10, 1, seed=seed), 200) for seed in range(200)]
    assert 0.02 < np.mean(chances) < 0.06


def test_the_chance_follows_what_differs_between_episodes():
    # agents that are all alike: what is left is the error of the mean of a hundred episodes
    alike = np.tile(np.random.default_rng(0).normal(0, 1, (1, 100)), (20, 1))
    alike = 220 + 100 * (alike - alike.mean()) / alike.std()
    assert calibration.chance_below(alike, 200) == pytest.approx(0.0228, abs=0.002)


def test_one_failure_among_twenty_is_seen():
    returns = agents(280, 1, 1)
    returns[0] -= 200
    assert calibration.chance_below(returns, 200) >= 0.05


def test_above_is_the_mirror_of_below():
    returns = agents(0, 30, 30)
    assert calibration.chance_from(returns, 40) == calibration.chance_below(-returns, -40)


def test_two_agents_are_too_few():
    with pytest.raises(ValueError, match="at least 3 agents, got 2"):
        calibration.chance_below(agents(0, 1, 1, count=2), 0)


def test_a_row_counts_full_and_half_points():
    train = Artefact("train", lambda: None, "f", "lander", 4.0, (0.0, 200.0))
    right, wrong = agents(260, 5, 50), agents(-100, 20, 50)
    found = [calibration.Group("right", "", right), calibration.Group("masked", "ignores the mask", wrong)]
    first, second = calibration.rows(train, found)
    assert (first.agents, first.full, first.half) == (20, 20, 20) and first.chance < 0.01
    assert (second.full, second.half) == (0, 0) and second.chance < 0.01
    assert first.least <= first.middle <= first.most and first.middle == pytest.approx(260, abs=5)


def test_the_agents_of_an_experiment_are_those_trained_for_it(tmp_path):
    configurations = {
        "no_clip": {},
        "broken_mask": {"mistake": "It looks away."},
        "broken_sign": {"mistake": "It descends."},
        "ours": {},
    }
    for variant, configuration in configurations.items():
        for seed in range(2 if variant == "ours" else 1):
            summary = {"eval_returns": [1.0, 2.0, 3.0]}
            provenance = {"variant": variant, "seed": seed, "configuration": configuration, "summary": summary}
            records.write(tmp_path / "lander" / f"{variant}-{seed}.parquet", [{"env_steps": 1}], provenance)
    train = Artefact("train", lambda: None, "f", "lander", 4.0, (0.0, 200.0), experiment="lander", wrong=["broken_sign"])
    assert [(group.variant, group.mistake, group.returns.shape) for group in calibration.groups(train, tmp_path)] == [
        ("ours", "", (2, 3)),
        ("broken_sign", "It descends.", (1, 3)),
        ("broken_mask", "It looks away.", (1, 3)),
    ]


@pytest.mark.parametrize(
    ("agents", "told"),
    [
        ([260, 250, 240, 230], []),
        ([260, 250, 240, 150], ["train: agents 'ours': 3 of 4 earn all points"]),
    ],
)
def test_agents_that_miss_the_bar_are_told(agents, told):
    train = Artefact("train", lambda: None, "f", "lander", 4.0, (0.0, 200.0), wrong=["masked"])
    returns = np.repeat(np.array(agents, dtype=float)[:, None], 5, axis=1)
    found = [calibration.Group("ours", "", returns), calibration.Group("masked", "It looks away.", returns)]
    row = {"exercise": "train", "wrong": ["masked"], "agents": [vars(row) for row in calibration.rows(train, found)]}
    lines = calibration.report(row, "ours")
    mistaken = f"train: agents 'masked': {sum(mean >= 100 for mean in agents)} of 4 earn half"
    assert lines[-1].startswith(mistaken)
    if told:
        assert lines[0].startswith(told[0])


@pytest.mark.parametrize("artefact", ARTEFACTS + TUNINGS, ids=lambda artefact: artefact.name)
def test_a_right_agent_earns_all_points_and_a_wrong_one_not_half_of_them(artefact):
    rows = {row.variant: row for row in calibration.rows(artefact, calibration.groups(artefact))}
    right, wrong = rows[artefact.right], [rows[variant] for variant in artefact.wrong]
    assert right.agents >= 20 and sum(row.agents for row in wrong) >= 20
    assert right.full == right.agents and right.chance <= calibration.BAR
    assert [row for row in wrong if row.half or row.chance > calibration.BAR_WRONG] == []


@pytest.mark.parametrize("artefact", ARTEFACTS, ids=lambda artefact: artefact.name)
def test_the_judge_flies_a_policy_as_its_run_was_evaluated(artefact):
    known = records.load(artefact.experiment)
    seed = known.seeds(artefact.right)[0]
    judged = flights.fly(artefacts.hidden(artefact), known.artefact(artefact.right, seed, "safetensors").read_bytes(), 120)
    recorded = known.summary(artefact.right, "eval_returns")[0]
    error = np.hypot(judged.std(), recorded.std()) / np.sqrt(len(judged))
    assert abs(judged.mean() - recorded.mean()) < 4 * error


@pytest.mark.parametrize("exercise", TUNINGS, ids=lambda exercise: exercise.name)
def test_the_judge_trains_as_was_recorded(exercise):
    frozen, recorded = (
        artefacts.trained_by_grader(exercise),
        records.load(exercise.experiment).summary(exercise.right, "eval_returns"),
    )
    assert len(frozen.seeds) == recorded.shape[1]
    judged, _ = tuning.trainings(exercise.train, tuning.tuned(exercise.reference()), frozen.seeds)
    error = np.hypot(judged.std(ddof=1), recorded.std(ddof=1)) / np.sqrt(len(judged))
    assert abs(judged.mean() - recorded.mean()) < 4 * error
