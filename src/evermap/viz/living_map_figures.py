"""Figures of a living map: the map from above, and the history of one landmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.errors import InputError, printable
from evermap.geometry import se3
from evermap.geometry.upright import level_pose, move_map
from evermap.types import BoolArray, FloatArray, IntArray, Landmarks, rows_of
from evermap.viz.map_figure import GONE, LABELS_UP_TO, class_names_of, draw_ellipses, draw_gone, magnification
from evermap.viz.panels import (
    View,
    draw_footprints,
    draw_shapes,
    height_over_width,
    is_outlined,
    lay_out,
    mostly_boxes,
    seen,
)
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    INK,
    LANDMARK,
    MUTED,
    PAPER,
    SHADE,
    class_looks,
    drawing,
    label_points,
    legend_name,
    legend_of,
)
from evermap.viz.time_axis import TimeAxis

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_EXISTS = 0.5
_FAINTEST = 0.3
"""Opacity of landmarks with P(exists) 0.5; certain ones are opaque."""
_P_CLIP = 1e-3
"""Beliefs beyond this are drawn at the edge of the axis."""
_NATS_CLIP = 20.0
"""Evidence beyond this is drawn at the edge of the axis: 20 nats are odds of 500 million to one."""
_MAX_WORDS = 6
"""Maximum number of sessions with labels."""


@dataclass(frozen=True, slots=True)
class MapView:
    """Content of the figure of a living map.

    Attributes:
        landmarks: L landmarks at their most probable places, also those that are believed gone.
        pinned: (L,) marked by a ring.
        other_m: (K, 2), in space (K, 3), other places at which landmarks are known to have stood.
        other_of: (K,) row of the landmark of each.
        seen_from_m: (V, 2) middles of the floor's cells from which the robot looked.
        cell_m: side of a cell.
    """

    landmarks: Landmarks
    pinned: BoolArray
    other_m: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    other_of: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    seen_from_m: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    cell_m: float = 0.5


def plot_living_map(view: MapView, *, title: str) -> Figure:
    """Draw landmarks at their most probable places, the less probable the fainter; those believed gone are crossed out.

    Raises:
        InputError: there is nothing to draw.
    """
    up = view.landmarks.up
    view = _level_view(view)
    landmarks = view.landmarks
    if not len(landmarks):
        raise InputError("nothing to draw: the map has no landmark")
    places = np.concatenate([landmarks.position_m, *([view.other_m] if len(view.other_m) else [])])
    low, high = places.min(axis=0), places.max(axis=0)
    if len(view.seen_from_m):
        low[:2] = np.minimum(low[:2], view.seen_from_m.min(axis=0))
        high[:2] = np.maximum(high[:2], view.seen_from_m.max(axis=0))
    if mostly_boxes(landmarks):
        low, high = low[:2], high[:2]
    size = np.maximum(high - low, 1.0)
    margin = 0.05 * float(size.max())
    with drawing(7.2, float(np.clip(6.4 * height_over_width(size), 2.4, 7.5)) + 1.5) as figure:
        panels = lay_out(figure, low - margin, high + margin, up=up)
        (handles, *_) = [_draw_panel(axes, columns, view, float(size.max())) for axes, columns in panels]
        first = panels[0][0]
        first.set_title(", ".join(text for text in (printable(title), first.get_title(loc="left")) if text))
        _legend(figure, handles)
    return figure


def _level_view(view: MapView) -> MapView:
    """A view turned so that up is z; cells of the map's own x and y are then left out."""
    pose = level_pose(view.landmarks.up)
    if view.landmarks.position_m.shape[1] == 2 or not pose[:6].any():
        return view
    other = se3.transform(pose, view.other_m) if len(view.other_m) else view.other_m
    return replace(view, landmarks=move_map(view.landmarks, pose), other_m=other, seen_from_m=np.zeros((0, 2)))


