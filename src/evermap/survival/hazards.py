"""Hazards that the user states (Rosen 2016 section V-B): rates of stretches of time, repeated or not."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evermap.errors import ConfigError
from evermap.survival.base import Lifetime, check_edges, check_positive, check_rates
from evermap.types import FloatArray

_HOUR_S, _DAY_S = 3600.0, 86400.0


@dataclass(frozen=True, slots=True)
class PiecewiseConstantHazard(Lifetime):
    """`h(t) = rates[i]` for `edges_s[i] <= t < edges_s[i + 1]`; the last rate is unbounded in time.

    A last rate of 0 means that features still there by then never leave.

    Attributes:
        edges_s: starts of the stretches in seconds, the first 0, strictly increasing.
        rates: hazards in 1/s, as many, none negative.
    """

    edges_s: tuple[float, ...]
    rates: tuple[float, ...]

    def __post_init__(self) -> None:
        _check_steps(self)

    @property
    def p_never_leaves(self) -> float:
        if self.rates[-1] > 0.0:
            return 0.0
        return math.exp(-math.fsum(np.diff(self.edges_s) * self.rates[:-1]))

    def mean(self) -> float:
        lasts = np.append(np.diff(self.edges_s), np.inf)
        return mean_of_stretches(lasts, np.asarray(self.rates))[0]

    def integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Return `int_a^b h` for arrays of one shape with `a <= b`, unchecked."""
        return integrate_steps(np.append(self.edges_s, np.inf), np.asarray(self.rates), a, b)

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return self.integrated_hazard(a, b)

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        stretch = np.searchsorted(self.edges_s, t, side="right") - 1
        return np.asarray(np.log(np.asarray(self.rates)[stretch]))


@dataclass(frozen=True, slots=True)
class PeriodicHazard(Lifetime):
    """`h(t) = rates[i]` while `(start_s + t) mod period_s` lies in stretch `i` (Rosen 2016 Fig. 2, blue).

    Attributes:
        period_s: length of the period in seconds, positive.
        edges_s: starts of the stretches within the period, the first 0, strictly increasing, below `period_s`.
        rates: hazards in 1/s, as many, none negative.
        start_s: where in the period the feature was first seen, in [0, period_s).
    """

    period_s: float
    edges_s: tuple[float, ...]
    rates: tuple[float, ...]
    start_s: float = 0.0

    def __post_init__(self) -> None:
        _check_steps(self)
        check_positive(self.period_s, "period_s")
        if self.edges_s[-1] >= self.period_s:
            raise ConfigError(f"edges must lie below the period, not at {self.edges_s[-1]!r}", field="edges_s")
        if not 0.0 <= self.start_s < self.period_s:
            raise ConfigError(f"must lie in [0, {self.period_s!r}), not {self.start_s!r}", field="start_s")

    @property
    def p_never_leaves(self) -> float:
        return 0.0 if any(rate > 0.0 for rate in self.rates) else 1.0

    def mean(self) -> float:
        if self.p_never_leaves > 0.0:
            return math.inf
        edges, rates = self._pattern()
        one_period, survival = mean_of_stretches(np.diff(edges), rates)
        return one_period / -math.expm1(math.log(survival)) if survival > 0.0 else one_period

    def _pattern(self) -> tuple[FloatArray, FloatArray]:
        """Return edges from 0 to the period and rates, rotated to begin at `start_s`.

        An offset added to times of any size would cost their last digits; the remainder by the period is exact.
        """
        edges, rates = np.append(self.edges_s, self.period_s), np.asarray(self.rates)
        if self.start_s == 0.0:
            return edges, rates
        first = int(np.searchsorted(edges, self.start_s, side="right")) - 1
        after, before = edges[first + 1 :] - self.start_s, edges[1 : first + 1] + (self.period_s - self.start_s)
        turned = np.concatenate(([0.0], after, before, [self.period_s]))
        return turned, np.concatenate((rates[first:], rates[: first + 1]))

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        edges, rates = self._pattern()
        in_a, in_b = np.fmod(a, self.period_s), np.fmod(b, self.period_s)
        turns = np.rint((b - in_b) / self.period_s) - np.rint((a - in_a) / self.period_s)
        nothing, whole = np.zeros_like(in_a), np.full_like(in_a, self.period_s)
        per_turn = integrate_steps(edges, rates, nothing, whole)
        within = integrate_steps(edges, rates, in_a, np.where(turns > 0, whole, in_b))
        return within + np.where(
            turns > 0, (turns - 1.0) * per_turn + integrate_steps(edges, rates, nothing, in_b), 0.0
        )

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        edges, rates = self._pattern()
        stretch = np.searchsorted(edges, np.fmod(t, self.period_s), side="right") - 1
        return np.asarray(np.log(rates[np.minimum(stretch, len(rates) - 1)]))


