"""What the demonstration says at the top of its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from evermap.viz.report import ReportSection
from evermap.viz.style import NamedFigure

_COLUMNS = (
    ("pose_rmse_m", "position error"),
    ("precision", "precision"),
    ("recall", "recall"),
    ("existence_brier", "Brier, existence"),
    ("forecast_skill_over_as_is", "forecast skill"),
)


def demo_sections(
    numbers: Mapping[str, Any], cost: Mapping[str, Any], figures: Sequence[NamedFigure]
) -> tuple[ReportSection, ...]:
    """The story; `numbers` are those of `demo_dict`, `cost` of `cost`; figures: hero, scores, lifetimes."""
    hero, scores, lifetimes = figures
    html = (
        f"<p>A robot patrols a simulated building {len(numbers['sessions'])} times in {numbers['scenario']['days']}"
        f" days. {_what_happened(numbers)} The same recordings go,"
        " session after session, into one map for each of these methods; they are one engine with parts switched"
        f" off:</p>{_who(numbers)}"
    )
    text = (
        f"<p>In the last week:</p>{_table(numbers, cost)}"
        f"<p>Counted are {escape(numbers['counted'])}. Forecast skill is 1 for what was always right, 0 for no better"
        " than 'all stays as it truly is', and negative for worse. A map that is wrong about now is wrong about"
        " tomorrow.</p>"
        f"<p>What was expected before it was run:</p>{_expected(numbers, cost)}"
        "<p>All true changes are in <code>true_events.jsonl</code>, evermap's map with a revision a session in"
        " <code>map.evermap</code> (<code>evermap map log</code> reads it). Everything below is about evermap's last"
        " session.</p>"
    )
    return (
        ReportSection("Four weeks in one map", html, (hero,)),
        ReportSection("How right, how sure, how large, how dear", text, (scores, lifetimes)),
    )


def _what_happened(numbers: Mapping[str, Any]) -> str:
    sessions = numbers["sessions"]
    first, last = sessions[0], sessions[-1]
    return (
        f"Doors open and close, things are moved, taken away and brought back: {numbers['true_events']} changes. Of the"
        f" {first['landmarks']} landmarks that stood there in the first session, {last['where_first_mapped']} stand in"
        " the same place in the last."
    )


def _who(numbers: Mapping[str, Any]) -> str:
    from evermap.viz.tables import table

    rows = [(escape(m["label"]), escape(m["says"])) for m in numbers["methods"].values()]
    return table(("method", "what it does about change"), rows)


def _table(numbers: Mapping[str, Any], cost: Mapping[str, Any]) -> str:
    from evermap.viz.tables import table

    head = ("method", *(title for _, title in _COLUMNS), "places", "time a session")
    rows = [
        (escape(method["label"]), *cells_of(method), f"{median_ms(cost['session_cpu_s'][name]):.0f} ms")
        for name, method in numbers["methods"].items()
    ]
    return table(head, rows, numbers=tuple(range(1, len(head))))


def cells_of(method: Mapping[str, Any]) -> tuple[str, ...]:
    """A method's last week as text: error, precision, recall, Brier score, forecast skill, places."""
    week = method["weeks"][-1]
    error = week["pose_rmse_m"]
    scores = [week[name] for name, _ in _COLUMNS[1:]]
    return (
        "–" if error is None else f"{100 * error:.1f} cm",
        *("–" if score is None else f"{score:.3f}" for score in scores),
        str(method["sessions"][-1]["places"]),
    )


def median_ms(cpu_s: Sequence[float]) -> float:
    """Median time of a session [ms]."""
    from statistics import median

    return 1e3 * median(cpu_s)


def _expected(numbers: Mapping[str, Any], cost: Mapping[str, Any]) -> str:
    from evermap.viz.tables import table

    outcomes = [*numbers["expected"].values(), *cost["expected"].values()]
    return table(("what", "expected", "here", ""), [_row(outcome) for outcome in outcomes], numbers=(1, 2))


def _row(outcome: Mapping[str, Any]) -> tuple[str, str, str, str]:
    bound = f"at least {outcome['least']:g}" if outcome["least"] is not None else f"at most {outcome['most']:g}"
    value = "–" if outcome["value"] is None else f"{outcome['value']:.3f}"
    return escape(outcome["what"]), bound, value, "holds" if outcome["holds"] else "<strong>falls short</strong>"
