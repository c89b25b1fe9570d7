"""The references against hand-sized arrays and identities, so that the answer key does not rest on itself."""

import math

import pytest
import torch

from course_lib.control.clips import QuadraticReward, Segments, WatchedScorer
from solutions.ch80 import (
    bradley_terry_loss,
    fit_reward_model,
    preference_accuracy,
    preference_probability,
    repaired_segment_returns,
    segment_returns,
    simulate_preferences,
    standardize_rewards,
)

REWARDS = torch.tensor([[1.0, 2, 4, 8], [3, 5, 100, 100], [7, 100, 100, 100]], dtype=torch.float64)
MASK = torch.tensor([[True, True, True, True], [True, True, False, False], [False, False, False, False]])


def row(*numbers, dtype=torch.float64):
    return torch.tensor(numbers, dtype=dtype)


def test_returns_are_sums_over_own_steps():
    assert segment_returns(REWARDS, MASK).tolist() == [15, 8, 0]


def test_gradient_of_returns_reaches_own_steps_only():
    rewards = REWARDS.clone().requires_grad_()
    segment_returns(rewards, MASK).sum().backward()
    assert torch.equal(rewards.grad, MASK.double())


def test_padding_that_is_infinite_does_no_harm():
    assert segment_returns(REWARDS.masked_fill(~MASK, math.inf), MASK).tolist() == [15, 8, 0]


def test_probability_by_hand():
    gaps = row(0, math.log(3), -math.log(9), 1000, -1000)
    assert preference_probability(gaps, torch.zeros(5, dtype=torch.float64)).tolist() == pytest.approx([0.5, 0.75, 0.1, 1, 0])


