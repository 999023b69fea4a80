"""The plan of an audited map: what is right, what is wrong, with arrows; and each fault close up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from evermap.geometry import se3
from evermap.types import FloatArray
from evermap.viz.map_figure import LABELS_UP_TO
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    GROUP,
    INK,
    LANDMARK,
    MUTED,
    ODOMETRY,
    PAPER,
    NamedFigure,
    drawing,
    label_points,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = {
    "wrong": ALERT, "stale": ODOMETRY, "exchanged": GROUP, "gone": INK, "missing": ESTIMATE, "undecided": ODOMETRY,
    "unseen": MUTED, "right": LANDMARK,
}  # fmt: skip
_MARKS = {"gone": "x", "missing": "P", "undecided": "s", "unseen": "o", "right": "o"}
_MEANING = {
    "wrong": "elsewhere since the first drive", "stale": "moved since it was right",
    "exchanged": "in each other's place", "gone": "looked for, not there", "missing": "not in the map",
    "undecided": "undecided", "unseen": "never looked at", "right": "where the map has it",
}  # fmt: skip
_CLOSE_UPS, _A_ROW = 8, 4
_LEAST_HALF_M = 0.25
"""Half the side of a close-up, at least."""
_MOST_PATH = 4000
_LEAST_FACE_RAD = 0.05
"""Turn about its own axis from which a tag is drawn as it is seen."""


class PlanEntry(NamedTuple):
    """An entry as it is drawn.

    Attributes:
        label: its number or name.
        state: one of the states of an audit.
        before_m, after_m: (D,) where the map has it, and where it is; nan where that is not known.
        covariance_m2: (D, D) of the latter.
        before_turn, after_turn: quaternions (4,), or None.
        text: of the close-up.
    """

    label: str
    state: str
    before_m: FloatArray
    after_m: FloatArray
    covariance_m2: FloatArray
    before_turn: FloatArray | None
    after_turn: FloatArray | None
    text: str


def draw_audit(entries: Sequence[PlanEntry], paths: Sequence[FloatArray], title: str) -> NamedFigure:
    """Draw a map from above with what is wrong in it, and close-ups of what moved, turned or was exchanged.

    Args:
        entries: of the map, faults first.
        paths: (N, D) where each drive went.
        title: of the figure.
    """
    close = [one for one in entries if one.state in ("wrong", "stale") and np.isfinite(one.after_m).all()]
    close = close[:_CLOSE_UPS]
    rows = math.ceil(len(close) / _A_ROW)
    every = np.array([one.before_m[:2] for one in entries] + [one.after_m[:2] for one in entries])
    every = np.concatenate([every[np.isfinite(every).all(axis=1)], *(path[:, :2] for path in paths)])
    near = [one.state != "unseen" for one in entries]
    need = np.array(
        [at[:2] for one, kept in zip(entries, near, strict=True) if kept for at in (one.before_m, one.after_m)]
    )
    need = np.concatenate(
        [need.reshape(-1, 2)[np.isfinite(need.reshape(-1, 2)).all(axis=1)], *(p[:, :2] for p in paths)]
    )
    need = need if len(need) else every  # no drive could be trusted: nothing was seen
    low, high = need.min(axis=0), need.max(axis=0)
    inside = (every >= low - 0.5 * (high - low) - 1.0) & (every <= high + 0.5 * (high - low) + 1.0)
    every = every[inside.all(axis=1)]
    low, high = every.min(axis=0), every.max(axis=0)
    span = high - low + 1.0
    plan_in = float(np.clip(8.6 * span[1] / span[0], 2.4, 5.6))
    with drawing(9.0, plan_in + 0.9 + 2.3 * rows) as figure:
        grid = figure.add_gridspec(1 + rows, _A_ROW, height_ratios=[plan_in + 0.5, *[2.1] * rows])
        plan = figure.add_subplot(grid[0, :])
        _draw_plan(plan, entries, paths, (low, high))
        for k, one in enumerate(close):
            _draw_close_up(figure.add_subplot(grid[1 + k // _A_ROW, k % _A_ROW]), one)
        handles, labels = plan.get_legend_handles_labels()
        rank = [[*_COLOURS, "drives"].index(label.split(" (")[0]) for label in labels]
        order = np.argsort(rank, kind="stable").tolist()
        figure.legend([handles[k] for k in order], [labels[k] for k in order], loc="outside upper center", ncols=3)
    caption = (
        "The map from above, in its own frame. Arrows lead from where the map has an entry to where it is; bent ones "
        "join entries that stand in each other's place. Below, what moved or turned, close up: the diamond is the map, "
        "the solid dot is where it stands, with its 2σ ellipse; lines show to where a tag faces, "
        "and in the corner is how it is turned about its normal, viewed from the front."
    )
    return NamedFigure("audit", figure, title, caption)


def _draw_plan(
    axes: Axes, entries: Sequence[PlanEntry], paths: Sequence[FloatArray], corners: tuple[FloatArray, FloatArray]
) -> None:
    from matplotlib.patches import FancyArrowPatch

    for k, path in enumerate(paths):
        thin = path[:: max(1, len(path) // _MOST_PATH), :2]
        axes.plot(*thin.T, color=MUTED, lw=0.7, alpha=0.45, label="drives" if k == 0 else None, zorder=1)
    for state in reversed(_COLOURS):
        mine = [one for one in entries if one.state == state]
        if not mine:
            continue
        colour, moved = _COLOURS[state], state in ("wrong", "stale", "exchanged")
        before = np.array([one.before_m[:2] for one in mine])
        after = np.array([one.after_m[:2] for one in mine])
        at = np.where(np.isfinite(before), before, after)
        look: dict[str, Any] = {"marker": "D" if moved else _MARKS[state], "color": colour, "ls": "", "zorder": 6}
        look |= {"mfc": PAPER if moved or state in ("unseen", "undecided") else colour, "ms": 4.5, "mew": 1.0}
        look |= {"ms": 7.0, "mew": 1.8, "zorder": 8} if state in ("gone", "missing") else {}
        axes.plot(*at.T, label=f"{state} ({len(mine)}): {_MEANING[state]}", **look)
        if moved:
            axes.plot(*after.T, "o", color=colour, ms=3.5, zorder=7)
        least = 0.008 * float(np.max(corners[1] - corners[0]))
        for start, end in zip(before, after, strict=True) if moved else ():
            if np.linalg.norm(end - start) < least:
                axes.plot(*start, "o", mfc="none", mec=colour, ms=11.0, mew=1.0, zorder=6)
                continue
            way = "arc3,rad=0.2" if state == "exchanged" else "arc3"
            axes.add_patch(FancyArrowPatch(
                (start[0], start[1]), (end[0], end[1]), arrowstyle="-|>", connectionstyle=way, mutation_scale=9.0,
                shrinkA=2.0, shrinkB=2.0, color=colour, lw=1.4, zorder=9,
            ))  # fmt: skip
    outside = sum(not _is_inside(one, corners) for one in entries)
    if outside:
        axes.text(0.995, 0.02, f"{outside} unseen farther away", transform=axes.transAxes, ha="right", color=MUTED)
    named = [one for one in entries if one.state != "right"] if len(entries) > LABELS_UP_TO else list(entries)
    faults = [one for one in named if one.state not in ("right", "unseen")] if len(named) > LABELS_UP_TO else named
    faults = [one for one in faults if _is_inside(one, corners)]
    points = [np.where(np.isfinite(one.before_m), one.before_m, one.after_m)[:2] for one in faults]
    label_points(axes, points, [one.label for one in faults])
    (low, high), pad = corners, 0.06 * float(np.max(corners[1] - corners[0])) + 0.3
    axes.set_xlim(low[0] - pad, high[0] + pad)
    axes.set_ylim(low[1] - pad, high[1] + pad)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def _is_inside(one: PlanEntry, corners: tuple[FloatArray, FloatArray]) -> bool:
    at = np.where(np.isfinite(one.before_m), one.before_m, one.after_m)[:2]
    return bool(((at >= corners[0]) & (at <= corners[1])).all())


def _draw_close_up(axes: Axes, one: PlanEntry) -> None:
    """One fault from above, as large as it needs."""
    from matplotlib.patches import Ellipse, FancyArrowPatch

    colour = _COLOURS[one.state]
    before, after = one.before_m[:2], one.after_m[:2]
    value, vector = np.linalg.eigh(one.covariance_m2[:2, :2])
    sigma = np.sqrt(np.maximum(value, 0.0))
    far = float(np.linalg.norm(after - before))
    half = max(_LEAST_HALF_M, 0.75 * far + 0.1, 3.0 * float(sigma[-1]))
    middle = 0.5 * (before + after)
    tick = 0.3 * half
    for at, turn, dashed in ((before, one.before_turn, True), (after, one.after_turn, False)):
        facing = None if turn is None else se3.rotation_of(np.append(np.zeros(3), turn))[:2, 2]
        if facing is not None and np.linalg.norm(facing) > 0.1:
            end = at + tick * facing / np.linalg.norm(facing)
            axes.plot(
                *np.array([at, end]).T, color=INK if dashed else colour, lw=1.6, ls="--" if dashed else "-", zorder=4
            )
    _draw_face(axes, one, colour)
    axes.plot(*before, "D", mfc=PAPER, mec=INK, ms=6, mew=1.1, ls="", zorder=5)
    if far > 0.1 * half:
        axes.add_patch(FancyArrowPatch(
            (before[0], before[1]), (after[0], after[1]), arrowstyle="-|>", mutation_scale=10.0, shrinkA=4.0,
            shrinkB=3.0, color=colour, lw=1.5, zorder=6,
        ))  # fmt: skip
    angle = math.degrees(math.atan2(vector[1, 1], vector[0, 1]))
    axes.add_patch(Ellipse(
        (after[0], after[1]), 4.0 * sigma[1], 4.0 * sigma[0], angle=angle, fill=False, ec=colour, lw=0.9, zorder=5
    ))  # fmt: skip
    axes.plot(*after, "o", color=colour, ms=4.5, zorder=7)
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_aspect("equal")
    axes.set_title(one.text, fontsize=8.5)
    axes.locator_params(nbins=3)
    axes.grid(True, lw=0.5)


def _draw_face(axes: Axes, one: PlanEntry, colour: str) -> None:
    """Draw, in the corner of a close-up, how a tag is turned about its normal, viewed from the front."""
    if one.before_turn is None or one.after_turn is None:
        return
    poses = [np.append(np.zeros(3), turn) for turn in (one.before_turn, one.after_turn)]
    about = float(se3.log(se3.between(*poses))[5])
    if abs(about) < _LEAST_FACE_RAD:
        return
    square = 0.08 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1], [0, 1], [1, -1]])
    for angle, ink, dashes in ((0.0, INK, "--"), (about, colour, "-")):
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        corner = np.array([0.85, 0.85]) + square @ turn.T
        axes.plot(*corner.T, color=ink, ls=dashes, lw=1.2, transform=axes.transAxes, zorder=8)
