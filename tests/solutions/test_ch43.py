"""The references against hand-sized arrays and identities, so that the answer key does not rest on itself."""

import math

import pytest
import torch

from solutions.ch43 import (
    approx_kl,
    clip_fraction,
    clipped_surrogate_loss,
    importance_ratio,
    repaired_losses,
    surrogate_loss,
)

INF = math.inf


def row(*numbers, dtype=torch.float64):
    return torch.tensor(numbers, dtype=dtype)


def with_ratios(*ratios):
    """Log-probabilities that give these ratios against OLD, ready for gradient."""
    return (OLD[: len(ratios)] + row(*ratios).log()).requires_grad_()


OLD = row(-1, -2, -3, -700)
RATIOS = (2, 0.5, 2, 0.5)
ADVANTAGES = row(1, 10, -100, -1000)


def test_ratio_by_hand():
    assert importance_ratio(with_ratios(*RATIOS), OLD).tolist() == pytest.approx(RATIOS)


def test_ratio_of_actions_whose_probabilities_underflow():
    assert importance_ratio(row(-1000), row(-1001)).item() == pytest.approx(math.e)


def test_surrogate_by_hand():
    expected = -(2 * 1 + 0.5 * 10 - 2 * 100 - 0.5 * 1000) / 4
    assert surrogate_loss(with_ratios(*RATIOS), OLD, ADVANTAGES).item() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("clip_range", "factors"),
    [
        (0, (1, 0.5, 2, 1)),
        (0.2, (1.2, 0.5, 2, 0.8)),
        (0.75, (1.75, 0.5, 2, 0.5)),
        (INF, RATIOS),
    ],
)
def test_clip_holds_what_went_too_far_in_the_advantages_direction_and_nothing_else(clip_range, factors):
    expected = -sum(factor * advantage for factor, advantage in zip(factors, ADVANTAGES.tolist(), strict=True)) / 4
    assert clipped_surrogate_loss(with_ratios(*RATIOS), OLD, ADVANTAGES, clip_range).item() == pytest.approx(expected)


def test_a_sample_past_the_bound_has_no_gradient_and_one_past_the_wrong_side_keeps_it():
    log_probs = with_ratios(*RATIOS)
    (gradient,) = torch.autograd.grad(clipped_surrogate_loss(log_probs, OLD, ADVANTAGES), log_probs)
    # of -ρ A / 4 with respect to log ρ: -ρ A / 4 again
    assert gradient.tolist() == pytest.approx([0, -0.5 * 10 / 4, 2 * 100 / 4, 0])


@pytest.mark.parametrize("clip_range", [0.05, 0.2, INF])
def test_where_nothing_has_changed_the_gradient_is_the_policy_gradient(clip_range):
    log_probs = OLD.clone().requires_grad_()
    loss = clipped_surrogate_loss(log_probs, OLD, ADVANTAGES, clip_range)
    assert loss == -ADVANTAGES.mean()
    assert torch.autograd.grad(loss, log_probs)[0].tolist() == (-ADVANTAGES / 4).tolist()


def test_a_zero_range_stops_a_sample_at_its_first_step_forward():
    log_probs = with_ratios(1.01, 0.99)
    (gradient,) = torch.autograd.grad(clipped_surrogate_loss(log_probs, OLD[:2], row(1, 1), 0), log_probs)
    assert gradient.tolist() == pytest.approx([0, -0.99 / 2])


def test_an_infinite_range_is_no_clipping_even_where_the_advantage_is_zero():
    log_probs, advantages = with_ratios(*RATIOS), row(0, 1, -1, 0)
    clipped, plain = clipped_surrogate_loss(log_probs, OLD, advantages, INF), surrogate_loss(log_probs, OLD, advantages)
    assert clipped == plain
    assert torch.equal(*(torch.autograd.grad(loss, log_probs)[0] for loss in (clipped, plain)))


def test_the_clipped_loss_is_never_below_the_plain_one():
    generator = torch.Generator().manual_seed(0)
    for _ in range(100):
        new, old, advantages = torch.randn(3, 8, generator=generator, dtype=torch.float64)
        assert clipped_surrogate_loss(new, old, advantages) >= surrogate_loss(new, old, advantages)


def test_approx_kl_by_hand():
    assert approx_kl(with_ratios(2, 0.5), OLD[:2]).item() == pytest.approx((1 - math.log(2) - 0.5 + math.log(2)) / 2)
    assert approx_kl(OLD, OLD) == 0
    assert approx_kl(row(-1 + 1e-9), row(-1)).item() == pytest.approx(5e-19, rel=1e-3)  # where exp(x) - 1 - x gives 0 or noise


