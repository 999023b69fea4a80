"""Stays by their ages at looks, and their likelihood under a hazard that is constant over stretches of age.

Of a stay are known its entry, a span in which it arrived, and a span in which it ended, or that it goes on; between
looks it may leave and return (MATH.md sections 6 and 9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np

from evermap.survival.censored import CensoredLifetimes
from evermap.survival.hazard_regression import overlaps
from evermap.survival.logmath import TINY, log_sum_exp
from evermap.types import BoolArray, FloatArray, IntArray

ALIKE = 2
"""Digits after the first to which stays are alike that are learned from together."""


@dataclass(frozen=True, slots=True)
class StayAges:
    """N stays by their ages at looks, each with J equally probable instants of arrival.

    Attributes:
        first_s, last_s, gone_s: (N, J) ages at the first and the last sighting, and at the look that missed it; inf
            where it goes on.
        weight: (N,) how many each stands for.
        group: (N,) class of each.
        gap_s: (N, 2) two lengths of the gaps between looks from first to last, half of them have each; of one gap where
            nothing can return unseen.
        back: (N,) probability that one that leaves is back after one more stay elsewhere.
        back_rate: (N,) rate in 1/s at which others return.
    """

    first_s: FloatArray
    last_s: FloatArray
    gone_s: FloatArray
    weight: FloatArray
    group: IntArray
    gap_s: FloatArray
    back: FloatArray
    back_rate: FloatArray

    @classmethod
    def of_samples(cls, data: CensoredLifetimes, group: IntArray | None = None) -> Self:
        """Take censored samples (N rows): entry, left and right bounds of one instant each; ends that were observed
        lie in a span of a billionth of their age.
        """
        last = np.maximum(data.left_s, data.entry_s)
        gone = np.where(data.exact, data.right_s * (1.0 + 1e-9), data.right_s)
        n = len(last)
        return cls(
            data.entry_s[:, None], last[:, None], gone[:, None], data.weight,
            np.zeros(n, dtype=np.int64) if group is None else group,
            np.ones((n, 2)), np.zeros(n), np.zeros(n),
        )  # fmt: skip

    @classmethod
    def empty(cls) -> Self:
        """Return no stays."""
        ages, column = np.zeros((0, 1)), np.zeros(0)
        return cls(ages, ages, ages, column, np.zeros(0, dtype=np.int64), np.zeros((0, 2)), column, column)

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Return all that have a weight; rows that are alike to three digits are one."""
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in cls.__slots__}
        weight = columns.pop("weight")
        some = weight > 0.0
        if not some.any():
            return cls.empty()
        table = np.column_stack([*columns.values()])[some]
        with np.errstate(divide="ignore", invalid="ignore"):
            size = 10.0 ** (np.floor(np.log10(np.abs(table))) - ALIKE)
            alike = np.where(np.isfinite(size) & (size > 0.0), np.rint(table / size) * size, table)
        _, first, row = np.unique(alike, axis=0, return_index=True, return_inverse=True)
        kept = {name: column[some][first] for name, column in columns.items()}
        return cls(weight=np.bincount(row.ravel(), weight[some]).astype(np.float64), **kept)

    def of_group(self, group: int) -> Self:
        """Return those of one class."""
        mine = self.group == group
        return type(self)(*(getattr(self, name)[mine] for name in self.__slots__))

    @property
    def ended(self) -> BoolArray:
        """(N,) whether it is known to be gone."""
        return np.isfinite(self.gone_s[:, 0])


