"""The held-out judge: better than VADER, worse than people, blind to nothing but what it says."""

import importlib.util
from pathlib import Path

import torch

from course_lib.language import preferences
from course_lib.language.judges import gold_judge


def test_it_orders_held_out_texts_better_than_vader_and_worse_than_one_person():
    test = preferences.load("test")
    judge = preferences.pairwise_accuracy(gold_judge()(test.texts), test.means)
    assert preferences.pairwise_accuracy(preferences.vader(test.texts), test.means).high < judge.low
    assert judge.high < preferences.agreement_ceiling(test).low


def test_scores_are_ratings_and_do_not_depend_on_the_batch():
    texts = ["A masterpiece, and a joy to watch.", "", "A dull and tiresome mess."]
    scores = gold_judge()(texts)
    assert scores.dtype == torch.float32 and scores[0] > 0.5 and scores[2] < -0.5
    torch.testing.assert_close(scores, torch.cat([gold_judge()([text]) for text in texts]))
    torch.testing.assert_close(scores[1], gold_judge().level)


def test_the_committed_weights_are_what_the_script_trains():
    path = Path(__file__).parents[3] / "tools" / "train_gold_judge.py"
    spec = importlib.util.spec_from_file_location("train_gold_judge", path)
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    trained = tool.trained(preferences.load("gold", tool.SOURCES))
    texts = preferences.load("validation").texts
    torch.testing.assert_close(trained(texts), gold_judge()(texts), rtol=0, atol=5e-3)
