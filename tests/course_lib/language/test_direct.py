"""What the fast step of direct preference optimisation leaves out changes no number."""

import copy
import functools

import pytest
import torch

from course_lib.language import lm
from course_lib.language.direct import completion_logps, encode_pairs, like_lengths, reference_logps, train_step
from solutions.ch97 import dpo_loss, sequence_logps

PROMPTS = ["The film", "It is", "A film that"]
CHOSEN = [" is a triumph from the first scene to the last", " fun", " never bores"]
REJECTED = [" is dull", " a mess of a thriller without a single thrill", " ends"]


@pytest.fixture(scope="module")
def model():
    return lm.load("tiny")


@pytest.fixture(scope="module")
def pairs(model):
    return encode_pairs(model, CHOSEN, REJECTED, PROMPTS)


def test_completions_are_what_follows_the_prompts_with_the_end_token(model, pairs):
    kept = [model.decode(*both) for both in zip(pairs.input_ids, pairs.completion_mask, strict=True)]
    assert kept == [[chosen, rejected] for chosen, rejected in zip(CHOSEN, REJECTED, strict=True)]
    last = pairs.attention_mask.sum(-1, keepdim=True) - 1
    assert (pairs.input_ids.gather(-1, last) == model.end_id).all() and pairs.completion_mask.gather(-1, last).all()


def test_without_prompts_all_but_the_first_token_is_compared(model):
    pairs = encode_pairs(model, CHOSEN, REJECTED)
    assert torch.equal(pairs.completion_mask[..., 1:], pairs.attention_mask[..., 1:])
    assert not pairs.completion_mask[..., 0].any()


def test_a_completion_that_changes_its_prompt_s_tokens_is_refused(model):
    with pytest.raises(ValueError, match="begin completions with a space"):
        encode_pairs(model, ["m"], [" film"], ["The fil"])


def test_log_probabilities_are_those_of_every_text_alone_with_all_logits(model, pairs):
    found = completion_logps(model, pairs, sequence_logps)
    for pair in range(len(CHOSEN)):
        for side in range(2):
            kept = pairs.attention_mask[pair, side]
            input_ids, mask = (part[pair, side][kept][None] for part in (pairs.input_ids, pairs.completion_mask))
            alone = sequence_logps(model.logits(input_ids, torch.ones_like(mask)), input_ids, mask)
            torch.testing.assert_close(found[pair, side], alone[0], rtol=1e-5, atol=1e-4)


def test_even_a_mask_that_counts_padding_gives_what_all_logits_would(model, pairs):
    everything = torch.ones_like(pairs.completion_mask)
    everything[..., 0] = False
    wrong = pairs._replace(completion_mask=everything)
    flat = [part.flatten(0, 1) for part in wrong]
    expected = sequence_logps(model.logits(*flat[:2]), flat[0], flat[2]).unflatten(0, (-1, 2))
    torch.testing.assert_close(completion_logps(model, wrong, sequence_logps), expected, rtol=1e-5, atol=1e-4)


def test_the_reference_answers_in_the_order_of_the_pairs(model, pairs):
    expected = completion_logps(model, pairs, sequence_logps)
    torch.testing.assert_close(reference_logps(model, pairs, sequence_logps, batch=2), expected.detach(), rtol=1e-5, atol=1e-4)


def test_batches_hold_every_pair_once_and_little_padding(model):
    words = torch.randint(1, 30, (50,), generator=torch.Generator().manual_seed(0)).tolist()
    pairs = encode_pairs(model, [" film" * count for count in words], [" it"] * 50)
    batches = list(like_lengths(pairs, 8, torch.Generator().manual_seed(1)))
    assert sorted(torch.cat(batches).tolist()) == list(range(50))
    lengths = pairs.attention_mask.sum(-1).amax(-1)
    assert sum(lengths[rows].max() * len(rows) for rows in batches) < 1.15 * lengths.sum()
    assert all(pairs.of(rows).input_ids.shape[-1] == lengths[rows].max() for rows in batches)


def test_a_step_is_the_plain_one(model, pairs):
    policies = [copy.deepcopy(model) for _ in range(2)]
    optimizers = [torch.optim.SGD(policy.parameters(), lr=0.1) for policy in policies]
    ref_logps = reference_logps(model, pairs, sequence_logps) + torch.tensor([0.5, -0.3])
    row = train_step(
        policies[0], optimizers[0], pairs, ref_logps, functools.partial(dpo_loss, beta=0.2), sequence_logps, max_grad_norm=1e9
    )
    logps = torch.stack(
        [
            sequence_logps(
                policies[1].logits(pairs.input_ids[:, side], pairs.attention_mask[:, side]),
                pairs.input_ids[:, side],
                pairs.completion_mask[:, side],
            )
            for side in range(2)
        ]
    )
    losses, chosen_rewards, rejected_rewards = dpo_loss(*logps, *ref_logps.T, beta=0.2)
    losses.mean().backward()
    optimizers[1].step()
    assert row["loss"] == pytest.approx(losses.mean().item(), abs=1e-5)
    assert row["margin"] == pytest.approx((chosen_rewards - rejected_rewards).mean().item(), abs=1e-4)
    assert (row["chosen_moved"], row["rejected_moved"]) == pytest.approx((-0.5, 0.3), abs=1e-4)
    for ours, plain in zip(*(policy.parameters() for policy in policies), strict=True):
        torch.testing.assert_close(ours, plain, rtol=0, atol=1e-5)


def test_pairs_that_are_seen_again_and_again_are_learnt(model, pairs):
    policy = copy.deepcopy(model)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-3, weight_decay=0.0, fused=True)
    ref_logps = reference_logps(model, pairs, sequence_logps)
    rows = [train_step(policy, optimizer, pairs, ref_logps, dpo_loss, sequence_logps) for _ in range(8)]
    assert rows[0]["loss"] == pytest.approx(0.693147, abs=1e-4)
    assert rows[-1]["loss"] < 0.5 and rows[-1]["accuracy"] == 1 and rows[-1]["chosen_moved"] > rows[-1]["rejected_moved"]
