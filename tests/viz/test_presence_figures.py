"""What the raster of beliefs and the calibration figure show, read back from the drawn artists."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text

from evermap.errors import InputError
from evermap.metrics.belief import belief_scores, reliability
from evermap.viz.presence_figures import plot_raster, plot_reliability


def texts(figure: Any) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text) if text.get_text()]


def line(axes: Any, label: str) -> Any:
    return next(item for item in axes.lines if item.get_label() == label)


def test_raster_has_a_row_a_feature_with_its_changes() -> None:
    belief = np.array([[1.0, 0.5, 0.0], [np.nan, 0.2, 0.9]])
    changes = [(0, 5400.0, False), (1, 9000.0, True)]
    figure = plot_raster(["door", "c" * 30], [0.0, 3600.0, 7200.0, 10800.0 * 1.01], belief, changes=changes)
    axes = figure.axes[0]
    mesh: Any = axes.collections[0]
    np.testing.assert_array_equal(mesh.get_array().filled(-1.0).ravel(), [1.0, 0.5, 0.0, -1.0, 0.2, 0.9])
    assert mesh.get_clim() == (0.0, 1.0)
    labels = [tick.get_text() for tick in axes.get_yticklabels()]
    assert labels == ["door", "c" * 17 + "…"]
    np.testing.assert_allclose(line(axes, "vanished").get_xydata(), [[1.5, 0.0]])  # in hours
    np.testing.assert_allclose(line(axes, "returned").get_xydata(), [[2.5, 1.0]])
    assert axes.yaxis_inverted()
    assert {"vanished", "returned", "not yet seen"} == {text.get_text() for text in figure.legends[0].get_texts()}


def test_many_rows_are_labelled_sparsely() -> None:
    figure = plot_raster([str(k) for k in range(100)], [0.0, 1.0], np.zeros((100, 1)))
    assert len(figure.axes[0].get_yticks()) <= 40


def test_raster_refuses_shapes_that_do_not_fit() -> None:
    with pytest.raises(InputError, match=r"shape \(1, 2\) instead of \(1, 3\)"):
        plot_raster(["a"], [0.0, 1.0, 2.0, 3.0], np.zeros((1, 2)))


def test_reliability_shows_the_bins_and_the_numbers() -> None:
    rng = np.random.default_rng(0)
    belief = rng.random(500)
    there = rng.random(500) < belief
    bins, scores = reliability(belief, there), belief_scores(belief, there)
    figure = plot_reliability(bins, scores)
    above: Any
    below: Any
    above, below = figure.axes
    np.testing.assert_allclose(above.lines[1].get_xydata(), np.column_stack([bins.belief, bins.present]))
    assert [patch.get_height() for patch in below.patches] == bins.count.tolist()
    assert any(f"Brier {scores.brier:.4f}" in text for text in texts(figure))


def test_an_empty_bin_is_left_out() -> None:
    bins, scores = reliability([0.05, 0.95], [0, 1]), belief_scores([0.05, 0.95], [0, 1])
    above: Any = plot_reliability(bins, scores).axes[0]
    np.testing.assert_allclose(above.lines[1].get_xydata(), [[0.05, 0.0], [0.95, 1.0]])
