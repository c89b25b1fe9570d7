"""The course's one plotting style: transparent, readable on light and dark pages, safe for colour-blind readers."""

from __future__ import annotations

import matplotlib.pyplot as plt
from cycler import cycler
from IPython.core.interactiveshell import InteractiveShell

from course_lib.figures.statistics import summarise

GREY = "#686d72"
COLOURS = (
    "#2a7fbf",
    "#d55e00",
    "#009e73",
    "#b5609a",
    "#8a7a1f",
    "#7a6fd0",
)  # after Okabe and Ito, darkened or lightened to mid-contrast
DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (2, 1)))  # so that no curve is told from another by colour alone


def use_style():
    """Set the style for all later figures; in a notebook, draw them as SVG with text that can be selected."""
    plt.rcParams.update(
        {
            "figure.facecolor": "none",
            "axes.facecolor": "none",
            "savefig.facecolor": "none",
            "legend.framealpha": 0,
            "text.color": GREY,
            "axes.labelcolor": GREY,
            "axes.edgecolor": GREY,
            "axes.titlesize": "medium",
            "axes.prop_cycle": cycler(color=COLOURS) + cycler(linestyle=DASHES),
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.grid": True,
            "grid.color": GREY,
            "grid.alpha": 0.25,
            "xtick.color": GREY,
            "ytick.color": GREY,
            "legend.labelcolor": GREY,
            "figure.constrained_layout.use": True,
            "svg.fonttype": "none",
            "svg.hashsalt": "course",
        }
    )
    if InteractiveShell.initialized():
        from matplotlib_inline.backend_inline import set_matplotlib_formats

        set_matplotlib_formats("svg")


def curves(ax, x, runs, xlabel="", ylabel=""):
    """Draw, for every entry of `runs`, the interquartile mean over seeds and its 95% bootstrap interval.

    `x, runs = records.curves("mean_return", labels)` gives those of recorded runs.

    Args:
      ax: matplotlib axes.
      x: (points,), shared by all curves.
      runs: label -> scores of shape (seeds, points).
      xlabel, ylabel: labels of the axes; with either of them a legend is drawn, too.
    """
    for label, scores in runs.items():
        centre, low, high = summarise(scores)
        (line,) = ax.plot(x, centre, label=label)
        ax.fill_between(x, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
    if xlabel or ylabel:
        ax.set(xlabel=xlabel, ylabel=ylabel)
        ax.legend()
