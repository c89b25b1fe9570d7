"""What the variants of DPO are compared in is what their names say."""

import math

import pytest
import torch

from course_lib.language import lm
from course_lib.language.direct import encode_pairs
from course_lib.language.fine_tuning import openings
from course_lib.language.reward_models import RewardModel
from experiments import direct, rlhf
from solutions.ch96 import last_token_scores


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


def test_own_texts_are_what_the_reward_model_likes_best_and_least_of_each_prompts_candidates(monkeypatch):
    model = lm.load("tiny").frozen_copy()
    judge = RewardModel(model, seed=0).requires_grad_(False)
    monkeypatch.setattr(direct, "reference", lambda seed: model)
    monkeypatch.setattr(rlhf, "reward_model", lambda seed: judge)
    monkeypatch.setattr(direct, "PROMPTS_AT_A_TIME", 2)
    pairs = direct.own_texts(count=3, candidates=4, seed=0)
    input_ids, attention_mask, completion_mask = (part.flatten(0, 1) for part in pairs)
    scores = last_token_scores(judge(input_ids, attention_mask), attention_mask).unflatten(0, (-1, 2))
    assert (scores[:, 0] > scores[:, 1]).all()
    prompts = model.decode(input_ids, attention_mask & ~completion_mask)
    assert prompts == [prompt for prompt in openings("policy")[:3] for _ in range(2)]
    assert (completion_mask <= attention_mask).all() and (completion_mask.sum(1) <= rlhf.PPO.new_tokens).all()
    ended = (input_ids == model.end_id) & completion_mask
    assert (ended.any(1) | (completion_mask.sum(1) == rlhf.PPO.new_tokens)).all(), "a text that was cut off has no end token"


def test_a_coin_turns_labels_and_leaves_the_pairs_alone():
    asked = direct.comparisons(400, seed=3)
    tossed = direct.by_coin(asked, seed=3)
    turned = tossed.chosen != asked.chosen
    assert 150 < turned.sum() < 250
    assert torch.equal(torch.where(turned, tossed.rejected, tossed.chosen), asked.chosen)
    assert torch.equal(torch.where(turned, tossed.chosen, tossed.rejected), asked.rejected)


def test_of_four_texts_that_people_wrote_the_reward_model_takes_the_best_and_the_worst(monkeypatch):
    judge = RewardModel(lm.load("tiny"), seed=0).requires_grad_(False)
    monkeypatch.setattr(rlhf, "reward_model", lambda seed: judge)
    few, many = direct.picked(200, seed=0), direct.comparisons(200, seed=0)
    (best, worst), (chosen, rejected) = (
        [judge.scores(side, last_token_scores) for side in (asked.chosen_texts, asked.rejected_texts)] for asked in (few, many)
    )
    assert (best >= worst).all()
    assert (best - worst).mean() > 1.4 * (chosen - rejected).abs().mean(), "four at random lie further apart than two"
