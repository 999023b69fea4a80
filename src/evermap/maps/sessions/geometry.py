"""The joint Gaussian of a map's places, after a session that saw some of them and found others.

The poses of the session were marginalised, so nothing of it remains but this: the cost of a map is that of its size.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.geometry import se2
from evermap.maps.living import LivingMap
from evermap.types import FloatArray, IntArray


def with_session(
    position_m: FloatArray,
    covariance_m2: FloatArray,
    seen: IntArray,
    session_m: FloatArray,
    session_covariance_m2: FloatArray,
    drift_m: float,
) -> tuple[FloatArray, FloatArray]:
    """Positions and joint covariance of the old places, then of the new ones.

    What the session says of the places it saw moves those that it did not see, by their correlation.

    Args:
        position_m: (P, 2) as the map had them.
        covariance_m2: (2 P, 2 P).
        seen: (K,) rows of those that the session saw.
        session_m: (K + N, 2) posterior of these, then of N new ones.
        session_covariance_m2: (2 (K + N), 2 (K + N)) joint posterior.
        drift_m: as in `drifted`, when the session was solved.

    Returns:
        (P + N, 2) and (2 (P + N), 2 (P + N)).
    """
    count, new = len(position_m), len(session_m) - len(seen)
    s = se2.xy_rows(seen)
    k = len(s)
    u = np.setdiff1d(np.arange(2 * count), s)
    before = drifted(covariance_m2[np.ix_(s, s)], drift_m)
    gain = np.linalg.solve(before, covariance_m2[np.ix_(s, u)]).T if k else np.zeros((len(u), 0))
    mean = np.zeros(2 * (count + new))
    mean[s] = session_m[: len(seen)].ravel()
    mean[u] = position_m.ravel()[u] + gain @ (session_m[: len(seen)] - position_m[seen]).ravel()
    mean[2 * count :] = session_m[len(seen) :].ravel()
    joint = np.zeros((len(mean), len(mean)))
    place = np.concatenate([s, np.arange(2 * count, 2 * (count + new))])
    joint[np.ix_(place, place)] = session_covariance_m2
    joint[np.ix_(u, u)] = covariance_m2[np.ix_(u, u)] + gain @ (session_covariance_m2[:k, :k] - before) @ gain.T
    across = gain @ session_covariance_m2[:k]
    joint[np.ix_(u, place)] = across
    joint[np.ix_(place, u)] = across.T
    return mean.reshape(-1, 2), 0.5 * (joint + joint.T)


def anchored(position_m: FloatArray, covariance_m2: FloatArray) -> FloatArray:
    """The joint covariance of a new map in the frame that its places define: as a whole they neither move nor turn.

    A session knows its landmarks in the frame of its first pose, whose heading is no better known than the robot saw.
    Later sessions would turn the whole map as they learn how the robot stood when all began, which is of no interest.
    This is the S-transformation of geodesy (Baarda 1973) to inner constraints.
    """
    motion = se2.rigid_directions(position_m - position_m.mean(axis=0))
    onto = np.eye(len(motion)) - motion @ np.linalg.pinv(motion)
    return np.asarray(onto @ covariance_m2 @ onto.T)


def drifted(covariance_m2: FloatArray, drift_m: float) -> FloatArray:
    """Joint covariance (2 K, 2 K) of places of which each may be off by `drift_m` since the map was made."""
    return np.asarray(covariance_m2 + drift_m**2 * np.eye(len(covariance_m2)))


def resized(living: LivingMap, factor: float, log_size_variance: float, log_size_information: float) -> LivingMap:
    """The map longer by a factor, about its middle; how well its metre is known goes with it."""
    position = living.places.position_m
    middle = position.mean(axis=0)
    return replace(
        living,
        places=replace(living.places, position_m=middle + factor * (position - middle)),
        covariance_m2=factor**2 * living.covariance_m2,
        log_size_variance=log_size_variance,
        log_size_information=log_size_information,
    )


def blocks(covariance_m2: FloatArray) -> FloatArray:
    """(P, 2, 2) covariance of every place by itself, of the joint one (2 P, 2 P)."""
    count = len(covariance_m2) // 2
    rows = np.arange(count)
    return np.asarray(covariance_m2.reshape(count, 2, count, 2)[rows, :, rows, :])


def of_places(covariance_m2: FloatArray, rows: IntArray) -> FloatArray:
    """(2 K, 2 K) joint covariance of some places, in their order."""
    at = se2.xy_rows(rows)
    return np.asarray(covariance_m2[np.ix_(at, at)])
