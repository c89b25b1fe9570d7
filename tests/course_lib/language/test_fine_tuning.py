"""PPO on tokens: padding changes nothing that is measured, a trivial score rises, seeds repeat."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import transformers

from course_lib.language import fine_tuning, lm
from course_lib.language.fine_tuning import Taught, TokenPPO, Writer, train
from course_lib.seeding import seed_everything
from solutions import ch45, ch95

TAUGHT = Taught.of(vars(ch95), vars(ch45))
PROMPTS = ["The film is", "", "A story that goes on", "I"]
SETTINGS = TokenPPO(kl_coef=0.0, iterations=12, batch=32, new_tokens=6, minibatch=16, learning_rate=3e-2)


def a_random_model(seed=0):
    """GPT-2's architecture, as small as can be, untrained, with the tiny model's tokenizer."""
    tokenizer = transformers.PreTrainedTokenizerFast(tokenizer_file=str(lm.FOLDER / "tiny" / "tokenizer.json"))
    torch.manual_seed(seed)
    configuration = transformers.GPT2Config(
        vocab_size=len(tokenizer), n_positions=64, n_embd=16, n_layer=1, n_head=2, resid_pdrop=0, embd_pdrop=0, attn_pdrop=0
    )
    return lm.LanguageModel(transformers.GPT2LMHeadModel(configuration), tokenizer).eval()


def early_tokens(samples):
    """A score that no language is needed for: the share of tokens with a number below 1,000."""
    kept = samples.attention_mask & (torch.arange(samples.input_ids.shape[1]) >= samples.prompt_lengths[:, None])
    return (kept & (samples.input_ids < 1000)).sum(1) / kept.sum(1)


def a_writer(score=early_tokens, seed=0):
    policy = a_random_model(seed)
    return Writer(policy, a_random_model(seed + 1).frozen_copy(), score, TAUGHT)


def padded(samples, left, right):
    """The same samples with more padding on either side."""
    rows = len(samples.input_ids)

    def around(x, fill):
        return torch.cat([x.new_full((rows, left), fill), x, x.new_full((rows, right), fill)], 1)

    return samples._replace(
        input_ids=around(samples.input_ids, 7),
        attention_mask=around(samples.attention_mask, False),
        prompt_lengths=samples.prompt_lengths + left,
    )


def all_ended(samples, end_id):
    """The same samples, each ended: the first one early, the others in the last column. What is padded on the right has ended."""
    input_ids, attention_mask = samples.input_ids.clone(), samples.attention_mask.clone()
    input_ids[:, -1] = input_ids[0, -5:] = end_id
    attention_mask[0, -4:] = False
    return samples._replace(input_ids=input_ids, attention_mask=attention_mask)


@pytest.mark.parametrize(("left", "right"), [(5, 0), (0, 4), (3, 9)])
def test_padding_changes_nothing_that_is_measured(monkeypatch, left, right):
    writer = a_writer()
    ended = all_ended(writer.policy.generate(PROMPTS, 8, generator=seed_everything(0)), writer.policy.end_id)

    def written(samples):
        monkeypatch.setattr(writer.policy, "generate", lambda *args, **kwargs: samples)
        return writer.write(PROMPTS, 8, seed_everything(0)).measured(TAUGHT)

    assert written(padded(ended, left, right)) == pytest.approx(written(ended), rel=1e-4, abs=1e-5)


def test_padding_changes_no_advantage_and_no_loss(monkeypatch):
    writer, critic = a_writer(), torch.nn.Linear(16, 1)
    samples = all_ended(writer.policy.generate(PROMPTS, 8, generator=seed_everything(0)), writer.policy.end_id)

    def estimated(samples):
        monkeypatch.setattr(writer.policy, "generate", lambda *args, **kwargs: samples)
        writing = writer.write(PROMPTS, 8, seed_everything(0))
        advantages, returns = fine_tuning.estimate(writer, critic, writing, SETTINGS.but(kl_coef=0.1))
        loss = TAUGHT.ppo_token_loss(writing.logps - 0.1, writing.logps, advantages, writing.mask)
        return advantages[writing.mask], returns[writing.mask], loss

    for wide, narrow in zip(estimated(padded(samples, 6, 2)), estimated(samples), strict=True):
        torch.testing.assert_close(wide, narrow, rtol=1e-4, atol=1e-4)


def test_a_policy_that_is_the_reference_has_no_divergence():
    policy = a_random_model()
    writing = Writer(policy, policy.frozen_copy(), early_tokens, TAUGHT).write(PROMPTS, 8, seed_everything(0))
    assert writing.measured(TAUGHT)["kl"] == pytest.approx(0, abs=1e-5)


def test_a_few_updates_raise_a_trivial_score():
    writer = a_writer()
    rows = list(train(writer, PROMPTS, SETTINGS, seed=0))
    scores = [row["score"] for row in rows]
    assert sum(scores[-3:]) / 3 > sum(scores[:3]) / 3 + 0.1
    assert [row["iteration"] for row in rows] == list(range(SETTINGS.iterations))


def test_a_penalty_keeps_the_policy_nearer():
    def divergence(kl_coef):
        policy = a_random_model()
        writer = Writer(policy, policy.frozen_copy(), early_tokens, TAUGHT)
        return list(train(writer, PROMPTS, SETTINGS.but(kl_coef=kl_coef), seed=0))[-1]["kl"]

    assert divergence(1.0) < divergence(0.0) / 2


def test_only_the_policy_changes():
    writer = a_writer()
    before = [parameter.clone() for parameter in writer.reference.parameters()]
    policy_before = [parameter.clone() for parameter in writer.policy.parameters()]
    list(train(writer, PROMPTS, SETTINGS.but(iterations=1), seed=0))
    assert all(torch.equal(old, new) for old, new in zip(before, writer.reference.parameters(), strict=True))
    assert not all(torch.equal(old, new) for old, new in zip(policy_before, writer.policy.parameters(), strict=True))


def test_two_runs_of_one_seed_are_equal_and_two_seeds_are_not():
    def run(seed):
        rows = list(train(a_writer(), PROMPTS, SETTINGS.but(iterations=3), seed=seed))
        return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]

    first = run(0)
    assert first == run(0)
    assert first != run(1)


def test_another_update_takes_the_place_of_the_modules():
    seen = []

    def nothing(writer, critic, optimizer, writing, settings, generator):
        seen.append(writing.texts)
        return {"policy_loss": 0.0}

    rows = list(train(a_writer(), PROMPTS, SETTINGS.but(iterations=2), seed=0, update=nothing))
    assert len(seen) == len(rows) == 2
    assert "value_loss" not in rows[0]


def test_functions_are_found_where_they_are_given():
    assert TAUGHT.masked_gae is ch95.masked_gae
    mine = dict(vars(ch95), masked_mean=len)
    assert Taught.of(mine, vars(ch45)) == replace(TAUGHT, masked_mean=len)


def test_openings_are_the_first_words_of_texts_that_go_on():
    found = fine_tuning.openings("validation", words=3)
    assert len(found) > 100
    assert {len(text.split()) for text in found} == {3}
