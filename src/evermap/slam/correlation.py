"""Errors that last: what each detection is worth beside others of its landmark that err alike.

Residuals of one landmark differ by more the more time is between them: at once by white noise, to a limit by errors
that persist for a while (a view, a pole's side, the light). White and persistent parts are fitted to half the mean
squared difference of residuals by their lag (a variogram, Matheron 1963), which a wrong position of the landmark, or
whatever else is the same for all of its residuals, does not change.

Of detections whose errors have the correlations `a_mn`, each counts as `1 / sum_n a_mn` of an independent one: for the
mean of a stationary sequence that is what its information comes to, `n (1 - a) / (1 + a)` of the first-order
autoregressive one.

What correlated errors make of the variance of an estimate shows in clusters: what each stretch of a recording adds to
the estimate is summed before it is squared (`Pull`), which makes no assumption on how errors hang together within it:
White's covariance (1980), with stretches as clusters (Liang and Zeger 1986).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from evermap.compiled import kept
from evermap.estimate.graph import AlikeFactors
from evermap.types import BoolArray, FloatArray, IntArray

kernel = kept(effort=1, error_model="numpy")

PERSIST_S = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""Correlation times of detection errors that are tried together; none that is longer than the recording."""
BINS, FEWEST_BINS, FEWEST_PAIRS = 14, 4, 30
MOST_LAGS = 50.0
"""Lags that follow one another in a recording vary independently, but shorter ones are no better known than so many."""
ROUNDS_OF_FIT, LEAST_OF_SQUARE = 6, 0.1
PERSISTS = 2.0
"""Nats a curve by which errors that persist must explain all curves better than white ones: of two numbers more for
each of them (Akaike 1974)."""
MOST_SWAPS = 1000
"""Steps of least squares of numbers that aren't negative: three for each, as is the default, aren't always enough."""
LEAST_WEIGHT = 0.5
"""Inlier probability from which a residual counts."""


class Curve(NamedTuple):
    """Mean or median squares (K,) of differences, for one axis, by their lags [s], and half the degrees of freedom."""

    lag_s: FloatArray
    square: FloatArray
    worth: FloatArray


class Lasting(NamedTuple):
    """How long errors last.

    Attributes:
        persist_s: (T,) correlation times.
        share: (T,) of the variance that has each; the rest is white.
    """

    persist_s: FloatArray
    share: FloatArray

    @property
    def any(self) -> bool:
        """Return whether some last."""
        return bool(self.share.any())

    def correlation(self, stamp_s: FloatArray) -> FloatArray:
        """Return (K, K) correlations of the errors of sightings of one landmark at stamps (K,)."""
        lag_s = np.abs(stamp_s[:, None] - stamp_s)
        found = sum(share * np.exp(-lag_s / each_s) for each_s, share in zip(self.persist_s, self.share, strict=True))
        return np.where(np.eye(len(stamp_s), dtype=np.bool_), 1.0, found)

    def information(self, stamp_s: FloatArray, place: IntArray) -> FloatArray:
        """Return (M,) shares of the information of detections of places (M,) at (M,) stamps, sorted by time."""
        if not self.any:
            return np.ones(len(place))
        one = np.ones((len(place), 1))
        before, after = (
            carry(one, np.ascontiguousarray(each_s), np.ascontiguousarray(each), self.persist_s, self.share)[:, 0]
            for each_s, each in ((stamp_s, place), (-stamp_s[::-1], place[::-1]))
        )
        return np.asarray(1.0 / (1.0 + before + after[::-1]))

    def variance_beside(self, influence: FloatArray, stamp_s: FloatArray, place: IntArray) -> FloatArray:
        """Return (S,) variances of linear estimates that correlation adds, beside those of independent errors.

        Args:
            influence: (M, D, S) of each whitened component on them.
            stamp_s: (M,) of the detections, sorted.
            place: (M,) what was seen.
        """
        if not self.any:
            return np.zeros(influence.shape[2])
        flat = np.ascontiguousarray(influence.reshape(len(place), -1))
        place = np.ascontiguousarray(place)
        both = 2.0 * (flat * carry(flat, stamp_s, place, self.persist_s, self.share)).sum(axis=0)
        return np.asarray(both.reshape(influence.shape[1:]).sum(axis=0))


