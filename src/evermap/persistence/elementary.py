"""exp - 1, log and the exponential integral as straight-line arithmetic, so that loops over them use vector units.

The C library's functions are calls, which keep a compiler from handling several rows at once. These are branch-free
and correct to a few units in the last place over the stated ranges (their tests compare with mpmath).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit

_Function = TypeVar("_Function", bound=Callable[..., Any])


def _drop_stale_code() -> None:
    """Delete kept machine code that is older than any source of this package.

    A kernel's machine code contains the kernels it calls, but its keeper looks at the kernel's own file only.
    """
    sources = Path(__file__).parent
    newest = max(path.stat().st_mtime for path in sources.glob("*.py"))
    for index in (sources / "__pycache__").glob("*.nbi"):
        if index.stat().st_mtime < newest:
            index.unlink(missing_ok=True)


_drop_stale_code()


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
def expm1(x: Any) -> Any:
    """`e^x - 1` for |x| <= 700: argument reduction by ln 2 (Cody and Waite), Taylor series of degree 13."""
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
    p = f + f * f * p
    return power * p + (power - 1.0)


@inlined
def log(x: Any) -> Any:
    """Natural logarithm of a normal positive number: exponent apart, series of the inverse hyperbolic tangent."""
    bits = np.float64(x).view(np.int64)
    exponent = (bits - np.int64(0x3FE6A09E667F3BCD)) >> 52  # the mantissa lies in [sqrt(1/2), sqrt(2))
    f = np.int64(bits - (exponent << 52)).view(np.float64) - 1.0
    s = f / (2.0 + f)
    z = s * s
    p = 1.0 / 21.0
    p = p * z + 1.0 / 19.0
    p = p * z + 1.0 / 17.0
    p = p * z + 1.0 / 15.0
    p = p * z + 1.0 / 13.0
    p = p * z + 1.0 / 11.0
    p = p * z + 1.0 / 9.0
    p = p * z + 1.0 / 7.0
    p = p * z + 1.0 / 5.0
    p = p * z + 1.0 / 3.0
    whole = np.float64(exponent)
    return whole * 0.6931471803691238 + (whole * 1.9082149292705877e-10 + 2.0 * (s + s * z * p))


@inlined
def e1_small(x: Any) -> Any:
    """Exponential integral `E1(x)` for 0 < x <= 1: `-gamma - log x` and the entire rest as its Taylor series."""
    p = -1.0 / (18.0 * 6402373705728000.0)
    p = p * x + 1.0 / (17.0 * 355687428096000.0)
    p = p * x - 1.0 / (16.0 * 20922789888000.0)
    p = p * x + 1.0 / (15.0 * 1307674368000.0)
    p = p * x - 1.0 / (14.0 * 87178291200.0)
    p = p * x + 1.0 / (13.0 * 6227020800.0)
    p = p * x - 1.0 / (12.0 * 479001600.0)
    p = p * x + 1.0 / (11.0 * 39916800.0)
    p = p * x - 1.0 / (10.0 * 3628800.0)
    p = p * x + 1.0 / (9.0 * 362880.0)
    p = p * x - 1.0 / (8.0 * 40320.0)
    p = p * x + 1.0 / (7.0 * 5040.0)
    p = p * x - 1.0 / (6.0 * 720.0)
    p = p * x + 1.0 / (5.0 * 120.0)
    p = p * x - 1.0 / (4.0 * 24.0)
    p = p * x + 1.0 / (3.0 * 6.0)
    p = p * x - 1.0 / 4.0
    p = p * x + 1.0
    return p * x - (0.5772156649015329 + log(x))


@inlined
def e1_scaled_large(x: Any) -> Any:
    """`e^x E1(x)` for x >= 1: rational in `1 / x` of degree (10, 10), fitted with 60 digits, relative error 2e-17.

    All coefficients are positive, so that nothing cancels.
    """
    z = 1.0 / x
    p = 3.905670962488299
    p = p * z + 720.3053789961139
    p = p * z + 9227.226658615518
    p = p * z + 36037.67036614425
    p = p * z + 59702.395736249586
    p = p * z + 48678.81314767395
    p = p * z + 21061.361916263104
    p = p * z + 4982.662604085902
    p = p * z + 636.4309414904419
    p = p * z + 40.58810641415341
    p = p * z + 1.0
    q = 206.80823742894526
    q = q * z + 4630.937315174753
    q = q * z + 28996.8957582662
    q = q * z + 75392.99229178052
    q = q * z + 96414.99326057384
    q = q * z + 66210.15980545132
    q = q * z + 25516.357899338866
    q = q * z + 5581.5054391521035
    q = q * z + 676.0190479046391
    q = q * z + 41.58810641415334
    q = q * z + 1.0
    return z * p / q
