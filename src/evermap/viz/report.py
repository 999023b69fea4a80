"""`report.html`: what a run found, in one file that needs nothing else."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from evermap.metrics.summary import Evaluation
from evermap.types import UNKNOWN, AnyRecording, Clock, ParameterEstimate, SlamResult, stamp_text
from evermap.viz.change_words import explanations, grew, near_alternatives
from evermap.viz.page import PAGE, STYLE, card, cards_html, figure_html, table, warnings_note
from evermap.viz.run_figures import has_prior, quantity
from evermap.viz.style import NamedFigure
from evermap.viz.verdict_words import cause_text, further_causes, innovations_text


@dataclass(frozen=True, slots=True)
class ReportSection:
    """A part of the report that the caller adds. A page with such parts opens with them.

    Attributes:
        title: plain text.
        html: trusted markup (paragraphs, tables); may use the page's classes `cards`, `card`, `note`, `n`.
        figures: drawn after the text.
    """

    title: str
    html: str = ""
    figures: tuple[NamedFigure, ...] = ()


def render_report(
    recording: AnyRecording,
    result: SlamResult,
    evaluation: Evaluation,
    summary: Mapping[str, Any],
    figures: Sequence[NamedFigure],
    sections: Sequence[ReportSection] = (),
) -> str:
    """Return the page as text. It contains no address outside of itself, and nothing in it is executed.

    Args:
        recording: what was processed.
        result: what came out.
        evaluation: `compare_with_truth(recording, result)`.
        summary: the content of `summary.json`.
        figures: `draw_figures(...)`, may be empty.
        sections: what the caller adds.
    """
    parts = [  # the first one has the heading of the page
        "\n".join([f"<h2>{escape(one.title)}</h2>" if k else "", one.html, *map(figure_html, one.figures)])
        for k, one in enumerate(sections)
    ]
    if sections:  # the page is about more than this recording
        parts.append(f'<h2>{escape(recording.name)}</h2><p class="lead">{_lead(summary)}</p>')
    parts += [
        _verdict(result),
        cards_html(_cards(summary)),
        _INTERRUPTED if summary["interrupted"] else "",
        _changes(result, summary),
        warnings_note(summary["warnings"]),
        _figures("Accuracy", figures, ("map", "errors"), _frames(summary)),
        _figures("Sensor calibration", figures, ("calibration",), _calibration(result)),
        _figures("Calibration of the uncertainty", figures, ("consistency",), _consistency(summary)),
        _figures("Cost", figures, ("latency",), ""),
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
        text += f"; {counts['robot_sightings']:,} sightings of other robots, used by evermap together"
    return f"{text}.<br>Read from <code>{escape(source)}</code>." if source else f"{text}."


def _verdict(result: SlamResult) -> str:
    """Return how far the run can be trusted, and all that was asked, the alarming first."""
    verdict = result.verdict
    if verdict is None:
        return ""
    rows = [
        (escape(one.code), escape(one.message), "beyond" if one.is_alarming else "fine") for one in verdict.symptoms
    ]
    causes = "".join(f"<li>{escape(cause_text(one))}</li>" for one in further_causes(verdict))
    asked = table(("symptom", "here, and what is expected", ""), rows) if rows else ""
    return (
        f'<p class="note"><strong>{escape(verdict.text)}</strong></p>'
        + (f"<ul>{causes}</ul>" if causes else "")
        + (f"<details><summary>Why</summary>{asked}</details>" if asked else "")
    )


_INTERRUPTED = '<p class="note">Stopped before the end of the recording: all results are for the part until then.</p>'


def _changes(result: SlamResult, summary: Mapping[str, Any]) -> str:
    """Return the changes in words and numbers, with the alternatives; '' if there are none."""
    lines = explanations(result) + grew(summary["counts"].get("landmarks_grown"))
    if not lines:
        return ""
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    note = ""
    if near_alternatives(result):
        note = (
            "<p>The recording cannot rule out the explanations after 'or'. Their maps are in"
            " <code>alternative_1.geojson</code> and so on, the most probable first.</p>"
        )
    return f"<h2>What changed</h2><ul>{items}</ul>{change_table(result)}{note}"


def _figures(title: str, figures: Sequence[NamedFigure], names: tuple[str, ...], html: str) -> str:
    shown = [figure for figure in figures if figure.name in names]
    if not shown and not html:
        return ""
    return "\n".join([f"<h2>{escape(title)}</h2>", *map(figure_html, shown), html])


def _frames(summary: Mapping[str, Any]) -> str:
    """Return the section on frames, and on the alignment with the truth."""
    rows = [(escape(name), escape(meaning)) for name, meaning in summary["frames"].items()]
    rows.append(("up in the map", escape(summary["up"]["text"])))
    alignment = summary["metrics"]["alignment"]
    pose = alignment["pose_truth_estimate"]
    if pose is not None:
        turn = "rad" if "theta_rad" in pose else "quaternion x, y, z, w"
        angle = ", ".join(f"{pose[name]:.4f}" for name in ("theta_rad", "qx", "qy", "qz", "qw") if name in pose)
        shift = ", ".join(f"{value:.3f}" for name, value in pose.items() if name.endswith("_m"))
        how = (
            f"truth = R({angle} {turn}) · estimate + ({shift}) m, by"
            f" {escape(alignment['method'])} on {alignment['scored_stamps']} positions at {alignment['rate_hz']:g} Hz,"
            f" {alignment['scored_from_s']:.1f} s to {alignment['scored_to_s']:.1f} s; {escape(alignment['purpose'])}."
            " Odometry alone and the online poses are aligned separately."
        )
        rows.append(("alignment", how))
    return f"<h3>Frames</h3>{table(('what', 'meaning'), rows)}"


def _calibration(result: SlamResult) -> str:
    """Calibration states and noise levels, which are named `sigma_...`, with uncertainty and prior."""
    parts = {"Calibration states": False, "Noise levels": True}
    chosen = {
        title: [parameter for parameter in result.parameters if parameter.name.startswith("sigma_") is noise]
        for title, noise in parts.items()
    }
    tables = "".join(f"<h3>{title}</h3>{_parameters(those)}" for title, those in chosen.items() if those)
    return tables + "".join(f"<p>{escape(_sentence(pair.text))}</p>" for pair in result.undecided)


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _consistency(summary: Mapping[str, Any]) -> str:
    metrics = summary["metrics"]
    dof = metrics["nees_dof"] or 2
    rows = [
        ("NIS, mean of the inliers", _cell(metrics["nis_mean"]), "2"),
        ("NIS, mean of all", _cell(metrics["nis_mean_all"]), "2 without outliers"),
        ("NIS, median of all", _cell(metrics["nis_median"]), "1.39"),
        ("NIS, share below the 95% bound", _cell(metrics["nis_in_band_share"], "{:.1%}"), "95%"),
        ("NIS, correlation between a landmark's successive values", _cell(metrics["nis_lag1_autocorrelation"]), "0"),
        ("detections judged outliers", _cell(metrics["outlier_share"], "{:.2%}"), ""),
        ("NEES of positions, aligned", _cell(metrics["pose_nees_mean"]), f"below {dof}: alignment removes error"),
        (
            "NEES of positions, first pose held",
            _cell(metrics["pose_nees_anchored_mean"]),
            f"{dof}; one sample, large scatter",
        ),
        ("NEES of whole poses, aligned", _cell(metrics["whole_pose_nees_mean"]), f"below {3 * dof - 3}"),
        ("NEES of landmarks, aligned", _cell(metrics["landmark_nees_mean"]), f"below {dof}: alignment removes error"),
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
    rows.append(("files in this folder", files))
    return (
        f"<h2>Source and settings</h2>{table(('what', ''), rows)}"
        f"<details><summary>Configuration</summary><pre>{config}</pre></details>"
    )


def _footer(summary: Mapping[str, Any]) -> str:
    timing = summary["timing"]
    text = f"Made by evermap {escape(str(summary['evermap']))}"
    if timing["written_at"]:
        text += f", {escape(timing['written_at'])}"
    return text + ". All numbers of this page are in <code>summary.json</code>."


def _cards(summary: Mapping[str, Any]) -> list[str | None]:
    """Cards for the numbers this run has, each with a sentence that says what it means."""
    metrics, timing = summary["metrics"], summary["timing"]
    odometry, pose = metrics["dead_reckoning_rmse_m"], metrics["pose_rmse_m"]
    turn, odometry_turn = metrics["orientation_rmse_deg"], metrics["dead_reckoning_orientation_rmse_deg"]
    turned = "Orientation error" if metrics["heading_rmse_deg"] is None else "Heading error"
    return [
        card("Position error", pose, "{:.3f}", "m RMSE", _gain(pose, odometry, "{:.2f} m")),
        card(turned, turn, "{:.2f}", "° RMSE", _gain(turn, odometry_turn, "{:.1f}°")),
        _landmark_card(metrics),
        card("Speed", timing["real_time_factor"], "{:.0f}", "× real time", _latency(timing)),
        card("Innovations", metrics["nis_mean"], "{:.2f}", "mean NIS", _nis(metrics)),
        card("Online position error", metrics["online_pose_rmse_m"], "{:.3f}", "m RMSE",
             "Causal poses, without later detections, while landmarks were in view."),
    ]  # fmt: skip


def _gain(value: float | None, odometry: float | None, form: str) -> str:
    if value is None or odometry is None:
        return "Compared with the truth, after aligning the whole path."
    ratio = odometry / max(value, 1e-9)
    times = (
        "no worse" if ratio < 1.05 else f"{ratio:.1f} times as much" if ratio < 9.95 else f"{ratio:.0f} times as much"
    )
    return f"Odometry alone is {form.format(odometry)} off: {times}."


def _landmark_card(metrics: Mapping[str, Any]) -> str | None:
    after_path, own = metrics["landmark_rmse_m"], metrics["landmark_rmse_own_alignment_m"]
    scored, least = metrics["landmarks_scored"], metrics["landmark_min_sightings"]
    how = (
        "after the alignment of the path" if after_path is not None else "aligned by themselves: there is no true path"
    )
    meaning = f"{scored} landmarks with at least {least} sightings, {how}."
    return card("Landmark error", own if after_path is None else after_path, "{:.3f}", "m RMSE", meaning)


def _latency(timing: Mapping[str, Any]) -> str:
    if timing["step_p99_ms"] is None:
        return "Duration of the recording over the time it took."
    if timing["step_max_ms"] == timing["step_p50_ms"]:
        return "Duration of the recording over the time it took, all frames together."
    p50, p99 = timing["step_p50_ms"], timing["step_p99_ms"]
    return f"99% of the steps were done within {p99:.1f} ms, half within {p50:.1f} ms."


def _nis(metrics: Mapping[str, Any]) -> str:
    mean = metrics["nis_mean"]
    if mean is None:
        return "No detection was judged an inlier: the readings do not fit the estimate."
    return f"2 is expected: {innovations_text(mean)}. {metrics['nis_in_band_share']:.0%} lie below the 95% bound."


_MAX_LANDMARK_ROWS = 500


def _alone(parameter: ParameterEstimate) -> str:
    """The other reading of an error that only shows together with another one."""
    if not parameter.shown_with or abs(parameter.alone - parameter.value) < 1e-9:
        return ""
    return escape(f", or {quantity(parameter.alone, 0.0, parameter.unit)} without {parameter.shown_with}")


def _parameters(parameters: Sequence[ParameterEstimate]) -> str:
    rows = [
        (
            f"<code>{escape(p.name)}</code>",
            escape(quantity(p.value, 0.0 if p.fixed else p.sigma, p.unit)) + _say_why_held(p) + _alone(p),
            escape(quantity(p.prior_mean, p.prior_sigma, p.unit)) if has_prior(p) else "–",
            _find_gain(p),
            escape(p.meaning),
        )
        for p in parameters
    ]
    return table(("name", "estimate, 1σ", "prior, 1σ", "narrower", "meaning"), rows, numbers=(1, 2, 3))


def _say_why_held(parameter: ParameterEstimate) -> str:
    """Why a state was not estimated."""
    if not parameter.fixed:
        return ""
    if math.isnan(parameter.p_needed):
        return " <small>fixed</small>"
    return " <small>as stated</small>"


def _find_gain(parameter: ParameterEstimate) -> str:
    """Return the ratio of the prior's to the estimate's standard deviation."""
    if not has_prior(parameter) or not 0 < parameter.sigma < math.inf:
        return "–"
    return f"{parameter.prior_sigma / parameter.sigma:.3g} ×"


def change_table(result: SlamResult) -> str:
    """Return every change with its numbers, times as dates or since the start of the recording; '' if there is none."""
    if not result.changes:
        return ""
    clock = result.landmarks.clock
    start_s = float(result.trajectory.stamp_s[0]) if clock is Clock.RECORDING and len(result.trajectory) else 0.0
    rows = [
        (
            ", ".join(change.labels),
            change.kind.value,
            *(stamp_text(stamp_s - start_s, clock) for stamp_s in (change.stamp_from_s, change.stamp_to_s)),
            *(_number(metres, 3) for metres in change.displacement_m),
            _number(math.degrees(change.rotation_rad), 2),
            f"{change.probability:.4f}",
        )
        for change in result.changes
    ]
    zone = {Clock.RECORDING: "since the start", Clock.UNIX: "UTC"}.get(clock, "local clock")
    head = ("landmarks", "kind", f"not before ({zone})", f"not after ({zone})")
    steps = [f"Δ{axis} [m]" for axis in "xyz"[: len(result.changes[0].displacement_m)]]
    columns = (*head, *steps, "turn [°]", "probability")
    return table(columns, rows, numbers=range(2, len(columns)))


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "–"


def landmark_table(result: SlamResult, evaluation: Evaluation) -> str:
    """Return the map, landmark by landmark, with its error where surveyed; '' if it is empty."""
    landmarks, errors = result.landmarks, evaluation.landmarks or evaluation.landmarks_own
    if len(landmarks) == 0:
        return ""
    known = () if errors is None else (1e3 * errors.error_m, errors.nees, np.degrees(errors.orientation_error_rad))
    of = {} if errors is None else dict(zip(errors.landmark_id.tolist(), np.column_stack(known), strict=True))
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(landmarks.covariance_m2)[:, -1], 0.0))
    oriented = errors is not None and bool(np.isfinite(errors.orientation_error_rad).any())
    rows = []
    labels = landmarks.labels
    for i, name in enumerate(landmarks.landmark_id[:_MAX_LANDMARK_ROWS].tolist()):
        kind = int(landmarks.class_id[i])
        error_mm, nees, turn_deg = of.get(name, np.full(3, np.nan))
        rows.append(
            (
                escape(labels[i]),
                escape(landmarks.class_names[kind]) if UNKNOWN < kind < len(landmarks.class_names) else "–",
                f"{landmarks.n_hits[i]:,}",
                f"{landmarks.n_misses[i]:,}",
                *(f"{metres:.3f}" for metres in landmarks.position_m[i]),
                f"{2e3 * sigma[i]:.0f}",
                _number(error_mm, 0),
                _number(nees, 1),
                *([_number(turn_deg, 1)] if oriented else []),
            )
        )
    places = [f"{axis} [m]" for axis in "xyz"[: landmarks.position_m.shape[1]]]
    head = ("id", "class", "seen", "missed", *places, "2σ [mm]", "error [mm]", "NEES", *["turned [°]"] * oriented)
    html = table(head, rows, numbers=range(2, len(head)))
    more = len(landmarks) - len(rows)
    return html + (f"<p>{more} more are in <code>map.parquet</code>.</p>" if more > 0 else "")