class Pull(NamedTuple):
    """What factors of one kind contribute to linear estimates of some numbers.

    Attributes:
        pose: (K,) the pose that each belongs to.
        influence: (K, D, S) of each whitened residual on the numbers; zeros behind those of factors with fewer rows.
        by: (K, S) by what they move the numbers: residuals times their influence.
    """

    pose: IntArray
    influence: FloatArray
    by: FloatArray

    @classmethod
    def of(cls, alike: Sequence[AlikeFactors], pose: IntArray, values: FloatArray, covariance: FloatArray) -> Pull:
        """Return that of a block of factors.

        Args:
            alike: the factors.
            pose: (K,) the pose that each belongs to.
            values: whitened Jacobians and right sides of all factors.
            covariance: (numbers, S) of all variables with the numbers that are estimated.
        """
        most, width = max((one.rows for one in alike), default=0), covariance.shape[1]
        influence, by = np.zeros((len(pose), most, width)), np.zeros((len(pose), width))
        for one in alike:
            own = one.multiply(values, covariance)
            influence[one.factor, : own.shape[1]] = own
            by[one.factor] = np.einsum("krs,kr->ks", own, values[one.right])
        return cls(pose, influence, by)

    @property
    def variance(self) -> FloatArray:
        """(S,) variances that the factors add if all residuals are independent."""
        return np.asarray((self.influence**2).sum(axis=(0, 1)))


def sum_by_stretches(pulls: Sequence[Pull], stretch: IntArray, count: int) -> FloatArray:
    """Return (count, S) what each stretch of a recording moves estimates by; `stretch` (N,) is that of each pose."""
    total = np.zeros((count, pulls[0].by.shape[1]))
    for pull in pulls:
        np.add.at(total, stretch[pull.pose], pull.by)
    return total


def variance_of_clusters(pull: FloatArray, count: float | None = None) -> FloatArray:
    """Return (S,) variances of estimates by what each of some clusters pulls them (K, S).

    `count` is how many there are; None: as many as pull at all.
    """
    if count is None:
        count = max(float(np.count_nonzero(pull.any(axis=1))), 2.0)
    return np.asarray((pull**2).sum(axis=0) * count / (count - 1.0))


@kernel
def carry(value: FloatArray, stamp_s: FloatArray, place: Any, persist_s: FloatArray, share: FloatArray) -> FloatArray:
    """Return (M, S) sums of values (M, S) of the same place before, each by its correlation with the present one."""
    count = 0
    for m in range(len(place)):
        count = max(count, place[m] + 1)
    kinds, width = len(persist_s), value.shape[1]
    total, last = np.zeros((count, kinds, width)), np.full(count, np.nan)
    found = np.zeros(value.shape)
    for m in range(len(place)):
        j = place[m]
        for k in range(kinds):
            kept = math.exp(-(stamp_s[m] - last[j]) / persist_s[k]) if last[j] == last[j] else 0.0
            for a in range(width):
                total[j, k, a] *= kept
                found[m, a] += share[k] * total[j, k, a]
                total[j, k, a] += value[m, a]
        last[j] = stamp_s[m]
    return found


def lasting_errors(residual: FloatArray, weight: FloatArray, stamp_s: FloatArray, place: IntArray) -> Lasting:
    """Return how long errors last, by the residuals of all landmarks together.

    Args:
        residual: (M, D) whitened; nan where a detection has fewer components.
        weight: (M,) inlier probabilities.
        stamp_s: (M,) of the detections, sorted.
        place: (M,) what was seen.
    """
    persist_s = np.array(
        [each for each in PERSIST_S if each <= max(float(np.ptp(stamp_s)) if len(stamp_s) else 0.0, PERSIST_S[0])]
    )
    none = Lasting(persist_s, np.zeros(len(persist_s)))
    curve = _pool_differences(residual, weight > LEAST_WEIGHT, stamp_s, place)
    if len(curve.lag_s) < FEWEST_BINS:
        return none
    white, (parts, log_likelihood) = fit_curve(curve, [], 0.0)[1], fit_curve(curve, persist_s.tolist(), 0.0)
    if log_likelihood - white < PERSISTS:
        return none
    return Lasting(persist_s, parts[1:] / max(float(parts.sum()), 1e-12))


