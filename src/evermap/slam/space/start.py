"""Initial values in space: frame by frame, each pose from the odometry and the tags known by then.

Without odometry the robot is assumed static until its tags show otherwise. A tag puts the robot in one of two places,
where its view has two explanations; the one that agrees with the other tags and with the motion is taken.
"""

from __future__ import annotations

import time

import numpy as np

from evermap.geometry import se3
from evermap.geometry.rigid import rigid
from evermap.geometry.symmetry import Symmetries
from evermap.slam.space.problem import SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.types import BoolArray, FloatArray, Progress

SLACK_M, SLACK_RAD = 0.15, 0.15
"""What places of a map in the making are off by."""
STILL_M, STILL_RAD = 0.03, 0.03
"""What a robot is off by that was there a moment ago."""
OUTLIER, LOST = 10.0, 15.0
"""Nats that a detection, and a motion, cost at most: a wrong identity, a robot that was carried."""
WORTH = 3.0
"""Nats by which a candidate must beat the predicted pose."""


def incremental(
    problem: SpatialProblem, noise: SpatialNoise, known: BoolArray, place: FloatArray, progress: Progress | None = None
) -> tuple[SpatialEstimate, FloatArray, FloatArray]:
    """Return poses and places, one frame after the other; their spread (N, 2) [m, rad]; seconds (N,) of each frame.

    Args:
        problem: the measurements.
        noise: how far the robot may be from where the odometry puts it.
        known: (P,) places of a map that is given.
        place: (P, 7) where they are.
        progress: told after every frame.
    """
    n, mount = len(problem.stamp_s), problem.mount[problem.sensor]
    place, known = place.copy(), known.copy()
    either, ways = se3.compose(mount, problem.either), se3.compose(mount, problem.explanations)
    share = np.exp(-np.clip(problem.other_log_odds / noise.pixel**2, 0.0, 30.0))
    log_share = np.stack([-np.log1p(share), np.log(share + 1e-12) - np.log1p(share)])
    sigma_m = np.hypot(_sigma_m(problem.measured_root) * noise.position, SLACK_M)
    sigma_rad = np.hypot(problem.sigma_rad * noise.pixel, SLACK_RAD)
    turned = problem.oriented[problem.place]
    first = np.searchsorted(problem.pose_row, np.arange(n + 1))
    pose, unsure_s = np.empty((n, 7)), 1e6 if known.any() else 0.0
    pose[0], step_s, spread = se3.identity(), np.zeros(n), np.zeros((n, 2))
    for row in range(n):
        began = time.perf_counter()
        if row:
            pose[row] = se3.compose(pose[row - 1], problem.increment[row - 1])
            unsure_s += problem.lasted_s[row - 1]
        mine = np.arange(first[row], first[row + 1])
        met = mine[known[problem.place[mine]]]
        if len(met):
            within = STILL_M + noise.translation * np.sqrt(unsure_s), STILL_RAD + noise.rotation * np.sqrt(unsure_s)
            alike = problem.symmetries[problem.place[met]]
            candidate = _candidates(pose[row], ways[:, met], place[problem.place[met]], turned[met], alike)
            cost = _moved(candidate, within)
            cost += _seen(
                candidate, either[:, met], place[problem.place[met]], log_share[:, met], sigma_m[met], sigma_rad[met],
                turned[met], alike,
            ).sum(axis=1)  # fmt: skip
            cost[0] -= WORTH
            best = int(np.argmin(cost))
            pose[row] = candidate[best]
            unsure_s = 0.0 if best else unsure_s
        new = mine[~known[problem.place[mine]]]
        place[problem.place[new]] = se3.compose(pose[row], either[0, new])
        known[problem.place[new]] = True
        spread[row] = SLACK_M + noise.translation * np.sqrt(unsure_s), SLACK_RAD + noise.rotation * np.sqrt(unsure_s)
        step_s[row] = time.perf_counter() - began
        if progress is not None:
            progress(float(problem.stamp_s[row]), float(problem.stamp_s[-1]))
    place[~problem.oriented, 3:] = se3.NO_TURN
    return SpatialEstimate(pose, place, np.zeros((len(problem.mount), 6))), spread, step_s


def _sigma_m(root: FloatArray) -> FloatArray:
    """(M,) of positions, all axes alike."""
    inverse = np.linalg.inv(root)
    return np.asarray(np.sqrt((inverse**2).sum(axis=(1, 2)) / 3.0))


def _candidates(
    predicted: FloatArray, ways: FloatArray, place: FloatArray, turned: BoolArray, alike: Symmetries
) -> FloatArray:
    """(C, 7) the predicted pose, then where each detection (E, K, 7) of a place with an orientation puts the robot, and
    where the positions of three or more put it.
    """
    seen, known = ways[:, turned], place[turned]
    known = alike[turned].twisted(known, se3.compose(predicted, seen))
    by_places = se3.compose(known, se3.inverse(seen)).reshape(-1, 7)
    by_all = rigid(ways[0, :, :3], place[:, :3])[None] if len(place) >= 3 else np.zeros((0, 7))
    return np.vstack([predicted[None], by_places, by_all])


def _moved(candidate: FloatArray, spread: tuple[float, float]) -> FloatArray:
    """(C,) nats that it costs to be there rather than where the odometry says, the first."""
    off = se3.local(candidate[:1], candidate)
    squared = (off[:, :3] ** 2).sum(axis=1) / spread[0] ** 2 + (off[:, 3:] ** 2).sum(axis=1) / spread[1] ** 2
    return np.asarray(np.minimum(0.5 * squared, LOST))


def _seen(
    candidate: FloatArray, either: FloatArray, place: FloatArray, log_share: FloatArray, sigma_m: FloatArray,
    sigma_rad: FloatArray, turned: BoolArray, alike: Symmetries,
) -> FloatArray:  # fmt: skip
    """(C, K) nats that the detections cost."""
    at = se3.compose(candidate[:, None, None, :], either[None])
    away = np.linalg.norm(at[..., :3] - place[:, :3], axis=-1) / sigma_m
    angle = np.where(turned, alike.angle_between(at, place), 0.0) / sigma_rad
    cost = 0.5 * away**2 + 0.5 * angle**2 - log_share[None]
    return np.asarray(np.minimum(cost.min(axis=1), OUTLIER))
