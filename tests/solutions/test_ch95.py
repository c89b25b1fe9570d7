"""The references against hand-sized arrays and identities, so that the answer key does not rest on itself."""

import math

import pytest
import torch

from course_lib.language import fine_tuning, lm
from course_lib.language.tables import Bigrams, TableActor, fondness
from course_lib.seeding import seed_everything
from solutions import ch43, ch44, ch45, ch95
from solutions.ch95 import (
    completion_mask,
    kl_penalized_rewards,
    masked_gae,
    masked_mean,
    masked_whiten,
    per_token_logps,
    ppo_token_loss,
    repaired_reward_scaling,
    rlhf_iteration,
)
from solutions.ch97 import sequence_logps

END = 0


def rows(*lists, dtype=torch.float64):
    return torch.tensor(lists, dtype=dtype)


def masks(*texts):
    """One row for each text of "x" (keep) and "." (padding)."""
    return torch.tensor([[letter == "x" for letter in text] for text in texts])


def test_log_probabilities_of_tokens_by_hand():
    probabilities = rows([[0.5, 0.5], [0.2, 0.8], [0.9, 0.1]])
    found = per_token_logps(probabilities.log() - 3, torch.tensor([[0, 1, 0]]))
    assert found.tolist()[0] == pytest.approx([math.log(0.5), math.log(0.2)])


def test_tokens_add_up_to_the_sequence_of_chapter_97():
    logits, input_ids = torch.randn(4, 9, 6, dtype=torch.float64), torch.randint(6, (4, 9))
    mask = torch.rand(4, 9) < 0.5
    summed = torch.where(mask[:, 1:], per_token_logps(logits, input_ids), 0).sum(1)
    torch.testing.assert_close(summed, sequence_logps(logits, input_ids, mask))


@pytest.mark.parametrize(
    ("tokens", "start", "expected"),
    [
        ([5, 6, 7, 8, 9], 2, "..xxx"),  # no end token: cut off by the limit
        ([5, 6, 7, END, 9], 2, "..xx."),  # the first end token is kept, what follows is not
        ([5, 6, 7, END, END], 2, "..xx."),
        ([5, 6, END, END, END], 2, "..x.."),  # ended at once
        ([END, END, 5, 7, END], 3, "...xx"),  # left padding by end tokens
        ([5, END, 7, 8, 9], 2, "..xxx"),  # an end token within the prompt
        ([5, 6, 7, 8, 9], 0, "xxxxx"),
        ([5, 6, 7, 8, 9], 5, "....."),
    ],
)
def test_the_completion_mask_by_hand(tokens, start, expected):
    found = completion_mask(torch.tensor([tokens]), torch.tensor([start]), END)
    assert found.dtype == torch.bool
    assert torch.equal(found, masks(expected))


def test_penalised_rewards_by_hand():
    found = kl_penalized_rewards(
        rows(10, 20), rows([-1, -2, -3, -4], [-1, -2, -3, -4]), rows([-2, -2, -2, -2], [9, 9, -2, -2]), masks("xxx.", "..xx"), 0.1
    )
    torch.testing.assert_close(found, rows([-0.1, 0, 0.1 + 10, 0], [0, 0, 0.1, 0.2 + 20]))


def test_the_penalties_of_a_text_sum_to_the_sequences_log_ratio():
    logps, ref_logps = torch.randn(2, 5, 8, dtype=torch.float64)
    mask = masks(*["..xxxx.."] * 5)
    scores = torch.randn(5, dtype=torch.float64)
    ratios = torch.where(mask, logps - ref_logps, 0).sum(1)
    torch.testing.assert_close(kl_penalized_rewards(scores, logps, ref_logps, mask, 0.3).sum(1), scores - 0.3 * ratios)


def test_the_mean_is_over_tokens_not_over_rows():
    assert masked_mean(rows([1, 2, 3], [9, 50, 60]), masks("xxx", "x..")).item() == (1 + 2 + 3 + 9) / 4


def test_whitened_entries_have_mean_zero_and_deviation_one_and_padding_is_zero():
    mask = masks("xxx.", ".xx.", "...x")
    whitened = masked_whiten(5 + 3 * torch.randn(3, 4, dtype=torch.float64), mask)
    assert whitened[mask].mean().item() == pytest.approx(0, abs=1e-12)
    assert whitened[mask].std(correction=0).item() == pytest.approx(1)
    assert not whitened[~mask].any()


def test_equal_entries_whiten_to_zero():
    assert not masked_whiten(torch.full((2, 3), 4.0), masks("xxx", "x..")).any()


@pytest.mark.parametrize("gae_lambda", [0, 0.7, 1])
def test_advantages_of_texts_are_those_of_episodes_that_terminate(gae_lambda):
    """Each completion, cut out and laid along chapter 44's time axis, with its last token as the terminal step."""
    mask = masks("xxxx....", "..xxx...", ".......x")
    rewards, values = torch.randn(2, 3, 8, dtype=torch.float64)
    found = masked_gae(rewards, values, mask, 0.9, gae_lambda)
    for row, kept in enumerate(mask):
        r, v = rewards[row, kept, None], values[row, kept, None]  # (T, 1)
        terminated = torch.zeros_like(v, dtype=torch.bool)
        terminated[-1] = True
        following = torch.cat([v[1:], torch.full_like(v[:1], 99.0)])
        expected = ch44.compute_gae(r, v, following, terminated, torch.zeros_like(terminated), 0.9, gae_lambda)
        torch.testing.assert_close(found[row, kept], expected[:, 0])
    assert not found[~mask].any()


