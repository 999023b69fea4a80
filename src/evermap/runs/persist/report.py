"""`report.html` of a run: what is there now, what changed, and whether the probabilities mean what they say."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from evermap.runs.persist.run import PersistResult
from evermap.stamps import stamp_text
from evermap.survival.durations import duration_text
from evermap.types import Clock
from evermap.viz.page import PAGE, STYLE, card, cards_html, figure_html, table, warnings_note
from evermap.viz.style import NamedFigure

_MOST_ROWS = 100


def render_report(
    result: PersistResult, summary: Mapping[str, Any], figures: Sequence[NamedFigure], clock: Clock
) -> str:
    """Return the page as text. Contains no address outside of itself, and nothing in it is executed.

    Args:
        result: of `run_persist`.
        summary: the content of `summary.json`.
        figures: as `draw_run` gives them.
        clock: of the stamps.
    """
    drawn = {figure.name: figure_html(figure) for figure in figures}
    alone = [html for name, html in drawn.items() if name.startswith("feature-")]
    parts = [
        _cards(summary),
        warnings_note(summary["warnings"]),
        "<h2>Overview</h2>" + drawn["overview"],
        f"<h2>Calibration</h2>{drawn['calibration']}" if "calibration" in drawn else "",
        _changes(result, clock),
        _forecasts(result),
        "<h2>Single features</h2>" + "\n".join(alone) if alone else "",
        f"<h2>Source and settings</h2><pre>{escape(_provenance(summary))}</pre>",
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
            ("Log loss", metrics["log_loss"], "{:.4f}", "nats", "Punishes being sure and wrong; 0 is perfect."),
            ("Calibration error", metrics["calibration_error"], "{:.4f}", "", "Mean distance from the dashed line."),
        ]
    return cards_html(card(*one) for one in cards)


def _changes(result: PersistResult, clock: Clock) -> str:
    changes, names = result.changes, result.table.names
    if len(changes) == 0:
        return ""
    rows = [
        (
            escape(names[changes.feature[k]]),
            "returned" if changes.returned[k] else "vanished",
            *(
                stamp_text(getattr(changes, name)[k], clock)
                for name in ("stamp_s", "earliest_s", "latest_s", "decided_s")
            ),
            f"{changes.confidence[k]:.3f}",
        )
        for k in range(len(changes) - 1, max(-1, len(changes) - 1 - _MOST_ROWS), -1)
    ]
    zone = "since the start" if clock is Clock.RECORDING else "UTC" if clock is Clock.UNIX else "local clock"
    head = ("feature", "change", f"when ({zone})", "not before", "not after", "decided", "confidence")
    more = len(changes) - len(rows)
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
            *(_time(float(times_s[k])) for times_s in outlooks.values()),
        )
        for k in believed[:_MOST_ROWS].tolist()
    ]
    head = ("feature", "P(exists) now", f"in {horizon}", *outlooks)
    more = believed.size - len(rows)
    note = f"<p>{more:,} more are in <code>forecasts.csv</code>.</p>" if more > 0 else ""
    return f"<h2>Forecasts</h2>{table(head, rows, numbers=range(1, len(head)))}{note}"


def _time(seconds: float) -> str:
    return "–" if math.isnan(seconds) else duration_text(seconds)


def _provenance(summary: Mapping[str, Any]) -> str:
    """Command, configuration and versions."""
    shown = {name: summary[name] for name in ("command", "config", "model", "learning", "versions", "timing")}
    return json.dumps(shown, indent=2, ensure_ascii=False)
