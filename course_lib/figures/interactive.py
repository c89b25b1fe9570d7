"""Figures with sliders: `explore` draws what a function returns for every setting of its parameters.

In a live notebook the sliders are ipywidgets and the function is called anew at every move. When the book is built
(environment variable COURSE_BOOK=1) the function is called once for every combination of slider values, and the page gets
one self-contained piece of HTML: the values as JSON, and a small script that draws them. It needs no kernel and no network.
"""

from __future__ import annotations

import base64
import html
import io
import itertools
import json
import math
import os
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np

STATIC = files("course_lib") / "static"


@dataclass(frozen=True)
class Series:
    """One set of values to draw.

    Args:
      y: (points,) numbers; tensors and arrays will do. NaN leaves a gap.
      kind: "line", "bar" or "points".
      panel: label of the panel to draw it in; panels lie below one another.
      x: (points,), by default 0, 1, 2, …; the same for every setting of the sliders.
    """

    y: Sequence[float]
    kind: str = "line"
    panel: str = "value"
    x: Sequence[float] | None = None


def explore(series: Callable[..., dict[str, Series]], *, title: str, x_label: str, start: dict | None = None, **sliders) -> None:
    """Show `series(**setting)` under one slider for each keyword argument.

    Args:
      series: returns name -> Series, the same names, kinds, panels and x for every setting.
      title: caption of the figure.
      x_label: label of the shared horizontal axis.
      start: setting to begin with, parameter -> one of its values; the first value by default.
      sliders: parameter -> the values (numbers or strings) that its slider offers.

    Raises: ValueError if `start` names a value that its slider does not offer.
    """
    initial = {name: (start or {}).get(name, values[0]) for name, values in sliders.items()}
    for name, value in initial.items():
        if value not in sliders[name]:
            raise ValueError(f"start must name a value of the slider {name}, one of {list(sliders[name])}, got {value}")
    if os.environ.get("COURSE_BOOK") == "1":
        _show_recorded(series, title, x_label, initial, sliders)
    else:
        _show_live(series, title, x_label, initial, sliders)


