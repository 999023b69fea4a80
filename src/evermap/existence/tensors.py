"""The looks of `batch` on torch tensors, on whatever device they are; no import of torch, the tensors bring it.

The arithmetic is that of the kernels, with whole tensors for rows. Exponential lifetimes are computed in the tensors'
own type. Lifetimes of unknown rate are computed in double precision whatever comes in, for their odds of dying are
differences of nearly equal numbers, of which single precision would leave three or four digits.
"""

from __future__ import annotations

from functools import reduce
from typing import Any

from evermap.existence.coefficients import DENOMINATOR, DIFFERENCE_TRUSTED, GAMMA, NODE, NUMERATOR, SERIES, TINY_TIME
from evermap.existence.state import LARGEST, LOG_LARGEST, SMALLEST

Tensor = Any
"""A `torch.Tensor`; torch need not be installed where types are checked."""


def exponential(
    inverse_odds: Tensor,
    stamp_s: Tensor,
    rate_hz: Tensor,
    time_s: Tensor,
    detected: Tensor,
    p_miss: Tensor,
    p_false: Tensor,
    horizon_s: float,
) -> tuple[Tensor, Tensor, bool]:
    """As the kernel of this name; inverse odds, probability, and whether a row was refused."""
    gap = time_s - stamp_s
    hazard, later = rate_hz * gap, rate_hz * horizon_s
    new, fine = _looked(inverse_odds, hazard.clamp(0.0, _range(hazard)[2]).expm1(), detected, p_miss, p_false)
    probability = (-later).exp() / (1.0 + new)
    fine = fine & (gap >= 0.0) & time_s.isfinite() & (rate_hz >= 0.0) & rate_hz.isfinite()
    return _answered(inverse_odds, new, probability, fine)


def general_purpose(
    inverse_odds: Tensor,
    stamp_s: Tensor,
    low_hz: Tensor,
    high_hz: Tensor,
    time_s: Tensor,
    detected: Tensor,
    p_miss: Tensor,
    p_false: Tensor,
    horizon_s: float,
) -> tuple[Tensor, Tensor, bool]:
    """As the kernel of this name; inverse odds, probability, and whether a row was refused."""
    odds, start, low, high, stop, miss, false = (
        column.double() for column in (inverse_odds, stamp_s, low_hz, high_hz, time_s, p_miss, p_false)
    )
    at_start, _ = _scaled_survival(low, high, start)
    at_stop, decay = _scaled_survival(low, high, stop)
    dying = _odds_of_dying(low, high, start, stop, at_start, at_stop, decay)
    new, fine = _looked(odds, dying, detected, miss, false)
    probability = 1.0 / (1.0 + new)
    if horizon_s > 0.0:
        at_end, _ = _scaled_survival(low, high, stop + horizon_s)
        shrunk = (-_scale_step(low, stop, stop + horizon_s).clamp(0.0, LOG_LARGEST)).exp()
        probability = probability * (at_end * shrunk / at_stop)
    fine = fine & (stop >= start) & stop.isfinite() & (low > 0.0) & (high > low) & high.isfinite()
    return _answered(inverse_odds, new, probability, fine)


def two_state(
    inverse_odds: Tensor,
    stamp_s: Tensor,
    leave_hz: Tensor,
    return_hz: Tensor,
    time_s: Tensor,
    detected: Tensor,
    p_miss: Tensor,
    p_false: Tensor,
    horizon_s: float,
) -> tuple[Tensor, Tensor, bool]:
    """As the kernel of this name; inverse odds, probability, and whether a row was refused."""
    gap = time_s - stamp_s
    mixed = _mixed(inverse_odds, leave_hz, return_hz, gap)
    gone_for_good = inverse_odds.isinf() & (return_hz * gap == 0.0)
    new, fine = _updated(mixed.where(~gone_for_good, float("inf")), detected, p_miss, p_false)
    probability = 1.0 / (1.0 + _mixed(new, leave_hz, return_hz, horizon_s))
    fine = fine & (inverse_odds >= 0.0) & (gap >= 0.0) & time_s.isfinite()
    fine = fine & (leave_hz >= 0.0) & leave_hz.isfinite() & (return_hz >= 0.0) & return_hz.isfinite()
    return _answered(inverse_odds, new, probability, fine)


def _mixed(inverse_odds: Tensor, leave: Tensor, comes: Tensor, gap: Any) -> Tensor:
    """Inverse odds after a gap in which a feature may leave and return any number of times."""
    smallest, largest, log_largest = _range(inverse_odds)
    total = leave + comes
    x = (total * gap).clamp(0.0, log_largest)
    fresh, kept = -(-x).expm1(), (-x).exp()
    scale = 1.0 / total.clamp(min=smallest)
    leaving, returning = (leave * scale).where(total > 0.0, 1.0), comes * scale
    bounded = inverse_odds.clamp(max=largest)
    gone = leaving * fresh + bounded * (leaving + returning * kept)
    there = (returning + leaving * kept) + bounded * returning * fresh
    return (gone / there).clamp(max=largest)


