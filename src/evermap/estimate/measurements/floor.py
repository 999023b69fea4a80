"""Height and tilt of a robot on a floor: its z, and how its own z axis leans."""

from __future__ import annotations

import numpy as np

from evermap.estimate.kind import Columns, Linearised, MeasurementKind, crossing, stack_columns
from evermap.geometry import se3
from evermap.types import FloatArray


def linearise(pose: FloatArray, _: FloatArray, columns: Columns) -> Linearised:
    """Return height and, of the vertical in the robot's frame, x and y, each measured less predicted."""
    turn = se3.rotation_of(pose)
    up = turn[:, 2]
    predicted = np.column_stack([pose[:, 2], up[:, :2]])
    by_pose = np.zeros((len(pose), 3, 6))
    by_pose[:, 0, :3] = -up  # a step in the robot's frame rises by its part along the vertical
    by_pose[:, 1:, 3:] = -crossing(up)[:, :2]
    return Linearised(stack_columns(columns, "z_m", "up_x", "up_y") - predicted, by_pose)


KIND = MeasurementKind(
    name="floor",
    meaning="the robot's height, and where the vertical points in its frame",
    columns=("z_m",),
    optional={"up_x": 0.0, "up_y": 0.0, "sigma_z_m": 0.01, "sigma_tilt": 0.01},
    sigma=("sigma_z_m", "sigma_tilt", "sigma_tilt"),
    ties="pose",
    linearise=linearise,
    first_sigma=(1e-4, 1e-4, 1e3, 1.0, 1.0, 1e-4),
)