def to_html(series, title: str, x_label: str, initial: dict, sliders: dict) -> str:
    """The self-contained figure of `explore`, with the values of every combination, rounded to four significant digits."""
    first = series(**initial)
    settings = [dict(zip(sliders, values, strict=True)) for values in itertools.product(*sliders.values())]
    values = [[_rounded(one.y) for one in series(**setting).values()] for setting in settings]
    abscissae = [_rounded(range(len(one.y)) if one.x is None else one.x) for one in first.values()]
    data = {
        "xLabel": x_label,
        "sliders": [{"name": name, "values": [_label(choice) for choice in choices]} for name, choices in sliders.items()],
        "series": [{"name": name, "kind": one.kind, "x": x} for (name, one), x in zip(first.items(), abscissae, strict=True)],
        "panels": _panels(first, abscissae, values),
        "values": values,
    }
    shown = values[settings.index(initial)]
    payload = json.dumps(data, ensure_ascii=False, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    return (
        f'<figure class="explorer"><style>{_static("explorer.css")}</style><figcaption>{html.escape(title)}</figcaption>'
        f'<div class="controls">{_controls(initial, sliders)}</div>{_frames(data)}{_table(data, shown)}'
        f'<script type="application/json">{payload}</script><script>{_static("explorer.js")}</script></figure>'
    )


def _static(name: str) -> str:
    return (STATIC / name).read_text(encoding="utf-8")


def _rounded(numbers) -> list[float | int | None]:
    kept = [float(f"{number:.4g}") for number in np.asarray(numbers, dtype=float).ravel()]
    return [None if math.isnan(number) else int(number) if number.is_integer() else number for number in kept]


def _panels(first: dict[str, Series], abscissae: list, values: list) -> list[dict]:
    """Panels in order of appearance; their ranges hold for every setting, so that a move of a slider shows as a change."""
    panels = []
    for label in dict.fromkeys(one.panel for one in first.values()):
        indices = [i for i, one in enumerate(first.values()) if one.panel == label]
        heights = [y for combination in values for i in indices for y in combination[i] if y is not None]
        low, high = min(0, *heights), max(0, *heights)
        margin = 0.05 * (high - low or 1)
        positions = [x for i in indices for x in abscissae[i]]
        left, right = min(positions), max(positions)
        bars = any(one.kind == "bar" for one in first.values() if one.panel == label)
        beside = 0.5 if bars else 0.02 * (right - left or 1)
        panels.append(
            {
                "label": label,
                "series": indices,
                "x": [left - beside, right + beside],
                "y": [low - margin if low < 0 else 0, high + margin],
            }
        )
    return panels


def _controls(initial: dict, sliders: dict) -> str:
    return "".join(
        f'<label>{html.escape(name)} <input type="range" min="0" max="{len(choices) - 1}" step="1" '
        f'value="{list(choices).index(initial[name])}" aria-valuetext="{html.escape(_label(initial[name]))}"> '
        f"<output>{html.escape(_label(initial[name]))}</output></label>"
        for name, choices in sliders.items()
    )


def _label(choice: float | str) -> str:
    """A slider's value as the page shows it."""
    return choice if isinstance(choice, str) else f"{choice:g}"


def _frames(data: dict) -> str:
    frames = []
    for panel in data["panels"]:
        names = [(i, html.escape(data["series"][i]["name"])) for i in panel["series"]]
        key = "".join(
            f'<span class="entry"><span class="key c{i % 5}" aria-hidden="true"></span>{name}</span>' for i, name in names
        )
        label = html.escape(panel["label"])
        frames.append(f'<p class="panel">{label}:{key}</p><div><svg role="img" aria-label="{label}"></svg></div>')
    return "".join(frames)


def _table(data: dict, shown: list) -> str:
    """The text alternative: the same values, row by row, which the script keeps up to date."""
    rows = []
    for one, values in zip(data["series"], shown, strict=True):
        cells = "".join(f"<td>{'' if value is None else f'{value:.3g}'}</td>" for value in values)
        rows.append(f'<tr><th scope="row">{html.escape(one["name"])}</th>{cells}</tr>')
    head = "".join(f'<th scope="col">{x:g}</th>' for x in max((one["x"] for one in data["series"]), key=len))
    return (
        "<details><summary>The values as a table</summary>"
        f'<div class="scroll" tabindex="0" role="region" aria-label="The values as a table"><table><thead><tr><th scope="col">'
        f"{html.escape(data['xLabel'])}</th>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div></details>"
    )


def _figure(shown: dict[str, Series], title: str, x_label: str):
    import matplotlib.pyplot as plt

    labels = list(dict.fromkeys(one.panel for one in shown.values()))
    figure, axes = plt.subplots(len(labels), 1, figsize=(7, 2.4 * len(labels)), squeeze=False, layout="constrained")
    for i, (name, one) in enumerate(shown.items()):
        ax = axes[labels.index(one.panel), 0]
        x = range(len(one.y)) if one.x is None else one.x
        y = np.asarray(one.y, dtype=float).ravel()
        if one.kind == "bar":
            ax.bar(x, y, width=0.6, alpha=0.55, color=f"C{i}", label=name)
        else:
            ax.plot(x, y, "o-" if one.kind == "line" else "o", color=f"C{i}", label=name)
        ax.set(ylabel=one.panel, xlabel=x_label)
        ax.legend()
    figure.suptitle(title)
    return figure


def _show_live(series, title: str, x_label: str, initial: dict, sliders: dict) -> None:
    import ipywidgets as widgets
    import matplotlib.pyplot as plt
    from IPython.display import display

    def draw(**setting):
        try:
            _figure(series(**setting), title, x_label)
        except Exception as error:  # in a function of the learner's, above which stand thirty lines of widgets and of ours
            print(_in_a_sentence(error))
        else:
            plt.show()

    controls = {
        name: widgets.SelectionSlider(options=list(choices), value=initial[name], description=name)
        for name, choices in sliders.items()
    }
    display(widgets.VBox([*controls.values(), widgets.interactive_output(draw, controls)]))


def _in_a_sentence(error: Exception) -> str:
    """Why there is no figure yet, and what to do."""
    name = traceback.extract_tb(error.__traceback__)[-1].name
    if isinstance(error, NotImplementedError):
        return (
            f"This figure shows what {name} returns, which is not written yet: write it, run its cell, then run this one again."
        )
    if isinstance(error, NameError):
        return f"This figure needs a cell that has not run ({error}): run the cells above, then this one again."
    return f"There is no figure, as {name} stops: {type(error).__name__}: {error}. Its check says more."


def _show_recorded(series, title: str, x_label: str, initial: dict, sliders: dict) -> None:
    """The HTML for the book, and for readers without it (a notebook that shows recorded outputs) a picture and a sentence."""
    import matplotlib.pyplot as plt
    from IPython.display import display

    setting = ", ".join(f"{name} = {value}" for name, value in initial.items())
    figure = _figure(series(**initial), f"{title}\n{setting}", x_label)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=100, facecolor="white")
    plt.close(figure)
    display(
        {
            "text/html": to_html(series, title, x_label, initial, sliders),
            "image/png": base64.b64encode(picture.getvalue()).decode(),
            "text/plain": f"{title} ({setting})",
        },
        raw=True,
    )
