"""Hazards that the user states (Rosen 2016 section V-B): rates of stretches of time, repeated or not, or a function."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from evermap.errors import ConfigError
from evermap.survival.base import Lifetime, check_edges, check_positive, check_rates, check_times
from evermap.survival.logmath import gauss_legendre
from evermap.types import FloatArray

_HOUR_S, _DAY_S = 3600.0, 86400.0
_NODES = 16
_PANELS_PER_DECADE = 8
_MOST_PANELS = 50_000
_TOLERANCE = 1e-12
_FIRST_PANEL = 1e-9
"""End of the first panel: in seconds, or as a share of the horizon if that is less."""
_NEAR_ZERO = 1e-20
"""Width, relative to the first panel, of a panel from 0 that is not halved again (powers of t never converge)."""
_NEGLIGIBLE = 1e-9
"""Largest share of the first panel's integral that such a panel may hold."""
_JUMP_WIDTH = 1e-13
"""Relative width at which a panel that still does not converge is taken to hold a jump."""


@dataclass(frozen=True, slots=True)
class PiecewiseConstantHazard(Lifetime):
    """`h(t) = rates[i]` for `edges_s[i] <= t < edges_s[i + 1]`; the last rate holds for ever.

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


@dataclass(frozen=True, slots=True)
class CallableHazard(Lifetime):
    """`h(t) = function(t)` up to `horizon_s`, and the constant `rate_after` from then on.

    The hazard is integrated once, by Gauss-Legendre quadrature on panels that grow with t and are halved until the
    integral of each is known to a relative 1e-12. Jumps are found by halving; a peak that is much narrower than a
    tenth of its own time may be missed: name its ends in `breaks_s`.

    Attributes:
        function: hazard in 1/s for an array of seconds (or one value for all), none negative, finite near 0.
        horizon_s: the function is evaluated up to here, in seconds, positive.
        rate_after: hazard beyond, in 1/s; None for the function's value at the horizon. 0: the rest never leave.
        breaks_s: times at which the function jumps or kinks, in any order.
    """

    function: Callable[[FloatArray], FloatArray | float]
    horizon_s: float
    rate_after: float | None = None
    breaks_s: tuple[float, ...] = ()
    _edges: FloatArray = field(init=False, repr=False, compare=False)
    _before: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_positive(self.horizon_s, "horizon_s")
        check_times(self.breaks_s, "breaks_s")
        if self.rate_after is None:
            object.__setattr__(self, "rate_after", float(self._evaluate(np.array([self.horizon_s]))[0]))
        check_rates((self._rate_after,), "rate_after")
        edges, integrals = self._refine(self._first_edges())
        object.__setattr__(self, "_edges", edges)
        # Differences of this running sum are taken later: its extra digits are what they keep.
        running = np.concatenate(([0.0], np.cumsum(integrals.astype(np.longdouble))))
        object.__setattr__(self, "_before", running)

    @property
    def p_never_leaves(self) -> float:
        return math.exp(-float(self._before[-1])) if self._rate_after == 0.0 else 0.0

    def mean(self) -> float:
        survival = math.exp(-float(self._before[-1]))
        if survival > 0.0 and self._rate_after == 0.0:
            return math.inf
        nodes, weights = gauss_legendre(24)
        left, width = self._edges[:-1], np.diff(self._edges)
        t = left[:, None] + width[:, None] * nodes
        within = float(np.sum(width * (np.exp(-self._integrated_hazard(np.zeros_like(t), t)) @ weights)))
        return within + (survival / self._rate_after if survival > 0.0 else 0.0)

    @property
    def _rate_after(self) -> float:
        return math.nan if self.rate_after is None else self.rate_after

    def _evaluate(self, t: FloatArray) -> FloatArray:
        """Evaluate the user's function on an array, and check its values."""
        values = np.asarray(self.function(t), dtype=np.float64)
        if values.shape not in {(), t.shape}:
            raise ConfigError(
                f"gives shape {values.shape} for times of shape {t.shape}",
                field="hazard",
                hint="numpy.vectorize(function)",
            )
        values = np.broadcast_to(values, t.shape)
        good = np.isfinite(values) & (values >= 0.0)
        if not good.all():
            where = tuple(np.argwhere(~good)[0])
            raise ConfigError(
                f"a hazard must be finite and not negative: h({float(t[where])!r}) = {float(values[where])!r}",
                field="hazard",
            )
        return values

    def _first_edges(self) -> FloatArray:
        first = _FIRST_PANEL * min(1.0, self.horizon_s)
        count = math.ceil(_PANELS_PER_DECADE * math.log10(self.horizon_s / first)) + 1
        inner = [t for t in self.breaks_s if 0.0 < t < self.horizon_s]
        return np.unique(
            np.concatenate(([0.0], np.geomspace(first, self.horizon_s, count)[:-1], inner, [self.horizon_s]))
        )

    def _refine(self, edges: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Halve panels until each integral equals that of its halves; return edges (P + 1,) and integrals (P,)."""
        open_left, open_right = edges[:-1], edges[1:]
        done_left: list[FloatArray] = []
        done_integral: list[FloatArray] = []
        panels = 0
        for _ in range(100):
            middle = 0.5 * (open_left + open_right)
            halves = self._quadrature(open_left, middle) + self._quadrature(middle, open_right)
            error = np.abs(self._quadrature(open_left, open_right) - halves)
            width = open_right - open_left
            smallest = (open_left == 0.0) & (width <= _NEAR_ZERO * edges[1])
            good = (error <= _TOLERANCE * halves) | (width <= _JUMP_WIDTH * open_right) | smallest
            done_left.append(open_left[good])
            done_integral.append(halves[good])
            panels += int(good.sum())
            if good.all():
                left = np.concatenate(done_left)
                order = np.argsort(left)
                refined, integral = np.append(left[order], self.horizon_s), np.concatenate(done_integral)[order]
                if smallest.any() and integral[0] > _NEGLIGIBLE * integral[refined[:-1] < edges[1]].sum():
                    break  # like 1/t: the integral diverges at 0
                return refined, integral
            bad = ~good
            open_left, open_right = (
                np.concatenate((open_left[bad], middle[bad])),
                np.concatenate((middle[bad], open_right[bad])),
            )
            if panels + len(open_left) > _MOST_PANELS:
                break
        raise ConfigError(
            f"its integral does not converge near t = {float(open_right[0])!r} s",
            field="hazard",
            hint="a shorter horizon, a hazard that is finite near 0, or PeriodicHazard for one that repeats",
        )

    def _quadrature(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Integrate the hazard over intervals that lie within one panel each."""
        nodes, weights = gauss_legendre(_NODES)
        width = b - a
        return np.asarray(width * (self._evaluate(a[..., None] + width[..., None] * nodes) @ weights))

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        x, y = np.minimum(a, self.horizon_s), np.minimum(b, self.horizon_s)
        last = len(self._edges) - 2
        in_x = np.clip(np.searchsorted(self._edges, x, side="right") - 1, 0, last)
        in_y = np.clip(np.searchsorted(self._edges, y, side="right") - 1, 0, last)
        same = in_x == in_y
        head = self._quadrature(x, np.where(same, y, self._edges[in_x + 1]))
        between = (self._before[in_y] - self._before[np.minimum(in_x + 1, in_y)]).astype(np.float64)
        tail = self._quadrature(np.where(same, y, self._edges[in_y]), y)
        beyond = self._rate_after * (np.maximum(b, self.horizon_s) - np.maximum(a, self.horizon_s))
        return np.asarray(head + between + tail + beyond)

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        inside = self._evaluate(np.minimum(t, self.horizon_s))
        return np.asarray(np.log(np.where(t < self.horizon_s, inside, self._rate_after)))


def gone_daily(probability: float, *, first_seen_hour: float, hours: tuple[float, float]) -> PeriodicHazard:
    """Return the hazard of things that leave within some hours of the day only, as parked cars do by night.

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
