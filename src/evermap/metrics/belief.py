"""Scores of probabilities of presence: proper scores, hard decisions, calibration.

The Brier score and the log loss are proper: only the honest probability minimises their expectation. Mean absolute
error and balanced accuracy are reported because others report them; an overconfident forecast can do well in both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import InputError
from evermap.show import Shown
from evermap.types import BoolArray, FloatArray, IntArray

SURE = 1e-9
"""The log loss clips beliefs this far from 0 and 1: one wrong certainty would make it infinite."""
BINS = 10


@dataclass(frozen=True, slots=True)
class Reliability(Shown):
    """Mean belief and observed share, in bins of equal width (a reliability diagram).

    Attributes:
        edge: (B + 1,) borders of the bins, from 0 to 1.
        count: (B,) beliefs in each.
        belief: (B,) their mean, nan in an empty bin.
        present: (B,) share of them for which the feature was there, nan in an empty bin.
    """

    edge: FloatArray
    count: IntArray
    belief: FloatArray
    present: FloatArray

    @property
    def error(self) -> float:
        """Return the expected calibration error: |belief - share| weighted by count; nan without any belief."""
        if not self.count.sum():
            return float("nan")
        gap = np.where(self.count > 0, np.abs(self.belief - self.present), 0.0)
        return float(np.sum(gap * self.count) / self.count.sum())


@dataclass(frozen=True, slots=True)
class BeliefScores:
    """Scores of N beliefs; nan where there is nothing to score.

    Attributes:
        count: N.
        share_present: how often the feature was there.
        brier: mean squared error (Brier 1950).
        log_loss: mean negative natural logarithm of the probability given to the outcome.
        calibration_error: of `Reliability` with ten bins.
        mae: mean absolute error.
        accuracy: share of right decisions at 0.5.
        balanced_accuracy: mean of the shares among present and among absent; nan where one of them is empty.
    """

    count: int
    share_present: float
    brier: float
    log_loss: float
    calibration_error: float
    mae: float
    accuracy: float
    balanced_accuracy: float


def belief_scores(p_present: ArrayLike, present: ArrayLike) -> BeliefScores:
    """Score beliefs against truth.

    Args:
        p_present: (N,) probabilities.
        present: (N,) 1 where the feature was there, else 0.

    Raises:
        InputError: shapes that differ, a probability outside [0, 1], or a truth that is neither 1 nor 0.
    """
    belief, there = _check(p_present, present)
    if len(belief) == 0:
        return BeliefScores(0, *[float("nan")] * 7)
    error = belief - there
    said = np.where(there, belief, 1.0 - belief)
    right = (belief >= 0.5) == there
    both = there.any() and not there.all()
    return BeliefScores(
        count=len(belief),
        share_present=float(there.mean()),
        brier=float(np.mean(error**2)),
        log_loss=float(-np.mean(np.log(np.clip(said, SURE, 1.0 - SURE)))),
        calibration_error=reliability(belief, there).error,
        mae=float(np.mean(np.abs(error))),
        accuracy=float(right.mean()),
        balanced_accuracy=float((right[there].mean() + right[~there].mean()) / 2.0) if both else float("nan"),
    )


def reliability(p_present: ArrayLike, present: ArrayLike, *, bins: int = BINS) -> Reliability:
    """Sort beliefs and truth into bins of equal width; the last bin includes 1.

    Args:
        p_present: (N,) probabilities.
        present: (N,) 1 where the feature was there, else 0.
        bins: number of bins.

    Raises:
        InputError: as `belief_scores`.
    """
    belief, there = _check(p_present, present)
    edge = np.arange(bins + 1) / bins
    bin_ = np.searchsorted(edge[1:-1], belief, side="right")
    count = np.bincount(bin_, minlength=bins)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(bin_, weights=belief, minlength=bins) / count
        share = np.bincount(bin_, weights=there, minlength=bins) / count
    return Reliability(edge, count, mean, share)


def _check(p_present: ArrayLike, present: ArrayLike) -> tuple[FloatArray, BoolArray]:
    belief = np.asarray(p_present, dtype=np.float64)
    truth = np.asarray(present, dtype=np.float64)
    if belief.ndim != 1 or belief.shape != truth.shape:
        raise InputError(f"shape {truth.shape} where the beliefs have {belief.shape}", field="present")
    wrong = np.flatnonzero(~((belief >= 0.0) & (belief <= 1.0)))
    if wrong.size:
        problem = f"row {wrong[0]}: {belief[wrong[0]]} is not a probability"
        raise InputError(problem, field="p_present", hint="a number between 0 and 1")
    wrong = np.flatnonzero((truth != 0.0) & (truth != 1.0))
    if wrong.size:
        raise InputError(f"row {wrong[0]}: {truth[wrong[0]]} is not a truth value", field="present", hint="1 or 0")
    return belief, truth == 1.0