def test_what_padding_holds_changes_nothing():
    mask = masks("xxxx....", "..xxx...", "......xx")
    rewards, values, logps, old_logps = torch.randn(4, 3, 8, dtype=torch.float64)
    noise = torch.where(mask, 0, 1e3 * torch.randn(3, 8, dtype=torch.float64))
    torch.testing.assert_close(
        masked_gae(rewards + noise, values - noise, mask, 0.9, 0.8), masked_gae(rewards, values, mask, 0.9, 0.8)
    )
    torch.testing.assert_close(
        ppo_token_loss(logps + noise, old_logps, rewards - noise, mask), ppo_token_loss(logps, old_logps, rewards, mask)
    )


def test_the_token_loss_is_chapter_43s_loss_of_the_kept_tokens():
    logps, old_logps, advantages = torch.randn(3, 4, 6, dtype=torch.float64)
    mask = masks("xxxxxx", "x.....", "..xx..", ".....x")
    expected = ch43.clipped_surrogate_loss(logps[mask], old_logps[mask], advantages[mask], 0.1)
    torch.testing.assert_close(ppo_token_loss(logps, old_logps, advantages, mask, 0.1), expected)


def test_every_kept_token_weighs_alike_whatever_the_length_of_its_text():
    logps = torch.zeros(2, 4, dtype=torch.float64, requires_grad=True)
    ppo_token_loss(logps, torch.zeros(2, 4), torch.ones(2, 4), masks("xxxx", "x...")).backward()
    torch.testing.assert_close(logps.grad, -masks("xxxx", "x...").double() / 5)


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: masked_gae(torch.ones(1, 2), torch.ones(1, 2), masks("xx"), 1.1, 0.5), "gamma"),
        (lambda: masked_gae(torch.ones(1, 2), torch.ones(1, 2), masks("xx"), 1.0, -0.5), "gae_lambda"),
        (lambda: ppo_token_loss(*[torch.ones(1, 2)] * 3, masks("xx"), clip_range=-0.1), "clip_range"),
        (lambda: kl_penalized_rewards(torch.ones(2), *[torch.ones(1, 2)] * 2, masks("xx"), 0.1), "scores"),
        (lambda: masked_mean(torch.ones(2, 2), masks("xx")), "mask"),
    ],
)
def test_bad_input_is_refused_by_name(call, name):
    with pytest.raises(ValueError, match=name):
        call()


def test_scaling_changes_the_unit_and_nothing_else():
    rewards, mask = rows([0, 0, 4, 9], [0, 2, 77, 77]), masks("xxx.", "xx..")
    found = repaired_reward_scaling(rewards, mask)
    deviation = math.sqrt((0 + 0 + 16 + 0 + 4) / 5 - (6 / 5) ** 2)
    torch.testing.assert_close(found, rows([0, 0, 4 / deviation, 0], [0, 2 / deviation, 0, 0]))
    assert found[mask].std(correction=0).item() == pytest.approx(1)


def test_a_text_of_zeros_stays_worth_nothing_however_long():
    rewards, mask = rows([0, 0, 0, 0], [3, 0, 0, 0]), masks("xxxx", "x...")
    assert repaired_reward_scaling(rewards, mask)[0].tolist() == [0, 0, 0, 0]
    assert masked_whiten(rewards, mask)[0].sum() < -1  # what the suspect program did


def taught_to_like(kl_coef, learning_rate, iterations=12):
    """What a table's policy does after iterations that pay for the token 1: (V - 1, V) probabilities, and the last iteration's log."""
    table, generator = torch.zeros(4, 4, dtype=torch.float64), torch.Generator().manual_seed(0)
    actor, reference = TableActor(table.clone(), torch.zeros(1, 4, dtype=torch.float64), learning_rate, 0.2), Bigrams(table)
    settings = fine_tuning.TokenPPO(kl_coef=kl_coef, new_tokens=5, minibatch=500)
    for _ in range(iterations):
        log = rlhf_iteration(actor, reference, ["0", "21", "2"] * 8, fondness(1), settings, generator)
    assert not reference.table.any() and actor.steps == 2 * iterations
    return actor.policy.table.detach()[:-1].softmax(-1), log


def test_iterations_teach_what_is_paid_for_and_a_high_price_holds():
    free, log = taught_to_like(0.0, 12.0)
    held, log_held = taught_to_like(5.0, 2.0)
    assert free[:, 1].median() > 0.5 > 0.35 > held[:, 1].max()
    assert log["score"] > 3 > log_held["score"] and log["kl"] > 1 > log_held["kl"]


def test_an_iteration_on_a_language_model_is_that_of_the_library():
    reference, settings = lm.load("tiny").frozen_copy(), fine_tuning.TokenPPO(batch=6, minibatch=4, new_tokens=8, iterations=1)
    prompts = ["The film is", "A", "This movie has", "It", "One of the", "What"]
    writer = fine_tuning.Writer(
        lm.load("tiny"), reference, fine_tuning.vader_scores, fine_tuning.Taught.of(vars(ch95), vars(ch45))
    )
    (theirs,) = fine_tuning.train(writer, prompts, settings, seed=0)
    policy = lm.load("tiny")
    generator = seed_everything(0)
    actor = fine_tuning.ActorCritic(policy, settings)
    asked = [prompts[pick] for pick in torch.randint(6, (6,), generator=generator).tolist()]
    ours = rlhf_iteration(actor, reference, asked, fine_tuning.vader_scores, settings, generator)
    assert ours == pytest.approx({name: theirs[name] for name in ours}, rel=1e-4, abs=1e-5)
    for mine, library in zip(policy.parameters(), writer.policy.parameters(), strict=True):
        assert torch.allclose(mine, library, atol=2e-5)
