"""Calibration of stated probabilities: Brier score, log loss, expected calibration error, false among the certain."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from evermap_score.episodes import Episodes, FloatArray
from evermap_score.matching import World, pair_rows
from evermap_score.metric import Metric, metric_of_rows, ratio

BINS = 10
CERTAIN_P = 0.99
SMALLEST_P = 1e-6
"""Probabilities are clipped to this for the log loss, which one wrong certainty would make infinite otherwise."""


@dataclass(frozen=True)
class ReliabilityBins:
    """Bins of equal mass for the reliability figure.

    Attributes:
        mean_p: (b,) mean of the stated probabilities of each bin.
        share_true: (b,) how much of it was true.
        mass: (b,) weight of each bin.
    """

    mean_p: FloatArray
    share_true: FloatArray
    mass: FloatArray


def bin_by_mass(p: FloatArray, outcome: FloatArray, weights: FloatArray, bins: int = BINS) -> ReliabilityBins:
    """Return bins of equal mass along the probability; equal probabilities are in one bin.

    Args:
        p: stated probabilities (n,).
        outcome: 1 if true, else 0, (n,).
        weights: of the items (n,).
        bins: how many at most.
    """
    if weights.sum() <= 0.0:
        return ReliabilityBins(np.empty(0), np.empty(0), np.empty(0))
    values, index = np.unique(p, return_inverse=True)
    mass = np.bincount(index, weights, minlength=len(values))
    true = np.bincount(index, weights * outcome, minlength=len(values))
    middle = (np.cumsum(mass) - 0.5 * mass) / mass.sum()
    number = np.minimum((middle * bins).astype(np.int64), bins - 1)
    total: FloatArray = np.bincount(number, mass, minlength=bins).astype(np.float64)
    used = total > 0.0
    return ReliabilityBins(
        np.bincount(number, mass * values, minlength=bins)[used] / total[used],
        np.bincount(number, true, minlength=bins)[used] / total[used],
        total[used],
    )


def calibration_error(columns: FloatArray, weights: FloatArray) -> float:
    """Return the expected calibration error: the mean distance of stated and true shares over bins of equal mass.

    Args:
        columns: probability and outcome (n, 2).
        weights: of the items (n,).
    """
    bins = bin_by_mass(columns[:, 0], columns[:, 1], weights)
    if len(bins.mass) == 0:
        return float("nan")
    return float(np.average(np.abs(bins.mean_p - bins.share_true), weights=bins.mass))


def claims_at(world: World, estimate: Episodes, query_s: float) -> list[tuple[str, float, float]]:
    """Return what an estimate states for an instant: landmark, probability that it is there, and whether it is.

    A row is true if it has a partner in the truth (`matching.pair_rows`). What is there and was looked at, and of which
    the estimate has no row, is a statement with probability 0: an estimate does not gain by silence. Of a landmark that
    was never looked at a missing row is no statement.
    """
    truth = world.truth.state_at(query_s)
    stated = estimate[estimate.is_present(query_s)]
    true_rows, rows = pair_rows(truth, stated, world.rules)
    partner = dict(zip(rows.tolist(), true_rows.tolist(), strict=True))
    claims = []
    for row, name in enumerate(stated.landmark_id.tolist()):
        about = str(truth.landmark_id[partner[row]]) if row in partner else name
        claims.append((about, float(stated.p[row]), float(row in partner)))
    for row in sorted(set(range(len(truth))) - set(true_rows.tolist())):
        name = str(truth.landmark_id[row])
        if world.count_looks(name, to_s=query_s) > 0:
            claims.append((name, 0.0, 1.0))
    return claims


def calibration_items(world: World, estimate: Episodes, *, ahead: bool) -> list[tuple[int, str, tuple[float, float]]]:
    """Return (session, landmark, (probability, outcome)) of all statements now, or of those one session ahead.

    Now: at each instant the map of that robot time; with one map it is asked for all instants. Ahead: the map of each
    robot time is asked for the next instant; none with one map.
    """
    instants = world.instants_s.tolist()
    several = len(estimate.robot_times_s()) > 0
    if ahead and not several:
        return []
    pairs = pairwise(instants) if ahead else zip(instants, instants, strict=True)
    return [
        (world.session_of(query_s), name, (p, true))
        for robot_s, query_s in pairs
        for name, p, true in claims_at(world, estimate.select_map(robot_s), query_s)
    ]


def calibration_metrics(world: World, estimate: Episodes) -> list[Metric]:
    """Return the calibration now and as a forecast.

    Brier (1950): mean of (p - outcome)^2. Log loss: mean of -log of the probability of what was true, in nats. ECE in
    ten bins of equal mass (Naeini et al., AAAI 2015, with bins as in Nguyen and O'Connor, EMNLP 2015).
    """
    return [
        metric
        for name, ahead in (("calibration", False), ("calibration_forecast", True))
        for metric in score_claims(name, calibration_items(world, estimate, ahead=ahead))
    ]


def score_claims(name: str, items: list[tuple[int, str, tuple[float, float]]]) -> list[Metric]:
    """Return the metrics of statements (session, landmark, (probability, outcome))."""
    brier, loss, certain = [], [], []
    for session, landmark, (p, true) in items:
        brier.append((session, landmark, ((p - true) ** 2, 1.0)))
        clipped = min(max(p, SMALLEST_P), 1.0 - SMALLEST_P)
        loss.append((session, landmark, (-float(np.log(clipped if true else 1.0 - clipped)), 1.0)))
        if p > CERTAIN_P:
            certain.append((session, landmark, (1.0 - true, 1.0)))
    return [
        metric_of_rows(f"{name}/brier", "", brier, 2, of_sums=ratio([0], [1])),
        metric_of_rows(f"{name}/log_loss", "nats", loss, 2, of_sums=ratio([0], [1])),
        metric_of_rows(f"{name}/ece", "", items, 2, of_items=calibration_error),
        metric_of_rows(f"{name}/false_above_99", "", certain, 2, of_sums=ratio([0], [1])),
    ]
