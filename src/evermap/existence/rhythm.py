"""Daily and weekly rhythms: by what a hazard is multiplied at each local time of the week, and how that is learned.

Learning is penalised Poisson regression on a table of events and exposure. The logarithm of the rate is a smooth
function of age plus a smooth function of the time of the week; how smooth is learned with it (Wood and Fasiolo 2017,
the generalised Fellner-Schall update of the smoothing parameters, which climbs the marginal likelihood). A stay or an
absence is a sequence of survived moments, so its hazard is such a rate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from evermap.compiled import single_threaded
from evermap.errors import ConfigError
from evermap.show import Shown
from evermap.types import FloatArray, IntArray

DAY_S = 86400.0
WEEK_S = 7.0 * DAY_S
BIN_S = 600.0
"""A rhythm is constant for ten minutes at a time."""
BINS_OF_DAY = round(DAY_S / BIN_S)
BINS = 7 * BINS_OF_DAY
MONDAY_S = 4.0 * DAY_S
"""1970-01-05 was a Monday."""


@dataclass(frozen=True, slots=True)
class Rhythm(Shown):
    """A factor on a hazard for every ten minutes of the week, Monday 00:00 first.

    Stamps are seconds since 1970-01-01 as the clocks on the wall show them (`Clock.LOCAL_WALL`).

    Attributes:
        log_factor: (1008,) natural logarithm of the factor.

    Raises:
        ConfigError: another shape, or numbers that are not finite.
    """

    log_factor: FloatArray

    def __post_init__(self) -> None:
        if self.log_factor.shape != (BINS,) or not np.isfinite(self.log_factor).all():
            raise ConfigError(f"a rhythm is {BINS} finite numbers, one for every ten minutes of the week")

    @property
    def factor(self) -> FloatArray:
        """(1008,) by what the hazard is multiplied."""
        return np.asarray(np.exp(self.log_factor), dtype=np.float64)

    @property
    def hourly_factor(self) -> FloatArray:
        """(168,) the same, on average over each hour."""
        return np.asarray(self.factor.reshape(7 * 24, -1).mean(axis=1))

    def count_s(self, stamp_s: ArrayLike) -> FloatArray:
        """Return the integral (...) of the factor from a Monday 00:00 until stamps (...): a clock that runs as fast as
        things happen. What is not finite stays as it is.
        """
        stamps = np.asarray(stamp_s, dtype=np.float64)
        until = np.append(0.0, np.cumsum(BIN_S * self.factor))
        with np.errstate(invalid="ignore"):
            weeks, phase = np.divmod(stamps - MONDAY_S, WEEK_S)
            passed = weeks * until[-1] + np.interp(phase, BIN_S * np.arange(BINS + 1), until)
        return np.asarray(np.where(np.isfinite(stamps), passed, stamps))

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, for JSON."""
        return {"log_factor": [round(float(value), 5) for value in self.log_factor]}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Rhythm:
        """Return the model that `to_dict` wrote."""
        return cls(np.array(data["log_factor"], dtype=np.float64))


def bin_of_week(stamp_s: ArrayLike) -> IntArray:
    """Return which ten minutes of the week an instant lies in, 0 from Monday 00:00, stamps in local wall time."""
    phase = np.mod(np.asarray(stamp_s, dtype=np.float64) - MONDAY_S, WEEK_S)
    return np.minimum((phase / BIN_S).astype(np.int64), BINS - 1)


class DayShares(NamedTuple):
    """Shares of the days that do not follow their rhythm.

    Attributes:
        still: nothing changes: a holiday, a building that is closed.
        other: hazards are those of the mean day, at every time of it: a Saturday on which people work.
        timeless: hazards are their means over the week, day and night.
    """

    still: float
    other: float
    timeless: float


