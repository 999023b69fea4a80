"""`report.html` of a run: what is there now, what changed, and whether the probabilities mean what they say."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from evermap.runs.persist.run import PersistResult
from evermap.survival.durations import duration_text
from evermap.viz.page import PAGE, STYLE
from evermap.viz.report import table
from evermap.viz.style import NamedFigure

_MOST_ROWS = 100


def render_report(
    result: PersistResult, summary: Mapping[str, Any], figures: Sequence[NamedFigure], pictures: Sequence[bytes]
) -> str:
    """The page as text. Contains no address outside of itself, and nothing in it is executed.

    Args:
        result: of `run_persist`.
        summary: the content of `summary.json`.
        figures: their captions.
        pictures: the same as PNG.
    """
    drawn = {figure.name: _figure(figure, picture) for figure, picture in zip(figures, pictures, strict=True)}
    alone = [html for name, html in drawn.items() if name.startswith("feature-")]
    parts = [
        _cards(summary),
        _warnings(summary),
        "<h2>At one glance</h2>" + drawn["overview"],
        f"<h2>Calibration</h2>{drawn['calibration']}" if "calibration" in drawn else "",
        _changes(result),
        _forecasts(result),
        "<h2>Single features</h2>" + "\n".join(alone) if alone else "",
        f"<h2>Where this comes from</h2><pre>{escape(_provenance(summary))}</pre>",
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
        heading="What is there, what changed, what is to come",
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
    items = "".join(
        f'<div class="card"><dt>{escape(label)}</dt><dd class="number">{escape(form.format(value))}'
        f" <small>{escape(unit)}</small></dd><dd><p>{escape(meaning)}</p></dd></div>"
        for label, value, form, unit, meaning in cards
    )
    return f'<dl class="cards">{items}</dl>'


def _warnings(summary: Mapping[str, Any]) -> str:
    if not summary["warnings"]:
        return ""
    items = "".join(f"<li>{escape(text)}</li>" for text in summary["warnings"])
    return f'<div class="note"><strong>Worth knowing</strong><ul>{items}</ul></div>'


def _figure(named: NamedFigure, picture: bytes) -> str:
    data = base64.b64encode(picture).decode("ascii")
    width = f"{7.5 * float(named.figure.get_size_inches()[0]):.0f}rem"  # one scale for all
    return (
        f'<figure><img style="max-width:{width}" alt="{escape(named.title, quote=True)}"'
        f' src="data:image/png;base64,{data}">'
        f"<figcaption><strong>{escape(named.title)}.</strong> {escape(named.caption)}</figcaption></figure>"
    )


def _changes(result: PersistResult) -> str:
    changes, names = result.changes, result.table.names
    if len(changes) == 0:
        return ""
    rows = [
        (
            escape(names[changes.feature[k]]),
            "returned" if changes.returned[k] else "vanished",
            *(f"{getattr(changes, column)[k]:,.1f}" for column in ("stamp_s", "earliest_s", "latest_s", "decided_s")),
            f"{changes.confidence[k]:.3f}",
        )
        for k in range(len(changes) - 1, max(-1, len(changes) - 1 - _MOST_ROWS), -1)
    ]
    head = ("feature", "change", "when [s]", "not before [s]", "not after [s]", "clear since [s]", "confidence")
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
    return f"<h2>Now and later</h2>{table(head, rows, numbers=range(1, len(head)))}{note}"


def _time(seconds: float) -> str:
    return "–" if math.isnan(seconds) else duration_text(seconds)


def _provenance(summary: Mapping[str, Any]) -> str:
    """Command, configuration and versions."""
    shown = {name: summary[name] for name in ("command", "config", "model", "learning", "versions", "timing")}
    return json.dumps(shown, indent=2, ensure_ascii=False)
