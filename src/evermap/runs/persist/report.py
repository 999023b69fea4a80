"""Figures and `report.html` of a run: present features, changes, calibration."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from evermap.existence.protocol import Instants
from evermap.runs.persist.changes import MOST_FEATURES
from evermap.runs.persist.run import PersistResult
from evermap.survival.durations import duration_text
from evermap.types import Clock, FloatArray, IntArray, stamp_text
from evermap.viz.page import PAGE, STYLE, card, cards_html, figure_html, table, warnings_note
from evermap.viz.style import NamedFigure

MOST_ROWS = 100
"""Of a table on the page."""


def render_report(
    result: PersistResult, summary: Mapping[str, Any], figures: Sequence[NamedFigure], clock: Clock
) -> str:
    """Return the page as text. Contains no address outside of itself, and nothing in it is executed."""
    drawn = {figure.name: figure_html(figure) for figure in figures}
    alone = [html for name, html in drawn.items() if name.startswith("feature-")]
    names = ("command", "config", "model", "learning", "versions", "timing")
    provenance = json.dumps({name: summary[name] for name in names}, indent=2, ensure_ascii=False)
    parts = [
        _cards(summary),
        warnings_note(summary["warnings"]),
        "<h2>Overview</h2>" + drawn["overview"],
        f"<h2>Calibration</h2>{drawn['calibration']}" if "calibration" in drawn else "",
        _changes(result, clock),
        _forecasts(result),
        "<h2>Single features</h2>" + "\n".join(alone) if alone else "",
        f"<h2>Source and settings</h2><pre>{escape(provenance)}</pre>",
    ]
    counts, source = summary["counts"], escape(str(summary["source"]) or "a table in memory")
    lead = (
        f"{counts['looks']:,} looks at {counts['features']:,} features over {duration_text(counts['duration_s'])}."
        f"<br>Read from <code>{source}</code>."
    )
    return PAGE.substitute(
        version=escape(str(summary["evermap"])),
        title="evermap persist",
        style=STYLE,
        heading="Presence, changes and forecasts",
        lead=lead,
        body="\n".join(part for part in parts if part),
        footer=f"evermap {escape(str(summary['evermap']))}",
    )


def _cards(summary: Mapping[str, Any]) -> str:
    counts, metrics = summary["counts"], summary["metrics"]
    cards = [
        ("There now", summary["expected_present_now"], "{:.1f}", f"of {counts['features']:,}", "Sum of all beliefs."),
        ("Vanished", counts["vanished"], "{:,}", "", "Belief fell below 1 minus the confidence at a look."),
        ("Returned", counts["returned"], "{:,}", "", "Belief rose above the confidence again."),
    ]
    if metrics:
        cards += [
            ("Brier score", metrics["brier"], "{:.4f}", "", "Mean squared error of the beliefs; 0 is perfect."),
            ("Log loss", metrics["log_loss"], "{:.4f}", "nats", "Penalises confident errors; 0 is perfect."),
            ("Calibration error", metrics["calibration_error"], "{:.4f}", "", "Mean distance from the dashed line."),
        ]
    return cards_html(card(*one) for one in cards)


def _changes(result: PersistResult, clock: Clock) -> str:
    changes, names = result.changes, result.table.names
    if len(changes) == 0:
        return ""
    times = (changes.stamp_s, changes.earliest_s, changes.latest_s, changes.decided_s)
    rows = [
        (
            escape(names[changes.feature[k]]),
            "returned" if changes.returned[k] else "vanished",
            *(stamp_text(times_s[k], clock) for times_s in times),
            f"{changes.confidence[k]:.3f}",
        )
        for k in range(len(changes) - 1, max(-1, len(changes) - 1 - MOST_ROWS), -1)
    ]
    zone = "since the start" if clock is Clock.RECORDING else "UTC" if clock is Clock.UNIX else "local clock"
    head = ("feature", "change", f"when ({zone})", "not before", "not after", "decided", "confidence")
    more = result.totals.vanished + result.totals.returned - len(rows)
    note = f"<p>{more:,} earlier ones are in <code>changes.jsonl</code>.</p>" if more > 0 else ""
    return f"<h2>Changes, latest first</h2>{table(head, rows, numbers=(2, 3, 4, 5, 6))}{note}"


def _forecasts(result: PersistResult) -> str:
    forecasts, names = result.forecasts, result.table.names
    believed = np.flatnonzero(~np.isnan(forecasts.p_exists[:, 0]))
    if believed.size == 0:
        return ""
    horizon = duration_text(float(forecasts.stamp_s[-1] - forecasts.stamp_s[0]))
    outlooks = {
        "if there, half are gone after": forecasts.median_stay_s,
        "if there, leaves after": forecasts.mean_stay_s,
        "if away, returns after": forecasts.mean_absence_s,
    }
    outlooks = {title: times_s for title, times_s in outlooks.items() if not np.isnan(times_s).all()}
    rows = [
        (
            escape(names[k]),
            f"{forecasts.p_exists[k, 0]:.3f}",
            f"{forecasts.p_exists[k, -1]:.3f}",
            *("–" if np.isnan(times_s[k]) else duration_text(float(times_s[k])) for times_s in outlooks.values()),
        )
        for k in believed[:MOST_ROWS].tolist()
    ]
    head = ("feature", "P(exists) now", f"in {horizon}", *outlooks)
    more = int((~np.isnan(result.totals.p_now)).sum()) - len(rows)
    note = f"<p>{more:,} more are in <code>forecasts.csv</code>.</p>" if more > 0 else ""
    return f"<h2>Forecasts</h2>{table(head, rows, numbers=range(1, len(head)))}{note}"


_CURVE_POINTS = 400
_PIXELS = 1200
"""Columns of a figure: with more looks, each column shows the lowest and the highest belief, and one tick per kind."""


def draw_run(result: PersistResult, clock: Clock) -> Iterator[NamedFigure]:
    """Draw the figures one by one, so that a progress bar can follow."""
    yield _overview(result, clock)
    if result.scores is not None and result.reliability is not None:
        yield _calibration(result)
    taken: set[str] = set()
    for feature in result.most_changed(result.config.figures).tolist():
        yield _feature(result, feature, clock, taken)


def _overview(result: PersistResult, clock: Clock) -> NamedFigure:
    from evermap.viz.plots import plot_persist_run

    figure = plot_persist_run(result, clock)
    total, shown = len(result.totals.p_now), min(MOST_FEATURES, result.table.n_features)
    which = "All features" if shown == total else f"The {shown} of {total:,} features that changed most"
    caption = f"{which}: blue is there, orange is not, pale is undecided, hatched is not yet seen."
    return NamedFigure("overview", figure, "Beliefs of all features", caption)


def _calibration(result: PersistResult) -> NamedFigure:
    from evermap.viz.presence_figures import plot_reliability

    assert result.scores is not None and result.reliability is not None  # noqa: PT018
    figure = plot_reliability(result.reliability, result.scores)
    caption = (
        "Share of instants at which the feature was there, by its belief. On the dashed line beliefs are calibrated. "
        "Below: the number of instants."
    )
    return NamedFigure("calibration", figure, "Calibration", caption)


def _feature(result: PersistResult, feature: int, clock: Clock, taken: set[str]) -> NamedFigure:
    from evermap.viz.presence_figures import plot_belief, stretches

    index = np.array([feature])
    looks, look_rows = result.looks.at(index)
    start_s, end_s = _span(result)
    pixel = np.floor((looks.stamp_s - start_s) / (end_s - start_s or 1.0) * _PIXELS)
    turn_s = looks.stamp_s[_extremes(pixel, result.p_at_looks[look_rows])]
    before_s = np.maximum(np.nextafter(turn_s, -np.inf), start_s)  # draws the jump of a look upright
    time_s = np.unique(np.concatenate([np.linspace(start_s, end_s, _CURVE_POINTS), before_s, turn_s]))
    track = result.models.only(index).track(looks, Instants.same_for_all(1, time_s))
    truth = result.truth
    there = None
    if truth is not None and truth.first[feature + 1] > truth.first[feature]:
        rows = slice(int(truth.first[feature]), int(truth.first[feature + 1]))
        there = stretches(truth.stamp_s[rows], truth.present[rows])
    name = result.table.names[feature]
    shown = np.unique(pixel + 1j * looks.detected, return_index=True)[1]
    figure = plot_belief(
        time_s,
        track.p_present,
        looks=(looks.stamp_s[shown], looks.detected[shown]),
        truth_s=there,
        forecast_from_s=result.table.span.last_look_s,
        title=f"feature {name if len(name) <= 60 else name[:59] + '…'}",
        clock=clock,
    )
    slug = re.sub(r"[^A-Za-z0-9_.-]+", "-", name)[:60].strip("-.") or "feature"
    while slug in taken:
        slug += "-"
    taken.add(slug)
    caption = "Belief, detections (above) and misses (below); shaded: truly there; dashed: forecast."
    return NamedFigure(f"feature-{slug}", figure, f"Feature {name}", caption)


def _extremes(pixel: FloatArray, belief: FloatArray) -> IntArray:
    """The looks with the lowest and the highest belief in each column of pixels; nan counts as highest."""
    order = np.lexsort((belief, pixel))
    edge = np.flatnonzero(np.diff(pixel[order], prepend=-np.inf, append=np.inf))
    return np.unique(np.concatenate([order[edge[:-1]], order[edge[1:] - 1]]))


def _span(result: PersistResult) -> tuple[float, float]:
    """From the first row to the end of the forecast."""
    start_s, stop_s = result.table.span[:2]
    return start_s, max(stop_s, float(result.forecasts.stamp_s[-1]))
