"""Directions of landmarks without a range: azimuth and, where measured, elevation; as gtsam's `BearingFactor3D`."""

from __future__ import annotations

import numpy as np

from evermap.estimate.kind import Columns, Linearised, MeasurementKind, crossing, stack_columns
from evermap.geometry import se3
from evermap.types import FloatArray


def linearise(pose: FloatArray, place: FloatArray, columns: Columns) -> Linearised:
    """Return angles in the robot's frame, measured less predicted."""
    turn = se3.rotation_of(pose)
    seen = se3.transform(se3.inverse(pose), place)
    x, y, z = seen.T
    flat = np.maximum(np.hypot(x, y), 1e-6)
    far = np.maximum(np.linalg.norm(seen, axis=1), 1e-6)
    off = stack_columns(columns, "azimuth_rad", "elevation_rad") - np.column_stack(
        [np.arctan2(y, x), np.arctan2(z, flat)]
    )
    by_seen = np.stack(
        [
            np.column_stack([-y, x, 0.0 * z]) / flat[:, None] ** 2,
            np.column_stack([-x * z / flat, -y * z / flat, flat]) / far[:, None] ** 2,
        ],
        axis=1,
    )
    off[:, 0] = np.remainder(off[:, 0] + np.pi, 2.0 * np.pi) - np.pi
    by_pose = by_seen @ np.concatenate([np.tile(-np.eye(3), (len(seen), 1, 1)), crossing(seen)], axis=2)
    return Linearised(off, -by_pose, -by_seen @ np.swapaxes(turn, 1, 2))


def locate(pose: FloatArray, columns: Columns) -> FloatArray | None:
    """Return (3,) the point nearest to all lines of sight; None where these are parallel."""
    azimuth, elevation = columns["azimuth_rad"], np.nan_to_num(columns["elevation_rad"])
    c = np.cos(elevation)
    ray = np.column_stack([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)])
    ray = np.einsum("kab,kb->ka", se3.rotation_of(pose), ray)
    across = np.eye(3) - ray[:, :, None] * ray[:, None]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < 1e-3:
        return None
    return np.asarray(np.linalg.solve(total, np.einsum("kab,kb->a", across, pose[:, :3])))


KIND = MeasurementKind(
    name="bearings",
    meaning="the direction of a landmark from the robot: to the left of its front, and above its plane",
    columns=("azimuth_rad",),
    optional={"elevation_rad": np.nan, "sigma_rad": 0.02},
    sigma=("sigma_rad", "sigma_rad"),
    ties="pose_place",
    linearise=linearise,
    place=locate,
)
