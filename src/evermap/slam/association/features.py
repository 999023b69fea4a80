"""What landmarks are like, as their radius or colour: evidence on which detections are of one landmark.

Random effects: of each column a landmark has a value of its own, every visit adds an error that all its readings share
(another side, another light), every reading one more. Two groups of readings are then more or less probable if they are
of one landmark than if they are of two, by a ratio of Gaussians in closed form: `same_nats`, which every stage of the
association asks. All variances are learned from a recording that was associated without, so that units and scales do
not matter and a column that tells nothing is not used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import gammaincinv

from evermap.slam.kernels import kernel
from evermap.types import FloatArray, IntArray

MISREAD_NATS = math.log(20.0)
"""What a reading may tell at most: one in twenty is of something else, or of nothing."""
MOST_READINGS = 4
"""Readings that a visit counts as, at most: their errors are alike."""
MOST_COLUMNS = 16
"""Those that tell most are used."""
LEAST_NATS = 0.1
"""What two visits must tell on average, for columns to be used at all."""
CONFIDENCE = 0.999
"""That landmarks differ in a column, for it to be used."""
CLIPPED_AT = 9.0
"""Squared normalised deviation beyond which one tells nothing more about a variance."""
HALVES = 6
"""Readings of a visit whose halves are compared: as the robot drives by, errors change that depend on where it is."""
SHARES = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.6, 1.0])
"""Of all variance, that the error of a visit may be."""
WRONG, WRONG_WORTH = 0.1, 2.0
"""Share of visits that are taken for those of one landmark and are not, before any is seen, and what that is worth."""
PREFERRED_NATS = 2.0
"""By how much visits must be more alike than that, for a lesser error of a visit to be believed."""
SETTLED = 0.5
"""Relative change of a variance that calls for nothing to be done again."""
FEWEST_PAIRS = 3.0
"""Pairs of visits, each landmark's counting as one less than its visits, from which that is told."""
MOST_COMPARED = 1_000_000
"""Differences that it is told by."""
ROUNDS = 12


class Variances(NamedTuple):
    """Variances (C,) of columns: of readings in a visit, of visits to a landmark, of landmarks; and the share of the
    columns that tell something of their own.
    """

    reading: FloatArray
    visit: FloatArray
    landmark: FloatArray
    share: float


class Likeness(NamedTuple):
    """G groups of readings: value and variance of its error (G, C), nan where nothing was read, and (G,) how many
    readings each counts as.
    """

    value: FloatArray
    variance: FloatArray
    readings: FloatArray

    def part(self, rows: Any) -> Likeness:
        """Return some groups."""
        return Likeness(self.value[rows], self.variance[rows], self.readings[rows])


@kernel
def same_nats(
    one: FloatArray, of_one: FloatArray, other: FloatArray, of_other: FloatArray, readings: float, spread: Any
) -> float:
    """Return how much more probable two groups are if they are of one landmark, at most so much for each reading.

    With values a, b about the mean of all, variances A, B of their errors and V of landmarks, it is
    `N((a, b); 0, [[V + A, V], [V, V + B]]) / (N(a; 0, V + A) N(b; 0, V + B))`.

    Args:
        one: (C,) values, nan where nothing was read.
        of_one: (C,) variances of their errors.
        other: (C,) values of the other one.
        of_other: (C,) variances of their errors.
        readings: how many the lesser of the two counts as.
        spread: a `Variances`.
    """
    total = 0.0
    for c in range(len(one)):
        a, b, v = one[c], other[c], spread.landmark[c]
        if not (np.isfinite(a) and np.isfinite(b)):
            continue
        va, vb = v + of_one[c], v + of_other[c]
        det = va * vb - v * v
        together = (vb * a * a - 2.0 * v * a * b + va * b * b) / det
        total += 0.5 * (a * a / va + b * b / vb - together + np.log(va * vb / det))
    most = MISREAD_NATS * readings
    return float(min(max(spread.share * total, -most), most))


@kernel
def _each_same(one: Any, other: Any, spread: Any) -> FloatArray:
    found = np.zeros(len(one.value))
    for k in range(len(found)):
        readings = min(one.readings[k], other.readings[k])
        found[k] = same_nats(one.value[k], one.variance[k], other.value[k], other.variance[k], readings, spread)
    return found


