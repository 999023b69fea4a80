"""Lifetimes of unknown rate (Rosen 2016 eqs. 26-29) as straight-line arithmetic, so that loops use vector units.

`D(t) = E1(low t) - E1(high t)` is their survival but for a constant. Here it is scaled by `e^(low t)` as soon as
`low t >= 1`, which keeps it a normal number at any age: `S = e^s D`, `s = low t` or 0.
"""

from __future__ import annotations

import math
from typing import Any

from evermap.existence.coefficients import DENOMINATOR, DIFFERENCE_TRUSTED, GAMMA, NODE, NUMERATOR, SERIES, TINY_TIME
from evermap.existence.elementary import exp, expm1, inlined, log_of_split, split
from evermap.existence.state import LARGEST, LOG_LARGEST

EXP_GAMMA = math.exp(GAMMA)


@inlined
def _numerator(x: Any, large: Any) -> Any:
    """Polynomial of the exponential integral below 1 and from 1 on: one chain of products serves both.

    Even and odd powers apart, here and below, for the second chain runs in the waiting times of the first.
    """
    z = x * x
    even = NUMERATOR[0] if large else SERIES[0]
    odd = NUMERATOR[1] if large else SERIES[1]
    for k in range(2, 10, 2):
        even = even * z + (NUMERATOR[k] if large else SERIES[k])
        odd = odd * z + (NUMERATOR[k + 1] if large else SERIES[k + 1])
    return (even * z + (NUMERATOR[10] if large else SERIES[10])) + x * odd


@inlined
def _denominator(x: Any) -> Any:
    z = x * x
    even, odd = DENOMINATOR[0], DENOMINATOR[1]
    for k in range(2, 10, 2):
        even = even * z + DENOMINATOR[k]
        odd = odd * z + DENOMINATOR[k + 1]
    return (even * z + DENOMINATOR[10]) + x * odd


@inlined
def scaled_survival(low: Any, high: Any, time: Any) -> Any:
    """`S` and `e^(s - high t) - 1`, for any `0 < low < high` and any time from 0.

    E1 is a series and a logarithm below 1, a rational function of x from there on. Where both arguments are below 1,
    the two logarithms are one of `low / high`. One division serves everything.
    """
    late, grown = low * time >= 1.0, high * time >= 1.0
    x, y = min(low * time, 1e15), min(high * time, 1e15)
    p, q = _numerator(x, late), _denominator(x)
    p_high, q_high = _numerator(y, grown), _denominator(y)
    exponent, f = split(x * EXP_GAMMA if grown else low / high)
    d = q if late else 2.0 + f
    inverse = 1.0 / (d * q_high)
    ratio = (p if late else f) * (q_high * inverse)
    decay = expm1(-min(y - (x if late else 0.0), 600.0))
    first = ratio if late else p * x - log_of_split(exponent, ratio)
    return first - p_high * ((1.0 + decay) * (d * inverse) if grown else y), decay


@inlined
def _scale_step(low: Any, start: Any, stop: Any) -> Any:
    """By how much `s` grows over a gap."""
    after = low * stop
    return low * (stop - start) if low * start >= 1.0 else (after if after >= 1.0 else 0.0)


@inlined
def _death_density(base: Any, slow: Any, fast: Any, x: Any, y: Any) -> Any:
    """`slow e^x - fast e^y` for small exponents, `base = slow - fast`: density of the lifetime times t."""
    grown = x * (1.0 + x * (0.5 + x * (1.0 / 6.0)))
    return base + slow * grown - fast * (y * (1.0 + y * (0.5 + y * (1.0 / 6.0 + y * (1.0 / 24.0 + y * (1.0 / 120.0))))))


@inlined
def odds_of_dying(low: Any, high: Any, start: Any, stop: Any, at_start: Any, at_stop: Any, decay: Any) -> Any:
    """`(1 - q) / q` of a gap, given `S` at both of its ends and the decay at the later one.

    The difference of two survivals where they differ. Where they nearly agree the integral of the density: two nodes
    in the gap, exponentials from its end by their series, for such a gap is short on the scale of all rates that count.
    """
    gap = max(stop - start, 0.0)
    late = low * stop >= 1.0
    step = max(min(_scale_step(low, start, stop), LOG_LARGEST), 0.0)
    change = expm1(step if late else -low * stop)  # both of its uses at the cost of one
    difference = (change if late else 0.0) * at_start + (at_start - at_stop)

    slow = 0.0 if late else change
    middle, reach = max(start + 0.5 * gap, TINY_TIME), NODE * gap
    x, y = low * gap, min(high * gap, 0.5)
    near, far = 0.5 + NODE, 0.5 - NODE  # of the two nodes to the end of the gap
    left = _death_density(slow - decay, 1.0 + slow, 1.0 + decay, near * x, near * y)
    right = _death_density(slow - decay, 1.0 + slow, 1.0 + decay, far * x, far * y)
    mass = 0.5 * gap * (middle * (left + right) + reach * (left - right))
    apart = difference > DIFFERENCE_TRUSTED * at_stop
    weight = 1.0 if apart else middle * middle - reach * reach
    return min((difference if apart else mass) / (at_stop * weight), LARGEST)


@inlined
def conditional_survival(low: Any, start: Any, stop: Any, at_start: Any, at_stop: Any) -> Any:
    """`q` of a gap, given `S` at both of its ends; its digits are lost with those of `1 - q` when q is close to 1."""
    return at_stop * exp(-max(min(_scale_step(low, start, stop), LOG_LARGEST), 0.0)) / at_start


@inlined
def gap_odds(low: Any, high: Any, start: Any, stop: Any) -> Any:
    """`(1 - q) / q` of a gap."""
    at_start, _ = scaled_survival(low, high, start)
    at_stop, decay = scaled_survival(low, high, stop)
    return odds_of_dying(low, high, start, stop, at_start, at_stop, decay)