def day_shares(
    likelihood: FloatArray, importance: FloatArray, counted: FloatArray
) -> tuple[FloatArray, FloatArray, DayShares]:
    """Return the number of days of each kind, and the expected shares of future days.

    Days are a multinomial sample with the prior Dirichlet(1/2, ..): a kind that none of `n` days was of has the share
    `1/2 / (n + 2)`, the estimator of least regret in log loss (Krichevsky and Trofimov 1981). A day on which a kind
    would have looked like any other says nothing about its share. By EM, as each day's kind is uncertain.

    Args:
        likelihood: (D, K) of each day's looks on each kind of day, up to a factor of the day.
        importance: (D,) weight of each day.
        counted: (K,) numbers of earlier days of each kind.

    Returns:
        (K,) expected numbers of days, (D, K) probability of each kind of each day, and the shares.
    """
    share = np.append(1.0 - 3.0 * UNUSUAL, np.full(3, UNUSUAL))
    for _ in range(_DAY_ROUNDS):
        kind = share * likelihood
        kind /= kind.sum(axis=1, keepdims=True)
        total, before = counted + importance @ kind, share
        share = (total + 0.5) / (total.sum() + 0.5 * len(total))
        if np.abs(share - before).max() < _DAY_SETTLED:
            break
    return total, kind, DayShares(*map(float, share[1:]))


def on_other_days(factor: FloatArray) -> FloatArray:
    """Return (4, 2, 1008) factors on an ordinary day, and on those of `DayShares`.

    Args:
        factor: (2, 1008) factors on the hazards of absences and stays on an ordinary day.
    """
    other = np.tile(factor.reshape(2, 7, BINS_OF_DAY).mean(axis=1), 7)
    timeless = np.repeat(factor.mean(axis=1), BINS).reshape(2, BINS)
    return np.stack([factor, np.zeros_like(factor), other, timeless])


UNUSUAL = 0.01
"""Share of each unusual kind of day to begin with."""
_DAY_ROUNDS, _DAY_SETTLED = 500, 1e-6
HALF_AN_EVENT = 0.5
"""Added to every table where the exposure is, so that no rate is zero (Jeffreys' prior of a Poisson rate)."""
DAY_KNOTS = 72
DEVIATION_KNOTS = 12
WEAK = 1e-5
"""Precision of the prior of directions that no penalty reaches."""
_WEEKEND = 0.03
"""Precision of the prior of the weekend's log factor: a factor of e^6 is one standard deviation."""
_SMOOTHEST, _ROUGHEST = 1e6, 1e-4
_SETTLED = 0.01
"""Change of the effective number of parameters below which the smoothness is found."""
_MAX_ROUNDS = 60
_MAX_NEWTON = 25
_MAX_STEP = 4.0
_LOWEST, _HIGHEST = -60.0, 20.0


class Basis(NamedTuple):
    """Columns that a smooth function is made of, and what its roughness costs.

    Attributes:
        columns: (n, p) value of each column at each of n points.
        penalties: (p, p) matrices, each with a weight that is learned.
        fixed: (p, p) penalty that always holds.
    """

    columns: FloatArray
    penalties: tuple[FloatArray, ...]
    fixed: FloatArray


@dataclass(frozen=True, slots=True)
class SmoothRates(Shown):
    """Log rate at age `i` and time of the week `j`: `log_age[i] + log_week[j]`.

    Attributes:
        log_age: (I,) log of events per unit of exposure.
        log_week: (J,) log factor, of mean 0 over the events.
        freedom: effective number of parameters.
        coefficients: of the columns of both bases.
        weights: of the penalties.
    """

    log_age: FloatArray
    log_week: FloatArray
    freedom: float
    coefficients: FloatArray
    weights: FloatArray


def constant(n: int) -> Basis:
    """Return one level for all of n points."""
    return Basis(np.ones((n, 1)), (), np.zeros((1, 1)))


def age_basis(log_age: FloatArray, knots: int) -> Basis:
    """Return a cubic spline in the logarithm of age, its second differences penalised (Eilers and Marx 1996)."""
    low, high = float(log_age[0]), float(log_age[-1])
    columns = _spline(log_age, low, max(high - low, 1e-6) / knots, knots)
    difference = np.diff(np.eye(columns.shape[1]), 2, axis=0)
    return Basis(columns, (difference.T @ difference,), np.zeros((columns.shape[1],) * 2))


