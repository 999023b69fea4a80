"""Detections without a bearing, as of UWB radios: a first value for it, which counts for nothing.

The estimator reads such a detection as one of a bearing that is known to `ANY_BEARING_RAD`: only its range matters. But
its solution begins where the landmark seems to be, and a range alone leaves a circle. So each landmark is first located
by its ranges from several poses, which the odometry ties for a while: least squares from many starts, with tails for
ranges that are too long, and an unknown offset. The place holds if it is narrow, and no other place is nearly as good,
such as the mirrored one of a drive straight on; otherwise ranges from longer ago are taken, too.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evermap.config import RangesConfig, SlamConfig
from evermap.errors import DataError
from evermap.geometry import se2
from evermap.slam.bridge import dead_reckoned
from evermap.slam.calibration import BIAS, CalibrationPrior
from evermap.slam.noise import START
from evermap.slam.problem import Drive
from evermap.types import (
    ANY_BEARING_RAD,
    UNKNOWN,
    BoolArray,
    FloatArray,
    IntArray,
    Recording,
    SlamResult,
    landmark_label,
)

RANGE_ONLY = "a range without a bearing is located by what is seen later, which is not causal"
"""Why a robot cannot use it while it drives."""
OF_MEDIAN, CHANGED, SWAY = 0.6745, 3.0, 0.02
"""Median of the sizes of normal numbers over their standard deviation, rounded (1 / `estimate.robust.MEDIAN_TO_SIGMA`
differs from it in the fifth figure); standard deviations of a difference from which the robot moved; and share of a
range by which it may change as a robot stands."""


class Ranged(NamedTuple):
    """Ranges of one landmark in the order of time: where the sensor was (M, 2) by odometry alone, how far it had gone
    (M,), stamps (M,), and the ranges (M,).
    """

    eye: FloatArray
    way_m: FloatArray
    stamp_s: FloatArray
    range_m: FloatArray


class Fix(NamedTuple):
    """Where the ranges around some moment place a landmark: position (2,), its standard deviation, and how far the
    sensor had gone by then.
    """

    place: FloatArray
    sigma_m: float
    way_m: float


def with_bearings(recording: Recording, settings: SlamConfig) -> tuple[Recording, tuple[str, ...]]:
    """Return a recording in which every detection has a bearing, those without one a first value; and remarks.

    Landmarks that the ranges do not locate lose their identity.

    Raises:
        DataError: detections without bearing and without identity, which nothing can associate; or none with a bearing,
            and no landmark that is located by its ranges.
    """
    seen, frames = recording.detections, recording.frames.stamp_s
    blind = np.isnan(seen.bearing_rad)
    if not blind.any():
        return recording, ()
    if settings.unknown_ids or np.any(blind & (seen.landmark_id == UNKNOWN)):
        problem = f"{recording.name}: detections without a bearing need a landmark_id"
        hint = "the number of the beacon; leave out what associates by geometry"
        raise DataError(problem, field="bearing_rad", hint=hint)
    stamp_s, odometry_s = frames[seen.frame], recording.odometry.stamp_s
    rows = np.flatnonzero(blind & (stamp_s >= odometry_s[0]) & (stamp_s <= odometry_s[-1]))
    eye, way_m = _eyes(recording, stamp_s[rows], settings)
    bearing, sigma = seen.bearing_rad.copy(), seen.sigma_bearing_rad.copy()
    bearing[blind], sigma[blind] = 0.0, ANY_BEARING_RAD
    landmark_id = seen.landmark_id.copy()
    prior = CalibrationPrior.from_settings(settings.calibration, calibrated=True, sensor=recording.sensor)
    offset_m = float(prior.sigma[BIAS])
    noise_m = recording.sensor.sigma_range_m or settings.noise.sigma_range_m
    for name in np.unique(seen.landmark_id[rows]).tolist():
        mine = np.flatnonzero(seen.landmark_id[rows] == name)
        ranged = Ranged(eye[mine, :2], way_m[mine], stamp_s[rows[mine]], seen.range_m[rows[mine]])
        fixes = _fixes(ranged, noise_m, offset_m, settings.ranges)
        if not fixes:
            landmark_id[blind & (seen.landmark_id == name)] = UNKNOWN
            continue
        nearest = np.abs(ranged.way_m[:, None] - np.array([fix.way_m for fix in fixes])).argmin(axis=1)
        toward = np.array([fix.place for fix in fixes])[nearest] - ranged.eye
        bearing[rows[mine]] = se2.wrap(np.arctan2(toward[:, 1], toward[:, 0]) - eye[mine, 2])
        drift_m = settings.ranges.drift_share * abs(ranged.way_m[0] - fixes[nearest[0]].way_m)
        first_m = np.hypot(max(fixes[nearest[0]].sigma_m, settings.ranges.first_m), drift_m)
        sigma[rows[mine[0]]] = min(float(first_m / ranged.range_m[0]), ANY_BEARING_RAD)
    if (landmark_id == UNKNOWN).all():
        problem = f"{recording.name}: no landmark is located by its ranges alone"
        raise DataError(problem, hint="more ranges of each, from places that are not on one line, while odometry runs")
    lost = np.setdiff1d(seen.landmark_id, landmark_id).tolist()  # others have bearings, too
    remarks = [f"{int(blind.sum())} detections without a bearing: only their ranges are used"]
    if lost:
        called = ", ".join(landmark_label(name, recording.landmark_names) for name in lost)
        remarks.append(f"landmarks that their ranges do not locate not used: {called}")
    seen = replace(seen, bearing_rad=bearing, sigma_bearing_rad=sigma, landmark_id=landmark_id)
    return replace(recording, detections=seen), tuple(remarks)


def with_bearings_anew(recording: Recording, settings: SlamConfig) -> Recording:
    """Return a recording whose odometry is another now with first bearings by it, where `with_bearings` gave some."""
    seen = recording.detections
    blind = seen.sigma_bearing_rad >= ANY_BEARING_RAD
    name, first, row = np.unique(seen.landmark_id, return_index=True, return_inverse=True)
    first = first[np.bincount(row, ~blind) <= 1.0]  # the only one of a landmark that counts, as a first place
    blind[first[name[row[first]] != UNKNOWN]] = True
    blind &= seen.landmark_id != UNKNOWN
    if not blind.any():
        return recording
    unset = replace(seen, bearing_rad=np.where(blind, np.nan, seen.bearing_rad))
    return with_bearings(replace(recording, detections=unset), settings)[0]


def has_range_changed(recording: Recording, first: IntArray, second: IntArray) -> BoolArray:
    """Return (P,) pairs of detections of a landmark, rows of the recording, whose ranges differ by more than their
    noise, and by more than a sensor moves on a robot that stands.

    Noise is found by second differences of ranges (medians of them), in which a robot that drives on hardly shows.
    """
    seen = recording.detections
    order = np.lexsort((recording.frames.stamp_s[seen.frame], seen.landmark_id))
    range_m, name = seen.range_m[order], seen.landmark_id[order]
    bend_m = np.abs(np.diff(range_m, n=2))[name[2:] == name[:-2]]
    sigma_m = float(np.median(bend_m)) / (OF_MEDIAN * 6.0**0.5) if len(bend_m) else 0.0
    least_m = np.maximum(CHANGED * 2.0**0.5 * sigma_m, SWAY * seen.range_m[first])
    return np.asarray(np.abs(seen.range_m[second] - seen.range_m[first]) > least_m)


def _eyes(recording: Recording, stamp_s: FloatArray, settings: SlamConfig) -> tuple[FloatArray, FloatArray]:
    """Return poses (M, 3) of the sensor at stamps (M,) by odometry alone, and how far it had gone (M,)."""
    drive, start_s = Drive.of(recording, settings.odometry), float(recording.odometry.stamp_s[0])
    instants, row = np.unique(np.append(start_s, stamp_s), return_inverse=True)
    mean = CalibrationPrior.from_settings(settings.calibration, calibrated=False).mean
    pose, _ = dead_reckoned(instants - start_s, drive, mean, START)
    eye = se2.compose(pose, np.array(recording.sensor.mount_robot_sensor, dtype=np.float64))
    way_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(eye[:, :2], axis=0), axis=1)))
    return eye[row[1:]], way_m[row[1:]]


def _fixes(ranged: Ranged, noise_m: float, offset_m: float, settings: RangesConfig) -> list[Fix]:
    """Return where a landmark is by the ranges around several moments, those that tell."""
    found: list[Fix] = []
    stamp_s = ranged.stamp_s
    for block in np.unique((stamp_s - stamp_s[0]) // settings.window_s).tolist():
        middle_s = stamp_s[0] + (block + 0.5) * settings.window_s
        half_s, fix = 0.5 * settings.window_s, None
        while fix is None:
            some = np.flatnonzero(np.abs(stamp_s - middle_s) <= half_s)
            whole = len(some) == len(stamp_s)
            some = some[np.linspace(0, len(some) - 1, min(len(some), settings.most_ranges)).astype(np.int64)]
            fix = locate_by_ranges(Ranged(*(column[some] for column in ranged)), noise_m, offset_m, settings)
            if fix is None and whole:  # all together do not tell: nor will they around another moment
                return found
            half_s *= 2.0
        found.append(fix)
    return found


def locate_by_ranges(ranged: Ranged, noise_m: float, offset_m: float, settings: RangesConfig) -> Fix | None:
    """Return where a landmark is by some ranges, which may share an offset of so much; None where they do not tell."""
    if len(ranged.range_m) < settings.fewest:
        return None
    way_m = float(np.median(ranged.way_m))
    sigma = np.hypot(noise_m, settings.drift_share * (ranged.way_m - way_m))
    middle, angle = len(ranged.range_m) // 2, np.linspace(0.0, 2.0 * np.pi, settings.starts, endpoint=False)
    around = np.column_stack([np.cos(angle), np.sin(angle)])
    start = ranged.eye[middle] + ranged.range_m[middle] * around
    at, cost, information = _descend(np.pad(start, ((0, 0), (0, 1))), ranged, sigma, offset_m, settings)
    best = int(np.argmin(cost))
    spread = np.linalg.inv(information[best])[:2, :2]
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))
    apart = np.linalg.norm(at[:, :2] - at[best, :2], axis=1) > settings.apart_m
    rival = cost[apart].min(initial=np.inf) - cost[best]
    if not sigma_m < settings.most_sigma_m or rival < settings.rival_nats:
        return None
    return Fix(at[best, :2], sigma_m, way_m)


def _descend(
    at: FloatArray, ranged: Ranged, sigma: FloatArray, offset_m: float, settings: RangesConfig
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return positions and offsets (K, 3) after damped Gauss-Newton steps from starts (K, 3), costs (K,), and the
    information (K, 3, 3) there.
    """
    damping = np.full(len(at), 1e-3)
    cost, gradient, information = _normal(at, ranged, sigma, offset_m, settings.tail)
    for _ in range(settings.steps):
        damped = information * (1.0 + damping[:, None, None] * np.eye(3)) + 1e-9 * np.eye(3)
        trial = at - np.linalg.solve(damped, gradient[..., None])[..., 0]
        there = _normal(trial, ranged, sigma, offset_m, settings.tail)
        better: BoolArray = there[0] <= cost
        at = np.where(better[:, None], trial, at)
        cost = np.where(better, there[0], cost)
        gradient = np.where(better[:, None], there[1], gradient)
        information = np.where(better[:, None, None], there[2], information)
        damping = np.clip(np.where(better, 0.2 * damping, 10.0 * damping), 1e-9, 1e6)
    return at, cost, information + 1e-9 * np.eye(3)


