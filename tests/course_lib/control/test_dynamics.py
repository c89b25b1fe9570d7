"""The small worlds that chapter 51's functions are checked in."""

import torch

from course_lib.control.dynamics import FixedNetwork, LinearModel, LinearPolicy


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def test_a_step_by_hand():
    model = LinearModel(torch.tensor([[1.0, 2.0], [0.0, 1.0]]), torch.tensor([[1.0, 0.0]]), limit=2.5, drift=10.0)
    next_obs, rewards, continues = model(torch.tensor([[1.0, 1.0], [2.0, 0.0]]), torch.tensor([[1.0], [1.0]]), seeded())
    assert next_obs.tolist() == [[2, 3], [3, 4]]
    assert rewards.tolist() == [10 - 13, 10 - 25] and continues.tolist() == [1, 0] and model.calls == 1


def test_noise_has_its_deviation_and_comes_from_the_generator():
    model = LinearModel(torch.zeros(1, 1), torch.zeros(1, 1), noise=0.5)
    columns = [model(torch.zeros(4000, 1), torch.zeros(4000, 1), seeded(seed))[0] for seed in (0, 0, 1)]
    assert torch.equal(columns[0], columns[1]) and not torch.equal(columns[0], columns[2])
    torch.testing.assert_close(columns[0].std(), torch.tensor(0.5), atol=0.03, rtol=0)


def test_without_noise_nothing_is_drawn():
    generator = seeded()
    before = generator.get_state()
    LinearModel(torch.eye(2), torch.zeros(1, 2))(torch.zeros(3, 2), torch.zeros(3, 1), generator)
    policy = LinearPolicy(torch.ones(2, 1))
    assert policy(torch.ones(3, 2), generator).tolist() == [[2]] * 3 and policy.calls == 1
    assert torch.equal(before, generator.get_state())


def test_everything_keeps_the_precision_of_the_observations():
    model, policy = LinearModel(torch.eye(2), torch.zeros(1, 2), noise=0.1), LinearPolicy(torch.ones(2, 1), noise=0.1)
    obs = torch.zeros(3, 2, dtype=torch.float64)
    assert {column.dtype for column in model(obs, policy(obs, seeded()), seeded())} == {torch.float64}


def test_a_fixed_network_is_the_hyperbolic_tangent_of_a_product():
    network = FixedNetwork(torch.tensor([[1.0], [2.0]], dtype=torch.float64))
    torch.testing.assert_close(network(torch.tensor([[0.5, 0.25]])), torch.tensor([[1.0]]).tanh())