def test_probability_of_either_answer_adds_to_one_and_the_level_does_not_count():
    generator = torch.Generator().manual_seed(0)
    a, b = 3 * torch.randn(2, 50, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(preference_probability(a, b) + preference_probability(b, a), torch.ones_like(a))
    torch.testing.assert_close(preference_probability(a + 700, b + 700), preference_probability(a, b))


@pytest.mark.parametrize("temperature", [0.5, 1.0, 4.0])
def test_simulated_answers_come_as_often_as_the_model_says(temperature):
    a, b = torch.full((20_000,), 1.5), torch.full((20_000,), 0.5)
    answers = simulate_preferences(a, b, temperature, torch.Generator().manual_seed(0))
    assert answers.dtype == torch.bool and answers.shape == (20_000,)
    assert answers.float().mean().item() == pytest.approx(1 / (1 + math.exp(-1 / temperature)), abs=0.015)


def test_the_generator_decides_the_answers_and_goes_on():
    a, b = torch.zeros(100), torch.zeros(100)
    generators = [torch.Generator().manual_seed(3) for _ in range(2)]
    first, again = (simulate_preferences(a, b, 1.0, generator) for generator in generators)
    assert torch.equal(first, again)
    assert not torch.equal(first, simulate_preferences(a, b, 1.0, generators[0]))


def test_loss_by_hand():
    chosen, rejected = row(1, 0, 5), row(1, math.log(3), 5 - math.log(3))
    assert bradley_terry_loss(chosen, rejected).item() == pytest.approx((math.log(2) + math.log(4) + math.log(4 / 3)) / 3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("gap", "loss", "slope"), [(-1000, 1000, -1), (0, math.log(2), -0.5), (1000, 0, 0)])
def test_loss_and_gradient_at_both_ends_and_in_the_middle(gap, loss, slope, dtype):
    chosen, rejected = row(gap, dtype=dtype).requires_grad_(), row(0, dtype=dtype).requires_grad_()
    value = bradley_terry_loss(chosen, rejected)
    value.backward()
    assert value.item() == pytest.approx(loss) and value.dtype == dtype and value.shape == ()
    assert (chosen.grad.item(), rejected.grad.item()) == pytest.approx((slope, -slope))


def test_loss_of_a_linear_reward_is_convex():
    features = torch.randn(40, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def loss(weights):
        return bradley_terry_loss(features @ weights, torch.zeros(40, dtype=torch.float64))

    for seed in range(5):
        weights = 2 * torch.randn(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        assert torch.linalg.eigvalsh(torch.autograd.functional.hessian(loss, weights)).min() > 0


def test_accuracy_counts_choices():
    assert preference_accuracy(row(1, 2, -3, 4), row(0, 5, -4, 3)) == 0.75
    assert not preference_accuracy(row(1.0).requires_grad_(), row(0)).requires_grad


def test_standardised_rewards_have_mean_0_and_deviation_1_over_kept_steps():
    result = standardize_rewards(REWARDS, MASK)
    assert result[MASK].mean().item() == pytest.approx(0) and result[MASK].std().item() == pytest.approx(1)
    assert not result[~MASK].any()


def test_equal_rewards_become_zero():
    assert not standardize_rewards(torch.full((2, 3), 4.0), MASK[:2, :3]).any()


def clip_pairs(first, gaps):
    """Pairs of clips of one step whose returns differ by these gaps under a weight of 1."""
    sides = []
    for side, way in enumerate((0.5, -0.5)):
        numbers = (first + side + 2.0 * torch.arange(len(gaps))).reshape(-1, 1, 1)
        obs = (way * row(*gaps)).reshape(-1, 1, 1)
        sides.append(Segments(obs, numbers, torch.zeros(len(gaps), 1), torch.ones(len(gaps), 1, dtype=torch.bool)))
    return sides


def fitted(held_out_gaps, epochs=40, pairs=6):
    scorer, generator = WatchedScorer(row(0.0)), torch.Generator().manual_seed(0)
    training, held_out = clip_pairs(0, [1.0] * pairs), clip_pairs(100, held_out_gaps)
    losses = fit_reward_model(scorer, training, held_out, epochs, 4, 0.05, generator)
    return scorer, losses


def test_a_fitted_reward_stops_at_the_log_odds_of_the_held_out_answers():
    scorer, losses = fitted([1.0, 1.0, 1.0, -1.0])
    assert scorer.weights.item() == pytest.approx(math.log(3), abs=0.06)
    assert losses[0].item() == pytest.approx(math.log(2)) and losses.min() < losses[-1]
    assert not losses.requires_grad and len(losses) == 41


def test_a_reward_that_training_only_harms_stays_as_it_came():
    scorer, losses = fitted([-1.0], epochs=3)
    assert scorer.weights.item() == 0 and losses.argmin() == 0


def test_every_pair_is_learned_from_once_an_epoch_and_no_held_out_one():
    scorer, _ = fitted([1.0], epochs=3)
    assert scorer.diary[:, 0].bincount().tolist() == [3] * 12
    assert scorer.diary[:, 1].unique().tolist() == list(range(6))


def test_repaired_returns_do_not_depend_on_the_padding():
    model = QuadraticReward(row(1, -1), row(2, 0), row(5))
    obs = torch.randn(3, 4, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    returns = repaired_segment_returns(model, obs, MASK)
    assert returns[1].item() == pytest.approx(sum((o[0] - o[1] + 2 * o[0] ** 2 + 5).item() for o in obs[1, :2]))
    assert returns[2] == 0
    assert torch.equal(returns, repaired_segment_returns(model, obs.masked_fill(~MASK[..., None], 9.0), MASK))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: segment_returns(REWARDS, MASK[:1]), r"mask \(1, 4\)"),
        (lambda: preference_probability(REWARDS[0], REWARDS[0][:, None]), r"returns_b \(4, 1\)"),
        (lambda: simulate_preferences(row(1), row(0), 0, torch.Generator()), "temperature must be above 0, got 0"),
        (lambda: simulate_preferences(row(1), row(0, 1), 1, torch.Generator()), r"true_returns_b \(2,\)"),
        (lambda: bradley_terry_loss(row(1, 2), row(1)), r"rejected_returns \(1,\)"),
        (lambda: preference_accuracy(row(1, 2), row(1)), r"rejected_returns \(1,\)"),
        (lambda: standardize_rewards(REWARDS, MASK[:, :1]), r"mask \(3, 1\)"),
        (lambda: fitted([1.0], epochs=0), "num_epochs must be at least 1, got 0"),
        (lambda: repaired_segment_returns(lambda obs: obs[..., 0], torch.zeros(3, 4, 2), MASK[:1]), r"mask \(1, 4\)"),
    ],
)
def test_errors_name_the_argument_and_the_shape_received(call, message):
    with pytest.raises(ValueError, match=message):
        call()