def _normal(
    at: FloatArray, ranged: Ranged, sigma: FloatArray, offset_m: float, tail: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return costs (K,) with Cauchy's tails from `tail` sigmas on, gradients (K, 3) and information (K, 3, 3)."""
    away = at[:, None, :2] - ranged.eye
    distance = np.maximum(np.linalg.norm(away, axis=2), 1e-6)
    residual = (distance + at[:, 2:] - ranged.range_m) / sigma
    weight = 1.0 / (1.0 + (residual / tail) ** 2)
    row = np.concatenate([away / distance[..., None], np.ones((*distance.shape, 1))], axis=2) / sigma[:, None]
    cost = 0.5 * tail**2 * np.log1p((residual / tail) ** 2).sum(axis=1) + 0.5 * (at[:, 2] / offset_m) ** 2
    gradient = np.einsum("km,kma->ka", weight * residual, row)
    gradient[:, 2] += at[:, 2] / offset_m**2
    information = np.einsum("km,kma,kmb->kab", weight, row, row)
    information[:, 2, 2] += offset_m**-2
    return cost, gradient, information


def compare_with_mirrored(result: SlamResult, recording: Recording) -> float:
    """Return by how much where the sensor sits speaks for a drive that has ranges alone, not its mirror image [nats].

    If y and the sign of turns are reversed, all ranges stay what they are, but that the sensor is on the other side;
    nan where that is not estimated.
    """
    left = next((one for one in result.parameters if one.name == "mount_left_m" and one.prior_sigma > 0.0), None)
    if left is None:
        return math.nan
    stated_m = float(recording.sensor.mount_robot_sensor[1])
    mirrored_m = -2.0 * stated_m - left.value
    return 0.5 * ((mirrored_m - left.prior_mean) ** 2 - (left.value - left.prior_mean) ** 2) / left.prior_sigma**2
