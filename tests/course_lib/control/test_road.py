"""The rover's road: what its rules promise, and that its driver can keep to it."""

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from course_lib.control.road import LinearPolicy, RoadDriver, RoadEnv


@pytest.mark.parametrize("discrete", [False, True])
def test_it_is_an_environment_as_gymnasium_wants_it(discrete):
    check_env(RoadEnv(time_limit=50, discrete=discrete), skip_render_check=True)


def test_one_step_by_hand():
    env = RoadEnv(gust=0.0)
    obs, _ = env.reset(seed=0)
    after, reward, *_ = env.step(np.array([2.0]))  # as good as 1
    assert after[2] == pytest.approx(0.6) and after[1] == pytest.approx(0.12 * 0.6 - obs[3], abs=1e-6)
    assert after[0] == pytest.approx(obs[0] + 0.5 * np.sin(after[1]), abs=1e-6) and reward == pytest.approx(1 - after[0] ** 2)


def test_seeds_make_roads_and_gusts():
    def observations(seed):
        env = RoadEnv()
        return np.stack([env.reset(seed=seed)[0]] + [env.step([0.1])[0] for _ in range(5)])

    assert (observations(1) == observations(1)).all() and (observations(1) != observations(2)).any()


def test_a_road_with_one_array_shows_the_same_numbers_in_it():
    plain, reusing = RoadEnv(), RoadEnv(one_array=True)
    first, again = plain.reset(seed=3)[0], reusing.reset(seed=3)[0]
    assert (first == again).all()
    then, later = plain.step([0.5])[0], reusing.step([0.5])[0]
    assert later is again and (then == later).all() and (first != then).any()


def test_the_ends():
    env = RoadEnv(time_limit=3)
    env.reset(seed=0)
    ends = [env.step([0.0])[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    with pytest.raises(RuntimeError, match="call reset"):
        env.step([0.0])


def test_the_driver_keeps_to_the_road_and_his_tremor_comes_from_its_generator():
    for driver, env in ((RoadDriver(), RoadEnv()), (RoadDriver(discrete=True), RoadEnv(discrete=True))):
        obs, _ = env.reset(seed=3)
        while not env.ended:
            obs, *_ = env.step(driver(torch.tensor(obs)[None])[0].numpy())
        assert env.elapsed == 200
    obs = torch.zeros(1000, 5)
    noise = RoadDriver(tremor=0.2, generator=torch.Generator().manual_seed(0))(obs)
    assert noise.std().item() == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize(
    ("settings", "name"),
    [({"time_limit": 0}, "time_limit"), ({"gust": -1}, "gust"), ({"bend": -1}, "bend"), ({"start": -1}, "start")],
)
def test_impossible_settings_are_named(settings, name):
    with pytest.raises(ValueError, match=name):
        RoadEnv(**settings)


def test_a_linear_policy_wants_batches():
    policy = LinearPolicy([[1.0, 0.0], [0.0, 2.0]], [0.0, 0.5])
    assert policy(torch.ones(1, 2)).tolist() == [[1.0, 2.5]]
    assert LinearPolicy([[1.0, 0.0], [0.0, 2.0]], [0.0, 0.5], discrete=True)(torch.ones(1, 2)).tolist() == [1]
    with pytest.raises(ValueError, match=r"\(B, O\)"):
        policy(torch.ones(2))
