"""Fine-tuning moves the loss down, and a proxy's unit is measured once."""

import pytest
import torch

from course_lib.language import lm, preferences
from course_lib.language.reward_models import RewardModel
from course_lib.language.rlhf import Proxy, liked_texts, next_token_loss, supervised, whole_texts
from solutions.ch96 import in_reference_units, last_token_scores


@pytest.fixture(scope="module")
def tiny():
    return lm.load("tiny")


@pytest.fixture(scope="module")
def samples(tiny):
    return tiny.generate(["A film", "The plot of it"] * 4, 6, generator=torch.Generator().manual_seed(0))


def test_a_calibrated_proxy_has_mean_0_and_deviation_1_there_and_keeps_its_order(tiny, samples):
    proxy = Proxy(RewardModel(tiny, seed=2), last_token_scores)
    calibrated = proxy.calibrated(samples)
    assert calibrated(samples).mean().item() == pytest.approx(0, abs=1e-5)
    assert calibrated(samples).std().item() == pytest.approx(1, abs=1e-4)
    assert torch.equal(calibrated(samples).argsort(), proxy(samples).argsort())


def test_a_calibrated_proxy_is_in_reference_units_of_one_prompt(tiny, samples):
    proxy = Proxy(RewardModel(tiny, seed=2), last_token_scores)
    raw = proxy(samples)[None]
    torch.testing.assert_close(proxy.calibrated(samples)(samples)[None], in_reference_units(raw, raw, 0.05)[0])


def test_judges_read_prompts_and_completions(tiny, samples):
    texts = whole_texts(tiny, samples)
    assert all(text.endswith(completion) for text, completion in zip(texts, samples.texts, strict=True))
    assert texts[0].startswith("A film") and texts[1].startswith("The plot of it")


def test_the_liked_half_is_liked():
    snippets = preferences.load("validation")
    liked = set(liked_texts("validation"))
    means = {text in liked: [] for text in snippets.texts}
    for text, mean in zip(snippets.texts, snippets.means.tolist(), strict=True):
        means[text in liked].append(mean)
    assert min(means[True]) > max(means[False]) and 0.4 < len(liked) / len(snippets) <= 0.5


def test_fine_tuning_brings_its_own_texts_closer(tiny):
    policy, texts = tiny.frozen_copy().requires_grad_(True), ["A warm and funny film."] * 4
    before = next_token_loss(policy, texts).item()
    losses = list(supervised(policy, texts, seed=0, steps=4, batch=4))
    assert len(losses) == 4 and next_token_loss(policy, texts).item() < before - 0.2
