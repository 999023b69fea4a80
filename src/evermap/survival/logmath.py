"""Logarithms, integrals and special functions in forms that do not cancel or overflow."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from evermap.types import FloatArray

TINY = 1e-300
"""In place of 0 where a logarithm or a quotient is taken."""
_EULER_GAMMA = 0.5772156649015328606
_SMOOTH_RATIO = 0.1
"""Below this difference of `log H` between two times, integrating the hazard is more exact than subtracting."""


def log_one_minus_exp(x: FloatArray) -> FloatArray:
    """Return `log(1 - exp(-x))` for `x >= 0`; `-inf` at 0."""
    return np.where(x < np.log(2.0), np.log(-np.expm1(-x)), np.log1p(-np.exp(-x)))


def log_one_minus_exp_of_minus_exp(y: FloatArray) -> FloatArray:
    """Return `log(1 - exp(-exp(y)))`, also where `exp(y)` underflows."""
    x = np.exp(y)
    # 1 - exp(-x) = x (1 - x/2 + ...): below 1e-17 the bracket is 1 in double precision.
    return np.where(y < -40.0, y, log_one_minus_exp(x))


def log_sum_exp(x: FloatArray) -> FloatArray:
    """Return `log sum exp(x)` over the last axis; `-inf` where all are, `+inf` where any is."""
    top = np.max(x, axis=-1)
    shift = np.where(np.isfinite(top), top, 0.0)
    total = np.log(np.sum(np.exp(x - shift[..., None]), axis=-1)) + shift
    return np.where(np.isposinf(top), np.inf, total)


@lru_cache(maxsize=8)
def gauss_legendre(count: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of Gauss-Legendre quadrature on [0, 1], each (count,)."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1.0), 0.5 * weights


def log_ratio(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return `log(b / a)` for `0 <= a <= b`, exact also where they nearly agree."""
    return np.where(b < 2.0 * a, np.log1p((b - a) / a), np.log(b) - np.log(a))


def log_integral_of_smooth_hazard(
    a: FloatArray,
    b: FloatArray,
    log_cumulative: Callable[[FloatArray], FloatArray],
    log_hazard: Callable[[FloatArray], FloatArray],
) -> FloatArray:
    """Return `log int_a^b h` of a hazard that is smooth in log t, with full relative precision.

    Where `H` grows by more than a tenth between `a` and `b` the difference of its two values is exact enough;
    where it grows by less, its hazard is close to a polynomial, which twelve nodes in log t integrate.
    """
    at_a, at_b = log_cumulative(a), log_cumulative(b)
    growth = at_b - at_a
    result = np.asarray(at_b + log_one_minus_exp(np.where(a > 0.0, np.maximum(growth, 0.0), np.inf)))
    near = (a > 0.0) & ((growth < _SMOOTH_RATIO) | np.isnan(growth))
    if near.any():
        nodes, weights = gauss_legendre(12)
        first = a[near]
        width = log_ratio(first, b[near])
        t = first[..., None] * np.exp(width[..., None] * nodes)
        result[near] = np.log(width) + log_sum_exp(log_hazard(t) + np.log(t) + np.log(weights))
    return result


def scaled_e1(x: FloatArray) -> FloatArray:
    """Return `exp(x) E1(x)` for `x >= 0`."""
    from scipy.special import exp1

    large = x > 50.0
    small = np.where(large, 1.0, x)
    big = np.where(large, x, 50.0)
    # Asymptotic series sum (-1)^n n! / x^(n+1): at 50 its 22nd term is 1e-16 of the first.
    series = np.ones_like(big)
    for n in range(22, 0, -1):
        series = 1.0 - n / big * series
    return np.where(large, series / big, np.exp(small) * exp1(small))


def entire_exponential_integral(x: FloatArray) -> FloatArray:
    """Return `Ein(x) = int_0^x (1 - exp(-s)) / s ds = E1(x) + log x + gamma`, to full relative precision near 0."""
    from scipy.special import exp1

    small = x < 1.0
    near = np.where(small, x, 0.0)
    term = near.copy()
    total = near.copy()
    for n in range(2, 20):
        term = -term * near / n
        total = total + term / n
    far = np.where(small, 1.0, x)
    return np.where(small, total, exp1(far) + np.log(far) + _EULER_GAMMA)
