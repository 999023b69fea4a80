"""What the demonstration says at the top of its report."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

from evermap.viz.report import ReportSection
from evermap.viz.style import NamedFigure

NOT_YET = (
    "evermap does nothing about it yet: it takes a map as true for ever, and neither notices that a landmark has moved,"
    " vanished or come back, nor mends the map. That is the work ahead, and these numbers are what it has to beat."
)


def demo_section(numbers: Mapping[str, Any], figure: NamedFigure) -> ReportSection:
    """The story with its table and figure; `numbers` are those of `demo_dict`."""
    sessions = numbers["sessions"]
    last = sessions[-1]
    html = (
        f"<p>A robot maps a simulated building on day 1 and then patrols it once a day, believing that map."
        f" {_what_happened(last)}</p>"
        f"<p>{_what_it_costs(sessions)}</p>"
        f"<p>{_why(sessions)}</p>"
        f'<p class="note"><strong>Not yet done.</strong> {escape(NOT_YET)}</p>'
        f"{_table(sessions)}"
        "<p>Position error: RMSE in centimetres after an alignment of each path of its own (evaluation only; the"
        " estimator never sees the truth). <em>Nothing changes</em>: the same building, robot, patrols and noise"
        " with all changes switched off. <em>No map kept</em>: the changing building, mapped from scratch every day."
        " Rejected: detections whose landmark moved, or stayed where it was, that were judged to be outliers. True"
        " changes are in <code>true_events.jsonl</code>; everything below this section is about the last day in"
        " the changing building.</p>"
    )
    return ReportSection("What a map that never changes costs", html, (figure,))


def _what_happened(session: Mapping[str, Any]) -> str:
    changes = session["changes"]
    return (
        f"By day {session['day']}, {changes['moved']} of its {changes['landmarks_mapped_then']} landmarks have moved,"
        f" {changes['vanished']} have vanished and {changes['appeared']} new ones stand about."
    )


def _what_it_costs(sessions: list[Mapping[str, Any]]) -> str:
    """Only what these very numbers say; another seed may tell another story."""
    first, later = sessions[0], sessions[1:]
    changed = [s["changed"]["pose_rmse_m"] for s in later if s["changed"]["pose_rmse_m"] is not None]
    unchanged = [s["unchanged"]["pose_rmse_m"] for s in later if s["unchanged"]["pose_rmse_m"] is not None]
    if not changed or not unchanged or first["changed"]["pose_rmse_m"] is None:
        return "There is too little truth to say what that costs."
    mine, other = sum(changed) / len(changed), sum(unchanged) / len(unchanged)
    text = (
        f"On the day the map is made the position error is {100 * first['changed']['pose_rmse_m']:.1f} cm. On the later"
        f" days it is {100 * mine:.1f} cm on average, up to {100 * max(changed):.1f} cm, where things"
        f" change, and {100 * other:.1f} cm where nothing does"
    )
    ratio = mine / other
    return text + (f": {ratio:.1f} times as much." if ratio >= 1.1 else ": in this run the changes hardly hurt.")


def _why(sessions: list[Mapping[str, Any]]) -> str:
    """What became of the moved landmarks: the robust kernel is all that stands between the old map and the robot."""
    day, changes = sessions[-1]["day"], sessions[-1]["changes"]
    believed, rejected = changes["moved_believed"], changes["moved_rejected"]
    text = f"Of the moved landmarks that were seen on day {day}, "
    if rejected:
        text += (
            f"{rejected} (by {changes['rejected_displacement_m']:.1f} m, median) are too far from their old place to be"
            " believed: the robust kernel rejects their detections, and the robot has to do without them."
        )
    if believed:
        text += (" " if rejected else "") + (
            f"{believed} (by {changes['believed_displacement_m']:.1f} m) are {'still ' if rejected else ''}near enough"
            " to pass for a mistake of the map: the estimate compromises, and is drawn off with them."
        )
    if not (believed or rejected):
        return ""
    return f"{text} And it starts from zero every day: it judges detections, but learns nothing about the map."


def _table(sessions: list[Mapping[str, Any]]) -> str:
    from evermap.viz.tables import table

    head = ("day", "moved", "vanished", "new", "error, things change", "error, nothing changes", "error, no map kept",
            "rejected, moved", "rejected, stayed")  # fmt: skip
    rows = [
        (
            str(s["day"]),
            *(str(s["changes"][name]) for name in ("moved", "vanished", "appeared")),
            *(_centimetres(s[name]["pose_rmse_m"]) for name in ("changed", "unchanged", "from_scratch")),
            *(_percent(s["changes"][f"{name}_rejected_share"]) for name in ("moved", "stayed")),
        )
        for s in sessions
    ]
    return table(head, rows, numbers=tuple(range(1, len(head))))


def _centimetres(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.1f} cm"


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:.0%}"
