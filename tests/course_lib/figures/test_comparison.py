"""The widget of clips: what a session learns, and the page that replays it."""

import json
import re

import numpy as np
import pytest
import torch.nn.functional as F

from course_lib.figures.comparison import ANGLES, Session, animation, compare_clips, record, to_html


def loss(chosen, rejected):
    return F.softplus(rejected - chosen).mean()


def by_true_return(left, right):
    return "left" if left > right else "right"


def test_a_session_learns_that_upright_is_good_from_a_person_who_never_errs():
    session = Session(loss, pairs=20)
    assert session.accuracy() == 0.5 and not session.curve().any()
    data = record(session, by_true_return)
    assert data["accuracies"][-1] > 0.8
    hanging, upright = data["curves"][-1][0], data["curves"][-1][len(ANGLES) // 2]
    assert upright > hanging + 0.5


def test_a_tie_pulls_two_returns_together():
    session = Session(loss, pairs=2)
    session.answer("left")
    before = abs(session.sums[2] - session.sums[3]) @ abs(session.weights)
    session.answer("equal")
    assert abs((session.sums[2] - session.sums[3]) @ session.weights) < before


def test_an_unknown_answer_is_refused():
    with pytest.raises(ValueError, match="given must be one of left, right, equal, got 'both'"):
        Session(loss, pairs=1).answer("both")


def test_the_page_holds_the_whole_session_and_asks_for_nothing_else():
    page = to_html(record(Session(loss, pairs=3), by_true_return), "Three <pairs>")
    payload = json.loads(re.search(r'<script type="application/json">(.*?)</script>', page, re.DOTALL)[1])
    assert len(payload["clips"]) == 3 and len(payload["curves"]) == 4 and len(payload["curves"][0]) == len(ANGLES)
    assert "Three &lt;pairs&gt;" in page and "src=" not in page and "https:" not in page


def test_a_clip_is_described_in_words():
    still = np.zeros((40, 2))
    assert 'aria-label="left: from upright to upright, turning through 0° on the way"' in animation(still, "left")


def test_the_book_shows_a_recording_with_a_picture_and_a_sentence(monkeypatch):
    shown = []
    monkeypatch.setenv("COURSE_BOOK", "1")
    monkeypatch.setattr("IPython.display.display", lambda data, raw: shown.append(data))
    compare_clips(loss, by_true_return, pairs=2)
    assert {"text/html", "image/png", "text/plain"} == set(shown[0])
