"""Chapter 48's functions: values by hand, limits, gradients, and the fast update against the plain one."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from course_lib.control import sac
from solutions import ch48
from solutions.ch48 import (
    polyak_update,
    sac_actor_loss,
    soft_q_target,
    squashed_gaussian_log_prob,
    temperature_loss,
)

TAUGHT = sac.Taught.of(vars(ch48))
SMALL = sac.SACSettings(total_steps=300, learning_starts=50, batch_size=16, hidden=8)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def test_log_prob_at_rest_is_normal_and_integrates_to_one():
    zero = torch.zeros(1, 2)
    assert squashed_gaussian_log_prob(zero, zero, zero).item() == pytest.approx(-math.log(2 * math.pi))
    actions = torch.linspace(-1, 1, 200_001, dtype=torch.float64)[1:-1, None]
    u, one = actions.atanh(), torch.ones_like(actions)
    density = squashed_gaussian_log_prob(0.3 * one, math.log(0.7) * one, u).exp()
    assert density.sum().item() * 1e-5 == pytest.approx(1, abs=1e-4)


@given(st.floats(-1e4, 1e4), st.floats(-5, 2))
@settings(max_examples=50, deadline=None)
def test_log_prob_is_finite_everywhere_and_symmetric(u, log_std):
    mean, log_std, u = (torch.tensor([[value]], dtype=torch.float64) for value in (0.9 * u, log_std, u))
    here, mirrored = squashed_gaussian_log_prob(mean, log_std, u), squashed_gaussian_log_prob(-mean, log_std, -u)
    assert here.isfinite().all()
    torch.testing.assert_close(here, mirrored)


def test_log_prob_is_that_of_pytorchs_distribution_and_passes_gradient_through_the_actions():
    mean, log_std = (torch.randn(5, 3, generator=seeded(i), requires_grad=True) for i in range(2))
    u = mean + log_std.exp() * torch.randn(5, 3, generator=seeded(2))
    result = squashed_gaussian_log_prob(mean, log_std, u)
    normal = torch.distributions.Normal(mean, log_std.exp())
    squashed = torch.distributions.TransformedDistribution(normal, torch.distributions.TanhTransform(cache_size=1))
    torch.testing.assert_close(result, squashed.log_prob(squashed.transforms[0](u)).sum(-1))
    fixed = u.detach().requires_grad_()
    (to_actions,) = torch.autograd.grad(squashed_gaussian_log_prob(mean, log_std, fixed).sum(), fixed)
    torch.testing.assert_close(to_actions, (-(fixed - mean) / log_std.exp().square() + 2 * fixed.tanh()).detach())


def test_target_by_hand():
    """A step that goes on: 1 + 0.5 (min(4, 3) - 0.2 · (-1)); one that terminates: its reward."""
    column = torch.tensor([1.0, 1.0])
    found = soft_q_target(column, torch.tensor([False, True]), 4 * column, 3 * column, -column, 0.2, 0.5)
    torch.testing.assert_close(found, torch.tensor([2.6, 1.0]))


def test_a_terminated_step_may_have_any_next_value():
    column = torch.ones(2)
    found = soft_q_target(column, torch.tensor([True, True]), column * math.inf, column * math.nan, column, 0.2)
    torch.testing.assert_close(found, column)


def test_nothing_of_the_target_has_a_graph():
    given_ = [torch.rand(4, requires_grad=True) for _ in range(5)]
    ended = torch.zeros(4, dtype=torch.bool)
    assert not soft_q_target(given_[0], ended, *given_[1:4], alpha=given_[4][0]).requires_grad


@pytest.mark.parametrize("position", range(5))
def test_target_refuses_columns_that_would_broadcast(position):
    columns = [torch.zeros(3), torch.zeros(3, dtype=torch.bool), *torch.zeros(3, 3)]
    columns[position] = columns[position][:1]
    with pytest.raises(ValueError, match="must have one shape"):
        soft_q_target(*columns, 0.1)


def test_actor_loss_by_hand_and_its_gradients():
    q1, q2 = torch.tensor([1.0, 5.0], requires_grad=True), torch.tensor([2.0, 3.0], requires_grad=True)
    log_probs, alpha = torch.tensor([-1.0, 1.0], requires_grad=True), torch.tensor(0.5, requires_grad=True)
    loss = sac_actor_loss(q1, q2, log_probs, alpha)
    assert loss.item() == pytest.approx((-0.5 - 1 + 0.5 - 3) / 2)
    loss.backward()
    assert q1.grad.tolist() == [-0.5, 0] and q2.grad.tolist() == [0, -0.5]
    assert log_probs.grad.tolist() == [0.25, 0.25] and alpha.grad is None


def test_temperature_rises_while_the_entropy_is_below_the_target():
    log_alpha, log_probs = torch.tensor(math.log(0.5), requires_grad=True), torch.tensor([2.0, 4.0], requires_grad=True)
    loss = temperature_loss(log_alpha, log_probs, target_entropy=-1.0)  # the entropy is -3
    assert loss.item() == pytest.approx(-0.5 * (3 - 1))
    loss.backward()
    assert log_alpha.grad.item() == pytest.approx(-1.0) and log_probs.grad is None


def test_polyak_moves_in_place_by_a_share_and_makes_no_graph():
    target, online = torch.nn.Linear(2, 3), torch.nn.Linear(2, 3)
    before, places = [p.detach().clone() for p in target.parameters()], [p.data_ptr() for p in target.parameters()]
    polyak_update(target.parameters(), online.parameters(), 0.25)
    for old, new, goal in zip(before, target.parameters(), online.parameters(), strict=True):
        torch.testing.assert_close(new.detach(), 0.75 * old + 0.25 * goal.detach())
    assert [p.data_ptr() for p in target.parameters()] == places and all(p.is_leaf for p in target.parameters())


def test_polyak_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match=r"tau must lie in \[0, 1\], got 2"):
        polyak_update([torch.zeros(2)], [torch.zeros(2)], 2)
    with pytest.raises(ValueError, match="target_params"):
        polyak_update([torch.zeros(2)], [torch.zeros(1)], 0.5)