@dataclass(frozen=True, slots=True)
class Traits:
    """Readings (M, C) of detections about the mean of all, in the columns that are used, and how these spread."""

    value: FloatArray
    spread: Variances

    @classmethod
    def none(cls, count: int) -> Traits:
        """Return those of detections of which nothing was read."""
        return cls(np.zeros((count, 0)), Variances(np.zeros(0), np.zeros(0), np.zeros(0), 1.0))

    @property
    def errors(self) -> FloatArray:
        """(N, C) variances of the error of a visit that counts as so many readings, from none on."""
        readings = np.arange(MOST_READINGS + 1)[:, None]
        return self.spread.visit + self.spread.reading / np.maximum(readings, 1)

    def close_to(self, other: Traits) -> bool:
        """Return whether the same columns have errors of the same size, or nearly."""
        one, two = self.errors[MOST_READINGS], other.errors[MOST_READINGS]
        return one.shape == two.shape and bool(np.all(np.abs(np.log(one / two)) < SETTLED))

    def until(self, count: int) -> Traits:
        """Return those of the first detections."""
        return replace(self, value=self.value[:count])

    def singly(self, rows: IntArray) -> Likeness:
        """Return detections each by itself."""
        value = self.value[rows]
        return Likeness(value, np.tile(self.errors[1], (len(value), 1)), np.isfinite(value).any(axis=1).astype(float))

    def nothing(self, count: int) -> Likeness:
        """Return landmarks of which nothing was read."""
        nothing = np.full((count, self.value.shape[1]), np.nan)
        return Likeness(nothing, nothing.copy(), np.zeros(count))

    def followed(self, known: Likeness, landmark: IntArray, rows: IntArray) -> Likeness:
        """Return landmarks with readings more, each of another one: a running mean, until medians are taken."""
        value, variance, readings = (each.copy() for each in known)
        old, now = value[landmark], self.value[rows]
        gain = 1.0 / (1.0 + readings[landmark, None])
        mean = np.where(np.isnan(old), now, old + gain * np.where(np.isnan(now), 0.0, now - old))
        value[landmark] = mean
        readings[landmark] += np.isfinite(now).any(axis=1)
        counts = np.minimum(readings[landmark], MOST_READINGS).astype(np.int64)
        variance[landmark] = np.fmin(variance[landmark], self.errors[counts])
        return Likeness(value, variance, readings)

    def of_visits(self, visit: IntArray, count: int) -> Likeness:
        """Return visits by the medians of their readings; visit (M,) of each detection, negative for none."""
        value, read = medians(self.value, visit, count)
        variance = self.spread.visit + self.spread.reading / np.clip(read, 1, MOST_READINGS)
        return Likeness(value, variance, np.minimum(read.max(axis=1, initial=0), MOST_READINGS).astype(float))

    def of_landmarks(self, visits: Likeness, landmark: IntArray, count: int) -> Likeness:
        """Return landmarks by their visits; landmark (V,) of each."""
        known = np.isfinite(visits.value)
        weight = np.where(known, 1.0 / visits.variance, 0.0)
        total, middle = np.zeros((count, weight.shape[1])), np.zeros((count, weight.shape[1]))
        readings = np.zeros(count)
        np.add.at(total, landmark, weight)
        np.add.at(middle, landmark, weight * np.where(known, visits.value, 0.0))
        np.add.at(readings, landmark, visits.readings)
        some = np.where(total > 0.0, total, np.nan)
        return Likeness(middle / some, 1.0 / some, readings)

    def same(self, one: Likeness, other: Likeness) -> FloatArray:
        """Return (K,) nats by which groups are more probable if each is of one landmark with the other one."""
        return _each_same(one, other, self.spread)

    def told(self, visit: IntArray, landmark: IntArray) -> float:
        """Return how much more probable all readings are, visits belonging together as they do, than if each were to
        another landmark [nats]; visit (M,) of detections, numbered by landmark and time, landmark (V,) of visits.
        """
        visits = self.of_visits(visit, len(landmark))
        first = np.searchsorted(landmark, landmark)  # of the landmark that each is to
        rank, found = np.arange(len(landmark)) - first, 0.0
        for k in range(1, int(rank.max(initial=0)) + 1):
            now, before = np.flatnonzero(rank == k), np.flatnonzero(rank < k)
            known = self.of_landmarks(visits.part(before), first[before], len(landmark))
            found += float(self.same(visits.part(now), known.part(first[now])).sum())
        return found


