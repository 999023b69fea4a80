"""Relative poses between two instants: loop closures, or the graph of another SLAM; as gtsam's `BetweenFactorPose3`."""

from __future__ import annotations

import numpy as np

from evermap.estimate.kind import Columns, Linearised, MeasurementKind, stack_columns
from evermap.geometry import se3
from evermap.types import FloatArray


def linearise(pose: FloatArray, other: FloatArray, columns: Columns) -> Linearised:
    """Return the twist from the predicted to the measured pose of the later instant, seen from the earlier one."""
    given = stack_columns(columns, "x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")
    known = np.nan_to_num(given)
    measured = np.hstack([known[:, :3], se3.from_angles(known[:, 3:])[:, 3:]])
    between = se3.between(pose, other)
    off = se3.local(measured, between)
    jacobian = -se3.right_jacobian_inverse(off)
    by_pose = -jacobian @ se3.adjoint(se3.inverse(between))
    return Linearised(np.where(np.isfinite(given), -off, np.nan), by_pose, jacobian)


KIND = MeasurementKind(
    name="closures",
    meaning="the robot's pose at `to_stamp_s`, seen from that at `stamp_s`",
    columns=("to_stamp_s", "x_m", "y_m", "yaw_rad"),
    optional={"z_m": np.nan, "roll_rad": np.nan, "pitch_rad": np.nan, "sigma_m": 0.1, "sigma_rad": 0.03},
    sigma=("sigma_m", "sigma_m", "sigma_m", "sigma_rad", "sigma_rad", "sigma_rad"),
    ties="pose_pose",
    linearise=linearise,
)
