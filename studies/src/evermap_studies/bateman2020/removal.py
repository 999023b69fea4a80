"""Whether things are removed from a map when they vanish: not before, and soon after (Bateman 2020, section 5.1).

Columns are what beliefs are about: cliques, or landmarks that share the weight of their clique. A step counts as a
*possible detection* if the column is in view in it, from its birth on; steps whose looks a filter suppressed count like
all others. In such a step a belief of at least `rho_high` is a positive, and it is a true one if the thing is there.

* accuracy: right positives and negatives over possible detections; precision and recall are of the positives;
* Brier score: mean squared distance of belief and truth over possible detections;
* MES/S (eq. 5.1): mean over columns of `min(estimated / true survival time, 1)`. Both count from birth. A thing is
  removed at the first step, in view or not, in which its belief is below `rho_low`, and stays removed. The true time is
  cut at the end of the run; what is never removed counts 1.
* delay: MES/S is best for a filter that removes nothing, so it is told together with the looks that it takes to remove
  what has vanished: steps in view from the first without it to that of its removal, both included. Only of columns that
  were not removed before, and were in view again. Those that are never removed are counted by themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from evermap.errors import InputError
from evermap.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class RemovalTally:
    """What happened in each of N columns; sums of these make scores, of all columns or of a resampling of them.

    Attributes:
        true_positive, false_positive, true_negative, false_negative: (N,) possible detections of each kind.
        squared_error: (N,) sum over possible detections.
        survival_ratio: (N,) estimated over true survival time, at most 1.
        delay_looks: (N,) inf where it was never removed, nan where there is no delay to speak of.
    """

    true_positive: FloatArray
    false_positive: FloatArray
    true_negative: FloatArray
    false_negative: FloatArray
    squared_error: FloatArray
    survival_ratio: FloatArray
    delay_looks: FloatArray


@dataclass(frozen=True, slots=True)
class RemovalScores:
    """Scores of many columns, as the module defines them; nan where there is nothing to score.

    Attributes:
        accuracy: share of possible detections that were decided rightly.
        precision: share of positives at which the thing was there.
        recall: share of possible detections with the thing there that were positives.
        brier: mean squared error of the belief.
        survival_ratio: MES/S.
        delay_mean: of those removed after they had vanished, in looks.
        delay_p95: 95th percentile of the same.
        vanished: weight of the columns that vanished while in the map, and were in view again.
        never_removed: weight of those among them that stayed in the map.
    """

    accuracy: float
    precision: float
    recall: float
    brier: float
    survival_ratio: float
    delay_mean: float
    delay_p95: float
    vanished: float
    never_removed: float


def removal_tally(
    belief: FloatArray,
    in_view: BoolArray,
    first: IntArray,
    survival_steps: FloatArray,
    *,
    rho_high: float = 0.9,
    rho_low: float = 0.2,
) -> RemovalTally:
    """Compare beliefs of N columns over F steps with the truth.

    Args:
        belief: (F, N) probability that each thing is there, after the looks of the step.
        in_view: (F, N) whether it was looked at; steps before its birth are ignored.
        first: (N,) step of birth.
        survival_steps: (N,) it is there up to and with `first + survival_steps`.
        rho_high: from this belief on its measurements are used.
        rho_low: below this belief it is removed.

    Raises:
        InputError: shapes that do not fit, or a belief outside [0, 1].
    """
    steps, columns = belief.shape
    for name, shape, wanted in (
        ("in_view", in_view.shape, (steps, columns)),
        ("first", first.shape, (columns,)),
        ("survival_steps", survival_steps.shape, (columns,)),
    ):
        if shape != wanted:
            raise InputError(f"shape {shape} instead of {wanted}", field=name)
    if not ((belief >= 0.0) & (belief <= 1.0)).all():
        raise InputError("not all are probabilities", field="belief", hint="numbers between 0 and 1")

    step = np.arange(steps)[:, None]
    there = step <= first + survival_steps
    born = step >= first
    possible = in_view & born
    positive = belief >= rho_high
    removed = _first_true(born & (belief < rho_low))
    vanished = _first_true(~there)

    true_steps = np.minimum(survival_steps, steps - 1 - first)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where((removed < steps) & (true_steps > 0.0), (removed - first) / true_steps, 1.0)
    looks_since = possible & (step >= vanished)
    delay = np.where(removed < steps, (looks_since & (step <= removed)).sum(axis=0), np.inf)
    return RemovalTally(
        true_positive=_count(possible & positive & there),
        false_positive=_count(possible & positive & ~there),
        true_negative=_count(possible & ~positive & ~there),
        false_negative=_count(possible & ~positive & there),
        squared_error=np.asarray(np.sum(np.where(possible, (belief - there) ** 2, 0.0), axis=0)),
        survival_ratio=np.minimum(ratio, 1.0),
        delay_looks=np.where((removed >= vanished) & looks_since.any(axis=0), delay, np.nan),
    )


def _first_true(what: BoolArray) -> IntArray:
    """(N,) first step in which it is so; the number of steps where it never is."""
    return np.where(what.any(axis=0), np.argmax(what, axis=0), len(what))


def _count(what: BoolArray) -> FloatArray:
    return np.asarray(what.sum(axis=0), dtype=np.float64)


def removal_scores(tally: RemovalTally, weight: FloatArray | None = None) -> RemovalScores:
    """Scores of all columns together.

    Args:
        tally: of N columns.
        weight: (N,) of each; a landmark has its share of its clique. All 1 where None.
    """
    w = np.ones(len(tally.survival_ratio)) if weight is None else weight

    def total(values: FloatArray) -> float:
        return float(values @ w)

    right, wrong = total(tally.true_positive), total(tally.false_positive)
    rejected, missed = total(tally.true_negative), total(tally.false_negative)
    possible = right + wrong + rejected + missed
    late = (w > 0.0) & ~np.isnan(tally.delay_looks)
    found = late & np.isfinite(tally.delay_looks)
    delay, share = tally.delay_looks[found], w[found]
    return RemovalScores(
        accuracy=_ratio(right + rejected, possible),
        precision=_ratio(right, right + wrong),
        recall=_ratio(right, right + missed),
        brier=_ratio(total(tally.squared_error), possible),
        survival_ratio=_ratio(total(tally.survival_ratio), float(w.sum())),
        delay_mean=_ratio(float(delay @ share), float(share.sum())),
        delay_p95=_percentile(delay, share, 0.95),
        vanished=float(w[late].sum()),
        never_removed=float(w[late & ~found].sum()),
    )


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole > 0.0 else float("nan")


def _percentile(values: FloatArray, weight: FloatArray, share: float) -> float:
    if not len(values):
        return float("nan")
    return float(np.quantile(values, share, weights=weight, method="inverted_cdf"))


def bootstrap(
    tally: RemovalTally, run: IntArray, *, weight: FloatArray | None = None, draws: int = 200, seed: int = 0
) -> list[RemovalScores]:
    """Scores of resampled runs: whole runs are drawn again, since what is in one run is not independent.

    The same seed draws the same runs, whatever the tally: differences of two filters can be taken draw by draw.

    Args:
        tally: of N columns.
        run: (N,) which run each is of, counted from 0.
        weight: as in `removal_scores`.
        draws: samples of as many runs as there are, with replacement.
        seed: of the draws.
    """
    runs = int(run.max()) + 1
    w = np.ones(len(run)) if weight is None else weight
    drawn = np.random.default_rng(seed).multinomial(runs, np.full(runs, 1.0 / runs), size=draws)
    return [removal_scores(tally, w * times[run]) for times in drawn]


def standard_errors(draws: Sequence[RemovalScores]) -> RemovalScores:
    """Standard deviation of every score over the draws in which it is known; nan where those are fewer than two."""
    table = np.array([astuple(scores) for scores in draws])
    known = [column[np.isfinite(column)] for column in table.T]
    return RemovalScores(*(float(np.std(column, ddof=1)) if len(column) > 1 else float("nan") for column in known))
