"""Traits of landmarks, such as radius or colour, as evidence on which detections are of one landmark.

Random effects: in each column a landmark has its own value, every visit adds an error that its readings share (another
side, another light), every reading one more. The likelihood ratio of two groups of readings, of one landmark over of
two, is then a ratio of Gaussians in closed form: `same_nats`, which every stage of the association uses. All variances
are learned from a recording that was associated without traits, so units and scales do not matter, and a column without
evidence is not used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
from scipy.special import gammaincinv

from evermap.config import ReadingsConfig, SlamConfig
from evermap.estimate.robust import MEDIAN_TO_SIGMA
from evermap.slam.batch import USUAL
from evermap.slam.kernels import kernel
from evermap.types import FloatArray, IntArray

_Found = TypeVar("_Found")

MOST_COLUMNS = 16
"""Number of columns that are used, those with most evidence: bounds the work."""
SHARES = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.6, 1.0])
"""Grid of the share of all variance that is the error of a visit."""
SETTLED = 0.5
"""Tolerance of a variance, as the change of its logarithm, for the association to be repeated."""
MOST_COMPARED = 1_000_000
"""Number of differences of visits that are used: bounds the work."""
MOST_LEARNED = 3
"""Maximum number of rounds of learning traits and associating with them; they converge within these."""
ROUNDS = 12
"""Rounds of reweighting; they converge within a few."""


class Variances(NamedTuple):
    """Variances (C,) of columns: of readings in a visit, of visits to a landmark, of landmarks; the share of
    independent columns; and the evidence of one reading at most [nats].
    """

    reading: FloatArray
    visit: FloatArray
    landmark: FloatArray
    share: float
    misread_nats: float = USUAL.association.readings.misread_nats


class Likeness(NamedTuple):
    """G groups of readings: value and variance of its error (G, C), nan without readings, and (G,) the number of
    readings that each counts as.
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
    """Return the evidence that two groups are of one landmark, over of two, bounded per reading [nats].

    With values a, b about the mean of all, variances A, B of their errors and V of landmarks, it is
    `N((a, b); 0, [[V + A, V], [V, V + B]]) / (N(a; 0, V + A) N(b; 0, V + B))`.

    Args:
        one: (C,) values, nan without readings.
        of_one: (C,) variances of their errors.
        other: (C,) values of the other group.
        of_other: (C,) variances of their errors.
        readings: number that the smaller group counts as.
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
    most = spread.misread_nats * readings
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
    """Readings (M, C) of detections, centred, in the columns that are used; their variances; settings; which columns
    these are, and (C,) the means.
    """

    value: FloatArray
    spread: Variances
    settings: SlamConfig = USUAL
    column: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    mean: FloatArray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def none(cls, count: int, settings: SlamConfig = USUAL) -> Traits:
        """Return those of detections without readings."""
        return cls(np.zeros((count, 0)), Variances(np.zeros(0), np.zeros(0), np.zeros(0), 1.0), settings)

    @property
    def most_readings(self) -> int:
        """Number of readings that a visit counts as, at most."""
        return self.settings.association.readings.most_readings

    @property
    def errors(self) -> FloatArray:
        """(N, C) variance of the error of a visit by the number of readings that it counts as, from 0 on."""
        readings = np.arange(self.most_readings + 1)[:, None]
        return self.spread.visit + self.spread.reading / np.maximum(readings, 1)

    def close_to(self, other: Traits) -> bool:
        """Return whether the same columns have errors of about the same size."""
        one, two = self.errors[self.most_readings], other.errors[self.most_readings]
        return one.shape == two.shape and bool(np.all(np.abs(np.log(one / two)) < SETTLED))

    def until(self, count: int) -> Traits:
        """Return the traits of the first detections."""
        return replace(self, value=self.value[:count])

    def singly(self, rows: IntArray) -> Likeness:
        """Return a group per detection."""
        value = self.value[rows]
        return Likeness(value, np.tile(self.errors[1], (len(value), 1)), np.isfinite(value).any(axis=1).astype(float))

    def nothing(self, count: int) -> Likeness:
        """Return landmarks without readings."""
        nothing = np.full((count, self.value.shape[1]), np.nan)
        return Likeness(nothing, nothing.copy(), np.zeros(count))

    def followed(self, known: Likeness, landmark: IntArray, rows: IntArray) -> Likeness:
        """Return landmarks with further readings, each of a different one: a running mean, until medians are taken.

        Rows of landmarks behind the known ones are of new ones.
        """
        new = self.nothing(max(int(landmark.max(initial=-1)) + 1 - len(known.value), 0))
        value, variance, readings = (np.concatenate(each) for each in zip(known, new, strict=True))
        old, now = value[landmark], self.value[rows]
        gain = 1.0 / (1.0 + readings[landmark, None])
        mean = np.where(np.isnan(old), now, old + gain * np.where(np.isnan(now), 0.0, now - old))
        value[landmark] = mean
        readings[landmark] += np.isfinite(now).any(axis=1)
        counts = np.minimum(readings[landmark], self.most_readings).astype(np.int64)
        variance[landmark] = np.fmin(variance[landmark], self.errors[counts])
        return Likeness(value, variance, readings)

    def of_visits(self, visit: IntArray, count: int) -> Likeness:
        """Return the medians of the readings per visit; visit (M,) of each detection, negative for none."""
        value, read = medians(self.value, visit, count)
        variance = self.spread.visit + self.spread.reading / np.clip(read, 1, self.most_readings)
        return Likeness(value, variance, np.minimum(read.max(axis=1, initial=0), self.most_readings).astype(float))

    def of_landmarks(self, visits: Likeness, landmark: IntArray, count: int) -> Likeness:
        """Return landmarks as means of their visits; landmark (V,) of each visit."""
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
        """Return (K,) the evidence that groups are pairwise of one landmark [nats]."""
        return _each_same(one, other, self.spread) if one.value.shape[1] else np.zeros(len(one.value))

    def evidence(self, visit: IntArray, landmark: IntArray) -> float:
        """Sum the evidence of all readings for this assignment of visits, over each to its own landmark [nats]; visit
        (M,) of detections, numbered by landmark and time, landmark (V,) of visits.
        """
        if not self.value.shape[1]:
            return 0.0
        visits = self.of_visits(visit, len(landmark))
        first = np.searchsorted(landmark, landmark)  # visit to the same landmark
        rank, found = np.arange(len(landmark)) - first, 0.0
        for k in range(1, int(rank.max(initial=0)) + 1):
            now, before = np.flatnonzero(rank == k), np.flatnonzero(rank < k)
            known = self.of_landmarks(visits.part(before), first[before], len(landmark))
            found += float(self.same(visits.part(now), known.part(first[now])).sum())
        return found


def medians(value: FloatArray, number: IntArray, count: int) -> tuple[FloatArray, IntArray]:
    """Return (G, C) medians of the readings (M, C) of each group, nan for none, and their number.

    Args:
        value: nan without a reading.
        number: (M,) group of each, negative for none.
        count: number of groups.
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


