"""The four-week story: what the report of the demonstration opens with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from evermap.viz.report import ReportSection
from evermap.viz.style import NamedFigure

TITLE = "Four weeks in one map"


def demo_sections(
    numbers: Mapping[str, Any], cost: Mapping[str, Any], figures: Sequence[NamedFigure]
) -> tuple[ReportSection, ...]:
    """The story. `numbers` as of `demo_dict`, `cost` as of `cost`, figures: weeks, hero, claims, scores, lifetimes."""
    weeks, hero, claims, scores, lifetimes = figures
    what = f"<p>{_what_happened(numbers)}</p>"
    who = (
        "<p>The same recordings go, session after session, into one map for each of these methods; they are one engine"
        f" with parts switched off:</p>{_who(numbers)}"
    )
    false = (
        f"<p>Over all sessions, counted by landmark:</p>{_false_table(numbers)}"
        f"<p>{escape(numbers['false_means'])} The oracle is told every change before it looks, so it has nothing to"
        " tell.</p>"
    )
    text = (
        f"<p>Over all sessions:</p>{_table(numbers, cost)}"
        f"<p>Counted are {escape(numbers['counted'])}. Forecast skill is that of the probabilities for the next session"
        " against a constant, the share of statements that come true: 1 for what was always right, 0 for no better."
        " Time is of one processor, without compiling.</p>"
        f"<p>What was expected before it was run:</p>{_expected(numbers, cost)}"
        "<p>All true changes are in <code>true_events.jsonl</code>, evermap's map with a revision a session in"
        " <code>map.evermap</code> (<code>evermap map log</code> reads it). Everything below is about evermap's last"
        " session.</p>"
    )
    return (
        ReportSection(TITLE, what, (weeks,)),
        ReportSection("The methods", who, (hero,)),
        ReportSection("What each method tells falsely", false, (claims,)),
        ReportSection("Accuracy, calibration, map size, cost", text, (scores, lifetimes)),
    )


def _what_happened(numbers: Mapping[str, Any]) -> str:
    sessions, scenario = numbers["sessions"], numbers["scenario"]
    first, last = sessions[0], sessions[-1]
    lengths = sorted({session["patrol_s"] for session in sessions})
    opened = [session["day"] for session in sessions if not session["wing_shut"]]
    wing = (
        f"the eastern wing is closed until day {opened[0]}" if opened and first["wing_shut"]
        else "the eastern wing is closed" if first["wing_shut"] else "all rooms can be reached"
    )  # fmt: skip
    shut = sum(len(session["shut_rooms"]) for session in sessions) / len(sessions)
    known = sum(session["known"] for session in sessions) / sum(session["landmarks"] for session in sessions)
    return (
        f"A robot patrols a simulated building {len(sessions)} times in {scenario['days']} days, for"
        f" {lengths[0]:g} to {lengths[-1]:g} s, each time along a route of its own that sees a part of the building."
        f" Doors block its sight ({shut:.1f} are shut on average), and {wing}. Meanwhile doors open and close, things"
        " are moved, taken away and brought back, and crates come and go by the hour:"
        f" {numbers['true_events']} changes. {last['where_first_mapped']} of the {first['landmarks']} landmarks that"
        " stood there in the first session stand in the same place in the last. Even a robot that never errs would know"
        f" only {known:.0%} of the"
        " landmarks that stand there: those that stand where it really looked since they came."
    )


def _who(numbers: Mapping[str, Any]) -> str:
    from evermap.viz.page import table

    rows = [(escape(m["label"]), escape(m["says"])) for m in numbers["methods"].values()]
    return table(("method", "what it does about change"), rows)


def _false_table(numbers: Mapping[str, Any]) -> str:
    from evermap.viz.page import table

    head = ("method", "changes told", "false", "with p > .99", "of things that never changed", "'came'", "'vanished'",
            "'moved'", "Brier, told", "told of what could be known")  # fmt: skip
    rows = []
    for method in numbers["methods"].values():
        told = method["whole"]["changes"]
        if told is None:
            rows.append((escape(method["label"]), *("–",) * (len(head) - 1)))
            continue
        rows.append(
            (
                escape(method["label"]),
                str(told["told"]),
                f"<strong>{told['false']}</strong>" + _percent(told["false_share"], " ({})"),
                str(told["false_certain"]),
                f"{told['never_changed']}, {told['never_changed_certain']} with p > .99",
                *(str(count) for count in told["false_by_reason"].values()),
                _score(told["told_brier"]),
                _percent(told["told_recall"], "{}" + f" of {told['knowable']}"),
            )
        )
    return table(head, rows, numbers=tuple(range(1, len(head))))


def _percent(share: float | None, form: str) -> str:
    return "" if share is None else form.format(f"{share:.1%}")


def _score(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def _table(numbers: Mapping[str, Any], cost: Mapping[str, Any]) -> str:
    from evermap.viz.page import table

    head = ("method", "position error", "not found", "precision", "p ≥ .9", "recall", "Brier, existence",
            "forecast skill", "places", "time a minute")  # fmt: skip
    rows = []
    for name, method in numbers["methods"].items():
        whole = method["whole"]
        scores = ("precision", "precision_sure", "recall", "existence_brier", "forecast_skill_over_base_rate")
        rows.append(
            (
                escape(method["label"]),
                _centimetres(whole["pose_rmse_m"]),
                str(whole["lost"]),
                *(_score(whole[key]) for key in scores),
                str(method["sessions"][-1]["places"]),
                f"{median_ms(cost['cpu_s_per_minute'][name]):.0f} ms",
            )
        )
    return table(head, rows, numbers=tuple(range(1, len(head))))


HEAD = ("error", "precision", "recall", "told", "false", "p > .99", "forecast", "time")
"""Of the columns of `cells_of`, and the time for a minute of recording."""


def cells_of(method: Mapping[str, Any]) -> tuple[str, ...]:
    """A method over all sessions as text; the columns are `HEAD`, but for the time."""
    whole = method["whole"]
    told = whole["changes"]
    changes = ("–",) * 3 if told is None else tuple(str(told[key]) for key in ("told", "false", "false_certain"))
    return (
        _centimetres(whole["pose_rmse_m"]),
        _score(whole["precision"]),
        _score(whole["recall"]),
        *changes,
        _score(whole["forecast_skill_over_base_rate"]),
    )


def _centimetres(error_m: float | None) -> str:
    return "–" if error_m is None else f"{100 * error_m:.1f} cm"


def median_ms(cpu_s: Sequence[float]) -> float:
    """Median of times [ms]."""
    from statistics import median

    return 1e3 * median(cpu_s)


def _expected(numbers: Mapping[str, Any], cost: Mapping[str, Any]) -> str:
    from evermap.viz.page import table

    outcomes = [*numbers["expected"].values(), *cost["expected"].values()]
    return table(("what", "expected", "here", ""), [_row(outcome) for outcome in outcomes], numbers=(1, 2))


def _row(outcome: Mapping[str, Any]) -> tuple[str, str, str, str]:
    bound = f"at least {outcome['least']:g}" if outcome["least"] is not None else f"at most {outcome['most']:g}"
    value = "–" if outcome["value"] is None else f"{outcome['value']:.3f}"
    return escape(outcome["what"]), bound, value, "holds" if outcome["holds"] else "<strong>falls short</strong>"
