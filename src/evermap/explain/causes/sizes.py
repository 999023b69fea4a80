"""Sizes of tags, scales of what sensors measure, and what ranges of one landmark are too long by."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from evermap.explain.causes.suspect import RARE_P, SCALE, USUAL_P, Inputs, Suspect, rows_of_kind
from evermap.slam.space.intake import without_range
from evermap.types import BoolArray, SpatialRecording

ONE_TAG = 0.3
"""Standard deviation of the logarithm of the size of one tag, or of one kind of tags."""
ONE_BIAS_M = 0.5
"""Standard deviation of what all ranges of one landmark are too long by. A delay of its antenna that is 1 ns off, of a
two-way exchange, is .15 to .3 m, and .2 m of concrete in the line of sight (relative permittivity 6) are .3 m; both, or
two walls, are met as well."""
ONE_BIAS_P = 3e-4
"""Probability beforehand of that, of each landmark: as that one of eight has moved by itself before a session, which is
`p_moved` / 4 over their number (`ChangesConfig`). It is met as often as other usual causes (`USUAL_P`), and is of one.
"""
LEAST_RANGE_M = 1e-3
"""Range that is left, at least, when a bias is taken off."""


def suspect_size_of_one(subject: str, stretch: Callable[..., Inputs], of: tuple[str, float], key: str) -> Suspect:
    """Return that one landmark is of another size than the sensor takes it to be.

    Args:
        subject: its name.
        stretch: `stretch_ranges` or `stretch_positions`.
        of: which detections are of it, as `Suspect.rows`.
        key: its stated size [m]; '' where none is.
    """
    return Suspect(
        "tag-size", subject, RARE_P, partial(stretch, of=of),
        lambda s: f"landmark {subject} is {math.exp(s):.4g} times as large, or as far, as the sensor takes it to be",
        lambda s: f"[tags.sizes] {subject} = {float(key) * math.exp(s):.4g}" if key else "the size of this tag",
        ONE_TAG, math.exp, rows=of,
    )  # fmt: skip


def suspect_bias_of_one(subject: str, of: tuple[str, float]) -> Suspect:
    """Return that all ranges of one landmark, a radio, are too long or too short by as many metres.

    Its price is that of a move: where the two look alike, neither is preferred.

    Args:
        subject: its name.
        of: which detections are of it, as `Suspect.rows`.
    """
    return Suspect(
        "range-bias", subject, ONE_BIAS_P, partial(shorten_ranges, of=of),
        lambda s: f"ranges of landmark {subject} are {abs(s):.3g} m too {'long' if s > 0.0 else 'short'}: the delay of "
        "its antenna, or a wall in the line of sight",
        lambda s: f"detections.csv: range_m of landmark {subject} {'-' if s > 0.0 else '+'} {abs(s):.3g}",
        ONE_BIAS_M, rows=of,
    )  # fmt: skip


def suspect_size_of_kind(subject: str, stretch: Callable[..., Inputs], of: tuple[str, float], key: str) -> Suspect:
    """Return the same of all landmarks of a class or of a size."""
    return Suspect(
        "tag-size", subject, USUAL_P, partial(stretch, of=of),
        lambda s: f"landmarks of {subject} are {math.exp(s):.4g} times as large as the sensor takes them to be",
        lambda s: f"[tags] size_m = {float(key) * math.exp(s):.4g}" if key else "the size of these tags",
        ONE_TAG, math.exp, rows=of,
    )  # fmt: skip


def suspect_size_of_all(size: str) -> Suspect:
    """Return that all tags are of another size than stated [m]; '' where several sizes, or none, are stated."""
    return Suspect(
        "tag-size", "all tags", USUAL_P, partial(stretch_positions, of=None),
        lambda s: (f"tags are {float(size) * math.exp(s):.4g} m large, not {float(size):.4g} m" if size
                   else f"tags are {math.exp(s):.4g} times as large as stated"),
        lambda s: (f"[tags] size_m = {float(size) * math.exp(s):.4g}" if size
                   else f"[tags] sizes x {math.exp(s):.4g}"),
        SCALE, math.exp,
    )  # fmt: skip


def suspect_scale_of_sensor(row: int, name: str) -> Suspect:
    """Return that one of several sensors measures in another scale than the others."""
    return Suspect(
        "sensor-scale", name, USUAL_P, partial(stretch_positions, of=("sensor", row)),
        lambda s: f"{name} measures {math.exp(-s):.4g} times too {'long' if s < 0.0 else 'short'}: true distances are "
        f"{math.exp(s):.4g} times those of its detections",
        lambda s: f"detections.csv of {name}: x_m, y_m, z_m x {math.exp(s):.4g}",
        SCALE, math.exp, rows=("sensor", row),
    )  # fmt: skip


def has_scale(recording: SpatialRecording) -> BoolArray:
    """Return (S,) sensors whose detections may have another scale; that of a camera that reads corners is its lens."""
    seen, cameras = recording.detections, np.array([one.intrinsics is not None for one in recording.sensors])
    corners = cameras[seen.sensor] & np.isfinite(seen.corner_px[:, 0, 0])
    found = np.bincount(seen.sensor[~(corners | without_range(recording))], minlength=len(cameras)) > 0
    return np.asarray(found & ~np.isin(np.arange(len(cameras)), seen.sensor[corners]))


def stretch_ranges(inputs: Inputs, state: float, of: tuple[str, float] | None) -> Inputs:
    """Return the same with ranges in the plane, those of `rows_of_kind`, longer by a factor of logarithm `state`."""
    recording: Any = inputs.recording
    mine = rows_of_kind(recording, of)
    seen, factor = recording.detections, np.where(mine, math.exp(state), 1.0)
    further = replace(seen, range_m=seen.range_m * factor, sigma_range_m=seen.sigma_range_m * factor)
    return replace(
        inputs,
        recording=replace(recording, detections=further),
        stretched=inputs.stretched + state * mine,
    )


def shorten_ranges(inputs: Inputs, state: float, of: tuple[str, float] | None) -> Inputs:
    """Return the same with ranges in the plane, those of `rows_of_kind`, shorter by `state` metres."""
    recording: Any = inputs.recording
    mine, seen = rows_of_kind(recording, of), recording.detections
    shorter = np.where(mine, np.maximum(seen.range_m - state, LEAST_RANGE_M), seen.range_m)
    return replace(inputs, recording=replace(recording, detections=replace(seen, range_m=shorter)))


def stretch_positions(inputs: Inputs, state: float, of: tuple[str, float] | None) -> Inputs:
    """Return the same with positions in space, those of `rows_of_kind`, farther by a factor of logarithm `state`."""
    recording: Any = inputs.recording
    mine, seen = rows_of_kind(recording, of), recording.detections
    factor = np.where(mine, math.exp(state), 1.0)
    further = replace(
        seen,
        position_sensor_m=seen.position_sensor_m * factor[:, None],
        covariance_sensor_m2=seen.covariance_sensor_m2 * factor[:, None, None] ** 2,
        tag_size_m=seen.tag_size_m * factor,
    )
    cameras = np.array([sensor.intrinsics is not None for sensor in recording.sensors])[seen.sensor]
    read = ~(cameras & np.isfinite(seen.corner_px[:, 0, 0]))  # of others the position was measured
    return replace(
        inputs,
        recording=replace(recording, detections=further),
        stretched=inputs.stretched + 3.0 * state * (mine & read),
    )
