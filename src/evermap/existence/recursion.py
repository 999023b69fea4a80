"""The persistence recursion: every formula of MATH.md section 2 once, for floats, compiled loops and tensors alike.

Plain Python on one number at a time. `one_stay` calls it directly, `kernels` compiles it into loops over rows, `batch`
reads its conditional expressions as selections between whole tensors. A belief is its inverse odds `r = (1 - p) / p`:
a gap of conditional survival `q` gives `r + (1 + r) (1 - q) / q`, a look multiplies by its likelihood when gone over
its likelihood when there.

Lifetimes of unknown rate (Rosen 2016 eqs. 26-29) are straight-line arithmetic, so that loops use vector units.
`D(t) = E1(low t) - E1(high t)` is their survival but for a constant. Here it is scaled by `e^(low t)` as soon as
`low t >= 1`, which keeps it a normal number at any age: `S = e^s D`, `s = low t` or 0. The polynomials of the
exponential integral were fitted with 50 digits; highest power first.
"""

from __future__ import annotations

from math import exp, expm1, frexp, log
from typing import Any, NamedTuple

INF, NAN = float("inf"), float("nan")
SMALLEST = 1e-300
"""Inverse odds of a feature that is present beyond every finite doubt; exactly 0 is certainty."""
LARGEST = 1e300
"""Inverse odds of a feature that is gone beyond every finite doubt; infinity is certainty."""
LOG_LARGEST = log(LARGEST)
SERIES = (
    1.5013750012591917e-09, -2.5841256043524532e-08, 3.0396444844847993e-07, -3.0983732358297067e-06,
    2.834370254941879e-05, -0.00023148114958617023, 0.0016666665955014242, -0.010416666657736743,
    0.05555555555497918, -0.24999999999998546, 0.9999999999999999,
)  # fmt: skip
"""`(E1(x) + log x + gamma) / x` on [0, 1]: minimax, relative error 6e-17."""

NUMERATOR = (
    0.0, 1.0, 34.37770363805674, 443.9946033752262, 2760.421672406844, 8820.41760460935, 14380.479978636853,
    11221.149807748383, 3633.612499628075, 352.431272111798, 2.3847401717119427,
)  # fmt: skip
DENOMINATOR = (
    1.0, 35.37770363805599, 477.37230701372374, 3173.0385720540626, 11226.977793969772, 21396.548962835925,
    21270.39202563451, 10171.588737098129, 1983.5082469855927, 106.49313334660272, 1e-300,
)  # fmt: skip
"""`NUMERATOR(x) / DENOMINATOR(x)` is `e^x E1(x)` from 1 on: minimax, relative error 4e-16, no zeros and no poles.

The last coefficient stands for 0 and keeps the reciprocal finite where x is 0 and the quotient is not asked for.
"""

TINY_TIME = 1e-80
"""Stands for time 0 where a logarithm or a quotient is taken: S is 1 there to every digit."""
GAMMA = 0.5772156649015329
"""Euler's constant."""
DIFFERENCE_TRUSTED = 2e-4
"""Odds of dying in a gap above which a difference of survivals has lost less than four digits."""
NODE = 0.28867513459481287
"""Gauss-Legendre quadrature with two points: half a gap over the square root of three either side of its middle."""
EXP_GAMMA = exp(GAMMA)


class RowState(NamedTuple):
    """Features before a look.

    Attributes:
        inverse_odds: (N,) `(1 - p) / p` after the last look, 0 at birth.
        stamp_s: (N,) time of that look, in seconds since each feature's birth.
    """

    inverse_odds: Any
    stamp_s: Any


class RowLooks(NamedTuple):
    """One look at each of N features.

    Attributes:
        time_s: (N,) when, on each feature's own clock.
        detected: (N,) bool.
        p_miss: (N,) `P(no detection | there)`.
        p_false: (N,) `P(detection | gone)`.
    """

    time_s: Any
    detected: Any
    p_miss: Any
    p_false: Any


def odds_of(log_odds: Any) -> Any:
    """Return `e^x` of log-odds, between the smallest and the largest; infinities are certainties."""
    bounded = exp(min(max(log_odds, -LOG_LARGEST), LOG_LARGEST))
    return bounded if abs(log_odds) < INF else (INF if log_odds > 0.0 else 0.0)


