"""Changes on a plan view: where each landmark was, an arrow to where it is, one colour a group; alternatives dashed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.geometry import se2
from evermap.types import ChangeKind, FloatArray, Landmarks, MapChange, SlamResult
from evermap.viz.change_words import near_alternatives, probability, what
from evermap.viz.style import ALERT, GROUP, MUTED, ONLINE, PAPER

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

GROUP_COLOURS = (ALERT, ONLINE, GROUP)
"""One after the other; the legend tells groups of one colour apart."""
_MAX_ALTERNATIVES = 2


@dataclass(frozen=True, slots=True)
class Move:
    """One change, ready to be drawn.

    Attributes:
        change: what it is.
        before_m, after_m: (K, 2) places of its landmarks that are in the map. Two that exchanged their identities have
            not moved: `before_m` is where the other one is.
        label: for the legend.
        colour: of its group.
        alternative: belongs to another explanation than the most probable one.
    """

    change: MapChange
    before_m: FloatArray
    after_m: FloatArray
    label: str
    colour: str
    alternative: bool

    @property
    def swapped(self) -> bool:
        """Whether identities were exchanged, and nothing moved."""
        return self.change.kind is ChangeKind.SWAPPED


def moves(result: SlamResult, pose_truth_map: FloatArray) -> list[Move]:
    """What to draw of a run: its changes by time, then those of the nearest alternatives.

    Args:
        result: what came out.
        pose_truth_map: (3,) from the map's frame to that of the picture.
    """
    found = []
    for number, (change, before, after) in enumerate(_places(result.landmarks, result.changes, pose_truth_map)):
        label = f"{what(change)}, {probability(change.probability)}"
        found.append(Move(change, before, after, label, GROUP_COLOURS[number % len(GROUP_COLOURS)], alternative=False))
    for other in near_alternatives(result)[:_MAX_ALTERNATIVES]:
        for number, (change, before, after) in enumerate(_places(other.landmarks, other.changes, pose_truth_map)):
            label = f"and {what(change)}" if number else f"or: {what(change)}, {probability(other.probability)}"
            found.append(Move(change, before, after, label, MUTED, alternative=True))
    return found


def draw_moves(axes: Axes, drawn: Sequence[Move]) -> list[Artist]:
    """Diamonds where landmarks were, arrows to where they are. Returns what to put into a legend."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import FancyArrowPatch

    handles: list[Artist] = []
    for move in drawn:
        style = "--" if move.alternative else "-"
        width = 1.0 if move.alternative else 1.5
        mark: dict[str, Any] = {"marker": "D", "mfc": PAPER, "mec": move.colour, "mew": 1.1, "ms": 4.0}
        if not move.swapped:
            axes.plot(*move.before_m.T, ls="", zorder=7, **mark)
        for start, end in zip(move.before_m, move.after_m, strict=True):
            if np.array_equal(start, end):
                continue
            arrow = FancyArrowPatch(
                (start[0], start[1]),
                (end[0], end[1]),
                arrowstyle="-|>",
                connectionstyle="arc3,rad=0.15" if move.swapped else "arc3",
                mutation_scale=8.0,
                shrinkA=2.0,
                shrinkB=2.0 if move.swapped else 0.0,
                color=move.colour,
                linestyle=style,
                lw=width,
                zorder=8 if move.alternative else 9,
            )
            axes.add_patch(arrow)
        handles.append(Line2D([], [], color=move.colour, ls=style, lw=width, label=move.label, **mark))
    return handles


def _places(
    landmarks: Landmarks, changes: Sequence[MapChange], pose_truth_map: FloatArray
) -> list[tuple[MapChange, FloatArray, FloatArray]]:
    """(change, before, after) by time: undone one after the other from the last, for some landmarks move twice."""
    place = dict(zip(landmarks.landmark_id.tolist(), landmarks.position_m, strict=True))
    found = []
    by_time = sorted(changes, key=lambda change: change.stamp_to_s)
    for change in by_time[::-1]:
        ids = [identity for identity in change.landmark_ids if identity in place]
        if not ids:
            continue
        after = np.array([place[identity] for identity in ids])
        if change.kind is ChangeKind.SWAPPED:
            before = after[::-1]
        elif not np.all(np.isfinite(change.displacement_m)):  # it was nowhere before
            before = after
        else:
            before = se2.move_together(after, -np.array(change.displacement_m), -change.rotation_rad)
            place |= zip(ids, before, strict=True)
        found.append((change, se2.transform(pose_truth_map, before), se2.transform(pose_truth_map, after)))
    return found[::-1]
