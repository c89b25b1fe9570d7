"""Human ratings: what the file holds, how preferences follow from it, and how agreement is counted."""

from __future__ import annotations

import hashlib
import itertools

import pytest
import torch

from course_lib.language import preferences
from course_lib.language.preferences import Snippets


def snippets(*ratings):
    return Snippets(
        [str(i) for i in range(len(ratings))], [f"text {i}" for i in range(len(ratings))], [torch.tensor(r) for r in ratings]
    )


def test_the_file_has_the_checksum_that_the_loader_demands():
    assert hashlib.sha256(preferences.RATINGS.read_bytes()).hexdigest() == preferences.SHA256


def test_every_text_has_fifteen_raters_or_more_on_the_scale():
    for split in preferences.SPLITS:
        loaded = preferences.load(split, preferences.SOURCES)
        assert min(len(ratings) for ratings in loaded.ratings) >= 15
        assert all(ratings.min() >= -4 and ratings.max() <= 4 for ratings in loaded.ratings)


def test_the_first_snippet_has_the_mean_that_its_authors_published():
    everything = [preferences.load(split) for split in preferences.SPLITS]
    loaded = next(split for split in everything if "film-1" in split.ids)
    assert loaded.means[loaded.ids.index("film-1")] == pytest.approx(2.26666666667)


def test_no_text_is_in_two_splits_however_it_is_spelt():
    def letters(split):
        texts = preferences.load(split, preferences.SOURCES).texts
        return {"".join(c for c in text.lower() if c.isascii() and c.isalnum()) for text in texts}

    for one, other in itertools.combinations(preferences.SPLITS, 2):
        assert not letters(one) & letters(other)


def test_the_splits_together_are_all_snippets():
    assert sum(len(preferences.load(split, preferences.SOURCES)) for split in preferences.SPLITS) == 23703
    assert sum(len(preferences.load(split)) for split in preferences.SPLITS) == 10605


@pytest.mark.parametrize(
    ("arguments", "name"), [(("train",), "split"), (("test", ("films",)), "sources"), (("test", "film"), "sources")]
)
def test_an_unknown_split_or_source_is_refused(arguments, name):
    with pytest.raises(ValueError, match=name):
        preferences.load(*arguments)


def test_disagreement_counts_rater_pairs_with_ties_halved():
    two = snippets([2, 3, 3, 4], [3, 0, 4, -1])
    expected = sum((a < b) + (a == b) / 2 for a in [2, 3, 3, 4] for b in [3, 0, 4, -1]) / 16
    assert preferences.disagreement(two.frequencies[:1], two.frequencies[1:]).item() == pytest.approx(expected)
    assert preferences.disagreement(two.frequencies[1:], two.frequencies[:1]).item() == pytest.approx(1 - expected)
    assert preferences.disagreement(two.frequencies[:1], two.frequencies[:1]).item() == pytest.approx(0.5)


def test_the_chosen_text_has_the_higher_mean_rating():
    loaded = preferences.load("validation")
    drawn = preferences.draw_pairs(loaded, 500, torch.Generator().manual_seed(0), min_gap=0.5)
    assert len(drawn) == 500
    assert (drawn.gap > 0.5).all()
    torch.testing.assert_close(drawn.gap, loaded.means[drawn.chosen] - loaded.means[drawn.rejected])
    assert drawn.chosen_texts[3] == loaded.texts[drawn.chosen[3]]


def test_pairs_repeat_with_the_generator():
    loaded = preferences.load("validation")
    one, two = (preferences.draw_pairs(loaded, 50, torch.Generator().manual_seed(4)) for _ in range(2))
    assert torch.equal(one.chosen, two.chosen) and torch.equal(one.rejected, two.rejected)


def test_pairs_that_cannot_differ_by_so_much_are_refused():
    with pytest.raises(ValueError, match="min_gap"):
        preferences.draw_pairs(snippets([1, 1], [2, 2]), 5, torch.Generator(), min_gap=3)


def test_single_raters_turn_round_as_many_pairs_as_raters_disagree():
    generator = torch.Generator().manual_seed(0)
    drawn = preferences.draw_pairs(preferences.load("reward_model"), 20_000, generator)
    asked = preferences.ask_two_raters(drawn, generator)
    turned = asked.gap < 0
    assert turned.float().mean().item() == pytest.approx(drawn.disagreement.mean().item(), abs=0.01)
    torch.testing.assert_close(asked.disagreement[turned], 1 - drawn.disagreement[turned])


