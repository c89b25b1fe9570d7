"""The references against hand-sized arrays and identities, so that the answer key does not rest on itself."""

import math

import pytest
import torch

from course_lib.language import direct, lm, tables
from solutions.ch97 import dpo_epoch, dpo_loss, ipo_loss, kl_optimal_policy, repaired_completion_mask, sequence_logps


def row(*numbers, dtype=torch.float64):
    return torch.tensor(numbers, dtype=dtype)


NAMES = ("chosen_logps", "rejected_logps", "ref_chosen_logps", "ref_rejected_logps")

# ------------------------------------------------------------------------------------------------------ sequence_logps


def test_log_probabilities_are_summed_over_the_completion_only():
    probabilities = torch.tensor([[[0.5, 0.5], [0.2, 0.8], [0.9, 0.1], [0.3, 0.7]]], dtype=torch.float64)
    input_ids = torch.tensor([[0, 1, 1, 0]])
    mask = torch.tensor([[False, False, True, True]])
    # position 1 predicts token 1 at column 2, position 2 token 0 at column 3
    assert sequence_logps(probabilities.log() + 7, input_ids, mask).item() == pytest.approx(math.log(0.8) + math.log(0.9))


def test_the_first_column_never_counts():
    logits, input_ids = torch.randn(2, 5, 4), torch.randint(4, (2, 5))
    all_kept = torch.ones(2, 5, dtype=torch.bool)
    without_first = all_kept.clone()
    without_first[:, 0] = False
    assert torch.equal(sequence_logps(logits, input_ids, all_kept), sequence_logps(logits, input_ids, without_first))


def test_probabilities_of_all_texts_of_two_tokens_sum_to_one():
    first, second = torch.randn(3, dtype=torch.float64), torch.randn(3, 3, dtype=torch.float64)
    texts = torch.cartesian_prod(torch.arange(3), torch.arange(3))  # (9, 2)
    input_ids = torch.cat([torch.zeros(9, 1, dtype=torch.long), texts], dim=1)
    logits = torch.stack([first.expand(9, 3), second[texts[:, 0]], torch.zeros(9, 3)], dim=1)
    mask = torch.tensor([False, True, True]).expand(9, 3)
    assert sequence_logps(logits, input_ids, mask).exp().sum().item() == pytest.approx(1)


def test_only_logits_that_predict_kept_tokens_receive_gradient():
    logits = torch.randn(1, 5, 4, requires_grad=True)
    mask = torch.tensor([[False, False, True, True, False]])
    sequence_logps(logits, torch.zeros(1, 5, dtype=torch.long), mask).sum().backward()
    assert (logits.grad[0] != 0).any(1).tolist() == [False, True, True, False, False]


# ------------------------------------------------------------------------------------------------------------ dpo_loss


def test_dpo_by_hand():
    losses, chosen, rejected = dpo_loss(row(-10), row(-20), row(-12), row(-21), beta=0.5)
    x = 0.5 * ((-10 + 12) - (-20 + 21))
    assert losses.tolist() == pytest.approx([math.log(1 + math.exp(-x))])
    assert (chosen.item(), rejected.item()) == pytest.approx((1.0, 0.5))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("smoothing", [0.0, 0.3])
def test_where_policy_and_reference_agree_the_loss_is_log_two_exactly(dtype, smoothing):
    logps = row(-3, -40.5, -1000, dtype=dtype), row(-7, -0.25, -2000, dtype=dtype)
    losses, chosen, rejected = dpo_loss(*logps, *logps, label_smoothing=smoothing)
    torch.testing.assert_close(losses, torch.full_like(losses, math.log(2)), rtol=1e-7, atol=0)
    assert not chosen.any() and not rejected.any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gaps_of_ten_thousand_give_finite_losses_with_the_right_gradients(dtype):
    chosen, rejected = row(0, -10_000, dtype=dtype).requires_grad_(), row(-10_000, 0, dtype=dtype).requires_grad_()
    losses, _, _ = dpo_loss(chosen, rejected, row(0, 0, dtype=dtype), row(0, 0, dtype=dtype), beta=0.1)
    assert losses.tolist() == [0, 1000]
    losses.sum().backward()
    torch.testing.assert_close(chosen.grad, row(0, -0.1, dtype=dtype))
    torch.testing.assert_close(rejected.grad, row(0, 0.1, dtype=dtype))


