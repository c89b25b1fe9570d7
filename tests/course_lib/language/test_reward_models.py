"""Small reward models: padding changes nothing, they learn from comparisons, and what is frozen stays so."""

import pytest
import torch

from course_lib.language import lm, preferences
from course_lib.language.reward_models import RewardModel, fit
from solutions.ch96 import last_token_scores, reward_model_loss


@pytest.fixture(scope="module")
def tiny():
    return lm.load("tiny")


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_text_is_worth_the_same_in_any_company_and_on_either_side(tiny, side):
    model = RewardModel(tiny, seed=1)
    texts = ["A joy.", "It is a film that has rather a lot of scenes."]
    tokens = tiny.encode(texts, side=side, ended=True)
    together = last_token_scores(model(*tokens), tokens.attention_mask)
    torch.testing.assert_close(together, torch.cat([model.scores([text], last_token_scores) for text in texts]))


def test_a_token_knows_nothing_of_the_next(tiny):
    model, tokens = RewardModel(tiny, seed=1), tiny.encode(["A joy to watch"])
    changed = tokens.input_ids.clone()
    changed[0, -1] = 7
    torch.testing.assert_close(model(*tokens)[:, :-1], model(changed, tokens.attention_mask)[:, :-1])


def test_it_learns_what_comparisons_say_and_is_frozen_afterwards(tiny):
    texts = ["good film", "bad film", "good plot", "bad plot"]
    data = preferences.Preferences(texts, torch.tensor([0, 2]), torch.tensor([1, 3]), torch.zeros(2), torch.ones(2))
    model = fit(RewardModel(tiny), data, reward_model_loss, last_token_scores, seed=0, steps=100, batch=4)
    scores = model.scores(texts, last_token_scores)
    assert scores[::2].min() > scores[1::2].max() and not any(parameter.requires_grad for parameter in model.parameters())


def test_each_comparison_is_learnt_with_its_own_margin(tiny):
    texts, seen = ["good film", "bad film", "good plot", "bad plot"], []
    data = preferences.Preferences(texts, torch.tensor([0, 2]), torch.tensor([1, 3]), torch.zeros(2), torch.ones(2))

    def loss(chosen, rejected, margin):
        seen.append((chosen - rejected - margin).detach())
        return reward_model_loss(chosen, rejected, margin)

    fit(RewardModel(tiny), data, loss, last_token_scores, seed=0, steps=100, batch=8, margins=torch.tensor([0.0, 50.0]))
    assert ((seen[0] < -40).any() and (seen[0] > -10).any()) and len(seen) == 100
