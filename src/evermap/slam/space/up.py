"""Where up is in the frame of a solution in space: by what the robot measured, or by how it moved.

Sources, combined by their information (`geometry.upright`):

- **imu**: specific forces of an accelerometer, turned into the map by the poses;
- **tf**: the z axis of the odometry's frame, where the recording states that this is up;
- **odometry**, **plane of motion**: wheels and feet move in a plane and turn about its normal. The axis that all turns
  have in common is that of the mean rotation, whose singular value is 1 (both robot and map keep it); the normal of the
  plane is the axis of the least spread of the positions. Neither has a sign: that is where gravity, tf, or else the
  robot's frame has up, by the convention of its axes (z, REP 103). Where the robot's frame is that of a camera, which
  may be mounted upside down, tags on walls must agree. Without a sign up is unknown, and a remark tells the axis.

What moves freely, in a straight line, or not at all, has no such plane, and up remains unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evermap.config import UpConfig
from evermap.geometry import se3
from evermap.geometry.upright import LEAST_RAD, STATED_RAD, angle_between_ups, combine_ups, is_contradiction
from evermap.slam.space.linearise import CORNERS
from evermap.slam.space.problem import SpatialEstimate, SpatialProblem
from evermap.types import (
    MOST_TILT_RAD,
    PLANE,
    BoolArray,
    FloatArray,
    Measurements,
    SlamResult,
    SpatialOdometry,
    SpatialSensor,
    Up,
)

AXES_OF_CAMERA = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Columns are ahead, left and up of a sensor that looks along its z, with y down."""
FEWEST = 5
"""Poses of a motion."""
UPRIGHT = 0.7
"""Cosine between two axes that are taken for the same, about that of 45 degrees."""


class Movement(NamedTuple):
    """What the decision is made of, all in the frame of the solution.

    Attributes:
        stamp_s: (N,) of poses, on the clock of the measurements.
        pose: (N, 7) of the robot.
        upright: (3,) mean over all poses of what is up by the convention of the robot's axes or, where its frame is
            that of a camera, of the camera's; shorter than 1 the less they agree, 0 where conventions contradict.
        tags_up: (K, 3) directions that are up on tags that hang on walls.
        is_camera: whether the robot's frame is that of a camera, z ahead.
    """

    stamp_s: FloatArray
    pose: FloatArray
    upright: FloatArray
    tags_up: FloatArray
    is_camera: bool = False

    @classmethod
    def of(
        cls,
        stamp_s: FloatArray,
        problem: SpatialProblem,
        estimate: SpatialEstimate,
        sensors: Sequence[SpatialSensor],
        found: BoolArray,
        placed: BoolArray,
    ) -> Movement:
        """Return that of a solution: stamps (N,) of its poses, of which some are `found`, and `placed` places (P,)."""
        pose = estimate.pose[found]
        axes = (se3.rotation_of(estimate.mount(problem)) @ sensor_axes(problem, sensors))[np.unique(problem.sensor)]
        ahead, _, up = axes.mean(axis=0).T if len(axes) else np.zeros((3, 3))
        is_camera = bool(ahead[2] > UPRIGHT)
        if not is_camera:  # of a camera upside down, or of a robot whose z is down
            up = np.array([0.0, 0.0, float(up[2] > UPRIGHT or ahead[2] < -UPRIGHT)])
        upright = se3.rotation_of(pose).mean(axis=0) @ up if len(pose) else np.zeros(3)
        tag = np.unique(problem.place[problem.kind == CORNERS])
        tag = tag[placed[tag] & problem.oriented[tag]]
        tags_up = se3.rotation_of(estimate.place[tag])[:, :, 1]
        length = float(np.linalg.norm(upright))
        on_wall = np.abs(tags_up @ upright) > UPRIGHT * max(length, 1e-9)
        return cls(stamp_s[found], pose, upright, tags_up[on_wall], is_camera)


class Axis(NamedTuple):
    """A direction (3,) without a sign, and its standard deviation [rad], infinite where nothing tells."""

    direction: FloatArray
    sigma_rad: float


NO_AXIS = Axis(np.full(3, np.nan), np.inf)
"""Of what shows none."""
USUAL = UpConfig()


