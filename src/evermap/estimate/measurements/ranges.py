"""Ranges of landmarks without a direction, as of UWB radios; as gtsam's `RangeFactor3D`."""

from __future__ import annotations

import numpy as np

from evermap.estimate.kind import Columns, Linearised, MeasurementKind, crossing, stack_columns
from evermap.geometry import se3
from evermap.types import FloatArray


def linearise(pose: FloatArray, place: FloatArray, columns: Columns) -> Linearised:
    """Return ranges from a radio on the robot, measured less predicted."""
    lever, turn = stack_columns(columns, "lever_x_m", "lever_y_m", "lever_z_m"), se3.rotation_of(pose)
    away = place - se3.transform(pose, lever)
    far = np.maximum(np.linalg.norm(away, axis=1), 1e-6)
    by_place = -(away / far[:, None])[:, None]
    by_pose = -by_place @ np.concatenate([turn, -turn @ crossing(lever)], axis=2)
    return Linearised((columns["range_m"] - far)[:, None], by_pose, by_place)


def locate(pose: FloatArray, columns: Columns) -> FloatArray | None:
    """Return (3,) where ranges cross; where the robot moved in a plane, above it. None where it moved along a line."""
    radio = se3.transform(pose, stack_columns(columns, "lever_x_m", "lever_y_m", "lever_z_m"))
    middle, far = radio.mean(axis=0), columns["range_m"]
    axes = np.linalg.svd(radio - middle, full_matrices=True)[2]
    at = (radio - middle) @ axes.T
    extent = np.sqrt((at**2).mean(axis=0))
    if extent[1] < 0.1 * far.mean():
        return None
    seen = 3 if extent[2] > 0.1 * far.mean() else 2
    # |at - p|^2 = far^2 is linear in p and |p|^2
    system = np.column_stack([-2.0 * at[:, :seen], np.ones(len(at))])
    found = np.linalg.lstsq(system, far**2 - (at**2).sum(axis=1), rcond=None)[0]
    here = np.zeros(3)
    here[:seen] = found[:seen]
    if seen == 2:
        here[2] = np.sqrt(max(found[2] - found[:2] @ found[:2], 0.0)) * (1.0 if axes[2, 2] >= 0.0 else -1.0)
    return np.asarray(middle + here @ axes)


KIND = MeasurementKind(
    name="ranges",
    meaning="the distance of a landmark from a radio on the robot",
    columns=("range_m",),
    optional={"sigma_m": 0.1, "lever_x_m": 0.0, "lever_y_m": 0.0, "lever_z_m": 0.0},
    sigma=("sigma_m",),
    ties="pose_place",
    linearise=linearise,
    place=locate,
)