def _check_steps(prior: PiecewiseConstantHazard | PeriodicHazard) -> None:
    """Make edges and rates tuples of numbers; raise a ConfigError if they do not fit."""
    for name in ("edges_s", "rates"):
        object.__setattr__(prior, name, tuple(float(value) for value in getattr(prior, name)))
    check_edges(prior.edges_s)
    if len(prior.rates) != len(prior.edges_s):
        raise ConfigError(f"{len(prior.edges_s)} edges need as many rates, not {len(prior.rates)}", field="rates")
    check_rates(prior.rates)


def gone_daily(probability: float, *, first_seen_hour: float, hours: tuple[float, float]) -> PeriodicHazard:
    """Return the hazard of objects that leave within some hours of the day only, as parked cars at night.

    Args:
        probability: of leaving in these hours of one day, above 0 and below 1.
        first_seen_hour: local time of day at t = 0, in hours, in [0, 24).
        hours: begin and end in hours of local time, in [0, 24), of the hours; they may pass midnight.

    Raises:
        ConfigError: numbers out of range, or hours that begin when they end.
    """
    if not 0.0 < probability < 1.0:
        raise ConfigError(f"must lie above 0 and below 1, not {probability!r}", field="probability")
    begin, end = hours
    for hour, argument in ((begin, "hours"), (end, "hours"), (first_seen_hour, "first_seen_hour")):
        if not 0.0 <= hour < 24.0:
            raise ConfigError(f"an hour of the day must lie in [0, 24), not {hour!r}", field=argument)
    if begin == end:
        raise ConfigError(f"begin and end must differ, not both {begin!r}", field="hours")
    length_s = ((end - begin) % 24.0) * _HOUR_S
    rate = -math.log1p(-probability) / length_s
    # The period starts with the stretch, so that midnight is no special case.
    start_s = ((first_seen_hour - begin) % 24.0) * _HOUR_S
    return PeriodicHazard(_DAY_S, (0.0, length_s), (rate, 0.0), start_s=start_s)


def integrate_steps(edges: FloatArray, rates: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return `int_a^b h` for a step function with `len(rates) + 1` edges; in neighbouring steps nothing cancels.

    It is the sum of two ends and the whole steps between them; only these are a difference, of sums of whole steps.
    """
    first = np.clip(np.searchsorted(edges, a, side="right") - 1, 0, len(rates) - 1)
    last = np.clip(np.searchsorted(edges, b, side="right") - 1, 0, len(rates) - 1)
    whole = np.concatenate([[0.0], np.cumsum(rates[:-1] * np.diff(edges[:-1]))])  # up to the start of every step
    within = rates[first] * (b - a)
    with np.errstate(invalid="ignore"):  # the last step has no end and no successor
        begun = rates[first] * (edges[first + 1] - a)
    between = whole[last] - whole[np.minimum(first + 1, len(rates) - 1)]
    across = begun + between + rates[last] * (b - edges[last])
    return np.asarray(np.where(first == last, within, across))


def mean_of_stretches(lasts: FloatArray, rates: FloatArray) -> tuple[float, float]:
    """Return `int S dt` over consecutive stretches of given lengths, and `S` after the last of them."""
    total, survival = 0.0, 1.0
    for length, rate in zip(lasts, rates, strict=True):
        if survival == 0.0:
            break
        total += survival * (float(length) if rate == 0.0 else -math.expm1(-rate * length) / float(rate))
        survival *= 1.0 if rate == 0.0 else math.exp(-rate * length)
    return total, survival
