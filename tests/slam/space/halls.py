"""A hall with points that have no identity (reflectors, poles, features), driven through; rotations by scipy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from evermap.geometry import se3
from evermap.io.spatial import spatial_detections
from evermap.types import Frames, Landmarks, SpatialRecording, SpatialSensor, Trajectory, rows_of

from .corridors import _drifting, poses

SIZE_M = 24.0, 16.0, 3.0
RANGE_M = 7.0
CLASSES = ("pole", "reflector")


def hall(
    seed: int,
    *,
    n_points: int = 60,
    n_frames: int = 700,
    step_s: float = 0.4,
    drift: float = 0.03,
    sigma_m: float = 0.03,
    p_false: float = 0.02,
    classes: bool = False,
    beside_m: float = 0.0,
) -> SpatialRecording:
    """Make two and a half rounds through a hall; of what is ahead within `RANGE_M` eight of ten are detected.

    Args:
        seed: of everything.
        n_points: landmarks, anywhere in the hall.
        n_frames: of the drive.
        step_s: between them.
        drift: of the odometry, metres and a third of that in radians, for each square root of a second.
        sigma_m: noise of each coordinate.
        p_false: share of detections that are of nothing; they have the identity -1.
        classes: whether detections come with one of two classes.
        beside_m: how far above those of the first half the landmarks of the second half are; 0: anywhere.
    """
    random = np.random.default_rng(seed)
    place = random.uniform(0.0, 1.0, (n_points, 3)) * SIZE_M
    if beside_m:
        place[n_points // 2 :] = place[: n_points // 2] + (0.0, 0.0, beside_m)
    kind = random.integers(0, 2, n_points)
    stamp_s = step_s * np.arange(n_frames)
    angle = 5.0 * np.pi * np.arange(n_frames) / n_frames
    at = np.column_stack([12.0 + 7.0 * np.cos(angle), 8.0 + 4.5 * np.sin(angle), 1.0 + 0.1 * np.sin(3.0 * angle)])
    heading = np.unwrap(np.arctan2(4.5 * np.cos(angle), -7.0 * np.sin(angle)))
    sway = 0.03 * np.sin(np.outer(stamp_s, [0.9, 0.7]))
    turn = Rotation.from_euler("ZYX", np.column_stack([heading, sway]))
    frames, said, seen, kinds = [], [], [], []
    for row in range(n_frames):
        ahead = turn[row].inv().apply(place - at[row])
        inside = (np.linalg.norm(ahead, axis=1) < RANGE_M) & (ahead[:, 0] > 0.3) & (random.random(n_points) < 0.8)
        for k in np.flatnonzero(inside):
            frames.append(row)
            real = random.random() >= p_false
            said.append(k if real else -1)
            nowhere = random.uniform((0.5, -3.0, -1.0), (RANGE_M, 3.0, 2.0))
            seen.append((ahead[k] if real else nowhere) + random.normal(0.0, sigma_m, 3))
            kinds.append(kind[k])
    count, pose = len(frames), poses(at, turn)
    detections = spatial_detections(
        np.array(frames), landmark_id=np.array(said), position_sensor_m=np.array(seen),
        covariance_sensor_m2=np.tile(sigma_m**2 * np.eye(3), (count, 1, 1)),
        **({"class_id": np.array(kinds)} if classes else {}),
    )  # fmt: skip
    return SpatialRecording(
        f"hall {seed}", _drifting(pose, stamp_s, drift, random), Frames(stamp_s), detections, (SpatialSensor(),),
        Trajectory(stamp_s, pose, np.zeros((n_frames, 6, 6)), frame="truth"),
        Landmarks.in_space(np.arange(n_points), place), class_names=CLASSES,
    )  # fmt: skip


def part_of_hall(
    recording: SpatialRecording,
    begin: int,
    end: int,
    frame: np.ndarray | None = None,
    *,
    without: Sequence[int] = (),
    later_s: float = 0.0,
) -> SpatialRecording:
    """The frames from one to another, without truth and some landmarks; odometry starts at 0, or at a pose (7,)."""
    seen, odometry = recording.detections, recording.odometry
    assert odometry is not None
    seen = rows_of(seen, (seen.frame >= begin) & (seen.frame < end) & ~np.isin(seen.landmark_id, without))
    driven = rows_of(odometry, np.arange(begin, end))
    start = se3.inverse(driven.pose_world_robot[0])
    pose = se3.compose(se3.identity() if frame is None else frame, se3.compose(start, driven.pose_world_robot))
    return replace(
        recording,
        odometry=replace(driven, stamp_s=driven.stamp_s + later_s, pose_world_robot=pose),
        frames=replace(recording.frames, stamp_s=recording.frames.stamp_s[begin:end] + later_s),
        detections=replace(seen, frame=seen.frame - begin),
        truth=None,
        true_landmarks=None,
    )


def tilt(seed: int) -> np.ndarray:
    """Any pose (7,)."""
    random = np.random.default_rng(seed)
    return se3.exp(np.append(random.normal(0.0, 5.0, 3), random.normal(0.0, 1.0, 3)))