def test_at_a_gap_of_zero_the_gradient_is_half_of_beta():
    logps = [row(-3.0).requires_grad_() for _ in range(4)]
    dpo_loss(*logps, beta=0.4)[0].sum().backward()
    assert [value.grad.item() if value.grad is not None else None for value in logps] == pytest.approx([-0.2, 0.2, None, None])


def test_smoothing_makes_the_best_margin_finite():
    smoothing, beta = 0.2, 0.1
    best = math.log((1 - smoothing) / smoothing) / beta  # where the labels' odds are met
    chosen = row(best).requires_grad_()
    dpo_loss(chosen, row(0), row(0), row(0), beta, smoothing)[0].sum().backward()
    assert chosen.grad.item() == pytest.approx(0, abs=1e-12)


def test_the_implicit_rewards_carry_no_graph():
    logps = [row(-3.0).requires_grad_() for _ in range(4)]
    losses, chosen, rejected = dpo_loss(*logps)
    assert losses.requires_grad and not chosen.requires_grad and not rejected.requires_grad


def test_a_larger_beta_reaches_the_same_loss_with_a_smaller_departure():
    zero = row(0)
    far, near = (dpo_loss(row(departure), zero, zero, zero, beta)[0] for departure, beta in ((10.0, 0.1), (2.0, 0.5)))
    torch.testing.assert_close(far, near)


