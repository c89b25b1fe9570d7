"""What the variants of DPO are compared in is what their names say."""

import math

import pytest
import torch

from course_lib.language import lm
from course_lib.language.direct import encode_pairs
from experiments import direct, rlhf


@pytest.fixture(scope="module")
def pairs():
    return encode_pairs(
        lm.load("tiny"), ["A fine film.", "Funny, wise and warm from its first scene to its last."], ["Dull.", "No."]
    )


def test_only_the_suspect_counts_padding(pairs):
    (healthy,), (suspect,) = (direct.batches(pairs, 2, padding_counts) for padding_counts in (False, True))
    assert torch.equal(healthy.completion_mask[..., 1:], healthy.attention_mask[..., 1:])
    assert suspect.completion_mask[..., 1:].all() and not suspect.attention_mask.all()
    assert not healthy.completion_mask[..., 0].any() and not suspect.completion_mask[..., 0].any()


def test_an_unfrozen_reference_shows_no_progress_and_never_stops_pulling():
    chosen, rejected = torch.tensor([-3.0]).requires_grad_(), torch.tensor([-50.0]).requires_grad_()
    losses, chosen_rewards, _ = direct.unfrozen(beta=0.2)(chosen, rejected, torch.tensor([-40.0]), torch.tensor([-40.0]))
    losses.sum().backward()
    assert losses.item() == pytest.approx(math.log(2)) and chosen_rewards.item() == 0
    assert (chosen.grad.item(), rejected.grad.item()) == pytest.approx((-0.1, 0.1))


def test_dpo_learns_from_comparisons_that_the_reward_model_has_too():
    some, everything = direct.comparisons(20, seed=3), direct.preferences.comparisons(rlhf.COMPARISONS, seed=3)
    assert some.chosen_texts == everything.chosen_texts[:20] and some.rejected_texts == everything.rejected_texts[:20]
    assert len(some) == len(some.gap) == 20
