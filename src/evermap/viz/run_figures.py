"""The figures of a run, as one would print them in a paper: map, errors, consistency, latency, calibration."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.estimate.innovations import comparable_nis
from evermap.geometry.group import PLANE, group_of
from evermap.metrics.consistency import chi2_interval, chi2_quantile, running_mean
from evermap.metrics.summary import Evaluation
from evermap.metrics.trajectory import PoseErrors
from evermap.types import AnyRecording, Clock, FloatArray, ParameterEstimate, SlamResult, stamp_text
from evermap.viz.map_figure import draw_map
from evermap.viz.panels import BLIND_S, with_breaks
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    ESTIMATE_BAND,
    GRID,
    INK,
    MUTED,
    ODOMETRY,
    ONLINE,
    SHADE,
    NamedFigure,
    house_style,
    new_figure,
    settle,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_figures(
    recording: AnyRecording, result: SlamResult, evaluation: Evaluation, *, real_time_factor: float | None = None
) -> tuple[NamedFigure, ...]:
    """Return all figures with content for this run, in the order of the report.

    Args:
        recording: what was processed.
        result: what came out.
        evaluation: `compare_with_truth(recording, result)`.
        real_time_factor: duration of the recording over processing time, for the latency figure.
    """
    with house_style():
        drawn = (
            draw_map(recording, result, evaluation),
            draw_errors(recording, result, evaluation),
            draw_consistency(result),
            draw_latency(recording, result, real_time_factor),
            draw_calibration(result),
        )
        figures = tuple(figure for figure in drawn if figure is not None)
        for named in figures:
            settle(named.figure)
    return figures


_RASTER_FROM = 1500
"""Number of points above which they are embedded as pixels, to keep vector files small."""


def blind_stretches(stamp_s: FloatArray, longer_than_s: float = BLIND_S) -> FloatArray:
    """Return (B, 2) start and end of the gaps between frames."""
    gaps = np.flatnonzero(np.diff(stamp_s) > longer_than_s)
    return np.stack([stamp_s[gaps], stamp_s[gaps + 1]], axis=1) if len(gaps) else np.zeros((0, 2))


def draw_errors(recording: AnyRecording, result: SlamResult, evaluation: Evaluation) -> NamedFigure:
    """Draw errors of position and heading, in space orientation, with 2-sigma bands; bands alone without truth."""
    figure = new_figure(7.2, 4.2)
    above, below = figure.subplots(2, 1, sharex=True)
    start_s = _start(recording)
    poses = evaluation.poses
    known = result.trajectory if poses is None else poses
    time, covariance = known.stamp_s - start_s, known.covariance
    group = group_of(result.trajectory.pose_world_robot)
    size, turn = group.point_dim, "heading" if group is PLANE else "orientation"
    position_band = 2.0 * np.sqrt(np.trace(covariance[:, :size, :size], axis1=1, axis2=2))
    turn_band = 2.0 * np.degrees(np.sqrt(np.trace(covariance[:, size:, size:], axis1=1, axis2=2)))

    blind = blind_stretches(recording.frames.stamp_s) - start_s
    for axes in (above, below):
        for k, (begin, end) in enumerate(blind):
            axes.axvspan(begin, end, color=SHADE, lw=0, zorder=0, label=f"blind > {BLIND_S:g} s" if k == 0 else None)
    lowest = -1.0 if group is PLANE else 0.0  # headings have a sign, angles in space have none
    above.fill_between(time, 0, position_band, color=ESTIMATE_BAND, lw=0, zorder=1, label="2σ expected")
    below.fill_between(time, lowest * turn_band, turn_band, color=ESTIMATE_BAND, lw=0, zorder=1)
    top, side = (1.12 * float(np.max(band, initial=0.0)) for band in (position_band, turn_band))
    if poses is not None:
        online = evaluation.online
        if online is not None:
            errors = np.column_stack([online.position_error_m, _turn_deg(online)])
            stamps, causal = with_breaks(online.stamp_s, errors)
            label = f"online (RMSE {online.rmse_m:.3f} m)"
            above.plot(stamps - start_s, causal[:, 0], color=ONLINE, lw=0.8, label=label)
            below.plot(stamps - start_s, causal[:, 1], color=ONLINE, lw=0.8)
        turned = _turn_deg(poses)
        above.plot(time, poses.position_error_m, color=ESTIMATE, lw=1.1, label=f"smoothed (RMSE {poses.rmse_m:.3f} m)")
        below.plot(time, turned, color=ESTIMATE, lw=1.1)
        below.axhline(0, color=MUTED, lw=0.7)
        top = max(1.12 * poses.max_m, min(top, 3.0 * poses.max_m))
        most = float(np.max(np.abs(turned)))
        side = max(1.12 * most, min(side, 3.0 * most))
    above.set(ylim=(0, top or None), ylabel="position error [m]" if poses else "2σ of position [m]")
    ylabel = f"{turn} error [°]" if poses else f"2σ of {turn} [°]"
    below.set(ylim=(lowest * side, side) if side else None, ylabel=ylabel, xlabel=_since_start(recording))
    _span(below, recording)
    figure.legend(*above.get_legend_handles_labels(), loc="outside upper center", ncols=4)
    title = "Error over time" if poses else "Uncertainty over time"
    return NamedFigure("errors", figure, title, _error_caption(evaluation, len(blind)))


def _turn_deg(errors: PoseErrors) -> FloatArray:
    """Errors of headings, signed; in space of orientations."""
    plane = group_of(errors.estimate) is PLANE
    return np.asarray(np.degrees(errors.heading_error_rad if plane else errors.orientation_error_rad))


def draw_consistency(result: SlamResult) -> NamedFigure | None:
    """Draw the NIS over time with its 95% band and running mean, and its histogram against the chi-square density."""
    values, stamps = comparable_nis(result.innovations), result.innovations.stamp_s
    finite = np.isfinite(values)
    if not np.any(finite):
        return None
    nis, stamps = values[finite], stamps[finite]
    inlier = result.innovations.p_inlier[finite] >= 0.5
    figure = new_figure(7.2, 3.3)
    left, right = figure.subplots(1, 2, width_ratios=(2.1, 1))
    time = stamps - stamps[0]
    low, high = chi2_interval(2)
    left.axhspan(low, high, color=ESTIMATE_BAND, lw=0, zorder=0, label=f"95% band, {low:.2f} to {high:.2f}")
    style = {"lw": 0, "ms": 2.2, "mec": "none", "rasterized": len(nis) > _RASTER_FROM}
    faint = float(np.clip(700.0 / len(nis), 0.06, 0.35))
    left.plot(time[inlier], nis[inlier], "o", color=ESTIMATE, alpha=faint, zorder=2, **style)
    left.plot([], [], "o", color=ESTIMATE, alpha=0.6, ms=3, mec="none", lw=0, label="detection")
    if not np.all(inlier):
        left.plot(time[~inlier], nis[~inlier], "x", color=ALERT, ms=3.5, mew=0.9, lw=0, label="judged an outlier")
    window = int(np.clip(np.count_nonzero(inlier) // 20, 10, 200))
    smooth = running_mean(nis[inlier], window)
    mean_low, mean_high = chi2_interval(2, window)
    left.plot(*with_breaks(time[inlier], smooth), color=INK, lw=1.3, label=f"running mean of {window}", zorder=4)
    left.axhspan(mean_low, mean_high, color=ODOMETRY, alpha=0.35, lw=0, zorder=3, label="its 95% band")
    left.set_yscale("log")
    left.set(xlabel="time since the first [s]", ylabel="NIS [1]", ylim=(max(nis.min(), 3e-3), max(nis.max(), 20) * 1.6))

    edge = 14.0
    kept = nis[inlier]
    beyond = float(np.mean(kept > edge)) if len(kept) else 0.0
    if len(kept):
        counts, edges = np.histogram(kept, bins=np.linspace(0, edge, 29))
        density = counts / len(kept) / np.diff(edges)
        right.stairs(density, edges, fill=True, color=ESTIMATE, alpha=0.45, label="detections")
    grid = np.linspace(0, edge, 200)
    right.plot(grid, np.exp(-grid / 2.0) / 2.0, color=INK, lw=1.3, label="χ², 2 d.o.f.")
    usual = chi2_quantile(0.95, 2)
    right.axvline(usual, color=MUTED, lw=0.9, ls="--")
    right.text(usual + 0.2, 0.93, "95%", size=8, color=MUTED, transform=right.get_xaxis_transform())
    right.set(xlabel="NIS [1]", ylabel="density [1]", xlim=(0, edge), ylim=(0, None))
    right.legend(loc="center right")
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper left", ncols=5, columnspacing=1.1)
    caption = (
        "Squared Mahalanobis distance of every detection from its prediction, before it was used. If the noise levels "
        "are right the mean is 2 and 95% are below 5.99."
    )
    if result.innovations.dof is not None:
        caption += " Detections of more than two numbers are converted by their tail probability."
    if len(kept):
        caption += f" Here: mean {kept.mean():.2f}, {np.mean(kept <= usual):.1%} below"
        caption += f", {np.mean(~inlier):.1%} judged outliers" + (f", {beyond:.1%} beyond the axis." if beyond else ".")
    return NamedFigure("consistency", figure, "Innovation consistency", caption)


def draw_latency(recording: AnyRecording, result: SlamResult, real_time_factor: float | None) -> NamedFigure | None:
    """Draw the processing time of every step, with the median, the 99th percentile and the time there was."""
    count = len(result.step_s)
    if count == 0 or len(result.online) != count:  # frames that were solved together
        return None
    stamps, step_ms = result.online.stamp_s, 1e3 * np.maximum(result.step_s, 1e-7)
    p50, p99 = np.percentile(step_ms, [50, 99])
    figure = new_figure(7.2, 2.7)
    axes = figure.add_subplot()
    look: Any = {"color": ESTIMATE, "ms": 2, "mec": "none", "alpha": 0.4, "rasterized": count > _RASTER_FROM}
    axes.plot(stamps - _start(recording), step_ms, "o", **look)
    axes.set_yscale("log")
    lines = [(p50, INK, f"median {p50:.2g} ms"), (p99, ALERT, f"99% {p99:.2g} ms")]
    if count > 1:
        budget = 1e3 * float(np.median(np.diff(stamps)))
        lines.append((budget, MUTED, f"frame interval {budget:.3g} ms"))
    for level, colour, label in lines:
        axes.axhline(level, color=colour, lw=1.1, ls="--" if colour == MUTED else "-", label=label)
    axes.set(xlabel=_since_start(recording), ylabel="time per step [ms]")
    _span(axes, recording)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    caption = "Wall-clock time from a frame's arrival to its pose, on one core."
    if real_time_factor is not None:
        caption += f" The whole recording was processed at {real_time_factor:.0f} times real time."
    return NamedFigure("latency", figure, "Step latency", caption)


def _start(recording: AnyRecording) -> float:
    return float(recording.frames.stamp_s[0]) if len(recording.frames) else 0.0


def _since_start(recording: AnyRecording) -> str:
    """Label of an axis of seconds, with the date of the first frame where it is known."""
    if recording.clock is Clock.RECORDING or not len(recording.frames):
        return "time since the first frame [s]"
    zone = "UTC" if recording.clock is Clock.UNIX else "local clock"
    return f"time since the first frame, {stamp_text(_start(recording), recording.clock)} {zone} [s]"


def _span(axes: Axes, recording: AnyRecording) -> None:
    stamps = recording.frames.stamp_s
    if len(stamps) > 1:
        axes.set_xlim(0, float(stamps[-1] - stamps[0]))


def _error_caption(evaluation: Evaluation, blind: int) -> str:
    poses = evaluation.poses
    if poses is None:
        return "Uncertainty relative to the first pose; the recording has no pose truth to compare with."
    text = (
        f"After SE({poses.dof}) alignment: {poses.rmse_m:.3f} m and {poses.orientation_rmse_deg:.2f}° RMSE,"
        f" {poses.max_m:.2f} m at worst. The band is twice the estimated standard deviation relative to the first "
        f"pose; alignment makes errors a little smaller."
    )
    if evaluation.online is not None:
        text += " Online poses are causal, scored at frames of the sensor."
    return text + (f" {blind} stretches without any frame are shaded." if blind > 1 else "")


def quantity(value: float, sigma: float, unit: str) -> str:
    """Return `0.2104 ± 0.0038 s`: two digits of the uncertainty decide how many the value gets."""
    suffix = "" if unit == "1" else f" {unit.replace('^2', '²')}"
    if not math.isfinite(sigma) or sigma <= 0:
        return f"{value:.4g}{suffix}".replace("-", "\N{MINUS SIGN}", 1)
    decimals = int(np.clip(1 - math.floor(math.log10(sigma)), 0, 9))
    return f"{value:.{decimals}f} ± {sigma:.{decimals}f}{suffix}".replace("-", "\N{MINUS SIGN}", 1)


def has_prior(parameter: ParameterEstimate) -> bool:
    """Return whether it was estimated against a finite prior."""
    return not parameter.fixed and math.isfinite(parameter.prior_mean) and 0 < parameter.prior_sigma < math.inf


def draw_calibration(result: SlamResult) -> NamedFigure | None:
    """Return estimates in units of their prior's standard deviation, numbers beside them; None without any prior."""
    shown = [parameter for parameter in result.parameters if has_prior(parameter)]
    if not shown:
        return None
    figure = new_figure(7.2, 0.9 + 0.34 * len(shown))
    axes = figure.add_subplot()
    rows = np.arange(len(shown))[::-1]
    shift = np.array([(p.value - p.prior_mean) / p.prior_sigma for p in shown])
    spread = np.array([p.sigma / p.prior_sigma for p in shown])
    axes.barh(rows, 4.0, left=-2.0, height=0.62, color=GRID, alpha=0.6, lw=0, label="prior, 2σ", zorder=1)
    axes.axvline(0, color=MUTED, lw=0.8, zorder=2)
    look: Any = {"color": ESTIMATE, "ms": 4.5, "capsize": 3, "lw": 1.6, "label": "estimate, 2σ", "zorder": 3}
    axes.errorbar(shift, rows, xerr=2 * spread, fmt="o", **look)
    reach = max(2.6, 1.1 * float(np.max(np.abs(shift) + 2 * spread)))
    axes.set(xlim=(-reach, reach), ylim=(-0.6, len(shown) - 0.4))
    axes.set_yticks(rows, [p.name for p in shown])
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("distance from the prior mean [prior standard deviations]")
    for row, parameter in zip(rows, shown, strict=True):
        text = quantity(parameter.value, parameter.sigma, parameter.unit)
        axes.text(1.02, row, text, transform=axes.get_yaxis_transform(), va="center", size=8, color=INK)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    caption = (
        "Estimated calibration states in units of their prior standard deviations: a bar much shorter than the grey "
        "one was learned from the data; a bar as long as the grey one is unobservable."
    )
    return NamedFigure("calibration", figure, "Calibration", caption)
