"""`report.html`: what a run found, in one file that needs nothing else."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

from evermap.metrics.summary import Evaluation
from evermap.types import Recording, SlamResult
from evermap.viz.change_words import explanations, grew, near_alternatives
from evermap.viz.headline import headline_cards
from evermap.viz.page import PAGE, STYLE
from evermap.viz.style import NamedFigure, house_style, inline_svg
from evermap.viz.tables import calibration_table, change_table, landmark_table, noise_table, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class ReportSection:
    """A part of the report that the caller adds. A page with such parts opens with them.

    Attributes:
        title: plain text.
        html: trusted markup (paragraphs, tables); may use the page's classes `cards`, `card`, `note`, `n`.
        figures: drawn after the text; a `NamedFigure`, or (PNG bytes or matplotlib figure, plain-text caption).
    """

    title: str
    html: str = ""
    figures: tuple[NamedFigure | tuple[Figure | bytes, str], ...] = ()


def render_report(
    recording: Recording,
    result: SlamResult,
    evaluation: Evaluation,
    summary: Mapping[str, Any],
    figures: Sequence[NamedFigure],
    sections: Sequence[ReportSection] = (),
) -> str:
    """The page as text. Contains no address outside of itself, and nothing in it is executed.

    Args:
        recording: what was processed.
        result: what came out.
        evaluation: `compare_with_truth(recording, result)`.
        summary: the content of `summary.json`.
        figures: `draw_figures(...)`, may be empty.
        sections: what the caller adds.
    """
    parts = [_section(section, number) for number, section in enumerate(sections)]
    if sections:  # the page is about more than this recording
        parts.append(f'<h2>{escape(recording.name)}</h2><p class="lead">{_lead(summary)}</p>')
    parts += [
        headline_cards(summary),
        _interrupted(summary),
        _changes(result, summary),
        _warnings(summary),
        _figures("Where it was", figures, ("map", "errors"), _frames(summary)),
        _figures("What the sensors are like", figures, ("calibration",), _calibration(result)),
        _figures("Does it know how wrong it is", figures, ("consistency",), _consistency(summary)),
        _figures("Speed", figures, ("latency",), ""),
        _landmarks(result, evaluation),
        _provenance(summary),
    ]
    return PAGE.substitute(
        version=escape(str(summary["evermap"])),
        title=escape(f"{sections[0].title if sections else recording.name}: evermap run"),
        style=STYLE,
        heading=escape(sections[0].title if sections else recording.name),
        lead="" if sections else _lead(summary),
        body="\n".join(part for part in parts if part),
        footer=_footer(summary),
    )


def _lead(summary: Mapping[str, Any]) -> str:
    counts, source = summary["counts"], summary["source"]
    text = (
        f"{counts['duration_s'] / 60:.1f} minutes, {counts['frames']:,} frames, {counts['detections']:,} detections"
        f" of {counts['landmarks']:,} landmarks"
    )
    if counts["robot_sightings"]:
        text += f"; {counts['robot_sightings']:,} sightings of other robots were read and not used"
    return f"{text}.<br>Read from <code>{escape(source)}</code>." if source else f"{text}."


def _interrupted(summary: Mapping[str, Any]) -> str:
    if not summary["interrupted"]:
        return ""
    return '<p class="note">Stopped before the end of the recording: everything here is about the part until then.</p>'


def _warnings(summary: Mapping[str, Any]) -> str:
    if not summary["warnings"]:
        return ""
    items = "".join(f"<li>{escape(text)}</li>" for text in summary["warnings"])
    return f'<div class="note"><strong>Worth knowing</strong><ul>{items}</ul></div>'


def _changes(result: SlamResult, summary: Mapping[str, Any]) -> str:
    """What differs from the map, in words and numbers, and what else it may be; '' where nothing is in question."""
    lines = explanations(result) + grew(summary["counts"].get("landmarks_grown"))
    if not lines:
        return ""
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    note = ""
    if near_alternatives(result):
        note = (
            "<p>The recording cannot rule out what follows an 'or'. The maps as they would be then are in"
            " <code>alternative_1.geojson</code> and so on, the most probable first.</p>"
        )
    return f"<h2>What changed</h2><ul>{items}</ul>{change_table(result)}{note}"


def _figures(title: str, figures: Sequence[NamedFigure], names: tuple[str, ...], html: str) -> str:
    shown = [figure for figure in figures if figure.name in names]
    if not shown and not html:
        return ""
    return "\n".join([f"<h2>{escape(title)}</h2>", *map(_figure, shown), html])


def _figure(named: NamedFigure) -> str:
    drawing = inline_svg(named.figure, named.name)
    label = escape(named.title, quote=True)
    drawing = drawing.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)
    return (
        f'<figure id="{named.name}">{drawing}'
        f"<figcaption><strong>{escape(named.title)}.</strong> {escape(named.caption)}</figcaption></figure>"
    )


def _section(section: ReportSection, number: int) -> str:
    # the first one has the heading of the page
    parts = [f"<h2>{escape(section.title)}</h2>" if number else "", section.html]
    for index, item in enumerate(section.figures):
        if isinstance(item, NamedFigure):
            parts.append(_figure(item))
            continue
        picture, caption = item
        data = base64.b64encode(picture if isinstance(picture, bytes) else _png(picture)).decode("ascii")
        parts.append(
            f'<figure id="section-{number}-{index}"><img alt="{escape(caption, quote=True)}"'
            f' src="data:image/png;base64,{data}"><figcaption>{escape(caption)}</figcaption></figure>'
        )
    return "\n".join(parts)


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    with house_style():
        figure.savefig(buffer, format="png", dpi=160, facecolor="white")
    return buffer.getvalue()


def _frames(summary: Mapping[str, Any]) -> str:
    """What the coordinates mean, and how they were compared with truth."""
    rows = [(escape(name), escape(meaning)) for name, meaning in summary["frames"].items()]
    alignment = summary["metrics"]["alignment"]
    pose = alignment["pose_truth_estimate"]
    if pose is not None:
        how = (
            f"truth = R({pose['theta_rad']:.4f} rad) · estimate + ({pose['x_m']:.3f}, {pose['y_m']:.3f}) m, by"
            f" {escape(alignment['method'])} on {alignment['scored_stamps']} positions at {alignment['rate_hz']:g} Hz,"
            f" {alignment['scored_from_s']:.1f} s to {alignment['scored_to_s']:.1f} s; {escape(alignment['purpose'])}."
            " Odometry alone and the online poses each have an alignment of their own."
        )
        rows.append(("alignment", how))
    return f"<h3>Frames</h3>{table(('what', 'meaning'), rows)}"


def _calibration(result: SlamResult) -> str:
    html = ""
    calibration, noise = calibration_table(result), noise_table(result)
    if calibration:
        html += f"<h3>Calibration states</h3>{calibration}"
    if noise:
        html += f"<h3>Noise levels</h3>{noise}"
    return html


def _consistency(summary: Mapping[str, Any]) -> str:
    metrics = summary["metrics"]
    rows = [
        ("NIS, mean of the inliers", _cell(metrics["nis_mean"]), "2"),
        ("NIS, mean of all", _cell(metrics["nis_mean_all"]), "2 without outliers"),
        ("NIS, median of all", _cell(metrics["nis_median"]), "1.39"),
        ("NIS, share below the 95% bound", _cell(metrics["nis_in_band_share"], "{:.1%}"), "95%"),
        ("NIS, correlation between a landmark's successive values", _cell(metrics["nis_lag1_autocorrelation"]), "0"),
        ("detections judged outliers", _cell(metrics["outlier_share"], "{:.2%}"), ""),
        ("NEES of positions, aligned", _cell(metrics["pose_nees_mean"]), "below 2: alignment removes error"),
        (
            "NEES of positions, first pose held",
            _cell(metrics["pose_nees_anchored_mean"]),
            "2, one draw: scatters widely",
        ),
        ("NEES of landmarks, aligned", _cell(metrics["landmark_nees_mean"]), "below 2: alignment removes error"),
    ]
    return table(("quantity", "here", "if consistent"), [row for row in rows if row[1]], numbers=(1,))


def _cell(value: float | None, form: str = "{:.2f}") -> str:
    return "" if value is None else form.format(value)


def _landmarks(result: SlamResult, evaluation: Evaluation) -> str:
    content = landmark_table(result, evaluation)
    if not content:
        return ""
    return f"<h2>The map</h2><details><summary>{len(result.landmarks)} landmarks</summary>{content}</details>"


def _provenance(summary: Mapping[str, Any]) -> str:
    versions = ", ".join(f"{escape(name)} {escape(str(value))}" for name, value in summary["versions"].items())
    rows = [("evermap", escape(str(summary["evermap"]))), ("versions", versions)]
    if summary["command"]:
        rows.append(("command", f"<code>{escape(summary['command'])}</code>"))
    rows.append(("seeds", escape(json.dumps(summary["seeds"]))))
    config = escape(json.dumps(summary["config"], indent=2, ensure_ascii=False))
    files = " ".join(f"<code>{escape(name)}</code>" for name in summary["outputs"])
    rows.append(("files beside this one", files))
    return (
        f"<h2>How it was made</h2>{table(('what', ''), rows)}"
        f"<details><summary>Configuration</summary><pre>{config}</pre></details>"
    )


def _footer(summary: Mapping[str, Any]) -> str:
    timing = summary["timing"]
    text = f"Made by evermap {escape(str(summary['evermap']))}"
    if timing["written_at"]:
        text += f", {escape(timing['written_at'])}"
    return text + ". All numbers of this page are in <code>summary.json</code>."
