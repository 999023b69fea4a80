"""A frame: its detections, checked, as the kernels take them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from evermap.errors import InputError
from evermap.types import UNKNOWN, FloatArray, IntArray


class Frame(NamedTuple):
    """Detections of one frame.

    Attributes:
        stamp_s: when.
        position: (M, 3) in the world.
        noise: (M, 3, 3) covariances, or (1, 3, 3) for all.
        class_id: (M,) or `UNKNOWN`.
        appearance: (M, A) unit vectors, or zeros.
        box: (M, 4) length, width, height, heading; (M, 0) where the tracker follows points.
        box_noise: (M, 4) their variances.
        level: (M, 1) log odds by the score that a detection is real, inf without one; (M, 0) where none has a score.
    """

    stamp_s: float
    position: FloatArray
    noise: FloatArray
    class_id: IntArray
    appearance: FloatArray
    box: FloatArray
    box_noise: FloatArray
    level: FloatArray


def p_real_of(score: FloatArray, midpoint: float, scale: float) -> FloatArray:
    """Return (M,) probabilities that detections are real: scores themselves if all are in [0, 1], else logistic.

    Args:
        score: (M,) of one detector, nan for none.
        midpoint: score of even odds, where scores are any numbers.
        scale: score by which the log odds grow by one.
    """
    from scipy.special import expit

    given = score[~np.isnan(score)]
    if len(given) == 0 or (given.min() >= 0.0 and given.max() <= 1.0):
        return score
    return np.asarray(expit((score - midpoint) / scale))


def positions(values: Any) -> FloatArray:
    """Return (M, 3) finite positions.

    Raises:
        InputError: another shape, or a number that is not finite.
    """
    try:
        array = np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError("not numbers", field="position_m", hint="three coordinates a detection") from error
    if array.size == 0:
        return np.empty((0, 3))
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"shape {array.shape} instead of (M, 3)", field="position_m")
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise InputError(f"detection {row}: {array[row].tolist()} is not finite", field="position_m")
    return array


def boxes(values: Any, m: int) -> FloatArray:
    """Return (M, 4) sizes and headings.

    Raises:
        InputError: another shape, a size that is not positive, or a heading that is not finite.
    """
    array = np.ascontiguousarray(values, dtype=np.float64) if m else np.empty((0, 4))
    if array.shape != (m, 4):
        raise InputError(f"shape {array.shape} instead of ({m}, 4)", field="box", hint="length, width, height, heading")
    wrong = np.flatnonzero(~(np.isfinite(array).all(axis=1) & (array[:, :3] > 0.0).all(axis=1)))
    if wrong.size:
        what = f"detection {wrong[0]}: {array[wrong[0]].tolist()} is no box"
        raise InputError(what, field="box", hint="positive sizes [m] and a heading [rad]")
    return array


def probabilities(values: Any, m: int) -> FloatArray:
    """Return (M,) probabilities, nan where none is given.

    Raises:
        InputError: another shape, or a number that is not a probability.
    """
    if values is None:
        return np.full(m, np.nan)
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (m,):
        raise InputError(f"shape {array.shape} instead of ({m},)", field="p_real")
    wrong = np.flatnonzero((array < 0.0) | (array > 1.0))
    if wrong.size:
        raise InputError(f"detection {wrong[0]}: {array[wrong[0]]} is not a probability", field="p_real")
    return array


def classes(values: Any, m: int, n_classes: int) -> IntArray:
    """Return (M,) classes, `UNKNOWN` where none is given.

    Raises:
        InputError: another number of them, no whole numbers, or a class that does not exist.
    """
    if values is None:
        return np.full(m, UNKNOWN)
    array = np.asarray(values)
    if array.shape != (m,):
        raise InputError(f"shape {array.shape} instead of ({m},)", field="class_id")
    if array.size and array.dtype.kind not in "iu":
        raise InputError("classes are whole numbers", field="class_id")
    ids = array.astype(np.int64)
    if m and not (ids.min() >= UNKNOWN and ids.max() < n_classes):
        row = int(np.flatnonzero((ids < UNKNOWN) | (ids >= n_classes))[0])
        raise InputError(
            f"detection {row}: class {ids[row]} of {n_classes} does not exist",
            field="class_id",
            hint=f"0 to {n_classes - 1}, or {UNKNOWN} for unknown",
        )
    return ids


def covariances(values: Any, m: int, default: FloatArray) -> FloatArray:
    """Return (M, 3, 3) covariances, or `default` (1, 3, 3) where none are given.

    Raises:
        InputError: another shape, or a matrix that is not symmetric and positive definite.
    """
    if values is None or m == 0:
        return default
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.shape != (m, 3, 3):
        raise InputError(f"shape {array.shape} instead of ({m}, 3, 3)", field="covariance_m2")
    symmetric = np.isclose(array, array.transpose(0, 2, 1), rtol=1e-6, atol=1e-12).all(axis=(1, 2))
    minors = np.stack([array[:, 0, 0], np.linalg.det(array[:, :2, :2]), np.linalg.det(array)])
    wrong = np.flatnonzero(~(symmetric & (minors > 0.0).all(axis=0) & np.isfinite(array).all(axis=(1, 2))))
    if wrong.size:
        raise InputError(
            f"detection {wrong[0]}: the matrix is not symmetric and positive definite", field="covariance_m2"
        )
    return array


def appearances(values: Any, m: int, n_appearance: int) -> FloatArray:
    """Return (M, A) unit vectors; a row of zeros, or without a finite length, has no appearance.

    Raises:
        InputError: another shape than the tracker was made for.
    """
    if values is None:
        return np.zeros((m, n_appearance))
    array = np.asarray(values, dtype=np.float64)
    if array.size == 0 and m == 0:
        return np.zeros((0, n_appearance))
    if array.shape != (m, n_appearance):
        raise InputError(f"shape {array.shape} instead of ({m}, {n_appearance})", field="appearance")
    length = np.linalg.norm(array, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.ascontiguousarray(np.where((length > 0.0) & np.isfinite(length), array / length, 0.0))
