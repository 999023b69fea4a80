"""The few numbers one looks at first, each with a sentence that says what it means."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any


def headline_cards(summary: Mapping[str, Any]) -> str:
    """Cards for the numbers this run has, as a definition list."""
    cards = [card for card in _cards(summary) if card is not None]
    return f'<dl class="cards">{"".join(cards)}</dl>' if cards else ""


def _cards(summary: Mapping[str, Any]) -> list[str | None]:
    metrics, timing = summary["metrics"], summary["timing"]
    odometry, pose = metrics["dead_reckoning_rmse_m"], metrics["pose_rmse_m"]
    heading, odometry_heading = metrics["heading_rmse_deg"], metrics["dead_reckoning_heading_rmse_deg"]
    return [
        _card("Position error", pose, "{:.3f}", "m RMSE", _gain(pose, odometry, "{:.2f} m")),
        _card("Heading error", heading, "{:.2f}", "° RMSE", _gain(heading, odometry_heading, "{:.1f}°")),
        _landmark_card(metrics),
        _card("Speed", timing["real_time_factor"], "{:.0f}", "× real time", _latency(timing)),
        _card("Innovations", metrics["nis_mean"], "{:.2f}", "mean NIS", _nis(metrics)),
        _card(
            "Online position error",
            metrics["online_pose_rmse_m"],
            "{:.3f}",
            "m RMSE",
            "What the robot knew at the time, without hindsight, while it saw something.",
        ),
    ]


def _card(label: str, value: float | None, form: str, unit: str, meaning: str) -> str | None:
    if value is None:
        return None
    number = f'<dd class="number">{escape(form.format(value))} <small>{escape(unit)}</small></dd>'
    return f'<div class="card"><dt>{escape(label)}</dt>{number}<dd><p>{escape(meaning)}</p></dd></div>'


def _gain(value: float | None, odometry: float | None, form: str) -> str:
    if value is None or odometry is None:
        return "Against truth, after aligning the whole path to it."
    ratio = odometry / max(value, 1e-9)
    times = (
        "no worse" if ratio < 1.05 else f"{ratio:.1f} times as much" if ratio < 9.95 else f"{ratio:.0f} times as much"
    )
    return f"Odometry alone is {form.format(odometry)} off: {times}."


def _landmark_card(metrics: Mapping[str, Any]) -> str | None:
    after_path, own = metrics["landmark_rmse_m"], metrics["landmark_rmse_own_alignment_m"]
    scored, least = metrics["landmarks_scored"], metrics["landmark_min_sightings"]
    if after_path is not None:
        meaning = f"{scored} landmarks with at least {least} sightings, after the alignment of the path."
        return _card("Landmark error", after_path, "{:.3f}", "m RMSE", meaning)
    meaning = f"{scored} landmarks with at least {least} sightings, aligned among themselves: there is no true path."
    return _card("Landmark error", own, "{:.3f}", "m RMSE", meaning)


def _latency(timing: Mapping[str, Any]) -> str:
    if timing["step_p99_ms"] is None:
        return "Duration of the recording over the time it took."
    p50, p99 = timing["step_p50_ms"], timing["step_p99_ms"]
    return f"99% of the steps were done within {p99:.1f} ms, half within {p50:.1f} ms."


def _nis(metrics: Mapping[str, Any]) -> str:
    mean = metrics["nis_mean"]
    if mean > 2.6:
        verdict = "errors are larger than it believes"
    elif mean < 1.4:
        verdict = "errors are smaller than it believes"
    else:
        verdict = "its uncertainties are about right"
    return f"2 is expected: {verdict}. {metrics['nis_in_band_share']:.0%} lie below the 95% bound."
