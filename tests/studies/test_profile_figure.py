"""The curves of a learned sensor profile, read back from the figure."""

from __future__ import annotations

import numpy as np

from evermap.viz.style import house_style, new_figure
from evermap_studies.bateman2020.profile_figure import RateCurve, draw_profile


def curve(hits: float) -> RateCurve:
    at = np.linspace(0.5, 3.5, 4)
    return RateCurve(
        at=at,
        assumed=np.array([0.9, 0.7, 0.5, 0.3]),
        learned=np.array([0.8, 0.4, 0.2, 0.1]),
        hits=np.full(4, hits),
        true_at=np.array([0.0, 4.0]),
        true=np.array([1.0, 0.0]),
        label="range [m]",
    )


def test_lines_are_the_curves_and_the_band_two_standard_deviations() -> None:
    with house_style():
        figure = new_figure(6.0, 3.0)
        draw_profile(figure, [curve(16.0), curve(1.0)])
    first, second = figure.axes
    lines = {line.get_label(): line for line in first.get_lines()}
    np.testing.assert_allclose(lines["learned"].get_ydata(), [0.8, 0.4, 0.2, 0.1])
    np.testing.assert_allclose(lines["assumed before"].get_ydata(), [0.9, 0.7, 0.5, 0.3])
    np.testing.assert_allclose(lines["true"].get_xdata(), [0.0, 4.0])
    for axes, share in ((first, 0.5), (second, 2.0)):  # of the value: two over the root of the hits
        band = axes.collections[0].get_paths()[0].vertices
        at_two = band[np.isclose(band[:, 0], 1.5), 1]
        assert np.isclose(at_two.min(), max(0.0, 0.4 * (1 - share)))
        assert np.isclose(at_two.max(), min(1.0, 0.4 * (1 + share)))
    assert first.get_xlabel() == "range [m]"
