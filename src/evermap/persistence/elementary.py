"""Exponentials and the exponential integral as straight-line arithmetic, so that loops over them use vector units.

The C library's functions are calls, which keep a compiler from handling several rows at once. These are branch-free
and correct to a few units in the last place over the stated ranges (their tests compare with mpmath).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit

from evermap.compiled import drop_stale_code

_Function = TypeVar("_Function", bound=Callable[..., Any])


drop_stale_code(__file__)


def kernel(function: _Function) -> _Function:
    """Compile at the first call and keep the machine code; products and sums may fuse, nothing else is relaxed."""
    return cast("_Function", njit(cache=True, error_model="numpy", fastmath={"contract"})(function))


def inlined(function: _Function) -> _Function:
    """Compile into the kernels that call it, which is what lets their loops be vectorised."""
    compiled = njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)(function)
    return cast("_Function", compiled)


def parallel_kernel(function: _Function) -> _Function:
    """Compile with its `prange` loops spread over the threads."""
    return cast("_Function", njit(cache=True, error_model="numpy", parallel=True)(function))


@inlined
def _reduced(x: Any) -> Any:
    """`e^x = power * (1 + p)`, `power` a power of 2: reduction by ln 2 (Cody and Waite), Taylor series of degree 13."""
    shifted = x * 1.4426950408889634 + 6755399441055744.0  # adding 1.5 * 2^52 rounds to a whole number
    whole = shifted - 6755399441055744.0
    f = (x - whole * 0.6931471803691238) - whole * 1.9082149292705877e-10
    power = np.int64((np.float64(shifted).view(np.int64) + 1023) << 52).view(np.float64)  # 2^whole
    p = 1.0 / 6227020800.0
    p = p * f + 1.0 / 479001600.0
    p = p * f + 1.0 / 39916800.0
    p = p * f + 1.0 / 3628800.0
    p = p * f + 1.0 / 362880.0
    p = p * f + 1.0 / 40320.0
    p = p * f + 1.0 / 5040.0
    p = p * f + 1.0 / 720.0
    p = p * f + 1.0 / 120.0
    p = p * f + 1.0 / 24.0
    p = p * f + 1.0 / 6.0
    p = p * f + 0.5
    return power, f + f * f * p


@inlined
def expm1(x: Any) -> Any:
    """`e^x - 1` for |x| <= 700."""
    power, p = _reduced(x)
    return power * p + (power - 1.0)


@inlined
def exp(x: Any) -> Any:
    """`e^x` for |x| <= 700, to the last digit also where it is small."""
    power, p = _reduced(x)
    return power * p + power


@inlined
def exponential_integral(x: Any) -> Any:
    """`E1(x)` for 0 < x < 1 and `e^x E1(x)` from there on; normal positive numbers, constant above 1e27.

    Small: `-gamma - log x` and the entire rest as its Taylor series; the logarithm by its exponent and the series of
    the inverse hyperbolic tangent. Large: a rational function of degree (10, 10) in `1 / x`, fitted with 60 digits,
    relative error 2e-17, all coefficients positive. Both need a quotient, and one division serves either.
    """
    u, v = min(x, 1.0), min(max(x, 1.0), 1e27)
    bits = np.float64(u).view(np.int64)
    exponent = (bits - np.int64(0x3FE6A09E667F3BCD)) >> 52  # the mantissa lies in [sqrt(1/2), sqrt(2))
    f = np.int64(bits - (exponent << 52)).view(np.float64) - 1.0
    p = v + 40.58810641415341
    p = p * v + 636.4309414904419
    p = p * v + 4982.662604085902
    p = p * v + 21061.361916263104
    p = p * v + 48678.81314767395
    p = p * v + 59702.395736249586
    p = p * v + 36037.67036614425
    p = p * v + 9227.226658615518
    p = p * v + 720.3053789961139
    p = p * v + 3.905670962488299
    q = v + 41.58810641415334
    q = q * v + 676.0190479046391
    q = q * v + 5581.5054391521035
    q = q * v + 25516.357899338866
    q = q * v + 66210.15980545132
    q = q * v + 96414.99326057384
    q = q * v + 75392.99229178052
    q = q * v + 28996.8957582662
    q = q * v + 4630.937315174753
    q = q * v + 206.80823742894526
    small = x < 1.0
    s = (f if small else p) / (2.0 + f if small else v * q)
    z = s * s
    t = 1.0 / 21.0
    t = t * z + 1.0 / 19.0
    t = t * z + 1.0 / 17.0
    t = t * z + 1.0 / 15.0
    t = t * z + 1.0 / 13.0
    t = t * z + 1.0 / 11.0
    t = t * z + 1.0 / 9.0
    t = t * z + 1.0 / 7.0
    t = t * z + 1.0 / 5.0
    t = t * z + 1.0 / 3.0
    whole = np.float64(exponent)
    log_u = whole * 0.6931471803691238 + (whole * 1.9082149292705877e-10 + 2.0 * (s + s * z * t))
    e = -1.0 / (18.0 * 6402373705728000.0)
    e = e * u + 1.0 / (17.0 * 355687428096000.0)
    e = e * u - 1.0 / (16.0 * 20922789888000.0)
    e = e * u + 1.0 / (15.0 * 1307674368000.0)
    e = e * u - 1.0 / (14.0 * 87178291200.0)
    e = e * u + 1.0 / (13.0 * 6227020800.0)
    e = e * u - 1.0 / (12.0 * 479001600.0)
    e = e * u + 1.0 / (11.0 * 39916800.0)
    e = e * u - 1.0 / (10.0 * 3628800.0)
    e = e * u + 1.0 / (9.0 * 362880.0)
    e = e * u - 1.0 / (8.0 * 40320.0)
    e = e * u + 1.0 / (7.0 * 5040.0)
    e = e * u - 1.0 / (6.0 * 720.0)
    e = e * u + 1.0 / (5.0 * 120.0)
    e = e * u - 1.0 / (4.0 * 24.0)
    e = e * u + 1.0 / (3.0 * 6.0)
    e = e * u - 1.0 / 4.0
    e = e * u + 1.0
    return e * u - (0.5772156649015329 + log_u) if small else s
