"""Camera models: projection of points, its derivatives, and rays of pixels.

Points are in the camera's frame (x right, y down, z ahead), pixels are (u right, v down). Three models: 'pinhole';
'radtan', a pinhole with the radial and tangential distortion of Brown (1966), also called plumb bob; 'equidistant', the
fisheye of Kannala and Brandt (2006), which images points beside and behind the camera, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from evermap.types import FloatArray, IntArray, SpatialSensor

_STEPS = 30
"""Newton steps by which distortion is removed, at most; three to six are usual."""


def project(point: FloatArray, sensor: SpatialSensor) -> tuple[FloatArray, FloatArray]:
    """Return pixels (..., 2) of points (..., 3) in a camera's frame, and their derivatives (..., 2, 3) by the points.

    A pinhole, distorted or not, images points ahead of it only; for others the formula's pixels are meaningless.
    """
    focal, centre = _intrinsics(sensor)
    distort = _fisheye if sensor.distortion_model == "equidistant" else _perspective
    with np.errstate(divide="ignore", invalid="ignore"):
        image, slope = distort(np.asarray(point, dtype=np.float64), sensor)
    return focal * image + centre, focal[:, None] * slope


def project_each(point: FloatArray, row: IntArray, sensors: Sequence[SpatialSensor]) -> tuple[FloatArray, FloatArray]:
    """Return pixels and derivatives as `project`, of points (M, ..., 3) each by its own camera, `sensors[row]`.

    Both are nan for sensors that are no cameras.
    """
    point = np.asarray(point, dtype=np.float64)
    pixel, slope = np.full((*point.shape[:-1], 2), np.nan), np.full((*point.shape[:-1], 2, 3), np.nan)
    for number, sensor in enumerate(sensors):
        own = row == number
        if sensor.intrinsics is not None and own.any():
            pixel[own], slope[own] = project(point[own], sensor)
    return pixel, slope


def unproject(pixel: FloatArray, sensor: SpatialSensor) -> FloatArray:
    """Return the unit vectors (..., 3) in a camera's frame along which pixels (..., 2) look; nan where there is none.

    Distortion is removed by Newton's method.
    """
    focal, centre = _intrinsics(sensor)
    image = (np.asarray(pixel, dtype=np.float64) - centre) / focal
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ray = _ray_of_fisheye(image, sensor) if sensor.distortion_model == "equidistant" else _ray(image, sensor)
        return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))


def _intrinsics(sensor: SpatialSensor) -> tuple[FloatArray, FloatArray]:
    """Focal lengths (2,) and principal point (2,) [px]."""
    assert sensor.intrinsics is not None, f"{sensor.name} is not a camera"
    fx, fy, cx, cy = sensor.intrinsics
    return np.array([fx, fy]), np.array([cx, cy])


def _perspective(point: FloatArray, sensor: SpatialSensor) -> tuple[FloatArray, FloatArray]:
    """Image coordinates (..., 2) in units of the focal length, and their derivatives (..., 2, 3)."""
    depth = point[..., 2]
    plane = point[..., :2] / depth[..., None]
    slope = np.zeros((*plane.shape, 3))
    slope[..., 0, 0] = slope[..., 1, 1] = 1.0 / depth
    slope[..., 2] = -plane / depth[..., None]
    if not any(sensor.distortion):
        return plane, slope
    image, by_plane = _brown(plane, sensor.distortion)
    return image, by_plane @ slope


def _brown(plane: FloatArray, distortion: Sequence[float]) -> tuple[FloatArray, FloatArray]:
    """Radial and tangential distortion of (..., 2), and its derivatives (..., 2, 2)."""
    k1, k2, p1, p2, k3 = (*distortion, 0.0)[:5]
    x, y = plane[..., 0], plane[..., 1]
    q = x * x + y * y
    radial = 1.0 + q * (k1 + q * (k2 + q * k3))
    steep = 2.0 * (k1 + q * (2.0 * k2 + q * 3.0 * k3))
    image = np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (q + 2.0 * x * x),
            y * radial + 2.0 * p2 * x * y + p1 * (q + 2.0 * y * y),
        ],
        axis=-1,
    )
    across = steep * x * y + 2.0 * (p1 * x + p2 * y)
    slope = np.empty((*plane.shape, 2))
    slope[..., 0, 0] = radial + steep * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    slope[..., 1, 1] = radial + steep * y * y + 2.0 * p2 * x + 6.0 * p1 * y
    slope[..., 0, 1] = slope[..., 1, 0] = across
    return image, slope


def _fisheye(point: FloatArray, sensor: SpatialSensor) -> tuple[FloatArray, FloatArray]:
    """Project like `_perspective`, with an image radius that is an odd polynomial of the angle off the axis."""
    x, y, z = point[..., 0], point[..., 1], point[..., 2]
    side, whole = np.hypot(x, y), np.linalg.norm(point, axis=-1)
    angle = np.arctan2(side, z)
    distance, by_angle = _bent(angle, sensor.distortion)
    centred = side < 1e-6 * z  # the first terms of the series, exact to 1e-12 there
    k1 = (*sensor.distortion, 0.0)[0]
    safe = np.where(centred, 1.0, side)
    stretch = np.where(centred, 1.0 / z, distance / safe)
    by_side = by_angle * z / (whole * whole)
    steep = np.where(centred, 2.0 * (k1 - 1.0 / 3.0) / z**3, (by_side - stretch) / (safe * safe))
    slope = np.empty((*point.shape[:-1], 2, 3))
    slope[..., 0, 0] = stretch + steep * x * x
    slope[..., 1, 1] = stretch + steep * y * y
    slope[..., 0, 1] = slope[..., 1, 0] = steep * x * y
    slope[..., 2] = -(by_angle / (whole * whole))[..., None] * point[..., :2]
    return stretch[..., None] * point[..., :2], slope


def _bent(angle: FloatArray, distortion: Sequence[float]) -> tuple[FloatArray, FloatArray]:
    """The odd polynomial of angles, and its derivative."""
    k1, k2, k3, k4 = (*distortion, 0.0, 0.0, 0.0, 0.0)[:4]
    q = angle * angle
    value = angle * (1.0 + q * (k1 + q * (k2 + q * (k3 + q * k4))))
    return value, 1.0 + q * (3.0 * k1 + q * (5.0 * k2 + q * (7.0 * k3 + q * 9.0 * k4)))


def _ray(image: FloatArray, sensor: SpatialSensor) -> FloatArray:
    plane = image.copy()
    if any(sensor.distortion):
        for _ in range(_STEPS):
            there, slope = _brown(plane, sensor.distortion)
            miss = there - image
            (a, b), (c, d) = (slope[..., 0, 0], slope[..., 0, 1]), (slope[..., 1, 0], slope[..., 1, 1])
            step = np.stack([d * miss[..., 0] - b * miss[..., 1], a * miss[..., 1] - c * miss[..., 0]], axis=-1)
            plane -= step / (a * d - b * c)[..., None]
            if _settle_pixels(miss):
                break
        plane[np.linalg.norm(_brown(plane, sensor.distortion)[0] - image, axis=-1) > 1e-9] = np.nan
    return np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)


def _ray_of_fisheye(image: FloatArray, sensor: SpatialSensor) -> FloatArray:
    distance = np.linalg.norm(image, axis=-1)
    angle = np.minimum(distance, np.pi)
    for _ in range(_STEPS):
        there, slope = _bent(angle, sensor.distortion)
        miss = there - distance
        angle = np.clip(angle - miss / slope, 0.0, np.pi)
        if _settle_pixels(miss):
            break
    angle = np.where(np.abs(_bent(angle, sensor.distortion)[0] - distance) > 1e-9, np.nan, angle)
    along = np.where(distance > 0.0, np.sin(angle) / np.where(distance > 0.0, distance, 1.0), 1.0)
    return np.concatenate([along[..., None] * image, np.cos(angle)[..., None]], axis=-1)


def _settle_pixels(miss: Any) -> bool:
    return not np.nanmax(np.abs(miss), initial=0.0) > 1e-14
