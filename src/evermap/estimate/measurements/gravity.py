"""Gravity: the direction of what an accelerometer reads at rest, or on average; as gtsam's `Pose3AttitudeFactor`."""

from __future__ import annotations

import numpy as np

from evermap.estimate.kind import Columns, Linearised, MeasurementKind, crossing, stacked
from evermap.geometry import se3
from evermap.types import FloatArray


def linearise(pose: FloatArray, _: FloatArray, columns: Columns) -> Linearised:
    """Return the measured direction less that of the vertical in the robot's frame: at rest it reads upward."""
    reads = stacked(columns, "ax_mps2", "ay_mps2", "az_mps2")
    up = se3.rotation_of(pose)[:, 2]
    by_pose = np.concatenate([np.zeros((len(pose), 3, 3)), -crossing(up)], axis=2)
    return Linearised(reads / np.linalg.norm(reads, axis=1, keepdims=True) - up, by_pose)


KIND = MeasurementKind(
    name="gravity",
    meaning="specific force in the robot's frame while it does not accelerate",
    columns=("ax_mps2", "ay_mps2", "az_mps2"),
    optional={"sigma_rad": 0.02},
    sigma=("sigma_rad", "sigma_rad", "sigma_rad"),
    ties="pose",
    linearise=linearise,
    first_sigma=(1e-4, 1e-4, 1e-4, 1.0, 1.0, 1e-4),
)
