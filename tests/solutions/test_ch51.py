"""Chapter 51's functions: values by hand, limits and gradients."""

import math

import pytest
import torch

from course_lib.control.dynamics import LinearModel, LinearPolicy
from solutions.ch44 import compute_gae
from solutions.ch51 import dreamer_lambda_returns, gaussian_nll, imagine, model_error_by_horizon


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def counter(limit=math.inf, noise=0.0):
    """Each step adds the action, which is 1, to the first component."""
    model = LinearModel(torch.eye(2), torch.tensor([[1.0, 0.0]]), noise, limit)
    return model, LinearPolicy(torch.tensor([[0.0], [1.0]]))


def test_nll_by_hand_and_that_of_pytorchs_distribution():
    mean, log_var, targets = torch.zeros(2, 1, 1), torch.tensor([[[0.0]], [[math.log(4.0)]]]), torch.tensor([[2.0]])
    expected = 0.5 * math.log(2 * math.pi) + 0.5 * (0.5 * 4 + 0.5 * (math.log(4) + 1))
    assert gaussian_nll(mean, log_var, targets).item() == pytest.approx(expected)
    mean, log_var, targets = (torch.randn(3, 5, 2, generator=seeded(i)) for i in range(3))
    normal = torch.distributions.Normal(mean, (0.5 * log_var).exp())
    torch.testing.assert_close(gaussian_nll(mean, log_var, targets), -normal.log_prob(targets).mean())


def test_nll_is_least_at_the_spread_of_the_data_and_gives_targets_no_gradient():
    targets = torch.tensor([[1.0], [-1.0]], dtype=torch.float64, requires_grad=True)
    mean, log_var = (torch.zeros(1, 2, 1, dtype=torch.float64, requires_grad=True) for _ in range(2))
    gaussian_nll(mean, log_var, targets).backward()
    assert log_var.grad.abs().max() < 1e-12 and targets.grad is None and mean.grad.abs().max() > 0


@pytest.mark.parametrize("shape", [(1, 5, 2), (5, 1), (4, 2), (2,)])
def test_nll_refuses_targets_that_would_broadcast(shape):
    with pytest.raises(ValueError, match="targets"):
        gaussian_nll(torch.zeros(3, 5, 2), torch.zeros(3, 5, 2), torch.zeros(shape))


def test_imagination_by_hand():
    model, policy = counter(limit=2.5)
    dream = imagine(model, policy, torch.tensor([[0.0, 1.0], [1.0, 1.0]]), 3, seeded())
    assert dream["obs"][..., 0].tolist() == [[0, 1], [1, 2], [2, 3], [3, 4]]
    assert dream["rewards"].tolist() == [[-2, -5], [-5, -10], [-10, -17]]
    assert dream["continues"].tolist() == [[1, 1], [1, 0], [0, 0]]
    assert dream["actions"].shape == (3, 2, 1) and (model.calls, policy.calls) == (3, 3)


def test_what_has_ended_stays_ended_where_the_model_changes_its_mind():
    model = LinearModel(torch.tensor([[0.0, 1.0], [-1.0, 0.0]]), torch.zeros(1, 2), limit=1.0)
    dream = imagine(model, LinearPolicy(torch.zeros(2, 1)), torch.tensor([[0.0, 2.0]]), 4, seeded())
    assert dream["continues"].squeeze(1).tolist() == [0, 0, 0, 0]


def test_imagination_draws_from_its_generator_only():
    model, policy = counter(noise=1.0)
    dreams = [imagine(model, policy, torch.zeros(3, 2), 4, seeded(seed))["obs"] for seed in (0, 0, 1)]
    assert torch.equal(dreams[0], dreams[1]) and not torch.equal(dreams[0], dreams[2])


def random_dream(steps=6, batch=3):
    rewards, values = torch.randn(2, steps, batch, generator=seeded(), dtype=torch.float64)
    ended = torch.rand(steps, batch, generator=seeded(1)) < 0.2
    return rewards, values, ended


def test_lambda_returns_by_hand():
    rewards, values = torch.tensor([[1.0], [2.0], [3.0]]), torch.tensor([[10.0], [20.0], [30.0]])
    continues = torch.tensor([[1.0], [1.0], [1.0]])
    last = 3 + 0.5 * 30
    middle = 2 + 0.5 * (0.25 * 20 + 0.75 * last)
    first = 1 + 0.5 * (0.25 * 10 + 0.75 * middle)
    found = dreamer_lambda_returns(rewards, values, continues, 0.5, 0.75)
    torch.testing.assert_close(found, torch.tensor([[first], [middle], [last]]))
    continues[1] = 0
    found = dreamer_lambda_returns(rewards, values, continues, 0.5, 0.75)
    torch.testing.assert_close(found[1:], torch.tensor([[2.0], [last]]))


@pytest.mark.parametrize("lam", [0.0, 0.6, 1.0])
def test_lambda_returns_are_those_of_chapter_44(lam):
    """compute_gae's advantages plus values: the value before a step is there what is here the value after the step before."""
    rewards, values, ended = random_dream()
    start = torch.randn(1, 3, generator=seeded(2), dtype=torch.float64)
    before = torch.cat([start, values[:-1]])
    advantages = compute_gae(rewards, before, values, ended, torch.zeros_like(ended), 0.9, lam)
    found = dreamer_lambda_returns(rewards, values, (~ended).double(), 0.9, lam)
    torch.testing.assert_close(found, advantages + before)


def test_lambda_returns_pass_gradient_to_rewards_and_values():
    rewards, values, ended = random_dream()
    assert torch.autograd.gradcheck(
        lambda r, v: dreamer_lambda_returns(r, v, (~ended).double(), 0.9, 0.8),
        (rewards.requires_grad_(), values.requires_grad_()),
    )


@pytest.mark.parametrize(("settings", "named"), [({"gamma": 1.5}, "gamma"), ({"lam": -0.1}, "lam")])
def test_lambda_returns_refuse_impossible_settings(settings, named):
    with pytest.raises(ValueError, match=named):
        dreamer_lambda_returns(*torch.zeros(3, 4, 2), **{"gamma": 0.9, "lam": 0.9} | settings)


def test_error_of_a_model_that_forgets_one_is_the_number_of_steps():
    model, _ = counter()
    actions = torch.ones(4, 3, 1)
    real = torch.zeros(5, 3, 2)
    real[..., 0] = 2 * torch.arange(5)[:, None]  # the world moves by 2, the model by 1
    found = model_error_by_horizon(model, real, actions, seeded())
    torch.testing.assert_close(found, torch.arange(1, 5) / math.sqrt(2))  # a mean over two components, one of them right
    assert model.calls == 4


def test_error_of_a_perfect_model_is_none_and_refuses_misaligned_trajectories():
    model, policy = counter()
    dream = imagine(model, policy, torch.rand(3, 2), 4, seeded())
    assert model_error_by_horizon(model, dream["obs"], dream["actions"], seeded()).tolist() == [0] * 4
    with pytest.raises(ValueError, match="one step more"):
        model_error_by_horizon(model, dream["obs"][:-1], dream["actions"], seeded())
