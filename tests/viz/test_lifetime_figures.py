"""What the figures of lifetimes and beliefs show, read back from the drawn artists."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import scipy.stats
from matplotlib.dates import date2num
from matplotlib.text import Text

from evermap.errors import ConfigError, InputError
from evermap.survival import Exponential, GeneralPurpose, LifetimePrior, Mixture, Uniform, Weibull, never_leaves
from evermap.types import Clock
from evermap.viz.lifetime_figures import plot_lifetimes
from evermap.viz.presence_figures import plot_belief, stretches
from evermap.viz.time_axis import unit_for

DAY_S = 86400.0


def panel(figure: Any, title: str) -> Any:
    return next(axes for axes in figure.axes if axes.get_title(loc="left") == title)


def line(axes: Any, label: str) -> Any:
    return next(item for item in axes.lines if item.get_label() == label)


def texts(figure: Any) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text) if text.get_text()]


def test_four_views_agree_with_scipy_in_the_unit_of_the_axis() -> None:
    figure = plot_lifetimes(Weibull(2 * DAY_S, 1.5), until_s=6 * DAY_S, log_time=False)
    reference = scipy.stats.weibull_min(1.5, scale=2.0)  # in days
    views = {
        "hazard": lambda t: reference.pdf(t) / reference.sf(t),
        "cumulative hazard": lambda t: -reference.logsf(t),
        "survival": reference.sf,
        "density": reference.pdf,
    }
    for title, view in views.items():
        days, heights = panel(figure, title).lines[0].get_data()
        assert days[-1] == pytest.approx(6.0)
        np.testing.assert_allclose(heights[1:], view(days[1:]), rtol=1e-9)
    assert panel(figure, "hazard").get_ylabel() == "h(t) [1/day]"
    assert panel(figure, "density").get_xlabel() == "time since first seen [days]"


def test_features_that_never_leave_are_named_and_marked() -> None:
    mixture = Mixture((Exponential(1.0), never_leaves()), (0.6, 0.4))
    figure = plot_lifetimes({"chairs": mixture, "bins": Exponential(0.1)})
    assert "chairs (40 % never leave)" in texts(figure)
    assert "bins" in texts(figure)
    levels = [item.get_ydata()[0] for item in panel(figure, "survival").lines if item.get_ls() == ":"]
    assert levels == pytest.approx([0.4])
    levels = [item.get_ydata()[0] for item in panel(figure, "cumulative hazard").lines if item.get_ls() == ":"]
    assert levels == pytest.approx([-math.log(0.4)])
    assert panel(figure, "survival").get_ylim()[0] == 0.0


@pytest.mark.parametrize(
    ("prior", "logarithmic"), [(GeneralPurpose(1e-6, 1.0), True), (Exponential(1.0), False), (never_leaves(), False)]
)
def test_axis_of_time_suits_the_span_of_the_lifetimes(prior: LifetimePrior, logarithmic: bool) -> None:
    axes = panel(plot_lifetimes(prior), "survival")
    assert (axes.get_xscale() == "log") == logarithmic
    assert panel(plot_lifetimes(prior, log_time=not logarithmic), "survival").get_xscale() == (
        "linear" if logarithmic else "log"
    )


def test_poles_are_cut_and_leave_the_rest_in_sight() -> None:
    axes = panel(plot_lifetimes({"a": Uniform(10.0), "b": Exponential(0.5)}, log_time=False), "hazard")
    assert 0.5 < axes.get_ylim()[1] < 20.0


def test_ticks_of_wide_spans_are_durations() -> None:
    labels = texts(plot_lifetimes(GeneralPurpose(1 / (30 * DAY_S), 1 / 60.0)))
    assert {"1 h", "1 day"} <= set(labels)


def test_lifetimes_refuse_nothing_and_no_time() -> None:
    with pytest.raises(ConfigError, match="no lifetime prior"):
        plot_lifetimes({})
    with pytest.raises(ConfigError, match="until_s"):
        plot_lifetimes(Exponential(1.0), until_s=0.0)


@pytest.mark.parametrize(("span_s", "name"), [(30, "s"), (900, "min"), (12 * 3600, "h"), (30 * DAY_S, "days")])
def test_units_suit_the_span(span_s: float, name: str) -> None:
    assert unit_for(span_s).name == name


TIME_S = np.linspace(0.0, 600.0, 121)
BELIEF = np.exp(-TIME_S / 300.0)


def test_belief_curve_looks_and_truth_are_where_they_belong() -> None:
    figure: Any = plot_belief(
        TIME_S,
        BELIEF,
        looks=([60.0, 120.0, 420.0], [1, 1, 0]),
        truth_s=[(-5.0, 300.0), (900.0, 950.0)],
        forecast_from_s=480.0,
        threshold=0.25,
        title="chair 3",
    )
    axes: Any = figure.axes[0]
    minutes, belief = line(axes, "P(exists)").get_data()
    np.testing.assert_allclose(minutes, TIME_S[TIME_S <= 480.0] / 60.0)
    np.testing.assert_array_equal(belief, BELIEF[TIME_S <= 480.0])
    dashed = next(item for item in axes.lines if item.get_linestyle() == "--" and len(item.get_xdata()) > 2)
    np.testing.assert_allclose(dashed.get_xdata(), TIME_S[TIME_S >= 480.0] / 60.0)
    rows = [
        [segment[0] for segment in item.get_segments()] for item in axes.collections if hasattr(item, "get_segments")
    ]
    heights = {(round(x, 9), y > 0.5) for row in rows for x, y in row}
    assert heights == {(1.0, True), (2.0, True), (7.0, False)}
    shades = [item.get_paths()[0].get_extents() for item in axes.collections if item.get_label() == "truly there"]
    assert [(box.x0, box.x1, box.y0, box.y1) for box in shades] == [(0.0, 5.0, 0.0, 1.0)]
    forecast = next(patch for patch in axes.patches if patch.get_label() == "forecast")
    assert forecast.get_x() == pytest.approx(8.0)
    assert forecast.get_width() == pytest.approx(2.0)
    assert axes.get_xlabel() == "time [min]"
    assert {"chair 3", "detection", "miss", "truly there", "forecast", "threshold 0.25"} <= set(texts(figure))
    assert min(text.get_fontsize() for text in figure.findobj(Text) if text.get_text()) >= 8


def test_clocks_show_dates_and_far_starts_count_from_there() -> None:
    start = np.datetime64("2026-11-21T08:00")
    stamps = TIME_S * 100 + float(start.astype("datetime64[s]").astype(np.int64))
    axes: Any = plot_belief(stamps, BELIEF, clock=Clock.LOCAL_WALL).axes[0]
    assert axes.get_xlim()[0] == pytest.approx(date2num(start))  # type: ignore[no-untyped-call]
    assert axes.get_xlabel() == "time [local clock]"
    axes = plot_belief(stamps, BELIEF).axes[0]
    assert axes.get_xlim() == pytest.approx((0.0, 60000.0 / 3600.0))
    assert axes.get_xlabel() == "time since the start [h]"


def test_samples_become_stretches() -> None:
    stamps = np.arange(7.0)
    np.testing.assert_array_equal(stretches(stamps, [1, 1, 0, 0, 1, 0, 1]), [[0, 2], [4, 5], [6, 6]])
    np.testing.assert_array_equal(stretches(stamps, [0, 0, 0, 1, 1, 1, 1]), [[3, 6]])
    assert stretches(stamps, np.zeros(7)).shape == (0, 2)
    assert stretches([], []).shape == (0, 2)


@pytest.mark.parametrize(
    ("time", "belief", "looks", "detected", "named"),
    [
        ([0.0, 1.0], [1.0], [], [], "p_exists"),
        ([0.0], [1.0], [0.5], [], "detected"),
        ([], [], [], [], "time_s"),
        ([1.0, 0.0], [1.0, 1.0], [], [], "time_s"),
    ],
)
def test_columns_that_do_not_fit_are_refused(time: Any, belief: Any, looks: Any, detected: Any, named: str) -> None:
    with pytest.raises(InputError, match=named):
        plot_belief(time, belief, looks=(looks, detected))
