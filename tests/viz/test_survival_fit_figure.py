"""Learned survival functions, read back from the drawn artists."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from evermap.errors import ConfigError
from evermap.survival import Exponential, Weibull, never_leaves
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.hazard_regression import HazardDraws
from evermap.survival.nonparametric import kaplan_meier, npmle
from evermap.survival.parametric_fit import fit
from evermap.viz.lifetime_figures import plot_survival

DAY_S = 86400.0
INF = float("inf")


def line(axes: Any, label: str) -> Any:
    return next(item for item in axes.lines if item.get_label() == label)


def band_at(collection: Any, x: float) -> tuple[float, float]:
    """Lowest and highest corner of a filled area next to x."""
    corners = np.concatenate([path.vertices for path in collection.get_paths()])
    near = corners[np.abs(corners[:, 0] - x) == np.abs(corners[:, 0] - x).min()]
    return float(near[:, 1].min()), float(near[:, 1].max())


STAYS = Weibull(3 * DAY_S, 1.5).sample(0, 80)
EXACT = CensoredLifetimes.of(STAYS, STAYS)


def test_curves_and_bands_are_those_of_the_estimates() -> None:
    weibull, product_limit = fit("weibull", EXACT), kaplan_meier(EXACT)
    draws = HazardDraws(np.array([0.0, DAY_S]), np.exp(np.random.default_rng(1).normal(-12.4, 0.3, (100, 2))))
    truth = Weibull(3 * DAY_S, 1.5)
    figure: Any = plot_survival(
        {"W": weibull, "KM": product_limit, "GP": draws, "plain": Exponential(1e-5)}, truth=truth, until_s=8 * DAY_S
    )
    axes: Any = figure.axes[0]
    t = line(axes, "truth").get_xdata() * DAY_S
    assert t[-1] == pytest.approx(8 * DAY_S)
    for name, expected in {
        "W": np.exp(weibull.prior.log_survival(t)),
        "KM": product_limit.survival(t),
        "GP": draws.survival(t)[0],
        "plain": np.exp(-1e-5 * t),
        "truth": np.exp(truth.log_survival(t)),
    }.items():
        np.testing.assert_allclose(line(axes, name).get_ydata(), expected)
    two_days = t[300]
    for area, (lower, upper) in zip(
        axes.collections,
        [weibull.band(two_days), product_limit.band(two_days), draws.survival(two_days)[1:]],
        strict=True,
    ):
        np.testing.assert_allclose(band_at(area, two_days / DAY_S), (lower, upper), rtol=1e-6)


def test_mass_of_an_interval_is_a_box() -> None:
    data = CensoredLifetimes.of([0.0, 10.0, 30.0], [20.0, 15.0, INF])
    estimate = npmle(data)
    axes: Any = plot_survival({"N": estimate}, until_s=60.0, log_time=False).axes[0]
    box = axes.collections[0]
    assert band_at(box, 12.0) == pytest.approx((1.0 / 3.0, 1.0))
    x, y = line(axes, "N").get_data()
    inside = (x > 10.0) & (x < 15.0)
    assert np.isnan(y[inside]).all()
    np.testing.assert_allclose(y[(x > 15.0) & (x < 30.0)], 1.0 / 3.0)
    assert "anywhere in a box" in [item.get_label() for item in axes.collections]


def test_survival_refuses_nothing_and_no_time() -> None:
    with pytest.raises(ConfigError, match="no survival function"):
        plot_survival({})
    with pytest.raises(ConfigError, match="until_s"):
        plot_survival({"a": Exponential(1.0)}, until_s=0.0)
    assert plot_survival({"wall": never_leaves()}).axes[0].lines[0].get_ydata().min() == 1.0  # type: ignore[union-attr]
