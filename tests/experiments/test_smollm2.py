"""The experiment's own code, on a random network of the same kind: what it trains, and what it tells."""

import copy

import pytest
import torch
from transformers import LlamaConfig, LlamaForCausalLM

from course_lib.language import lm
from experiments import smollm2


@pytest.fixture(scope="module")
def little():
    torch.manual_seed(0)
    tokenizer = lm.load("tiny").tokenizer
    shape = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 3, "num_attention_heads": 2}
    network = LlamaForCausalLM(LlamaConfig(vocab_size=len(tokenizer), tie_word_embeddings=True, **shape))
    return lm.LanguageModel(network, tokenizer).eval()


@pytest.fixture
def loaded(little, monkeypatch):
    """What `run` gets to work on, with little to do."""
    model = copy.deepcopy(little)
    monkeypatch.setattr(lm, "load", lambda name: model)
    for variant, few in {
        "ppo": {"iterations": 2, "batch": 4},
        "dpo": {"steps": 2},
        "reward_model": {"steps": 11, "texts": 20},
    }.items():
        layers = {"last_layers": min(1, smollm2.VARIANTS[variant]["last_layers"])}
        monkeypatch.setitem(smollm2.VARIANTS, variant, smollm2.VARIANTS[variant] | few | layers)
    monkeypatch.setattr(smollm2, "WRITTEN", 4)
    monkeypatch.setattr(smollm2, "RATED", 8)
    return model


def changed(before, after):
    return {name for name, value in after.state_dict().items() if not torch.equal(value, before.state_dict()[name])}


@pytest.mark.parametrize("variant", ["ppo", "dpo"])
def test_only_the_last_layer_and_the_normalisation_learn(variant, little, loaded, tmp_path):
    result = smollm2.run(variant, 0, tmp_path, lambda done, total: None)
    assert changed(little, loaded) and all(".layers.2." in name or ".model.norm." in name for name in changed(little, loaded))
    assert [row["iteration"] for row in result.rows] == [0, 1]
    assert len(result.summary["texts"]) == 4 and {"score_before", "score_after"} <= set(result.summary)


def test_a_reward_model_is_judged_on_unseen_texts_and_leaves_the_language_model_alone(little, loaded, tmp_path):
    result = smollm2.run("reward_model", 0, tmp_path, lambda done, total: None)
    assert not changed(little, loaded)
    assert result.summary["accuracy_low"] <= result.summary["accuracy"] <= result.summary["accuracy_high"]
    assert [row["iteration"] for row in result.rows] == [0, 10]
    assert result.rows[0]["held_out_accuracy"] == 0.5 and result.rows[0]["loss"] == pytest.approx(0.693147, abs=1e-5)


def test_what_is_known_of_a_text_does_not_depend_on_the_texts_beside_it(little):
    texts = ["A film", "It is a long and very fine film about a film", ""]
    together = smollm2.known(little, texts)
    torch.testing.assert_close(together, torch.cat([smollm2.known(little, [text]) for text in texts]), rtol=1e-4, atol=1e-5)
