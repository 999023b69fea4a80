"""How far odometry drifts and for how long detection errors persist, before anything is estimated.

Each landmark is put where each of its sightings has it along the odometry alone. The squared distance between two of
these places grows with the time between them: at once by white noise, to a limit by errors that persist (a view, a bias
of the detector), and for ever by drift. The three are fitted to medians over pairs (a variogram, Matheron 1963), so
that outliers do not matter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from evermap.geometry import se3
from evermap.slam.space.problem import SpatialProblem
from evermap.types import FloatArray

PERSIST_S = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""Correlation times of detection errors that are tried together; the last two only where the drift is known."""
SIGHTINGS_A_PLACE = 150
BINS, FEWEST_BINS, FEWEST_PAIRS = 14, 4, 30
MEDIAN = 2.366
"""Of the chi-square distribution with three degrees of freedom."""
LEAST_DRIFT = 3e-4
"""Metres for the square root of a second; no odometry is better."""


class Drift(NamedTuple):
    """What a recording says of its noise.

    Attributes:
        translation: of the odometry [m / sqrt(s)]; rotation: [rad / sqrt(s)]; None where too little is seen twice.
        share: (M,) of the information of each detection that is new.
    """

    translation: float | None
    rotation: float | None
    share: FloatArray


def drift_of(problem: SpatialProblem, driven: FloatArray) -> Drift:
    """Return the drift of the odometry, poses (N, 7), and how much of each detection is new."""
    sensor = se3.compose(driven[problem.pose_row], problem.mount[problem.sensor])
    at, stamp_s = se3.transform(sensor, problem.measured[:, :3]), problem.stamp_s[problem.pose_row]
    medians = {}
    for place in range(len(problem.oriented)):
        mine = np.flatnonzero(problem.place == place)
        some = mine[:: max(1, len(mine) // SIGHTINGS_A_PLACE)]
        i, j = np.triu_indices(len(some), 1)
        square = ((at[some[j]] - at[some[i]]) ** 2).sum(axis=1) / MEDIAN
        lag_s, square = _medians(np.abs(stamp_s[some[j]] - stamp_s[some[i]]), square)
        if len(lag_s) >= FEWEST_BINS:
            medians[place] = lag_s, square
    share = np.ones(len(problem.place))
    if not medians:
        return Drift(None, None, share)
    # all landmarks drift alike: what one of them stays behind, others moved by errors of their own
    growth = min(_fitted(lag_s, square, PERSIST_S[:-2], 0.0)[-1] for lag_s, square in medians.values())
    for place, (lag_s, square) in medians.items():
        mine = np.flatnonzero(problem.place == place)
        parts = _fitted(lag_s, square, PERSIST_S, growth)
        repeated = (parts[1:-1] * np.array(PERSIST_S)).sum() / max(parts[:-1].sum(), 1e-12)
        share[mine] = 1.0 / (1.0 + 2.0 * repeated * _rate(stamp_s[mine]))
    translation = float(np.sqrt(max(0.5 * growth, LEAST_DRIFT**2)))
    range_m = float(np.median(np.linalg.norm(problem.measured[:, :3], axis=1)))
    return Drift(translation, translation / max(range_m, 1.0), share)


def _fitted(lag_s: FloatArray, square: FloatArray, persist_s: tuple[float, ...], growth: float) -> FloatArray:
    """Parts of a variogram: white, persistent for each of some times, and growing without end; the last is given,
    unless it is 0.
    """
    columns = [np.ones(len(lag_s)), *(1.0 - np.exp(-lag_s / each_s) for each_s in persist_s)]
    rest = np.maximum(square - growth * lag_s, 0.0)
    columns += [] if growth > 0.0 else [lag_s]
    found, _ = nnls(np.column_stack(columns) / square[:, None], rest / square)
    return np.append(found, growth) if growth > 0.0 else np.asarray(found)


def _medians(lag_s: FloatArray, square: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Median lag and median square of pairs, by lag."""
    some = lag_s > 0.0
    lag_s, square = lag_s[some], square[some]
    if len(lag_s) < FEWEST_PAIRS:
        return np.zeros(0), np.zeros(0)
    edges = np.geomspace(lag_s.min(), lag_s.max() * (1.0 + 1e-9), BINS)
    row = np.digitize(lag_s, edges)
    bins = [row == k for k in range(1, BINS) if np.count_nonzero(row == k) >= FEWEST_PAIRS]
    median = np.array([[np.median(lag_s[mine]), np.median(square[mine])] for mine in bins]).reshape(-1, 2)
    return median[:, 0], np.maximum(median[:, 1], 1e-12)


def _rate(stamp_s: FloatArray) -> FloatArray:
    """(K,) detections of one place a second, around each."""
    half_s = 0.5 * PERSIST_S[1]
    first, last = np.searchsorted(stamp_s, stamp_s - half_s), np.searchsorted(stamp_s, stamp_s + half_s, side="right")
    return np.asarray((last - first - 1) / PERSIST_S[1])
