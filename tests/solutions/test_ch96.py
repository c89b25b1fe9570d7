"""The references against hand-sized arrays and identities, so that the answer key does not rest on itself."""

import math

import pytest
import torch

from solutions.ch96 import (
    best_of_n,
    best_of_n_kl,
    in_reference_units,
    last_token_scores,
    length_correlation,
    repaired_choices,
    reward_model_loss,
)
from solutions.ch97 import kl_optimal_policy


def row(*numbers, dtype=torch.float64):
    return torch.tensor(numbers, dtype=dtype)


VALUES = row([1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12])


@pytest.mark.parametrize("kind", [torch.bool, torch.int64])
def test_the_last_kept_token_is_found_on_either_side_of_the_padding(kind):
    mask = torch.tensor([[1, 1, 0, 0], [0, 0, 1, 1], [0, 1, 1, 0]]).to(kind)
    assert last_token_scores(VALUES, mask).tolist() == [2, 8, 11]


def test_only_the_last_kept_token_receives_gradient():
    values = VALUES.clone().requires_grad_()
    last_token_scores(values, torch.tensor([[1, 1, 0, 0], [0, 0, 1, 1], [0, 1, 1, 0]])).sum().backward()
    assert values.grad.tolist() == [[0, 1, 0, 0], [0, 0, 0, 1], [0, 0, 1, 0]]


def test_reward_model_loss_by_hand():
    loss = reward_model_loss(row(1, 2), row(0, 3), row(0.5, 0))
    assert loss.item() == pytest.approx((math.log(1 + math.exp(-0.5)) + math.log(1 + math.exp(1))) / 2)


def test_a_model_that_knows_nothing_loses_log_two_and_learns_from_it():
    chosen, rejected = row(3.0, -1.0).requires_grad_(), row(3.0, -1.0).requires_grad_()
    loss = reward_model_loss(chosen, rejected)
    assert loss.item() == pytest.approx(math.log(2), rel=1e-12)
    loss.backward()
    assert chosen.grad.tolist() == [-0.25, -0.25] and rejected.grad.tolist() == [0.25, 0.25]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_hopeless_comparisons_cost_their_gap_and_keep_their_gradient(dtype):
    chosen, rejected = row(-5000.0, dtype=dtype).requires_grad_(), row(5000.0, dtype=dtype).requires_grad_()
    loss = reward_model_loss(chosen, rejected)
    assert loss.item() == 10_000
    loss.backward()
    assert (chosen.grad.item(), rejected.grad.item()) == (-1, 1)


def test_the_loss_does_not_know_where_scores_begin():
    chosen, rejected = torch.randn(2, 20, dtype=torch.float64)
    torch.testing.assert_close(reward_model_loss(chosen + 100, rejected + 100), reward_model_loss(chosen, rejected))


def test_a_margin_receives_no_gradient():
    margin = row(0.5).requires_grad_()
    reward_model_loss(row(1.0).requires_grad_(), row(0.0), margin).backward()
    assert margin.grad is None


def test_reference_units_by_hand():
    converted, kl_coef = in_reference_units(row([5, 9], [-7, -3]), row([1, 3, 5], [-13, -7, -1]), 0.1)
    unit = math.sqrt((4 + 36) / 2)
    torch.testing.assert_close(converted, row([2, 6], [0, 4]) / unit)
    assert kl_coef == pytest.approx(0.1 / unit) and isinstance(kl_coef, float)


def test_the_optimum_is_the_same_policy_in_either_unit():
    ref_probs = torch.randn(3, 7, dtype=torch.float64).softmax(-1)
    scores = 4 * torch.randn(3, 7, dtype=torch.float64) + row([100], [0], [-20])
    drawn = scores.gather(1, ref_probs.multinomial(50, replacement=True))
    converted, kl_coef = in_reference_units(scores, drawn, 0.7)
    optimum = kl_optimal_policy(ref_probs, scores, 0.7)
    torch.testing.assert_close(kl_optimal_policy(ref_probs, converted, kl_coef), optimum)
    assert (kl_optimal_policy(ref_probs, converted, 0.7) - optimum).abs().max() > 0.1


