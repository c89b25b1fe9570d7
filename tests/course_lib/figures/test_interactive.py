"""The book's sliders: the page holds exactly what the function returns, and asks nobody for anything."""

import itertools
import json
import re

import matplotlib
import pytest

matplotlib.use("Agg")
from course_lib.figures.interactive import Series, explore, to_html

SLIDERS = {"slope": [0.5, 1, 2], "kind": ["up", "down"]}


def line(slope, kind):
    sign = 1 if kind == "up" else -1
    return {
        "ramp": Series([sign * slope * x for x in range(4)], "line", "Heights"),
        "with a gap": Series([1 / 3, float("nan"), slope], "bar", "Others", x=[1, 2, 5]),
    }


def page():
    return to_html(line, "A <title>", "x", {"slope": 1, "kind": "down"}, SLIDERS)


def data():
    return json.loads(re.search(r'<script type="application/json">(.*?)</script>', page(), re.DOTALL)[1])


def test_embedded_values_are_the_functions_for_every_combination():
    embedded = data()
    combinations = list(itertools.product(*SLIDERS.values()))
    assert len(embedded["values"]) == len(combinations)
    for values, combination in zip(embedded["values"], combinations, strict=True):
        for got, expected in zip(values, line(*combination).values(), strict=True):
            assert [float("nan") if value is None else value for value in got] == pytest.approx(expected.y, rel=1e-3, nan_ok=True)
    assert [one["x"] for one in embedded["series"]] == [[0, 1, 2, 3], [1, 2, 5]]


def test_panels_have_one_range_for_all_settings():
    heights, others = data()["panels"]
    assert (heights["label"], heights["series"], others["series"]) == ("Heights", [0], [1])
    assert heights["y"][0] <= -6 and heights["y"][1] >= 6


def test_controls_are_labelled_and_start_where_asked():
    controls = re.findall(r'<label>(\w+) <input type="range" min="0" max="(\d)" step="1" value="(\d)"', page())
    assert controls == [("slope", "2", "1"), ("kind", "1", "1")]
    assert page().count("<output>") == 2 and "<output>down</output>" in page()


def test_page_is_self_contained_and_escaped():
    assert "A &lt;title&gt;" in page()
    addresses = set(re.findall(r"https?://[^\s\"']+", page()))
    assert addresses <= {"http://www.w3.org/2000/svg"}  # a namespace, never fetched
    assert not re.search(r"\b(src|href)=|import\(|fetch\(|@import", page())


def test_text_alternative_holds_the_initial_values():
    table = re.search(r"<tbody>(.*)</tbody>", page())[1]
    assert re.findall(r"<td>(.*?)</td>", table) == ["0", "-1", "-2", "-3", "0.333", "", "1"]


def test_book_build_displays_html_with_a_picture_and_a_sentence(monkeypatch):
    shown = []
    monkeypatch.setenv("COURSE_BOOK", "1")
    monkeypatch.setattr("IPython.display.display", lambda bundle, raw: shown.append(bundle))
    explore(line, title="T", x_label="x", start={"slope": 2}, **SLIDERS)
    assert set(shown[0]) == {"text/html", "image/png", "text/plain"}
    assert shown[0]["text/plain"] == "T (slope = 2, kind = up)"


def test_live_notebook_gets_sliders_that_call_the_function(monkeypatch):
    shown, called = [], []
    monkeypatch.delenv("COURSE_BOOK", raising=False)
    monkeypatch.setattr("IPython.display.display", shown.append)
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: None)

    def recorded(**setting):
        called.append(setting)
        return line(**setting)

    explore(recorded, title="T", x_label="x", **SLIDERS)
    slider = shown[0].children[0]
    slider.value = 2
    assert called[0] == {"slope": 0.5, "kind": "up"} and called[-1] == {"slope": 2, "kind": "up"}


def unwritten(slope):
    raise NotImplementedError


def needs_an_answer(slope, kind):
    return {"ramp": Series(unwritten(slope))}


def needs_a_cell(slope, kind):
    return {"ramp": Series(cell_that_has_not_run)}  # noqa: F821


def stops(slope, kind):
    raise ValueError("shapes (3,) and (4,) differ")


@pytest.mark.parametrize(
    ("series", "says"),
    [
        (needs_an_answer, "This figure shows what unwritten returns, which is not written yet: write it, run its cell"),
        (needs_a_cell, "This figure needs a cell that has not run (name 'cell_that_has_not_run' is not defined)"),
        (stops, "There is no figure, as stops stops: ValueError: shapes (3,) and (4,) differ."),
    ],
)
def test_an_explorer_that_cannot_draw_says_one_sentence(monkeypatch, capsys, series, says):
    monkeypatch.delenv("COURSE_BOOK", raising=False)
    monkeypatch.setattr("IPython.display.display", lambda _shown: None)
    explore(series, title="T", x_label="x", **SLIDERS)
    printed = capsys.readouterr()
    shown = printed.out.replace("\x1b[2K\r", "")  # how a cell is cleared
    assert shown.startswith(says) and shown.count("\n") == 1
    assert "Traceback" not in printed.out + printed.err


def test_a_start_that_no_slider_offers_is_refused():
    with pytest.raises(ValueError, match=r"start.*slope.*7"):
        explore(line, title="T", x_label="x", start={"slope": 7}, **SLIDERS)