class StayLikelihood:
    """Log likelihood of the stays of one class, as a function of the hazards (K,) of the stretches."""

    def __init__(self, stays: StayAges, edges_s: FloatArray) -> None:
        n, j = stays.first_s.shape
        self.stays, self.ended = stays, stays.ended
        last, gone = stays.last_s, np.where(np.isfinite(stays.gone_s), stays.gone_s, stays.last_s)
        spans = ((np.zeros_like(last), stays.first_s), (stays.first_s, last), (last, gone))
        self.spent = [overlaps(a.ravel(), b.ravel(), edges_s).reshape(n, j, len(edges_s)) for a, b in spans]
        both = stays.gap_s.sum(axis=1)
        self.watched_s = last[:, 0] - stays.first_s[:, 0]
        self.left_s = (gone - last)[:, 0]
        self.pairs = np.maximum(self.watched_s / both, 0.5)
        self.share = stays.gap_s / both[:, None]

    def values(self, hazards: FloatArray) -> FloatArray:
        """Return the values (S,) of hazards (S, K)."""
        stays = self.stays
        until, stayed, left = (spent @ hazards.T for spent in self.spent)  # (N, J, S)
        score = -until
        for part in (0, 1):
            each = (self.share[:, part] / self.pairs)[:, None, None]
            come = (stays.back_rate * self.watched_s)[:, None, None] * each
            score += self.pairs[:, None, None] * _log_there_again(stayed * each, stays.back[:, None, None], come)
        come = (stays.back_rate * self.left_s)[self.ended, None, None]
        score[self.ended] += _log_gone(left[self.ended], stays.back[self.ended, None, None], come)
        seen, there = (log_sum_exp(np.moveaxis(part, 1, -1)) for part in (score, -until))
        return np.asarray(stays.weight @ (seen - there))

    def __call__(self, hazard: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Return the value, and gradient (K,) and second derivative (K, K) by log hazards."""
        value, gradients, curvatures = self.by_class(hazard[None], np.zeros(len(self.stays.weight), dtype=np.int64))
        return value, gradients[0], curvatures[0]

    def by_class(self, hazards: FloatArray, row: IntArray) -> tuple[float, FloatArray, FloatArray]:
        """Return the value under hazards (C, K), of which each stay has one (N,), in order; and gradients (C, K) and
        second derivatives (C, K, K) by log hazards.
        """
        stays, ended = self.stays, self.ended
        before, during, after = (spent * hazards[row, None] for spent in self.spent)
        until, stayed, left = (part.sum(axis=-1) for part in (before, during, after))
        score, first, second = -until, np.zeros_like(until), np.zeros_like(until)
        for part in (0, 1):
            each = (self.share[:, part] / self.pairs)[:, None]
            value, d1, d2 = _there_again(
                stayed * each, stays.back[:, None], (stays.back_rate * self.watched_s)[:, None] * each
            )
            score = score + self.pairs[:, None] * value
            first += self.pairs[:, None] * each * d1
            second += self.pairs[:, None] * each**2 * d2
        value, of_end, of_end_2 = _find_gone(left, stays.back[:, None], (stays.back_rate * self.left_s)[:, None])
        score = score + np.where(ended[:, None], value, 0.0)
        of_end, of_end_2 = (np.where(ended[:, None], d, 0.0) for d in (of_end, of_end_2))
        seen, there = log_sum_exp(score), log_sum_exp(-until)
        total = float(stays.weight @ (seen - there))
        w = stays.weight[:, None]
        p, q = w * np.exp(score - seen[:, None]), w * np.exp(-until - there[:, None])
        slope = -before + first[..., None] * during + of_end[..., None] * after
        mean, mean_before = (slope * p[..., None]).sum(axis=1), (before * q[..., None]).sum(axis=1)
        columns, weights = [during, after], [p * second, p * of_end_2]
        if slope.shape[1] > 1:  # of one instant these are 0 in sum
            per = 1.0 / w
            columns += [slope, mean[:, None], mean_before[:, None], before]
            weights += [p, -per, per, -q]
        of_all, by = np.concatenate(columns, axis=1), np.concatenate(weights, axis=1)
        n_classes, n_stretches = hazards.shape
        gradients, curvatures = np.zeros((n_classes, n_stretches)), np.zeros((n_classes, n_stretches, n_stretches))
        ends = np.searchsorted(row, np.arange(n_classes + 1))
        for k, (low, high) in enumerate(pairwise(ends.tolist())):
            gradients[k] = (mean[low:high] + mean_before[low:high]).sum(axis=0)
            curvatures[k] = _outer(of_all[low:high], by[low:high])
            curvatures[k].flat[:: n_stretches + 1] += gradients[k]
        return total, gradients, curvatures


def _outer(columns: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the weighted sum (K, K) of outer products of rows (N, J, K)."""
    flat = columns.reshape(-1, columns.shape[-1])
    return np.asarray((flat * weight.reshape(-1, 1)).T @ flat)


def _log_there_again(leave: FloatArray, back: FloatArray, come: FloatArray) -> FloatArray:
    """Return the log probability to be there at the next look, by the integrated hazard of leaving.

    `log (c + l exp(-c - l)) / (c + l)` with `c = back l + come` (`maps.learning`); `-l` where nothing comes back.
    """
    leave = np.maximum(leave, TINY)
    coming = back * leave + come
    both = coming + leave
    with np.errstate(all="ignore"):
        value = np.log((coming + leave * np.exp(-both)) / both)
    value = np.where(both < 1e-4, -leave + 0.5 * leave * (both - leave), value)
    return np.where((back == 0.0) & (come == 0.0), -leave, value)


def _there_again(leave: FloatArray, back: FloatArray, come: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return `_log_there_again`, and its derivatives by the integrated hazard."""
    plain = (back == 0.0) & (come == 0.0)
    value = _log_there_again(leave, back, come)
    leave = np.maximum(leave, TINY)
    coming = back * leave + come
    both = coming + leave
    small = both < 1e-4
    with np.errstate(all="ignore"):
        gone = np.exp(-both)
        top = coming + leave * gone
        rise = back + gone * (1.0 - (1.0 + back) * leave)
        bend = -gone * (1.0 + back) * (2.0 - (1.0 + back) * leave)
        d1 = rise / top - (1.0 + back) / both
        d2 = bend / top - (rise / top) ** 2 + ((1.0 + back) / both) ** 2
    d1 = np.where(small, -1.0 - leave + 0.5 * (both + leave * (1.0 + back)), d1)
    d2 = np.where(small, back, d2)
    return value, np.where(plain, -1.0, d1), np.where(plain, 0.0, d2)


def _log_gone(leave: FloatArray, back: FloatArray, come: FloatArray) -> FloatArray:
    """Return the log probability to be gone at the next look, by the integrated hazard of leaving."""
    leave = np.maximum(leave, TINY)
    change = (1.0 + back) * leave + come
    with np.errstate(all="ignore"):
        return np.log(leave / change) + np.log(-np.expm1(-change))


def _find_gone(leave: FloatArray, back: FloatArray, come: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return `_log_gone`, and its derivatives by the integrated hazard."""
    value = _log_gone(leave, back, come)
    leave = np.maximum(leave, TINY)
    slope = 1.0 + back
    change = slope * leave + come
    with np.errstate(all="ignore"):
        odds = 1.0 / np.expm1(np.minimum(change, 700.0))
        ratio, bend = slope / change, slope**2 * odds
        d1 = 1.0 / leave - ratio + slope * odds
        d2 = ratio**2 - 1.0 / leave**2 - bend * (1.0 + odds)
    return value, d1, d2