def test_what_comparisons_cannot_fix_changes_no_reference_unit():
    scores, reference = torch.randn(4, 3, dtype=torch.float64), torch.randn(4, 6, dtype=torch.float64)
    of_prompt = 10 * torch.randn(4, 1, dtype=torch.float64)
    before = in_reference_units(scores, reference, 0.05)
    after = in_reference_units(3 * scores + of_prompt, 3 * reference + of_prompt, 3 * 0.05)
    torch.testing.assert_close(after[0], before[0])
    assert after[1] == pytest.approx(before[1])


def test_a_batch_that_is_the_reference_s_own_still_receives_gradient_as_data_does():
    scores = torch.randn(2, 5, dtype=torch.float64, requires_grad=True)
    converted, _ = in_reference_units(scores, scores, 1.0)
    (gradient,) = torch.autograd.grad(converted.sum(), scores)
    torch.testing.assert_close(gradient, torch.full_like(gradient, 1 / scores.var(1).mean().sqrt().item()))


@pytest.mark.parametrize("reference", [row([1], [2]), row([1, 1], [3, 3])])
def test_reference_scores_without_a_deviation_are_refused(reference):
    with pytest.raises(ValueError, match="reference_scores"):
        in_reference_units(row([1, 2], [3, 4]), reference, 0.1)


def test_the_best_of_n_by_hand():
    found = best_of_n(row([1, 5, 3], [-1, -2, -3]))
    assert found.tolist() == [1, 0] and found.dtype == torch.int64


@pytest.mark.parametrize(
    ("n", "expected"), [(1, 0), (2, math.log(2) - 0.5), (4, math.log(4) - 0.75), (100, math.log(100) - 0.99)]
)
def test_the_kl_of_best_of_n_by_hand(n, expected):
    assert best_of_n_kl(n) == pytest.approx(expected) and isinstance(best_of_n_kl(n), float)


def test_the_kl_of_best_of_n_is_that_of_ten_thousand_answers_ranked():
    answers, n = 10_000, 8
    ranks = torch.arange(answers + 1, dtype=torch.float64) / answers
    best = ranks[1:] ** n - ranks[:-1] ** n  # probability that the best of n is the answer of this rank
    assert (best * (best * answers).log()).sum().item() == pytest.approx(best_of_n_kl(n), abs=1e-3)


@pytest.mark.parametrize("n", [0, -1])
def test_no_candidate_is_refused(n):
    with pytest.raises(ValueError, match="n must be at least 1"):
        best_of_n_kl(n)


def test_length_correlation_by_hand():
    assert length_correlation(row(1, 2, 3), torch.tensor([10, 20, 30])).item() == pytest.approx(1)
    assert length_correlation(row(3, 1, 2), torch.tensor([1, 3, 2])).item() == pytest.approx(-1)
    assert length_correlation(row(1, 2, 1), torch.tensor([1, 2, 3])).item() == pytest.approx(0, abs=1e-12)


def test_length_correlation_knows_neither_units_nor_origin():
    scores, lengths = torch.randn(30, dtype=torch.float64), torch.randint(5, 50, (30,))
    torch.testing.assert_close(length_correlation(7 * scores - 3, lengths * 2 + 5), length_correlation(scores, lengths))


def test_ties_are_left_out_and_the_rest_keeps_its_order():
    chosen, rejected = repaired_choices(
        torch.tensor([10, 11, 12, 13]), torch.tensor([20, 21, 22, 23]), torch.tensor([1, 0, -1, 1]), torch.tensor([0, 0, 1, -1])
    )
    assert chosen.tolist() == [10, 22, 13] and rejected.tolist() == [20, 12, 23]


def test_nothing_but_ties_leaves_nothing():
    same = torch.tensor([1, 1])
    chosen, rejected = repaired_choices(torch.tensor([3, 4]), torch.tensor([5, 6]), same, same)
    assert chosen.shape == rejected.shape == (0,) and chosen.dtype == torch.int64
