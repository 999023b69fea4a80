"""Lifetimes: priors in four views, and survival functions learned from data."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.errors import ConfigError
from evermap.survival.base import LifetimePrior
from evermap.survival.hazard_posterior import HazardPosterior
from evermap.survival.hazard_regression import HazardDraws
from evermap.survival.nonparametric import KaplanMeier, Npmle
from evermap.survival.parametric_fit import ParametricFit
from evermap.types import FloatArray
from evermap.viz.style import CLASS_COLOURS, INK, MUTED, class_looks, drawing, legend_name
from evermap.viz.time_axis import TimeUnit, label_ages, unit_for

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DASHES = ("-", "--", ":")
_POINTS = 2001
_WIDE = 1e3
"""Ratio of long to short lifetimes above which the time axis is logarithmic."""
_DECADES = 7.0
"""Maximum decades of a logarithmic axis of rates."""
_BOX = "anywhere in a box"

Estimate = Npmle | KaplanMeier | ParametricFit | HazardDraws | HazardPosterior | LifetimePrior


def plot_lifetimes(
    priors: Mapping[str, LifetimePrior] | LifetimePrior,
    *,
    until_s: float | None = None,
    log_time: bool | None = None,
    title: str | None = None,
) -> Figure:
    """Draw hazard, cumulative hazard, survival and density over the time since a feature was first seen.

    A prior of which some features never leave (its hazard has a finite integral) says so in the legend, with the
    level at which its survival ends as a dotted line. A point of mass shows as a step of survival and cumulative
    hazard; its infinite hazard and density are left out.

    Args:
        priors: by the names for the legend, or a single one.
        until_s: end of the time axis in seconds; left out, all but the longest twentieth of the lifetimes.
        log_time: a logarithmic axis of time; left out, where lifetimes span more than three decades.
        title: above the figure.

    Raises:
        ConfigError: no prior, or a time that is not positive.
    """
    named = dict(priors) if isinstance(priors, Mapping) else {type(priors).__name__: priors}
    if not named:
        raise ConfigError("no lifetime prior to draw", field="priors")
    time_s, logarithmic = _times(named.values(), until_s, log_time)
    unit = unit_for(float(time_s[-1]))
    with drawing(7.2, 5.0, title=title) as figure:
        panels = figure.subplots(2, 2, sharex=True)
        styles = _styles(named)
        for name, prior in named.items():
            _draw_prior(panels, prior, _legend(name, prior), time_s, unit, styles[name])
        _finish(panels, unit, logarithmic)
        for axes in panels[1]:
            label_ages(axes, time_s, unit, logarithmic=logarithmic)
        figure.legend(*panels[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _draw_prior(
    panels: Any, prior: LifetimePrior, label: str, time_s: FloatArray, unit: TimeUnit, style: dict[str, Any]
) -> None:
    """One prior in all four views, rates per `unit`."""
    x = time_s / unit.seconds
    (hazard, cumulative), (survival, density) = panels
    with np.errstate(over="ignore"):
        hazard.plot(x, _finite(prior.hazard(time_s) * unit.seconds), **style)
        density.plot(x, _finite(np.exp(prior.log_density(time_s)) * unit.seconds), **style)
    cumulative.plot(x, _finite(prior.cumulative_hazard(time_s)), **style)
    survival.plot(x, np.exp(prior.log_survival(time_s)), label=label, **style)
    stay = prior.p_never_leaves
    if 0.0 < stay < 1.0:
        survival.axhline(stay, color=style["color"], lw=0.8, ls=":")
        cumulative.axhline(-math.log(stay), color=style["color"], lw=0.8, ls=":")


def _finish(panels: Any, unit: TimeUnit, logarithmic: bool) -> None:
    (hazard, cumulative), (survival, density) = panels
    for axes, title, label in (
        (hazard, "hazard", f"h(t) [1/{unit.name.removesuffix('s') or 's'}]"),
        (cumulative, "cumulative hazard", "H(t) [1]"),
        (survival, "survival", "S(t) [1]"),
        (density, "density", f"p(t) [1/{unit.name.removesuffix('s') or 's'}]"),
    ):
        axes.set_title(title)
        axes.set_ylabel(label)
        if axes is not survival:
            _limit(axes, logarithmic)
    survival.set_ylim(0.0, 1.04)


def _limit(axes: Axes, logarithmic: bool) -> None:
    """Heights that show the curves and cut their poles."""
    heights = np.concatenate([np.asarray(line.get_ydata(), dtype=np.float64) for line in axes.lines])
    heights = heights[np.isfinite(heights) & (heights > 0.0)]
    if len(heights) == 0:
        axes.set_ylim(0.0, 1.0)
        return
    highest = float(heights.max())
    if logarithmic:
        axes.set_yscale("log")
        lowest = max(float(heights.min()), highest * 10.0**-_DECADES)
        axes.set_ylim(0.5 * lowest, 2.0 * max(highest, 2.0 * lowest))
        return
    typical = float(np.quantile(heights, 0.98))
    axes.set_ylim(0.0, 1.08 * (highest if highest < 5.0 * typical else 2.0 * typical))


def _legend(name: str, prior: LifetimePrior) -> str:
    stay = prior.p_never_leaves
    return f"{name} ({100.0 * stay:.3g} % never leave)" if stay else name


def _times(priors: Iterable[LifetimePrior], until_s: float | None, log_time: bool | None) -> tuple[FloatArray, bool]:
    """Return the times to draw at, and whether their axis is logarithmic.

    Raises:
        ConfigError: a time that is not positive.
    """
    if until_s is not None and not 0.0 < until_s < math.inf:
        raise ConfigError(f"a time must be positive and finite, not {until_s!r}", field="until_s")
    priors = list(priors)
    last_s = until_s or _quantile(priors, 0.95, max)
    first_s = max(_quantile(priors, 0.05, min), 1e-6 * last_s)
    logarithmic = log_time if log_time is not None else last_s > _WIDE * first_s
    if logarithmic:
        return np.geomspace(min(first_s, 1e-2 * last_s), last_s, _POINTS), True
    return np.linspace(0.0, last_s, _POINTS), False


def _quantile(priors: Iterable[LifetimePrior], p: float, choose: Callable[[list[float]], float]) -> float:
    """Of those that leave at all; a day where none do."""
    times = [float(prior.quantile(p * (1.0 - prior.p_never_leaves))) for prior in priors if prior.p_never_leaves < 1.0]
    finite = [time for time in times if 0.0 < time < math.inf]
    return choose(finite) if finite else 86400.0


def _styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Colour and dashes by name; a class has the colour that it has in every figure."""
    rank = {name: k for k, name in enumerate(sorted(filter(None, names)))}
    return {
        name: {"color": look.colour, "ls": _DASHES[rank.get(name, 0) // len(CLASS_COLOURS) % len(_DASHES)]}
        for name, look in class_looks(names).items()
    }


def _finite(values: Any) -> FloatArray:
    """Points of infinite height are left out."""
    return np.where(np.isfinite(values), values, np.nan)


def plot_survival(
    estimates: Mapping[str, Estimate],
    *,
    truth: LifetimePrior | None = None,
    until_s: float | None = None,
    log_time: bool | None = None,
    title: str | None = None,
) -> Figure:
    """Draw `P(T > t)` as one or several estimators have it, with 95 % bands where they know them.

    A nonparametric estimate of intervals says nothing of how its mass is spread within a cell: there its survival
    function is anywhere in a grey box.

    Args:
        estimates: by the names for the legend.
        truth: the lifetime that the samples were drawn from, where it is known.
        until_s: end of the axis in seconds; left out, when all but a twentieth have gone.
        log_time: a logarithmic axis of time; left out, where lifetimes span more than three decades.
        title: above the figure.

    Raises:
        ConfigError: nothing to draw, or a time that is not positive.
    """
    if not estimates:
        raise ConfigError("no survival function to draw", field="estimates")
    priors = [*map(_prior, estimates.values()), *([truth] if truth is not None else [])]
    time_s, logarithmic = _times(priors, until_s, log_time)
    unit = unit_for(float(time_s[-1]))
    styles = _styles(estimates)
    with drawing(6.4, 3.8, title=title) as figure:
        axes = figure.subplots()
        for name, one in estimates.items():
            _draw_estimate(axes, one, legend_name(name), time_s, unit, styles[name])
        for again in [box for box in axes.collections if box.get_label() == _BOX][1:]:
            again.set_label("")
        if truth is not None:
            true = np.exp(truth.log_survival(time_s))
            axes.plot(time_s / unit.seconds, true, color=INK, lw=1.0, ls="--", label="truth")
        axes.set(ylim=(0.0, 1.03), ylabel="P(T > t) [1]")
        label_ages(axes, time_s, unit, logarithmic=logarithmic)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def _draw_estimate(
    axes: Axes, one: Estimate, name: str, time_s: FloatArray, unit: TimeUnit, style: dict[str, Any]
) -> None:
    x = time_s / unit.seconds
    if isinstance(one, Npmle):
        corners = _corners(one, time_s)
        lower, upper = one.survival(corners)
        at = corners / unit.seconds
        axes.fill_between(at, lower, upper, color=MUTED, alpha=0.35, lw=0, label=_BOX)
        # outside the boxes both bounds agree
        axes.plot(at, np.where(lower == upper, lower, np.nan), lw=1.4, label=name, **style)
        return
    mean, band = _curve(one, time_s)
    if band is not None:
        axes.fill_between(x, *band, color=style["color"], alpha=0.2, lw=0)
    axes.plot(x, mean, label=name, **style)


def _curve(one: Estimate, time_s: FloatArray) -> tuple[FloatArray, tuple[FloatArray, FloatArray] | None]:
    """Survival function, and its 95 % band where it is known."""
    match one:
        case KaplanMeier():
            return one.survival(time_s), one.band(time_s)
        case ParametricFit():
            return np.exp(one.prior.log_survival(time_s)), one.band(time_s)
        case HazardDraws() | HazardPosterior():
            mean, lower, upper = one.survival(time_s)
            return mean, (lower, upper)
        case _:
            return np.exp(one.log_survival(time_s)), None  # type: ignore[union-attr]


def _corners(one: Npmle, time_s: FloatArray) -> FloatArray:
    """Both sides of every end of a cell, within the axis."""
    ends = np.concatenate([one.support_left, one.support_right])
    ends = ends[np.isfinite(ends) & (ends > time_s[0]) & (ends < time_s[-1])]
    return np.unique(np.concatenate([time_s[[0, -1]], np.nextafter(ends, 0.0), ends, np.nextafter(ends, np.inf)]))


def _prior(one: Estimate) -> LifetimePrior:
    match one:
        case Npmle() | KaplanMeier() | HazardDraws() | HazardPosterior():
            return one.prior()
        case ParametricFit():
            return one.prior
        case _:
            return one