def _draw_panel(axes: Axes, columns: View, view: MapView, reach_m: float) -> list[Any]:
    """Draw floor and landmarks into a panel; returns what to put into a legend."""
    landmarks = view.landmarks
    handles = [*_draw_floor(axes, columns, view), *_draw_landmarks(axes, columns, view, reach_m)]
    if len(landmarks) <= LABELS_UP_TO:
        names = landmarks.labels
        label_points(axes, landmarks.position_m[:, columns], names)
    return handles


def _draw_floor(axes: Axes, columns: View, view: MapView) -> list[Any]:
    """From where the robot looked, as seen from above, and other known places; returns what to put into a legend."""
    from matplotlib.collections import PolyCollection

    handles: list[Any] = []
    if columns == [0, 1] and len(view.seen_from_m):
        corners = 0.5 * view.cell_m * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        squares = view.seen_from_m[:, None, :] + corners
        axes.add_collection(PolyCollection(list(squares), facecolors=SHADE, edgecolors=SHADE, lw=0.4, zorder=0.5))
        handles.append(_mark("s", "sensor positions", color=SHADE, ms=7, mec="none"))
    if len(view.other_m):
        for place, now in zip(view.other_m, view.landmarks.position_m[view.other_of], strict=True):
            axes.plot(*np.stack([place, now])[:, columns].T, color=MUTED, lw=0.5, alpha=0.5, zorder=1.5)
        axes.plot(*view.other_m[:, columns].T, ".", color=MUTED, ms=4, zorder=2)
        handles.append(_mark(".", "other known place", color=MUTED, ms=4))
    return handles


def _draw_landmarks(axes: Axes, columns: View, view: MapView, reach_m: float) -> list[Any]:
    """Landmarks by class with their uncertainty; returns what to put into a legend."""
    landmarks = seen(view.landmarks, columns)
    there = landmarks.p_exists >= _EXISTS
    names = class_names_of(landmarks)
    looks = class_looks(landmarks.class_names)
    handles: list[Any] = []
    for name in sorted(set(names)):
        look, label = looks[name], legend_name(name) or "class unknown"
        mine = np.array([other == name for other in names])
        here = np.flatnonzero(mine & there & ~is_outlined(view.landmarks, reach_m))
        alpha: Any = _FAINTEST + (1.0 - _FAINTEST) * (landmarks.p_exists[here] - _EXISTS) / (1.0 - _EXISTS)
        x, y = landmarks.position_m[here].T
        if len(here):
            axes.scatter(x, y, s=36, marker=look.marker, color=look.colour, alpha=alpha, edgecolors=PAPER,
                         linewidths=0.5, zorder=4, label=label)  # fmt: skip
        handles.append(_mark(look.marker, label, color=look.colour))
    draw_gone(axes, rows_of(landmarks, ~there))
    colours = np.array([looks[name].colour for name in names])[there]
    handles.append(tuple(_mark("o", "", color=MUTED, alpha=a) for a in (_FAINTEST, 0.5 * (1.0 + _FAINTEST), 1.0)))
    if not there.all():
        hollow = _mark("o", "", mfc="none", mec=MUTED, alpha=0.6, ms=7, mew=1.1)
        handles.append((hollow, _mark("x", GONE, color=ALERT, ms=6, mew=1.1, alpha=0.8)))
    if mostly_boxes(view.landmarks):
        handles.append(draw_footprints(axes, rows_of(view.landmarks, there), colours))
    else:
        draw_shapes(axes, rows_of(view.landmarks, there), columns, colours, reach_m)
        factor = magnification(view.landmarks.covariance_m2[there], reach_m)
        label = draw_ellipses(axes, landmarks.position_m[there], landmarks.covariance_m2[there], colours, factor)
        handles.append(_mark("o", label, mfc="none", mec=MUTED, ms=7))
    if view.pinned.any():
        axes.plot(*landmarks.position_m[view.pinned].T, "o", mfc="none", mec=INK, ms=11, mew=1.0, zorder=5)
        handles.append(_mark("o", "pinned", mfc="none", mec=INK, ms=9))
    return handles


