"""A room with small tags on its walls, seen by a camera that is carried around in it, without odometry."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from evermap.types import Frames, Landmarks, SpatialRecording, SpatialSensor, Trajectory

from .corridors import INTRINSICS, World, corner_detections, poses, see_corners

AHEAD = Rotation.from_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
"""Of the camera: its z is the robot's x."""
CAMERA = SpatialSensor("ahead", tuple(np.append(np.zeros(3), AHEAD.as_quat()).tolist()), INTRINSICS)
ROOM_M, RANGE_M, FACED = np.array([6.5, 6.0, 2.5]), 6.0, 0.35
"""Size of the room; how far, and at which cosine between the line of sight and what a tag faces, it is detected."""


def make_walk(
    seed: int,
    *,
    n_tags: int = 24,
    seconds: float = 60.0,
    rate_hz: float = 8.0,
    sigma_px: float = 0.35,
    p_wrong: float = 0.0,
) -> World:
    """Make a room and a walk in it without odometry.

    Args:
        seed: of everything.
        n_tags: on the four walls, 20 cm large.
        seconds: how long.
        rate_hz: of frames.
        sigma_px: noise of corners.
        p_wrong: share of detections with the identity of another tag.
    """
    random = np.random.default_rng(seed)
    place, facing = _tags(random, n_tags)
    stamp_s = np.arange(0.0, seconds, 1.0 / rate_hz)
    phase = random.uniform(0.0, 2.0 * np.pi, 3)
    at = np.column_stack(
        [
            1.4 * np.sin(stamp_s / 5.0 + phase[0]),
            1.1 * np.sin(stamp_s / 3.7 + phase[1]),
            0.2 * np.sin(stamp_s / 2.2 + phase[2]),
        ]
    )
    yaw = 2.0 * np.pi * stamp_s / 50.0 + 0.3 * np.sin(stamp_s)
    turn = Rotation.from_euler("ZYX", np.column_stack([yaw, 0.15 * np.sin(stamp_s / 2.0), 0.1 * np.sin(stamp_s / 1.7)]))
    frame, tag, corner = see_corners(at, turn, place, facing, AHEAD, np.zeros(3), nearest_m=0.2)
    ray = at[frame] - place[tag]
    away = np.linalg.norm(ray, axis=1)
    faced = np.einsum("ni,ni->n", ray, facing[tag].apply([0.0, 0.0, 1.0])) / away
    near = (away < RANGE_M) & (faced > FACED)
    frame, tag, corner = frame[near], tag[near], corner[near]
    kept = random.random(len(frame)) < 0.9
    frame, tag, corner = frame[kept], tag[kept], corner[kept] + random.normal(0.0, sigma_px, corner[kept].shape)
    wrong = random.random(len(tag)) < p_wrong
    said = np.where(wrong, random.integers(0, n_tags, len(tag)), tag)
    pose = poses(at, turn)
    truth = Trajectory(stamp_s, pose, np.zeros((len(stamp_s), 6, 6)), frame="truth")
    tags = Landmarks.in_space(np.arange(n_tags), place, rotation=facing.as_quat())
    detections = corner_detections(frame, said, corner)
    return World(SpatialRecording("walk", None, Frames(stamp_s), detections, (CAMERA,), truth, tags), pose, tags)


def _tags(random: np.random.Generator, count: int) -> tuple[np.ndarray, Rotation]:
    """Places on the walls, and turns in which z points into the room, to who looks at them."""
    half, wall = ROOM_M / 2.0, random.integers(0, 4, count)
    along = random.uniform(-0.9, 0.9, count)
    xy = np.where(
        (wall % 2 == 0)[:, None],
        np.column_stack([np.where(wall == 0, half[0], -half[0]), along * half[1]]),
        np.column_stack([along * half[0], np.where(wall == 1, half[1], -half[1])]),
    )
    upright = Rotation.from_matrix(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    inwards = Rotation.from_rotvec(np.outer(np.pi + 0.5 * np.pi * wall, [0.0, 0.0, 1.0]))
    return np.column_stack([xy, random.uniform(-1.0, 1.0, count)]), inwards * upright