def decide_up(
    motion: Movement,
    odometry: SpatialOdometry | None = None,
    measurements: Sequence[Measurements] = (),
    settings: UpConfig = USUAL,
) -> tuple[Up, tuple[str, ...]]:
    """Return where up is, and remarks on sources that contradict each other.

    Args:
        motion: poses of the solution.
        odometry: of the recording.
        measurements: of other kinds, of which those of gravity tell it.
        settings: thresholds, and the direction in the frame of the solution by the user's word.
    """
    if settings.direction is not None:
        direction = np.array(settings.direction, dtype=np.float64)
        return Up(direction / np.linalg.norm(direction), STATED_RAD, "stated"), ()
    found = [up_by_gravity(motion, measurements, settings), up_by_frame(motion, odometry, settings)]
    known = next((one for one in found if one.source), None)
    reference = motion.upright if known is None else known.direction
    reference = np.zeros(3) if known is None and not _has_sign(motion, settings) else reference
    by_turns = turn_axis(motion.pose, settings)
    wheels = odometry is not None and sway_of(odometry.pose_world_robot) < settings.wheels_rad
    found.append(_choose_sign(by_turns, reference, "odometry" if wheels else "plane of motion", settings))
    by_plane = plane_axis(motion.pose[:, :3], settings)
    found.append(_choose_sign(by_plane, reference, "plane of motion", settings))
    up, remarks = Up(), []
    axis = min(by_plane, by_turns, key=lambda one: one.sigma_rad)
    if not any(one.source for one in found) and axis.sigma_rad < MOST_TILT_RAD:
        text = ", ".join(f"{part:.3f}" for part in axis.direction.tolist())
        remarks.append(
            f"up is along ({text}) or its opposite, by the plane of motion: nothing tells which, as of a camera that "
            "may be upside down; slam.space.up.direction states it"
        )
    for one in found:
        if up.source and is_contradiction(up, one):
            degrees = np.degrees([angle_between_ups(up, one), np.hypot(up.sigma_rad, one.sigma_rad)])
            remarks.append(
                f"up by {one.source} is {degrees[0]:.0f} deg off that by {up.source} "
                f"(1 sigma: {degrees[1]:.1f} deg); the more certain one is used"
            )
        up = combine_ups(up, one)
    return up, tuple(remarks)


def sensor_axes(problem: SpatialProblem, sensors: Sequence[SpatialSensor]) -> FloatArray:
    """Return (S, 3, 3) ahead, left and up of each sensor, by where it saw most."""
    axes = np.tile(np.eye(3), (len(problem.mount), 1, 1))
    for row, sensor in enumerate(sensors):
        seen = problem.measured[problem.sensor == row, :3]
        if sensor.intrinsics is not None or (len(seen) and np.median(seen[:, 2]) > abs(np.median(seen[:, 0]))):
            axes[row] = AXES_OF_CAMERA
    return axes


def with_known_up(result: SlamResult, known: Up) -> SlamResult:
    """Return a result in the frame of a map of which it is known where up is, combined with what the session says."""
    own = result.landmarks.up
    if own.source == PLANE:
        return result
    up, remarks = combine_ups(known, own), result.warnings
    if is_contradiction(known, own):
        angle, sigma = angle_between_ups(known, own), float(np.hypot(known.sigma_rad, own.sigma_rad))
        remark = (
            f"up of this session, by {own.source}, is {np.degrees(angle):.0f} deg off that of the map, by "
            f"{known.source} (1 sigma: {np.degrees(sigma):.1f} deg); the more certain one is kept"
        )
        remarks = (*remarks, remark)
    return replace(
        result, landmarks=replace(result.landmarks, up=up), gone=replace(result.gone, up=up), warnings=remarks
    )


def up_by_gravity(motion: Movement, measurements: Sequence[Measurements], settings: UpConfig = USUAL) -> Up:
    """Return the mean direction of specific forces, of a robot at rest or whose accelerations average out."""
    rows = [table for table in measurements if table.kind == "gravity"]
    inside = [(one.stamp_s >= motion.stamp_s[0]) & (one.stamp_s <= motion.stamp_s[-1]) for one in rows]
    if not any(some.any() for some in inside):
        return Up()
    names = ("ax_mps2", "ay_mps2", "az_mps2")
    stamp_s = np.concatenate([one.stamp_s[some] for one, some in zip(rows, inside, strict=True)])
    force = np.concatenate(
        [np.column_stack([one.columns[name] for name in names])[some] for one, some in zip(rows, inside, strict=True)]
    )
    pose = se3.interpolate(motion.stamp_s, motion.pose, stamp_s) if len(motion.stamp_s) > 1 else motion.pose[[0]]
    read = np.einsum("nij,nj->ni", se3.rotation_of(pose), force / np.linalg.norm(force, axis=1, keepdims=True))
    return _mean(read, "imu", settings)


def up_by_frame(motion: Movement, odometry: SpatialOdometry | None, settings: UpConfig = USUAL) -> Up:
    """Return the mean direction in the map of the z axis of the odometry's frame, if that is stated to be up.

    Not where the sensors have up across or against it: that odometry is in a frame of a camera.
    """
    if odometry is None or not odometry.z_up:
        return Up()
    inside = (motion.stamp_s >= odometry.stamp_s[0]) & (motion.stamp_s <= odometry.stamp_s[-1])
    if not inside.any():
        return Up()
    driven = odometry.pose_world_robot[[0]]
    if len(odometry) > 1:
        driven = se3.interpolate(odometry.stamp_s, odometry.pose_world_robot, motion.stamp_s[inside])
    vertical = se3.rotation_of(driven)[:, 2]  # z of the odometry's frame in the robot's
    up = _mean(np.einsum("nij,nj->ni", se3.rotation_of(motion.pose[inside]), vertical), "tf", settings)
    agree = float(up.direction @ motion.upright) if up.source else -1.0
    return up if agree > settings.evident * float(np.linalg.norm(motion.upright)) - 1e-9 else Up()