def test_what_two_raters_told_is_what_the_pair_s_raters_say_given_who_won():
    texts = snippets([-1, 2, 4], [0, 2])
    answers = preferences.Preferences(
        texts.texts,
        torch.zeros(20_000, dtype=torch.int64),
        torch.ones(20_000, dtype=torch.int64),
        torch.zeros(20_000),
        torch.zeros(20_000),
    )
    told = preferences.told_differences(answers, texts, torch.Generator().manual_seed(0))
    # (2, 0), (4, 0), (4, 2) win outright; (2, 2) by a coin
    shares = [(told == points).float().mean().item() for points in (0, 2, 4)]
    assert shares == pytest.approx([0.5 / 3.5, 2 / 3.5, 1 / 3.5], abs=0.02) and set(told.tolist()) == {0.0, 2.0, 4.0}


def test_careless_labels_are_turned_round_at_the_given_rate():
    generator = torch.Generator().manual_seed(0)
    drawn = preferences.draw_pairs(preferences.load("reward_model"), 20_000, generator)
    assert (preferences.flip_labels(drawn, 0.3, generator).gap < 0).float().mean().item() == pytest.approx(0.3, abs=0.01)
    assert (preferences.flip_labels(drawn, 0.0, generator).gap > 0).all()
    with pytest.raises(ValueError, match="rate"):
        preferences.flip_labels(drawn, 1.5, generator)


def test_pairwise_accuracy_counts_pairs_and_halves_ties():
    labels = torch.tensor([0.0, 1.0, 2.0, 2.0])
    assert preferences.pairwise_accuracy(labels, labels).estimate == 1
    assert preferences.pairwise_accuracy(-labels, labels).estimate == 0
    assert preferences.pairwise_accuracy(torch.zeros(4), labels).estimate == 0.5
    one_pair_wrong = torch.tensor([0.0, 3.0, 2.0, 4.0])  # of five pairs whose labels differ
    assert preferences.pairwise_accuracy(one_pair_wrong, labels).estimate == pytest.approx(4 / 5)
    assert preferences.pairwise_accuracy(one_pair_wrong, labels, min_gap=1.5).estimate == 1


def test_the_interval_covers_the_true_accuracy_as_often_as_it_says():
    generator = torch.Generator().manual_seed(0)
    truth = 0.75  # of two independent normals with correlation √½ between score and label: ½ + asin(√½) / π
    inside = 0
    for _ in range(200):
        labels = torch.randn(100, generator=generator)
        interval = preferences.pairwise_accuracy(labels + torch.randn(100, generator=generator), labels)
        inside += interval.low <= truth <= interval.high
    assert 0.90 <= inside / 200 <= 0.99


def test_people_who_all_give_one_score_agree_and_people_who_draw_lots_do_not():
    unanimous = snippets(*([score] * 16 for score in range(-4, 5)))
    assert preferences.agreement_ceiling(unanimous, num_draws=2).estimate == 1
    generator = torch.Generator().manual_seed(0)
    lots = snippets(*(torch.randint(-4, 5, (16,), generator=generator).tolist() for _ in range(200)))
    assert preferences.agreement_ceiling(lots, num_draws=5).estimate == pytest.approx(0.5, abs=0.03)


def test_a_panel_agrees_with_the_other_panel_more_often_than_one_person_does():
    loaded = preferences.load("validation")
    one, half = (preferences.agreement_ceiling(loaded, raters, num_draws=3) for raters in (1, None))
    assert 0.75 < one.low < one.high < half.low < half.high < 0.95


def test_vader_tells_praise_from_blame():
    praise, blame, nothing = preferences.vader(["A great, wonderful film!", "An awful, boring mess.", "the"]).tolist()
    assert blame < -0.4 and nothing == 0 and praise > 0.4


def test_comparisons_repeat_with_their_seed_and_err_as_two_people_do():
    one, again, other = (preferences.comparisons(4000, seed) for seed in (3, 3, 4))
    assert torch.equal(one.chosen, again.chosen) and not torch.equal(one.chosen, other.chosen)
    wrong = (one.gap < 0).float().mean().item()
    assert wrong == pytest.approx(0.16, abs=0.02)
