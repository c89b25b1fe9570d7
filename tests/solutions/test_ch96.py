"""The references against hand-sized arrays and identities, so that the answer key does not rest on itself."""

import math

import pytest
import torch

from solutions.ch96 import best_of_n, best_of_n_kl, last_token_scores, length_correlation, repaired_choices, reward_model_loss


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
