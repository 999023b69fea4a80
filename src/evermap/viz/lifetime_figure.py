"""Four views of lifetime priors, as in Rosen 2016 Fig. 2: hazard, cumulative hazard, survival and density."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.errors import ConfigError
from evermap.survival.base import LifetimePrior
from evermap.types import FloatArray
from evermap.viz.style import ALERT, ESTIMATE, INK, LANDMARK, ODOMETRY, ONLINE, house_style, new_figure, settle
from evermap.viz.time_axis import TimeUnit, label_durations, unit_for

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = (ESTIMATE, ALERT, LANDMARK, ONLINE, ODOMETRY, INK)
_POINTS = 2001
_WIDE = 1e3
"""A ratio of long to short lifetimes from which the axis of time is logarithmic."""
_DECADES = 7.0
"""Most decades that a logarithmic axis of rates shows."""


def plot(
    priors: Mapping[str, LifetimePrior] | LifetimePrior,
    *,
    until_s: float | None = None,
    log_time: bool | None = None,
    title: str | None = None,
) -> Figure:
    """Figure of hazard, cumulative hazard, survival and density over the time since a feature was first seen.

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
    if until_s is not None and not (math.isfinite(until_s) and until_s > 0.0):
        raise ConfigError(f"a time must be positive and finite, not {until_s!r}", field="until_s")
    first_s, last_s = _span(named.values())
    last_s = until_s or last_s
    logarithmic = log_time if log_time is not None else last_s > _WIDE * first_s
    if logarithmic:
        first_s = min(first_s, 1e-2 * last_s)
        time_s = np.geomspace(first_s, last_s, _POINTS)
    else:
        time_s = np.linspace(0.0, last_s, _POINTS)

    unit = unit_for(last_s)
    with house_style():
        figure = new_figure(7.2, 5.0)
        panels = figure.subplots(2, 2, sharex=True)
        for k, (name, prior) in enumerate(named.items()):
            style = {"color": _COLOURS[k % len(_COLOURS)], "ls": ("-", "--", ":")[k // len(_COLOURS) % 3]}
            _draw(panels, prior, _legend(name, prior), time_s, unit, style)
        _finish(panels, unit, logarithmic, time_s)
        for axes in panels[1]:
            _time_axis(axes, time_s, unit, logarithmic)
        figure.legend(*panels[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
        if title:
            figure.suptitle(title, fontweight="bold")
        settle(figure)
    return figure


def _draw(
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


def _finish(panels: Any, unit: TimeUnit, logarithmic: bool, time_s: FloatArray) -> None:
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
    if not logarithmic:
        hazard.set_xlim(0.0, time_s[-1] / unit.seconds)


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


def _time_axis(axes: Axes, time_s: FloatArray, unit: TimeUnit, logarithmic: bool) -> None:
    if logarithmic:
        label_durations(axes, float(time_s[0]), float(time_s[-1]), unit)
    else:
        axes.set_xlabel(f"time since first seen [{unit.name}]")


def _legend(name: str, prior: LifetimePrior) -> str:
    stay = prior.p_never_leaves
    if stay == 0.0:
        return name
    return f"{name} ({100.0 * stay:.3g} % never leave)"


def _span(priors: Any) -> tuple[float, float]:
    """Times by which a twentieth, and all but a twentieth, of those that leave at all have left."""
    return _quantile(priors, 0.05, min), _quantile(priors, 0.95, max)


def _quantile(priors: Any, p: float, choose: Callable[[list[float]], float]) -> float:
    times = [float(prior.quantile(p * (1.0 - prior.p_never_leaves))) for prior in priors if prior.p_never_leaves < 1.0]
    finite = [time for time in times if 0.0 < time < math.inf]
    return choose(finite) if finite else 86400.0


def _finite(values: Any) -> FloatArray:
    """Points of infinite height are left out."""
    return np.where(np.isfinite(values), values, np.nan)
