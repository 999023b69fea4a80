"""Lifetimes by stretches of time: hazards that a user states, and masses, the form of nonparametric estimates.

Rates hold for stretches of time, repeated or not (Rosen 2016 section V-B); probability mass lies on points and
intervals (MATH.md section 6).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import ConfigError
from evermap.survival.base import Lifetime, LifetimePrior, Seed, check_positive, check_rates, check_times
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

    _integrated_hazard = integrated_hazard

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


@dataclass(frozen=True, slots=True)
class ScaledHazard(Lifetime):
    """`h(t) = factors[i] h0(t)` for `edges_s[i] <= t < edges_s[i + 1]`: what was stated, times what was learned.

    Attributes:
        prior: the lifetime of hazard `h0`.
        edges_s: starts of the stretches in seconds, the first 0, strictly increasing.
        factors: as many, positive.
    """

    prior: LifetimePrior
    edges_s: tuple[float, ...]
    factors: tuple[float, ...]

    def __post_init__(self) -> None:
        _make_floats(self, "edges_s", "factors")
        _check_edges(self.edges_s)
        if len(self.factors) != len(self.edges_s):
            raise ConfigError(
                f"{len(self.edges_s)} edges need as many factors, not {len(self.factors)}", field="factors"
            )
        for factor in self.factors:
            check_positive(factor, "factors")

    @property
    def p_never_leaves(self) -> float:
        for_ever, edge_s = self.prior.p_never_leaves, self.edges_s[-1]
        if for_ever == 0.0:
            return 0.0
        until = float(self._integrated_hazard(np.zeros(1), np.array([edge_s]))[0])
        after = max(float(self.prior.log_survival(edge_s)) - math.log(for_ever), 0.0)
        return math.exp(-until - self.factors[-1] * after)

    def mean(self) -> float:
        if self.p_never_leaves > 0.0:
            return math.inf
        reach_s = float(self.quantile(1.0 - 1e-13))
        log_s = np.linspace(math.log(reach_s) - 40.0, math.log(reach_s), 40_001)
        below, times = math.exp(log_s[0]), np.exp(log_s)
        alive = np.exp(self.log_survival(times)) * times
        step = log_s[1] - log_s[0]
        simpson = alive[0] + alive[-1] + 4.0 * alive[1:-1:2].sum() + 2.0 * alive[2:-1:2].sum()
        return below + float(step / 3.0 * simpson)

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        edges, factors = np.asarray(self.edges_s), np.asarray(self.factors)
        first, last = (np.searchsorted(edges, t, side="right") - 1 for t in (a, b))
        one, after = first == last, edges[np.minimum(first + 1, len(edges) - 1)]
        whole = factors[:-1] * (0.0 - np.asarray(self.prior.log_conditional_survival(edges[:-1], edges[1:])))
        whole = np.concatenate([[0.0], np.cumsum(whole)])  # up to the start of every stretch
        begun = factors[first] * self._of_prior(a, np.where(one, b, after))
        with np.errstate(invalid="ignore"):
            between = np.where(one, 0.0, whole[last] - whole[np.minimum(first + 1, len(edges) - 1)])
        ended = factors[last] * self._of_prior(np.where(one, b, edges[last]), b)
        total = begun + between + ended
        return np.asarray(np.where(np.isnan(total), np.inf, total))

    def _of_prior(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return 0.0 - np.asarray(self.prior.log_conditional_survival(a, b))

    def _log_integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        edges, log_factor = np.asarray(self.edges_s), np.log(self.factors)
        first, last = (np.searchsorted(edges, t, side="right") - 1 for t in (a, b))
        # Within one stretch the prior says it to the last digit, also where only the logarithm can be represented.
        death, survival = self.prior.log_conditional_death(a, b), self.prior.log_conditional_survival(a, b)
        tiny = np.asarray(log_factor[first] + np.where(death < -40.0, death, np.log(0.0 - survival)))
        return np.where(first == last, tiny, np.log(self._integrated_hazard(a, b)))

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        stretch = np.searchsorted(self.edges_s, t, side="right") - 1
        return np.asarray(np.log(self.prior.hazard(t)) + np.log(self.factors)[stretch])


def scale_hazard(prior: LifetimePrior, edges_s: Sequence[float], factors: Sequence[float]) -> LifetimePrior:
    """Return the lifetime whose hazard is that of a prior, times factors by age; steps of a hazard stay steps.

    Args:
        prior: the lifetime.
        edges_s: (K,) starts of the stretches, the first 0.
        factors: (K,) positive.
    """
    if all(factor == 1.0 for factor in factors):
        return prior
    if isinstance(prior, ScaledHazard):
        edges, both = _multiply_steps(prior.edges_s, prior.factors, edges_s, factors)
        return ScaledHazard(prior.prior, edges, both)
    if isinstance(prior, PiecewiseConstantHazard):
        return PiecewiseConstantHazard(*_multiply_steps(prior.edges_s, prior.rates, edges_s, factors))
    return ScaledHazard(prior, tuple(edges_s), tuple(factors))


def _multiply_steps(
    edges_s: Sequence[float], values: Sequence[float], other_s: Sequence[float], factors: Sequence[float]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the edges of two step functions, and their product."""
    edges = np.union1d(edges_s, other_s)
    one, other = (np.searchsorted(of, edges, side="right") - 1 for of in (edges_s, other_s))
    return tuple(edges.tolist()), tuple((np.asarray(values)[one] * np.asarray(factors)[other]).tolist())


