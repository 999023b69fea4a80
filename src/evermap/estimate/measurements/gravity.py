"""Gravity: the direction of what an accelerometer reads at rest, or on average; as gtsam's `Pose3AttitudeFactor`."""

from __future__ import annotations

from typing import Any

import numpy as np

from evermap.estimate.kind import (
    Columns,
    Linearised,
    MeasurementKind,
    MessageRows,
    Messages,
    TableRows,
    crossing,
    stack_columns,
)
from evermap.geometry import se3
from evermap.types import FloatArray, SpatialOdometry

BLOCK_S = 1.0
"""Length of the blocks of an accelerometer's readings of which each is one of rest or not."""
FEWEST_READINGS = 10
"""Readings of a block whose mean is used."""
GRAVITY_MPS2, GRAVITY_BAND_MPS2 = 9.81, 0.5
"""Specific force at rest, and its error: else gravity was taken off, or the unit is another one."""
STILL_RADPS = 0.05
"""Turn rate at rest, with the bias of a gyroscope."""
STILL_MPS = 0.02
"""Speed at rest, with the noise of odometry from images."""
STEADY_MPS2 = 0.3
"""Standard deviation of the specific force at rest where there is no odometry to say so."""


def linearise(pose: FloatArray, _: FloatArray, columns: Columns) -> Linearised:
    """Return the measured direction less that of the vertical in the robot's frame: at rest it reads upward."""
    reads = stack_columns(columns, "ax_mps2", "ay_mps2", "az_mps2")
    up = se3.rotation_of(pose)[:, 2]
    by_pose = np.concatenate([np.zeros((len(pose), 3, 3)), -crossing(up)], axis=2)
    return Linearised(reads / np.linalg.norm(reads, axis=1, keepdims=True) - up, by_pose)


def read_imu(message: Any) -> tuple[float, ...] | None:
    """Return specific force [m/s^2] and turn rate [rad/s]; nan for a gyroscope, None for an accelerometer not there."""
    force, rate = message.linear_acceleration, message.angular_velocity
    if message.linear_acceleration_covariance[0] == -1.0:  # as ROS says that there is none
        return None
    turned = (np.nan,) * 3 if message.angular_velocity_covariance[0] == -1.0 else (rate.x, rate.y, rate.z)
    return force.x, force.y, force.z, *turned


def make_rows(messages: Messages) -> TableRows:
    """Return the mean specific force of every rest, in the robot's frame; orientations of the sensor are not used."""
    if messages.mount is None:
        remark = "no fixed transform to the sensor, which is therefore not used"
        return TableRows(np.zeros(0), {name: np.zeros(0) for name in KIND.columns}, remark)
    stamp_s, force = messages.stamp_s, messages.values[:, :3]
    block = np.floor((stamp_s - stamp_s[0]) / BLOCK_S).astype(np.int64)
    edges = np.append(np.flatnonzero(np.diff(block, prepend=-1)), len(block))
    rests, last = list[list[int]](), -2
    for first, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if not _is_rest(messages, slice(first, end)):
            continue
        if rests and block[first] == last + 1:
            rests[-1][1] = end
        else:
            rests.append([first, end])
        last = int(block[first])
    mean = np.array([force[first:end].mean(axis=0) for first, end in rests]).reshape(-1, 3)
    mean = mean @ se3.rotation_of(messages.mount).T
    middle = np.array([(stamp_s[first] + stamp_s[end - 1]) / 2.0 for first, end in rests])
    return TableRows(middle, {name: mean[:, axis].copy() for axis, name in enumerate(KIND.columns)})


def _is_rest(messages: Messages, rows: slice) -> bool:
    """Return whether the robot stood still: by its gyroscope and odometry, of which one may be missing."""
    stamp_s, force, rate = messages.stamp_s[rows], messages.values[rows, :3], messages.values[rows, 3:]
    if len(stamp_s) < FEWEST_READINGS or stamp_s[-1] - stamp_s[0] < BLOCK_S / 2.0:
        return False
    if abs(np.linalg.norm(force.mean(axis=0)) - GRAVITY_MPS2) > GRAVITY_BAND_MPS2:
        return False
    has_rate = bool(np.isfinite(rate).all())
    if has_rate and np.sqrt((rate**2).sum(axis=1).mean()) > STILL_RADPS:
        return False
    if messages.odometry is None:
        return has_rate and bool(np.linalg.norm(force.std(axis=0)) < STEADY_MPS2)
    pose, covered = _poses_during(messages.odometry, stamp_s)
    off = np.abs(se3.log(se3.between(pose[:1], pose)))
    allowed = BLOCK_S * np.repeat([STILL_MPS, STILL_RADPS], 3)
    return bool(covered and np.all(off < allowed))


def _poses_during(odometry: SpatialOdometry, stamp_s: FloatArray) -> tuple[FloatArray, bool]:
    """Return poses (N, 7) from just before some stamps to just after them, and whether there are such."""
    first = int(np.searchsorted(odometry.stamp_s, stamp_s[0], side="right")) - 1
    last = int(np.searchsorted(odometry.stamp_s, stamp_s[-1]))
    covered = first >= 0 and last < len(odometry)
    return odometry.pose_world_robot[max(first, 0) : last + 1], covered


KIND = MeasurementKind(
    name="gravity",
    meaning="specific force in the robot's frame while it does not accelerate",
    columns=("ax_mps2", "ay_mps2", "az_mps2"),
    optional={"sigma_rad": 0.02},
    sigma=("sigma_rad", "sigma_rad", "sigma_rad"),
    ties="pose",
    linearise=linearise,
    first_sigma=(1e-4, 1e-4, 1e-4, 1.0, 1.0, 1e-4),
    messages=MessageRows(("Imu",), read_imu, make_rows),
)