def test_approx_kl_weighted_by_the_acting_policy_is_the_divergence_from_it():
    old, new = row(0.5, 0.3, 0.2), row(0.2, 0.2, 0.6)
    estimates = torch.stack([approx_kl(new.log()[[action]], old.log()[[action]]) for action in range(3)])
    assert (old * estimates).sum().item() == pytest.approx((old * (old / new).log()).sum().item())


@pytest.mark.parametrize(("clip_range", "expected"), [(0, 1), (0.2, 0.75), (0.4, 0.5), (0.6, 0.25), (3, 0), (INF, 0)])
def test_clip_fraction_counts_both_sides(clip_range, expected):
    assert clip_fraction(with_ratios(2, 0.5, 0.7, 1.1), OLD, clip_range) == expected


def test_repaired_losses_compare_every_epoch_with_the_policy_that_acted():
    log_probs = torch.stack([OLD, with_ratios(1.1, 0.9, 1.1, 0.9), with_ratios(*RATIOS)]).detach()
    losses = repaired_losses(log_probs, ADVANTAGES)
    assert losses.tolist() == pytest.approx(
        [
            -(1 + 10 - 100 - 1000) / 4,
            -(1.1 + 9 - 110 - 900) / 4,
            -(1.2 + 5 - 200 - 800) / 4,
        ]
    )


def test_repaired_losses_reach_each_row_through_its_own_epoch_only():
    log_probs = torch.stack([OLD, with_ratios(*RATIOS)]).detach().requires_grad_()
    losses = repaired_losses(log_probs, ADVANTAGES)
    first = torch.autograd.grad(losses[0], log_probs, retain_graph=True)[0]
    second = torch.autograd.grad(losses[1], log_probs)[0]
    assert first[0].tolist() == (-ADVANTAGES / 4).tolist() and not first[1].any()
    assert second[1].tolist() == pytest.approx([0, -1.25, 50, 0]) and not second[0].any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradient_reaches_log_probs_only_and_the_dtype_is_kept(dtype):
    new, old, advantages = (x.detach().to(dtype).requires_grad_() for x in (with_ratios(*RATIOS), OLD, ADVANTAGES))
    for loss in (surrogate_loss(new, old, advantages), clipped_surrogate_loss(new, old, advantages)):
        reached = torch.autograd.grad(loss, [new, old, advantages], allow_unused=True)
        assert [gradient is not None for gradient in reached] == [True, False, False]
        assert loss.dtype == dtype and loss.shape == ()
    for metric in (approx_kl(new, old), clip_fraction(new, old)):
        assert metric.dtype == dtype and metric.shape == () and not metric.requires_grad
    losses = repaired_losses(torch.stack([old, new]), advantages)
    assert losses.dtype == dtype and torch.autograd.grad(losses.sum(), advantages, allow_unused=True) == (None,)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"clip_range": -0.1}, "clip_range must be at least 0, got -0.1"),
        ({"clip_range": math.nan}, "clip_range must be at least 0, got nan"),
        ({"old_log_probs": OLD[:, None]}, r"old_log_probs.*\(4, 1\)"),
        ({"advantages": ADVANTAGES[:3]}, r"advantages.*\(3,\)"),
    ],
)
def test_errors_name_the_argument_and_the_value_received(changes, message):
    arguments = {"log_probs": OLD, "old_log_probs": OLD, "advantages": ADVANTAGES} | changes
    with pytest.raises(ValueError, match=message):
        clipped_surrogate_loss(**arguments)


def test_all_functions_refuse_bad_input():
    column = OLD[:, None]
    for call in (
        lambda: importance_ratio(OLD, column),
        lambda: surrogate_loss(OLD, OLD, column),
        lambda: approx_kl(OLD, column),
        lambda: clip_fraction(OLD, column),
        lambda: clip_fraction(OLD, OLD, -1),
        lambda: repaired_losses(torch.stack([OLD, OLD]), column),
        lambda: repaired_losses(torch.stack([OLD, OLD]), ADVANTAGES[:1]),
        lambda: repaired_losses(torch.stack([OLD, OLD]), ADVANTAGES, -1),
    ):
        with pytest.raises(ValueError, match=r"log_probs|advantages|clip_range"):
            call()