def aged(inverse_odds: Any, death_odds: Any) -> Any:
    """Return the inverse odds after a gap; `death_odds` is `(1 - q) / q`, infinite for certain death."""
    after = inverse_odds + (1.0 + inverse_odds) * death_odds
    bounded = after if after < LARGEST else LARGEST  # noqa: FURB136  (a call takes a tenth of an update)
    return bounded if (inverse_odds < INF) & (death_odds < INF) else INF


def observed(predicted: Any, there: Any, gone: Any) -> Any:
    """Return the inverse odds after a look of these likelihoods, and its evidence `p(y_n | y_1:n-1)`.

    NaN where it is impossible under both states. Only what excludes a state makes a certainty; doubt stays doubt.
    """
    probability = 1.0 / (1.0 + predicted)
    evidence = probability * there + (predicted * probability if predicted < INF else 1.0) * gone
    possible = (predicted > 0.0) & (gone > 0.0)
    after = predicted * gone / there if there > 0.0 else (INF if possible else NAN)
    after = SMALLEST if (after < SMALLEST) & possible else after
    return (LARGEST if (after > LARGEST) & (predicted < INF) & (there > 0.0) else after), evidence


def weighed(predicted: Any, log_ratio: Any) -> Any:
    """Return the inverse odds after a look from the logarithm of the likelihood when there over that when gone.

    Many landmarks may weigh more than `exp` can hold: in two halves, each cut where the result would be cut anyway.
    """
    half = odds_of(-0.5 * log_ratio)
    doubtful = (predicted > 0.0) & (predicted < INF)
    begun = min(max(predicted * half, SMALLEST), LARGEST) if doubtful else predicted
    after, _ = observed(begun, 1.0 if log_ratio > -INF else 0.0, half)
    return after


def mixed(inverse_odds: Any, leave: Any, comes: Any, gap: Any) -> Any:
    """Return the inverse odds after a gap in which a feature may leave and return any number of times (section 4).

    Stays and absences are exponential; only sums of positive terms.
    """
    total = leave + comes
    x = max(min(total * gap, LOG_LARGEST), 0.0)
    fresh, kept = -expm1(-x), exp(-x)
    scale = 1.0 / max(total, SMALLEST)
    leaving = leave * scale if total > 0.0 else 1.0  # neither leaves nor returns: unchanged
    returning = comes * scale
    bounded = min(inverse_odds, LARGEST)
    gone = leaving * fresh + bounded * (leaving + returning * kept)
    there = (returning + leaving * kept) + bounded * returning * fresh
    return min(gone / there, LARGEST)


def looked(predicted: Any, detected: Any, p_miss: Any, p_false: Any) -> Any:
    """Return the inverse odds after a look, and whether its numbers were in order."""
    there = 1.0 - p_miss if detected else p_miss
    gone = p_false if detected else 1.0 - p_false
    new, _ = observed(predicted, there, gone)
    return new, (new >= 0.0) & (p_miss >= 0.0) & (p_miss <= 1.0) & (p_false >= 0.0) & (p_false <= 1.0)


def look_exponential(odds: Any, start: Any, rate: Any, stop: Any, hit: Any, p_miss: Any, p_false: Any) -> Any:
    """Return the inverse odds after a look under a constant hazard, and whether all was in order."""
    gap = stop - start
    predicted = aged(odds, expm1(max(min(rate * gap, LOG_LARGEST), 0.0)))
    new, fine = looked(predicted, hit, p_miss, p_false)
    return new, fine & (gap >= 0.0) & (stop < INF) & (rate >= 0.0) & (rate < INF)


def later_exponential(odds: Any, rate: Any, horizon: Any) -> Any:
    """Return the probability `horizon` after a look."""
    return exp(-max(min(rate * horizon, LOG_LARGEST), 0.0)) / (1.0 + odds)


def look_two_state(
    odds: Any, start: Any, leave: Any, comes: Any, stop: Any, hit: Any, p_miss: Any, p_false: Any
) -> Any:
    """Return the same for a feature that leaves and returns."""
    gap = stop - start
    gone_for_good = (odds == INF) & (comes * gap == 0.0)
    new, fine = looked(INF if gone_for_good else mixed(odds, leave, comes, gap), hit, p_miss, p_false)
    fine = fine & (odds >= 0.0) & (gap >= 0.0) & (stop < INF)
    return new, fine & (leave >= 0.0) & (leave < INF) & (comes >= 0.0) & (comes < INF)