def _pool_differences(residual: FloatArray, used: BoolArray, stamp_s: FloatArray, place: IntArray) -> Curve:
    """Half of the mean squares of differences, a component, over pairs of residuals of one landmark."""
    rows = np.flatnonzero(used)
    rows = rows[np.argsort(place[rows], kind="stable")]
    lags, squares = [], []
    apart = 1
    while apart < len(rows):  # of all pairs those 1, 2, 3, 4, 6, 8, 12, ... sightings apart
        one, other = rows[:-apart], rows[apart:]
        same = place[one] == place[other]
        one, other = one[same], other[same]
        if not len(one):
            break
        lags.append(stamp_s[other] - stamp_s[one])
        squares.append(_mean_square(residual[other] - residual[one]))
        apart += max(1, apart // 2)
    if not lags:
        return Curve(*np.zeros((3, 0)))
    lag_s, square = np.concatenate(lags), 0.5 * np.concatenate(squares)
    lag_s, square = lag_s[lag_s > 0.0], square[lag_s > 0.0]
    if len(lag_s) < FEWEST_PAIRS:
        return Curve(*np.zeros((3, 0)))
    edges = np.geomspace(lag_s.min(), lag_s.max() * (1.0 + 1e-9), BINS)
    row = np.digitize(lag_s, edges)
    count = np.bincount(row, minlength=BINS)
    bins = [k for k in range(1, BINS) if count[k] >= FEWEST_PAIRS]
    order, last = np.argsort(row.astype(np.int16), kind="stable"), np.cumsum(count)
    lag_s, square = lag_s[order], square[order]
    lag = np.array([np.median(lag_s[last[k] - count[k] : last[k]]) for k in bins])
    mean = np.array([square[last[k] - count[k] : last[k]].mean() for k in bins])
    # pairs that overlap in time say the same: so many differ, of all landmarks
    first, last = np.full((2, place.max() + 1), np.inf)
    np.minimum.at(first, place[rows], stamp_s[rows])
    np.minimum.at(last, place[rows], -stamp_s[rows])
    span = np.where(np.isfinite(first), -last - first, 0.0)
    worth = np.array([np.clip(span[span >= each] / each, 1.0, MOST_LAGS).sum() for each in lag])
    return Curve(
        lag, np.maximum(mean, 1e-12), 0.5 * residual.shape[1] * np.maximum(np.minimum(worth, count[bins]), 1.0)
    )


def _mean_square(difference: FloatArray) -> FloatArray:
    """Return (K,) means of squares (K, D), a few, of those that are no nan: `np.nanmean` in a third of the time."""
    square = difference**2
    known = ~np.isnan(square)
    if known.all():
        return np.asarray(sum(square.T) / square.shape[1])
    return np.asarray(sum(np.where(known, square, 0.0).T) / known.sum(axis=1))


def curve_columns(curve: Curve, persist_s: tuple[float, ...] | list[float]) -> list[FloatArray]:
    """Return shapes of white noise, and of errors that persist for each of some times."""
    return [np.ones(len(curve.lag_s)), *(1.0 - np.exp(-curve.lag_s / each_s) for each_s in persist_s)]


def fit_curve(curve: Curve, persist_s: tuple[float, ...] | list[float], growth: float) -> tuple[FloatArray, float]:
    """Return the parts of a curve, white and persistent for each of some times, beside what grows by the second; and
    their log likelihood (squares are Gamma distributed; reweighted by what is fitted).
    """
    from scipy.optimize import nnls

    columns, known = np.column_stack(curve_columns(curve, persist_s)), growth * curve.lag_s
    found, fitted = np.zeros(columns.shape[1]), curve.square
    for _ in range(ROUNDS_OF_FIT):
        weight = np.sqrt(curve.worth) / fitted
        found, _ = nnls(columns * weight[:, None], (curve.square - known) * weight, maxiter=MOST_SWAPS)
        fitted = np.maximum(columns @ found + known, LEAST_OF_SQUARE * curve.square)
    return found, float(curve.worth @ (-np.log(fitted) - curve.square / fitted))
