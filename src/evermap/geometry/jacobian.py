"""Inverse right Jacobians of the exponential map, in the plane and in space by the same formula.

With `A` the bracket of a twist and `q` the square of its rotation, `A (A^2 + q)^2 = 0` in SE(3), and `A (A^2 + q) = 0`
in SE(2). Any power series of `A` is therefore a polynomial of degree four, of which the terms with `A (A^2 + q)` vanish
in the plane. Its coefficients follow from Hermite interpolation at the eigenvalues; in SE(3) the result is that of
Barfoot and Furgale 2014 (Associating uncertainty with three-dimensional poses).
"""

from __future__ import annotations

from math import factorial

import numpy as np

from evermap.types import FloatArray

SERIES_BELOW = 1.0
"""Squared rotation below which coefficients are sums of `TERMS` terms; the rest is below 1e-18 there."""
TERMS = 10
B_SERIES = [(-1) ** m / factorial(2 * m + 2) for m in reversed(range(TERMS))]
C_SERIES = [(-1) ** m / factorial(2 * m + 3) for m in reversed(range(TERMS))]
SERIES = np.array([B_SERIES, C_SERIES, [0.0, *np.polyder(B_SERIES)]])
"""Coefficients of `b`, of `c` and of the derivative of `b`, the highest powers first."""


def inverse_coefficient(q: FloatArray) -> FloatArray:
    """Return `d = (1 - (t / 2) cot(t / 2)) / t^2` of `q = t^2 < 4 pi^2`, without cancellation.

    The inverse of the left Jacobian of a rotation vector is `1 - W / 2 + d W^2`. The Jacobian is `1 + b W + c W^2` with
    `b = (1 - cos t) / t^2` and `c = (t - sin t) / t^3`, `W` its cross product matrix.
    """
    small = q < SERIES_BELOW
    b, c, slope = _sum_series(SERIES, q)
    if not small.all():
        safe = np.where(small, 1.0, q)
        t = np.sqrt(safe)
        b = np.where(small, b, 2.0 * np.sin(t / 2) ** 2 / safe)
        c = np.where(small, c, (t - np.sin(t)) / (safe * t))
        slope = np.where(small, slope, (1.0 - 2.0 * b - q * c) / (2.0 * safe))
    return np.asarray(-slope / b)


def _sum_series(series: FloatArray, q: FloatArray) -> FloatArray:
    """Return (K, ...) sums of power series (K, T) at `q`, by Horner's rule for all together."""
    coefficient = series.T.reshape(series.shape[1], len(series), *(1,) * q.ndim)
    found: FloatArray = coefficient[0] * np.ones_like(q)
    for each in coefficient[1:]:
        found *= q
        found += each
    return found


def inverse_slope(q: FloatArray, d: FloatArray) -> FloatArray:
    """Return the derivative by `q` of `inverse_coefficient`."""
    small = q < 0.01
    series = 1 / 720 + q * (1 / 15120 + q * (1 / 403200 + q / 11975040))
    return np.where(small, series, (1.0 - 12.0 * d + 4.0 * q * d * d) / np.where(small, 1.0, 8.0 * q))


def right_jacobian_inverse(bracket: FloatArray, q: FloatArray) -> FloatArray:
    """Return the inverse of the right Jacobian (..., n, n) of twists with this bracket (..., n, n) and squared rotation
    (...), for rotations of less than a full turn.
    """
    d = inverse_coefficient(q)
    d, by_d = d[..., None, None], inverse_slope(q, d)[..., None, None]
    square = bracket @ bracket
    rest = bracket @ square + q[..., None, None] * bracket  # zero in the plane
    one = np.eye(bracket.shape[-1])
    return np.asarray(one + 0.5 * bracket + d * square - by_d * (rest @ bracket))
