"""The learner of chapter 101: padding on either side changes no logits that count, and is masked only where that matters."""

from __future__ import annotations

import pytest
import torch

from course_lib.language import verifiable

PROMPTS = ["49381=13489", "052=", "7=7"]


@pytest.fixture(scope="module")
def learner():
    return verifiable.Learner(verifiable.fresh(seed=0))


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_learners_logits_are_those_of_its_model_at_every_kept_token(learner, side):
    input_ids, mask = learner.model.encode(PROMPTS, side=side)
    assert not mask.all()
    expected = learner.model.logits(input_ids, mask)[mask]
    torch.testing.assert_close(learner.logits(input_ids, mask)[mask], expected)
    torch.testing.assert_close(learner.logits(torch.where(mask, input_ids, 3), mask)[mask], expected)


def test_padding_behind_an_answer_is_masked_by_nothing_but_the_order(learner, monkeypatch):
    handed = []
    monkeypatch.setattr(learner.model, "logits", lambda input_ids, attention_mask: handed.append(attention_mask))
    for side in ("right", "left"):
        learner.logits(*learner.model.encode(PROMPTS, side=side))
    assert handed[0].all() and not handed[1].all()
