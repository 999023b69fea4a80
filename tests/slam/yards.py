"""A yard with posts whose layout is known: a robot drives through it and reads ranges and bearings."""

from __future__ import annotations

import numpy as np

from evermap.types import UNKNOWN, Detections, Frames, Landmarks, Odometry, Recording, Sensor, Trajectory

SIZE_M = np.array([16.0, 8.0])
ODOMETRY_S, FRAME_S = 0.02, 0.1
SIGMA_RANGE, SIGMA_BEARING = 0.011, 0.004
"""Noise of ranges, as a share of them, and of bearings [rad]."""


def yard(
    seed: int, *, noise: float, scale: float = 1.01, seconds: float = 57.0, n_posts: int = 18, p_detect: float = 0.8
) -> Recording:
    """Make a drive past posts at the edge of a yard: ranges and bearings within 6 m ahead.

    Args:
        seed: of everything.
        noise: of each velocity that the odometry reports, fifty times a second [m/s, rad/s].
        scale: reported over true speeds.
        seconds: how long.
        n_posts: around the yard.
        p_detect: share of the posts in view that are detected.
    """
    random = np.random.default_rng(seed)
    stamp_s, pose = _drive(random, seconds)
    around = np.sort(random.uniform(0.0, 2.0 * SIZE_M.sum(), n_posts))
    corner = np.array([[0.0, 0.0], [SIZE_M[0], 0.0], SIZE_M, [0.0, SIZE_M[1]], [0.0, 0.0]])
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corner, axis=0), axis=1)))
    post = np.column_stack([np.interp(around, length, corner[:, k]) for k in range(2)])
    rows = np.arange(0, len(stamp_s), round(FRAME_S / ODOMETRY_S))
    range_m, bearing = _away(pose[rows], post)
    seen = (range_m < 6.0) & (np.abs(bearing) < 1.0) & (random.random(range_m.shape) < p_detect)
    frame, name = np.nonzero(seen)
    range_m = range_m[seen] * (1.0 + SIGMA_RANGE * random.normal(size=len(frame)))
    bearing = bearing[seen] + SIGMA_BEARING * random.normal(size=len(frame))
    sensor = Sensor(range_max_m=7.0, bearing_min_rad=-1.1, bearing_max_rad=1.1)
    odometry = _odometry(random, stamp_s, pose, noise, scale)
    return _recording(f"yard {seed}", stamp_s, pose, rows, frame, name, range_m, bearing, post, sensor, odometry)


def layout(recording: Recording, sigma_m: float = 0.0) -> Landmarks:
    """Return the posts as a map to localise in."""
    posts = recording.true_landmarks
    assert posts is not None
    return Landmarks.at(posts.landmark_id, posts.position_m, sigma_m=sigma_m, frame="prior_map")


def position_error_m(recording: Recording, path: Trajectory) -> float:
    """Return the root mean square of the errors of positions, as they stand."""
    truth = recording.truth
    assert truth is not None
    row = np.searchsorted(truth.stamp_s, path.stamp_s - 1e-6)
    off = path.pose_world_robot[:, :2] - truth.pose_world_robot[row, :2]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def _drive(random: np.random.Generator, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """(n,) stamps, and (n, 3) poses of a robot that drives along its front."""
    stamp_s = np.arange(0.0, seconds, ODOMETRY_S)
    phase, rate = random.uniform(0.0, 6.28, 2), np.array([0.23, 0.41]) * random.uniform(0.9, 1.1, 2)
    half = 0.5 * SIZE_M * [0.7, 0.6]
    inside = np.outer(stamp_s, rate) + phase
    at, ahead = 0.5 * SIZE_M + half * np.sin(inside), half * rate * np.cos(inside)
    return stamp_s, np.column_stack([at, np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))])


def _away(pose: np.ndarray, post: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, L) ranges and bearings."""
    off = post[None] - pose[:, None, :2]
    bearing = np.arctan2(off[..., 1], off[..., 0]) - pose[:, None, 2]
    return np.hypot(off[..., 0], off[..., 1]), (bearing + np.pi) % (2.0 * np.pi) - np.pi


def _odometry(
    random: np.random.Generator, stamp_s: np.ndarray, pose: np.ndarray, noise: float, scale: float
) -> Odometry:
    step = np.diff(pose, axis=0)
    middle = pose[:-1, 2] + 0.5 * step[:, 2]
    forward = (step[:, :2] * np.column_stack([np.cos(middle), np.sin(middle)])).sum(axis=1) / ODOMETRY_S
    velocity = np.column_stack([scale * forward, np.zeros(len(step)), step[:, 2] / ODOMETRY_S])
    velocity = np.vstack([velocity, velocity[-1]]) + noise * random.normal(size=(len(stamp_s), 3)) * [1.0, 0.0, 1.0]
    return Odometry(stamp_s, *velocity.T)


def _recording(
    name: str,
    stamp_s: np.ndarray,
    pose: np.ndarray,
    rows: np.ndarray,
    frame: np.ndarray,
    post_id: np.ndarray,
    range_m: np.ndarray,
    bearing: np.ndarray,
    post: np.ndarray,
    sensor: Sensor,
    odometry: Odometry,
) -> Recording:
    unsaid, unknown = np.full(len(frame), np.nan), np.full(len(frame), UNKNOWN)
    detections = Detections(frame, post_id, range_m, bearing, unknown, unsaid, unsaid.copy(), unknown)
    truth = Trajectory(stamp_s, pose, np.zeros((len(stamp_s), 3, 3)), frame="truth")
    posts = Landmarks.at(np.arange(len(post)), post)
    return Recording(name, odometry, Frames(stamp_s[rows]), detections, sensor, truth=truth, true_landmarks=posts)
