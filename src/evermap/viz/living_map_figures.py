"""Figures of a living map: the map from above, and the history of one landmark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.errors import InputError, printable
from evermap.types import UNKNOWN, BoolArray, Clock, FloatArray, IntArray
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    GROUP,
    INK,
    LANDMARK,
    MUTED,
    ODOMETRY,
    ONLINE,
    PAPER,
    house_style,
    legend_name,
    new_figure,
    settle,
)
from evermap.viz.time_axis import TimeAxis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = (LANDMARK, ESTIMATE, ODOMETRY, GROUP, ONLINE)
_MARKERS = ("o", "s", "^", "D")
_MAX_LABELS = 60


def plot_living_map(
    landmark_id: IntArray,
    place: IntArray,
    p_exists: FloatArray,
    class_id: IntArray,
    class_names: tuple[str, ...],
    pinned: BoolArray,
    deleted: BoolArray,
    position_m: FloatArray,
    place_landmark: IntArray,
    *,
    title: str,
) -> Figure:
    """Landmarks at their most probable places, the fainter the less they exist; their other places as small dots.

    Args:
        landmark_id: (L,) sorted.
        place: (L,) row of the place of each, -1 for none.
        p_exists: (L,) probability.
        class_id: (L,) class, or `UNKNOWN`.
        class_names: names of the classes, for the legend.
        pinned: (L,) marked by a ring.
        deleted: (L,) left out.
        position_m: (P, 2) of all places.
        place_landmark: (P,) whose place each is.
        title: above the axes.

    Raises:
        InputError: there is nothing to draw.
    """
    shown = np.flatnonzero((place >= 0) & ~deleted)
    if not len(shown):
        raise InputError("nothing to draw: the map has no landmark")
    at = position_m[place[shown]]
    low, high = position_m.min(axis=0), position_m.max(axis=0)
    size = np.maximum(high - low, 1.0)
    with house_style():
        figure = new_figure(7.2, float(np.clip(6.4 * size[1] / size[0], 2.4, 7.5)) + 1.0)
        axes = figure.add_subplot()
        earlier = ~np.isin(np.arange(len(position_m)), place[shown]) & np.isin(place_landmark, landmark_id[shown])
        for row in np.flatnonzero(earlier):
            now = at[np.searchsorted(landmark_id[shown], place_landmark[row])]
            axes.plot(*np.stack([position_m[row], now]).T, color=MUTED, lw=0.5, alpha=0.5, zorder=1)
        if earlier.any():
            axes.plot(*position_m[earlier].T, ".", color=MUTED, ms=4, zorder=2, label="other known place")
        there = p_exists[shown] >= 0.5
        for k, name in enumerate(np.unique(class_id[shown])):
            label = legend_name(class_names[name]) if 0 <= name < len(class_names) else "class not known"
            colour = INK if name == UNKNOWN else _COLOURS[k % len(_COLOURS)]
            mine = (class_id[shown] == name) & there
            if mine.any():
                alpha = np.clip(p_exists[shown][mine], 0.25, 1.0)
                x, y = at[mine].T
                shape = _MARKERS[k // len(_COLOURS) % len(_MARKERS)]
                axes.scatter(x, y, s=34, color=colour, marker=shape, alpha=alpha, lw=0, zorder=4, label=label)
        if not there.all():
            axes.plot(*at[~there].T, "x", color=ALERT, ms=5, mew=1.1, zorder=3, label="believed gone")
        if pinned[shown].any():
            axes.plot(*at[pinned[shown]].T, "o", mfc="none", mec=INK, ms=10, mew=1.0, zorder=5, label="pinned")
        if len(shown) <= _MAX_LABELS:
            for point, name in zip(at, landmark_id[shown], strict=True):
                axes.annotate(
                    str(name), point, xytext=(5, 4), textcoords="offset points", fontsize=7.5, color=INK, zorder=6,
                    bbox={"facecolor": PAPER, "alpha": 0.6, "edgecolor": "none", "pad": 0.5},
                )  # fmt: skip
        margin = 0.06 * float(size.max())
        axes.set(
            xlim=(low[0] - margin, high[0] + margin),
            ylim=(low[1] - margin, high[1] + margin),
            aspect="equal",
            xlabel="x [m]",
            ylabel="y [m]",
            title=printable(title),
        )
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5)
        settle(figure)
    return figure


_WORDS = 10.0
"""Room for words beyond the bars, as a factor on a logarithmic axis."""
_MAX_WORDS = 6
"""More sessions than this have no room for words."""


def plot_why(
    stamp_s: FloatArray,
    p_exists: FloatArray,
    n_hits: IntArray,
    n_misses: IntArray,
    log_odds: FloatArray,
    *,
    session: IntArray,
    stays: Sequence[tuple[str, float, float, float, float]],
    now_s: float,
    title: str,
    clock: Clock = Clock.RECORDING,
) -> Figure:
    """Three rows over one axis of time: belief, evidence of every session, stays.

    Args:
        stamp_s: (N,) of the looks, never decreasing.
        p_exists: (N,) after each.
        n_hits: (N,) detections.
        n_misses: (N,) expected detections that did not come.
        log_odds: (N,) what each said for 'it stands there' [nats].
        session: (N,) number of the session of each look.
        stays: name of the site, last look before, first and last sighting, first look after, as in `maps.Stays`.
        now_s: end of the axis.
        title: above the axes.
        clock: of the stamps.

    Raises:
        InputError: nothing was looked at and it never stood anywhere.
    """
    edges = [value for stay in stays for value in stay[1:] if np.isfinite(value)]
    known = np.concatenate([stamp_s, edges, [now_s] if np.isfinite(now_s) else []])
    if not len(known):
        raise InputError("nothing to draw: no session looked at it")
    first, last = float(known.min()), float(known.max())
    margin = 0.02 * max(last - first, 1.0)
    axis = TimeAxis.over(first, last + margin, clock)
    sites = list(dict.fromkeys(name for name, *_ in stays))
    with house_style():
        figure = new_figure(7.2, 3.9 + 0.22 * len(sites))
        rows = figure.subplots(3, 1, sharex=True, height_ratios=[2.0, 1.6, 0.5 + 0.35 * max(len(sites), 1)])
        _draw_belief(rows[0], axis, stamp_s, p_exists, session, now_s)
        _draw_evidence(rows[1], axis, stamp_s, n_hits, n_misses, log_odds, session)
        _draw_stays(rows[2], axis, stays, sites, last)
        rows[0].set_title(printable(title))
        rows[2].set_xlim(axis.coordinates(first - margin), axis.coordinates(last + margin))
        axis.label(rows[2])
        known_labels = {
            label: handle for axes in rows for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(known_labels.values(), known_labels.keys(), loc="outside lower center", ncols=3)
        settle(figure)
    return figure


def _draw_belief(
    axes: Axes, axis: TimeAxis, stamp_s: FloatArray, p_exists: FloatArray, session: IntArray, now_s: float
) -> None:
    """A line within every session, a thin one between sessions, where nobody looked."""
    for k, rows in enumerate(_sessions(session)):
        label = "P(exists)" if k == 0 else None
        axes.plot(axis.coordinates(stamp_s[rows]), p_exists[rows], color=ESTIMATE, lw=1.8, zorder=4, label=label)
    if len(stamp_s):
        axes.plot(axis.coordinates(stamp_s), p_exists, color=ESTIMATE, lw=0.7, alpha=0.6, zorder=3)
        axes.plot(axis.coordinates(stamp_s[-1:]), p_exists[-1:], "o", color=ESTIMATE, ms=4.0, zorder=5)
    axes.axhline(0.5, color=MUTED, lw=0.8, ls=(0, (3, 2)), zorder=2)
    if np.isfinite(now_s):
        axes.axvline(axis.coordinates(now_s), color=INK, lw=0.9, ls=(0, (4, 2)), zorder=2, label="now")
    axes.set(ylim=(-0.05, 1.05), yticks=(0.0, 0.5, 1.0), ylabel="P(exists) [1]")


def _draw_evidence(
    axes: Axes,
    axis: TimeAxis,
    stamp_s: FloatArray,
    n_hits: IntArray,
    n_misses: IntArray,
    log_odds: FloatArray,
    session: IntArray,
) -> None:
    """What every session said, upwards for and downwards against, with its hits and misses written to it."""
    for rows in _sessions(session):
        said = float(log_odds[rows].sum())
        at = axis.coordinates(stamp_s[rows].mean())
        axes.vlines(at, 0.0, said, color=LANDMARK if said >= 0.0 else ALERT, lw=3.0, zorder=3)
    for colour, label in ((LANDMARK, "a session speaks for it"), (ALERT, "a session speaks against it")):
        axes.plot([], [], "-", color=colour, lw=3.0, label=label)
    groups = _sessions(session)
    if len(groups) <= _MAX_WORDS:
        for k, rows in enumerate(groups):
            said = float(log_odds[rows].sum())
            axes.annotate(
                f"{int(n_hits[rows].sum())} hits, {int(n_misses[rows].sum())} misses",
                (axis.coordinates(stamp_s[rows].mean()), said),
                xytext=(0, 3 if said >= 0.0 else -3),
                textcoords="offset points",
                ha="left" if k == 0 else "right" if k == len(groups) - 1 else "center",
                va="bottom" if said >= 0.0 else "top",
                fontsize=8,
                color=MUTED,
            )
    axes.axhline(0.0, color=MUTED, lw=0.7, zorder=2)
    said_all = [float(log_odds[rows].sum()) for rows in groups]
    high, low = _decade(max([*said_all, 1.0])), 0.0 - _decade(-min([*said_all, 0.0]))
    axes.set_yscale("symlog", linthresh=10.0)
    ticks = sorted({low, 0.0, high})
    axes.set_yticks(ticks)
    axes.set_yticklabels([f"{value:,.0f}" for value in ticks])
    axes.minorticks_off()
    axes.set_ylim(_WORDS * low if low else -3.0, _WORDS * high)
    axes.set_ylabel("evidence [nats]")


def _decade(nats: float) -> float:
    """The power of ten from 10 on that holds so much; 0 for nothing."""
    return 0.0 if nats <= 0.0 else max(10.0, 10.0 ** math.ceil(math.log10(nats)))


def _draw_stays(
    axes: Axes,
    axis: TimeAxis,
    stays: Sequence[tuple[str, float, float, float, float]],
    sites: Sequence[str],
    last_s: float,
) -> None:
    """A bar from the first to the last sighting; thin lines for when it may have come and gone; an arrow goes on."""
    for k, (name, elsewhere, first, until, gone) in enumerate(stays):
        y = sites.index(name)
        label = "" if k else "seen at the site"
        axes.hlines(y, axis.coordinates(first), axis.coordinates(until), color=LANDMARK, lw=6.0, zorder=3, label=label)
        axes.plot(axis.coordinates(np.array([first, until])), [y, y], "s", color=LANDMARK, ms=6.0, mew=0.0, zorder=3)
        if np.isfinite(elsewhere):
            axes.hlines(y, axis.coordinates(elsewhere), axis.coordinates(first), color=MUTED, lw=1.0, zorder=2)
        if np.isfinite(gone):
            axes.hlines(y, axis.coordinates(until), axis.coordinates(gone), color=MUTED, lw=1.0, zorder=2)
            axes.plot(axis.coordinates(gone), y, "x", color=ALERT, ms=5.0, mew=1.4, zorder=4)
        else:
            axes.hlines(y, axis.coordinates(until), axis.coordinates(last_s), color=LANDMARK, lw=1.0, zorder=2)
            axes.plot(axis.coordinates(last_s), y, ">", color=LANDMARK, ms=4.0, zorder=4)
    if any(np.isfinite(stay[4]) for stay in stays):
        axes.plot([], [], "x", color=ALERT, ms=5.0, mew=1.4, label="found gone")
    axes.set(ylim=(len(sites) - 0.4 if sites else 1.0, -0.6), yticks=range(len(sites)))
    axes.set_yticklabels(sites)
    axes.grid(visible=False, axis="y")


def _sessions(session: IntArray) -> list[Any]:
    """Rows of each session, in order."""
    return [np.flatnonzero(session == number) for number in dict.fromkeys(session.tolist())]
