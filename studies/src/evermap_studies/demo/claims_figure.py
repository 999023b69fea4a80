"""What each method tells falsely: by reason, by length of the patrol, and against its own probabilities."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from evermap.types import FloatArray
from evermap.viz.style import ALERT, ESTIMATE, GRID, INK, ODOMETRY, ONLINE, NamedFigure, house_style, new_figure, settle
from evermap_studies.demo.claims import REASONS
from evermap_studies.demo.looks import METHOD_LOOKS
from evermap_studies.demo.methods import METHODS
from evermap_studies.demo.numbers import Line, lengths_of
from evermap_studies.demo.study import Study

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TELLING = tuple(method.name for method in METHODS if not method.is_told)
"""Methods that find out by themselves what has changed."""
_REASON_COLOURS = (ALERT, ODOMETRY, ONLINE)


def draw_claims(study: Study, lines: dict[str, Line]) -> NamedFigure:
    """Three panels side by side."""
    with house_style():
        figure = new_figure(9.0, 3.3)
        reasons, lengths, sure = figure.subplots(1, 3, width_ratios=(1.15, 1.0, 1.0))
        _by_reason(reasons, lines)
        length_s = lengths_of(study)
        for name in TELLING:
            share = [_false_share(lines[name], length_s == one) for one in np.unique(length_s)]
            look = METHOD_LOOKS[name]
            lengths.plot(np.unique(length_s), share, color=look.colour, ls=look.dash, lw=look.width, marker="o", ms=3.5,
                         label=look.label, zorder=look.order)  # fmt: skip
        lengths.set_title("False, of the changes told [%]")
        lengths.set_xlabel("length of the patrol [s]")
        lengths.set_xticks(np.unique(length_s))
        lengths.set_ylim(bottom=0.0)
        lengths.legend(loc="upper center", bbox_to_anchor=(0.5, -0.25), ncols=2)
        _reliability(sure, lines["evermap"], length_s)
        settle(figure)
    caption = (
        "Left: changes that were told and had not happened, by what was told. Middle: their share of all changes told,"
        " by how long the patrol was in which they were told. Right: for evermap, the mean probability with which"
        " changes were told (hollow), and the share of them that are true (filled): the two agree where it is"
        " calibrated. n is how many were told."
    )
    return NamedFigure("demo_claims", figure, "What each method tells falsely", caption)


def _by_reason(axes: Axes, lines: dict[str, Line]) -> None:
    """Stacked bars, one a method."""
    left = np.zeros(len(TELLING))
    for row, (reason, colour) in enumerate(zip(REASONS, _REASON_COLOURS, strict=True)):
        count = np.array([float(np.sum(~c.is_true & (c.reason == row))) for c in (lines[n].claims for n in TELLING)])
        axes.barh(np.arange(len(TELLING)), count, left=left, color=colour, label=f"'{reason}'", height=0.65)
        left += count
    for row, name in enumerate(TELLING):
        axes.annotate(f" {left[row]:.0f} of {len(lines[name].claims)}", (left[row], row), va="center", fontsize=8)
    axes.set_yticks(np.arange(len(TELLING)), [METHOD_LOOKS[name].label for name in TELLING])
    axes.invert_yaxis()
    axes.set_xlim(0.0, 1.35 * max(1.0, float(left.max())))
    axes.set_title("False, by what was told")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.25), ncols=3)


def _false_share(line: Line, sessions: FloatArray) -> float:
    """In percent; nan where nothing was told."""
    rows = sessions[line.claims.session]
    return 100.0 * float(np.mean(~line.claims.is_true[rows])) if rows.any() else float("nan")


def _reliability(axes: Axes, line: Line, length_s: FloatArray) -> None:
    """Mean probability and share of true changes for every length of patrols."""
    lengths = np.unique(length_s)
    for row, length in enumerate(lengths):
        mine = (length_s == length)[line.claims.session]
        if not mine.any():
            continue
        first = not axes.lines
        stated, true = float(line.claims.probability[mine].mean()), float(line.claims.is_true[mine].mean())
        axes.plot([stated, true], [row, row], color=GRID, lw=3.0, zorder=1)
        axes.plot(stated, row, "o", mfc="none", mec=INK, ms=7, zorder=2, label="told, mean" if first else None)
        axes.plot(true, row, "o", color=ESTIMATE, ms=6, zorder=3, label="true" if first else None)
        axes.annotate(f"n = {int(mine.sum())}", (0.02, row), va="center", fontsize=8)
    axes.set_yticks(np.arange(len(lengths)), [f"{length:g} s" for length in lengths])
    axes.set_xlim(0.0, 1.03)
    axes.set_ylim(len(lengths) - 0.5, -0.5)
    axes.set_title("evermap: told and true")
    axes.set_xlabel("probability")
    if axes.lines:
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.25), ncols=2)
