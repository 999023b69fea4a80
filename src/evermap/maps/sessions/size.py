"""How long the map's metre is: every session knows it a little, by the priors of its range slope and wheel size.

A graph whose scale is free shrinks: smaller worlds have smaller residuals. So the scale is held inside every graph and
settled outside, where it is a one-dimensional Gaussian: with `e` the log of the map's metre over the true one and `g`
that of the true metre over the session's, how much longer the map is than the session shows `g + e`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.geometry import se2
from evermap.geometry.rigid import rigid
from evermap.types import FloatArray

ITERATIONS = 5
WALK = 0.002
"""Standard deviation by which the log of a map's metre wanders in a session, as its landmarks are replaced."""


@dataclass(frozen=True, slots=True)
class Size:
    """What a session and a map say of the size of the world, together.

    Attributes:
        map_factor: by which the map should be longer.
        session_factor: metres of that map for one of the session's own.
        variance: of the log of the map's metre, after the session.
        information: sum of the inverse variances of all sessions that the map's metre is the mean of.
    """

    map_factor: float
    session_factor: float
    variance: float
    information: float


def settled(
    log_ratio: float, ratio_variance: float, session: tuple[float, float], map_variance: float, information: float
) -> Size:
    """Both sizes after they were compared.

    The map's metre is the mean of those of all sessions. What one robot gets wrong about the metre it gets wrong in
    every session, so errors are taken as fully correlated: more sessions do not make the metre surer.

    Args:
        log_ratio: of the map's size over that of the session, as its landmarks show it.
        ratio_variance: of it.
        session: log of the true metre over the session's, by its own priors, and the standard deviation of that.
        map_variance: of the log of the map's metre over the true one.
        information: of the map so far, see `Size`.
    """
    own, sigma = session
    before = 1.0 / (1.0 / information + WALK**2)
    after = 1.0 / (sigma**2 + ratio_variance)
    gain = after / (before + after)
    innovation = log_ratio - own
    return Size(
        map_factor=float(np.exp(-gain * innovation)),
        session_factor=float(np.exp(own + innovation * sigma**2 / (1.0 / before + sigma**2 + ratio_variance))),
        variance=((1.0 - gain) * np.sqrt(map_variance) + gain * sigma) ** 2 + gain**2 * min(ratio_variance, 1.0),
        information=before + after,
    )


def log_ratio(
    session_m: FloatArray, session_m2: FloatArray, map_m: FloatArray, map_m2: FloatArray
) -> tuple[float, float]:
    """Log of the map's size over the session's, and its variance: a similarity by generalised least squares.

    Where residuals are larger than the covariances allow, as in a session that is bent, the variance grows with them.

    Args:
        session_m: (K, 2) landmarks in the session's frame and metres.
        session_m2: (2 K, 2 K) their covariance, the scale held.
        map_m: (K, 2) the same in the map.
        map_m2: (2 K, 2 K) covariance of these.
    """
    if len(session_m) < 2:  # a point has no size
        return 0.0, np.inf
    size = float(
        np.sqrt(((map_m - map_m.mean(0)) ** 2).sum() / max(((session_m - session_m.mean(0)) ** 2).sum(), 1e-12))
    )
    motion, log_size, variance = np.zeros(3), np.log(size), np.inf
    motion = rigid(size * session_m, map_m)
    for _ in range(ITERATIONS):
        factor = np.exp(log_size)
        turned = se2.transform(np.array([0.0, 0.0, motion[2]]), session_m) * factor
        turn = factor * np.kron(np.eye(len(session_m)), se2.rotation(motion[2]))
        columns = np.column_stack([se2.rigid_directions(turned), turned.ravel()])
        rest = (map_m - turned - motion[:2]).ravel()
        weighed = np.linalg.solve(turn @ session_m2 @ turn.T + map_m2, np.column_stack([columns, rest]))
        information = columns.T @ weighed[:, :4]
        step = np.linalg.solve(information, columns.T @ weighed[:, 4])
        motion, log_size = motion + step[:3], log_size + step[3]
        squared = float(rest @ weighed[:, 4] - step @ information @ step)
        variance = float(np.linalg.inv(information)[3, 3]) * max(1.0, squared / max(len(rest) - 4, 1))
        if np.abs(step).max() < 1e-9:
            break
    return float(log_size), variance