def _check_edges(edges_s: tuple[float, ...]) -> None:
    """Raise a ConfigError unless stretches start at 0 and follow each other."""
    if len(edges_s) == 0 or edges_s[0] != 0.0:
        raise ConfigError("edges must start at 0", field="edges_s")
    for row, (left, right) in enumerate(itertools.pairwise(edges_s), start=1):
        if not (math.isfinite(right) and right > left):
            raise ConfigError(f"edges must be finite and increase strictly, row {row} is {right!r}", field="edges_s")


def _check_steps(prior: PiecewiseConstantHazard | PeriodicHazard) -> None:
    """Make edges and rates tuples of numbers; raise a ConfigError if they do not fit."""
    _make_floats(prior, "edges_s", "rates")
    _check_edges(prior.edges_s)
    if len(prior.rates) != len(prior.edges_s):
        raise ConfigError(f"{len(prior.edges_s)} edges need as many rates, not {len(prior.rates)}", field="rates")
    check_rates(prior.rates)


def _make_floats(prior: Lifetime, *names: str) -> None:
    for name in names:
        object.__setattr__(prior, name, tuple(float(value) for value in getattr(prior, name)))


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


_CHUNK = 1_000_000
"""Rows times steps that are computed at once, at most."""


@dataclass(frozen=True, slots=True)
class StepLifetime(Lifetime):
    """`P(starts_s[i] < T <= ends_s[i]) = masses[i]`, spread evenly; a point where start and end agree.

    An end of `inf` means that this mass never leaves, whatever its start. `S(t) = P(T > t)` has already dropped at a
    point of mass. Intervals may overlap and come in any order.

    Attributes:
        starts_s: in seconds, finite or not, none negative; points lie above 0.
        ends_s: in seconds, `>= starts_s`, possibly `inf`.
        masses: probabilities, none negative, of sum 1.
    """

    starts_s: tuple[float, ...]
    ends_s: tuple[float, ...]
    masses: tuple[float, ...]

    def __post_init__(self) -> None:
        _make_floats(self, "starts_s", "ends_s", "masses")
        if not len(self.starts_s) == len(self.ends_s) == len(self.masses) > 0:
            raise ConfigError("starts, ends and masses must be equally many, at least one", field="masses")
        for row, (start, end, mass) in enumerate(zip(self.starts_s, self.ends_s, self.masses, strict=True)):
            if not (0.0 <= start <= end and end > 0.0):
                raise ConfigError(
                    f"0 <= start <= end and end > 0 must hold, row {row} is ({start}, {end}]", field="ends_s"
                )
            if not (math.isfinite(mass) and mass >= 0.0):
                raise ConfigError(f"a mass must be finite and not negative, row {row} is {mass!r}", field="masses")
        if abs(math.fsum(self.masses) - 1.0) > 1e-9:
            raise ConfigError(f"masses must sum to 1, not {math.fsum(self.masses)!r}", field="masses")

    @classmethod
    def at_points(cls, times_s: Sequence[float], masses: Sequence[float]) -> Self:
        """Put all mass on points; `inf` is the point of what never leaves."""
        return cls(tuple(times_s), tuple(times_s), tuple(masses))

    @property
    def p_never_leaves(self) -> float:
        return math.fsum(mass for end, mass in zip(self.ends_s, self.masses, strict=True) if math.isinf(end))

    def mean(self) -> float:
        if self.p_never_leaves > 0.0:
            return math.inf
        rows = zip(self.starts_s, self.ends_s, self.masses, strict=True)
        return math.fsum(m * 0.5 * (s + e) for s, e, m in rows if m > 0.0)

    def sample(self, rng: Seed, size: int | tuple[int, ...] | None = None) -> FloatArray:
        generator = np.random.default_rng(rng)
        starts, ends, masses = np.array((self.starts_s, self.ends_s, self.masses))
        row = np.asarray(generator.choice(len(masses), size=size, p=masses / masses.sum()))
        share = 1.0 - np.asarray(generator.random(size))  # in (0, 1], as the intervals are
        finite = np.isfinite(ends)
        starts, widths = np.where(finite, starts, np.inf), np.where(finite, ends - np.where(finite, starts, 0.0), 0.0)
        return np.asarray(starts[row] + widths[row] * share)[()]

    def log_density(self, t: ArrayLike) -> FloatArray:
        values = check_times(t)
        with np.errstate(all="ignore"):
            return np.asarray(np.log(self._density(values)))[()]

    def _density(self, t: FloatArray) -> FloatArray:
        starts, ends, masses = np.array((self.starts_s, self.ends_s, self.masses))
        at = t[..., None]
        inside = (at >= starts) & (at < ends) & np.isfinite(ends)
        even = np.where(inside, masses / np.where(inside, ends - starts, 1.0), 0.0)
        return np.asarray(np.where((at == starts) & (at == ends) & (masses > 0.0), np.inf, even).sum(axis=-1))

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        survival = self._alive_and_dying(t, t)[0]
        return np.where(survival > 0.0, np.log(self._density(t) / survival), np.inf)

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        alive, dying = self._alive_and_dying(a, b)
        later = self._alive_and_dying(b, b)[0]
        died = dying / alive
        value = np.where(died < 0.5, -np.log1p(-died), np.log(alive) - np.log(later))
        value = np.where((alive > 0.0) & (later > 0.0), value, np.inf)
        return np.where(a == b, 0.0, value)

    def _alive_and_dying(self, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return `S(a)` and `P(a < T <= b)`, each as a sum of parts of the masses, so that nothing cancels."""
        starts, ends, masses = np.array((self.starts_s, self.ends_s, self.masses))
        starts = np.where(np.isfinite(ends), starts, np.inf)
        point = starts == ends
        width = np.where(point, 1.0, ends - starts)
        rows = max(1, _CHUNK // len(masses))
        alive, dying = np.empty(a.size), np.empty(a.size)
        for at in range(0, a.size, rows):
            x, y = a.reshape(-1, 1)[at : at + rows], b.reshape(-1, 1)[at : at + rows]
            left = np.where(point, x < ends, np.clip(ends - np.maximum(x, starts), 0.0, None) / width)
            within = np.clip(np.minimum(y, ends) - np.maximum(x, starts), 0.0, None) / width
            alive[at : at + rows] = left @ masses
            dying[at : at + rows] = np.where(point, (x < ends) & (ends <= y), within) @ masses
        return alive.reshape(a.shape), dying.reshape(a.shape)

    def _time_of_log_hazard(self, log_target: FloatArray) -> FloatArray:
        # A probability that equals a sum of masses up to its last digit belongs to that point, not to the next one.
        rough = Lifetime._time_of_log_hazard(self, log_target - 1e-13)
        corners = np.unique([t for t in (*self.starts_s, *self.ends_s) if math.isfinite(t)] or [0.0])
        nearest = corners[np.argmin(np.abs(rough[..., None] - corners), axis=-1)]
        # Bisection ends a few last digits away from a point of mass; the quantile is the point itself.
        return np.where(np.abs(rough - nearest) <= 1e-12 * nearest, nearest, rough)


def never_leaves() -> StepLifetime:
    """Return the prior of objects that never leave, such as walls."""
    return StepLifetime.at_points((math.inf,), (1.0,))