@pytest.mark.parametrize("settings", [{"beta": 0}, {"beta": -1}, {"label_smoothing": 0.5}, {"label_smoothing": -0.01}])
def test_impossible_settings_are_refused_by_name(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        dpo_loss(*[row(-1.0)] * 4, **settings)


# ------------------------------------------------------------------------------------------------------------ ipo_loss


def test_ipo_by_hand():
    assert ipo_loss(row(-10), row(-20), row(-12), row(-21), beta=0.25).tolist() == pytest.approx([(2 - 1 - 2) ** 2])


def test_ipo_is_satisfied_at_its_target_and_pulls_back_beyond_it():
    beta, zero = 0.1, row(0)
    margins = row(4, 5, 6).requires_grad_()
    losses = ipo_loss(margins, *[zero.expand(3)] * 3, beta)
    assert losses.tolist() == pytest.approx([1, 0, 1])
    losses.sum().backward()
    assert margins.grad.tolist() == pytest.approx([-2, 0, 2])


# --------------------------------------------------------------------------------------------------- kl_optimal_policy


def test_the_optimum_by_hand():
    found = kl_optimal_policy(row(0.5, 0.25, 0.25), row(0, math.log(2), math.log(4)), beta=1)
    assert found.tolist() == pytest.approx([0.25, 0.25, 0.5])


def test_no_other_policy_has_a_higher_penalised_reward():
    generator = torch.Generator().manual_seed(0)
    reference = torch.randn(6, generator=generator, dtype=torch.float64).softmax(0)
    rewards, beta = torch.randn(6, generator=generator, dtype=torch.float64), 0.3

    def objective(policy):
        return (policy * (rewards - beta * (policy / reference).log())).sum(-1)

    best = objective(kl_optimal_policy(reference, rewards, beta))
    others = torch.randn(10_000, 6, generator=generator, dtype=torch.float64).mul(3).softmax(-1)
    assert (objective(others) <= best).all()
    assert best.item() == pytest.approx(beta * math.log((reference * (rewards / beta).exp()).sum().item()))  # β log Z


def test_gradient_ascent_ends_at_the_optimum():
    reference, rewards, beta = row(0.6, 0.3, 0.1), row(0.0, 1.0, 3.0), 0.8
    logits = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([logits], lr=0.05)
    for _ in range(1500):
        policy = logits.softmax(0)
        loss = -(policy * (rewards - beta * (policy / reference).log())).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    torch.testing.assert_close(logits.softmax(0).detach(), kl_optimal_policy(reference, rewards, beta), rtol=0, atol=1e-4)


def test_rewards_recovered_from_the_optimum_differ_by_a_constant_only():
    reference, rewards, beta = row(0.6, 0.3, 0.1), row(0.2, -1.0, 2.0), 0.5
    implicit = beta * (kl_optimal_policy(reference, rewards, beta) / reference).log()
    torch.testing.assert_close(implicit - rewards, (implicit - rewards)[:1].expand(3))


def test_huge_rewards_stay_probabilities_and_impossible_answers_stay_impossible():
    found = kl_optimal_policy(row(0.5, 0.5, 0.0), row(10_000, -10_000, 1e6), beta=0.01)
    assert found.tolist() == [1, 0, 0]


# ----------------------------------------------------------------------------------------------------------- dpo_epoch


def two_words(*pairs):
    """Pairs of texts of one given and one written token."""
    input_ids = torch.tensor([[[0, chosen], [0, rejected]] for chosen, rejected in pairs])
    own = torch.ones_like(input_ids, dtype=torch.bool)
    return direct.Pairs(input_ids, own, own & torch.tensor([False, True]))


def test_an_epoch_makes_the_chosen_likelier_and_leaves_the_reference_alone():
    policy, reference = (tables.Bigrams(torch.zeros(4, 4, dtype=torch.float64)) for _ in range(2))
    log = dpo_epoch(policy, reference, two_words((1, 2), (1, 3)), [torch.tensor([0]), torch.tensor([1])] * 5, 1.0, 0.1)
    probabilities = policy.table[0].softmax(-1)
    assert probabilities[1] > 0.25 > probabilities[2] and not reference.table.any()
    assert log["loss"][0].item() == pytest.approx(math.log(2)) and log["loss"][-1] < log["loss"][1]
    assert log["accuracy"].tolist() == [0, 1, *[1] * 8]
    assert (log["chosen_rewards"][1:] > 0).all() and not any(column.requires_grad for column in log.values())


def test_an_epoch_on_a_language_model_makes_the_steps_of_the_library():
    policy = lm.load("tiny")
    reference, other = policy.frozen_copy(), lm.load("tiny")
    pairs = direct.encode_pairs(policy, [" a fine film", " good", " so funny"], [" bad", " a dull, long film", " so sad"])
    batches = [torch.tensor([0, 2]), torch.tensor([1])]
    log = dpo_epoch(policy, reference, pairs, batches)
    ref_logps = direct.reference_logps(reference, pairs, sequence_logps)
    optimizer = torch.optim.AdamW(other.parameters(), lr=2e-4, weight_decay=0.0)
    rows = [direct.train_step(other, optimizer, pairs.of(rows), ref_logps[rows], dpo_loss, sequence_logps) for rows in batches]
    assert log["loss"].tolist() == pytest.approx([row["loss"] for row in rows], rel=1e-3)
    assert log["chosen_rewards"].tolist() == pytest.approx([0.1 * row["chosen_moved"] for row in rows], abs=1e-3)


def test_an_epoch_without_a_price_is_refused():
    policy = tables.Bigrams(torch.zeros(3, 3))
    with pytest.raises(ValueError, match="beta must be above 0, got 0"):
        dpo_epoch(policy, policy, two_words((1, 2)), [torch.tensor([0])], beta=0)


# -------------------------------------------------------------------------------------------- repaired_completion_mask


def test_the_end_of_a_text_counts_and_what_stands_behind_it_does_not():
    kept = torch.tensor([[1, 1, 1, 1, 0, 0], [1, 1, 1, 1, 1, 1]]).bool()
    assert repaired_completion_mask(kept, torch.tensor([1, 2])).int().tolist() == [[0, 1, 1, 1, 0, 0], [0, 0, 1, 1, 1, 1]]


def test_the_side_of_the_padding_changes_no_log_probability():
    generator = torch.Generator().manual_seed(0)
    logits, ids = torch.randn(1, 4, 6, generator=generator), torch.tensor([[5, 2, 3, 5]])
    junk, pad = torch.randn(1, 2, 6, generator=generator), torch.tensor([[5, 5]])
    own, none = torch.ones(1, 4, dtype=torch.bool), torch.zeros(1, 2, dtype=torch.bool)
    sums = [
        sequence_logps(
            torch.cat(parts[0], 1), torch.cat(parts[1], 1), repaired_completion_mask(torch.cat(parts[2], 1), torch.tensor([1]))
        )
        for parts in (
            ([logits], [ids], [own]),
            ([logits, junk], [ids, pad], [own, none]),
            ([junk, logits], [pad, ids], [none, own]),
        )
    ]
    torch.testing.assert_close(torch.stack(sums), sums[0].expand(3, 1))
