"""Stamps of detections that are late by another delay each, as of what is stamped when it arrives.

By the odometry all landmarks that a late frame shows are where they would be some moments before: all along the way of
the sensor, in this frame and not in those before and after it. So the steps of one landmark from the frame before, and
of another one to the frame after, are opposite: by the variance of the delays, times the speeds at which both pass by.
Noise of detections is each landmark's own, errors of odometry last from one frame to the next, and a scale or a delay
of all has all steps go the same way: none of these makes steps of two landmarks opposite.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from evermap.estimate.robust import MEDIAN_TO_SIGMA
from evermap.explain.expectations import compare_detections
from evermap.geometry import se2, se3
from evermap.types import AnyRecording, Cause, FloatArray, IntArray, SlamResult, Trajectory, is_in_space

LEAST_S, LEAST_SHARE = 0.015, 0.2
"""Delays from which they matter [s], and correlation of steps of two landmarks: a half where nothing else is wrong."""
SURELY, FEWEST = 3.0, 15
"""Standard deviations by which steps must be opposite, and frames that say so, at least."""
FRAMES, SOON_S, WITHIN_S = 2, 1.0, 0.1
"""Sightings ahead, and time, to which steps are taken, at most; and time within which the sensor goes on as it does."""
CLIPPED = 4.0
"""Usual steps beyond which one counts as that: one wrong identity says little."""


class Jitter(NamedTuple):
    """Standard deviation of delays [s]; by how many standard deviations, and by which mean of their products over the
    root of its mean square, steps of two landmarks are opposite.
    """

    sigma_s: float
    surely: float
    share: float


def measure_jitter(result: SlamResult, recording: AnyRecording) -> Jitter | None:
    """Return by how much delays of the detections vary; None where two landmarks are hardly seen by frames in a row.

    Large delays count for less than they are: their standard deviation is a lower bound.
    """
    path = result.dead_reckoning
    if recording.odometry is None or len(path) < 3 or len(path) != len(result.trajectory):
        return None
    compared = compare_detections(recording, result)
    rows = np.flatnonzero(np.isfinite(compared.point_m).all(axis=1) & compared.used)
    rows = rows[(compared.taken_s[rows] >= path.stamp_s[0]) & (compared.taken_s[rows] <= path.stamp_s[-1])]
    taken_s, point_m, name = compared.taken_s[rows], compared.point_m[rows], compared.landmark_id[rows]
    at, later, earlier = (_put(path, taken_s + off_s, point_m) for off_s in (0.0, WITHIN_S, -WITHIN_S))
    speed = (later - earlier)[:, :2] / (2.0 * WITHIN_S)
    detection = compared.detection[rows]
    view = recording.detections.frame[detection]
    if is_in_space(recording):  # of one sensor each: the mounts of others are off by their own
        name, view = (of * len(recording.sensors) + recording.detections.sensor[detection] for of in (name, view))
    before, after = _find_steps(name, taken_s)
    step = (at[after] - at[before])[:, :2]
    if not len(step):
        return None
    fast = [np.linalg.norm(speed[end], axis=1) for end in (after, before)]
    along = [
        (step * speed[end]).sum(axis=1) / np.maximum(by, 1e-9) for end, by in zip((after, before), fast, strict=True)
    ]
    ends = [(view[end], name[end]) for end in (after, before)]

    def multiply_opposite(values: list[FloatArray], factor: list[FloatArray]) -> FloatArray:
        most = CLIPPED * MEDIAN_TO_SIGMA * float(np.median(np.abs(values[0])))
        one, two = (by * np.clip(each, -most, most) for each, by in zip(values, factor, strict=True))
        return -_multiply((one, *ends[0]), (two, *ends[1]))

    passed = _multiply((fast[0] ** 2, *ends[0]), (fast[1] ** 2, *ends[1]))
    told = passed > 0.0
    if np.count_nonzero(told) < FEWEST:
        return None
    variance = max(float(multiply_opposite(along, fast)[told].sum() / passed[told].sum()), 0.0)
    weighed = multiply_opposite([each * by for each, by in zip(along, fast, strict=True)], [np.ones(len(step))] * 2)[
        told
    ]
    surely = float(weighed.sum() / max(math.sqrt(float((weighed**2).sum())), 1e-12))
    return Jitter(math.sqrt(variance), surely, surely / math.sqrt(len(weighed)))


def find_jitter(result: SlamResult, recording: AnyRecording) -> tuple[Cause, ...]:
    """Return that stamps of detections are late by another delay each, if they certainly are, and by what matters."""
    found = measure_jitter(result, recording)
    if found is None or not (found.sigma_s > LEAST_S and found.surely > SURELY and found.share > LEAST_SHARE):
        return ()
    message = (
        "stamps of the detections, or of the odometry, are late by another delay each: they vary by "
        f"{found.sigma_s:.2g} s or more, as of what is stamped on arrival"
    )
    fix = "detections.csv, frames.csv: stamp_s of the exposure, not of the arrival"
    return (Cause("clock-jitter", "detections", message, found.sigma_s, math.nan, 1.0, fix),)


def _put(path: Trajectory, stamp_s: FloatArray, point_m: FloatArray) -> FloatArray:
    """Return where points (K, D) of the robot are at stamps (K,), before and after a path as at its ends."""
    pose = path.pose_world_robot
    group: Any = se2 if pose.shape[1] == 3 else se3
    row = np.clip(np.searchsorted(path.stamp_s, stamp_s) - 1, 0, len(path) - 2)
    part = (stamp_s - path.stamp_s[row]) / (path.stamp_s[row + 1] - path.stamp_s[row])
    step = part[:, None] * group.log(group.between(pose[row], pose[row + 1]))
    return np.asarray(group.transform(group.compose(pose[row], group.exp(step)), point_m))


def _find_steps(name: IntArray, taken_s: FloatArray) -> tuple[IntArray, IntArray]:
    """Return rows (S,) of sightings, and of the next ones of the same landmark by the same sensor, soon after."""
    order, pairs = np.lexsort((taken_s, name)), list[tuple[IntArray, IntArray]]()
    for ahead in range(1, FRAMES + 1):
        before, after = order[:-ahead], order[ahead:]
        soon = (name[before] == name[after]) & (taken_s[after] - taken_s[before] < SOON_S)
        pairs.append((before[soon], after[soon]))
    before, after = (np.concatenate(each) for each in zip(*pairs, strict=True))
    return before, after


def _multiply(one: tuple[FloatArray, IntArray, IntArray], two: tuple[FloatArray, IntArray, IntArray]) -> FloatArray:
    """Return (V,) sums of products of values of two landmarks in a view; `one` and `two` are values, views, names."""
    both = np.concatenate([np.column_stack(each[1:]) for each in (one, two)])
    keys, of_key = np.unique(both, axis=0, return_inverse=True)
    view = np.unique(keys[:, 0], return_inverse=True)[1]
    of_one, of_two = (
        np.bincount(rows, each[0], len(keys))
        for rows, each in zip(np.split(of_key.ravel(), [len(one[0])]), (one, two), strict=True)
    )
    of_all = np.bincount(view, of_one) * np.bincount(view, of_two)
    return np.asarray(of_all - np.bincount(view, of_one * of_two))  # but for those of a landmark with itself
