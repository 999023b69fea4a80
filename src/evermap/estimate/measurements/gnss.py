"""GNSS fixes: where an antenna is, in a frame of its own; as gtsam's `GPSFactorArm`."""

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
from evermap.geometry import se2, se3
from evermap.geometry.rigid import rigid
from evermap.types import FloatArray

EARTH_RADIUS_M, EARTH_ECCENTRICITY2 = 6378137.0, 6.69437999014e-3
"""Semi-major axis and squared eccentricity of the ellipsoid WGS 84."""


def linearise(pose: FloatArray, _: FloatArray, columns: Columns) -> Linearised:
    """Return fix less antenna."""
    lever = stack_columns(columns, "lever_x_m", "lever_y_m", "lever_z_m")
    fix, turn = stack_columns(columns, "x_m", "y_m", "z_m"), se3.rotation_of(pose)
    by_pose = -np.concatenate([turn, -turn @ crossing(lever)], axis=2)
    return Linearised(fix - se3.transform(pose, lever), by_pose)


def find_frame(pose: FloatArray, columns: Columns) -> FloatArray:
    """Return the turn about the vertical and the shift that bring the antenna nearest to most fixes."""
    antenna = se3.transform(pose, stack_columns(columns, "lever_x_m", "lever_y_m", "lever_z_m"))
    fix, weight = stack_columns(columns, "x_m", "y_m"), np.ones(len(pose))
    for _ in range(10):
        motion = rigid(antenna[:, :2], fix, weight)
        away = np.linalg.norm(se2.transform(motion, antenna[:, :2]) - fix, axis=1)
        weight = 1.0 / (1.0 + (away / max(float(np.median(away)), 1e-3)) ** 2)
    found, rise = se3.from_plane(motion), columns["z_m"] - antenna[:, 2]
    found[2] = np.median(rise[np.isfinite(rise)]) if np.isfinite(rise).any() else 0.0
    return found


def read_fix(message: Any) -> tuple[float, ...] | None:
    """Return latitude, longitude [deg], altitude [m], and variances along east, north and up, nan if not known."""
    at = float(message.latitude), float(message.longitude), float(message.altitude)
    if message.status.status < 0 or not np.all(np.isfinite(at[:2])) or at[:2] == (0.0, 0.0):
        return None
    stated = np.asarray(message.position_covariance, dtype=np.float64)[[0, 4, 8]]
    known = np.isfinite(stated) & (stated > 0.0) & (message.position_covariance_type > 0)
    return *at, *np.where(known, stated, np.nan).tolist()


def make_rows(messages: Messages) -> TableRows:
    """Return fixes to the east, to the north and above the first one."""
    latitude, longitude, altitude, *variance = messages.values.T
    high = altitude[np.isfinite(altitude)]
    height = np.where(np.isfinite(altitude), altitude, high[0] if len(high) else 0.0)
    origin = latitude[0], longitude[0], height[0]
    at = _cartesian(latitude, longitude, height) - _cartesian(*(np.array([one]) for one in origin))
    (s, t), (c, d) = np.sin(np.radians(origin[:2])), np.cos(np.radians(origin[:2]))
    east, north, up = np.array([[-t, d, 0.0], [-s * d, -s * t, c], [c * d, c * t, s]]) @ at.T
    sigma_xy, sigma_z = np.sqrt((variance[0] + variance[1]) / 2.0), np.sqrt(variance[2])
    lever = np.zeros(3) if messages.mount is None else messages.mount[:3]
    unmounted = "" if messages.mount is not None else "no fixed transform to the antenna: taken as the robot's centre; "
    return TableRows(
        messages.stamp_s,
        {
            "x_m": east,
            "y_m": north,
            "z_m": np.where(np.isfinite(altitude), up, np.nan),
            "sigma_xy_m": np.where(np.isnan(sigma_xy), KIND.optional["sigma_xy_m"], sigma_xy),
            "sigma_z_m": np.where(np.isnan(sigma_z), KIND.optional["sigma_z_m"], sigma_z),
            **{f"lever_{axis}_m": np.full(len(at), part) for axis, part in zip("xyz", lever, strict=True)},
        },
        f"{unmounted}east, north and up of latitude {origin[0]:.8f}, longitude {origin[1]:.8f}, {origin[2]:.2f} m",
    )


def _cartesian(latitude: FloatArray, longitude: FloatArray, height: FloatArray) -> FloatArray:
    """Return (K, 3) positions in the frame of the earth, of degrees and metres above the ellipsoid."""
    latitude, longitude = np.radians(latitude), np.radians(longitude)
    normal = EARTH_RADIUS_M / np.sqrt(1.0 - EARTH_ECCENTRICITY2 * np.sin(latitude) ** 2)
    flat = (normal + height) * np.cos(latitude)
    up = (normal * (1.0 - EARTH_ECCENTRICITY2) + height) * np.sin(latitude)
    return np.column_stack([flat * np.cos(longitude), flat * np.sin(longitude), up])


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
    messages=MessageRows(("NavSatFix",), read_fix, make_rows, derived=("filtered", "fused", "odom", "goal", "target")),
)  # fmt: skip