def week_basis(bins_of_day: int = BINS_OF_DAY, knots: int = DAY_KNOTS) -> Basis:
    """Return a daily curve shared by all days, a weekend, and a level and a smoother curve of each day of the week."""
    time = (np.arange(bins_of_day) + 0.5) / bins_of_day
    shared, own = cyclic_spline(time, knots), cyclic_spline(time, DEVIATION_KNOTS)
    weekend = np.repeat(np.arange(7) >= 5, bins_of_day)[:, None].astype(np.float64)
    levels = np.repeat(np.eye(7), bins_of_day, axis=0)
    columns = np.hstack([np.tile(shared, (7, 1)), weekend, levels, np.kron(np.eye(7), own)])
    starts = np.cumsum([0, knots, 1, 7])
    size = columns.shape[1]

    rough = _cyclic_difference(DEVIATION_KNOTS) + 0.05 * np.eye(DEVIATION_KNOTS)
    penalties = (
        _pad_matrix(_cyclic_difference(knots), int(starts[0]), size),
        _pad_matrix(np.eye(7), int(starts[2]), size),
        _pad_matrix(np.asarray(np.kron(np.eye(7), rough), dtype=np.float64), int(starts[3]), size),
    )
    return Basis(columns, penalties, _pad_matrix(np.array([[_WEEKEND]]), int(starts[1]), size))


def steady_level(n: int) -> Basis:
    """Return a level for each of n periods, a random walk whose steps are as small as the events allow."""
    difference = np.diff(np.eye(n), axis=0)
    return Basis(np.eye(n), (difference.T @ difference,) if n > 1 else (), np.zeros((n, n)))


@single_threaded()
def fit(
    events: FloatArray, exposure: FloatArray, age: Basis, week: Basis | None, start: SmoothRates | None = None
) -> SmoothRates:
    """Return log rates of greatest penalised likelihood, the penalties' weights by marginal likelihood.

    Args:
        events: (I, J) expected numbers of events by age and time of the week.
        exposure: (I, J) time spent there.
        age: basis of the I ages.
        week: basis of the J times of the week; None where there is no rhythm (then J may be 1).
        start: where to begin: an earlier fit of the same bases.
    """
    total = exposure.sum()
    if total <= 0.0:
        none = np.zeros(0)
        return SmoothRates(np.full(len(exposure), _LOWEST), np.zeros(exposure.shape[1]), 0.0, none, none)
    counted = events + HALF_AN_EVENT * exposure / total
    columns_week = week.columns if week else np.zeros((exposure.shape[1], 0))
    p, q = age.columns.shape[1], columns_week.shape[1]
    penalties = [_pad_matrix(penalty, 0, p + q) for penalty in age.penalties]
    fixed = WEAK * np.eye(p + q) + _pad_matrix(age.fixed, 0, p + q)
    if week:
        penalties += [_pad_matrix(penalty, p, p + q) for penalty in week.penalties]
        fixed += _pad_matrix(week.fixed, p, p + q)
    weights = np.ones(len(penalties))
    beta = np.concatenate([np.full(p, np.log(counted.sum() / total)), np.zeros(q)])
    if start is not None and len(start.coefficients) == p + q:
        beta, weights = start.coefficients, start.weights

    def maximise(beta: FloatArray, penalty: FloatArray) -> tuple[FloatArray, FloatArray]:
        return _newton(beta, counted, exposure, age.columns, columns_week, penalty)

    beta, weights, freedom = find_smoothness(maximise, beta, weights, penalties, fixed)
    log_age, log_week = age.columns @ beta[:p], columns_week @ beta[p:]
    level = float(counted.sum(0) @ log_week / counted.sum())
    return SmoothRates(log_age + level, log_week - level, freedom, beta, weights)


