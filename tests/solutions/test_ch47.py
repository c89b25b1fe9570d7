"""Chapter 47's functions: values by hand, limits, gradients, and the reader's update against the library's."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from course_lib.control import replay, sac
from solutions import ch47
from solutions.ch47 import (
    critic_loss,
    polyak_update,
    repaired_follow,
    sac_actor_loss,
    sac_update,
    soft_q_target,
    soft_value_iteration,
    squashed_gaussian_log_prob,
    temperature_loss,
)

TAUGHT = sac.Taught.of(vars(ch47))
SMALL = sac.SACSettings(batch_size=16, hidden=8, learning_rate=1e-2)


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


def problem(states=5, actions=3, seed=0):
    transitions = torch.randn(states, actions, states, generator=seeded(seed), dtype=torch.float64).softmax(-1)
    return torch.randn(states, actions, generator=seeded(seed + 1), dtype=torch.float64), transitions


def test_soft_values_of_one_state_without_rewards_are_the_wage_of_an_even_choice_for_ever():
    q, values, policy = soft_value_iteration(torch.zeros(1, 4), torch.ones(1, 4, 1), alpha=0.5, gamma=0.9)
    assert values.item() == pytest.approx(0.5 * math.log(4) / 0.1)
    assert policy.tolist() == [[0.25] * 4] and q[0, 0].item() == pytest.approx(0.9 * values.item())


@pytest.mark.parametrize("alpha", [0.05, 1.0, 30.0])
def test_soft_values_solve_the_bellman_equation_of_their_own_policy(alpha):
    rewards, transitions = problem()
    q, values, policy = soft_value_iteration(rewards, transitions, alpha, gamma=0.9, num_sweeps=400)
    torch.testing.assert_close(q, rewards + 0.9 * transitions @ values)
    torch.testing.assert_close(values, (policy * (q - alpha * policy.log())).sum(-1))
    assert (values >= q.amax(-1)).all() and (values <= q.amax(-1) + alpha * math.log(3) + 1e-9).all()


def test_a_cold_problem_is_ordinary_value_iteration_and_is_finite():
    rewards, transitions = problem(seed=3)
    _, values, policy = soft_value_iteration(rewards, transitions, alpha=1e-9, gamma=0.9)
    best = torch.zeros(5, dtype=torch.float64)
    for _ in range(300):
        best = (rewards + 0.9 * transitions @ best).amax(-1)
    torch.testing.assert_close(values, best, atol=1e-6, rtol=0)
    assert policy.amax(-1).tolist() == [1.0] * 5


def test_no_policy_is_worth_more_than_the_soft_one():
    """The soft value of any fixed policy, by a linear equation, lies below."""
    rewards, transitions = problem(seed=7)
    _, values, _ = soft_value_iteration(rewards, transitions, alpha=0.3, gamma=0.8)
    for seed in range(20):
        policy = torch.randn(5, 3, generator=seeded(seed), dtype=torch.float64).softmax(-1)
        earned = (policy * (rewards - 0.3 * policy.log())).sum(-1)
        moved = torch.einsum("sa,sat->st", policy, transitions)
        of_policy = torch.linalg.solve(torch.eye(5, dtype=torch.float64) - 0.8 * moved, earned)
        assert (of_policy < values + 1e-9).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"transitions": torch.ones(3, 5)}, "transitions must be"),
        ({"alpha": 0.0}, "alpha must be above 0"),
        ({"gamma": 1.1}, "gamma must lie in"),
        ({"num_sweeps": 0}, "num_sweeps must be at least 1"),
    ],
)
def test_soft_value_iteration_refuses_what_does_not_fit(changes, message):
    rewards, transitions = problem()
    with pytest.raises(ValueError, match=message):
        soft_value_iteration(**{"rewards": rewards, "transitions": transitions, "alpha": 1.0} | changes)


def test_critic_loss_by_hand_and_its_gradients():
    q1, q2 = torch.tensor([1.0, 2.0], requires_grad=True), torch.tensor([0.0, 4.0], requires_grad=True)
    targets = torch.tensor([2.0, 2.0], requires_grad=True)
    loss = critic_loss(q1, q2, targets)
    assert loss.item() == (1 + 0) / 2 + (4 + 4) / 2
    loss.backward()
    assert q1.grad.tolist() == [-1, 0] and q2.grad.tolist() == [-2, 2] and targets.grad is None
    with pytest.raises(ValueError, match="targets"):
        critic_loss(q1, q2, targets[:, None])


def test_the_update_is_the_librarys_losses_and_parameters():
    mine, theirs = (sac.Agent(4, [-1.0, -2.0], [1.0, 2.0], SMALL, seed=3) for _ in range(2))
    for seed in range(5):
        batch = replay.made_up(16, 4, 2, ended=0.3, seed=seed)
        generator = seeded(seed)
        noises = [torch.randn(16, 2, generator=generator) for _ in range(2)]
        told = sac_update(mine, batch, *noises, SMALL)
        expected = sac.update(theirs, batch, SMALL, TAUGHT, seeded(seed))
        for name in ("critic_loss", "entropy"):
            torch.testing.assert_close(told[name], expected[name], rtol=1e-4, atol=1e-5)
        assert not any(value.requires_grad for value in told.values())
        for here, there in zip(mine.tensors(), theirs.tensors(), strict=True):
            torch.testing.assert_close(here, there, rtol=1e-4, atol=1e-5)


def test_the_updates_losses_are_those_of_its_parts():
    """The actor's loss is that of the critics after their step, at the price from before the update."""
    agent, batch = sac.begun(3, [-1.0], [1.0], SMALL, seed=1), replay.made_up(8, 3, 1, ended=0.5, seed=2)
    noise, alpha = torch.randn(8, 1, generator=seeded(4)), agent.log_alpha.detach().exp()
    mean, log_std = (x.detach() for x in agent.distribution(batch.obs))
    told = sac_update(agent, batch, noise, noise, SMALL)
    u = mean + log_std.exp() * noise
    log_probs = squashed_gaussian_log_prob(mean, log_std, u)
    with torch.no_grad():
        expected = sac_actor_loss(*sac.values(agent.critics, batch.obs, u.tanh()), log_probs, alpha)
    torch.testing.assert_close(told["actor_loss"], expected)
    torch.testing.assert_close(told["entropy"], -log_probs.mean())
    assert told["temperature_loss"].item() == pytest.approx(-(alpha * (log_probs.mean() - 1)).item(), rel=1e-5)


def test_copies_follow_at_two_speeds_in_place():
    target, online = torch.zeros(4, requires_grad=True), torch.tensor([1.0, 2.0, 3.0, 4.0])
    place = target.data_ptr()
    repaired_follow(target, online, torch.tensor([True, False, True, False]), tau=0.5)
    assert target.tolist() == [0.5, 0.5, 1.5, 1.0] and target.data_ptr() == place and target.is_leaf


def test_the_suspects_way_moves_nothing():
    """What the bug lab is about: a mask in brackets makes a copy."""
    target, online, first = torch.zeros(4), torch.ones(4), torch.tensor([True, False, True, False])
    polyak_update([target[first]], [online[first]], 0.5)
    assert target.tolist() == [0, 0, 0, 0]