def _mark(marker: str, label: str, **style: Any) -> Artist:
    from matplotlib.lines import Line2D

    looks: dict[str, Any] = {"ls": "", "ms": 6.0, **style}
    return Line2D([], [], marker=marker, label=label, **looks)


_FAINT = "faint: P(exists) from 50 % upwards"


def _legend(figure: Figure, handles: Sequence[Any]) -> None:
    """One legend for all marks; several marks side by side say what faint means."""
    from matplotlib.legend_handler import HandlerTuple

    faint = next(one for one in handles if isinstance(one, tuple) and not one[-1].get_label())
    labels = [_FAINT if one is faint else (one[-1] if isinstance(one, tuple) else one).get_label() for one in handles]
    short = [k for k, label in enumerate(labels) if len(label) <= 16]
    order = short + [k for k in range(len(labels)) if k not in short]
    figure.legend(
        [handles[k] for k in order], [labels[k] for k in order], loc="outside lower center", ncols=3,
        handler_map={faint: HandlerTuple(ndivide=None)}, handlelength=2.6,
    )  # fmt: skip


_Stay = tuple[str, float, float, float, float]
"""Name of the site, last look before, first and last sighting, first look after."""


def plot_why(answer: Any) -> Figure:
    """Draw the `Answer` of `evermap.why` in three rows over one axis of time: belief, evidence of every session, stays.

    Raises:
        InputError: nothing was looked at and it never stood anywhere.
    """
    looks, now_s = answer.evidence, answer.stamp_s
    ends = np.cumsum([visit.n_looks for visit in answer.visits], dtype=np.int64)[:-1]
    sessions = [rows for rows in np.split(np.arange(len(looks.stamp_s)), ends) if len(rows)]
    site_id, columns = answer.stays.site_id.tolist(), ("elsewhere_s", "first_s", "last_s", "gone_s")
    names = {site: f"site {k + 1}" for k, site in enumerate(dict.fromkeys(site_id))}
    stamps = zip(*(getattr(answer.stays, column).tolist() for column in columns), strict=True)
    stays: list[_Stay] = [(names[site], *four) for site, four in zip(site_id, stamps, strict=True)]
    edges = [value for stay in stays for value in (*stay[1:], now_s) if np.isfinite(value)]
    known = np.concatenate([looks.stamp_s, edges])
    if not len(known):
        raise InputError("nothing to draw: no session looked at it")
    first, last = float(known.min()), float(known.max())
    margin = 0.02 * max(last - first, 1.0)
    axis = TimeAxis.over(first, last + margin, answer.clock)
    with drawing(7.2, 3.9 + 0.22 * len(names)) as figure:
        rows = figure.subplots(3, 1, sharex=True, height_ratios=[2.0, 1.6, 0.5 + 0.35 * max(len(names), 1)])
        _draw_belief(rows[0], axis, looks, sessions, now_s)
        _draw_evidence(rows[1], axis, looks, sessions)
        _draw_stays(rows[2], axis, stays, list(names.values()), last)
        rows[0].set_title(printable(answer.headline))
        rows[2].set_xlim(axis.coordinates(first - margin), axis.coordinates(last + margin))
        axis.label(rows[2])
        figure.legend(*legend_of(*rows), loc="outside lower center", ncols=3)
    return figure


