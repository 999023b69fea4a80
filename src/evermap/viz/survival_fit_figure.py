"""Survival functions learned from data, with what is not known of them; and lifetimes on the ground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from evermap.errors import ConfigError
from evermap.survival.base import LifetimePrior
from evermap.survival.hazard_regression import HazardDraws
from evermap.survival.kaplan_meier import KaplanMeier
from evermap.survival.parametric_fit import ParametricFit
from evermap.survival.pooling import Chunk
from evermap.survival.turnbull import Npmle
from evermap.types import FloatArray
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    GROUP,
    INK,
    LANDMARK,
    MUTED,
    ODOMETRY,
    house_style,
    legend_name,
    new_figure,
    settle,
)
from evermap.viz.time_axis import DURATIONS, TimeUnit, label_durations, unit_for

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Estimate = Npmle | KaplanMeier | ParametricFit | HazardDraws | LifetimePrior

_COLOURS = (ESTIMATE, ALERT, LANDMARK, ODOMETRY, GROUP)
_DASHES = ("-", "--", ":")
_BOX = "anywhere in a box"
_POINTS = 1201
_WIDE = 1e3
"""A ratio of the end of the axis to early lifetimes from which time is logarithmic."""


def plot_survival(
    estimates: Mapping[str, Estimate],
    *,
    truth: LifetimePrior | None = None,
    until_s: float | None = None,
    log_time: bool | None = None,
    title: str | None = None,
) -> Figure:
    """`P(T > t)` as one or several estimators have it, with 95 % bands where they know them.

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
    if until_s is not None and not 0.0 < until_s < np.inf:
        raise ConfigError(f"a time must be positive and finite, not {until_s!r}", field="until_s")
    priors = [*(_prior(one) for one in estimates.values()), *([truth] if truth is not None else [])]
    last_s = until_s or max(_finite_quantile(prior, 0.95) for prior in priors)
    first_s = max(min(_finite_quantile(prior, 0.05) for prior in priors), 1e-6 * last_s)
    logarithmic = log_time if log_time is not None else last_s > _WIDE * first_s
    time_s = np.geomspace(min(first_s, 1e-2 * last_s), last_s, _POINTS) if logarithmic else _even(last_s)
    unit = unit_for(last_s)
    with house_style():
        figure = new_figure(6.4, 3.8)
        axes = figure.subplots()
        for k, (name, one) in enumerate(estimates.items()):
            _draw(
                axes,
                one,
                legend_name(name),
                time_s,
                unit,
                _COLOURS[k % len(_COLOURS)],
                _DASHES[k // len(_COLOURS) % len(_DASHES)],
            )
        _name_boxes_once(axes)
        if truth is not None:
            axes.plot(
                time_s / unit.seconds, np.exp(truth.log_survival(time_s)), color=INK, lw=1.0, ls="--", label="truth"
            )
        axes.set(ylim=(0.0, 1.03), ylabel="P(T > t) [1]")
        if logarithmic:
            label_durations(axes, float(time_s[0]), last_s, unit)
        else:
            axes.set(xlim=(0.0, last_s / unit.seconds), xlabel=f"time since first seen [{unit.name}]")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        if title:
            figure.suptitle(title, fontweight="bold")
        settle(figure)
    return figure


def plot_chunks(
    chunks: Sequence[Chunk], size_m: float, hazards: Sequence[HazardDraws], *, title: str | None = None
) -> Figure:
    """Two maps of square chunks: until when half have gone, and how uncertain that is.

    The uncertainty is the factor between the bounds of the 95 % band of the median lifetime.

    Args:
        chunks: columns and rows.
        size_m: side of a chunk.
        hazards: of each chunk, as `PooledHazard.at` gives them.
        title: above the figure.

    Raises:
        ConfigError: no chunk, or not as many hazards.
    """
    if not len(chunks) == len(hazards) > 0:
        raise ConfigError(f"{len(chunks)} chunks need as many hazards, at least one", field="hazards")
    median, lower, upper = np.array([one.quantile(0.5) for one in hazards]).T
    with house_style():
        figure = new_figure(7.2, 3.8)
        left, right = figure.subplots(1, 2, sharex=True, sharey=True)
        _map(left, chunks, size_m, median, "half have gone after", durations=True)
        _map(right, chunks, size_m, upper / lower, "upper over lower bound [1]", durations=False)
        left.set_ylabel("y [m]")
        if title:
            figure.suptitle(title, fontweight="bold")
        settle(figure)
    return figure


def _draw(axes: Axes, one: Estimate, name: str, time_s: FloatArray, unit: TimeUnit, colour: str, dashes: str) -> None:
    x = time_s / unit.seconds
    match one:
        case Npmle():
            corners = _corners(one, time_s)
            lower, upper = one.survival(corners)
            at = corners / unit.seconds
            axes.fill_between(at, lower, upper, color=MUTED, alpha=0.35, lw=0, label=_BOX)
            # outside the boxes both bounds agree
            axes.plot(at, np.where(lower == upper, lower, np.nan), color=colour, ls=dashes, lw=1.4, label=name)
        case KaplanMeier():
            lower, upper = one.band(time_s)
            axes.fill_between(x, lower, upper, color=colour, alpha=0.2, lw=0)
            axes.plot(x, one.survival(time_s), color=colour, ls=dashes, label=name)
        case ParametricFit():
            lower, upper = one.band(time_s)
            axes.fill_between(x, lower, upper, color=colour, alpha=0.2, lw=0)
            axes.plot(x, np.exp(one.prior.log_survival(time_s)), color=colour, ls=dashes, label=name)
        case HazardDraws():
            mean, lower, upper = one.survival(time_s)
            axes.fill_between(x, lower, upper, color=colour, alpha=0.2, lw=0)
            axes.plot(x, mean, color=colour, ls=dashes, label=name)
        case _:
            axes.plot(x, np.exp(one.log_survival(time_s)), color=colour, ls=dashes, label=name)


def _name_boxes_once(axes: Axes) -> None:
    boxes = [drawn for drawn in axes.collections if drawn.get_label() == _BOX]
    for drawn in boxes[1:]:
        drawn.set_label("")


def _corners(one: Npmle, time_s: FloatArray) -> FloatArray:
    """Both sides of every end of a cell, within the axis."""
    ends = np.concatenate([one.support_left, one.support_right])
    ends = ends[np.isfinite(ends) & (ends > time_s[0]) & (ends < time_s[-1])]
    return np.unique(np.concatenate([time_s[[0, -1]], np.nextafter(ends, 0.0), ends, np.nextafter(ends, np.inf)]))


def _map(
    axes: Axes, chunks: Sequence[Chunk], size_m: float, values: FloatArray, label: str, *, durations: bool
) -> None:
    from matplotlib.collections import PatchCollection
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Rectangle

    squares = [Rectangle((x * size_m, y * size_m), size_m, size_m) for x, y in chunks]
    low, high = float(values.min()), float(values.max())
    # a colour bar needs some length
    norm = LogNorm(min(low, 0.9 * high), max(high, 1.1 * low))
    drawn = PatchCollection(squares, cmap="cividis", norm=norm, edgecolor="white", linewidth=0.5)
    drawn.set_array(values)
    axes.add_collection(drawn)
    axes.autoscale_view()
    axes.set(aspect="equal", xlabel="x [m]")
    axes.set_title(label)
    axes.grid(visible=False)
    ticks = _duration_ticks(low, high) if durations else _plain_ticks(low, high)
    bar = axes.figure.colorbar(drawn, ax=axes, location="bottom", shrink=0.9, aspect=30)
    bar.minorticks_off()
    bar.set_ticks([value for _, value in ticks], labels=[name for name, _ in ticks])


def _duration_ticks(low_s: float, high_s: float) -> list[tuple[str, float]]:
    """Whole durations in sight; where there is hardly one, a few numbers in the unit that suits."""
    ticks = [(name, value) for name, value in DURATIONS if low_s <= value <= high_s]
    if len(ticks) >= 3:
        return ticks
    unit = unit_for(high_s)
    return [(f"{value / unit.seconds:.2g} {unit.name}", value) for value in np.geomspace(low_s, high_s, 4).tolist()]


def _plain_ticks(low: float, high: float) -> list[tuple[str, float]]:
    return [(f"{value:.2g}", value) for value in np.geomspace(low, high, 4).tolist()]


def _even(last_s: float) -> FloatArray:
    return np.linspace(0.0, last_s, _POINTS)


def _prior(one: Estimate) -> LifetimePrior:
    match one:
        case Npmle() | KaplanMeier() | HazardDraws():
            return one.prior()
        case ParametricFit():
            return one.prior
        case _:
            return one


def _finite_quantile(prior: LifetimePrior, p: float) -> float:
    """Of those that leave at all; a day where none do."""
    time = float(prior.quantile(p * (1.0 - prior.p_never_leaves)))
    return time if 0.0 < time < np.inf else 86400.0