def medians(value: FloatArray, number: IntArray, count: int) -> tuple[FloatArray, IntArray]:
    """Return (G, C) medians of readings (M, C) of each group, nan where there are none, and how many there are.

    Args:
        value: nan where nothing was read.
        number: (M,) group of each, negative for none.
        count: how many groups there are.
    """
    found, read = np.full((count, value.shape[1]), np.nan), np.zeros((count, value.shape[1]), dtype=np.int64)
    for c, column in enumerate(value.T):
        rows = np.flatnonzero((number >= 0) & np.isfinite(column))
        rows = rows[np.lexsort((column[rows], number[rows]))]
        read[:, c] = np.bincount(number[rows], minlength=count)
        some, first = np.flatnonzero(read[:, c]), np.cumsum(read[:, c]) - read[:, c]
        low, high = (first + (read[:, c] - 1) // 2)[some], (first + read[:, c] // 2)[some]
        found[some, c] = 0.5 * (column[rows[low]] + column[rows[high]])
    return found, read


def learned(value: FloatArray, visit: IntArray, landmark: IntArray, *, revisits: bool = True) -> Traits | None:
    """Return what columns tell, by visits whose detections are surely of one landmark each; None if they tell nothing.

    Args:
        value: (M, D) readings, nan where there are none.
        visit: (M,) of each detection, numbered by landmark and time; negative for none.
        landmark: (V,) of each visit, right for many of them.
        revisits: whether the error of a visit is told by what visits to one landmark differ by; else it is as little as
            readings within a visit say.
    """
    middle, read = medians(value, visit, len(landmark))
    with np.errstate(all="ignore"):
        mean = _median(middle)
        value, middle = value - mean, middle - mean
        reading, least = _within(value, visit, middle, read)
        every = _clipped(middle, np.ones_like(middle))
        own = reading / np.clip(read, 1, MOST_READINGS)
        free = np.maximum(every - least, 0.0)
        share = _visit_share(middle, own, landmark, least, free) if revisits else np.zeros_like(free)
        error = least + share * free
        typical = error + _mean(np.where(read > 0, own, np.nan))
        between = np.maximum(every - typical, 0.0)
        many = (read > 0).sum(axis=0)  # as independent as visits are, if landmarks do not differ
        beyond = 2.0 * gammaincinv(0.5 * np.maximum(many - 1, 1), CONFIDENCE) / np.maximum(many - 1, 1)
        told = -0.5 * np.log1p(-((between / (between + typical)) ** 2))
    told = np.where((every > beyond * typical) & (many > 2) & np.isfinite(told), told, 0.0)
    used = np.sort(np.argsort(-told, kind="stable")[:MOST_COLUMNS])
    used = used[told[used] > 0.0]
    alone = _alone(middle[:, used])
    if alone * told[used].sum() < LEAST_NATS:
        return None
    spread = Variances(reading[used], error[used], between[used], alone)
    return Traits(np.ascontiguousarray(value[:, used]), spread)


def _within(value: FloatArray, visit: IntArray, middle: FloatArray, read: IntArray) -> tuple[FloatArray, FloatArray]:
    """Variances (D,) of readings about those of their visit, and of what halves of a visit differ by beyond that."""
    seen = np.flatnonzero(visit >= 0)
    of = visit[seen]
    left = 1.0 - 1.0 / np.maximum(read[of], 1.5)
    off = np.where(read[of] > 1, value[seen] - middle[of], np.nan)
    reading = (1.4826 * _median(np.abs(off) / np.sqrt(left))) ** 2
    reading = np.where(reading > 0.0, reading, _clipped(off, left))  # most are equal where values are rounded
    order = np.lexsort((seen, of))  # detections are in the order of time
    size = np.bincount(of, minlength=len(middle))
    rank = np.empty(len(seen), dtype=np.int64)
    rank[order] = np.arange(len(seen)) - (np.cumsum(size) - size)[of[order]]
    half = np.full(len(visit), -1)
    half[seen] = 2 * of + (2 * rank >= size[of])
    halves, each = medians(value, half, 2 * len(middle))
    apart, both = halves[1::2] - halves[::2], (each[1::2] + each[::2] >= HALVES) & (each[1::2] * each[::2] > 0)
    by_chance = np.where(both, 1.0 / np.maximum(each[1::2], 1) + 1.0 / np.maximum(each[::2], 1), np.nan)
    drifting = _clipped(np.where(both, apart, np.nan), np.ones_like(apart))
    more = 0.5 * (drifting - 0.5 * np.pi * reading * _mean(by_chance))
    return reading, np.where(np.isfinite(more), np.maximum(more, 0.0), 0.0)


def _median(value: FloatArray) -> FloatArray:
    """Medians (D,) of columns (N, D), nan where nothing was read."""
    return np.asarray(medians(value, np.zeros(len(value), dtype=np.int64), 1)[0][0])


def _mean(value: FloatArray) -> FloatArray:
    """Means (D,), nan where nothing was read."""
    known = np.isfinite(value)
    return np.asarray(np.where(known, value, 0.0).sum(axis=0) / known.sum(axis=0))


def _clipped(off: FloatArray, left: FloatArray) -> FloatArray:
    """Variances (D,) of deviations (N, D), nan for none, which are so many times smaller as they should be."""
    squared = off**2 / left
    found = _mean(squared)
    for _ in range(ROUNDS):
        found = _mean(np.minimum(squared, CLIPPED_AT * found))
    return np.where(np.isfinite(found), found, 0.0)


def _visit_share(
    middle: FloatArray, own: FloatArray, landmark: IntArray, least: FloatArray, free: FloatArray
) -> FloatArray:
    """(D,) share of what visits vary by that is an error of visits, not what landmarks differ by.

    Of the visits to what is taken for one landmark some are to others: two differ by errors, or by the landmarks, too
    (a mixture with one share for all columns). The largest errors that explain the differences are taken.
    """
    size = np.bincount(landmark)
    first, pairs = np.cumsum(size) - size, list[IntArray]()
    for step in range(1, int(size.max(initial=0))):
        one = np.flatnonzero(np.arange(len(landmark)) + step < (first + size)[landmark])
        pairs.append(np.column_stack([one, one + step]))
    one, other = (np.concatenate(pairs) if pairs else np.zeros((0, 2), dtype=np.int64)).T
    some = slice(None, None, 1 + len(one) * middle.shape[1] // MOST_COMPARED)
    one, other = one[some], other[some]
    weight = 2.0 * some.step / size[landmark[one]]
    gap, chance = middle[one] - middle[other], own[one] + own[other]
    usual = np.where(free > 0.0, np.minimum(_mean(own) * MOST_READINGS / np.maximum(free, 1e-300), 1.0), 1.0)
    if weight.sum() < FEWEST_PAIRS:
        return usual
    alone = _alone(middle)

    def nats(share: FloatArray) -> FloatArray:
        """Give (2, K, D) log likelihoods of differences, of one landmark and of two."""
        right = 2.0 * (least + share * free) + chance + 1e-300
        wrong = right + 2.0 * (1.0 - share) * free
        told = np.stack([-0.5 * (np.log(variance) + gap**2 / variance) for variance in (right, wrong)])
        return alone * np.where(np.isfinite(gap), told, 0.0)

    def fit(told: FloatArray) -> float:
        """Fit the share of wrong ones to (2, K) log likelihoods; returns that of all."""
        wrong = WRONG
        for _ in range(ROUNDS):
            odds = told[1] - told[0] + math.log(wrong / (1.0 - wrong))
            wrong = float(weight @ (1.0 / (1.0 + np.exp(-np.clip(odds, -500.0, 500.0)))) + WRONG * WRONG_WORTH)
            wrong /= float(weight.sum()) + WRONG_WORTH
        prior = WRONG_WORTH * (WRONG * math.log(wrong) + (1.0 - WRONG) * math.log1p(-wrong))
        return prior + float(weight @ np.logaddexp(told[0] + math.log1p(-wrong), told[1] + math.log(wrong)))

    def largest(found: list[float]) -> float:
        return float(SHARES[np.flatnonzero(np.array(found) >= max(found) - PREFERRED_NATS)[-1]])

    every = [nats(np.full(len(free), share)) for share in SHARES]
    share = np.full(len(free), largest([fit(each.sum(axis=2)) for each in every]))
    now = nats(share)
    for _ in range(2):
        for c in np.flatnonzero(free > 0.0):
            rest = now.sum(axis=2) - now[:, :, c]
            share[c] = largest([fit(rest + each[:, :, c]) for each in every])
            now[:, :, c] = every[int(np.flatnonzero(share[c] == SHARES)[0])][:, :, c]
    return share


def _alone(value: FloatArray) -> float:
    """Share of columns (V, D) that tell something of their own: effective number, by their correlations, over all."""
    count = value.shape[1]
    if count < 2:
        return 1.0
    known = np.isfinite(value)
    zero = np.where(known, value, 0.0)
    scale = np.sqrt((zero**2).sum(axis=0) / np.maximum(known.sum(axis=0), 1))
    z = np.clip(zero / np.where(scale > 0.0, scale, 1.0), -3.0, 3.0)
    both = known.T.astype(float) @ known
    correlation = (z.T @ z) / np.maximum(both, 1.0)
    shared = np.minimum(correlation**2, 1.0)
    np.fill_diagonal(shared, 1.0)
    return float(count / shared.sum())
