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

PERSIST_S = (1.0, 3.0, 10.0, 30.0)
"""Correlation times of detection errors that are tried together."""
SIGHTINGS_A_PLACE = 150
BINS, FEWEST_PAIRS = 14, 30
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
    count = len(problem.place)
    sensor = se3.compose(driven[problem.pose_row], problem.mount[problem.sensor])
    at, stamp_s = se3.transform(sensor, problem.measured[:, :3]), problem.stamp_s[problem.pose_row]
    lags, squares = [], []
    for place in range(len(problem.oriented)):
        mine = np.flatnonzero(problem.place == place)
        mine = mine[:: max(1, len(mine) // SIGHTINGS_A_PLACE)]
        i, j = np.triu_indices(len(mine), 1)
        lags.append(np.abs(stamp_s[mine[j]] - stamp_s[mine[i]]))
        squares.append(((at[mine[j]] - at[mine[i]]) ** 2).sum(axis=1))
    lag_s, square = _medians(np.concatenate(lags), np.concatenate(squares) / MEDIAN)
    if len(lag_s) < 4:
        return Drift(None, None, np.ones(count))
    columns = [np.ones(len(lag_s)), *(1.0 - np.exp(-lag_s / persist_s) for persist_s in PERSIST_S), lag_s]
    fitted, _ = nnls(np.column_stack(columns) / square[:, None], np.ones(len(lag_s)))
    variance = 0.5 * fitted[-1]
    rate_hz = _rate(problem, stamp_s)
    of_noise = fitted[0] + fitted[1:-1].sum()
    repeated = (fitted[1:-1] * np.array(PERSIST_S)).sum() / of_noise if of_noise > 0.0 else 0.0
    translation = float(np.sqrt(max(variance, LEAST_DRIFT**2)))
    range_m = float(np.median(np.linalg.norm(problem.measured[:, :3], axis=1)))
    return Drift(translation, translation / max(range_m, 1.0), 1.0 / (1.0 + 2.0 * repeated * rate_hz))


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


def _rate(problem: SpatialProblem, stamp_s: FloatArray) -> FloatArray:
    """(M,) detections of the same place a second, around each."""
    rate = np.zeros(len(stamp_s))
    for place in range(len(problem.oriented)):
        mine = np.flatnonzero(problem.place == place)
        near = stamp_s[mine]
        within = np.searchsorted(near, near + 0.5 * PERSIST_S[1], side="right") - np.searchsorted(
            near, near - 0.5 * PERSIST_S[1]
        )
        rate[mine] = (within - 1) / PERSIST_S[1]
    return rate
