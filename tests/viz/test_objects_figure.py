"""The figure of a tracking run shows every spell, and does not pretend to know ends that nobody knows."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evermap.tracking.record import StaticSpells
from evermap.viz.plots import MOST_SPELLS, plot_track_run
from evermap.viz.style import ALERT, class_looks

HOUR_S = 3600.0


def rests(n: int) -> StaticSpells:
    """Spell k is seen from k to 2 k + 1 hours; the first has no known beginning, the last no known end."""
    hour = np.arange(n, dtype=np.float64)
    elsewhere, gone = hour - 0.5, 2.0 * hour + 1.5
    elsewhere[0], gone[-1] = -np.inf, np.inf
    place = np.stack([hour, -hour], axis=1)
    return StaticSpells(
        np.arange(n), np.arange(n) % 2, place, *(HOUR_S * h for h in (elsewhere, hour, 2.0 * hour + 1.0, gone))
    )


def figure_of(spells: StaticSpells, *, end_s: float, start_s: float = 0.0, names: tuple[str, ...] = ("a", "b")) -> Any:
    """The figure of a run with these spells, in which an object of the first class moves from (0, 0) to (1, 1)."""
    stamp_s = np.array([start_s, start_s + 1.0, end_s])
    tracks = SimpleNamespace(
        track_id=np.zeros(2, int),
        stamp_s=stamp_s[:2],
        static=np.zeros(2, bool),
        position_m=np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]),
    )
    table = SimpleNamespace(class_names=names, stamp_s=stamp_s, sensor_m=None)
    run = SimpleNamespace(table=table, spells=spells, objects=lambda: tracks, class_of_track=lambda: np.zeros(1, int))
    return plot_track_run(run)


def test_a_bar_for_each_spell_thin_where_it_can_have_come_and_gone() -> None:
    figure = figure_of(rests(3), end_s=8 * HOUR_S)
    _, bars = figure.axes
    lines = [line for line in bars.lines if line.get_linestyle() == "-" and np.size(line.get_xdata()) == 2]
    spans = sorted(
        (float(line.get_linewidth()), *(round(float(x), 6) for x in np.asarray(line.get_xdata()))) for line in lines
    )
    spans = [span for span in spans if span[1:] != (8.0, 8.0)]  # the last frame
    # gone to last for the thin lines behind, elsewhere to first for those before
    assert spans == [(0.8, 0.5, 1.0), (0.8, 1.5, 1.0), (0.8, 1.5, 2.0), (0.8, 3.5, 3.0)] + [
        (3.0, 0.0, 1.0),
        (3.0, 1.0, 3.0),
        (3.0, 2.0, 5.0),
    ]
    drawn = [line for line in bars.lines if np.size(line.get_xdata())]
    arrows = {str(line.get_marker()): float(np.asarray(line.get_xdata())[0]) for line in drawn}
    assert (arrows["<"], arrows[">"]) == pytest.approx((0.0, 5.0))


def test_of_too_many_the_longest() -> None:
    figure = figure_of(rests(MOST_SPELLS + 5), end_s=400 * HOUR_S)
    _, bars = figure.axes
    thick = [line for line in bars.lines if line.get_linewidth() == 3.0 and np.size(line.get_xdata())]
    assert len(thick) == MOST_SPELLS
    assert bars.get_title(loc="left") == f"the {MOST_SPELLS} longest of {MOST_SPELLS + 5} spells at rest"


def test_classes_have_their_look_and_what_left_is_crossed_out() -> None:
    figure = figure_of(rests(3), end_s=8 * HOUR_S, names=("b", "a"))
    above, bars = figure.axes
    looks = class_looks(("a", "b"))
    marks = {(str(line.get_marker()), str(line.get_mec()), str(line.get_mfc())): np.asarray(line.get_xydata()).tolist()
             for line in above.lines if line.get_linestyle() == "None" and np.size(line.get_xdata())}  # fmt: skip
    b, a = looks["b"], looks["a"]
    assert marks[(b.marker, b.colour, "none")] == [[0.0, 0.0]]
    assert marks[(b.marker, b.colour, b.colour)] == [[2.0, -2.0]]
    assert marks[(a.marker, a.colour, "none")] == [[1.0, -1.0]]
    assert marks[("x", ALERT, ALERT)] == [[0.0, 0.0], [1.0, -1.0]]
    (path,) = [line for line in above.lines if np.size(line.get_xdata()) == 2 and line.get_linestyle() == "-"]
    assert path.get_color() == b.colour
    assert {str(line.get_color()) for line in bars.lines if line.get_linewidth() == 3.0} >= {a.colour, b.colour}
    words = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {
        "a",
        "b",
        "has left again",
        "seen at rest",
        "arrived or left in between",
        "beginning or end unknown",
    } <= words


def test_clocks_give_dates() -> None:
    figure = figure_of(rests(2), start_s=1.7e9, end_s=1.7e9 + HOUR_S)
    assert figure.axes[1].get_xlabel() == "time [UTC]"
