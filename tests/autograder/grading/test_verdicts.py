import json
import os

import pytest
from gradebook_samples import HOSTILE, judged, verdict
from hypothesis import given
from hypothesis import strategies as st

from autograder.grading import verdicts
from autograder.grading.verdicts import Item, Verdict, clean_text, from_json, plain_name, to_json

ANY_TEXT = st.text(st.characters(exclude_categories=()))  # surrogates and controls included
POINTS = st.floats(0, 1e6)


@given(ANY_TEXT, st.integers(3, 40))
def test_cleaned_text_is_printable_short_and_stable(text, limit):
    cleaned = clean_text(text, limit)
    assert len(cleaned.encode()) <= limit
    assert all(character.isprintable() or character in "\n\t" or ord(character) > 0x9F for character in cleaned)
    assert clean_text(cleaned, limit) == cleaned


@given(st.text(st.characters(categories=("L", "N", "P", "Z")), max_size=100))
def test_ordinary_text_is_kept(text):
    assert clean_text(text) == text


def test_text_of_ten_megabytes_is_cut_to_two_kilobytes():
    assert len(clean_text("ä" * 10_000_000).encode()) in (2047, 2048)


@given(
    st.lists(st.tuples(ANY_TEXT, POINTS, st.sampled_from(verdicts.STATES), st.lists(ANY_TEXT, max_size=3), ANY_TEXT), max_size=5),
    st.lists(ANY_TEXT, max_size=5),
    st.none() | POINTS,
)
def test_any_verdict_survives_strict_json(items, flags, manual):
    items = [
        {"exercise": name, "score": score / 2, "max_score": score, "state": state, "misconceptions": named, "message": message}
        for name, score, state, named, message in items
    ]
    one = Verdict.of(verdict(items=items, flags=flags, manual_score=manual, manual_max_score=1e6))
    text = to_json(one)
    assert from_json(text) == one
    assert to_json(from_json(text)) == text
    text.encode()  # no lone surrogate


def test_the_file_has_exactly_the_keys_of_the_contract():
    raw = json.loads(to_json(judged()))
    assert set(raw) == set(verdict())
    assert set(raw["items"][0]) == set(verdict()["items"][0])


@pytest.mark.parametrize(
    "changes",
    [
        {"score": float("nan")},
        {"score": float("inf")},
        {"score": -1.0},
        {"score": 11.0},
        {"score": "7"},
        {"score": True},
        {"status": "passed"},
        {"schema": 2},
        {"student": "../s001"},
        {"items": [{"exercise": "a", "score": 2.0, "max_score": 1.0, "state": "wrong", "misconceptions": [], "message": ""}]},
        {"items": [{"exercise": "a", "score": 0.0, "max_score": 1.0, "state": "fine", "misconceptions": [], "message": ""}]},
    ],
)
def test_impossible_verdicts_are_refused(changes):
    with pytest.raises(ValueError):
        Verdict.of(verdict(**changes))
    with pytest.raises(ValueError):
        from_json(json.dumps(verdict(**changes)))


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", "null", '{"schema": 1}', to_json(judged())[:-40], to_json(judged()).replace("5.0", "NaN")]
)
def test_other_text_is_no_verdict(text):
    with pytest.raises(ValueError):
        from_json(text) if text != to_json(judged()) else None


def test_a_verdict_built_in_code_is_cleaned_when_it_is_written(tmp_path):
    path = verdicts.write(tmp_path, Verdict("s001", "ch44", "infra_error", 0.0, 1.0, flags=(HOSTILE,)))
    assert "\x1b" not in from_json(path.read_text(encoding="utf-8")).flags[0]


@pytest.mark.parametrize("score", [-1.0, 99.0])
def test_whatever_a_teacher_has_typed_is_kept(score):
    assert from_json(to_json(judged(manual_score=score))).manual_score == score


def test_no_number_of_flags_makes_a_verdict_too_big():
    one = Verdict.of(verdict(flags=[f"linked file {n} " + "x" * 5000 for n in range(20_000)]))
    assert len(one.flags) == verdicts.MAX_FLAGS + 1
    assert one.flags[-1] == "… and 19950 more"
    assert len(to_json(one)) < 100_000


def test_a_verdict_past_a_megabyte_is_refused():
    item = Item("e", 0.0, 1.0, "wrong", (), "x" * 2048)
    with pytest.raises(ValueError, match="too many items"):
        to_json(judged(items=[item] * 500))


@pytest.mark.parametrize("name", ["", ".", "..", ".hidden", "a/b", "a\nb", "a\x00b", "\udc80", "x" * 250, 7])
def test_only_plain_names_name_files(name):
    with pytest.raises(ValueError, match="name"):
        plain_name(name)


@pytest.mark.parametrize("name", ["s001", "=1+1", "Ünï, code", "<b>", "x" * 249])
def test_odd_names_are_names(name):
    assert plain_name(name) == name


def test_verdicts_are_read_back_in_order_and_leftovers_ignored(tmp_path):
    for student in ("s2", "s10", "=1+1"):
        verdicts.write(tmp_path, judged(student))
    (tmp_path / "s2" / ".abc.tmp").write_text("{")
    assert [one.student for one in verdicts.read_all(tmp_path)] == ["=1+1", "s10", "s2"]
    assert verdicts.read_all(tmp_path / "absent") == []


def test_a_verdict_under_another_name_is_reported(tmp_path):
    path = verdicts.write(tmp_path, judged("s1"))
    path.parent.rename(tmp_path / "s2")
    with pytest.raises(ValueError, match=r"s2/ch44\.json: it is the verdict of s1"):
        verdicts.read_all(tmp_path)


def test_a_full_disk_keeps_the_old_verdict(tmp_path, monkeypatch):
    path = verdicts.write(tmp_path, judged())
    before = path.read_text()

    def full(_descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        verdicts.write(tmp_path, judged(scores={"compute_gae": 0.0}))
    assert path.read_text() == before
    assert os.listdir(path.parent) == [path.name]