def _range(like: Tensor) -> tuple[float, float, float]:
    """Smallest and largest finite inverse odds in a tensor's type, and the logarithm of the largest."""
    return (SMALLEST, LARGEST, LOG_LARGEST) if like.element_size() == 8 else (1e-37, 1e37, 85.0)


def _looked(before: Tensor, dying: Tensor, detected: Tensor, p_miss: Tensor, p_false: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse odds after a gap and a look, and whether the numbers of the look were in order."""
    predicted = (before + (1.0 + before) * dying).clamp(max=_range(before)[1])
    return _updated(predicted.where(before.isfinite() & dying.isfinite(), float("inf")), detected, p_miss, p_false)


def _updated(predicted: Tensor, detected: Tensor, p_miss: Tensor, p_false: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse odds after a look, and whether its numbers were in order."""
    smallest, largest, _ = _range(predicted)
    there, gone = (1.0 - p_miss).where(detected, p_miss), p_false.where(detected, 1.0 - p_false)
    after = predicted * gone / there
    after = after.clamp(min=smallest).where((predicted > 0.0) & (gone > 0.0), after)
    after = after.clamp(max=largest).where(predicted.isfinite() & (there > 0.0), after)
    fine = (after >= 0.0) & (p_miss >= 0.0) & (p_miss <= 1.0) & (p_false >= 0.0) & (p_false <= 1.0)
    return after, fine


def _answered(like: Tensor, new: Tensor, probability: Tensor, fine: Tensor) -> tuple[Tensor, Tensor, bool]:
    smallest, largest, _ = _range(like)
    kept = new.clamp(smallest, largest).where((new > 0.0) & new.isfinite(), new)
    return kept.to(like.dtype), probability.to(like.dtype), not bool(fine.all())


def _polynomial(coefficients: tuple[float, ...], x: Tensor) -> Tensor:
    return reduce(lambda p, c: p * x + c, coefficients[1:], x.new_full((), coefficients[0]))


def _scaled_survival(low: Tensor, high: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
    """As `unknown_rate.scaled_survival`."""
    t = time.clamp(min=TINY_TIME)
    x, y = (low * t).clamp(max=1e15), (high * t).clamp(max=1e15)
    late, grown = x >= 1.0, y >= 1.0
    x_small, x_large, y_small, y_large = x.clamp(max=1.0), x.clamp(min=1.0), y.clamp(max=1.0), y.clamp(min=1.0)
    log = (x_small.log() + GAMMA).where(grown, (low / high).log())
    early = x_small * _polynomial(SERIES, x_small) - log
    decay = -(y - x.where(late, 0.0)).clamp(max=600.0)
    first = (_polynomial(NUMERATOR, x_large) / _polynomial(DENOMINATOR, x_large)).where(late, early)
    second = decay.exp() * (_polynomial(NUMERATOR, y_large) / _polynomial(DENOMINATOR, y_large))
    return first - second.where(grown, y_small * _polynomial(SERIES, y_small)), decay.expm1()


def _scale_step(low: Tensor, start: Tensor, stop: Tensor) -> Tensor:
    """As `unknown_rate._scale_step`."""
    after = low * stop
    return (low * (stop - start)).where(low * start >= 1.0, after.where(after >= 1.0, 0.0))


def _death_density(base: Tensor, slow: Tensor, fast: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """As `unknown_rate._death_density`."""
    return base + slow * x.expm1() - fast * y.expm1()


def _odds_of_dying(
    low: Tensor, high: Tensor, start: Tensor, stop: Tensor, at_start: Tensor, at_stop: Tensor, decay: Tensor
) -> Tensor:
    """As `unknown_rate.odds_of_dying`."""
    gap = (stop - start).clamp(min=0.0)
    growth = _scale_step(low, start, stop).clamp(0.0, LOG_LARGEST).expm1()
    difference = growth * at_start + (at_start - at_stop)

    slow = (-low * stop).expm1().where(low * stop < 1.0, 0.0)
    middle, reach = (start + 0.5 * gap).clamp(min=TINY_TIME), NODE * gap
    x, y = (low * gap).clamp(max=0.5), (high * gap).clamp(max=0.5)
    left, right = (
        _death_density(slow - decay, 1.0 + slow, 1.0 + decay, share * x, share * y)
        for share in (0.5 + NODE, 0.5 - NODE)
    )
    mass = 0.5 * gap * (middle * (left + right) + reach * (left - right))
    short = mass / (at_stop * (middle * middle - reach * reach))
    return (difference / at_stop).where(difference > DIFFERENCE_TRUSTED * at_stop, short).clamp(max=LARGEST)
