"""Exponentials and logarithms as straight-line arithmetic, so that loops over them use vector units.

The C library's functions are calls, which keep a compiler from handling several rows at once. These are branch-free
and correct to a few units in the last place over the stated ranges (their tests compare with mpmath).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic

from evermap.compiled import kept

kernel = kept(error_model="numpy", fastmath={"contract"})
"""Products and sums may fuse, nothing else is relaxed."""
inlined = kept(error_model="numpy", fastmath={"contract"}, forceinline=True)
"""Into the kernels that call it, which is what lets their loops be vectorised."""
reordered = kept(error_model="numpy", fastmath={"contract", "reassoc", "nsz"}, forceinline=True)
"""The same for sums of which the order does not matter."""
parallel_kernel = kept(error_model="numpy", parallel=True)
"""With its `prange` loops spread over the threads."""


def _align_stack(_typing: Any) -> Any:
    """Called at the top of a kernel with long loops: the vector registers that it spills start on cache lines.

    LLVM decides whether to align the stack before it knows that it will spill 64-byte registers, and then each spill
    straddles two lines in three processes out of four: a fifth of the time of a long loop.
    """

    def generate(context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
        builder.function.attributes.alignstack = 64
        builder.function.attributes.add("nounwind")  # without another attribute llvmlite prints none
        return context.get_dummy_value()

    return types.void(), generate


aligned_stack: Any = intrinsic(_align_stack)


@inlined
def _reduce_exponent(x: Any) -> Any:
    """`e^x = power * (1 + p)`, `power` a power of 2: reduction by ln 2 (Cody and Waite), minimax polynomial (1e-17)."""
    shifted = x * 1.4426950408889634 + 6755399441055744.0  # adding 1.5 * 2^52 rounds to a whole number
    whole = shifted - 6755399441055744.0
    f = (x - whole * 0.6931471803691238) - whole * 1.9082149292705877e-10
    power = np.int64((np.float64(shifted).view(np.int64) + 1023) << 52).view(np.float64)  # 2^whole
    p = 2.5110049895858716e-08
    p = p * f + 2.7620090518499427e-07
    p = p * f + 2.7557242336680357e-06
    p = p * f + 2.4801521290973345e-05
    p = p * f + 0.00019841269886591
    p = p * f + 0.0013888888917217457
    p = p * f + 0.008333333333322207
    p = p * f + 0.04166666666662412
    p = p * f + 0.16666666666666674
    p = p * f + 0.5
    return power, f + f * f * p


@inlined
def expm1(x: Any) -> Any:
    """Return `e^x - 1` for |x| <= 700."""
    power, p = _reduce_exponent(x)
    return power * p + (power - 1.0)


@inlined
def exp(x: Any) -> Any:
    """Return `e^x` for |x| <= 700, to the last digit also where it is small."""
    power, p = _reduce_exponent(x)
    return power * p + power


@inlined
def split(x: Any) -> Any:
    """Return the exponent and fraction of a normal positive number: `x = 2^exponent (1 + f)`, `1 + f` in [sqrt(1/2),
    sqrt(2)).
    """
    bits = np.float64(x).view(np.int64)
    exponent = (bits - np.int64(0x3FE6A09E667F3BCD)) >> 52
    return np.float64(exponent), np.int64(bits - (exponent << 52)).view(np.float64) - 1.0


@inlined
def log_of_split(exponent: Any, s: Any) -> Any:
    """Return `log x` from `split(x)`, `s = f / (2 + f)`: twice the inverse hyperbolic tangent (minimax, 5e-18).

    The quotient is the caller's, who may have another division to share it with.
    """
    z = s * s
    t = 0.07308936401564736
    t = t * z + 0.07665798490120435
    t = t * z + 0.09091446608400358
    t = t * z + 0.11111105536447267
    t = t * z + 0.14285714313199327
    t = t * z + 0.19999999999949222
    t = t * z + 0.3333333333333335
    return exponent * 0.6931471803691238 + (exponent * 1.9082149292705877e-10 + 2.0 * (s + s * (z * t)))
