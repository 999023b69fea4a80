"""Scores of Rosen 2016 section VII-B, exact and without visiting a grid time: L1 error, precision and recall.

Between two looks every estimator of the paper believes `scale * shape(t)`: a persistence filter `p_i S(t) / S(t_i)`,
the empirical estimator 0 or 1. Sums over the grid times of such a stretch are therefore differences of running sums
of the shape, and the times at which a falling belief is below a threshold are found by bisection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.existence import single
from evermap.survival.base import LifetimePrior
from evermap.types import BoolArray, FloatArray, IntArray
from evermap_studies.worlds.revisits import Revisits


@dataclass(frozen=True, slots=True)
class Stretches:
    """Sequences cut at their looks: before the first, and after each. M + N rows, sequence by sequence.

    Attributes:
        grid_s: (G,) the times at which beliefs are asked.
        sequence: (M + N,) which sequence a stretch is of.
        look: (M + N,) which look begins it, -1 before the first.
        begin, end: (M + N,) its grid times are `begin` to `end`, without the last.
        change: (M + N,) from which grid time on, within the stretch, the feature is gone.
        total: number of sequences.
    """

    grid_s: FloatArray
    sequence: IntArray
    look: IntArray
    begin: IntArray
    end: IntArray
    change: IntArray
    total: int

    @classmethod
    def of(cls, data: Revisits, grid_s: FloatArray) -> Stretches:
        """Cut; a look at a grid time counts for it."""
        n, m = len(data), len(data.stamp_s)
        heads = data.first[:-1] + np.arange(n)
        is_head = np.zeros(m + n, dtype=np.bool_)
        is_head[heads] = True
        look = np.full(m + n, -1)
        look[~is_head] = np.arange(m)
        begin = np.zeros(m + n, dtype=np.int64)
        begin[~is_head] = np.searchsorted(grid_s, data.stamp_s, side="left")
        end = np.append(begin[1:], 0)
        end[heads[1:] - 1] = len(grid_s)
        end[-1] = len(grid_s)
        sequence = np.repeat(np.arange(n), data.looks + 1)
        gone = np.searchsorted(grid_s, data.survival_s, side="right")  # it exists at t <= T
        return cls(grid_s, sequence, look, begin, end, np.clip(gone[sequence], begin, end), n)

    def spread(self, before: float, after_look: FloatArray) -> FloatArray:
        """(M + N,) one value a stretch: `before` the first look, and that of the look (M,) after it."""
        return np.where(self.look < 0, before, after_look[self.look])

    def per_sequence(self, values: FloatArray | IntArray) -> FloatArray:
        """(N,) sums over the stretches of each sequence."""
        return np.asarray(np.bincount(self.sequence, weights=values, minlength=self.total), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Estimate:
    """What an estimator believes at all grid times.

    Attributes:
        scale: (M + N,) factor of each stretch.
        shape: (G,) never increasing; the belief is their product.
    """

    scale: FloatArray
    shape: FloatArray


def filtered(data: Revisits, cut: Stretches, prior: LifetimePrior, p_miss: float, p_false: float) -> Estimate:
    """The persistence filter with a lifetime prior: its posterior at every look, its prediction in between."""
    _, posterior = single.init(len(data), prior).run(data.sequence, data.stamp_s, data.detected, p_miss, p_false)
    scale = cut.spread(1.0, posterior / _unseen(prior, data.stamp_s))
    return Estimate(scale, _unseen(prior, cut.grid_s))


def _unseen(prior: LifetimePrior, stamp_s: FloatArray) -> FloatArray:
    """Belief in features at which nobody has looked since birth: their survival."""
    return single.init(len(stamp_s), prior).predict(stamp_s)


def empirical(data: Revisits, cut: Stretches, *, as_coded: bool) -> Estimate:
    """The last detector output, believed with certainty; 1 before there is any.

    Args:
        data: sequences.
        cut: the same, cut.
        as_coded: as the paper's authors have it: after the last look of a sequence, the output before the last.
    """
    outputs = data.detected.astype(np.float64)
    if as_coded:
        several = data.looks > 1
        last = data.first[1:][several] - 1
        outputs[last] = data.detected[last - 1]
        outputs[data.first[:-1][data.looks == 1]] = 1.0
    return Estimate(cut.spread(1.0, outputs), np.ones(len(cut.grid_s)))


def l1_error(estimate: Estimate, cut: Stretches) -> FloatArray:
    """(N,) mean distance between belief and truth by the trapezoidal rule over the grid (eq. 30)."""
    weight = np.diff(cut.grid_s, prepend=cut.grid_s[0]) / 2 + np.diff(cut.grid_s, append=cut.grid_s[-1]) / 2
    time = np.concatenate([[0.0], np.cumsum(weight)])
    mass = np.concatenate([[0.0], np.cumsum(weight * estimate.shape)])
    there = time[cut.change] - time[cut.begin] - estimate.scale * (mass[cut.change] - mass[cut.begin])
    gone = estimate.scale * (mass[cut.end] - mass[cut.change])
    return np.asarray(cut.per_sequence(there + gone) / (cut.grid_s[-1] - cut.grid_s[0]))


def removal(estimate: Estimate, cut: Stretches, threshold: float) -> tuple[FloatArray, FloatArray]:
    """(N,) precision and (N,) recall of removing the feature wherever the belief is below `threshold`.

    NaN where nothing was removed (precision), or where the feature never was gone (recall).
    """
    with np.errstate(divide="ignore"):
        level = threshold / estimate.scale
    below = np.clip(np.searchsorted(-estimate.shape, -level, side="right"), cut.begin, cut.end)
    removed = cut.per_sequence(cut.end - below)
    rightly = cut.per_sequence(cut.end - np.maximum(below, cut.change))
    gone = cut.per_sequence(cut.end - cut.change)
    return _ratio(rightly, removed), _ratio(rightly, gone)


def _ratio(part: FloatArray, whole: FloatArray) -> FloatArray:
    known: BoolArray = whole > 0.0
    return np.where(known, part / np.where(known, whole, 1.0), np.nan)
