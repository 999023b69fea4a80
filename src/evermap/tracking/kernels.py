"""How the kernels of this package are compiled, and the small linear algebra that they share."""

from __future__ import annotations

import math
from typing import Any

from evermap.compiled import drop_stale_code, kept
from evermap.types import FloatArray

drop_stale_code(__file__)

kernel = kept(error_model="numpy")
inlined = kept(error_model="numpy", forceinline=True)


@inlined
def distance_and_log_det(
    x: Any, y: Any, z: Any, xx: Any, xy: Any, xz: Any, yy: Any, yz: Any, zz: Any
) -> tuple[float, float]:
    """Squared Mahalanobis length of (x, y, z) under a symmetric (3, 3), and the log of its determinant.

    By the factors `L D L'`; infinite where the matrix is not positive definite.
    """
    a, b = xy / xx, xz / xx
    d1 = yy - a * xy
    rest = yz - b * xy
    c = rest / d1
    d2 = zz - b * xz - c * rest
    if not (xx > 0.0 and d1 > 0.0 and d2 > 0.0):
        return math.inf, math.inf
    u = y - a * x
    v = z - b * x - c * u
    return x * x / xx + u * u / d1 + v * v / d2, math.log(xx * d1 * d2)


@inlined
def invert(m: FloatArray, out: FloatArray) -> None:
    """Inverse of a symmetric positive definite (3, 3)."""
    xx, xy, xz, yy, yz, zz = m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2]
    cxx, cxy, cxz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    scale = 1.0 / (xx * cxx + xy * cxy + xz * cxz)
    out[0, 0], out[1, 1], out[2, 2] = cxx * scale, (xx * zz - xz * xz) * scale, (xx * yy - xy * xy) * scale
    out[0, 1] = out[1, 0] = cxy * scale
    out[0, 2] = out[2, 0] = cxz * scale
    out[1, 2] = out[2, 1] = (xy * xz - xx * yz) * scale
