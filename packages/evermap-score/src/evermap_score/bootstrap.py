"""Intervals by the bootstrap, over sessions or over landmarks, with the same draws for everything that is compared."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evermap_score.episodes import FloatArray, TextArray
from evermap_score.metric import Metric

LEVEL = 0.95


def draw_weights(n_units: int, n_draws: int, seed: int) -> FloatArray:
    """Return how often each unit is in each draw with replacement, (draws, units)."""
    rng = np.random.default_rng(seed)
    return rng.multinomial(n_units, np.full(n_units, 1.0 / n_units), size=n_draws).astype(np.float64)


def list_units(metrics: Sequence[Metric], *, over_sessions: bool) -> TextArray:
    """Return the sessions or landmarks that contribute to any of the metrics, sorted, as text."""
    found = [_units_of(metric, over_sessions) for metric in metrics if len(metric.columns)]
    units: TextArray = np.unique(np.concatenate([np.empty(0, np.str_), *found]))
    named: TextArray = units[units != ""]
    return named


def _units_of(metric: Metric, over_sessions: bool) -> TextArray:
    """Return the unit of each item (n,); empty: of none."""
    if not over_sessions:
        return metric.landmark
    return np.where(metric.session < 0, "", metric.session.astype(np.str_))


def resample(metric: Metric, units: TextArray, weights: FloatArray, *, over_sessions: bool) -> FloatArray:
    """Return the metric in each draw (draws,).

    Items of no unit have weight one in all draws.

    Args:
        metric: with its items.
        units: sorted (u,).
        weights: of the units (draws, u).
        over_sessions: whether units are sessions; else landmarks.
    """
    if len(metric.columns) == 0:
        return np.full(len(weights), metric.value())
    belongs = _units_of(metric, over_sessions)
    index = np.where(belongs == "", len(units), np.searchsorted(units, belongs))
    extended = np.concatenate([weights, np.ones((len(weights), 1))], axis=1)
    if metric.of_sums is not None:
        sums = np.zeros((len(units) + 1, metric.columns.shape[1]))
        np.add.at(sums, index, metric.columns)
        return np.array([metric.of_sums(row) for row in extended @ sums])
    return np.array([metric.value(row[index]) for row in extended])


def interval(draws: FloatArray, level: float = LEVEL) -> tuple[float, float]:
    """Return the quantiles of the draws that bound their middle; NaN where fewer than half of them are defined."""
    known = draws[np.isfinite(draws)]
    if 2 * len(known) < len(draws) or len(known) == 0:
        return float("nan"), float("nan")
    low, high = np.quantile(known, [0.5 - level / 2.0, 0.5 + level / 2.0])
    return float(low), float(high)
