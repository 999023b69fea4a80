"""A made street: a car with odometry drives past parked and moving cars, and sees them as boxes without identity."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.geometry import se3
from evermap.types import (
    UNKNOWN,
    FloatArray,
    Frames,
    SpatialDetections,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
)
from evermap_studies.worlds.parking import upright

STEP_S, SPEED_MPS, REACH_M = 0.1, 10.0, 45.0
SIZE_M = (4.2, 1.7, 1.5)


class Street(NamedTuple):
    """A recording and what is true of it.

    Attributes:
        recording: as it is read.
        pose: (F, 7) where the robot was.
        parked: (P, 3) x, y and heading of what stands.
        way: (C, F, 3) the same of what moves; nan where it is not there.
        of: (M,) what each box is of: parked cars first, then those that move.
    """

    recording: SpatialRecording
    pose: FloatArray
    parked: FloatArray
    way: FloatArray
    of: FloatArray


def street(
    seed: int = 0,
    *,
    seconds: float = 20.0,
    n_parked: int = 16,
    way: FloatArray | None = None,
    bend: float = 0.0,
    scale: float = 1.0,
    range_scale: float = 1.0,
) -> Street:
    """Return a drive along an S, with odometry that bends [rad/m] and is too long, and ranges that are too short."""
    rng = np.random.default_rng(seed)
    stamp_s = np.arange(round(seconds / STEP_S)) * STEP_S
    heading = 0.5 * np.sin(2.0 * np.pi * stamp_s / seconds)
    xy = np.zeros((len(stamp_s), 2))
    xy[1:] = np.cumsum(SPEED_MPS * STEP_S * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)[:-1]
    pose = upright(np.column_stack([xy, heading]))
    beside = np.linspace(20, len(stamp_s) - 5, n_parked).astype(int)
    aside = np.where(np.arange(n_parked) % 2, 5.0, -5.0) + rng.normal(0.0, 0.5, n_parked)
    normal = np.column_stack([-np.sin(heading), np.cos(heading)])
    parked = np.column_stack([xy[beside] + aside[:, None] * normal[beside], heading[beside]])
    way = _oncoming(xy, heading, normal) if way is None else way
    boxes = np.concatenate([np.repeat(parked[:, None], len(stamp_s), axis=1), way])
    detections, of = _seen(rng, pose, boxes, range_scale)
    odometry = SpatialOdometry(stamp_s, _drifted(pose, bend, scale), np.full((len(stamp_s), 6), np.nan))
    recording = SpatialRecording(
        "street", odometry, Frames(stamp_s), detections, (SpatialSensor(),), class_names=("Car",)
    )
    return Street(recording, pose, parked, way, of)


def _oncoming(xy: FloatArray, heading: FloatArray, normal: FloatArray) -> FloatArray:
    """Two cars ahead that go as fast as the robot or faster, and one that comes towards it."""
    n = len(xy)
    found = np.full((3, n, 3), np.nan)
    for k, (begin, by) in enumerate(((12, 1), (20, 1), (n - 1, -1))):
        at = begin + by * np.arange(n)
        there = (at >= 0) & (at < n)
        at = at[there]
        found[k, there, :2] = xy[at] + (0.5 if by > 0 else 3.0) * normal[at]
        found[k, there, 2] = heading[at] + (0.0 if by > 0 else np.pi)
    return found


def _drifted(pose: FloatArray, bend: float, scale: float) -> FloatArray:
    """Odometry that goes wrong by the metre."""
    step = se3.between(pose[:-1], pose[1:])
    turn = np.zeros((len(step), 6))
    turn[:, 5] = bend * np.linalg.norm(step[:, :3], axis=1)
    step[:, :3] *= scale
    found = [pose[0]]
    for one in se3.retract(step, turn):
        found.append(se3.compose(found[-1], one))
    return np.array(found)


def _seen(
    rng: np.random.Generator, pose: FloatArray, boxes: FloatArray, range_scale: float
) -> tuple[SpatialDetections, FloatArray]:
    """Boxes (C, F, 3) ahead of the robot and within its reach, with errors that last for a track and such that do not;
    and what each is of.
    """
    local = se3.compose(se3.inverse(pose)[None], upright(boxes))
    reach = np.linalg.norm(local[..., :3], axis=-1)
    seen = (reach < REACH_M) & (local[..., 0] > 2.0) & (np.abs(local[..., 1]) < 1.2 * local[..., 0])
    seen &= rng.uniform(size=seen.shape) < 0.95
    frame, of = np.nonzero(seen.T)
    count = len(frame)
    at = local[of, frame]
    lasting = rng.normal(0.0, 0.05, (len(boxes), 3))
    at[:, :3] = at[:, :3] / range_scale + lasting[of] + rng.normal(0.0, 0.05, (count, 3))
    unsaid = np.full(count, np.nan)
    return (
        SpatialDetections(
            frame=frame,
            sensor=np.zeros(count, dtype=np.int64),
            landmark_id=np.full(count, UNKNOWN),
            position_sensor_m=at[:, :3],
            rotation=at[:, 3:],
            covariance_sensor_m2=np.full((count, 3, 3), np.nan),
            sigma_rad=unsaid,
            corner_px=np.full((count, 4, 2), np.nan),
            tag_size_m=unsaid,
            size_m=SIZE_M * (1.0 + 0.02 * rng.normal(size=(count, 3))),
            class_id=np.zeros(count, dtype=np.int64),
            score=rng.normal(8.0, 1.0, count),
            source_line=2 + np.arange(count),
        ),
        of,
    )


def parks(n: int, at_s: float) -> FloatArray:
    """The way (1, F, 3) of a car that comes from 20 m ahead of the start, slows down and stands from `at_s` on."""
    stamp_s = np.arange(n) * STEP_S
    rest = np.maximum(at_s - stamp_s, 0.0)
    return np.column_stack([60.0 - 1.25 * rest**2, np.full(n, 3.5), np.zeros(n)])[None]
