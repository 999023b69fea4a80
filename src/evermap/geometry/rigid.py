"""Rigid alignment by least squares, in the plane and in space."""

from __future__ import annotations

import numpy as np

from evermap.geometry import se2, se3
from evermap.types import FloatArray


def rigid(source: FloatArray, target: FloatArray, weight: FloatArray | None = None) -> FloatArray:
    """Return the least-squares motion (..., 3) of points (..., k, 2) onto others, with weights (..., k).

    It is (..., 7) of points (..., k, 3) in space; where these lie on one line, it is one of many.
    """
    share = np.ones(source.shape[:-1]) if weight is None else weight
    share = (share / share.sum(axis=-1, keepdims=True))[..., None]
    middle, to = (share * source).sum(axis=-2), (share * target).sum(axis=-2)
    a, b = source - middle[..., None, :], target - to[..., None, :]
    if source.shape[-1] == 3:
        turn = _rotation(np.swapaxes(share * a, -1, -2) @ b)
        turned = np.concatenate([np.zeros_like(middle), turn], axis=-1)
        return se3.normalise_poses(np.concatenate([to - se3.transform(turned, middle), turn], axis=-1))
    across = (share[..., 0] * (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])).sum(axis=-1)
    theta = np.arctan2(across, (share * a * b).sum(axis=(-2, -1)))
    turned = np.stack([np.zeros_like(theta), np.zeros_like(theta), theta], axis=-1)
    return np.concatenate([to - se2.transform(turned, middle), theta[..., None]], axis=-1)


def _rotation(moment: FloatArray) -> FloatArray:
    """Quaternions (..., 4) of the rotations nearest to moments `sum a b'` (..., 3, 3): Horn 1987, closed form."""
    trace = np.trace(moment, axis1=-2, axis2=-1)
    form = np.zeros((*moment.shape[:-2], 4, 4))
    form[..., :3, :3] = moment + np.swapaxes(moment, -1, -2) - trace[..., None, None] * np.eye(3)
    i, j = [1, 2, 0], [2, 0, 1]
    form[..., :3, 3] = form[..., 3, :3] = moment[..., i, j] - moment[..., j, i]
    form[..., 3, 3] = trace
    return np.asarray(np.linalg.eigh(form).eigenvectors[..., -1])