def find_smoothness(
    maximise: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]],
    beta: FloatArray,
    weights: FloatArray,
    penalties: Sequence[FloatArray],
    fixed: FloatArray,
) -> tuple[FloatArray, FloatArray, float]:
    """Return coefficients (P,), weights (M,) of the penalties of largest marginal likelihood, and the effective number
    of parameters.

    Args:
        maximise: takes coefficients to begin with and a penalty (P, P), and returns the most probable ones and their
            covariance (P, P).
        beta: coefficients to begin with.
        weights: of the penalties, to begin with.
        penalties: M matrices (P, P).
        fixed: (P, P) penalty that always holds.
    """
    freedom = 0.0
    for _ in range(_MAX_ROUNDS):
        penalty = weigh_penalties(weights, penalties, fixed)
        beta, covariance = maximise(beta, penalty)
        prior = np.linalg.inv(penalty)
        updated = np.array(
            [
                w * max(float(np.sum(prior * m) - np.sum(covariance * m)), 1e-3) / max(float(beta @ m @ beta), 1e-8)
                for w, m in zip(weights, penalties, strict=True)
            ]
        )
        weights = np.clip(updated, _ROUGHEST, _SMOOTHEST)
        before, freedom = freedom, len(beta) - float(np.sum(covariance * penalty))
        if abs(freedom - before) < _SETTLED:
            break
    return beta, weights, freedom


def weigh_penalties(weights: FloatArray, penalties: Sequence[FloatArray], fixed: FloatArray) -> FloatArray:
    """Return the sum (P, P) of weighted penalties (P, P) and of the one that always holds."""
    return np.asarray(fixed + sum((w * m for w, m in zip(weights, penalties, strict=True)), np.zeros_like(fixed)))


def _newton(
    beta: FloatArray, events: FloatArray, exposure: FloatArray, a: FloatArray, w: FloatArray, penalty: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Maximum of the penalised likelihood by damped Newton steps, and the covariance there."""
    p = a.shape[1]
    gradient_events = np.concatenate([a.T @ events.sum(1), w.T @ events.sum(0)])
    information = penalty
    for _ in range(_MAX_NEWTON):
        log_rate = (a @ beta[:p])[:, None] + (w @ beta[p:])[None, :]
        expected = exposure * np.exp(np.clip(log_rate, _LOWEST, _HIGHEST))
        rows, columns = expected.sum(1), expected.sum(0)
        gradient = gradient_events - np.concatenate([a.T @ rows, w.T @ columns]) - penalty @ beta
        cross = a.T @ expected @ w
        information = np.block([[(a.T * rows) @ a, cross], [cross.T, (w.T * columns) @ w]]) + penalty
        step = np.linalg.solve(information, gradient)
        largest = float(np.abs(step).max())
        beta = beta + step * min(1.0, _MAX_STEP / max(largest, 1e-300))
        if largest < 1e-5:
            break
    return beta, np.asarray(np.linalg.inv(information), dtype=np.float64)


def _pad_matrix(matrix: FloatArray, start: int, size: int) -> FloatArray:
    """`matrix` on the diagonal of a larger matrix of zeros."""
    whole = np.zeros((size, size))
    whole[start : start + len(matrix), start : start + len(matrix)] = matrix
    return whole


def _spline(points: FloatArray, low: float, spacing: float, knots: int) -> FloatArray:
    """Cubic B-splines on equally spaced knots."""
    from scipy.interpolate import BSpline

    places = low + spacing * np.arange(-3, knots + 4)
    inside = np.clip(points, low, low + spacing * knots * (1.0 - 1e-12))
    return np.asarray(BSpline.design_matrix(inside, places, 3).toarray(), dtype=np.float64)


def cyclic_spline(points: FloatArray, knots: int) -> FloatArray:
    """Cubic B-splines on the unit circle."""
    columns = _spline(points, 0.0, 1.0 / knots, knots)
    columns[:, :3] += columns[:, knots:]
    return columns[:, :knots]


def _cyclic_difference(n: int) -> FloatArray:
    """Sum of squared second differences around a circle of n coefficients."""
    difference = np.eye(n) - 2.0 * np.roll(np.eye(n), 1, axis=1) + np.roll(np.eye(n), 2, axis=1)
    return np.asarray(difference.T @ difference)
