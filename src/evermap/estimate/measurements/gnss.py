"""GNSS fixes: where an antenna is, in a frame of its own; as gtsam's `GPSFactorArm`."""

from __future__ import annotations

import numpy as np

from evermap.estimate.kind import Columns, Linearised, MeasurementKind, crossing, stacked
from evermap.geometry import se2, se3
from evermap.geometry.rigid import rigid
from evermap.types import FloatArray


def linearise(pose: FloatArray, _: FloatArray, columns: Columns) -> Linearised:
    """Return fix less antenna."""
    lever = stacked(columns, "lever_x_m", "lever_y_m", "lever_z_m")
    fix, turn = stacked(columns, "x_m", "y_m", "z_m"), se3.rotation_of(pose)
    by_pose = -np.concatenate([turn, -turn @ crossing(lever)], axis=2)
    return Linearised(fix - se3.transform(pose, lever), by_pose)


def find_frame(pose: FloatArray, columns: Columns) -> FloatArray:
    """Return the turn about the vertical and the shift that bring the antenna nearest to most fixes."""
    antenna = se3.transform(pose, stacked(columns, "lever_x_m", "lever_y_m", "lever_z_m"))
    fix, weight = stacked(columns, "x_m", "y_m"), np.ones(len(pose))
    for _ in range(10):
        motion = rigid(antenna[:, :2], fix, weight)
        away = np.linalg.norm(se2.transform(motion, antenna[:, :2]) - fix, axis=1)
        weight = 1.0 / (1.0 + (away / max(float(np.median(away)), 1e-3)) ** 2)
    found, rise = se3.from_plane(motion), columns["z_m"] - antenna[:, 2]
    found[2] = np.median(rise[np.isfinite(rise)]) if np.isfinite(rise).any() else 0.0
    return found


KIND = MeasurementKind(
    name="gnss",
    meaning="where an antenna is: east, north (and up) of an origin",
    columns=("x_m", "y_m"),
    optional={
        "z_m": np.nan, "sigma_xy_m": 1.0, "sigma_z_m": 2.0, "lever_x_m": 0.0, "lever_y_m": 0.0, "lever_z_m": 0.0,
    },
    sigma=("sigma_xy_m", "sigma_xy_m", "sigma_z_m"),
    ties="pose",
    linearise=linearise,
    first_sigma=(1e3, 1e3, 1e3, 0.3, 0.3, np.pi),
    frame=find_frame,
)  # fmt: skip