def learned(
    value: FloatArray, visit: IntArray, landmark: IntArray, *, revisits: bool = True, settings: SlamConfig = USUAL
) -> Traits | None:
    """Learn the variances of columns from visits, each of one landmark with certainty; None without evidence.

    Args:
        value: (M, D) readings, nan for none.
        visit: (M,) of each detection, numbered by landmark and time; negative for none.
        landmark: (V,) of each visit, correct for many of them.
        revisits: estimate the error of a visit from the differences between visits to one landmark; else it is the
            least that the readings within a visit permit.
        settings: of the estimator.
    """
    rules = settings.association.readings
    middle, read = medians(value, visit, len(landmark))
    with np.errstate(all="ignore"):
        mean = column_medians(middle)
        value, middle = value - mean, middle - mean
        reading, least = _within(value, visit, middle, read, settings)
        every = _clip_variances(middle, np.ones_like(middle), settings)
        own = reading / np.clip(read, 1, rules.most_readings)
        free = np.maximum(every - least, 0.0)
        share = _visit_share(middle, own, landmark, least, free, rules) if revisits else np.zeros_like(free)
        error = least + share * free
        typical = error + _mean(np.where(read > 0, own, np.nan))
        between = np.maximum(every - typical, 0.0)
        many = (read > 0).sum(axis=0)  # visits are independent if landmarks do not differ
        beyond = 2.0 * gammaincinv(0.5 * np.maximum(many - 1, 1), rules.confidence) / np.maximum(many - 1, 1)
        nats = -0.5 * np.log1p(-((between / (between + typical)) ** 2))
    nats = np.where((every > beyond * typical) & (many > 2) & np.isfinite(nats), nats, 0.0)
    used = np.sort(np.argsort(-nats, kind="stable")[:MOST_COLUMNS])
    used = used[nats[used] > 0.0]
    alone = _alone(middle[:, used])
    if alone * nats[used].sum() < rules.least_nats:
        return None
    spread = Variances(reading[used], error[used], between[used], alone, rules.misread_nats)
    return Traits(np.ascontiguousarray(value[:, used]), spread, settings, used, mean[used])


def best_with_traits(
    first: _Found,
    traits: Traits | None,
    explain: Callable[[_Found, _Found], tuple[float, Traits | None]],
    again: Callable[[_Found, Traits], _Found],
) -> _Found:
    """Return the association that explains all detections and their traits best.

    The variances of the traits are learned from the association without them, which may be wrong: first from readings
    within visits, then from revisits. Each result is a proposal; the one with most evidence, by its own variances, is
    kept.

    Args:
        first: the association without traits.
        traits: learned from it without revisits; None without evidence.
        explain: returns the negative log likelihood [nats] of the second one, as the first one is judged, and the
            traits learned from it.
        again: returns another association with given traits, from the best one so far.
    """
    if traits is None:
        return first
    best, (cost, known) = first, explain(first, first)
    for _ in range(MOST_LEARNED):
        trial = again(best, traits)
        against, own = explain(best, trial)
        if against < cost:
            best, cost, known = trial, against, own
        if known is None or known.close_to(traits):
            break
        traits = known
    return best


