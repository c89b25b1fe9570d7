"""The references against hand-sized arrays and identities, so that the answer key does not rest on itself."""

import math

import pytest
import torch

from course_lib.language.verifiable import GroupSettings, Table, verifier
from solutions import ch101


def row(*numbers):
    return torch.tensor(numbers, dtype=torch.float64)


def test_only_the_prompts_own_digits_in_order_are_right():
    assert ch101.verify_sorted(["310=", "310=", "310="], ["013", "13", "0133"]).tolist() == [1, 0, 0]


def test_pass_at_k_by_hand():
    assert ch101.pass_at_k(4, torch.tensor([0, 1, 3]), 2).tolist() == pytest.approx([0, 1 - 3 / 6, 1])


def test_leave_one_out_compares_with_the_others():
    found = ch101.group_advantages(row(1, 0, 0, 1, 1, 1), 3, "leave_one_out", "none")
    assert found.tolist() == pytest.approx([1, -0.5, -0.5, 0, 0, 0])


def test_the_three_means_of_two_answers():
    terms, mask = torch.tensor([[2.0, 9.0], [4.0, 6.0]]), torch.tensor([[True, False], [True, True]])
    found = [ch101.aggregate_loss(terms, mask, how, 4).item() for how in ("tokens", "sequences", "constant")]
    assert found == pytest.approx([12 / 3, (2 + 5) / 2, 12 / 8])


@pytest.mark.parametrize(("estimator", "direction"), [("k1", None), ("k2", "reverse"), ("k3", "forward")])
def test_the_expected_gradient_of_a_term_is_that_of_a_divergence(estimator, direction):
    logits = row(1, 0, -1).requires_grad_(True)
    ref = row(0.2, 0.3, 0.5).log()
    logps = logits.log_softmax(-1)
    terms = ch101.kl_term(logps[None], ref[None], estimator)
    (found,) = torch.autograd.grad((logps.exp().detach() * terms).sum(), logits, retain_graph=True)
    divergences = {"reverse": (logps.exp() * (logps - ref)).sum(), "forward": (ref.exp() * (ref - logps)).sum()}
    right = torch.autograd.grad(divergences[direction], logits)[0] if direction else torch.zeros(3)
    assert found.tolist() == pytest.approx(right.tolist(), abs=1e-12)


def test_the_bounds_silence_one_side_each():
    logps = row(0.5, -0.5)[:, None].requires_grad_(True)
    loss, told = ch101.grpo_loss(logps, torch.zeros(2, 1, dtype=torch.float64), row(1, 1), torch.ones(2, 1, dtype=torch.bool))
    loss.backward()
    assert logps.grad.flatten().tolist() == pytest.approx([0, -math.exp(-0.5) / 2])
    assert (told["clipped_low"].item(), told["clipped_high"].item()) == (0, 0.5)


def test_the_ratio_of_an_answer_is_a_geometric_mean():
    ratio = ch101.sequence_ratio(row(2, 4, 9)[None].log(), row(1, 2, 1)[None].log(), torch.tensor([[True, True, False]]))
    assert ratio.item() == pytest.approx(2)


def test_a_table_learns_to_answer():
    policy, generator = Table(torch.zeros(3, 3, 5), 2.0), torch.Generator().manual_seed(0)
    settings = GroupSettings(group_size=8, new_tokens=4, minibatch=500, max_grad_norm=100.0)
    rewards = [ch101.grpo_iteration(policy, ["0=", "1=", "2="], verifier(), settings, generator)["reward"] for _ in range(60)]
    assert sum(rewards[-5:]) / 5 > 0.6 > 0.2 > rewards[0]


def test_repaired_advantages_keep_a_thousandth_a_thousandth():
    assert ch101.repaired_advantages(row(0.001, 0.003), 2).tolist() == pytest.approx([-0.001, 0.001])