def turn_axis(pose: FloatArray, settings: UpConfig = USUAL) -> Axis:
    """Return the axis in the map about which poses (N, 7) turn: in it and in the robot it keeps its direction.

    Its standard deviation is that of a regression on the headings: of N independent tilts of the robot by s about it,
    whose mean resultant is r, it is s / sqrt((N - 2) (1 - r^2)), since s is of residuals of two fitted numbers each.
    """
    if len(pose) < FEWEST:
        return NO_AXIS
    rotation = se3.rotation_of(pose)
    of_map, value, of_robot = np.linalg.svd(rotation.mean(axis=0))
    spread = 1.0 - min(float(value[1]), 1.0) ** 2
    tilt = np.einsum("nij,j->ni", rotation, of_robot[0]) @ of_map[:, 1:]
    sway = float(np.sqrt(np.mean(tilt**2)))
    free = count_independent(tilt) - 2.0
    if spread < settings.turned or sway > settings.sway_rad or free < 1.0:
        return NO_AXIS
    return Axis(of_map[:, 0], sway / float(np.sqrt(free * spread)))


def sway_of(pose: FloatArray) -> float:
    """Return the standard deviation [rad] of the axis of a robot that turns least, by poses (N, 7) of its odometry."""
    rotation = se3.rotation_of(pose)
    of_map, _, of_robot = np.linalg.svd(rotation.mean(axis=0))
    return float(np.sqrt(np.mean((np.einsum("nij,j->ni", rotation, of_robot[0]) @ of_map[:, 1:]) ** 2)))


def plane_axis(position_m: FloatArray, settings: UpConfig = USUAL) -> Axis:
    """Return the normal of the plane that positions (N, 3) are in."""
    if len(position_m) < FEWEST:
        return NO_AXIS
    away = position_m - position_m.mean(axis=0)
    _, value, axes = np.linalg.svd(away, full_matrices=False)
    _, second, across = (value / np.sqrt(len(away))).tolist()
    if second < settings.spread_m or across > settings.flatness * second:
        return NO_AXIS
    free = count_independent(away @ axes[2:].T) - 3.0  # three numbers are fitted
    return Axis(axes[2], across / (second * float(np.sqrt(free)))) if free >= 1.0 else NO_AXIS


def count_independent(residual: FloatArray) -> float:
    """Return how many independent ones residuals (N, K) in order of time are worth, by their correlation (Geyer 1992:
    summed until pairs of lags are no longer positive). At least 1.
    """
    count = len(residual)
    centred = residual - residual.mean(axis=0)
    power = np.abs(np.fft.rfft(centred, 2 * count, axis=0)) ** 2
    covariance = np.fft.irfft(power, axis=0)[:count].sum(axis=1)
    if covariance[0] <= 0.0:
        return float(count)
    correlation = covariance / covariance[0]
    pairs = correlation[: count // 2 * 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0.0)
    total = float(pairs[: ends[0] if len(ends) else len(pairs)].sum())
    return max(count / max(2.0 * total - 1.0, 1.0), 1.0)


def _mean(direction: FloatArray, source: str, settings: UpConfig) -> Up:
    """The mean of directions (N, 3), with the standard deviation of their scatter and of errors that last."""
    mean = direction.mean(axis=0)
    length = float(np.linalg.norm(mean))
    if not length > settings.evident:
        return Up()
    mean /= length
    off = direction - np.outer(direction @ mean, mean)
    scatter = float(np.sqrt(0.5 * np.mean(np.sum(off**2, axis=1)) / count_independent(off)))
    return Up(mean, float(np.hypot(scatter, LEAST_RAD[source])), source)


def _choose_sign(axis: Axis, reference: FloatArray, source: str, settings: UpConfig) -> Up:
    """An axis in the direction of a reference (3,), which must tell it."""
    part = float(axis.direction @ reference)
    if not (np.isfinite(axis.sigma_rad) and abs(part) > settings.evident):
        return Up()
    return Up(np.sign(part) * axis.direction, float(np.hypot(axis.sigma_rad, LEAST_RAD[source])), source)


def _has_sign(motion: Movement, settings: UpConfig) -> bool:
    """Judge whether conventions tell which end of an axis is up: tags do not contradict, and of a camera they agree."""
    share = float(np.mean(motion.tags_up @ motion.upright > 0.0)) if len(motion.tags_up) else 0.5
    if motion.is_camera:
        return len(motion.tags_up) >= settings.tags and share >= settings.tags_agree
    return bool(share >= 0.5)
