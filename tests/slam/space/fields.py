"""A hall with tags on its walls, driven through by a robot that strafes, with two cameras that report tags as poses."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from evermap.geometry import se3
from evermap.io.spatial import spatial_detections
from evermap.types import Frames, Landmarks, SpatialOdometry, SpatialRecording, SpatialSensor, Trajectory

from .corridors import poses

SIZE_M = np.array([16.0, 8.0])
RANGE_M, HALF_VIEW_RAD = 6.0, 0.6
ODOMETRY_S, FRAME_S = 0.02, 0.1
AHEAD = Rotation.from_euler("xyz", [-np.pi / 2, 0.0, -np.pi / 2])
"""Of a camera: its z is the robot's x."""
SIGMA_ALONG, SIGMA_ACROSS, SIGMA_RAD = 0.011, 0.004, 0.028
"""Noise of tags along and across the line of sight, as shares of the range, and of their orientations."""


def field(
    seed: int,
    *,
    noise: float,
    scale: float = 1.01,
    turn_scale: float = 1.0,
    seconds: float = 57.0,
    n_tags: int = 18,
    p_detect: float = 0.8,
    p_wrong: float = 0.0,
) -> tuple[SpatialRecording, Landmarks]:
    """Make a drive, and the exact layout of the tags.

    Args:
        seed: of everything.
        noise: of each velocity that the odometry reports, fifty times a second [m/s, rad/s].
        scale: reported over true speeds.
        turn_scale: reported over true turn rates.
        seconds: how long.
        n_tags: on the walls.
        p_detect: share of the tags in view that are detected.
        p_wrong: share of detections with the identity of another tag.
    """
    random = np.random.default_rng(seed)
    stamp_s = np.arange(0.0, seconds, ODOMETRY_S)
    phase, rate = random.uniform(0.0, 6.28, 4), random.uniform(0.9, 1.1, 4)
    at = np.column_stack(
        [
            8.0 + 5.5 * np.sin(0.23 * rate[0] * stamp_s + phase[0]),
            4.0 + 2.3 * np.sin(0.41 * rate[1] * stamp_s + phase[1]),
            np.zeros(len(stamp_s)),
        ]
    )
    yaw = phase[2] + 2.2 * np.sin(0.17 * rate[2] * stamp_s + phase[3]) + 0.12 * rate[3] * stamp_s
    pose = poses(at, Rotation.from_rotvec(np.outer(yaw, [0.0, 0.0, 1.0])))
    tags = _tags(random, n_tags)
    frame, tag, seen = [], [], []
    rows = np.arange(0, len(stamp_s), round(FRAME_S / ODOMETRY_S))
    mounts = poses(
        np.array([[0.3, 0.2, 0.5], [-0.3, -0.2, 0.5]]),
        Rotation.from_euler("ZYX", [[0.0, -0.2, 0.0], [np.pi, -0.2, 0.0]]) * AHEAD,
    )
    sensor = []
    for which, mount in enumerate(mounts):
        camera = se3.compose(pose[rows], mount)
        away = se3.between(camera[:, None], tags[None])
        range_m = np.linalg.norm(away[..., :3], axis=-1)
        axis = se3.rotation_of(away)[..., 2]  # of the tag, which points into its wall
        faced = (axis * away[..., :3]).sum(axis=-1) / range_m > 0.3
        in_view = (away[..., 2] > np.cos(HALF_VIEW_RAD) * range_m) & (range_m < RANGE_M) & faced
        some, mine = np.nonzero(in_view & (random.random(in_view.shape) < p_detect))
        frame.append(some)
        tag.append(mine)
        seen.append(_measured(random, away[some, mine]))
        sensor.append(np.full(len(some), which))
    row = np.concatenate(frame)
    order = np.argsort(row, kind="stable")
    name = np.concatenate(tag)[order]
    name = np.where(random.random(len(name)) < p_wrong, random.integers(0, n_tags, len(name)), name)
    at_sensor = np.concatenate(seen)[order]
    detections = spatial_detections(
        row[order],
        landmark_id=name,
        position_sensor_m=at_sensor[:, :3],
        rotation=at_sensor[:, 3:],
        sensor=np.concatenate(sensor)[order],
    )
    truth = Trajectory(stamp_s[rows], pose[rows], np.zeros((len(rows), 6, 6)), frame="truth")
    cameras = tuple(
        SpatialSensor(name, tuple(mount.tolist())) for name, mount in zip(("front", "back"), mounts, strict=True)
    )
    driven = _driven(random, stamp_s, pose, noise, scale, turn_scale)
    layout = Landmarks.in_space(np.arange(n_tags), tags[:, :3], rotation=tags[:, 3:])
    return SpatialRecording("field", driven, Frames(stamp_s[rows]), detections, cameras, truth, layout), layout


def position_error_m(recording: SpatialRecording, pose: np.ndarray) -> float:
    """Return the root mean square of the errors of positions of poses (N, 7), one a frame."""
    assert recording.truth is not None
    off = pose[:, :3] - recording.truth.pose_world_robot[:, :3]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def _tags(random: np.random.Generator, count: int) -> np.ndarray:
    """(T, 7) on the four walls, facing inwards."""
    around = np.cumsum([0.0, *SIZE_M, *SIZE_M])
    along = (np.arange(count) + random.uniform(0.2, 0.8, count)) / count * around[-1]
    wall = np.searchsorted(around, along, side="right") - 1
    part = along - around[wall]
    corner = np.array([[0.0, 0.0], [SIZE_M[0], 0.0], SIZE_M, [0.0, SIZE_M[1]]])[wall]
    heading = 0.5 * np.pi * wall
    at = corner + part[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    facing = Rotation.from_rotvec(np.outer(heading - 0.5 * np.pi, [0.0, 0.0, 1.0])) * AHEAD  # z points out of the hall
    return poses(np.column_stack([at, random.uniform(0.5, 1.8, count)]), facing)


def _measured(random: np.random.Generator, away: np.ndarray) -> np.ndarray:
    """(K, 7) tags as a camera reports them."""
    range_m = np.linalg.norm(away[:, :3], axis=1, keepdims=True)
    ray = away[:, :3] / range_m
    off = random.normal(size=(len(away), 3)) * SIGMA_ACROSS * range_m
    off += ray * random.normal(size=(len(away), 1)) * np.sqrt(SIGMA_ALONG**2 - SIGMA_ACROSS**2) * range_m
    turned = Rotation.from_quat(away[:, 3:]) * Rotation.from_rotvec(SIGMA_RAD * random.normal(size=(len(away), 3)))
    return poses(away[:, :3] + off, turned)


def _driven(
    random: np.random.Generator, stamp_s: np.ndarray, pose: np.ndarray, noise: float, scale: float, turn_scale: float
) -> SpatialOdometry:
    """Return the sums of what wheels report: speeds ahead and aside, and the turn rate."""
    step = se3.local(pose[:-1], pose[1:])
    step[:, :3] *= scale
    step[:, 3:] *= turn_scale
    step[:, [0, 1, 5]] += ODOMETRY_S * noise * random.normal(size=(len(step), 3))
    driven = [np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])]
    for one in se3.exp(step):
        driven.append(se3.compose(driven[-1], one))
    return SpatialOdometry(stamp_s, np.array(driven), np.full((len(stamp_s), 6), np.nan))
