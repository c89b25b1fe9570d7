"""The plotting style is transparent and tells curves apart by dashes as well as by colour."""

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from course_lib.figures.plotting import curves, use_style


def test_curves_draw_the_centre_and_a_band_for_each_run():
    with plt.rc_context():
        use_style()
        figure, ax = plt.subplots()
        curves(ax, [0, 1], {"a": np.array([[0.0, 2], [0, 2]]), "b": np.ones((3, 2))})
        assert figure.get_facecolor()[3] == 0
        assert len(ax.collections) == 2 and [line.get_label() for line in ax.lines] == ["a", "b"]
        np.testing.assert_allclose(ax.lines[0].get_ydata(), [0, 2])
        assert ax.lines[0].get_linestyle() != ax.lines[1].get_linestyle()
        plt.close(figure)


def test_curves_label_the_axes_and_draw_a_legend_if_asked():
    figure, ax = plt.subplots()
    curves(ax, [0, 1], {"a": np.ones((3, 2))}, xlabel="steps", ylabel="return")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("steps", "return")
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["a"]
    plt.close(figure)