def _within(
    value: FloatArray, visit: IntArray, middle: FloatArray, read: IntArray, settings: SlamConfig
) -> tuple[FloatArray, FloatArray]:
    """Variances (D,) of readings about the median of their visit, and of drift between the halves of a visit."""
    seen = np.flatnonzero(visit >= 0)
    of = visit[seen]
    left = 1.0 - 1.0 / np.maximum(read[of], 1.5)
    off = np.where(read[of] > 1, value[seen] - middle[of], np.nan)
    reading = (MEDIAN_TO_SIGMA * column_medians(np.abs(off) / np.sqrt(left))) ** 2
    reading = np.where(
        reading > 0.0, reading, _clip_variances(off, left, settings)
    )  # the median is 0 if values are rounded
    order = np.lexsort((seen, of))  # detections are in the order of time
    size = np.bincount(of, minlength=len(middle))
    rank = np.empty(len(seen), dtype=np.int64)
    rank[order] = np.arange(len(seen)) - (np.cumsum(size) - size)[of[order]]
    half = np.full(len(visit), -1)
    half[seen] = 2 * of + (2 * rank >= size[of])
    halves, each = medians(value, half, 2 * len(middle))
    apart, both = (
        halves[1::2] - halves[::2],
        (each[1::2] + each[::2] >= settings.association.readings.fewest_in_halves) & (each[1::2] * each[::2] > 0),
    )
    by_chance = np.where(both, 1.0 / np.maximum(each[1::2], 1) + 1.0 / np.maximum(each[::2], 1), np.nan)
    drifting = _clip_variances(np.where(both, apart, np.nan), np.ones_like(apart), settings)
    more = 0.5 * (drifting - 0.5 * np.pi * reading * _mean(by_chance))
    return reading, np.where(np.isfinite(more), np.maximum(more, 0.0), 0.0)


def column_medians(value: FloatArray) -> FloatArray:
    """Return (D,) medians of columns (N, D), nan without readings."""
    return np.asarray(medians(value, np.zeros(len(value), dtype=np.int64), 1)[0][0])


def _mean(value: FloatArray) -> FloatArray:
    """Means (D,), nan without readings."""
    known = np.isfinite(value)
    return np.asarray(np.where(known, value, 0.0).sum(axis=0) / known.sum(axis=0))


def _clip_variances(off: FloatArray, left: FloatArray, settings: SlamConfig) -> FloatArray:
    """Variances (D,) of deviations (N, D), nan for none; left (N, D) is the share of their variance that remains."""
    squared = off**2 / left
    found = _mean(squared)
    for _ in range(ROUNDS):
        found = _mean(np.minimum(squared, settings.association.clipped_at * found))
    return np.where(np.isfinite(found), found, 0.0)


def _visit_share(
    middle: FloatArray, own: FloatArray, landmark: IntArray, least: FloatArray, free: FloatArray, rules: ReadingsConfig
) -> FloatArray:
    """(D,) share of the variance between visits that is an error of visits, not a difference of landmarks.

    Some visits are assigned to the wrong landmark: two differ by errors only, or by their landmarks, too (a mixture
    with one share for all columns). The largest errors that explain the differences are chosen.
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
    usual = np.where(free > 0.0, np.minimum(_mean(own) * rules.most_readings / np.maximum(free, 1e-300), 1.0), 1.0)
    if weight.sum() < rules.fewest_pairs:
        return usual
    alone = _alone(middle)

    def nats(share: FloatArray) -> FloatArray:
        """Give (2, K, D) log likelihoods of differences, for one landmark and for two."""
        right = 2.0 * (least + share * free) + chance + 1e-300
        wrong = right + 2.0 * (1.0 - share) * free
        each = np.stack([-0.5 * (np.log(variance) + gap**2 / variance) for variance in (right, wrong)])
        return alone * np.where(np.isfinite(gap), each, 0.0)

    def fit(each: FloatArray) -> float:
        """Fit the share of wrong ones to (2, K) log likelihoods; returns the log likelihood of all."""
        prior, worth = rules.p_wrong, rules.wrong_worth
        wrong = prior
        for _ in range(ROUNDS):
            odds = each[1] - each[0] + math.log(wrong / (1.0 - wrong))
            wrong = float(weight @ (1.0 / (1.0 + np.exp(-np.clip(odds, -500.0, 500.0)))) + prior * worth)
            wrong /= float(weight.sum()) + worth
        of_prior = worth * (prior * math.log(wrong) + (1.0 - prior) * math.log1p(-wrong))
        return of_prior + float(weight @ np.logaddexp(each[0] + math.log1p(-wrong), each[1] + math.log(wrong)))

    def largest(found: list[float]) -> float:
        return float(SHARES[np.flatnonzero(np.array(found) >= max(found) - rules.preferred_nats)[-1]])

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
    """Share of independent columns (V, D): their effective number, from correlations, over all."""
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