def _draw_belief(axes: Axes, axis: TimeAxis, looks: Any, sessions: Sequence[IntArray], now_s: float) -> None:
    """A line within every session, a thin one between sessions, where there was no look; log odds as probabilities."""
    at, belief = axis.coordinates(looks.stamp_s), np.clip(looks.p_exists, _P_CLIP, 1.0 - _P_CLIP)
    axes.set_yscale("logit")
    edge = f", cut at {100 * _P_CLIP:g} % and {100 - 100 * _P_CLIP:g} %"
    label = "P(exists)" + (edge if np.any(belief != looks.p_exists) else "")
    for k, rows in enumerate(sessions):
        axes.plot(at[rows], belief[rows], color=ESTIMATE, lw=1.8, zorder=4, label="" if k else label)
    if len(at):
        axes.plot(at, belief, color=ESTIMATE, lw=0.7, alpha=0.6, zorder=3, label="between sessions")
        axes.plot(at[-1:], belief[-1:], "o", color=ESTIMATE, ms=4.0, zorder=5)
    axes.axhline(0.5, color=MUTED, lw=0.8, ls=(0, (3, 2)), zorder=2)
    if np.isfinite(now_s):
        axes.axvline(axis.coordinates(now_s), color=INK, lw=0.9, ls=(0, (4, 2)), zorder=2, label="now")
    axes.minorticks_off()
    ticks = (0.01, 0.1, 0.5, 0.9, 0.99)
    axes.set_yticks(ticks, [f"{100 * p:g} %" for p in ticks])
    axes.set(ylim=(0.6 * _P_CLIP, 1.0 - 0.6 * _P_CLIP), ylabel="P(exists)")


def _draw_evidence(axes: Axes, axis: TimeAxis, looks: Any, sessions: Sequence[IntArray]) -> None:
    """Draw the evidence of every session, upwards for and downwards against, with its hits and misses."""
    said = np.array([float(looks.log_odds[rows].sum()) for rows in sessions])
    drawn = np.clip(said, -_NATS_CLIP, _NATS_CLIP)
    at = axis.coordinates([looks.stamp_s[rows].mean() for rows in sessions])
    for side, colour, label in ((said >= 0.0, LANDMARK, "for it"), (said < 0.0, ALERT, "against it")):
        axes.vlines(at[side], 0.0, drawn[side], color=colour, lw=3.0, zorder=3)
        axes.plot([], [], "-", color=colour, lw=3.0, label=f"evidence of a session {label}")
    beyond = np.abs(said) > _NATS_CLIP
    for side, marker, colour in ((said > 0.0, "^", LANDMARK), (said < 0.0, "v", ALERT)):
        axes.plot(at[beyond & side], drawn[beyond & side], marker, color=colour, ms=6.0, zorder=4)
    if beyond.any():
        axes.plot([], [], "^", color=MUTED, ms=6.0, label=f"more than {_NATS_CLIP:g} nats")
    if len(sessions) <= _MAX_WORDS:
        hits, misses = ([int(column[rows].sum()) for rows in sessions] for column in (looks.n_hits, looks.n_misses))
        words = [f"{hit} hits, {miss} misses" for hit, miss in zip(hits, misses, strict=True)]
        label_points(axes, list(zip(at, drawn, strict=True)), words)
    axes.axhline(0.0, color=MUTED, lw=0.7, zorder=2)
    low, high = (1.6 * _NATS_CLIP if side.any() else 0.3 * _NATS_CLIP for side in (said < 0.0, said >= 0.0))
    axes.set(ylim=(-low, high), yticks=[y for y in (-_NATS_CLIP, 0.0, _NATS_CLIP) if -low < y < high])
    axes.set_ylabel("evidence [nats]")


def _draw_stays(axes: Axes, axis: TimeAxis, stays: Sequence[_Stay], sites: Sequence[str], last_s: float) -> None:
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
    for is_drawn, marker, style, label in (
        (any(np.isfinite(stay[4]) for stay in stays), "x", {"color": ALERT, "ms": 5.0, "mew": 1.4}, "found gone"),
        (any(not np.isfinite(stay[4]) for stay in stays), ">", {"color": LANDMARK, "ms": 4.0}, "the stay goes on"),
        (any(np.isfinite(stay[[1, 4][k]]) for stay in stays for k in (0, 1)), "", {"color": MUTED, "lw": 1.0},
         "arrived or left in between"),
    ):  # fmt: skip
        if is_drawn:
            axes.plot([], [], marker=marker or None, ls="" if marker else "-", label=label, **style)  # type: ignore[arg-type]
    axes.set(ylim=(len(sites) - 0.4 if sites else 1.0, -0.6), yticks=range(len(sites)))
    axes.set_yticklabels(sites)
    axes.grid(visible=False, axis="y")