def later_two_state(odds: Any, leave: Any, comes: Any, horizon: Any) -> Any:
    """Return the probability `horizon` after a look."""
    return 1.0 / (1.0 + mixed(odds, leave, comes, horizon))


def look_general_purpose(
    odds: Any, start: Any, low: Any, high: Any, stop: Any, hit: Any, p_miss: Any, p_false: Any
) -> Any:
    """Return the same for a lifetime of unknown rate, and in the middle the scaled survival at the look."""
    at_start, _ = scaled_survival(low, high, start)
    at_stop, decay = scaled_survival(low, high, stop)
    predicted = aged(odds, odds_of_dying(low, high, start, stop, at_start, at_stop, decay))
    new, fine = looked(predicted, hit, p_miss, p_false)
    fine = fine & (stop >= start) & (stop < INF) & (low > 0.0) & (high > low) & (high < INF)
    return new, at_stop, fine


def later_general_purpose(odds: Any, low: Any, high: Any, stop: Any, horizon: Any, at_stop: Any) -> Any:
    """Return the probability `horizon` after a look at `stop`."""
    at_end, _ = scaled_survival(low, high, stop + horizon)
    return conditional_survival(low, stop, stop + horizon, at_stop * (1.0 + odds), at_end)


def split(x: Any) -> Any:
    """Return the exponent and fraction of a positive number: `x = 2^e (1 + f)`, `1 + f` in [sqrt(1/2), sqrt(2))."""
    fraction, exponent = frexp(x)
    low = fraction < 0.7071067811865476
    return float(exponent - low), fraction * (1.0 + low) - 1.0


def log_of_split(exponent: Any, s: Any) -> Any:
    """Return `log x` from `split(x)`, given `s = f / (2 + f)`."""
    return exponent * 0.6931471805599453 + log((1.0 + s) / (1.0 - s))


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


def _denominator(x: Any) -> Any:
    z = x * x
    even, odd = DENOMINATOR[0], DENOMINATOR[1]
    for k in range(2, 10, 2):
        even = even * z + DENOMINATOR[k]
        odd = odd * z + DENOMINATOR[k + 1]
    return (even * z + DENOMINATOR[10]) + x * odd


def scaled_survival(low: Any, high: Any, time: Any) -> Any:
    """Return `S` and `e^(s - high t) - 1`, for any `0 < low < high` and any time from 0.

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


def _scale_step(low: Any, start: Any, stop: Any) -> Any:
    """Return the growth of `s` over a gap."""
    after = low * stop
    return low * (stop - start) if low * start >= 1.0 else (after if after >= 1.0 else 0.0)


def _death_density(base: Any, slow: Any, fast: Any, x: Any, y: Any) -> Any:
    """`slow e^x - fast e^y` for small exponents, `base = slow - fast`: density of the lifetime times t."""
    grown = x * (1.0 + x * (0.5 + x * (1.0 / 6.0)))
    return base + slow * grown - fast * (y * (1.0 + y * (0.5 + y * (1.0 / 6.0 + y * (1.0 / 24.0 + y * (1.0 / 120.0))))))


def odds_of_dying(low: Any, high: Any, start: Any, stop: Any, at_start: Any, at_stop: Any, decay: Any) -> Any:
    """Return `(1 - q) / q` of a gap, given `S` at both of its ends and the decay at the later one.

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


def conditional_survival(low: Any, start: Any, stop: Any, at_start: Any, at_stop: Any) -> Any:
    """Return `q` of a gap, given `S` at both of its ends; few digits of `1 - q` are left where q is near 1."""
    return at_stop * exp(-max(min(_scale_step(low, start, stop), LOG_LARGEST), 0.0)) / at_start


def gap_odds(low: Any, high: Any, start: Any, stop: Any) -> Any:
    """Return `(1 - q) / q` of a gap."""
    at_start, _ = scaled_survival(low, high, start)
    at_stop, decay = scaled_survival(low, high, stop)
    return odds_of_dying(low, high, start, stop, at_start, at_stop, decay)
